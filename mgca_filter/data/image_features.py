"""From two images to their matches: SIFT and nearest neighbours as ``match_images`` takes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..features import create_detector, detect_keypoints, match_descriptors
from ..inputs.attributes import MatchAttributes
from ..inputs.matches import read_matches
from .scene_bundle import ScenePair
from .source import Image, read_image

FEATURE_SETTINGS = f"sift 2000, revision 1, opencv {cv2.__version__}"
"""Part of the digest of whatever is detected and matched here."""


@dataclass(frozen=True)
class ImageFeatures:
    """Keypoints (N, 2) in pixels of the stored image, their diameters and angles (N,), descriptors (N, D)."""

    size: tuple[int, int]
    points: NDArray[np.float64]
    diameter: NDArray[np.float32]
    angle: NDArray[np.float32]
    descriptors: NDArray[Any]

    def take(self, rows: NDArray[np.intp]) -> ImageFeatures:
        """The keypoints of the given rows alone."""
        points, diameter, angle = self.points[rows], self.diameter[rows], self.angle[rows]
        return ImageFeatures(self.size, points, diameter, angle, self.descriptors[rows])


@dataclass(frozen=True)
class OneWayMatches:
    """Nearest neighbour in image 2 of each of M keypoints of image 1, no test applied.

    Attributes:
        index1, index2: (M,) rows of the two images' features.
        attributes: what the matcher and the keypoints know of each match.
        mutual: bool (M,), nearest both ways.
    """

    index1: NDArray[np.intp]
    index2: NDArray[np.intp]
    attributes: MatchAttributes
    mutual: NDArray[np.bool_]


@dataclass(frozen=True)
class View:
    """One image with its camera: ``points`` (N, 2) are its features' pixels under ``K`` (3, 3), free of distortion.

    A point is NaN where the camera model gives none.
    """

    name: str
    features: ImageFeatures
    points: NDArray[np.float64]
    K: NDArray[np.float64]


@lru_cache(maxsize=128)
def detect(path: Path, quarter_turns: int = 0) -> ImageFeatures:
    """Features of an image file turned counter-clockwise by ``quarter_turns`` · 90°; kept for the latest 128 images.

    Raises:
        DatasetError: the image is missing or cannot be read.
    """
    return describe(np.ascontiguousarray(np.rot90(read_image(path), quarter_turns)), create_detector(), str(path))


def describe(image: Image, detector: cv2.Feature2D, name: str) -> ImageFeatures:
    """Features of an image (H, W) or (H, W, 3) uint8; ``name`` stands in messages."""
    keypoints, descriptors = detect_keypoints(image, detector, name)
    values = np.array([(*k.pt, k.size, k.angle) for k in keypoints], dtype=np.float64).reshape(-1, 4)
    return ImageFeatures(
        size=(image.shape[1], image.shape[0]),
        points=values[:, :2],
        diameter=values[:, 2].astype(np.float32),
        angle=values[:, 3].astype(np.float32),
        descriptors=descriptors,
    )


def match_features(one: ImageFeatures, two: ImageFeatures) -> OneWayMatches:
    """The matches of two images."""
    forth = read_matches(match_descriptors(one.descriptors, two.descriptors), len(one.points), len(two.points))
    back = read_matches(match_descriptors(two.descriptors, one.descriptors), len(two.points), len(one.points))
    attributes = MatchAttributes(
        ratio=np.full(len(forth), np.nan, dtype=np.float32) if forth.ratio is None else forth.ratio,
        best=forth.best,
        size1=one.diameter[forth.index1],
        size2=two.diameter[forth.index2],
        angle1=one.angle[forth.index1],
        angle2=two.angle[forth.index2],
    )
    mutual = np.zeros(0, dtype=bool) if len(forth) == 0 else back.index2[forth.index2] == forth.index1
    return OneWayMatches(forth.index1, forth.index2, attributes, mutual)


def match_views(
    scene: str, index: int, view1: View, view2: View, R: NDArray[np.float64], t: NDArray[np.float64]
) -> ScenePair:
    """The pair of two views with pose ``X2 = R X1 + t``.

    Keypoints without undistorted place are left out before matching.
    """
    placed1, placed2 = (np.flatnonzero(np.isfinite(view.points).all(axis=1)) for view in (view1, view2))
    matches = match_features(view1.features.take(placed1), view2.features.take(placed2))
    return ScenePair(
        scene=scene,
        index=index,
        image1=view1.name,
        image2=view2.name,
        points1=view1.points[placed1][matches.index1],
        points2=view2.points[placed2][matches.index2],
        K1=view1.K,
        K2=view2.K,
        image_size1=view1.features.size,
        image_size2=view2.features.size,
        R=R,
        t=t,
        attributes=matches.attributes,
        mutual=matches.mutual,
    )
