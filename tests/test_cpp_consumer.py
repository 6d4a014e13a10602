"""The C++ example answers as Python does and names what it cannot read.

What it needs: see ``cpp_program.py``.
"""

from __future__ import annotations

import json
import re
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import METADATA, K, build_model
from cpp_program import (
    BUILD_TIMEOUT,
    ERROR,
    FOUND,
    SOURCE,
    Pair,
    assert_same_answer,
    assert_same_scores,
    build,
    build_program,
    comma_separated,
    nearest_neighbours,
    opencv_version,
    run,
    run_program,
)

import mgca_filter
from mgca_filter.features import create_detector, detect_keypoints
from mgca_filter.geometry.epipolar import pose_error_deg

IMAGES = Path(__file__).parent.parent / "examples" / "images"
K2 = np.array([[700.0, 0.0, 310.0], [0.0, 710.0, 250.0], [0.0, 0.0, 1.0]])
pytestmark = BUILD_TIMEOUT


@pytest.fixture(scope="module")
def program() -> Path:
    return build_program()


@pytest.fixture(scope="module")
def example() -> Pair:
    """The example images' keypoints and nearest neighbours."""
    K = np.array(json.loads((IMAGES / "pair.json").read_text())["K1"])
    found = [detect_keypoints(cv2.imread(str(IMAGES / name)), create_detector()) for name in ("left.jpg", "right.jpg")]
    return nearest_neighbours(*found, K)


def only_nearest(pair: Pair, max_ratio: float = 1.0) -> Pair:
    """The pair with matches as ``DescriptorMatcher.match`` or a ratio test leaves them."""
    kept = [first for first, second in pair.matches if first.distance <= max_ratio * second.distance]
    return Pair(pair.keypoints1, pair.keypoints2, kept, pair.K1, pair.K2)


@pytest.fixture
def small(scene) -> Pair:
    """The synthetic scene, seen by two different cameras, with several rows for one keypoint and unknown values."""
    keypoints1, keypoints2 = scene.keypoints()
    points2 = (scene.points2 - K[:2, 2]) / np.diag(K)[:2] * np.diag(K2)[:2] + K2[:2, 2]
    keypoints2 = [cv2.KeyPoint(float(x), float(y), 2.0 + i % 5, float(i)) for i, (x, y) in enumerate(points2)]
    matches = [*scene.knn_matches(), *scene.knn_matches()[:20]]
    for i in range(0, 40, 2):
        matches.append((cv2.DMatch(i, i + 1, 90.0), cv2.DMatch(i, i, 95.0)))
    keypoints1[3].pt = (float("nan"), 5.0)
    keypoints1[5].angle = -1.0
    keypoints2[7].size = 0.0
    return Pair(keypoints1, keypoints2, matches, K, K2)


# Agreement


@pytest.mark.parametrize("kind", ["knn", "nearest", "ratio_test"])
def test_example_pair_gets_the_answer_of_python(program, example, tmp_path, kind):
    pair = {"knn": example, "nearest": only_nearest(example), "ratio_test": only_nearest(example, 0.8)}[kind]
    assert_same_answer(program, pair, mgca_filter.model_path(), tmp_path)


def test_images_give_the_pose_they_were_rendered_with(program):
    truth = json.loads((IMAGES / "pair.json").read_text())
    K = comma_separated(np.array(truth["K1"]))
    done = run(program, IMAGES / "left.jpg", IMAGES / "right.jpg", "--model", mgca_filter.model_path(), "--K", K)
    assert done.returncode == FOUND, done.stderr
    answer = json.loads(done.stdout)
    assert len(answer["points"]) == len(answer["mask"]) > 1500
    assert pose_error_deg(answer["R"], answer["t"], truth["R"], truth["t"]) < 2.0


def test_two_cameras_unknown_values_and_repetitions(program, small, model_file, tmp_path):
    assert_same_answer(program, small, model_file, tmp_path)


def test_the_threshold_is_that_of_the_final_mask(program, small, model_file, tmp_path):
    assert_same_answer(program, small, model_file, tmp_path, threshold=0.4)


def test_rule_calibration_prior_and_threshold_come_from_the_file(program, small, tmp_path):
    prior = {"weight1": [[1, 0.5, 0, 0, -0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0, 0, 1e-3]], "bias1": [0.1, -0.2]}
    metadata = {
        **METADATA,
        "calibration": json.dumps({"scale": 0.7, "offset": -0.3}),
        "decision_threshold": "0.25",
        "candidate_rule": json.dumps({"max_ratio": 0.8, "min_count": 10}),
        "prior": json.dumps({**prior, "weight2": [-4.0, 2.0], "bias2": -1}),
    }
    assert_same_answer(program, small, build_model(tmp_path / "other.onnx", metadata), tmp_path)


