"""Do the matches agree with the focal length? The pose is refined under longer and shorter ones as well.

Two views determine a focal length that both share, unless the scene is a plane or the viewing axes are parallel or
meet (Hartley & Zisserman, 2nd ed., sec. 19.3; Sturm, 2001). There every focal length does about equally well, and the
rule stays silent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .epipolar import essential_from_pose, sampson_distance
from .pose_refinement import refine_pose, truncated_cost

Array = NDArray[np.float64]

FOCAL_STEP = 1.2
# Another focal length is believed where it lowers the truncated cost by this share of it, and by this many times the
# variance of the inliers' distances: the first keeps out distortion and other small errors of the camera model, which
# many matches make significant, the second chance. Set on the training scenes.
MIN_GAIN_SHARE = 0.15
MIN_GAIN_VARIANCES = 20.0
# The pose under another focal length lies further off than a fine threshold lets refinement see.
COARSE_FACTOR = 16.0
_COARSE_ROUNDS = 5
_MAX_ROWS = 500
_MAX_STEPS = 8


@dataclass(frozen=True)
class _Trial:
    """The pose that suits the given focal lengths times ``factor``, and its cost in the unit of the given ones."""

    factor: float
    R: Array
    t: Array
    cost: float


def better_focal_factor(correspondences: Array, R: Array, t: Array, threshold: float) -> float | None:
    """The factor on both focal lengths under which the matches agree markedly better; None = those given will do.

    Args:
        correspondences: (N, 4) on the normalised image planes of the given intrinsics, the most promising first.
        R, t: (3, 3) and (3,) unit norm, the pose fitted to them.
        threshold: Sampson distance where the error is cut off, normalised.

    Returns:
        A power of 1.2, rough by that much, between 0.23 and 4.3.
    """
    rows = correspondences[:_MAX_ROWS]
    given = _refined(rows, 1.0, R, t, threshold)
    best = min((_descend(rows, given, step, threshold) for step in (FOCAL_STEP, 1.0 / FOCAL_STEP)), key=_cost)
    squared = sampson_distance(rows, essential_from_pose(given.R, given.t)) ** 2
    near = squared < threshold**2
    gain = given.cost - best.cost
    if (
        not near.any()
        or gain <= MIN_GAIN_SHARE * given.cost
        or gain <= MIN_GAIN_VARIANCES * float(squared[near].mean())
    ):
        return None
    return best.factor


def _descend(rows: Array, trial: _Trial, step: float, threshold: float) -> _Trial:
    """Follow the factor in one direction for as long as the cost falls."""
    for _ in range(_MAX_STEPS):
        factor = trial.factor * step
        wide = COARSE_FACTOR * threshold / factor
        coarse = refine_pose(rows / factor, trial.R, trial.t, wide, _COARSE_ROUNDS)
        following = _refined(rows, factor, *coarse, threshold)
        if following.cost >= trial.cost:
            break
        trial = following
    return trial


def _refined(rows: Array, factor: float, R: Array, t: Array, threshold: float) -> _Trial:
    """The pose that suits a factor, from one that is near it."""
    R, t = refine_pose(rows / factor, R, t, threshold / factor)
    return _Trial(factor, R, t, truncated_cost(rows / factor, R, t, threshold / factor) * factor**2)


def _cost(trial: _Trial) -> float:
    return trial.cost
