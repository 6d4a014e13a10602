"""Homographies: laws of the distances, the local frames, the least squares and the decomposition."""

from __future__ import annotations

import numpy as np
import pytest

from mgca_filter.geometry.epipolar import homogeneous
from mgca_filter.geometry.homography import (
    AFFINE_FREEDOM,
    PROJECTIVE_FREEDOM,
    SIMILARITY_FREEDOM,
    HomographyResiduals,
    facing,
    homography_distance,
    local_frames,
    poses_from_homography,
    refine_homography,
    sampson_distance_to_homography,
    scaled_homography,
    transfer,
)
from mgca_filter.geometry.pose_refinement import rotation_from_vector

H_PIXELS = np.array([[0.9, -0.2, 60.0], [0.25, 1.1, -40.0], [2e-4, -1e-4, 1.0]])
H_UNIT = np.array([[0.9, -0.2, 0.1], [0.25, 1.1, -0.2], [0.15, -0.1, 1.0]])


def exact(H: np.ndarray = H_PIXELS, count: int = 80, size: float = 600.0, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).uniform(0, size, (count, 2))
    return np.hstack([points, transfer(points, H)])


def distance(rows: np.ndarray, H: np.ndarray) -> np.ndarray:
    return homography_distance(rows[:, :2], rows[:, 2:], H)


@pytest.mark.parametrize("measure", [sampson_distance_to_homography, distance])
@pytest.mark.parametrize("scale", [1.0, -3.0, 1e-6])
def test_exact_matches_are_at_no_distance_at_any_scale(measure, scale: float) -> None:
    assert measure(exact(), scale * H_PIXELS).max() < 1e-8


def test_sampson_distance_of_a_translation_is_the_error_over_root_two() -> None:
    rows = exact(np.array([[1, 0, 30.0], [0, 1, 20.0], [0, 0, 1]]))
    rows[:, 2:] += [3.0, 4.0]
    H = np.array([[1, 0, 30.0], [0, 1, 20.0], [0, 0, 1]])
    np.testing.assert_allclose(sampson_distance_to_homography(rows, H), 5.0 / np.sqrt(2.0))
    np.testing.assert_allclose(distance(rows, H), 5.0 / np.sqrt(2.0))


def test_swapping_the_images_inverts_the_homography() -> None:
    rng = np.random.default_rng(1)
    rows = exact() + rng.normal(0, 0.5, (80, 4))
    swapped = sampson_distance_to_homography(rows[:, [2, 3, 0, 1]], np.linalg.inv(H_PIXELS))
    np.testing.assert_allclose(swapped, sampson_distance_to_homography(rows, H_PIXELS), rtol=0.02)


def test_sampson_distance_is_that_to_the_nearest_exact_pair() -> None:
    """To first order: the nearest of many exact pairs around each match is as far away."""
    rng = np.random.default_rng(2)
    rows = exact(count=5) + rng.normal(0, 0.5, (5, 4))
    for row, expected in zip(rows, sampson_distance_to_homography(rows, H_PIXELS)):
        points = row[:2] + rng.uniform(-2, 2, (40000, 2))
        pairs = np.hstack([points, transfer(points, H_PIXELS)])
        assert np.linalg.norm(pairs - row, axis=1).min() == pytest.approx(expected, rel=0.02)


def test_scaling_the_pixels_scales_the_distance() -> None:
    rows = exact() + np.random.default_rng(3).normal(0, 1.0, (80, 4))
    S = np.diag([7.0, 7.0, 1.0])
    scaled = sampson_distance_to_homography(7.0 * rows, S @ H_PIXELS @ np.linalg.inv(S))
    np.testing.assert_allclose(scaled, 7.0 * sampson_distance_to_homography(rows, H_PIXELS), rtol=1e-6)


def test_matches_beyond_the_horizon_are_infinitely_far() -> None:
    H = np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.01, 0, 1.0]])  # x = 100 goes to infinity
    points = np.column_stack([np.r_[np.linspace(0, 80, 60), 130.0], np.linspace(0, 50, 61)])
    rows = np.hstack([points, transfer(points, H)])
    measured = sampson_distance_to_homography(rows, -H)
    assert measured[:60].max() < 1e-9
    assert measured[60] == np.inf
    assert (homogeneous(points[:60]) @ facing(rows[:60], -H)[2] > 0).all()


