"""Which face of a world each pixel of a camera shows, and how far away it is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .cameras import Camera
from .world import Face, World

FloatArray = NDArray[np.float64]
Window = tuple[slice, slice]

NEAR = 1e-3  # of the world's distance: what lies nearer to the camera's plane is cut off
NOTHING = -1


@dataclass(frozen=True)
class SeenFace:
    """A face as a camera has it: ``to_face`` (3, 3) maps homogeneous pixels to (a, b, 1) / depth on the face.

    Its last row therefore gives the inverse depth of any pixel. ``window`` holds the pixels that the face can cover.
    """

    number: int
    to_face: FloatArray
    window: Window


@dataclass(frozen=True)
class VisibilityMap:
    """Face number (H, W) int16, −1 where none is seen, and inverse depth (H, W) float32; the faces in view."""

    face: NDArray[np.int16]
    inverse_depth: NDArray[np.float32]
    seen: dict[int, SeenFace]


def see(world: World, camera: Camera) -> VisibilityMap:
    """Nearest face at every pixel."""
    width, height = camera.size
    face = np.full((height, width), NOTHING, dtype=np.int16)
    nearest = np.zeros((height, width), dtype=np.float32)
    seen: dict[int, SeenFace] = {}
    for number, item in enumerate(world.faces):
        polygon = _clipped_polygon(item, camera, NEAR * world.distance)
        if polygon is None:
            continue
        window = _window(polygon, camera.size)
        to_face = _pixels_to_face(item, camera)
        if window is None or to_face is None:
            continue
        inverse = inverse_depth(to_face, window)
        covered = np.zeros(inverse.shape, dtype=np.uint8)
        corner = np.array([window[1].start, window[0].start])
        cv2.fillConvexPoly(covered, np.round((polygon - corner) * 16).astype(np.int32), 1, shift=4)
        front = (covered > 0) & (inverse > nearest[window])
        if front.any():
            nearest[window][front] = inverse[front]
            face[window][front] = number
            seen[number] = SeenFace(number, to_face, window)
    return VisibilityMap(face, nearest, seen)


def inverse_depth(to_face: FloatArray, window: Window) -> NDArray[np.float32]:
    """Inverse depth (h, w) of a face's plane at the pixels of a window."""
    x = np.arange(window[1].start, window[1].stop, dtype=np.float32) * np.float32(to_face[2, 0])
    y = np.arange(window[0].start, window[0].stop, dtype=np.float32) * np.float32(to_face[2, 1])
    return x[None, :] + (y + np.float32(to_face[2, 2]))[:, None]


def _pixels_to_face(face: Face, camera: Camera) -> FloatArray | None:
    """Inverse of the homography (a, b, 1) → depth · (x, y, 1), or None for a face seen edge on."""
    H = camera.K @ np.column_stack([camera.R @ face.u, camera.R @ face.v, camera.R @ face.origin + camera.t])
    scale = np.prod(np.linalg.norm(H, axis=0))
    if abs(np.linalg.det(H)) < 1e-9 * scale:
        return None
    return np.asarray(np.linalg.inv(H), dtype=np.float64)


def _clipped_polygon(face: Face, camera: Camera, near: float) -> FloatArray | None:
    """Outline (V, 2) in pixels of the part of a face in front of the camera, or None."""
    X = face.corners() @ camera.R.T + camera.t
    inside = X[:, 2] > near
    if not inside.any():
        return None
    points = []
    for i in range(4):
        j = (i + 1) % 4
        if inside[i]:
            points.append(X[i])
        if inside[i] != inside[j]:
            share = (near - X[i, 2]) / (X[j, 2] - X[i, 2])
            points.append(X[i] + share * (X[j] - X[i]))
    p = np.array(points) @ camera.K.T
    # Far outside, fixed-point polygons would overflow; nothing there is seen.
    return np.clip(p[:, :2] / p[:, 2:], -1e5, 1e5)


def _window(polygon: FloatArray, size: tuple[int, int]) -> Window | None:
    low = np.maximum(np.floor(polygon.min(0)), 0).astype(int)
    high = np.minimum(np.ceil(polygon.max(0)) + 1, size).astype(int)
    if (high <= low).any():
        return None
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
