"""Laws of two-view geometry that labels, metrics and the filter rely on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mgca_filter.geometry import epipolar
from mgca_filter.geometry.pose_refinement import rotation_from_vector

vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
poses = st.tuples(vectors, vectors.filter(lambda v: np.linalg.norm(v) > 0.1))


def project(R: np.ndarray, t: np.ndarray, seed: int = 0, count: int = 30) -> np.ndarray:
    rng = np.random.default_rng(seed)
    X1 = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.ones(count)]) * rng.uniform(4, 9, (count, 1))
    X2 = X1 @ R.T + t
    return np.hstack([X1[:, :2] / X1[:, 2:], X2[:, :2] / X2[:, 2:]])


@given(poses)
def test_exact_points_have_no_residual(pose: tuple[np.ndarray, np.ndarray]) -> None:
    R, t = rotation_from_vector(pose[0] * 0.4), pose[1]
    points, E = project(R, t), epipolar.essential_from_pose(R, t)
    np.testing.assert_allclose(epipolar.sampson_distance(points, E), 0, atol=1e-9)
    np.testing.assert_allclose(epipolar.symmetric_epipolar_distance_squared(points, E), 0, atol=1e-12)


@given(poses)
def test_swapping_the_images_transposes_E(pose: tuple[np.ndarray, np.ndarray]) -> None:
    R, t = rotation_from_vector(pose[0]), pose[1]
    swapped = epipolar.essential_from_pose(R.T, -R.T @ t)
    E = epipolar.essential_from_pose(R, t)
    np.testing.assert_allclose(swapped, E.T * np.sign(np.sum(swapped * E.T)), atol=1e-9)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 4))
    np.testing.assert_allclose(
        epipolar.sampson_distance(points, E), epipolar.sampson_distance(points[:, [2, 3, 0, 1]], E.T), atol=1e-12
    )


def test_a_stack_of_matrices_is_measured_as_each_of_them() -> None:
    rng = np.random.default_rng(0)
    points, E, stretch = rng.uniform(-1, 1, (20, 4)), rng.normal(size=(3, 3, 3)), rng.normal(size=(20, 2, 2))
    for stretches in ((), (stretch, stretch[::-1])):
        each = [epipolar.sampson_distance(points, one, *stretches) for one in E]
        np.testing.assert_allclose(epipolar.sampson_distance(points, E, *stretches), each, rtol=1e-12)


@given(poses)
def test_decomposition_contains_the_pose(pose: tuple[np.ndarray, np.ndarray]) -> None:
    R, t = rotation_from_vector(pose[0]), pose[1]
    found = epipolar.decompose_essential(epipolar.essential_from_pose(R, t))
    assert all(np.linalg.det(rotation) == pytest.approx(1.0) for rotation, _ in found)
    assert min(epipolar.pose_error_deg(rotation, direction, R, t) for rotation, direction in found) < 1e-3


@given(poses, st.floats(-3.0, 3.0))
def test_the_order_of_the_decomposition_is_no_matter_of_signs(
    pose: tuple[np.ndarray, np.ndarray], scale: float
) -> None:
    assume(abs(scale) > 0.1)
    E = epipolar.essential_from_pose(rotation_from_vector(pose[0]), pose[1])
    rotations, directions = (np.stack(part) for part in zip(*epipolar.decompose_essential(scale * E)))
    traces, sizes = np.trace(rotations, axis1=1, axis2=2), np.sort(np.abs(directions[0]))
    assume(traces[0] - traces[2] > 1e-6)
    assume(sizes[2] - sizes[1] > 1e-6)
    assert directions[0][np.argmax(np.abs(directions[0]))] > 0.0
    for found, expected in zip(epipolar.decompose_essential(E), zip(rotations, directions)):
        np.testing.assert_allclose(found[0], expected[0], atol=1e-6)
        np.testing.assert_allclose(found[1], expected[1], atol=1e-6)


@given(st.lists(st.floats(-10, 10), min_size=9, max_size=9))
def test_projection_to_essential_is_valid_and_idempotent(values: list[float]) -> None:
    M = np.reshape(values, (3, 3))
    singular = np.linalg.svd(M, compute_uv=False)
    assume(singular[1] > 1e-3)
    assume(singular[1] - singular[2] > 1e-3)
    E = epipolar.project_to_essential(M)
    np.testing.assert_allclose(np.linalg.svd(E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
    np.testing.assert_allclose(epipolar.project_to_essential(E), E, atol=1e-9)


def test_fundamental_matrix_gives_pixels_the_same_zero() -> None:
    R, t = rotation_from_vector(np.array([0.1, 0.2, 0.0])), np.array([1.0, 0.0, 0.2])
    K1, K2 = np.diag([700.0, 720.0, 1.0]), np.diag([500.0, 500.0, 1.0])
    K1[:2, 2] = 320, 240
    points = project(R, t)
    pixels = np.hstack([points[:, :2] @ K1[:2, :2].T + K1[:2, 2], points[:, 2:] @ K2[:2, :2].T + K2[:2, 2]])
    F = epipolar.fundamental_from_essential(epipolar.essential_from_pose(R, t), K1, K2)
    np.testing.assert_allclose(epipolar.sampson_distance(pixels, F), 0, atol=1e-9)


def test_depths_are_those_of_the_scene() -> None:
    R, t = rotation_from_vector(np.array([0.1, -0.2, 0.05])), np.array([1.0, 0.1, 0.2])
    rng = np.random.default_rng(0)
    X1 = np.column_stack([rng.uniform(-1, 1, (30, 2)), np.ones(30)]) * rng.uniform(4, 9, (30, 1))
    X2 = X1 @ R.T + t
    points = np.hstack([X1[:, :2] / X1[:, 2:], X2[:, :2] / X2[:, 2:]])
    depth1, depth2 = epipolar.triangulated_depths(points, R, t)
    np.testing.assert_allclose(depth1, X1[:, 2], rtol=1e-6)
    np.testing.assert_allclose(depth2, X2[:, 2], rtol=1e-6)


@given(vectors, st.floats(0, 3.1))
def test_rotation_error_is_the_angle(axis: np.ndarray, angle: float) -> None:
    assume(np.linalg.norm(axis) > 0.1)
    R = rotation_from_vector(axis / np.linalg.norm(axis) * angle)
    assert epipolar.rotation_error_deg(R, np.eye(3)) == pytest.approx(np.degrees(angle), abs=1e-4)


def test_translation_error_ignores_the_sign() -> None:
    assert epipolar.translation_error_deg([1, 0, 0], [-1, 0, 0]) == pytest.approx(0.0)
    assert epipolar.translation_error_deg([1, 0, 0], [0, 2, 0]) == pytest.approx(90.0)
    assert epipolar.translation_error_deg([0, 0, 0], [0, 2, 0]) == 90.0


def test_sampson_distance_through_a_lens_is_that_of_the_distorted_images():
    """Linear lenses: the epipolar geometry of what was seen is x2' = A2 x2, and a true Sampson distance of its own."""
    rng = np.random.default_rng(0)
    correspondences, E = rng.normal(size=(40, 4)), rng.normal(size=(3, 3))
    stretch1, stretch2 = rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    seen = np.hstack(
        [
            np.linalg.solve(stretch1, correspondences[:, :2].T).T,
            np.linalg.solve(stretch2, correspondences[:, 2:].T).T,
        ]
    )
    A1, A2 = np.eye(3), np.eye(3)
    A1[:2, :2], A2[:2, :2] = stretch1, stretch2
    expected = epipolar.sampson_distance(seen, A2.T @ E @ A1)
    many1, many2 = (np.tile(stretch, (40, 1, 1)) for stretch in (stretch1, stretch2))
    np.testing.assert_allclose(epipolar.sampson_distance(correspondences, E, many1, many2), expected)
    identity = np.tile(np.eye(2), (40, 1, 1))
    plain = epipolar.sampson_distance(correspondences, E)
    np.testing.assert_allclose(epipolar.sampson_distance(correspondences, E, identity, None), plain)
