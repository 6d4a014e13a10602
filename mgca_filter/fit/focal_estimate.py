"""A focal length that both images share, from their matches alone: the one under which a pose agrees best.

A fundamental matrix of two views with otherwise known intrinsics determines it, unless the viewing axes are parallel
or meet (Hartley & Zisserman, 2nd ed., sec. 19.3; Sturm 2001). Poses are refined under focal lengths on a grid, and what
they leave of the matches, with a little belief in usual lenses, tells which is right and how surely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import project_to_essential, sampson_distance
from ..geometry.pose_refinement import refine_pose, truncated_cost
from .evidence import Evidence
from .robust_fit import REFINE_PX, TwoViewModel, pose_from_essential

Array = NDArray[np.float64]

# Factors on the guessed focal length that are tried: from extreme wide-angle lenses to telephoto ones.
_FACTORS = np.geomspace(0.25, 4.0, 19)
# Where cameras lie from the guess, in the logarithm: mean and standard deviation over the scenes of the training data.
_USUAL, _USUAL_SPREAD = -0.3, 0.35
_THRESHOLD_PX = 2.0
# What makes of the curvature a standard deviation that two thirds of the training pairs keep.
_SIGMA_FACTOR, _LEAST_SIGMA = 3.0, 0.04
# Under a focal length far from the right one matches lie this far off before the pose is refined.
_REACH_PX = 16.0
_ROUNDS = 6
_MAX_ROWS = 300
_MIN_ROWS = 12
# With this share of the matches that agree with F an essential matrix takes its place.
_LEAST_AGREEMENT = 0.8


@dataclass(frozen=True)
class FocalEstimate:
    """A focal length.

    Attributes:
        factor: on the guessed one.
        sigma: standard deviation of its logarithm: 0.1 is ten per cent.
    """

    factor: float
    sigma: float


def estimate_focal(evidence: Evidence, F: Array) -> FocalEstimate | None:
    """The focal length under which the matches agree best with a pose.

    Args:
        evidence: scored matches, on the image planes normalised by the guessed focal length.
        F: (3, 3) in the same coordinates.

    Returns:
        The estimate; None where the matches are few. Where they say little, the guess has the greater weight, and the
        standard deviation tells.
    """
    focal_px = evidence.focal_px
    agreeing = evidence.correspondences[evidence.above(0.0)]
    agreeing = agreeing[sampson_distance(agreeing, F) < REFINE_PX / focal_px]
    rows = agreeing[:: max(1, -(-len(agreeing) // _MAX_ROWS))]
    if len(rows) < _MIN_ROWS:
        return None
    costs = np.array([_cost_px(rows, F, factor, focal_px) for factor in _FACTORS])
    if not np.isfinite(costs).any():
        return None
    # The noise is what the best of them leaves.
    noise = max(float(np.nanmin(costs)) / len(rows), 0.1**2)
    logs = np.log(_FACTORS)
    penalised = np.where(np.isfinite(costs), costs / noise, np.inf) + ((logs - _USUAL) / _USUAL_SPREAD) ** 2
    best = int(np.clip(np.argmin(penalised), 1, len(logs) - 2))
    if not np.isfinite(penalised[best - 1 : best + 2]).all():
        return None
    curve = np.polyfit(logs[best - 1 : best + 2], penalised[best - 1 : best + 2], 2)
    if curve[0] <= 0:
        return None
    at = float(np.clip(-curve[1] / (2.0 * curve[0]), logs[best - 1], logs[best + 1]))
    # A sum of squares over the noise rises by one at a standard deviation, if matches were independent.
    return FocalEstimate(float(np.exp(at)), float(np.hypot(_SIGMA_FACTOR / np.sqrt(curve[0]), _LEAST_SIGMA)))


def agrees_as_well(evidence: Evidence, model: TwoViewModel, free: Evidence, free_model: TwoViewModel) -> bool:
    """True where nearly as many matches agree with an essential matrix as with the F that knows no intrinsics.

    Args:
        evidence, model: under the estimated focal length. free, free_model: under the guessed one.
    """
    counts = [
        np.count_nonzero(sampson_distance(e.correspondences[e.above(0.0)], m.M) < REFINE_PX / e.focal_px)
        for e, m in ((evidence, model), (free, free_model))
    ]
    return bool(counts[0] >= _LEAST_AGREEMENT * counts[1])


def _cost_px(rows: Array, F: Array, factor: float, focal_px: float) -> float:
    """Truncated squared Sampson errors in px², summed, of the best pose under ``factor`` times the guess."""
    zoom = np.diag([factor, factor, 1.0])
    scaled, focal = rows / factor, focal_px * factor
    pose = pose_from_essential(project_to_essential(zoom @ F @ zoom), scaled, focal / _REACH_PX)
    if pose is None:
        return float("inf")
    threshold = _THRESHOLD_PX / focal
    R, t = refine_pose(scaled, *pose, _REACH_PX / focal, _ROUNDS)
    R, t = refine_pose(scaled, R, t, threshold, _ROUNDS)
    return truncated_cost(scaled, R, t, threshold) * focal**2
