"""Keypoints in: ``cv2.KeyPoint`` sequences or arrays of pixels, to one plain structure.

Pixels follow OpenCV throughout: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .containers import unpacked


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one image.

    Attributes:
        points: (N, 2) float64 pixels; may hold NaN or infinite values, which later steps set aside.
        size: (N,) float32 diameters in pixels, or None where the caller gave bare points.
        angle: (N,) float32 orientations in degrees, −1 = unknown, or None.
    """

    points: NDArray[np.float64]
    size: NDArray[np.float32] | None = None
    angle: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points)


def read_keypoints(keypoints: Any, name: str = "keypoints") -> Keypoints:
    """Read keypoints: ``cv2.KeyPoint`` objects, or an array (N, 2), (N, 1, 2) or (1, N, 2) of pixels.

    Args:
        keypoints: what the caller holds, in any container that keeps an order (list, tuple, object array, generator,
            ``cv2.UMat``); an empty one gives no keypoints.
        name: name of the argument, for messages.

    Raises:
        TypeError: neither KeyPoints nor numbers, or a mixture of both.
        ValueError: an array of another shape.
    """
    if keypoints is None or isinstance(keypoints, (str, bytes, dict, cv2.KeyPoint)):
        raise TypeError(
            f"{name}: expected a sequence of cv2.KeyPoint or an array (N, 2), got {type(keypoints).__name__}"
        )
    keypoints = unpacked(keypoints)
    if isinstance(keypoints, Sequence):
        if all(isinstance(item, list) and len(item) == 1 for item in keypoints):  # a column of an object array
            keypoints = [item[0] for item in keypoints]
        if any(isinstance(item, cv2.KeyPoint) for item in keypoints):
            return _from_cv2(keypoints, name)
        if len(keypoints) == 0:
            return Keypoints(np.zeros((0, 2)))
    return Keypoints(_read_points(keypoints, name))


def _from_cv2(keypoints: Sequence[Any], name: str) -> Keypoints:
    # Types first, each only once, then one field after the other: a quarter of the time of going object by object.
    if not all(issubclass(kind, cv2.KeyPoint) for kind in set(map(type, keypoints))):
        i, item = next((i, item) for i, item in enumerate(keypoints) if not isinstance(item, cv2.KeyPoint))
        raise TypeError(f"{name}[{i}]: expected cv2.KeyPoint like its neighbours, got {type(item).__name__}")
    points = np.asarray(cv2.KeyPoint.convert(tuple(keypoints)), dtype=np.float64)
    size, angle = (
        np.fromiter(map(attrgetter(field), keypoints), dtype=np.float32, count=len(keypoints))
        for field in ("size", "angle")
    )
    return Keypoints(points, size, angle)


def _read_points(points: Any, name: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(points)
    except (ValueError, TypeError) as error:  # rows of different length
        raise ValueError(f"{name}: expected an array (N, 2) of pixels ({error})") from error
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{name}: expected cv2.KeyPoint or real numbers, got dtype {array.dtype}")
    if array.size == 0 and array.shape in ((0,), (0, 2), (0, 1, 2), (1, 0, 2)):
        return np.zeros((0, 2))
    if array.ndim == 3 and array.shape[2] == 2 and 1 in array.shape[:2]:
        array = array.reshape(-1, 2)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name}: expected shape (N, 2), (N, 1, 2) or (1, N, 2), got {array.shape}")
    return array.astype(np.float64)
