"""Figures of the field's relative-pose protocol, and of the scores of matches, in plain numpy.

Pose errors are degrees; a pair without a pose has :data:`FAILURE_DEG`. Errors of a method on one scene come as
(S, P): S runs of a randomised estimator with different seeds over P pairs. Every figure is computed per run and
averaged over the runs; errors (…, S, P) give figures (…). Shares and areas are 0 … 1 here; :mod:`report` prints them
in per cent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.epipolar import symmetric_epipolar_distance_squared

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Figures = Any  # a float for errors (P,) or (S, P), an array (…) of them for errors (…, S, P)
Statistic = Callable[[FloatArray], Figures]
SceneErrors = Mapping[str, FloatArray]

FAILURE_DEG = 180.0
MAP_STEP_DEG = 5
PAPER_LOGIT = 2.0
"""Logit above which the published evaluations of this family accept a match."""

_REPLICATES_AT_ONCE = 50

TRUE_INLIER_DISTANCE_SQUARED = 1e-4
"""Squared symmetric epipolar distance on the normalised planes below which a match counts as a true inlier."""


def true_matches(correspondences: FloatArray, E: FloatArray) -> BoolArray:
    """Bool (M,), True for matches (M, 4) on the normalised planes that lie near the true epipolar lines of E (3, 3)."""
    distance = symmetric_epipolar_distance_squared(correspondences, E)
    return np.asarray(distance < TRUE_INLIER_DISTANCE_SQUARED)


def precision_recall_f(kept: ArrayLike, truth: ArrayLike) -> tuple[float, float, float]:
    """Precision, recall and F-measure of one pair's kept matches.

    Args:
        kept: bool (M,), True where a match was accepted.
        truth: bool (M,), True where it is an inlier.

    A quotient without denominator (nothing kept, no inlier there) counts as 0, so that no pair drops out of the mean.
    """
    kept, truth = np.asarray(kept, dtype=bool), np.asarray(truth, dtype=bool)
    if kept.shape != truth.shape:
        raise ValueError(f"kept {kept.shape} and truth {truth.shape} differ in shape")
    correct, accepted, inliers = (int(np.count_nonzero(flags)) for flags in (kept & truth, kept, truth))
    precision = correct / max(accepted, 1)
    recall = correct / max(inliers, 1)
    f_measure = 2.0 * precision * recall / (precision + recall) if correct else 0.0
    return precision, recall, f_measure


def mean_of_the_nonzero(values: ArrayLike) -> tuple[float, int]:
    """Mean of the pairs' values without those that are 0 or NaN, and how many were left out.

    So the published figures average precision, recall and F. It rewards a method that accepts nothing on hard pairs;
    none of the honest figures uses it. Without a value left the mean is 0.
    """
    array = np.asarray(values, dtype=np.float64)
    counted = array[np.isfinite(array) & (array != 0)]
    return (float(counted.mean()) if len(counted) else 0.0), len(array) - len(counted)


def _runs(errors_deg: ArrayLike) -> FloatArray:
    """Errors (P,) or (…, S, P) as (…, S, P)."""
    return np.atleast_2d(np.asarray(errors_deg, dtype=np.float64))


def share_below(errors_deg: ArrayLike, limit_deg: float) -> Figures:
    """Share of the pairs whose pose error is below ``limit_deg``, 0 … 1."""
    return np.mean(_runs(errors_deg) < limit_deg, axis=(-2, -1))


def mean_average_precision(errors_deg: ArrayLike, limit_deg: int) -> Figures:
    """mAP@limit: mean of the shares below 5, 10, … ``limit_deg`` degrees (so mAP@5 is the share below 5).

    Args:
        errors_deg: pose errors (P,) or (…, S, P).
        limit_deg: a multiple of 5.

    Raises:
        ValueError: ``limit_deg`` is not a positive multiple of 5.
    """
    if limit_deg < MAP_STEP_DEG or limit_deg % MAP_STEP_DEG:
        raise ValueError(f"limit_deg must be a positive multiple of {MAP_STEP_DEG}, got {limit_deg}")
    limits = range(MAP_STEP_DEG, limit_deg + 1, MAP_STEP_DEG)
    return np.mean([share_below(errors_deg, limit) for limit in limits], axis=0)


def area_under_recall(errors_deg: ArrayLike, limit_deg: float) -> Figures:
    """AUC@limit: exact area under the recall curve up to ``limit_deg``, divided by it, 0 … 1.

    The curve of SuperGlue (Sarlin et al., CVPR 2020): straight lines from (0, 0) through (i-th smallest error, i / P),
    level from the last error below the limit up to it.
    """
    runs = _runs(errors_deg)
    below = runs < limit_deg
    # Summed by parts, the trapezoids give every error e below the limit (limit − e) / P, as steps would, and half the
    # largest of them besides, which is what the slopes between the steps add up to.
    steps = np.where(below, limit_deg - runs, 0.0).sum(axis=-1)
    largest = np.where(below, runs, 0.0).max(axis=-1)
    return np.mean(steps + largest / 2.0, axis=-1) / (runs.shape[-1] * limit_deg)


def median_error(errors_deg: ArrayLike) -> Figures:
    """Median over the pairs, mean over the runs, degrees."""
    return np.mean(np.median(_runs(errors_deg), axis=-1), axis=-1)


POSE_STATISTICS: dict[str, Statistic] = {
    "mAP@5": lambda errors: mean_average_precision(errors, 5),
    "mAP@10": lambda errors: mean_average_precision(errors, 10),
    "mAP@15": lambda errors: mean_average_precision(errors, 15),
    "mAP@20": lambda errors: mean_average_precision(errors, 20),
    "AUC@5": lambda errors: area_under_recall(errors, 5.0),
    "AUC@10": lambda errors: area_under_recall(errors, 10.0),
    "AUC@20": lambda errors: area_under_recall(errors, 20.0),
}


def mean_over_scenes(statistic: Statistic, errors: SceneErrors) -> float:
    """The headline: mean of the scenes' figures, each scene weighing the same whatever its size."""
    return float(np.mean([statistic(np.atleast_2d(scene_errors)) for scene_errors in errors.values()]))


