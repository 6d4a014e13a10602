"""From photographs as they are shown to the pixels of their files: COLMAP and hloc read files as they are stored.

The filter works on photographs as their EXIF says that they are to be shown, as all viewers and ``cv2.imread`` have
them. COLMAP (``pycolmap.Bitmap``) and hloc (``cv2.IMREAD_IGNORE_ORIENTATION``) do not turn them, and undistort, texture
and localise in the stored pixels: what they are given is turned back, keypoints, cameras and geometry alike.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..features import ImageFeatures
from ..geometry.orientation import UPRIGHT, shown_camera, shown_pixels, shown_size, stored_intrinsics
from .worker import PairRow


def stored_features(features: ImageFeatures, orientation: int) -> ImageFeatures:
    """Features of an image in the pixels of its file, from those in the image as it is shown."""
    if orientation == UPRIGHT or features.image_size is None:
        return features
    size = shown_size(orientation, features.image_size)
    T = np.linalg.inv(shown_pixels(orientation, size))
    K, angle = features.K, features.angle
    if angle is not None:
        direction = np.radians(angle)
        turned = np.column_stack([np.cos(direction), np.sin(direction)]) @ T[:2, :2].T
        angle = (np.degrees(np.arctan2(turned[:, 1], turned[:, 0])) % 360.0).astype(np.float32)
    return replace(
        features,
        points=features.points @ T[:2, :2].T + T[:2, 2],
        angle=angle,
        image_size=size,
        K=None if K is None else stored_intrinsics(K, orientation, size),
    )


def stored_row(
    row: PairRow, shape1: tuple[tuple[int, int], int] | None, shape2: tuple[tuple[int, int], int] | None
) -> PairRow:
    """A pair's geometry between the files as they are stored.

    Args:
        shape1, shape2: (width, height) of each image as it is shown, and its EXIF orientation; None = upright.

    Where one file is a mirror image and the other is not, no rotation leads from one to the other: R and t are None.
    """
    T1, S1 = _turn(shape1)
    T2, S2 = _turn(shape2)
    if np.array_equal(S1, np.eye(3)) and np.array_equal(S2, np.eye(3)):
        return row
    R = None if row.R is None else S2.T @ row.R @ S1
    t = None if row.t is None else S2.T @ row.t
    if R is not None and np.linalg.det(R) < 0:
        R, t = None, None
    return replace(
        row,
        E=None if row.E is None else S2.T @ row.E @ S1,
        F=None if row.F is None else T2.T @ row.F @ T1,
        H=None if row.H is None else np.linalg.inv(T2) @ row.H @ T1,
        R=R,
        t=t,
    )


def _turn(shape: tuple[tuple[int, int], int] | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Stored pixels to shown ones, and the stored camera's frame to the shown one's, (3, 3) each."""
    if shape is None:
        return np.eye(3), np.eye(3)
    shown, orientation = shape
    return shown_pixels(orientation, shown_size(orientation, shown)), shown_camera(orientation)
