"""Changes of a camera keep right matches right, and move keypoints as the image would."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_scene

from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import essential_from_pose, symmetric_epipolar_distance_squared
from mgca_filter.inputs.attributes import MatchAttributes
from mgca_filter.training.augmentation import (
    AugmentationConfig,
    draw_homographies,
    rotation_matrix,
    sees_all,
    transform_attributes,
    transform_epipolar,
    transform_points,
)

K = np.array([[800.0, 0.0, 319.5], [0.0, 800.0, 239.5], [0.0, 0.0, 1.0]])
EVERYTHING = AugmentationConfig(tilt_deg=20.0, roll_deg=20.0, turn=0.5, mirror=0.5, focal_error=0.5)
NOTHING = AugmentationConfig(tilt_deg=0.0, roll_deg=0.0, turn=0.0, mirror=0.0, focal_error=0.0)


def exact_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normalised points of both images and their essential matrix."""
    scene = make_scene(noise_px=0.0, wrong=0)
    return normalize_points(scene.points1, K), normalize_points(scene.points2, K), scene.E


@pytest.mark.parametrize("seed", range(10))
def test_right_matches_stay_on_the_epipolar_geometry(seed):
    x1, x2, E = exact_scene()
    H1, H2 = draw_homographies(np.random.default_rng(seed), EVERYTHING)
    moved = np.hstack([transform_points(H1, x1)[0], transform_points(H2, x2)[0]])
    F = transform_epipolar(E, H1, H2)
    assert np.isclose(np.linalg.norm(F), 1.0)
    assert symmetric_epipolar_distance_squared(moved, F).max() < 1e-18
    assert symmetric_epipolar_distance_squared(moved, E).max() > 1e-6


def test_a_virtual_rotation_is_a_rotation_of_the_pose():
    scene = make_scene()
    Q1 = rotation_matrix(0, 0.1) @ rotation_matrix(2, 0.7)
    Q2 = rotation_matrix(1, -0.2)
    F = transform_epipolar(scene.E, Q1, Q2)
    E = essential_from_pose(Q2 @ scene.R @ Q1.T, Q2 @ scene.t)
    assert min(np.abs(F - E).max(), np.abs(F + E).max()) < 1e-12


