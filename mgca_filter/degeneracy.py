"""Does the model deserve trust? Chance, planes, rotations and wrong intrinsics, told apart by simple rules.

Every rule asks for nearly all of the evidence, so that an ordinary pair stays ``OK``:

- *Chance*: random pairings of the same points measure how often a wrong match agrees with the model; a model is
  meaningful when its support is improbable under that rate (number of false alarms, Moisan & Stival 2004).
- *Rotation*: a rotation alone explains 95 % of the inliers to twice the inlier threshold.
- *Plane*: a homography explains 95 % of the inliers to twice the inlier threshold.
- *Intrinsics*: a fundamental matrix, which needs none, explains far more of the fitted matches than E does.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log

import numpy as np
from numpy.typing import NDArray

from .epipolar import homogeneous, sampson_distance

Array = NDArray[np.float64]

MIN_SUPPORT = 15
# Number of false alarms, log10: above the first the support is chance, above the second it is weak.
UNRELATED_LOG10_NFA = -2.0
LOW_SUPPORT_LOG10_NFA = -6.0
EXPLAINED_SHARE = 0.95
EXPLAINED_THRESHOLD_FACTOR = 2.0
INTRINSICS_SUPPORT_FACTOR = 1.5
_RANDOM_PAIRINGS = 20000
_MODEL_FREEDOM = 5


@dataclass(frozen=True)
class Support:
    """How well the fitted matches stand behind the model: count of inliers and log10 number of false alarms."""

    count: int
    log10_nfa: float


def measure_support(correspondences: Array, M: Array, threshold: float) -> Support:
    """Support of a model among the distinct matches (N, 4) that it was fitted to, all normalised."""
    rows = np.unique(correspondences, axis=0)
    count = int(np.count_nonzero(sampson_distance(rows, M) < threshold))
    return Support(count, log10_false_alarms(len(rows), count, _chance_rate(rows, M, threshold)))


def _chance_rate(rows: Array, M: Array, threshold: float) -> float:
    """Share of wrong pairings of the same points that agree with the model."""
    count = len(rows)
    if count < 2:
        return 1.0
    shifts = range(1, min(count, _RANDOM_PAIRINGS // count + 2))
    agreeing = sum(
        int(np.count_nonzero(sampson_distance(np.hstack([rows[:, :2], np.roll(rows[:, 2:], s, axis=0)]), M) < threshold))
        for s in shifts
    )
    # Laplace's rule: a rate that was never observed is not zero.
    return (agreeing + 1.0) / (count * len(shifts) + 2.0)


def log10_false_alarms(count: int, inliers: int, rate: float) -> float:
    """log10 of the number of models that chance would support by ``inliers`` of ``count`` matches."""
    if inliers <= _MODEL_FREEDOM:
        return float("inf")

    def log_binomial(n: int, k: int) -> float:
        return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)

    tests = log(count) + log_binomial(count, inliers) + log_binomial(inliers, _MODEL_FREEDOM)
    return (tests + (inliers - _MODEL_FREEDOM) * log(min(rate, 1.0))) / log(10.0)


def is_collinear(points: Array, tolerance: float) -> bool:
    """True where the points (N, 2) lie on one line to a root mean square distance of ``tolerance``."""
    if len(points) < 3:
        return True
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[1] <= tolerance * np.sqrt(len(points)))


def homography_distance(points1: Array, points2: Array, H: Array) -> Array:
    """Distance (N,) of matches to a homography ``p2 ~ H p1``, in the unit of the points.

    Half the root of the summed squared transfer errors in both directions: like Sampson's, it splits the error
    between the two images. Infinite where a point maps to infinity.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        forward = _transfer(points1, H) - points2
        backward = _transfer(points2, np.linalg.pinv(H)) - points1
        distance = 0.5 * np.sqrt(np.sum(forward**2, axis=1) + np.sum(backward**2, axis=1))
    return np.where(np.isfinite(distance), distance, np.inf)


def _transfer(points: Array, H: Array) -> Array:
    mapped = homogeneous(points) @ H.T
    transferred: Array = mapped[:, :2] / mapped[:, 2:]
    return transferred


def fit_rotation(correspondences: Array, threshold: float, R_start: Array, rounds: int = 5) -> Array:
    """Rotation (3, 3) that best aligns the viewing rays of the matches (N, 4) (Kabsch), outliers set aside.

    Args:
        correspondences: normalised. threshold: distance to the rotation's homography that still counts.
        R_start: where to start, the rotation of the fitted pose.
    """
    rays1, rays2 = (_unit(homogeneous(part)) for part in (correspondences[:, :2], correspondences[:, 2:]))
    R = R_start
    near = np.ones(len(rays1), dtype=bool)
    for _ in range(rounds):
        U, _, Vt = np.linalg.svd(rays2[near].T @ rays1[near])
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        distance = homography_distance(correspondences[:, :2], correspondences[:, 2:], R)
        near = distance < max(threshold, float(np.median(distance)))
    return R


def _unit(rays: Array) -> Array:
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def explains(distance: Array, threshold: float) -> bool:
    """True where nearly all matches lie within twice the inlier threshold of a degenerate model."""
    if len(distance) == 0:
        return False
    return bool(np.mean(distance < EXPLAINED_THRESHOLD_FACTOR * threshold) >= EXPLAINED_SHARE)
