"""From two images to a pair of the scoreboard: SIFT and nearest neighbours as ``match_images`` takes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...correspondences import MatchAttributes
from ...keypoints import create_detector, detect_keypoints
from ...matching import match_descriptors, read_matches
from ...scene_bundle import ScenePair
from .base import read_image

FEATURE_SETTINGS = f"sift 2000, revision 1, opencv {cv2.__version__}"
"""Part of the digest of sources that detect and match themselves."""


@dataclass(frozen=True)
class ImageFeatures:
    """Keypoints (N, 2) in pixels of the stored image, their diameters and angles (N,), descriptors (N, D)."""

    size: tuple[int, int]
    points: NDArray[np.float64]
    diameter: NDArray[np.float32]
    angle: NDArray[np.float32]
    descriptors: NDArray[Any]


@dataclass(frozen=True)
class View:
    """One image with its camera: ``points`` (N, 2) are its features' pixels under ``K`` (3, 3), free of distortion.

    A point is NaN where the camera model gives none.
    """

    name: str
    features: ImageFeatures
    points: NDArray[np.float64]
    K: NDArray[np.float64]


@lru_cache(maxsize=64)
def detect(path: Path, quarter_turns: int = 0) -> ImageFeatures:
    """Features of an image file turned counter-clockwise by ``quarter_turns`` · 90°; kept for the latest 64 images.

    Raises:
        DatasetError: the image is missing or cannot be read.
    """
    image = np.ascontiguousarray(np.rot90(read_image(path), quarter_turns))
    keypoints, descriptors = detect_keypoints(image, create_detector(), str(path))
    values = np.array([(*k.pt, k.size, k.angle) for k in keypoints], dtype=np.float64).reshape(-1, 4)
    return ImageFeatures(
        size=(image.shape[1], image.shape[0]),
        points=values[:, :2],
        diameter=values[:, 2].astype(np.float32),
        angle=values[:, 3].astype(np.float32),
        descriptors=descriptors,
    )


def match_views(
    scene: str, index: int, view1: View, view2: View, R: NDArray[np.float64], t: NDArray[np.float64]
) -> ScenePair:
    """The pair of two views with pose ``X2 = R X1 + t``: one-way nearest neighbours, no test applied.

    Keypoints without undistorted place are left out before matching.
    """
    rows1, rows2 = (np.flatnonzero(np.isfinite(view.points).all(axis=1)) for view in (view1, view2))
    descriptors1, descriptors2 = view1.features.descriptors[rows1], view2.features.descriptors[rows2]
    matches = read_matches(match_descriptors(descriptors1, descriptors2), len(rows1), len(rows2))
    back = match_descriptors(descriptors2, descriptors1)
    nearest_in_1 = np.array([row[0].trainIdx for row in back], dtype=np.intp)
    mutual = np.zeros(len(matches), dtype=bool)
    if len(matches):
        mutual = nearest_in_1[matches.index2] == matches.index1
    index1, index2 = rows1[matches.index1], rows2[matches.index2]
    attributes = MatchAttributes(
        ratio=matches.ratio if matches.ratio is not None else np.full(len(index1), np.nan, dtype=np.float32),
        best=matches.best,
        size1=view1.features.diameter[index1],
        size2=view2.features.diameter[index2],
        angle1=view1.features.angle[index1],
        angle2=view2.features.angle[index2],
    )
    return ScenePair(
        scene=scene,
        index=index,
        image1=view1.name,
        image2=view2.name,
        points1=view1.points[index1],
        points2=view2.points[index2],
        K1=view1.K,
        K2=view2.K,
        image_size1=view1.features.size,
        image_size2=view2.features.size,
        R=R,
        t=t,
        attributes=attributes,
        mutual=mutual,
    )
