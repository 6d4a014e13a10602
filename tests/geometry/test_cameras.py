"""Cameras: distortion is removed to the last digits or said to be impossible; what is not given is guessed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import K, make_scene

from mgca_filter import MatchFilter, Status
from mgca_filter.geometry.cameras import Fisheye, lens_doubt, resolve_intrinsics

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


LENS = Fisheye(-0.02, 0.004, -0.001, 0.0002)
FISHEYE_K = np.array([[300.0, 0.0, 511.5], [0.0, 310.0, 500.0], [0.0, 0.0, 1.0]])


def rays(largest_deg: float, count: int = 200) -> np.ndarray:
    """Points (N, 2) of the image plane, up to an angle off the axis."""
    rng = np.random.default_rng(0)
    theta, phi = np.radians(largest_deg) * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    return np.tan(theta)[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])


def seen_by_fisheye(plane: np.ndarray, lens: Fisheye = LENS, K: np.ndarray = FISHEYE_K) -> np.ndarray:
    """Pixels (N, 2), by the formula of the model, skew included."""
    radius = np.linalg.norm(plane, axis=1)
    theta = np.arctan(radius)
    powers = theta[:, None] ** np.array([2, 4, 6, 8])
    seen = theta * (1.0 + powers @ np.array([lens.k1, lens.k2, lens.k3, lens.k4]))
    on_sensor = plane * (seen / np.maximum(radius, 1e-12))[:, None]
    return np.column_stack([on_sensor, np.ones(len(plane))]) @ K[:2].T


@pytest.mark.parametrize("skew", [0.0, 5.0])
@pytest.mark.parametrize("lens", [LENS, Fisheye()])
def test_undistorting_a_fisheye_is_the_inverse_of_its_formula(skew: float, lens: Fisheye) -> None:
    K = FISHEYE_K + np.array([[0.0, skew, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    plane = rays(85.0)
    camera, shared = resolve_intrinsics(plane, plane, K1=K, dist1=lens)
    assert shared.distortion == lens
    found = camera.normalize(seen_by_fisheye(plane, lens, K))
    np.testing.assert_allclose(found, plane, rtol=1e-4, atol=1e-6)


def test_a_pixel_beyond_ninety_degrees_is_not_a_number() -> None:
    pixels = np.array([[511.5, 500.0], [511.5 + 300.0 * 1.6, 500.0]])
    camera, _ = resolve_intrinsics(pixels, pixels, K1=FISHEYE_K, dist1=Fisheye())
    np.testing.assert_array_equal(np.isnan(camera.normalize(pixels)).all(axis=1), [False, True])


@pytest.mark.parametrize("distortion", [LENS, [-0.28, 0.07, 1e-3, 0.0]])
def test_the_stretch_is_the_derivative_of_undistorting(distortion: Fisheye | list[float]) -> None:
    plane = rays(75.0) if isinstance(distortion, Fisheye) else rays(30.0)
    fisheye = isinstance(distortion, Fisheye)
    pixels = seen_by_fisheye(plane) if fisheye else distorted(plane, FISHEYE_K, distortion)
    camera, _ = resolve_intrinsics(pixels, pixels, K1=FISHEYE_K, dist1=distortion)
    stretch = camera.stretch(pixels)
    step = 1e-3 * np.random.default_rng(1).normal(size=pixels.shape)
    focal = np.array([300.0, 310.0])
    moved = (camera.normalize(pixels + step) - camera.normalize(pixels)) * focal
    error = np.linalg.norm(np.einsum("nij,nj->ni", stretch, step) - moved, axis=1)
    assert (error < 0.02 * np.linalg.norm(moved, axis=1) + 1e-5).all()
    middle = np.array([[511.5, 500.0]])
    np.testing.assert_allclose(camera.stretch(middle)[0], np.eye(2), atol=1e-3)


def test_without_distortion_there_is_no_stretch() -> None:
    camera, _ = resolve_intrinsics(np.zeros((3, 2)), np.zeros((3, 2)), K1=FISHEYE_K, dist1=[0.0, 0.0, 0.0, 0.0])
    assert camera.stretch(np.zeros((3, 2))) is None


@pytest.mark.parametrize(
    ("lens", "error", "words"),
    [
        (Fisheye(float("nan")), ValueError, "dist1: expected finite coefficients of a fisheye"),
        (Fisheye("a"), TypeError, "dist1: expected finite coefficients of a fisheye"),
    ],
)
def test_a_fisheye_of_no_numbers_is_refused(lens: Fisheye, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        resolve_intrinsics(np.zeros((3, 2)), np.zeros((3, 2)), K1=FISHEYE_K, dist1=lens)


def test_coefficients_that_show_nothing_at_many_keypoints_raise_a_doubt() -> None:
    pixels = seen_by_fisheye(rays(85.0))
    of_pinhole, _ = resolve_intrinsics(pixels, pixels, K1=FISHEYE_K, dist1=[-0.3, 0.01, 0.0, 0.0])
    doubt = lens_doubt(of_pinhole, pixels, 2)
    assert doubt is not None
    assert doubt.startswith("dist2 shows nothing at ")
    assert doubt.endswith("pass Fisheye(k1, k2, k3, k4)")
    of_fisheye, _ = resolve_intrinsics(pixels, pixels, K1=FISHEYE_K, dist1=LENS)
    assert lens_doubt(of_fisheye, pixels, 2) is None
