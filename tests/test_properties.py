"""Whatever the data: no exception, and every promise kept. Kinds, counts and types are drawn by hypothesis."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import K
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mgca_filter import FilterResult, MatchFilter, Status, findEssentialMat, findFundamentalMat
from mgca_filter.evaluation import stress
from mgca_filter.evaluation.hostile_inputs import FORMS, KINDS
from mgca_filter.evaluation.promises import broken_essential, broken_promises, broken_twin_answer

ANY = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
COUNTS = st.integers(0, 40) | st.integers(0, 3000)
SEEDS = st.integers(0, 2**32 - 1)


@ANY
@given(SEEDS, COUNTS, st.sampled_from(sorted(KINDS)), st.sampled_from(sorted(FORMS)), st.booleans())
def test_any_matches_in_any_type(
    match_filter: MatchFilter, seed: int, count: int, kind: str, form: str, known: bool
) -> None:
    rng = np.random.default_rng(seed)
    kp1, kp2, matches = FORMS[form](*KINDS[kind](rng, count), rng)
    result = match_filter.filter(kp1, kp2, matches, K1=K if known else None)
    assert broken_promises(result, count) == []


@ANY
@given(SEEDS, COUNTS, st.sampled_from(["magsac", "ransac", "poselib", "none"]), st.booleans())
def test_any_mixture_by_any_method(model_file, seed: int, count: int, method: str, known: bool) -> None:
    if method == "poselib":
        pytest.importorskip("poselib")
    rng = np.random.default_rng(seed)
    result = MatchFilter(model=model_file, method=method, keep_precision=0.7).filter(
        *KINDS["mixture"](rng, count), None, K1=K if known else None
    )
    assert [b for b in broken_promises(result, count) if "without a model" not in b or method != "none"] == []


@settings(ANY, max_examples=20)
@given(SEEDS, COUNTS, st.sampled_from(sorted(KINDS)))
def test_any_points_through_the_twins(seed: int, count: int, kind: str) -> None:
    points1, points2 = KINDS[kind](np.random.default_rng(seed), count)
    assert broken_twin_answer(findEssentialMat(points1, points2, K), count, essential=True) == []
    assert broken_twin_answer(findFundamentalMat(points1, points2), count, essential=False) == []


def result_with(**changes: object) -> FilterResult:
    """A right answer on ten matches, but for the changes."""
    E = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
    fields = {
        "mask": np.ones(10, bool), "scores": np.full(10, 0.9, np.float32), "matches": [0] * 10, "E": E, "F": E,
        "R": np.eye(3), "t": np.array([1.0, 0, 0]), "status": Status.OK, "num_inliers": 10, **changes,
    }  # fmt: skip
    return FilterResult(**fields)


@pytest.mark.parametrize(
    "changes",
    [
        {"mask": np.ones(9, bool)},
        {"mask": np.ones(10, np.uint8)},
        {"scores": np.full(10, np.nan, np.float32)},
        {"scores": np.full(10, 1.1, np.float32)},
        {"num_inliers": 9},
        {"E": None},
        {"E": np.eye(3)},
        {"E": np.zeros((18, 3))},
        {"F": np.full((3, 3), np.nan)},
        {"R": -np.eye(3)},
        {"R": np.diag([1.0, 1.0, 0.9])},
        {"t": np.array([2.0, 0, 0])},
        {"E": None, "F": None, "R": None, "t": None},
    ],
    ids=str,
)
def test_a_broken_promise_is_noticed(changes: dict) -> None:
    assert broken_promises(result_with(), 10) == []
    assert broken_promises(result_with(**changes), 10) != []


def test_broken_answers_of_twins_are_noticed() -> None:
    mask = np.ones((4, 1), np.uint8)
    assert broken_twin_answer((None, mask), 4, essential=True) == []
    assert broken_twin_answer((None, mask * 255), 4, essential=True) != []
    assert broken_twin_answer((None, mask.ravel()), 4, essential=True) != []
    assert broken_twin_answer((np.eye(3), mask), 4, essential=True) != []
    assert broken_essential(np.diag([1.0, 1.0, 0.1])) != []


def test_command_prints_what_was_tried(model_file, capsys, monkeypatch) -> None:
    assert stress.main(["--model", str(model_file), "--rounds", "2"]) == 0
    out = capsys.readouterr().out
    assert f"{len(KINDS) * 2 * 5 + len(stress.FILES)} inputs tried, 0 failures" in out
    monkeypatch.setattr(stress, "matchMGCA", lambda *arguments: 1 / 0)
    assert stress.main(["--model", str(model_file), "--rounds", "1"]) == 1
    done = capsys.readouterr()
    assert "1 (1 failed)" in done.out
    assert "ZeroDivisionError" in done.err
