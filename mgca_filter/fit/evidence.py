"""What is known of a pair before a model is fitted: distinct matches, their order, what the network says of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..inputs.attributes import Column
from ..inputs.pair import PairInput

Array = NDArray[np.float64]

# A pose has five degrees of freedom: the sixth match is the first that bears it out. With so many as the second number
# a fundamental matrix can be told as well, and inliers are enough however long the list is.
MIN_MATCHES, FIRM_MATCHES = 6, 8
# Matches that the network gives this probability are accepted; with fewer than so many the best-scored stand in.
ACCEPTED_SCORE, MIN_ACCEPTED = 0.3, 32
# Of a raw list, where several matches reach for one keypoint, classical pipelines keep the best with a ratio below.
RAW_MAX_RATIO = 0.9


@dataclass(frozen=True)
class Evidence:
    """N distinct matches, the most promising first.

    Attributes:
        rows: (N,) where each stands in the list that it comes from.
        correspondences: (N, 4) on the normalised image planes, finite; sources sample from all of them.
        once: (N,) bool, those whose keypoints stand in no better one: refinement and choice count these alone, since
            several matches of one keypoint bear witness once.
        listed: (N,) bool, what a classical pipeline would fit to: all of a filtered list, of a raw one the best of
            the list with a ratio below 0.9.
        order: (N,) ascending = promising without a network: ratio or descriptor distance; NaN = unknown.
        noise: (N,) of the positions, by the sizes of the keypoints; 1 = usual in the list.
        focal_px: mean focal length, pixels.
        calibrated: the intrinsics can be trusted.
        scores: (N,) probabilities of the network; None before it has run.
        margins: (N,) logits above the decision threshold, which tell saturated scores apart; None likewise.
        network_essential: (3, 3), or None.
    """

    rows: NDArray[np.intp]
    correspondences: Array
    once: NDArray[np.bool_]
    listed: NDArray[np.bool_]
    order: Array
    noise: Array
    focal_px: float
    calibrated: bool = True
    scores: Array | None = None
    margins: Array | None = None
    network_essential: NDArray[np.floating[Any]] | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def by_list_order(self) -> Array:
        """Listed matches (K, 4) in the order that is known without a network."""
        rows = np.flatnonzero(self.listed)
        return self.correspondences[rows[np.argsort(np.nan_to_num(self.order[rows], nan=np.inf), kind="stable")]]

    def accepted(self) -> NDArray[np.intp]:
        """Positions that the network accepts, best first; the listed ones before it has run."""
        if self.scores is None:
            return np.flatnonzero(self.listed)
        chosen = np.flatnonzero(self.scores > ACCEPTED_SCORE)
        return chosen if len(chosen) >= MIN_ACCEPTED else self.above(np.inf)

    def above(self, margin: float) -> NDArray[np.intp]:
        """Positions whose logit lies above the decision threshold by more, best first; else the 32 best-scored."""
        if self.margins is None:
            return np.flatnonzero(self.listed)
        chosen = np.flatnonzero(self.margins > margin)
        if len(chosen) >= MIN_ACCEPTED:
            return chosen
        return np.sort(np.argsort(-self.margins, kind="stable")[:MIN_ACCEPTED])


def gather_before(pair: PairInput) -> Evidence:
    """The listed matches of a pair, in the order that is known without a network."""
    listed = listed_rows(pair.attributes, pair.valid)
    rows = np.flatnonzero(listed)
    rows = rows[np.argsort(np.nan_to_num(pair.order[rows], nan=np.inf), kind="stable")]
    rows = rows[first_of_each(pair.correspondences[rows])]
    correspondences = pair.correspondences[rows]
    return Evidence(
        rows,
        correspondences,
        one_to_one(correspondences),
        np.ones(len(rows), dtype=bool),
        pair.order[rows],
        pair.noise[rows],
        pair.focal_px,
        pair.calibrated,
    )


def gather_scored(
    pair: PairInput,
    candidates: NDArray[np.intp],
    scores: NDArray[np.float32],
    margins: NDArray[np.float32],
    network_essential: NDArray[np.floating[Any]] | None,
) -> Evidence:
    """The matches that the network saw, best first.

    Args:
        pair: M matches. candidates: (N,) rows that entered the network.
        scores, margins: (M,) probabilities, and logits above the decision threshold.
        network_essential: (3, 3), or None.
    """
    attributes = pair.attributes[candidates]
    ratio, known = attributes[:, Column.RATIO], attributes[:, Column.RATIO_KNOWN] > 0
    rows = candidates[match_order(margins[candidates], ratio, known)]
    rows = rows[first_of_each(pair.correspondences[rows])]
    correspondences = pair.correspondences[rows]
    return Evidence(
        rows,
        correspondences,
        one_to_one(correspondences),
        listed_rows(pair.attributes, pair.valid)[rows],
        pair.order[rows],
        pair.noise[rows],
        pair.focal_px,
        pair.calibrated,
        scores[rows].astype(np.float64),
        margins[rows].astype(np.float64),
        network_essential,
    )


def listed_rows(attributes: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Matches (M,) that a classical pipeline would fit to, from encoded attributes (M, 8).

    A list in which no two matches reach for the same keypoint was filtered by somebody who knew why: all of it counts.
    """
    best_known = attributes[:, Column.BEST_KNOWN] > 0
    lost = best_known & (attributes[:, Column.BEST] == 0)
    if not (lost & valid).any():
        return valid
    ambiguous = (attributes[:, Column.RATIO_KNOWN] > 0) & (attributes[:, Column.RATIO] >= RAW_MAX_RATIO)
    kept = valid & ~lost & ~ambiguous
    return kept if np.count_nonzero(kept) >= FIRM_MATCHES else valid