@pytest.mark.parametrize(("first", "second"), list(combinations(range(4), 2)))
def test_rendered_views_get_the_pose_of_python(program, views, tmp_path, first, second):
    a, b = views[first], views[second]
    pair = nearest_neighbours((a.keypoints, a.descriptors), (b.keypoints, b.descriptors), a.K)
    answer, expected = assert_same_scores(program, pair, mgca_filter.model_path(), tmp_path)
    # Wide pairs with few matches: another version of OpenCV, or another seed, moves the pose by a third of a degree.
    assert pose_error_deg(answer["R"], answer["t"], expected.R, expected.t) < 1.0


# Little to go on


def test_too_few_matches_give_scores_and_no_geometry(program, small, model_file, tmp_path):
    pair = Pair(small.keypoints1, small.keypoints2, small.matches[10:17], small.K1, small.K2)
    answer = run_program(program, pair, model_file, tmp_path)
    assert answer["E"] is answer["R"] is answer["t"] is None
    assert answer["mask"] == [0] * 7
    assert all(0 < score < 1 for score in answer["scores"])


# Errors


def truncated(path: Path) -> Path:
    build_model(path)
    path.write_bytes(path.read_bytes()[:-40])
    return path


def without_prior(path: Path) -> Path:
    return build_model(path, {key: value for key, value in METADATA.items() if key != "prior"})


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: path, "cannot be opened"),
        (truncated, "truncated or damaged"),
        (without_prior, "metadata missing: prior"),
        (lambda path: build_model(path, {**METADATA, "contract_version": "2"}), "contract version 2"),
        (lambda path: build_model(path, {**METADATA, "calibration": '{"scale": "x"}'}), "'calibration' cannot be read"),
        (lambda path: build_model(path, {**METADATA, "decision_threshold": "no"}), "'decision_threshold'"),
        (lambda path: build_model(path, {**METADATA, "prior": METADATA["prior"].replace("[[1.0,", "[[")}), "'prior'"),
    ],
)
def test_bad_model_files_are_named(program, small, tmp_path, write, message):
    model = write(tmp_path / "bad.onnx")
    matches = small.write(tmp_path / "matches.yml")
    done = run(program, "--matches", matches, "--model", model, "--K", comma_separated(K))
    assert done.returncode == ERROR
    assert f"{model}: " in done.stderr
    assert message in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected two images, or --matches"),
        (["a.png", "b.png", "--matches", "c.yml"], "expected two images, or --matches"),
        (["a.png", "b.png", "--model", "m.onnx"], "expected --model and --K"),
        (["a.png", "b.png", "--model", "m.onnx", "--K", "1,2,3"], "--K: expected 4 number(s)"),
        (["a.png", "b.png", "--model", "m.onnx", "--K", "1,2,3,4", "--no"], "--no: unknown"),
    ],
)
def test_usage_errors_are_named(program, words, message):
    done = run(program, *words)
    assert done.returncode == ERROR
    assert message in done.stderr


def test_unreadable_inputs_are_named(program, model_file, tmp_path):
    for words in (["--matches", Path(__file__)], ["--matches", tmp_path / "no.yml"], [Path(__file__), "no.png"]):
        done = run(program, *words, "--model", model_file, "--K", comma_separated(K))
        assert done.returncode == ERROR
        assert f"mgca_match_cpp: {words[-1] if words[0] == '--matches' else words[0]}: not a readable" in done.stderr


def test_index_out_of_range_is_named(program, small, model_file, tmp_path):
    matches = [*small.matches, (cv2.DMatch(0, len(small.keypoints2), 1.0), cv2.DMatch(0, 0, 2.0))]
    path = Pair(small.keypoints1, small.keypoints2, matches, K, K).write(tmp_path / "matches.yml")
    done = run(program, "--matches", path, "--model", model_file, "--K", comma_separated(K))
    assert done.returncode == ERROR
    assert f"matches[{len(matches) - 1}]: index out of range" in done.stderr


# Without ONNX Runtime


def test_opencv_5_runs_the_network(example, tmp_path):
    if opencv_version() < (5,):
        pytest.skip("cv::dnn of OpenCV 4 cannot run the model")
    program = build(SOURCE, tmp_path, "mgca_match_cpp", "-DMGCA_USE_OPENCV_DNN=ON")
    assert_same_answer(program, example, mgca_filter.model_path(), tmp_path)


def test_opencv_4_alone_is_refused(tmp_path):
    if opencv_version() >= (5,):
        pytest.skip("OpenCV 5 runs the model by itself")
    done = run("cmake", "-S", SOURCE, "-B", tmp_path, "-DMGCA_USE_OPENCV_DNN=ON")
    assert done.returncode != 0
    assert "cannot run the model (OpenCV 5 can)" in re.sub(r"\s+", " ", done.stderr)
