"""What an editor says of calls: right ones pass, wrong ones are marked, under pyright as editors run it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

RIGHT = """
import cv2
import numpy as np
import mgca_filter

k, m = [cv2.KeyPoint(1, 2, 3)], [cv2.DMatch(0, 0, 1.0)]
knn = cv2.BFMatcher().knnMatch(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32), 2)
result = mgca_filter.filter_matches(k, tuple(k), m, K1=np.eye(3), size1=(3, 4))
mgca_filter.filter_matches(iter(k), np.array(k), knn, K=[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
mgca_filter.filter_matches(np.zeros((3, 2)), [(1.0, 2.0)], None, method=cv2.USAC_MAGSAC)
mgca_filter.filter_matches(k, k, np.zeros((1, 2), int), model="other.onnx")
E, mask = mgca_filter.findEssentialMat(np.zeros((8, 2)), np.zeros((8, 2)), np.eye(3))
word: str = result.status
T = result.relative_pose()
if result and T is not None:
    print(T @ T, result.dmatches[0].queryIdx)
"""
WRONG = [
    "mgca_filter.filter_matches(3, [], None)",
    "mgca_filter.filter_matches([], 'points', None)",
    "mgca_filter.filter_matches([], [], [cv2.KeyPoint()])",
    "mgca_filter.filter_matches([], [], None, K1=800.0)",
    "mgca_filter.filter_matches([], [], None, threshold='1 px')",
    "mgca_filter.filter_matches([], [], None, treshold=1.0)",
]


def complaints(path: Path) -> list[str]:
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    try:
        report = json.loads(done.stdout)
    except json.JSONDecodeError:
        pytest.skip(f"pyright cannot run here: {(done.stderr or done.stdout).strip()[-200:]}")
    return [str(item["range"]["start"]["line"]) for item in report["generalDiagnostics"] if item["severity"] == "error"]


@pytest.mark.slow
def test_pyright_passes_right_calls_and_marks_wrong_ones(tmp_path: Path) -> None:
    pytest.importorskip("pyright")
    script = tmp_path / "calls.py"
    script.write_text(RIGHT + "\n".join(WRONG) + "\n")
    first = len(RIGHT.splitlines())
    assert sorted(set(complaints(script)), key=int) == [str(first + i) for i in range(len(WRONG))]
