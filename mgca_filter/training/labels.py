"""Which raw matches of a pair are right: labels clean enough to learn an order from."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import symmetric_epipolar_distance_squared, triangulated_depths
from ..inputs.attributes import MatchAttributes

POSITIVE_DISTANCE = 1.5e-5  # squared symmetric epipolar distance, normalised coordinates
NEGATIVE_DISTANCE = 1e-4  # the field's threshold
SURE_RATIO = 0.85
SURE_COUNT = 8
DEPTH_PERCENTILES = (3.0, 97.0)

POSITIVE, NEGATIVE, IGNORED = 1, 0, -1


class PosedPair(Protocol):
    """Matches with a true pose, such as :class:`mgca_filter.data.scene_bundle.ScenePair`."""

    @property
    def correspondences(self) -> NDArray[np.float64]: ...
    @property
    def E(self) -> NDArray[np.float64]: ...
    @property
    def R(self) -> NDArray[np.float64]: ...
    @property
    def t(self) -> NDArray[np.float64]: ...
    @property
    def attributes(self) -> MatchAttributes: ...
    @property
    def mutual(self) -> NDArray[np.bool_]: ...


def clean_labels(pair: PosedPair) -> NDArray[np.int8]:
    """1 = right, 0 = wrong, −1 = left out of the loss, for each raw match (M,).

    Right: within 1.5e-5 of the true epipolar geometry, in front of both cameras, and at a depth inside half
    to twice the range of the pair's sure matches (mutual, ratio below 0.85; at least 8 of them, else depth is
    not tested). Wrong: beyond 1e-4. Near the epipolar line a third of the accidents are told by depth alone.
    """
    distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
    depth1, depth2 = triangulated_depths(pair.correspondences, pair.R, pair.t)
    close = (distance < POSITIVE_DISTANCE) & (depth1 > 0) & (depth2 > 0)
    assert pair.attributes.ratio is not None
    sure = close & pair.mutual & (pair.attributes.ratio < SURE_RATIO) & np.isfinite(depth1)
    if np.count_nonzero(sure) >= SURE_COUNT:
        low, high = np.percentile(depth1[sure], DEPTH_PERCENTILES)
        close &= (depth1 > 0.5 * low) & (depth1 < 2.0 * high)
    labels = np.full(len(distance), IGNORED, dtype=np.int8)
    labels[distance > NEGATIVE_DISTANCE] = NEGATIVE
    labels[close] = POSITIVE
    return labels


def epipolar_labels(correspondences: NDArray[np.float64], E: NDArray[np.float64]) -> NDArray[np.int8]:
    """The field's labels (M,): 1 within 1e-4 of the true epipolar geometry, 0 beyond."""
    near = symmetric_epipolar_distance_squared(correspondences, E) < NEGATIVE_DISTANCE
    return np.where(near, POSITIVE, NEGATIVE).astype(np.int8)
