"""The robust fit of the C++ example is that of ``mgca_filter.fit.robust_fit``: its starts, its choice, its refinement.

What it needs: see ``cpp_program.py``.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from conftest import METADATA, SIDEWAYS, SIZE, K, build_model
from cpp_program import BUILD_TIMEOUT, SOURCE, Pair, assert_same_answer, build, build_program
from mgca_filter.fit.ranking import RankedMatches, match_order

import mgca_filter
from mgca_filter.fit import robust_fit
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg
from mgca_filter.geometry.pose_refinement import refine_pose, rotation_from_vector

pytestmark = BUILD_TIMEOUT


@dataclass(frozen=True)
class Motion:
    """A rigid motion between two views and what a matcher and the network say of its matches."""

    rotation: tuple[float, float, float]
    t: tuple[float, float, float]
    count: int
    logit: float
    ratio: float
    noise_px: float = 0.3
    on_plane: bool = False

    @property
    def R(self) -> np.ndarray:
        return rotation_from_vector(np.array(self.rotation))

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Matches (count, 4) in pixels under ``K``."""
        pixels = rng.uniform([20, 20], np.subtract(SIZE, 20), (self.count, 2))
        depth = 1.0 / (0.2 + 0.05 * (pixels[:, 0] / 320 - 1)) if self.on_plane else rng.uniform(4, 11, self.count)
        rays = np.column_stack([(pixels - K[:2, 2]) / K[0, 0], np.ones(self.count)])
        X2 = depth[:, None] * rays @ self.R.T + self.t
        points = np.hstack([pixels, X2[:, :2] / X2[:, 2:] * K[0, 0] + K[:2, 2]])
        return points + rng.normal(0.0, self.noise_px, points.shape)


def pair_of_motions(seed: int, *motions: Motion) -> Pair:
    """Matches of all motions; the second keypoint's size holds the logit for :func:`model_of_sizes`."""
    rng = np.random.default_rng(seed)
    points = np.vstack([motion.draw(rng) for motion in motions])
    logits = np.repeat([motion.logit for motion in motions], [motion.count for motion in motions])
    ratios = np.repeat([motion.ratio for motion in motions], [motion.count for motion in motions])
    keypoints1 = [cv2.KeyPoint(float(x), float(y), 8.0, 0.0) for x, y in points[:, :2]]
    keypoints2 = [cv2.KeyPoint(float(x), float(y), 8.0 * 2.0**z, 0.0) for (x, y), z in zip(points[:, 2:], logits)]
    matches = [(cv2.DMatch(i, i, 90.0 * r), cv2.DMatch(i, 0, 90.0)) for i, r in enumerate(ratios)]
    return Pair(keypoints1, keypoints2, matches, K, K)


def model_of_sizes(path: Path, essential: np.ndarray = SIDEWAYS) -> Path:
    """A model whose logit is log2(size2 / size1), with scores that are surer than those logits, and of a fixed E."""
    metadata = {**METADATA, "calibration": json.dumps({"scale": 4.0, "offset": 0.0})}
    model = onnx.load(build_model(path, metadata, essential=essential))
    values = {"weight": np.eye(8, 1, -2, np.float32), "bias": np.zeros(1, np.float32)}
    for tensor in model.graph.initializer:
        if tensor.name in values:
            tensor.CopyFrom(onnx.numpy_helper.from_array(values[tensor.name], tensor.name))
    onnx.save(model, path)
    return path


SCENE = Motion((0.05, -0.12, 0.03), (1.0, 0.2, 0.1), count=60, logit=0.3, ratio=0.9)
# Doubtful matches of good ratio, which come first and are the most: starts that see them miss the scene. They turn
# about the camera, so that every such start ends with another translation; the start without them decides.
FIRMAMENT = Motion((-0.1, 0.1, 0.0), (0.0, 0.0, 0.0), count=120, logit=-0.5, ratio=0.2)
# The same of one rigid motion: the first two starts agree on it, which ends the search.
OTHER_BODY = Motion((-0.1, 0.1, 0.0), (0.2, 1.0, 0.3), count=200, logit=-0.5, ratio=0.2, noise_px=0.05)


@pytest.fixture(scope="module")
def program() -> Path:
    return build_program()


@pytest.mark.parametrize("seed", range(3))
def test_later_starts_find_what_the_first_one_misses(program, tmp_path, monkeypatch, seed):
    pair, model = pair_of_motions(seed, SCENE, FIRMAMENT), model_of_sizes(tmp_path / "model.onnx")
    assert_same_answer(program, pair, model, tmp_path)
    monkeypatch.setattr(robust_fit, "STARTS", robust_fit.STARTS[:1])
    misled = mgca_filter.filter_matches(pair.keypoints1, pair.keypoints2, pair.matches, K1=K, model=model)
    assert misled.R is None or pose_error_deg(misled.R, misled.t, SCENE.R, SCENE.t) > 5.0


def test_two_starts_that_agree_end_the_search(program, tmp_path):
    accepted = replace(OTHER_BODY, count=20, logit=0.3)
    pair = pair_of_motions(0, SCENE, OTHER_BODY, accepted)
    answer = assert_same_answer(program, pair, model_of_sizes(tmp_path / "model.onnx"), tmp_path)
    assert pose_error_deg(answer["R"], answer["t"], OTHER_BODY.R, OTHER_BODY.t) < 1.0


