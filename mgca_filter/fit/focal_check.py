"""Do the matches agree with the focal length? The pose is refined under longer and shorter ones as well.

Two views determine a focal length that both share, unless the scene is a plane or the viewing axes are parallel or
meet (Hartley & Zisserman, 2nd ed., sec. 19.3; Sturm, 2001). There every focal length does about equally well, and the
rule stays silent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import cross_matrix, sampson_distance
from ..geometry.pose_refinement import MIN_INLIERS, refine_pose, rotation_from_vector, truncated_cost

Array = NDArray[np.float64]

FOCAL_STEP = 1.2
# Another focal length is believed where it lowers the truncated cost by this share of it, and by this many times the
# variance of the inliers' distances: the first keeps out distortion and other small errors of the camera model, which
# many matches make significant, the second chance. With these it fired on none of the training pairs that were tried
# with their true focal length.
MIN_GAIN_SHARE, MIN_GAIN_VARIANCES = 0.35, 20.0
# It is tried where the derivatives promise this much: three quarters of the pairs with a right one end here.
MIN_PROMISED_SHARE, MIN_PROMISED_VARIANCES = 0.01, 4.0
# With less than this part of it before the pose is refined on the same matches no refinement is needed.
CLEAR_WORTH = 0.5
# The pose under another focal length lies further off than a fine threshold lets refinement see.
COARSE_FACTOR = 16.0
_COARSE_ROUNDS = 5
_MAX_ROWS = 500
_MAX_STEPS = 8
_DIFFERENCE = 1e-7
_SMALL_TURNS = np.stack([rotation_from_vector(_DIFFERENCE * axis) for axis in np.eye(3)])


@dataclass(frozen=True)
class _Trial:
    """The pose that suits the given focal lengths times ``factor``, and its cost in the unit of the given ones."""

    factor: float
    R: Array
    t: Array
    cost: float


@dataclass(frozen=True)
class _Promise:
    """What a Gauss-Newton step takes off the squared distances of the inliers if it may change the focal length.

    Attributes:
        worth: the gain beyond that of a step on the pose alone, as a multiple of what makes it worth a try.
        direction: 1 or -1, whether the step makes the focal length longer.
        variance: of the inliers' distances.
    """

    worth: float
    direction: float
    variance: float


def better_focal_factor(correspondences: Array, R: Array, t: Array, threshold: float) -> float | None:
    """The factor on both focal lengths under which the matches agree markedly better; None = those given will do.

    Args:
        correspondences: (N, 4) on the normalised image planes of the given intrinsics, the most promising first.
        R, t: (3, 3) and (3,) unit norm, the pose fitted to them.
        threshold: Sampson distance where the error is cut off, normalised.

    Returns:
        A power of 1.2, rough by that much, between 0.23 and 4.3.
    """
    # What lies beyond the coarsest reach is wrong under every focal length, and says nothing of any.
    within = sampson_distance(correspondences, cross_matrix(t) @ R) < COARSE_FACTOR * threshold
    rows = correspondences[within][:_MAX_ROWS]
    start = _promise(rows, R, t, threshold)
    if start is not None and start.worth < CLEAR_WORTH:
        return None
    given = _refined(rows, 1.0, R, t, threshold)
    promise = _promise(rows, given.R, given.t, threshold)
    if promise is None or promise.worth < 1.0:
        return None
    best = _descend(rows, given, FOCAL_STEP**promise.direction, threshold)
    enough = max(MIN_GAIN_SHARE * given.cost, MIN_GAIN_VARIANCES * promise.variance)
    return best.factor if given.cost - best.cost > enough else None


def _promise(rows: Array, R: Array, t: Array, threshold: float) -> _Promise | None:
    """What the derivatives at a pose promise; None with too few inliers."""
    T = cross_matrix(t)
    # Six small changes: three turns, two moves across t, a longer focal length. Distances have no sign, but neither
    # has the product of a distance and its derivative. Under a longer focal length the points shrink and with them the
    # unit of distances: in that of the given one they are those to an E that shrinks its points itself.
    moves = np.linalg.svd(t[None])[2][1:]
    shrink = np.diag([1.0 / (1.0 + _DIFFERENCE), 1.0 / (1.0 + _DIFFERENCE), 1.0])
    moved = [cross_matrix(t + _DIFFERENCE * move) @ R for move in moves]
    changed = np.stack([T @ R, *(T @ _SMALL_TURNS @ R), *moved, shrink @ T @ R @ shrink])  # (7, 3, 3)
    distances = sampson_distance(rows, changed)  # (7, N)
    near = distances[0] < threshold
    distances = distances[:, near]
    distance = distances[0]
    if len(distance) < MIN_INLIERS:
        return None
    jacobian = (distances[1:] - distance) / _DIFFERENCE
    hessian, gradient = jacobian @ jacobian.T, jacobian @ distance
    step = np.linalg.lstsq(hessian, gradient, rcond=None)[0]
    pose_step = np.linalg.lstsq(hessian[:5, :5], gradient[:5], rcond=None)[0]
    gain = float(gradient @ step - gradient[:5] @ pose_step)
    variance = float(np.mean(distance**2))
    cost = len(distance) * variance + np.count_nonzero(~near) * threshold**2
    worth = gain / max(MIN_PROMISED_SHARE * cost, MIN_PROMISED_VARIANCES * variance, 1e-300)
    return _Promise(worth, -1.0 if step[5] > 0 else 1.0, variance)


def _descend(rows: Array, trial: _Trial, step: float, threshold: float) -> _Trial:
    """Multiply the factor by ``step`` for as long as the cost falls."""
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