def pool_pairs(errors: SceneErrors) -> FloatArray:
    """All scenes' errors side by side, (S, sum of P): what the mean over pairs is computed on."""
    return np.concatenate([np.atleast_2d(scene_errors) for scene_errors in errors.values()], axis=1)


def mean_over_pairs(statistic: Statistic, errors: SceneErrors) -> float:
    """The figure over the pairs of all scenes together, each pair weighing the same."""
    return float(statistic(pool_pairs(errors)))


def paired_bootstrap_interval(
    errors: SceneErrors,
    baseline: SceneErrors,
    statistic: Statistic,
    *,
    replicates: int = 1000,
    level: float = 0.95,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of the difference ``errors`` − ``baseline`` of the means over scenes.

    Pairs are drawn with replacement within their scene: the interval speaks of the chance in the choice of pairs, the
    scenes being what they are. All runs (seeds) of a drawn pair come along. Both methods are seen on the same drawn
    pairs each time, so that what makes a pair hard for both cancels out.

    Raises:
        ValueError: the two do not cover the same scenes and pairs.
    """
    if list(errors) != list(baseline):
        raise ValueError(f"scenes differ: {', '.join(errors)} against {', '.join(baseline)}")
    for scene in errors:
        if np.atleast_2d(errors[scene]).shape[1] != np.atleast_2d(baseline[scene]).shape[1]:
            raise ValueError(f"scene {scene}: the two methods were run on different numbers of pairs")
    ours, theirs = (resampled_figures(e, statistic, replicates=replicates, seed=seed) for e in (errors, baseline))
    return percentile_interval((ours - theirs).mean(axis=0), level)


def resampled_figures(errors: SceneErrors, statistic: Statistic, *, replicates: int, seed: int) -> FloatArray:
    """The scenes' figures (scenes, replicates) on pairs drawn with replacement within their scene.

    Methods that were run on the same pairs see the same draws under the same seed.
    """
    generator = np.random.default_rng(seed)
    figures = np.zeros((len(errors), replicates))
    for scene, scene_errors in enumerate(errors.values()):
        runs = np.atleast_2d(scene_errors)
        count = runs.shape[1]
        for first in range(0, replicates, _REPLICATES_AT_ONCE):
            last = min(first + _REPLICATES_AT_ONCE, replicates)
            rows = generator.integers(0, count, size=(last - first, count))
            figures[scene, first:last] = statistic(np.moveaxis(runs[:, rows], 0, 1))  # (replicates, S, P)
    return figures


def percentile_interval(values: FloatArray, level: float = 0.95) -> tuple[float, float]:
    """The interval that holds the share ``level`` of the values, equal shares outside on both sides."""
    tail = 50.0 * (1.0 - level)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)


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
    def from_json(cls, fields: Mapping[str, Any]) -> ScoreCounts:
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


@dataclass(frozen=True)
class ReliabilityBin:
    """Matches whose probability lies in one bin: its mean, 0 … 1, the share of true ones, and how many there are."""

    probability: float
    share_right: float
    matches: int


def reliability(pairs: Sequence[ScoreCounts]) -> list[ReliabilityBin]:
    """Mean probability and share of true matches in each bin of probability that holds matches, all pairs together."""
    count, right, total = (
        np.sum([getattr(p, f"bin_{name}") for p in pairs], axis=0) for name in ("count", "right", "sum")
    )
    return [
        ReliabilityBin(float(total[i] / count[i]), float(right[i] / count[i]), int(count[i]))
        for i in np.flatnonzero(count)
    ]


def calibration_gap(bins: Sequence[ReliabilityBin]) -> float:
    """Expected calibration error: mean distance of probability and share of true ones, bins weighted by size; 0 empty.

    Naeini et al., AAAI 2015.
    """
    total = sum(one.matches for one in bins)
    gap = sum(one.matches * abs(one.probability - one.share_right) for one in bins)
    return gap / total if total else 0.0


def area_under_roc(values: ArrayLike, truth: ArrayLike) -> float:
    """Probability that a true one has the higher of two values, 0 … 1, ties counting half; NaN without both kinds.

    Args:
        values: (N,). truth: bool (N,).
    """
    values, truth = np.asarray(values, dtype=np.float64), np.asarray(truth, dtype=bool)
    right, wrong = np.sort(values[truth]), np.sort(values[~truth])
    if not len(right) or not len(wrong):
        return float("nan")
    below, up_to = (np.searchsorted(wrong, right, side=side) for side in ("left", "right"))
    return float(np.mean(below + up_to) / (2.0 * len(wrong)))
