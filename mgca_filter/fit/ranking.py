"""Matches in the order in which the robust fit draws them, with what each counts when models are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import essential_from_pose, sampson_distance, triangulated_depths

Array = NDArray[np.float64]

# With fewer matches than this above a margin, the best-scored ones stand in.
MIN_FIT_MATCHES = 32


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


@dataclass(frozen=True)
class RankedMatches:
    """Distinct matches that may enter the fit, the most promising first.

    Attributes:
        rows: (N,) where each stands in the list that it comes from.
        correspondences: (N, 4) on the normalised image planes, finite.
        weights: (N,) what each adds to the support of a model that it agrees with: its probability.
        margins: (N,) its logit above the decision threshold.
    """

    rows: NDArray[np.intp]
    correspondences: Array
    weights: Array
    margins: Array

    @classmethod
    def of(
        cls,
        correspondences: Array,
        order: NDArray[np.intp],
        weights: NDArray[np.floating[Any]] | None = None,
        margins: NDArray[np.floating[Any]] | None = None,
    ) -> RankedMatches:
        """Rows ``order`` (K,) of ``correspondences`` (M, 4), best first; ``weights`` and ``margins`` are (M,).

        Without scores all matches count alike and every start sees all of them. A match that is listed ten
        times is there once.
        """
        order = order[np.sort(distinct_rows(correspondences[order]))]
        ones = np.ones(len(correspondences))
        weights, margins = (ones if values is None else values for values in (weights, margins))
        return cls(
            order,
            np.ascontiguousarray(correspondences[order], dtype=np.float64),
            np.asarray(weights[order], dtype=np.float64),
            np.asarray(margins[order], dtype=np.float64),
        )

    def above(self, margin: float) -> RankedMatches:
        """The matches above a margin, in order; the best-scored 32 where those are fewer."""
        chosen = self.margins > margin
        if np.count_nonzero(chosen) < MIN_FIT_MATCHES:
            chosen[np.argsort(-self.margins, kind="stable")[:MIN_FIT_MATCHES]] = True
        return RankedMatches(
            self.rows[chosen], self.correspondences[chosen], self.weights[chosen], self.margins[chosen]
        )

    def support(self, M: Array, threshold: float) -> float:
        """Summed weights of the matches that agree with ``M`` (3, 3), less the further off they are (MSAC)."""
        return float(self.weights @ self._agreement(M, threshold))

    def pose_support(self, R: Array, t: Array, threshold: float) -> float:
        """Support of a pose: as of its essential matrix, of the matches that lie in front of both cameras."""
        depth1, depth2 = triangulated_depths(self.correspondences, R, t)
        agreement = self._agreement(essential_from_pose(R, t), threshold)
        return float(self.weights @ (agreement * ((depth1 > 0) & (depth2 > 0))))

    def _agreement(self, M: Array, threshold: float) -> Array:
        return 1.0 - np.minimum(sampson_distance(self.correspondences, M) / threshold, 1.0) ** 2


def distinct_rows(rows: NDArray[np.float64]) -> NDArray[np.intp]:
    """Positions of the distinct rows of finite (N, D), ascending by value; of equal rows the first counts.

    ``np.unique`` does the same for rows in several times the time.
    """
    ascending = np.lexsort(rows.T[::-1])  # stable: of equal rows the first stays first
    first = np.ones(len(rows), dtype=bool)
    first[1:] = np.any(rows[ascending[1:]] != rows[ascending[:-1]], axis=1)
    return ascending[first]
