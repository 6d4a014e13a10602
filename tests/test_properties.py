"""Whatever the data: no exception, and every promise kept. Kinds, counts and types are drawn by hypothesis."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import K
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.bad_input.matches import FORMS, KINDS
from benchmarks.bad_input.promises import broken_promises, broken_twin_answer
from mgca_filter import MatchFilter, findEssentialMat, findFundamentalMat

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