def test_rotations_turn_from_one_axis_to_the_next():
    for axis in range(3):
        R = rotation_matrix(axis, 0.3)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
        assert np.isclose(np.linalg.det(R), 1.0)
        np.testing.assert_allclose(R @ np.eye(3)[axis], np.eye(3)[axis])
    np.testing.assert_allclose(rotation_matrix(2, np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_finite_differences(seed):
    rng = np.random.default_rng(seed)
    H, _ = draw_homographies(rng, EVERYTHING)
    x = rng.uniform(-0.5, 0.5, (20, 2))
    _, jacobian = transform_points(H, x)
    step = 1e-6
    for axis in range(2):
        offset = step * np.eye(2)[axis]
        difference = (transform_points(H, x + offset)[0] - transform_points(H, x - offset)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], difference, atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_attributes_are_those_of_moved_keypoints(seed):
    rng = np.random.default_rng(seed)
    x1, x2, _ = exact_scene()
    count, reach = len(x1), 1e-5
    size1, size2 = rng.uniform(2, 20, count), rng.uniform(2, 20, count)
    angle1, angle2 = rng.uniform(0, 360, count), rng.uniform(0, 360, count)
    best, ratio = rng.random(count) < 0.5, rng.random(count).astype(np.float32)
    H1, H2 = draw_homographies(rng, EVERYTHING)
    J1, J2 = transform_points(H1, x1)[1], transform_points(H2, x2)[1]
    encoded = MatchAttributes(ratio, best, size1, size2, angle1, angle2).encode(count)
    found = transform_attributes(encoded, np.radians(angle1), J1, J2)

    def moved(H: np.ndarray, x: np.ndarray, size: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sizes and angles of small discs with a tick, after the image moved."""
        ticks = [
            transform_points(H, x + reach * np.column_stack([np.cos(a), np.sin(a)]))[0] - transform_points(H, x)[0]
            for a in (np.radians(angle), np.radians(angle + 90))
        ]
        area = np.abs(ticks[0][:, 0] * ticks[1][:, 1] - ticks[0][:, 1] * ticks[1][:, 0]) / reach**2
        return size * np.sqrt(area), np.degrees(np.arctan2(ticks[0][:, 1], ticks[0][:, 0])) % 360

    new1, new2 = moved(H1, x1, size1, angle1), moved(H2, x2, size2, angle2)
    expected = MatchAttributes(ratio, best, new1[0], new2[0], new1[1], new2[1]).encode(count)
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_unknown_sizes_and_angles_stay_unknown():
    x1, x2, _ = exact_scene()
    H1, H2 = draw_homographies(np.random.default_rng(0), EVERYTHING)
    encoded = MatchAttributes(ratio=np.full(len(x1), 0.5, np.float32)).encode(len(x1))
    moved = transform_attributes(encoded, np.zeros(len(x1)), transform_points(H1, x1)[1], transform_points(H2, x2)[1])
    np.testing.assert_array_equal(moved, encoded)


def test_mirrored_images_turn_angle_differences_round():
    x1, x2, E = exact_scene()
    mirror = np.diag([-1.0, 1.0, 1.0])
    rng = np.random.default_rng(0)
    size = np.full(len(x1), 3.0)
    angle1, angle2 = rng.uniform(0, 360, (2, len(x1)))
    encoded = MatchAttributes(None, None, size, size, angle1, angle2).encode(len(x1))
    J = transform_points(mirror, x1)[1]
    moved = transform_attributes(encoded, np.radians(angle1), J, J)
    np.testing.assert_allclose(moved[:, 3], encoded[:, 3], atol=1e-5)
    np.testing.assert_allclose(moved[:, 4], -encoded[:, 4], atol=1e-5)
    np.testing.assert_allclose(moved[:, 2], encoded[:, 2], atol=1e-6)
    flipped = np.hstack([x1 * [-1, 1], x2 * [-1, 1]])
    assert symmetric_epipolar_distance_squared(flipped, transform_epipolar(E, mirror, mirror)).max() < 1e-18


def test_swapped_images_transpose_the_geometry():
    x1, x2, E = exact_scene()
    H1, H2 = draw_homographies(np.random.default_rng(3), EVERYTHING)
    swapped = np.hstack([transform_points(H2, x2)[0], transform_points(H1, x1)[0]])
    assert symmetric_epipolar_distance_squared(swapped, transform_epipolar(E, H1, H2).T).max() < 1e-18


def test_nothing_changes_when_nothing_may():
    for seed in range(5):
        for H in draw_homographies(np.random.default_rng(seed), NOTHING):
            np.testing.assert_allclose(H, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("option", "value"),
    [("tilt_deg", 10.0), ("roll_deg", 10.0), ("turn", 1.0), ("mirror", 1.0), ("focal_error", 1.0)],
)
def test_every_option_changes_the_cameras(option, value):
    config = AugmentationConfig(**{**vars(NOTHING), option: value})
    H1, H2 = draw_homographies(np.random.default_rng(0), config)
    assert max(np.abs(H1 - np.eye(3)).max(), np.abs(H2 - np.eye(3)).max()) > 1e-2


def test_limits_are_kept():
    rng = np.random.default_rng(0)
    tilts, rolls, factors = [], [], []
    for _ in range(200):
        H, _ = draw_homographies(rng, AugmentationConfig(tilt_deg=5, roll_deg=0, turn=0, mirror=0, focal_error=0))
        tilts.append(np.degrees(np.arccos(H[2, 2])))
        H, _ = draw_homographies(rng, AugmentationConfig(tilt_deg=0, roll_deg=7, turn=0, mirror=0, focal_error=0))
        rolls.append(abs(np.degrees(np.arctan2(H[1, 0], H[0, 0]))))
        config = AugmentationConfig(tilt_deg=0, roll_deg=0, turn=0, mirror=0, focal_error=1, focal_factor=1.2)
        factors.append(np.log(draw_homographies(rng, config)[0][0, 0]))
    assert 5 < max(tilts) < 5 * np.sqrt(2) + 1e-9  # both axes at once
    assert 6 < max(rolls) <= 7
    assert np.percentile(np.abs(factors), 90) < np.log(1.2) + 0.1
    assert np.std(factors) > 0.05


def test_points_behind_a_changed_camera_are_seen():
    x = np.array([[0.0, 0.0], [0.8, 0.0]])
    assert sees_all(np.eye(3), x)
    assert not sees_all(rotation_matrix(1, np.radians(80)), x)
