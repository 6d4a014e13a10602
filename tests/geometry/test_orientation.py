"""EXIF orientations as maps of pixels and cameras: they are where the projection of a turned camera says."""

from __future__ import annotations

import numpy as np
import pytest

from mgca_filter.geometry.orientation import (
    is_quarter_turn,
    shown_camera,
    shown_intrinsics,
    shown_pixels,
    shown_size,
    stored_intrinsics,
)

SIZE = (40, 30)
K = np.array([[50.0, 0, 18], [0, 60, 13], [0, 0, 1]])
ORIENTATIONS = range(1, 9)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_projection_commutes_with_the_turn(orientation: int) -> None:
    """A point seen by the shown camera lies where the shown pixel of its stored pixel is."""
    X = np.array([[0.3, -0.2, 2.0], [-1.0, 0.5, 4.0], [0.0, 0.0, 1.0]])
    stored = X @ K.T
    shown = (X @ shown_camera(orientation).T) @ shown_intrinsics(K, orientation, SIZE).T
    expected = stored @ shown_pixels(orientation, SIZE).T
    np.testing.assert_allclose(shown / shown[:, 2:], expected / expected[:, 2:], atol=1e-12)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_intrinsics_lead_back_and_stay_intrinsics(orientation: int) -> None:
    shown = shown_intrinsics(K, orientation, SIZE)
    np.testing.assert_allclose(stored_intrinsics(shown, orientation, SIZE), K, atol=1e-12)
    assert sorted(np.diag(shown)[:2]) == [50, 60]
    np.testing.assert_array_equal(shown[[1, 2, 2], [0, 0, 1]], 0)
    width, height = shown_size(orientation, SIZE)
    assert 0 < shown[0, 2] < width
    assert 0 < shown[1, 2] < height


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_the_corners_stay_corners(orientation: int) -> None:
    width, height = shown_size(orientation, SIZE)
    assert ((width, height) == SIZE) != is_quarter_turn(orientation)
    corners = np.array([(x, y, 1) for x in (0, SIZE[0] - 1) for y in (0, SIZE[1] - 1)])
    shown = {tuple(corner) for corner in (corners @ shown_pixels(orientation, SIZE).T)[:, :2].astype(int)}
    assert shown == {(x, y) for x in (0, width - 1) for y in (0, height - 1)}


def test_turns_are_rotations_and_mirrors_are_not() -> None:
    determinants = [round(np.linalg.det(shown_camera(orientation))) for orientation in ORIENTATIONS]
    assert determinants == [1, -1, 1, -1, -1, 1, -1, 1]
