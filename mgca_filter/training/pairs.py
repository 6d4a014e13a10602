"""What every data source hands over: one pair of images as matches, true pose and labels.

Labels say which raw matches are right, clean enough to learn an order from: 1 = right, 0 = wrong, −1 = left out of the
loss.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair
from ..geometry.epipolar import essential_from_pose, symmetric_epipolar_distance_squared, triangulated_depths
from ..inputs.attributes import MatchAttributes

FloatArray = NDArray[np.float64]

POSITIVE_DISTANCE = 1.5e-5  # squared symmetric epipolar distance, normalised coordinates
NEGATIVE_DISTANCE = 1e-4  # the field's threshold
SURE_RATIO = 0.85
SURE_COUNT = 8
DEPTH_PERCENTILES = (3.0, 97.0)

POSITIVE, NEGATIVE, IGNORED = 1, 0, -1


@dataclass(frozen=True)
class TrainingPair:
    """One-way matches of a pair of images.

    Attributes:
        name: source, scene and number, for messages.
        correspondences: (M, 4) on the normalised image planes.
        R, t: relative pose, X2 = R X1 + t; the scale of ``t`` (3,) may be unknown.
        attributes: what the matcher knew.
        mutual: (M,) two-way nearest neighbours.
        known_labels: (M,) int8 where the source knows them; None = they are told from pose and depth.
    """

    name: str
    correspondences: FloatArray
    R: FloatArray
    t: FloatArray
    attributes: MatchAttributes
    mutual: NDArray[np.bool_]
    known_labels: NDArray[np.int8] | None = None

    def __len__(self) -> int:
        return len(self.correspondences)

    @cached_property
    def E(self) -> FloatArray:
        """True essential matrix (3, 3) of unit Frobenius norm."""
        return essential_from_pose(self.R, self.t)

    @cached_property
    def labels(self) -> NDArray[np.int8]:
        """1 = right, 0 = wrong, −1 = left out of the loss, (M,)."""
        return clean_labels(self) if self.known_labels is None else self.known_labels


def clean_labels(pair: ScenePair | TrainingPair) -> NDArray[np.int8]:
    """Labels of each raw match (M,), told from pose and depth.

    Right: within 1.5e-5 of the true epipolar geometry, in front of both cameras, and at a depth inside half
    to twice the range of the pair's sure matches (mutual, ratio below 0.85 where it is known; at least 8 of them, else
    depth is not tested). Wrong: beyond 1e-4. Near the epipolar line a third of the accidents are told by depth alone.
    """
    distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
    depth1, depth2 = triangulated_depths(pair.correspondences, pair.R, pair.t)
    close = (distance < POSITIVE_DISTANCE) & (depth1 > 0) & (depth2 > 0)
    sure = close & pair.mutual & np.isfinite(depth1)
    if pair.attributes.ratio is not None:
        sure &= pair.attributes.ratio < SURE_RATIO
    if np.count_nonzero(sure) >= SURE_COUNT:
        low, high = np.percentile(depth1[sure], DEPTH_PERCENTILES)
        close &= (depth1 > 0.5 * low) & (depth1 < 2.0 * high)
    labels = np.full(len(distance), IGNORED, dtype=np.int8)
    labels[distance > NEGATIVE_DISTANCE] = NEGATIVE
    labels[close] = POSITIVE
    return labels


def epipolar_labels(correspondences: FloatArray, E: FloatArray) -> NDArray[np.int8]:
    """The field's labels (M,): 1 within 1e-4 of the true epipolar geometry, 0 beyond."""
    near = symmetric_epipolar_distance_squared(correspondences, E) < NEGATIVE_DISTANCE
    return np.where(near, POSITIVE, NEGATIVE).astype(np.int8)
