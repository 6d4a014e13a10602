"""How a network does on real pairs: the filter around the network in memory, judged by the evaluation's metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..data import PairSource
from ..data.scene_bundle import SceneBundle, ScenePair
from ..evaluation.metrics import (
    FAILURE_DEG,
    TRUE_INLIER_DISTANCE_SQUARED,
    area_under_recall,
    mean_average_precision,
    precision_recall_f,
)
from ..evaluation.our_rows import pose_without_ransac
from ..geometry.epipolar import pose_error_deg, symmetric_epipolar_distance_squared
from ..inference.network_backend import NetworkBackend
from ..inputs.attributes import MatchAttributes
from ..match_filter import MatchFilter
from ..network import MGCANet
from .sources import is_held_out

InputList = tuple[NDArray[np.intp], MatchAttributes]
"""The list that a caller arrives with: rows (M,) of a pair's matches, and what is still known of them."""
RATIO_TEST = 0.75


def raw(pair: ScenePair) -> InputList:
    """``knnMatch`` output: every match, with all that is known of it."""
    return np.arange(len(pair.mutual)), pair.attributes


def ratio_tested(pair: ScenePair) -> InputList:
    """The usual loop over ``knnMatch`` with 0.75: what it leaves is a flat list, and the ratio is gone."""
    assert pair.attributes.ratio is not None
    rows = np.flatnonzero(pair.attributes.ratio < RATIO_TEST)
    return rows, replace(pair.attributes.take(rows), ratio=None)


def cross_checked(pair: ScenePair) -> InputList:
    """``BFMatcher(crossCheck=True)``: two-way nearest neighbours without ratios."""
    rows = np.flatnonzero(pair.mutual)
    return rows, replace(pair.attributes.take(rows), ratio=None)


def bare_points(pair: ScenePair) -> InputList:
    """Two arrays of points and nothing else."""
    return np.arange(len(pair.mutual)), MatchAttributes()


INPUT_KINDS: dict[str, Callable[[ScenePair], InputList]] = {
    "raw": raw,
    "ratio 0.75": ratio_tested,
    "cross-check": cross_checked,
    "bare points": bare_points,
}


def select_pairs(bundles: Sequence[SceneBundle | PairSource], per_scene: int) -> list[ScenePair]:
    """At most ``per_scene`` pairs of each scene, evenly spaced."""
    chosen = []
    for bundle in bundles:
        indices = np.unique(np.linspace(0, len(bundle) - 1, min(per_scene, len(bundle))).astype(int))
        chosen += [bundle[int(index)] for index in indices]
    return chosen


def held_out_pairs(bundles: Sequence[SceneBundle], holdout_every: int, per_scene: int) -> list[ScenePair]:
    """At most ``per_scene`` of the pairs of each training scene that training never sees."""
    chosen = []
    for bundle in bundles:
        kept = [index for index in range(len(bundle)) if is_held_out(index, holdout_every)]
        places = np.unique(np.linspace(0, len(kept) - 1, min(per_scene, len(kept))).astype(int))
        chosen += [bundle[kept[int(place)]] for place in places]
    return chosen


@dataclass(frozen=True)
class PairFigures:
    """A network on one pair and one kind of input of M matches.

    Attributes:
        logits: (M,) float64, as the filter gives them; a match that never enters the network has the prior's, and never
            one above the decision threshold.
        truth: (M,) bool, within 1e-4 of the true epipolar geometry.
        fit_deg: pose error of the filter's answer; 180 where it has none.
        essential_deg: pose error of the network's essential matrix alone, without a robust fit; likewise.
    """

    logits: NDArray[np.float64]
    truth: NDArray[np.bool_]
    fit_deg: float
    essential_deg: float

    def at(self, threshold: float) -> tuple[float, float, float]:
        """Precision, recall and F-measure of the matches whose logit is above ``threshold``."""
        return precision_recall_f(self.logits > threshold, self.truth)


def quick_validation(network: MGCANet, pairs: Iterable[ScenePair]) -> dict[str, float]:
    """Figures of a network on raw matches, in per cent: see :func:`summarize`."""
    match_filter = MatchFilter.over(NetworkBackend(network))
    return summarize([evaluate_pair(match_filter, pair) for pair in pairs])


def summarize(figures: Sequence[PairFigures]) -> dict[str, float]:
    """Mean precision, recall and F at logit > 0, mAP@5, mAP@20 and AUC@5 of the filter and of network E, per cent.

    Precision and recall count all matches of the input; pairs, not scenes, are averaged.
    """
    precision, recall, f_measure = np.mean([pair.at(0.0) for pair in figures], axis=0)
    result = {"precision": precision, "recall": recall, "F": f_measure}
    for name, errors in (("fit", [p.fit_deg for p in figures]), ("essential", [p.essential_deg for p in figures])):
        for limit in (5, 20):
            result[f"{name}_mAP@{limit}"] = mean_average_precision(errors, limit)
        result[f"{name}_AUC@5"] = area_under_recall(errors, 5.0)
    return {name: 100.0 * float(value) for name, value in result.items()}


def evaluate_pair(match_filter: MatchFilter, pair: ScenePair, given: InputList | None = None) -> PairFigures:
    """Filter the matches of a pair that ``given`` names (None = all, with all that is known of them)."""
    rows, attributes = raw(pair) if given is None else given
    result = match_filter.filter(
        pair.points1[rows],
        pair.points2[rows],
        None,
        K1=pair.K1,
        K2=pair.K2,
        size1=pair.image_size1,
        size2=pair.image_size2,
        attributes=attributes,
    )
    x, logits = pair.correspondences[rows], np.asarray(result.info["logits"], dtype=np.float64)
    alone = pose_without_ransac(result.info["network_essential"], logits, x[:, :2], x[:, 2:])
    return PairFigures(
        logits,
        symmetric_epipolar_distance_squared(x, pair.E) < TRUE_INLIER_DISTANCE_SQUARED,
        _error(result.R, result.t, pair),
        _error(alone.R, alone.t, pair),
    )


def _error(R: NDArray[np.float64] | None, t: NDArray[np.float64] | None, pair: ScenePair) -> float:
    return FAILURE_DEG if R is None or t is None else pose_error_deg(R, t, pair.R, pair.t)
