"""Logits to probabilities: Platt scaling fitted on real pairs, and how far it can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..data.scene_bundle import ScenePair
from ..evaluation.methods import BoolArray, FloatArray
from ..evaluation.metrics import TRUE_INLIER_DISTANCE_SQUARED
from ..geometry.epipolar import symmetric_epipolar_distance_squared
from ..inference.calibration import Calibration, sigmoid
from ..match_filter import MatchFilter

_NEWTON_STEPS = 50
_RIDGE = 1e-9


def collect_logits(model: str | Path, pairs: Sequence[ScenePair]) -> tuple[list[FloatArray], list[BoolArray]]:
    """Logits (M,) of all raw matches of each pair, as the filter gives them, and which are inliers (M,)."""
    match_filter = MatchFilter(model=model, method="none")
    logits, truth = [], []
    for pair in pairs:
        result = match_filter.filter(
            pair.points1, pair.points2, None, K1=pair.K1, K2=pair.K2, attributes=pair.attributes
        )
        logits.append(np.asarray(result.info["logits"], dtype=np.float64))
        distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
        truth.append(np.asarray(distance < TRUE_INLIER_DISTANCE_SQUARED))
    return logits, truth


def fit_calibration(logits: FloatArray, truth: BoolArray) -> Calibration:
    """Scale and offset that maximise the likelihood of the truth (Platt 1999), by Newton's method.

    Args:
        logits: (N,) finite. truth: (N,) inlier or not.

    Raises:
        ValueError: all matches are of one kind.
    """
    if truth.all() or not truth.any():
        raise ValueError("calibration needs inliers and outliers")
    design = np.column_stack([logits, np.ones(len(logits))])
    parameters = np.array([1.0, 0.0])
    for _ in range(_NEWTON_STEPS):
        p = sigmoid(design @ parameters)
        gradient = design.T @ (p - truth) / len(p)
        hessian = (design * (p * (1.0 - p))[:, None]).T @ design / len(p) + _RIDGE * np.eye(2)
        step = np.linalg.solve(hessian, gradient)
        parameters = parameters - step
        if np.abs(step).max() < 1e-8:
            break
    return Calibration(scale=float(parameters[0]), offset=float(parameters[1]))


def expected_calibration_error(probabilities: FloatArray, truth: BoolArray, bins: int = 15) -> float:
    """Mean gap between probability and frequency over equal bins of probability, weighted by their matches.

    Naeini et al., AAAI 2015; ``probabilities`` and ``truth`` (N,).
    """
    index = np.minimum((np.asarray(probabilities) * bins).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)
    gap = np.bincount(index, probabilities, bins) - np.bincount(index, truth.astype(float), bins)
    return float(np.abs(gap).sum() / max(count.sum(), 1))
