"""Which matches between two views of a world are right: known from depth, not guessed from epipolar lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...geometry.epipolar import symmetric_epipolar_distance_squared
from ..pairs import IGNORED, NEGATIVE, NEGATIVE_DISTANCE, POSITIVE, POSITIVE_DISTANCE
from .cameras import Camera
from .visibility import NOTHING, VisibilityMap

FloatArray = NDArray[np.float64]

RIGHT_PX, WRONG_PX = 3.0, 10.0  # distance to where the point truly is; what lies between is left out
EDGE_PX = 3  # a keypoint this near to another face may belong to that one
SAME_DEPTH = 0.02


def transfer_error(
    points1: FloatArray,
    points2: FloatArray,
    camera1: Camera,
    camera2: Camera,
    map1: VisibilityMap,
    map2: VisibilityMap,
) -> FloatArray:
    """Distance (N,) in pixels from ``points2`` to where the camera-2 image shows the points (N, 2) of image 1.

    The smallest over the faces at and near the point of image 1; infinite where that place is hidden or out of
    view.
    """
    error = np.full(len(points1), np.inf)
    rays = camera1.rays(points1)
    for dx, dy in ((0, 0), (EDGE_PX, 0), (-EDGE_PX, 0), (0, EDGE_PX), (0, -EDGE_PX)):
        depth = 1.0 / _inverse_depth_of_nearby_face(points1, (dx, dy), map1)  # inf where nothing is seen
        known = np.isfinite(depth)
        X = ((rays[known] * depth[known, None]) - camera1.t) @ camera1.R
        expected, depth2 = camera2.project(X)
        distance = np.linalg.norm(expected - points2[known], axis=1)
        distance[(depth2 <= 0) | ~_is_seen(expected, depth2, map2)] = np.inf
        error[known] = np.minimum(error[known], distance)
    return error


def match_labels(correspondences: FloatArray, E: FloatArray, error_px: FloatArray) -> NDArray[np.int8]:
    """1 = right, 0 = wrong, −1 = left out, (N,): both the transfer error and the epipolar distance must agree."""
    distance = symmetric_epipolar_distance_squared(correspondences, E)
    labels = np.full(len(distance), IGNORED, dtype=np.int8)
    labels[(error_px > WRONG_PX) | (distance > NEGATIVE_DISTANCE)] = NEGATIVE
    labels[(error_px < RIGHT_PX) & (distance < POSITIVE_DISTANCE)] = POSITIVE
    return labels


def visible_share(camera1: Camera, camera2: Camera, map1: VisibilityMap, map2: VisibilityMap) -> float:
    """Share of the pixels of image 1 whose points image 2 shows."""
    height, width = map1.face.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(np.float64)
    inverse = map1.inverse_depth.ravel().astype(np.float64)
    X = (camera1.rays(pixels) / np.maximum(inverse, 1e-12)[:, None] - camera1.t) @ camera1.R
    expected, depth = camera2.project(X)
    return float(np.mean((inverse > 0) & (depth > 0) & _is_seen(expected, depth, map2)))


def _inverse_depth_of_nearby_face(points: FloatArray, offset: tuple[int, int], visible: VisibilityMap) -> FloatArray:
    """Inverse depth (N,) at ``points`` of the plane seen ``offset`` pixels away; 0 where there is none."""
    height, width = visible.face.shape
    x = np.clip(np.round(points[:, 0]).astype(int) + offset[0], 0, width - 1)
    y = np.clip(np.round(points[:, 1]).astype(int) + offset[1], 0, height - 1)
    numbers = visible.face[y, x]
    inverse = np.full(len(points), np.nan)
    for number in np.unique(numbers):
        if number != NOTHING:
            plane = visible.seen[int(number)].to_face[2]
            rows = numbers == number
            inverse[rows] = points[rows] @ plane[:2] + plane[2]
    return np.where(inverse > 0, inverse, np.nan)


def _is_seen(pixels: FloatArray, depth: FloatArray, visible: VisibilityMap) -> NDArray[np.bool_]:
    """Whether points at ``depth`` (N,) that project to ``pixels`` (N, 2) are the nearest thing there."""
    height, width = visible.face.shape
    with np.errstate(invalid="ignore"):
        x, y = np.round(np.clip(pixels, -10, 1e5)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    nearest = visible.inverse_depth[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    with np.errstate(divide="ignore"):
        hidden = nearest > (1.0 + SAME_DEPTH) / depth
    return inside & ~hidden
