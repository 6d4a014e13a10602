"""Counts of right and wrong matches over the scores: what precision–recall curves and reliability are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

LOGIT_EDGES = tuple(float(edge) for edge in np.arange(-10.0, 10.01, 0.5))
"""Thresholds of the precision–recall curve; counts hold one bin more: what lies below the first edge, and so on."""

PROBABILITY_BINS = 15


@dataclass(frozen=True)
class ScoreCounts:
    """Histograms of one pair's matches.

    Attributes:
        right, wrong: true and false matches by logit: below the first of :data:`LOGIT_EDGES`, between two, above all.
        bin_count, bin_right, bin_sum: matches, true matches and sum of the probabilities in each of 15 equal bins of
            probability.
    """

    right: tuple[int, ...]
    wrong: tuple[int, ...]
    bin_count: tuple[int, ...]
    bin_right: tuple[int, ...]
    bin_sum: tuple[float, ...]

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> ScoreCounts:
        """Counts from the fields that ``dataclasses.asdict`` gave."""
        return cls(**{name: tuple(values) for name, values in fields.items()})


def count_scores(logits: ArrayLike, probabilities: ArrayLike, truth: ArrayLike) -> ScoreCounts:
    """Histograms of M matches: ``logits`` and ``probabilities`` (M,), ``truth`` bool (M,)."""
    logits, truth = np.asarray(logits, dtype=np.float64), np.asarray(truth, dtype=bool)
    probabilities = np.asarray(probabilities, dtype=np.float64)
    # A match counts at a threshold when its logit is above it, not at it.
    place = np.searchsorted(LOGIT_EDGES, logits, side="left")
    index = np.minimum((probabilities * PROBABILITY_BINS).astype(int), PROBABILITY_BINS - 1)
    logit_bins = len(LOGIT_EDGES) + 1
    return ScoreCounts(
        right=_integers(np.bincount(place[truth], minlength=logit_bins)),
        wrong=_integers(np.bincount(place[~truth], minlength=logit_bins)),
        bin_count=_integers(np.bincount(index, minlength=PROBABILITY_BINS)),
        bin_right=_integers(np.bincount(index[truth], minlength=PROBABILITY_BINS)),
        bin_sum=tuple(round(float(v), 4) for v in np.bincount(index, probabilities, minlength=PROBABILITY_BINS)),
    )


def _integers(values: NDArray[np.intp]) -> tuple[int, ...]:
    return tuple(int(value) for value in values)


def precision_recall_curve(pairs: Sequence[ScoreCounts]) -> tuple[FloatArray, FloatArray]:
    """Precision and recall at each of :data:`LOGIT_EDGES`, the matches of all pairs together.

    Precision is NaN where nothing is accepted, recall where there is no true match.
    """
    right, wrong = (np.sum([getattr(pair, side) for pair in pairs], axis=0) for side in ("right", "wrong"))
    # What lies above edge e: the bins e + 1, e + 2, …
    kept_right, kept_wrong = (np.cumsum(side[::-1])[::-1][1:].astype(float) for side in (right, wrong))
    with np.errstate(invalid="ignore"):
        return kept_right / (kept_right + kept_wrong), kept_right / float(right.sum())


def reliability(pairs: Sequence[ScoreCounts]) -> list[dict[str, float]]:
    """Mean probability and share of true matches in each bin of probability that holds matches, all pairs together."""
    count, right, total = (
        np.sum([getattr(p, f"bin_{name}") for p in pairs], axis=0) for name in ("count", "right", "sum")
    )
    return [
        {
            "probability": float(total[i] / count[i]),
            "share_right": float(right[i] / count[i]),
            "matches": int(count[i]),
        }
        for i in np.flatnonzero(count)
    ]
