"""Cameras: distortion is removed to the last digits or said to be impossible; what is not given is guessed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import K, make_scene

from mgca_filter import MatchFilter, Status
from mgca_filter.geometry.cameras import resolve_intrinsics

WIDE = np.array([[800.0, 0.0, 639.5], [0.0, 810.0, 479.5], [0.0, 0.0, 1.0]])


def distorted(normalized: np.ndarray, K: np.ndarray, coefficients: list[float]) -> np.ndarray:
    """Where a camera with a lens shows points (N, 2) of the normalised plane, pixels (N, 2)."""
    rays = np.column_stack([normalized, np.ones(len(normalized))])
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(coefficients))[0][:, 0]


@pytest.mark.parametrize(
    "coefficients",
    [
        [-0.28, 0.07, 0.0, 0.0],
        [-0.4, 0.2, 1e-3, -1e-3, -0.05],
        [0.2, -0.1, 0.0, 0.0],
        [0.1, 0.01, 0.0, 0.0, 0.0, 0.3, 0.02, 0.0],
    ],
)
def test_undistorting_is_the_inverse_of_distorting(coefficients: list[float]) -> None:
    x, y = np.meshgrid(np.linspace(-0.78, 0.78, 15), np.linspace(-0.58, 0.58, 15))
    plane = np.column_stack([x.ravel(), y.ravel()])
    pixels = distorted(plane, WIDE, coefficients)
    camera, _ = resolve_intrinsics(pixels, pixels, K1=WIDE, dist1=coefficients)
    np.testing.assert_allclose(camera.normalize(pixels), plane, atol=1e-6)


def test_a_pixel_that_no_ray_reaches_is_not_a_number() -> None:
    """r (1 − 0.28 r²) is 0.73 at most: 582 pixels from the centre."""
    pixels = np.array([[639.5, 479.5], [639.5 + 560.0, 479.5], [639.5 + 600.0, 479.5]])
    camera, _ = resolve_intrinsics(pixels, pixels, K1=WIDE, dist1=[-0.28, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(np.isnan(camera.normalize(pixels)).all(axis=1), [False, False, True])


def test_the_guess_is_that_of_the_image_size_or_the_extent() -> None:
    points = np.array([[10.0, 20.0], [599.0, 399.0], [np.nan, 1e9], [1e300, 3.0]])
    by_size, by_extent = resolve_intrinsics(points, points, size1=(640, 480))
    np.testing.assert_allclose(by_size.K, [[768, 0, 319.5], [0, 768, 239.5], [0, 0, 1]])
    np.testing.assert_allclose(by_extent.K, [[720, 0, 299.5], [0, 720, 199.5], [0, 0, 1]])
    assert by_size.guessed
    assert by_extent.guessed


def test_one_broken_coordinate_does_not_spoil_the_guess(match_filter: MatchFilter) -> None:
    scene = make_scene()
    points1 = scene.points1.copy()
    points1[3, 0] = 1e300
    result = match_filter.filter(points1, scene.points2, None, attributes=scene.attributes)
    assert result.status is Status.OK
    assert not result.mask[3]
    assert K[0, 0] * 0.7 < float(result.info["assumptions"][0].split()[2]) < K[0, 0] * 1.3
