"""Quick look at a network on real pairs while it trains; the evaluation package has the last word."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ..correspondences import candidate_mask, mean_focal_length
from ..epipolar import pose_error_deg, symmetric_epipolar_distance_squared
from ..evaluation.metrics import (
    FAILURE_DEG,
    TRUE_INLIER_DISTANCE_SQUARED,
    mean_average_precision,
    precision_recall_f,
)
from ..network import MGCANet
from ..ranking import RankedMatches, match_order
from ..robust_fit import estimate_pose, pose_from_essential
from ..scene_bundle import SceneBundle, ScenePair
from .sources.bundles import is_held_out


class PairSequence(Protocol):
    """Pairs by number, such as a :class:`SceneBundle` has them."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> ScenePair: ...


def select_pairs(bundles: Sequence[PairSequence], per_scene: int) -> list[ScenePair]:
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


def quick_validation(network: MGCANet, pairs: Iterable[ScenePair]) -> dict[str, float]:
    """Mean precision and recall at logit > 0, mAP@5 and mAP@20 (percent) of the robust fit and of E alone.

    Precision and recall count all raw matches; pairs, not scenes, are averaged.
    """
    network.eval()
    rows = [_evaluate_pair(network, pair) for pair in pairs]
    precision, recall, fit, own = np.array(rows, dtype=np.float64).T
    result = {"precision": precision.mean(), "recall": recall.mean()}
    for name, errors in (("fit", fit), ("essential", own)):
        for limit in (5, 20):
            result[f"{name}_mAP@{limit}"] = mean_average_precision(errors, limit)
    return {name: 100.0 * float(value) for name, value in result.items()}


@torch.inference_mode()
def _evaluate_pair(network: MGCANet, pair: ScenePair) -> tuple[float, float, float, float]:
    encoded = pair.attributes.encode(len(pair.points1))
    rows = np.flatnonzero(candidate_mask(encoded))
    x, attributes = pair.correspondences[rows], encoded[rows]
    output = network(torch.from_numpy(x.astype(np.float32))[None], torch.from_numpy(attributes)[None])
    logits = output.logits[0].numpy()
    truth = symmetric_epipolar_distance_squared(pair.correspondences, pair.E) < TRUE_INLIER_DISTANCE_SQUARED
    accepted = np.zeros(len(truth), dtype=bool)
    accepted[rows] = logits > 0
    precision, recall, _ = precision_recall_f(accepted, truth)
    scores = 1.0 / (1.0 + np.exp(-np.clip(logits, -60.0, 60.0)))
    order = match_order(scores, attributes[:, 0], attributes[:, 5] > 0)
    fit = estimate_pose(RankedMatches.of(x, order, scores, logits), mean_focal_length(pair.K1, pair.K2))
    best = np.argsort(-logits)[: max(len(logits) // 10, 8)]
    own = pose_from_essential(output.essential[0].numpy().astype(np.float64), x[best])
    return precision, recall, _error(fit, pair), _error(own, pair)


def _error(pose: tuple[NDArray[np.float64], NDArray[np.float64]] | None, pair: ScenePair) -> float:
    return FAILURE_DEG if pose is None else pose_error_deg(*pose, pair.R, pair.t)