def match_order(
    margins: NDArray[np.floating[Any]], ratio: NDArray[np.floating[Any]], ratio_known: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Rows of the matches (N,), most promising first: the order in which PROSAC draws.

    Logits above the decision threshold, squashed, order badly where they saturate; the descriptor ratio, where it
    is known, tells such matches apart.
    """
    score = 1.0 / (1.0 + np.exp(-np.clip(margins.astype(np.float64), -60.0, 60.0)))
    quality = score * np.where(ratio_known, 1.2 - ratio.astype(np.float64), 1.0)
    return np.argsort(-quality, kind="stable")


def one_to_one(correspondences: Array) -> NDArray[np.bool_]:
    """Of distinct matches (N, 4), best first, those (N,) whose points in either image stand in no better one."""
    rows = np.arange(len(correspondences))
    for columns in (slice(0, 2), slice(2, 4)):
        rows = rows[first_of_each(correspondences[rows, columns])]
    chosen = np.zeros(len(correspondences), dtype=bool)
    chosen[rows] = True
    return chosen


def first_of_each(rows: Array) -> NDArray[np.intp]:
    """Positions of the distinct rows of finite (N, D) in the order of the list; of equal rows the first counts."""
    column = np.sort(rows[:, 0])
    if (column[1:] != column[:-1]).all():
        return np.arange(len(rows))
    return np.sort(distinct_rows(rows))


def distinct_rows(rows: Array) -> NDArray[np.intp]:
    """Positions of the distinct rows of finite (N, D), ascending by value; of equal rows the first counts.

    ``np.unique`` does the same for rows in several times the time.
    """
    ascending = np.argsort(rows[:, 0])
    column = rows[ascending, 0]
    equal = np.zeros(len(rows) + 1, dtype=bool)  # to the row before
    equal[1:-1] = column[1:] == column[:-1]
    tied = equal[1:] | equal[:-1]
    if not tied.any():
        return ascending
    # The other columns matter among rows whose first is equal, which stand side by side.
    among = np.sort(ascending[tied])
    ascending[tied] = among[np.lexsort(rows[among].T[::-1])]  # stable: of equal rows the first stays first
    first = np.ones(len(rows), dtype=bool)
    first[1:] = np.any(rows[ascending[1:]] != rows[ascending[:-1]], axis=1)
    return ascending[first]
