"""Refinement of a pose, and how firmly its inliers hold it."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_scene
from fit_inputs import FOCAL, normalized

from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.geometry.pose_refinement import (
    direction_uncertainty_deg,
    pose_uncertainty_deg,
    refine_pose,
    rotation_from_vector,
    truncated_cost,
)


def test_refinement_lowers_the_cost_and_the_error() -> None:
    scene = make_scene()
    rows, threshold = normalized(scene), 3.0 / FOCAL
    R = rotation_from_vector(np.array([0.002, -0.002, 0.001])) @ scene.R
    t = scene.t + [0.0, 0.03, -0.02]
    t = t / np.linalg.norm(t)
    refined = refine_pose(rows, R, t, threshold, rounds=30)
    assert truncated_cost(rows, *refined, threshold) < truncated_cost(rows, R, t, threshold)
    assert pose_error_deg(*refined, scene.R, scene.t) < 0.5 * pose_error_deg(R, t, scene.R, scene.t)


def test_refinement_stays_at_the_exact_pose() -> None:
    exact = make_scene(wrong=0, noise_px=0.0)
    refined = refine_pose(normalized(exact), exact.R, exact.t, 1.0 / FOCAL)
    assert pose_error_deg(*refined, exact.R, exact.t) < 1e-5


@pytest.mark.parametrize("measure", [pose_uncertainty_deg, direction_uncertainty_deg])
def test_uncertainty_grows_with_noise_and_falls_with_matches(measure) -> None:
    exact = make_scene(wrong=0, right=200, noise_px=0.0)
    rows = normalized(exact)
    one = measure(rows, exact.R, exact.t, 0.5 / FOCAL)
    assert measure(rows, exact.R, exact.t, 1.0 / FOCAL) == pytest.approx(2.0 * one)
    assert measure(rows[:50], exact.R, exact.t, 0.5 / FOCAL) > 1.5 * one
    assert measure(rows[:5], exact.R, exact.t, 0.5 / FOCAL) == 90.0
    turned = make_scene("rotation", wrong=0, right=200, noise_px=0.0)
    t = np.array([1.0, 0.0, 0.0])
    assert measure(normalized(turned), turned.R, t, 0.5 / FOCAL) > 20.0 * one


def test_uncertainty_of_the_direction_is_what_other_noise_makes_of_it() -> None:
    errors, foretold = [], []
    for seed in range(30):
        scene = make_scene(wrong=0, right=100, noise_px=0.3, seed=7)
        rows = normalized(scene) + np.random.default_rng(seed).normal(0, 0.3 / FOCAL, (100, 4))
        R, t = refine_pose(rows, scene.R, scene.t, 3.0 / FOCAL, rounds=20)
        errors.append(np.degrees(np.arccos(np.clip(t @ scene.t, -1, 1))))
        foretold.append(direction_uncertainty_deg(rows, R, t, 0.3 / FOCAL))
    assert 0.3 * np.median(foretold) < np.sqrt(np.mean(np.square(errors))) < 3.0 * np.median(foretold)