def test_distances_of_nothing_and_of_no_homography() -> None:
    assert sampson_distance_to_homography(np.zeros((0, 4)), H_PIXELS).shape == (0,)
    assert np.isinf(sampson_distance_to_homography(exact(), np.full((3, 3), np.nan))).all()


def test_local_frames_are_the_derivatives() -> None:
    points = exact()[:, :2]
    step = 1e-4
    numeric = np.stack(
        [(transfer(points + d, H_PIXELS) - transfer(points - d, H_PIXELS)) / (2 * step) for d in step * np.eye(2)], 2
    )
    np.testing.assert_allclose(local_frames(points, H_PIXELS), numeric, rtol=1e-5, atol=1e-7)


def test_gradient_is_that_of_the_cost() -> None:
    """At small residuals, where holding J Jᵀ fixed changes nothing of the first order."""
    rows = exact(H_UNIT, size=1.0)
    rows[:, 2:] += np.random.default_rng(4).normal(0, 1e-5, (80, 2))
    H = facing(rows, H_UNIT)
    weights = np.random.default_rng(5).uniform(0.1, 1.0, 80)
    directions = np.eye(9)
    _, gradient = HomographyResiduals(rows, H, 1.0, weights).normal_equations(directions)
    step = 1e-7
    numeric = [
        (
            HomographyResiduals(rows, H + step * d.reshape(3, 3), 1.0, weights).cost
            - HomographyResiduals(rows, H - step * d.reshape(3, 3), 1.0, weights).cost
        )
        / (4 * step)
        for d in directions
    ]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize(
    ("freedom", "H"),
    [
        (PROJECTIVE_FREEDOM, H_UNIT),
        (AFFINE_FREEDOM, np.array([[0.9, -0.2, 0.1], [0.25, 1.1, -0.2], [0, 0, 1.0]])),
        (SIMILARITY_FREEDOM, np.array([[0.9, -0.3, 0.1], [0.3, 0.9, -0.2], [0, 0, 1.0]])),
    ],
)
def test_refinement_finds_the_exact_map_among_outliers(freedom: int, H: np.ndarray) -> None:
    rng = np.random.default_rng(6)
    rows = exact(H, size=1.0)
    rows[:20, 2:] = rng.uniform(0, 1, (20, 2))
    start = H + rng.normal(0, 0.003, (3, 3)) * (np.abs(H) > 0)
    if freedom == SIMILARITY_FREEDOM:
        start[1, 1], start[0, 1] = start[0, 0], -start[1, 0]
    start[2, 2] = 1.0
    if freedom != PROJECTIVE_FREEDOM:
        start[2, :2] = 0.0
    refined = refine_homography(rows, start, 0.02, rounds=30, freedom=freedom)
    np.testing.assert_allclose(scaled_homography(refined), H, atol=1e-9)


def test_refinement_never_raises_the_cost_and_obeys_weights_and_rounds() -> None:
    rng = np.random.default_rng(7)
    rows = exact(H_UNIT, size=1.0) + rng.normal(0, 0.004, (80, 4))
    start = facing(rows, H_UNIT + rng.normal(0, 0.01, (3, 3)))
    ones = np.ones(80)
    costs = [
        HomographyResiduals(rows, refine_homography(rows, start, 0.03, rounds=n), 0.03, ones).cost for n in range(6)
    ]
    assert all(later <= earlier for earlier, later in zip(costs, costs[1:]))
    assert costs[-1] < costs[0]
    left = np.where(np.arange(80) < 40, 1.0, 0.0)
    by_left = refine_homography(rows, start, 0.03, left)
    assert HomographyResiduals(rows, by_left, 0.03, left).cost < (
        HomographyResiduals(rows, refine_homography(rows, start, 0.03), 0.03, left).cost
    )


def test_scale_of_opencv_and_where_it_does_not_exist() -> None:
    assert scaled_homography(-5.0 * H_PIXELS)[2, 2] == 1.0
    H = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])
    np.testing.assert_allclose(scaled_homography(3.0 * H), H / np.linalg.norm(H))


def test_decomposition_holds_the_true_pose_and_nothing_of_a_rotation() -> None:
    R = rotation_from_vector(np.array([0.1, -0.2, 0.05]))
    t, normal = np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 1.0])
    H = R + np.outer(t, normal / np.linalg.norm(normal)) * 0.3
    poses = poses_from_homography(H)
    assert min(np.linalg.norm(R - own) + np.linalg.norm(t - move) for own, move in poses) < 1e-6
    assert poses_from_homography(R) == []
