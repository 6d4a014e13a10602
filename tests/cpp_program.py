"""The C++ example's program: built, run on a pair, its answer compared with Python's.

Needs CMake, a C++ compiler, OpenCV's headers, and ONNX Runtime's headers and library: in the folder that the
environment variable ONNXRUNTIME_ROOT names (include/ and lib/), or where CMake looks by itself.
"""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mgca_filter
from mgca_filter import FilterResult
from mgca_filter.features import match_descriptors
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.inference import OnnxBackend

SOURCE = Path(__file__).parent.parent / "examples" / "cpp"
FOUND, NOTHING_FOUND, ERROR = 0, 1, 2
# Two versions of OpenCV draw other samples; refinement stops a little beside the optimum that both share.
MAX_POSE_DIFFERENCE_DEG = 0.1
# The compiler may take minutes on a busy machine.
BUILD_TIMEOUT = pytest.mark.timeout(1200)
_BUILDS = tempfile.TemporaryDirectory(prefix="mgca_cpp_")


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(word) for word in command], capture_output=True, text=True)


@functools.cache
def opencv_version() -> tuple[int, ...]:
    """Version of the OpenCV that CMake finds; skips the test where it, CMake or the compiler is missing."""
    compiler = os.environ.get("CXX", "c++")
    for tool in ("cmake", compiler):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} not found")
    folder = Path(_BUILDS.name) / "probe"
    folder.mkdir(exist_ok=True)
    probe = "cmake_minimum_required(VERSION 3.16)\nproject(probe CXX)\nfind_package(OpenCV QUIET)\n"
    (folder / "CMakeLists.txt").write_text(probe + 'message(STATUS "OpenCV=${OpenCV_VERSION}")\n')
    found = re.search(r"OpenCV=([\d.]+)", run("cmake", "-S", folder, "-B", folder / "build").stdout)
    if found is None:
        pytest.skip("OpenCV's headers and CMake files not found (Debian: libopencv-dev)")
    return tuple(int(part) for part in found[1].split("."))


def build(source: Path, folder: Path, target: str, *options: str) -> Path:
    """The program ``target`` of a CMake project, built with warnings as errors."""
    done = run("cmake", "-S", source, "-B", folder, "-DCMAKE_CXX_FLAGS=-Werror", *options)
    assert done.returncode == 0, done.stdout + done.stderr
    done = run("cmake", "--build", folder, "--config", "Release", "--target", target)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(path for path in folder.rglob(f"{target}*") if path.is_file() and os.access(path, os.X_OK))


@functools.cache
def build_program() -> Path:
    """The program on ONNX Runtime, built once for all tests; skips where something is missing."""
    opencv_version()
    folder = Path(_BUILDS.name) / "program"
    if "ONNXRUNTIME_ROOT" not in os.environ:
        done = run("cmake", "-S", SOURCE, "-B", folder)
        if "runs on ONNX Runtime" not in done.stdout:
            pytest.skip("ONNX Runtime's headers and library not found; ONNXRUNTIME_ROOT may name their folder")
    return build(SOURCE, folder, "mgca_match_cpp")


@dataclass(frozen=True)
class Pair:
    """What goes into both programs."""

    keypoints1: list[cv2.KeyPoint]
    keypoints2: list[cv2.KeyPoint]
    matches: Sequence[Any]
    K1: np.ndarray
    K2: np.ndarray

    def write(self, path: Path) -> Path:
        """As a file for ``--matches``; every row has as many candidates as the first."""
        rows = [[match] if isinstance(match, cv2.DMatch) else match for match in self.matches]
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, keypoints in (("keypoints1", self.keypoints1), ("keypoints2", self.keypoints2)):
            storage.write(name, np.array([(*k.pt, k.size, k.angle) for k in keypoints], np.float32))
        storage.write("matches", np.array([(row[0].queryIdx, row[0].trainIdx) for row in rows], np.int32))
        storage.write("distances", np.array([[match.distance for match in row] for row in rows], np.float32))
        storage.release()
        return path


def comma_separated(K: np.ndarray) -> str:
    return ",".join(repr(float(K[index])) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))


def run_program(program: Path, pair: Pair, model: Path, folder: Path, *options: str) -> dict[str, Any]:
    """Answer of the C++ program; the exit status agrees with it."""
    matches = pair.write(folder / "matches.yml")
    cameras = ("--K", comma_separated(pair.K1), "--K2", comma_separated(pair.K2))
    done = run(program, "--matches", matches, "--model", model, *cameras, *options)
    assert done.stdout, done.stderr
    answer = json.loads(done.stdout)
    assert done.returncode == (NOTHING_FOUND if answer["E"] is None else FOUND)
    return answer


def assert_same_scores(
    program: Path, pair: Pair, model: Path, folder: Path, **options: Any
) -> tuple[dict[str, Any], FilterResult]:
    """Scores and network mask of the C++ program against those of Python; both answers."""
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    answer = run_program(program, pair, model, folder, *words)
    expected = mgca_filter.filter_matches(
        pair.keypoints1, pair.keypoints2, pair.matches, K1=pair.K1, K2=pair.K2, model=model, **options
    )
    threshold = OnnxBackend(model).metadata.decision_threshold
    logits = expected.info["logits"]
    np.testing.assert_allclose(answer["logits"], logits, atol=1e-3)
    np.testing.assert_allclose(answer["scores"], expected.scores, atol=1e-3)
    np.testing.assert_array_equal(np.array(answer["network_mask"], bool), logits > threshold)
    return answer, expected


def assert_same_answer(program: Path, pair: Pair, model: Path, folder: Path, **options: Any) -> dict[str, Any]:
    """Scores, masks and pose of the C++ program against those of Python; the answer."""
    answer, expected = assert_same_scores(program, pair, model, folder, **options)
    mask = np.array(answer["mask"], bool)
    union = np.count_nonzero(mask | expected.mask)
    assert expected.num_inliers > 30
    assert np.count_nonzero(mask & expected.mask) >= (1.0 if answer["opencv"] == cv2.__version__ else 0.98) * union
    assert pose_error_deg(answer["R"], answer["t"], expected.R, expected.t) < MAX_POSE_DIFFERENCE_DEG
    np.testing.assert_allclose(answer["E"], expected.E, atol=np.radians(MAX_POSE_DIFFERENCE_DEG))
    return answer


def nearest_neighbours(first: tuple[Any, Any], second: tuple[Any, Any], K: np.ndarray) -> Pair:
    """All nearest neighbours of two images of one camera, each given as keypoints and descriptors."""
    return Pair(first[0], second[0], match_descriptors(first[1], second[1]), K, K)
