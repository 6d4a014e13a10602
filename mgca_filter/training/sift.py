"""SIFT keypoints and one-way nearest neighbours as plain arrays: what scene bundles hold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..features import create_detector, detect_keypoints
from ..inputs.attributes import MatchAttributes, best_of_list, distance_ratio
from ..inputs.keypoints import read_keypoints


@dataclass(frozen=True)
class SiftFeatures:
    """Keypoints of an image: pixels (N, 2), diameters (N,), angles (N,) in degrees, descriptors (N, 128)."""

    points: NDArray[np.float64]
    size: NDArray[np.float32]
    angle: NDArray[np.float32]
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class OneWayMatches:
    """Nearest neighbour ``index2`` (N1,) in image 2 of every keypoint of image 1, and what is known of it."""

    index2: NDArray[np.intp]
    ratio: NDArray[np.float32]
    mutual: NDArray[np.bool_]
    best: NDArray[np.bool_]


@cache
def _detector() -> cv2.Feature2D:
    return create_detector("sift")


def detect_sift(image: NDArray[np.uint8]) -> SiftFeatures:
    """Keypoints with the settings that :func:`mgca_filter.match_images` uses, in pixels of the image."""
    found, descriptors = detect_keypoints(image, _detector())
    if not found:
        none = np.zeros(0, dtype=np.float32)
        return SiftFeatures(np.zeros((0, 2)), none, none, np.zeros((0, 128), dtype=np.float32))
    keypoints = read_keypoints(found)
    assert keypoints.size is not None
    assert keypoints.angle is not None
    return SiftFeatures(keypoints.points, keypoints.size, keypoints.angle, np.asarray(descriptors, dtype=np.float32))


def match_one_way(features1: SiftFeatures, features2: SiftFeatures) -> OneWayMatches:
    """Nearest neighbours of all keypoints of image 1; no matches when image 2 has fewer than two keypoints.

    Both directions come from one matrix of squared distances; OpenCV's descriptors hold whole numbers, so it is
    exact in float32.
    """
    d1, d2 = features1.descriptors, features2.descriptors
    if len(d1) == 0 or len(d2) < 2:
        nothing = np.zeros(0, dtype=bool)
        return OneWayMatches(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.float32), nothing, nothing)
    squared = np.sum(d1 * d1, axis=1)[:, None] + np.sum(d2 * d2, axis=1) - 2.0 * (d1 @ d2.T)
    rows = np.arange(len(d1))
    index2, index1 = squared.argmin(1), squared.argmin(0)
    nearest = squared[rows, index2].astype(np.float64)
    squared[rows, index2] = np.inf
    second = squared.min(1).astype(np.float64)
    distance, distance2 = (np.sqrt(np.maximum(d, 0.0)) for d in (nearest, second))
    best = best_of_list(index2, distance)
    return OneWayMatches(
        index2,
        distance_ratio(distance, distance2),
        index1[index2] == rows,
        np.ones(len(d1), dtype=bool) if best is None else best,
    )


def match_attributes(
    features1: SiftFeatures, features2: SiftFeatures, matches: OneWayMatches, rows: slice = slice(None)
) -> MatchAttributes:
    """All that is known of each match, as the network's callers hand it over."""
    to = matches.index2[rows]
    return MatchAttributes(
        ratio=matches.ratio[rows],
        best=matches.best[rows],
        size1=features1.size[rows],
        size2=features2.size[to],
        angle1=features1.angle[rows],
        angle2=features2.angle[to],
    )
