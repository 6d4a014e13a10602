"""Refinement of a pose, and how firmly its inliers hold it."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_scene
from fit_inputs import FOCAL, normalized

from mgca_filter.geometry.epipolar import homogeneous_columns, pose_error_deg, translation_error_deg
from mgca_filter.geometry.pose_refinement import (
    SampsonTerms,
    apply_step,
    apply_steps,
    costs_of_directions,
    direction_uncertainty_deg,
    pose_uncertainty_deg,
    refine_pose,
    refine_pose_by_weights,
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


def test_by_weights_the_exact_pose_stays_whatever_the_weights() -> None:
    exact = make_scene(wrong=0, noise_px=0.0)
    rng = np.random.default_rng(0)
    scale, weights = rng.uniform(0.1, 2.0, (2, len(exact.inlier)))
    refined = refine_pose_by_weights(normalized(exact), exact.R, exact.t, scale / FOCAL, weights, 6.0 / FOCAL)
    assert pose_error_deg(*refined, exact.R, exact.t) < 1e-5


def test_what_is_located_well_holds_the_pose() -> None:
    by_noise, alike = [], []
    for seed in range(10):
        exact = make_scene(wrong=0, right=150, noise_px=0.0, seed=seed)
        noise = np.where(np.arange(150) < 50, 0.1, 0.8)
        drawn = np.random.default_rng(seed).normal(0, 1, (150, 4)) * noise[:, None] / FOCAL
        rows = normalized(exact) + drawn
        for errors, scale in ((by_noise, noise), (alike, np.full(150, 0.5))):
            refined = refine_pose_by_weights(rows, exact.R, exact.t, scale / FOCAL, np.ones(150), 6.0 / FOCAL)
            errors.append(pose_error_deg(*refined, exact.R, exact.t))
    assert np.mean(by_noise) < 0.7 * np.mean(alike)


def test_what_weighs_nothing_or_is_out_of_reach_is_not_felt() -> None:
    right, mixed = make_scene(wrong=0, right=100), make_scene(wrong=0, right=60, noise_px=2.0, seed=1)
    rows = np.vstack([normalized(right), normalized(mixed)])
    scale, weights = np.full(160, 0.5 / FOCAL), np.where(np.arange(160) < 100, 1.0, 1e-9)
    alone = refine_pose_by_weights(rows[:100], right.R, right.t, scale[:100], weights[:100], 6.0 / FOCAL)
    together = refine_pose_by_weights(rows, right.R, right.t, scale, weights, 6.0 / FOCAL)
    assert pose_error_deg(*together, *alone) < 1e-3
    far = rows + np.where(np.arange(160) < 100, 0.0, 0.1)[:, None] * [0, 0, 1, -1]
    out_of_reach = refine_pose_by_weights(far, right.R, right.t, scale, np.ones(160), 6.0 / FOCAL)
    assert pose_error_deg(*out_of_reach, *alone) < 1e-3
    few = refine_pose_by_weights(rows[:5], right.R, right.t, scale[:5], weights[:5], 6.0 / FOCAL)
    np.testing.assert_array_equal(few[0], right.R)


def terms(rows: np.ndarray, R: np.ndarray, t: np.ndarray) -> SampsonTerms:
    return SampsonTerms(homogeneous_columns(rows[:, :2]), homogeneous_columns(rows[:, 2:]), R, t)


def test_derivatives_are_those_of_the_residuals_at_exact_points() -> None:
    # There the residual is zero, and so is what the line normals, held fixed, would add.
    exact = make_scene(wrong=0, noise_px=0.0)
    rows, step = normalized(exact), 1e-6
    J = terms(rows, exact.R, exact.t).derivatives()
    for axis in range(3):
        moved = terms(rows, rotation_from_vector(step * np.eye(3)[axis]) @ exact.R, exact.t)
        np.testing.assert_allclose(moved.residual / step, J[axis], atol=1e-4)
    for axis in (3, 4):
        unit = np.eye(5)[axis]
        np.testing.assert_allclose(
            terms(rows, *apply_step(exact.R, exact.t, step * unit)).residual / step, J[axis], atol=1e-4
        )


def test_many_steps_at_once_are_those_one_by_one() -> None:
    scene = make_scene()
    steps = np.vstack([np.zeros(5), np.random.default_rng(0).normal(0.0, 0.5, (20, 5)), [0.0, 0.0, 0.0, 0.3, -0.2]])
    R, t = apply_steps(scene.R, scene.t, steps)
    for k, step in enumerate(steps):
        expected = apply_step(scene.R, scene.t, step)
        np.testing.assert_allclose(R[k], expected[0], atol=1e-12)
        np.testing.assert_allclose(t[k], expected[1], atol=1e-12)


def test_costs_of_directions_are_those_of_poses_turned_as_each_likes_best() -> None:
    scene = make_scene(wrong=0)
    rows = normalized(scene)
    directions = np.vstack([scene.t, np.random.default_rng(0).normal(size=(5, 3))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = []
    for t in directions:
        one = terms(rows, scene.R, t)
        J = one.derivatives()[:3]
        gain = (J @ one.residual) @ np.linalg.solve(J @ J.T, J @ one.residual)
        expected.append(one.residual @ one.residual - gain)
    np.testing.assert_allclose(costs_of_directions(rows, scene.R, directions), expected, rtol=1e-6)


@pytest.mark.parametrize("measure", [pose_uncertainty_deg, direction_uncertainty_deg])
def test_uncertainty_grows_with_noise_and_falls_with_matches(measure) -> None:
    exact = make_scene(wrong=0, right=200, noise_px=0.0)
    rows = normalized(exact)
    one = measure(rows, exact.R, exact.t, 0.5 / FOCAL)
    assert measure(rows, exact.R, exact.t, 1.0 / FOCAL) == pytest.approx(2.0 * one, rel=0.02)
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


def tracks(parallax_px: float, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matches (300, 4) of a camera that moves a little, on image planes of 800 px, with R and t."""
    rng = np.random.default_rng(seed)
    R, t = rotation_from_vector(rng.normal(0, 0.005, 3)), rng.normal(0, 1, 3)
    t /= np.linalg.norm(t)
    x1 = rng.uniform(-0.7, 0.7, (300, 2))
    X = np.column_stack([x1, np.ones(300)]) * rng.uniform(4, 12, (300, 1))
    X2 = X @ R.T + parallax_px / 800 * 7 * t
    x2 = X2[:, :2] / X2[:, 2:]
    return np.hstack([x1, x2]) + rng.normal(0, noise, (300, 4)), R, t


@pytest.mark.parametrize("parallax_px", [1.0, 4.0])
def test_what_is_said_of_the_direction_holds_where_parallax_is_small(parallax_px: float) -> None:
    noise = 0.3 / 800
    errors, sigmas = [], []
    for seed in range(16):
        rows, R, t = tracks(parallax_px, noise, seed)
        start = rotation_from_vector(np.random.default_rng(seed).normal(0, 0.2, 3)) @ t
        found_R, found_t = refine_pose(rows, R, start, 10 * noise, 50)
        errors.append(translation_error_deg(found_t, t))
        sigmas.append(direction_uncertainty_deg(rows, found_R, found_t, noise))
    within = np.array(errors) < np.array(sigmas)
    assert 0.35 < within.mean() <= 1.0
    assert (np.array(errors) < 3.0 * np.array(sigmas)).mean() > 0.85


def test_a_camera_that_stood_still_knows_no_direction() -> None:
    rows, R, t = tracks(0.0, 0.3 / 800, 0)
    assert direction_uncertainty_deg(rows, R, t, 0.3 / 800) > 20.0
