"""From pixels and what the matcher knew to the network's two inputs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Column(IntEnum):
    """Columns of the encoded attributes (M, 8), the network's second input."""

    RATIO = 0
    BEST = 1
    LOG2_SIZE = 2
    COS_TURN = 3
    SIN_TURN = 4
    RATIO_KNOWN = 5
    BEST_KNOWN = 6
    SHAPE_KNOWN = 7


ATTRIBUTE_COUNT = len(Column)
# A keypoint's noise grows with this power of its size; what is known of that is believed within these limits.
_NOISE_POWER = 0.75
_LEAST_NOISE, _LARGEST_NOISE = 0.4, 3.0
CANDIDATE_MAX_RATIO = 0.95
CANDIDATE_MIN_COUNT = 32


@dataclass(frozen=True)
class MatchAttributes:
    """What a matcher knows of each match beyond its position; every field is optional, (M,) each.

    Attributes:
        ratio: distance to the nearest over distance to the second nearest descriptor, 0 … 1.
        best: True where no other match of the list reaches the same keypoint of image 2 at a smaller
            descriptor distance.
        size1, size2: keypoint diameters in pixels (``cv2.KeyPoint.size``).
        angle1, angle2: keypoint orientations in degrees (``cv2.KeyPoint.angle``, −1 = unknown).
    """

    ratio: NDArray[np.float32] | None = None
    best: NDArray[np.bool_] | None = None
    size1: NDArray[np.float32] | None = None
    size2: NDArray[np.float32] | None = None
    angle1: NDArray[np.float32] | None = None
    angle2: NDArray[np.float32] | None = None

    def encode(self, count: int) -> NDArray[np.float32]:
        """Network input (count, 8), raw physical values; groups that are unknown are zero.

        :class:`Column` names the columns: ratio, best (0/1), log2(size2 / size1), cos and sin of angle2 − angle1,
        and three flags (0/1) — ratio known, best known, size and angle known.
        """
        encoded = np.zeros((count, ATTRIBUTE_COUNT), dtype=np.float32)
        if self.ratio is not None:
            known = np.isfinite(self.ratio)
            encoded[:, Column.RATIO] = np.clip(np.where(known, self.ratio, 0.0), 0.0, 1.0)
            encoded[:, Column.RATIO_KNOWN] = known
        if self.best is not None:
            encoded[:, Column.BEST] = self.best
            encoded[:, Column.BEST_KNOWN] = 1.0
        fields = (self.size1, self.size2, self.angle1, self.angle2)
        if all(field is not None for field in fields):
            size1, size2, angle1, angle2 = (np.asarray(field, dtype=np.float64) for field in fields)
            with np.errstate(invalid="ignore"):
                known = (size1 > 0) & (size2 > 0) & (angle1 >= 0) & (angle2 >= 0)
                known &= np.isfinite(size1) & np.isfinite(size2) & np.isfinite(angle1) & np.isfinite(angle2)
            turn = np.radians(np.where(known, angle2, 0.0) - np.where(known, angle1, 0.0))
            encoded[:, Column.LOG2_SIZE] = np.log2(np.where(known, size2, 1.0) / np.where(known, size1, 1.0))
            encoded[:, Column.COS_TURN] = np.where(known, np.cos(turn), 0.0)
            encoded[:, Column.SIN_TURN] = np.where(known, np.sin(turn), 0.0)
            encoded[:, Column.SHAPE_KNOWN] = known
        return encoded

    def relative_noise(self, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
        """How noisy the position of each match (M,) is, the usual match of the list being 1; 1 where it is not known.

        A detector locates small keypoints better than large ones. The squares of the sizes in both images add up.

        Args:
            valid: (M,) the matches that tell what is usual.
        """
        noise = np.ones(len(valid))
        if self.size1 is None or self.size2 is None:
            return noise
        size = np.sqrt(0.5 * (self.size1.astype(np.float64) ** 2 + self.size2.astype(np.float64) ** 2))
        with np.errstate(invalid="ignore"):
            known = np.isfinite(size) & (self.size1 > 0) & (self.size2 > 0)
        usual = size[known & valid]
        if len(usual):
            noise[known] = np.clip((size[known] / np.median(usual)) ** _NOISE_POWER, _LEAST_NOISE, _LARGEST_NOISE)
        return noise

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> MatchAttributes:
        """The same attributes for a selection of matches."""
        return MatchAttributes(
            **{name: None if value is None else np.asarray(value)[rows] for name, value in vars(self).items()}
        )


def candidate_mask(
    attributes: NDArray[np.float32],
    max_ratio: float = CANDIDATE_MAX_RATIO,
    min_count: int = CANDIDATE_MIN_COUNT,
) -> NDArray[np.bool_]:
    """Matches (M,) worth the network's time, from encoded attributes (M, 8).

    A match is a candidate when it is best of the list and its ratio is below ``max_ratio``; a match whose ratio
    or best-of-list flag is unknown is one too. All are, when fewer than ``min_count`` would remain.
    """
    ratio, best = attributes[:, Column.RATIO], attributes[:, Column.BEST]
    ratio_known, best_known = attributes[:, Column.RATIO_KNOWN] > 0, attributes[:, Column.BEST_KNOWN] > 0
    hopeless: NDArray[np.bool_] = ratio_known & best_known & ((ratio >= max_ratio) | (best == 0))
    if len(hopeless) - np.count_nonzero(hopeless) < min_count:
        return np.ones(len(attributes), dtype=bool)
    return ~hopeless


def distance_ratio(nearest: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float32]:
    """Ratio (M,) of nearest to second nearest descriptor distance, 0 … 1; NaN where one is NaN.

    Two candidates at distance zero cannot be told apart: their ratio is 1.
    """
    known = np.isfinite(nearest) & np.isfinite(second)
    ambiguous = known & (second <= 0)
    with np.errstate(over="ignore"):
        ratio = np.divide(nearest, second, out=np.full(len(nearest), np.nan), where=known & ~ambiguous)
    return np.where(ambiguous, 1.0, np.clip(ratio, 0.0, 1.0)).astype(np.float32)


def best_of_list(index2: NDArray[np.intp], distance: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """True (M,) where no other match reaches the same keypoint of image 2 at a smaller distance.

    Returns None where the distances say nothing: some are missing, or several matches all have the same.
    """
    present = index2 >= 0
    known = distance[present]
    if not present.any() or not np.isfinite(known).all() or (len(known) > 1 and np.ptp(known) == 0):
        return None
    smallest = np.full(int(index2.max()) + 1, np.inf)
    np.minimum.at(smallest, index2[present], known)
    best = np.zeros(len(index2), dtype=bool)
    best[present] = known <= smallest[index2[present]]
    return best
