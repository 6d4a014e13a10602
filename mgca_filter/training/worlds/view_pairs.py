"""Pairs of views with their matches and labels, and their places in a scene bundle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...data.scene_bundle import BundleImage, BundlePair
from ...features import OneWayMatches, match_features
from ...geometry.cameras import normalize_points
from ...geometry.epipolar import essential_from_pose
from ..pairs import POSITIVE
from .truth import match_labels, transfer_error, visible_share
from .views import View

FloatArray = NDArray[np.float64]

MINIMUM_RIGHT = 20  # a pair with fewer right matches teaches noise


@dataclass(frozen=True)
class ViewPair:
    """One-way matches between two views, normalised correspondences (M, 4), relative pose and labels (M,)."""

    view1: View
    view2: View
    matches: OneWayMatches
    correspondences: FloatArray
    R: FloatArray
    t: FloatArray
    labels: NDArray[np.int8]

    @property
    def usable(self) -> bool:
        """Whether enough matches are right to learn from."""
        return int(np.count_nonzero(self.labels == POSITIVE)) >= MINIMUM_RIGHT


def match_views(view1: View, view2: View) -> ViewPair:
    """Match two views of one world and label the matches by depth."""
    matches = match_features(view1.features, view2.features)
    points1, points2 = view1.features.points[matches.index1], view2.features.points[matches.index2]
    camera1, camera2 = view1.camera, view2.camera
    R = camera2.R @ camera1.R.T
    t = camera2.t - R @ camera1.t
    x = np.hstack([normalize_points(points1, camera1.K), normalize_points(points2, camera2.K)])
    error_px = transfer_error(points1, points2, camera1, camera2, view1.visible, view2.visible)
    labels = match_labels(x, essential_from_pose(R, t), error_px)
    return ViewPair(view1, view2, matches, x, R, t, labels)


def bundle_image(view: View, name: str) -> BundleImage:
    """A view as a scene bundle keeps it."""
    return BundleImage(name, view.features, view.camera.R, view.camera.t)


def bundle_pairs(rng: np.random.Generator, views: Sequence[View]) -> list[BundlePair]:
    """All usable pairs of the views of a world, each matched in a direction drawn at random."""
    pairs = []
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            first, second = (i, j) if rng.random() < 0.5 else (j, i)
            pair = match_views(views[first], views[second])
            if pair.usable:
                share = visible_share(pair.view1.camera, pair.view2.camera, pair.view1.visible, pair.view2.visible)
                pairs.append(BundlePair(first, second, pair.matches, round(share * len(pair.labels)), pair.labels))
    return pairs
