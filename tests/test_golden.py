"""The filter answers as the golden files say; ``cpp/tests/test_golden.cpp`` asks the same of the C++ library.

Rewrite the files with ``python tests/golden/write_goldens.py`` where an answer changes on purpose.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
import pytest

from mgca_filter import FilterResult, Status
from mgca_filter.geometry.epipolar import pose_error_deg

sys.path.insert(0, str(Path(__file__).parent / "golden"))

from golden_files import FOLDER, MAX_POSE_DEG, MIN_IOU, Case, GoldenInput, answer, iou  # noqa: E402

CASES = [Case(**case) for case in json.loads((FOLDER / "cases.json").read_text(encoding="utf-8"))]
# Another machine's rounding moves logits, and what ranks by them; where it does not, the answers are the same.
SAME_ROUNDING, MEAN_SCORE_DIFFERENCE = 1e-4, 0.03


def expected_of(case: Case) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((FOLDER / "expected" / f"{case.name}.json").read_text(encoding="utf-8"))
    return values


def mask_of(expected: dict[str, Any]) -> np.ndarray:
    return np.array([character == "1" for character in expected["mask"]], dtype=bool)


def rounds_alike(expected: dict[str, Any], result: FilterResult) -> bool:
    """True where the answer was written by the same OpenCV and ONNX Runtime on a like machine."""
    versions = (expected["opencv"], expected["onnxruntime"]) == (cv2.__version__, onnxruntime.__version__)
    return versions and np.allclose(result.info["logits"], expected["logits"], atol=SAME_ROUNDING)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_answers_are_those_of_the_golden_files(case: Case) -> None:
    expected = expected_of(case)
    result = answer(case, GoldenInput.read(FOLDER / "inputs" / f"{case.input}.json"))
    mask = mask_of(expected)
    assert len(result.mask) == len(mask)
    assert result.info["intrinsics"] == expected["intrinsics"]
    # Numbers in them, an estimated focal length for one, move with the version of OpenCV.
    assert [text[:12] for text in result.info["assumptions"]] == [text[:12] for text in expected["assumptions"]]
    if len(mask) and result.info["networks"] == expected["networks"]:
        assert np.mean(np.abs(result.scores - expected["scores"])) < MEAN_SCORE_DIFFERENCE
    same = rounds_alike(expected, result)
    if not (same or expected["stable"]):
        return
    assert str(result.status) == expected["status"]
    assert bool(result.info.get("mirrored")) == expected["mirrored"]
    if same and expected["focal_px"] is not None:
        np.testing.assert_allclose(result.info["focal_px"], expected["focal_px"], rtol=1e-3)
    assert iou(result.mask, mask) >= (1.0 if same else min(MIN_IOU, 1.0 - 1.5 / max(mask.sum(), 1)))
    for name in ("E", "F", "R", "t"):
        assert (getattr(result, name) is None) == (expected[name] is None)
    if expected["t"] is not None and expected["intrinsics"] == "given":
        R = np.reshape(expected["R"], (3, 3))
        assert pose_error_deg(result.R, result.t, R, expected["t"]) < MAX_POSE_DEG


def test_golden_files_hold_every_status() -> None:
    assert {expected_of(case)["status"] for case in CASES} == {str(status) for status in Status}


def test_golden_files_hold_every_option() -> None:
    """Of the filter, but for those of the runtime and of other packages."""
    held = {name for case in CASES for name in case.options}
    assert held >= {
        "threshold",
        "keep_precision",
        "confidence",
        "method",
        "effort",
        "max_iterations",
        "seed",
        "geometry",
    }
    assert {"prosac", "magsac", "ransac", "none"} <= {case.options.get("method") for case in CASES}


def test_every_golden_file_is_asked_for() -> None:
    """No leftovers of an earlier list."""
    assert {path.stem for path in (FOLDER / "expected").glob("*.json")} == {case.name for case in CASES}
    assert {path.stem for path in (FOLDER / "inputs").glob("*.json")} == {case.input for case in CASES}
