"""Homographies: fit, residual, and the relative poses that a plane allows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .epipolar import homogeneous

Array = NDArray[np.float64]


def poses_from_homography(H: Array) -> list[tuple[Array, Array]]:
    """Relative poses R (3, 3), t (3,) unit norm under which a plane induces ``H`` between normalised points.

    Up to four (Malis & Vargas 2007); none where H is a rotation.
    """
    try:
        _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    except cv2.error:
        return []
    poses = []
    for R, t in zip(rotations, translations):
        norm = float(np.linalg.norm(t))
        if np.isfinite(R).all() and np.isfinite(norm) and norm > 1e-9:
            poses.append((np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel() / norm))
    return poses


def homography_distance(points1: Array, points2: Array, H: Array) -> Array:
    """Distance (N,) of matches to a homography ``p2 ~ H p1``, in the unit of the points.

    Half the root of the summed squared transfer errors in both directions: like Sampson's, it splits the error
    between the two images. Infinite where a point maps to infinity.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        forward = _transfer(points1, H) - points2
        backward = _transfer(points2, np.asarray(np.linalg.pinv(H), dtype=np.float64)) - points1
        distance = 0.5 * np.sqrt(np.sum(forward**2, axis=1) + np.sum(backward**2, axis=1))
    return np.where(np.isfinite(distance), distance, np.inf)


def _transfer(points: Array, H: Array) -> Array:
    mapped = homogeneous(points) @ H.T
    transferred: Array = mapped[:, :2] / mapped[:, 2:]
    return transferred
