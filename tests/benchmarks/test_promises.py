"""Bad input: a broken promise is noticed, and the command counts what it tried."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks.bad_input import __main__ as bad_input
from benchmarks.bad_input.matches import KINDS
from benchmarks.bad_input.promises import broken_essential, broken_promises, broken_twin_answer
from mgca_filter import FilterResult, Status


def result_with(**changes: object) -> FilterResult:
    """A right answer on ten matches, but for the changes."""
    E = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
    fields = {
        "mask": np.ones(10, bool), "scores": np.full(10, 0.9, np.float32), "matches": [0] * 10, "E": E, "F": E,
        "R": np.eye(3), "t": np.array([1.0, 0, 0]), "H": None, "status": Status.OK, "num_inliers": 10, **changes,
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


@pytest.mark.slow
def test_command_prints_what_was_tried(model_file, capsys, monkeypatch) -> None:
    assert bad_input.main(["--model", str(model_file), "--rounds", "1"]) == 0
    out = capsys.readouterr().out
    databases = len(bad_input.DATABASES) if find_spec("pycolmap") else 0  # colmap asks for it before it reads
    count = len(KINDS) * 6 + len(bad_input.FILES) + databases
    assert f"{count} inputs tried, 0 failures" in out
    monkeypatch.setattr(bad_input, "matchMGCA", lambda *arguments: 1 / 0)
    assert bad_input.main(["--model", str(model_file), "--rounds", "1"]) == 1
    done = capsys.readouterr()
    assert "1 (1 failed)" in done.out
    assert "ZeroDivisionError" in done.err
    assert bad_input.main(["--model", "absent.onnx"]) == 2
    assert "absent.onnx" in capsys.readouterr().err
