"""Types that several floors share: what callers may pass, by name, and how OpenCV's own objects travel.

``cv2.KeyPoint`` and ``cv2.DMatch`` cannot be pickled by themselves, so that neither they nor a result that holds them
could leave a worker process, or be copied deeply. Importing this module registers how.
"""

from __future__ import annotations

import copyreg
from collections.abc import Iterable, Sequence
from typing import Any

import cv2
from numpy.typing import NDArray

Providers = Sequence["str | tuple[str, dict[str, Any]]"]
"""Execution providers of ONNX Runtime: names, or names with options."""

PointsLike = Iterable[cv2.KeyPoint] | NDArray[Any] | Sequence[Sequence[float]]
"""Keypoints of an image: ``cv2.KeyPoint`` objects in any order-keeping container, or pixels (N, 2)."""

MatchesLike = Iterable[cv2.DMatch] | Iterable[Sequence[cv2.DMatch]] | NDArray[Any] | Sequence[Sequence[int]]
"""Putative matches: ``cv2.DMatch`` objects, ``knnMatch`` rows of them, or integer index pairs (M, 2)."""

MatrixLike = NDArray[Any] | Sequence[Sequence[float]]
"""A matrix, such as intrinsics (3, 3)."""

SizeLike = Sequence[float] | NDArray[Any]
"""(width, height) in pixels."""


def _reduce_keypoint(keypoint: cv2.KeyPoint) -> tuple[Any, ...]:
    x, y = keypoint.pt
    fields = (x, y, keypoint.size, keypoint.angle, keypoint.response, keypoint.octave, keypoint.class_id)
    return cv2.KeyPoint, fields


def _reduce_match(match: cv2.DMatch) -> tuple[Any, ...]:
    return cv2.DMatch, (match.queryIdx, match.trainIdx, match.imgIdx, match.distance)


copyreg.pickle(cv2.KeyPoint, _reduce_keypoint)
copyreg.pickle(cv2.DMatch, _reduce_match)
