"""How the camera moved between two images, and what kinds of motion a pair belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.difficulty import PairProperties
from mgca_filter.evaluation.metrics import true_matches
from mgca_filter.geometry.epipolar import rotation_error_deg

FORWARD, SIDEWAYS, SMALL_BASELINE, PLANAR, ROTATED = (
    *("forward or backward (below 30°)", "sideways (above 60°)", "small baseline (below 3°)"),
    *("near-planar (80 % on one plane)", "rotation above 60°"),
)
MOTIONS = (FORWARD, SIDEWAYS, SMALL_BASELINE, PLANAR, ROTATED)
"""Kinds of motion; a pair may belong to several, or to none."""

FORWARD_DEG, SIDEWAYS_DEG, SMALL_BASELINE_DEG, ROTATED_DEG = 30.0, 60.0, 3.0, 60.0
PLANE_PX, PLANAR_SHARE, MIN_ON_PLANE = 3.0, 0.8, 20
_PLANE_ITERATIONS = 500


@dataclass(frozen=True)
class Motion:
    """True motion of a pair.

    Attributes:
        rotation_deg: angle of the rotation.
        axes_deg: angles between the line through both centres and each camera's viewing axis, 0 … 90 degrees.
        baseline_deg: angle between the rays of a right match, median; None without a right match.
        planar_share: of the right two-way nearest neighbours, how many one homography explains within 3 px, 0 … 1; None
            where there are fewer than twenty.
    """

    rotation_deg: float
    axes_deg: tuple[float, float]
    baseline_deg: float | None
    planar_share: float | None

    @classmethod
    def of(cls, pair: ScenePair) -> Motion:
        """Measured on the truth and on the raw matches of a pair."""
        truth = true_matches(pair.correspondences, pair.E)
        directions = pair.R.T @ pair.t, pair.t  # the line through both centres as either camera sees it
        axes = [float(np.degrees(np.arccos(min(abs(d[2]) / np.linalg.norm(d), 1.0)))) for d in directions]
        baseline_deg = PairProperties.of(pair, truth).baseline_deg
        rotation_deg = rotation_error_deg(pair.R, np.eye(3))
        return cls(rotation_deg, (axes[0], axes[1]), baseline_deg, _planar_share(pair, truth & pair.mutual))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Those of :data:`MOTIONS` that the pair belongs to."""
        belongs = {
            FORWARD: max(self.axes_deg) < FORWARD_DEG,
            SIDEWAYS: min(self.axes_deg) > SIDEWAYS_DEG,
            SMALL_BASELINE: self.baseline_deg is not None and self.baseline_deg < SMALL_BASELINE_DEG,
            PLANAR: self.planar_share is not None and self.planar_share >= PLANAR_SHARE,
            ROTATED: self.rotation_deg > ROTATED_DEG,
        }
        return tuple(kind for kind in MOTIONS if belongs[kind])


def _planar_share(pair: ScenePair, right: np.typing.NDArray[np.bool_]) -> float | None:
    count = int(np.count_nonzero(right))
    if count < MIN_ON_PLANE:
        return None
    ends = pair.points1[right], pair.points2[right]
    _, mask = cv2.findHomography(*ends, cv2.RANSAC, PLANE_PX, maxIters=_PLANE_ITERATIONS)
    return 0.0 if mask is None else float(np.count_nonzero(mask)) / count