def test_the_networks_own_answer_stands_among_the_starts(program, tmp_path):
    """The starts would end with the other body, as above."""
    accepted, essential = replace(OTHER_BODY, count=20, logit=0.3), essential_from_pose(SCENE.R, SCENE.t)
    pair = pair_of_motions(0, SCENE, OTHER_BODY, accepted)
    answer = assert_same_answer(program, pair, model_of_sizes(tmp_path / "model.onnx", -essential), tmp_path)
    assert pose_error_deg(answer["R"], answer["t"], SCENE.R, SCENE.t) < 1.0
    unknown = model_of_sizes(tmp_path / "unknown.onnx", np.full((3, 3), np.nan))
    answer = assert_same_answer(program, pair, unknown, tmp_path)
    assert pose_error_deg(answer["R"], answer["t"], OTHER_BODY.R, OTHER_BODY.t) < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_few_matches_off_a_plane_decide(program, tmp_path, seed):
    """Two poses explain a plane; the starts of OpenCV 4.6 (first scene) and 5.0 (the others) end with the wrong one."""
    scene = replace(SCENE, count=300, logit=2.0, ratio=0.5)
    pair = pair_of_motions(seed, replace(scene, on_plane=True), replace(scene, count=8))
    answer = assert_same_answer(program, pair, model_of_sizes(tmp_path / "model.onnx"), tmp_path)
    assert pose_error_deg(answer["R"], answer["t"], SCENE.R, SCENE.t) < 1.0


PROBE = r"""
#include "mgca_filter.hpp"
#include <iostream>
int main() {
    double threshold = 0.0;
    mgca::Pose pose;
    std::cin >> threshold;
    for (double& value : pose.R.val) std::cin >> value;
    for (double& value : pose.t.val) std::cin >> value;
    std::vector<mgca::Correspondence> correspondences;
    std::vector<mgca::ScoredMatch> scored;
    for (double x1, y1, x2, y2, probability, margin, ratio;
         std::cin >> x1 >> y1 >> x2 >> y2 >> probability >> margin >> ratio;) {
        correspondences.emplace_back(x1, y1, x2, y2);
        const std::optional<double> known = ratio < 0.0 ? std::nullopt : std::optional<double>(ratio);
        scored.push_back({correspondences.back(), probability, margin, known});
    }
    const mgca::RankedMatches ranked(scored);
    const mgca::Pose refined = mgca::refine_pose(correspondences, pose, threshold);
    std::cout.precision(17);
    for (double value : refined.R.val) std::cout << value << " ";
    for (double value : refined.t.val) std::cout << value << " ";
    std::cout << ranked.support(pose, threshold) << "\n";
    for (double margin : {1.5, 0.0}) {
        for (const mgca::Correspondence& match : ranked.above(margin)) std::cout << match[0] << " ";
        std::cout << "\n";
    }
}
"""
PROBE_PROJECT = """
cmake_minimum_required(VERSION 3.16)
project(probe CXX)
add_subdirectory("{source}" mgca_filter)
add_executable(probe probe.cpp other.cpp)
target_link_libraries(probe PRIVATE mgca_filter)
"""


@pytest.fixture(scope="module")
def probe(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of a user's own, with the headers in two of its files."""
    folder = tmp_path_factory.mktemp("probe_project")
    (folder / "CMakeLists.txt").write_text(PROBE_PROJECT.format(source=SOURCE.as_posix()))
    (folder / "probe.cpp").write_text(PROBE)
    (folder / "other.cpp").write_text('#include "mgca_filter.hpp"\n')
    return build(folder, folder / "build", "probe")


@pytest.mark.parametrize(("seed", "moves"), [(0, True), (1, True), (2, False)])
def test_refinement_support_and_order_are_those_of_python(probe, seed, moves):
    """The last pose has too few matches near it to be refined."""
    rng = np.random.default_rng(seed)
    points = np.vstack([SCENE.draw(rng), FIRMAMENT.draw(rng)[:40]])
    correspondences = (points - np.tile(K[:2, 2], 2)) / K[0, 0]
    correspondences = np.vstack([correspondences, correspondences[:9]])  # repetitions
    count, threshold = len(correspondences), 2.0 / K[0, 0]
    margins, ratio = rng.normal(0.0, 1.0, count), np.where(rng.random(count) < 0.2, -1.0, rng.random(count))
    weights = rng.random(count)
    R = rotation_from_vector(rng.normal(0.0, 0.002, 3)) @ SCENE.R
    t = np.array(SCENE.t) + rng.normal(0.0, 0.02, 3)
    t /= np.linalg.norm(t)

    rows = np.column_stack([correspondences, weights, margins, ratio])
    numbers = " ".join(repr(float(value)) for value in [threshold, *R.ravel(), *t, *rows.ravel()])
    done = subprocess.run([str(probe)], input=numbers, capture_output=True, text=True, check=True)
    values, few, accepted = (np.array(line.split(), dtype=float) for line in done.stdout.splitlines())

    ranked = RankedMatches.of(correspondences, match_order(margins, ratio, ratio >= 0), weights, margins)
    refined = refine_pose(correspondences, R, t, threshold)
    assert (np.linalg.norm(refined[0] - R) > 1e-4) == moves
    np.testing.assert_allclose(values[:12], np.hstack([part.ravel() for part in refined]), atol=1e-9)
    np.testing.assert_allclose(values[12], ranked.pose_support(R, t, threshold), rtol=1e-9)
    assert len(few) == 32 < len(accepted)
    np.testing.assert_array_equal(few, ranked.above(1.5).correspondences[:, 0])
    np.testing.assert_array_equal(accepted, ranked.above(0.0).correspondences[:, 0])
