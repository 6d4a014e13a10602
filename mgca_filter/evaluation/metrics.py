"""Figures of the field's relative-pose protocol, in plain numpy.

Pose errors are degrees; a pair without a pose has :data:`FAILURE_DEG`. Errors of a method on one scene come as
(S, P): S runs of a randomised estimator with different seeds over P pairs. Every figure is computed per run and
averaged over the runs. Shares and areas are 0 … 1 here; :mod:`report` prints them in per cent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
Statistic = Callable[[FloatArray], float]
SceneErrors = Mapping[str, FloatArray]

FAILURE_DEG = 180.0
MAP_STEP_DEG = 5
PAPER_LOGIT = 2.0
"""Logit above which the published evaluations of this family accept a match."""

TRUE_INLIER_DISTANCE_SQUARED = 1e-4
"""Squared symmetric epipolar distance on the normalised planes below which a match counts as a true inlier."""


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


def share_below(errors_deg: ArrayLike, limit_deg: float) -> float:
    """Share of the pairs whose pose error is below ``limit_deg``, 0 … 1."""
    return float(np.mean(np.asarray(errors_deg, dtype=np.float64) < limit_deg))


def mean_average_precision(errors_deg: ArrayLike, limit_deg: int) -> float:
    """mAP@limit: mean of the shares below 5, 10, … ``limit_deg`` degrees (so mAP@5 is the share below 5).

    Args:
        errors_deg: pose errors, any shape; seeds and pairs weigh the same.
        limit_deg: a multiple of 5.

    Raises:
        ValueError: ``limit_deg`` is not a positive multiple of 5.
    """
    if limit_deg < MAP_STEP_DEG or limit_deg % MAP_STEP_DEG:
        raise ValueError(f"limit_deg must be a positive multiple of {MAP_STEP_DEG}, got {limit_deg}")
    limits = range(MAP_STEP_DEG, limit_deg + 1, MAP_STEP_DEG)
    return float(np.mean([share_below(errors_deg, limit) for limit in limits]))


def area_under_recall(errors_deg: ArrayLike, limit_deg: float) -> float:
    """AUC@limit: exact area under the recall curve up to ``limit_deg``, divided by it, 0 … 1.

    The curve of SuperGlue (Sarlin et al., CVPR 2020): straight lines from (0, 0) through (i-th smallest error, i / P),
    level from the last error below the limit up to it. (S, P) errors give the mean over S.
    """
    runs = np.atleast_2d(np.asarray(errors_deg, dtype=np.float64))
    areas = []
    for errors in np.sort(runs, axis=1):
        below = errors[errors < limit_deg]
        recall = np.arange(len(below) + 1) / len(errors)
        x = np.concatenate([[0.0], below, [limit_deg]])
        y = np.append(recall, recall[-1])
        areas.append(np.sum(np.diff(x) * (y[1:] + y[:-1])) / 2.0)
    return float(np.mean(areas) / limit_deg)


def median_error(errors_deg: ArrayLike) -> float:
    """Median over the pairs, mean over the runs, degrees."""
    return float(np.mean(np.median(np.atleast_2d(np.asarray(errors_deg, dtype=np.float64)), axis=1)))


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
    return float(np.mean([statistic(scene_errors) for scene_errors in errors.values()]))


def pool_pairs(errors: SceneErrors) -> FloatArray:
    """All scenes' errors side by side, (S, sum of P): what the mean over pairs is computed on."""
    return np.concatenate([np.atleast_2d(scene_errors) for scene_errors in errors.values()], axis=1)


def mean_over_pairs(statistic: Statistic, errors: SceneErrors) -> float:
    """The figure over the pairs of all scenes together, each pair weighing the same."""
    return statistic(pool_pairs(errors))


def bootstrap_interval(
    errors: SceneErrors, statistic: Statistic, *, replicates: int = 1000, level: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean over scenes.

    Pairs are drawn with replacement within their scene: the interval speaks of the chance in the choice of pairs, the
    scenes being what they are. All runs (seeds) of a drawn pair come along.
    """
    values = _replicate_means([errors], statistic, replicates, seed)[0]
    return _percentile_interval(values, level)


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

    Both methods are seen on the same drawn pairs each time, so that what makes a pair hard for both cancels out.

    Raises:
        ValueError: the two do not cover the same scenes and pairs.
    """
    if list(errors) != list(baseline):
        raise ValueError(f"scenes differ: {', '.join(errors)} against {', '.join(baseline)}")
    for scene in errors:
        if np.atleast_2d(errors[scene]).shape[1] != np.atleast_2d(baseline[scene]).shape[1]:
            raise ValueError(f"scene {scene}: the two methods were run on different numbers of pairs")
    ours, theirs = _replicate_means([errors, baseline], statistic, replicates, seed)
    return _percentile_interval(ours - theirs, level)


def _replicate_means(methods: Sequence[SceneErrors], statistic: Statistic, replicates: int, seed: int) -> FloatArray:
    """Means over scenes (methods, replicates) on resampled pairs, the same resample for every method."""
    generator = np.random.default_rng(seed)
    means = np.zeros((len(methods), replicates))
    scenes = list(methods[0])
    for scene in scenes:
        runs = [np.atleast_2d(method[scene]) for method in methods]
        count = runs[0].shape[1]
        for r in range(replicates):
            rows = generator.integers(0, count, size=count)
            for m, errors in enumerate(runs):
                means[m, r] += statistic(errors[:, rows]) / len(scenes)
    return means


def _percentile_interval(values: FloatArray, level: float) -> tuple[float, float]:
    tail = 50.0 * (1.0 - level)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)
