"""Does the model deserve trust? Chance, planes, rotations and wrong intrinsics, told apart by simple rules.

Every rule asks for nearly all of the evidence, so that an ordinary pair stays ``OK``:

- *Chance*: random pairings of the same points measure how often a wrong match agrees with the model; a model is
  meaningful when its support is improbable under that rate (number of false alarms, Moisan & Stival 2004).
- *Line*: a line in one of the images explains 95 % of the inliers to twice the inlier threshold.
- *Rotation*: so does a rotation alone, and it is the better model of the pair. *Plane*: so does a homography. Wrong
  matches that agree with the model by accident, about as many as the same rate foretells, are left out of the 95 %.
- *Intrinsics*: a fundamental matrix, which needs none, explains far more of the fitted matches than E does; or they
  agree markedly better under another focal length (``focal_check.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log, sqrt

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import homogeneous, homogeneous_columns, sampson_distance
from ..geometry.homography import homography_distance
from .evidence import distinct_rows

Array = NDArray[np.float64]

MIN_SUPPORT = 13
# Number of false alarms, log10: above the first the support is chance, above the second it is weak.
UNRELATED_LOG10_NFA = 0.5
LOW_SUPPORT_LOG10_NFA = -1.0
EXPLAINED_SHARE = 0.95
EXPLAINED_THRESHOLD_FACTOR = 2.0
MAX_ACCIDENTAL_SHARE = 0.3
# A translation may point anywhere: so many wrong matches agree with a rotation and the best of its directions.
DIRECTION_FREEDOM = 2
# What explains less than this part of what is asked for is no near miss.
CLEAR_SHORTFALL = 0.8
INTRINSICS_SUPPORT_FACTOR = 1.5
# Keypoints are not better than this, and the median of absolute normal deviates times this is their sigma.
LEAST_NOISE_PX = 0.1
TO_SIGMA = 1.4826
# A match this many sigmas off counts no more than that.
_GRIC_CUT = 5.0
_PRICE_OF_DIMENSION = 2.2
_CHANCE_ROWS = 400
_TRIM_ROUNDS = 5
_MODEL_FREEDOM = 5


@dataclass(frozen=True)
class Support:
    """How well the fitted matches stand behind the model.

    Attributes:
        count: distinct matches within the threshold.
        log10_nfa: log10 of the number of false alarms: how many models chance would support as well.
        chance_count: about how many of ``count`` are wrong matches that agree by accident.
    """

    count: int
    log10_nfa: float
    chance_count: float


def measure_support(correspondences: Array, M: Array, threshold: float) -> Support:
    """Support of a model among the matches (N, 4) that it was fitted to, all normalised."""
    rows = correspondences[distinct_rows(correspondences)]
    count = int(np.count_nonzero(sampson_distance(rows, M) < threshold))
    rate = chance_rate(rows, M, threshold)
    wrong = (len(rows) - count) / max(1.0 - rate, rate)
    return Support(count, log10_false_alarms(len(rows), count, rate), min(float(count), wrong * rate))


def chance_rate(correspondences: Array, M: Array, threshold: float) -> float:
    """Share of the wrong pairings of the same points (N, 4) that agree with the model."""
    step = max(1, -(-len(correspondences) // _CHANCE_ROWS))
    rows = correspondences[::step]
    x1, x2 = homogeneous(rows[:, :2]), homogeneous(rows[:, 2:])
    line2, line1 = x1 @ M.T, x2 @ M
    # Sampson distances of all pairings at once, (N, N): the line normals depend on one point each.
    limit2, limit1 = (threshold**2 * np.sum(line[:, :2] ** 2, axis=1) for line in (line2, line1))
    excess = x2 @ line2.T  # in place from here on: memory for all pairings takes longer to get than to fill
    excess *= excess
    excess -= limit1[:, None]
    agreeing = excess < limit2
    np.fill_diagonal(agreeing, False)
    # Laplace's rule: a rate that was never observed is not zero.
    return float((np.count_nonzero(agreeing) + 1.0) / (len(rows) * (len(rows) - 1) + 2.0))


def log10_false_alarms(count: int, inliers: int, rate: float) -> float:
    """log10 of the number of models that chance would support by ``inliers`` of ``count`` matches."""
    if inliers <= _MODEL_FREEDOM:
        return float("inf")

    def log_binomial(n: int, k: int) -> float:
        return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)

    tests = log(count) + log_binomial(count, inliers) + log_binomial(inliers, _MODEL_FREEDOM)
    return (tests + (inliers - _MODEL_FREEDOM) * log(min(rate, 1.0))) / log(10.0)


def line_distance(points: Array, threshold: float) -> Array:
    """Distance (N,) of points (N, 2) to the line that fits most of them, points beyond ``threshold`` set aside."""
    near = np.ones(len(points), dtype=bool)
    distance = np.zeros(len(points))
    for _ in range(_TRIM_ROUNDS):
        centre = points[near].mean(axis=0)
        offsets = points[near] - centre
        across = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]  # of the smallest variance
        distance = np.abs((points - centre) @ across)
        near = distance <= max(threshold, float(np.median(distance)))
    return distance


def fit_rotation(correspondences: Array, threshold: float) -> Array:
    """Rotation (3, 3) that best aligns the viewing rays of the matches (N, 4) (Kabsch), outliers set aside.

    Args:
        correspondences: normalised. threshold: distance to the rotation's homography that still counts.
    """
    rays1, rays2 = (_unit(homogeneous(part)) for part in (correspondences[:, :2], correspondences[:, 2:]))
    R: Array = np.eye(3)
    near = np.ones(len(rays1), dtype=bool)
    for _ in range(_TRIM_ROUNDS):
        U, _, Vt = np.linalg.svd(rays2[near].T @ rays1[near])
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        distance = homography_distance(correspondences[:, :2], correspondences[:, 2:], R)
        near = distance <= max(threshold, float(np.median(distance)))
    return R


def prefers_rotation(rotation_px: Array, epipolar_px: Array) -> bool:
    """True where a rotation alone is the better model of the matches than an essential matrix, noise considered.

    Torr's criterion GRIC (IJCV 2002): squared residuals in units of the noise, cut off far out, and a price for the
    dimension of the model's manifold, one more for E's, and for its parameters. A camera that moves a little leaves
    more of the matches than noise would, however few pixels that is.

    Args:
        rotation_px: (N,) Sampson distances of what bears witness to the rotation's homography; what is so far off that
            it is wrong, or agrees with E by accident, is left out.
        epipolar_px: (N,) their Sampson distances to E.
    """
    turned = rotation_px < 2.0 * EXPLAINED_THRESHOLD_FACTOR
    rotation_px, epipolar_px = rotation_px[turned], epipolar_px[turned]
    count = len(epipolar_px)
    # E has taken as many residuals as it has degrees of freedom.
    left = max(count - _MODEL_FREEDOM, 1)
    noise = max(TO_SIGMA * float(np.median(epipolar_px)) * sqrt(count / left), LEAST_NOISE_PX)
    # The root of two squared components: of noise alone their expectation is twice that of a distance to E.
    costs = [float(np.minimum((d / noise) ** 2, _GRIC_CUT**2).sum()) for d in (rotation_px, epipolar_px)]
    # Steeper than log 4 a match: E was chosen among many, and the noise is that of the residuals that it leaves.
    price = _PRICE_OF_DIMENSION * count + 2.0 * log(4.0 * count)
    return costs[0] - costs[1] < price


def _unit(rays: Array) -> Array:
    unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def explains(distance: Array, threshold: float, support: Support, freedom: int = 0) -> bool:
    """True where a degenerate model explains nearly all inliers, but for those that are there by accident.

    Args:
        distance: (N,) of the inliers to the degenerate model, or of more matches.
        threshold: inlier threshold, in the unit of ``distance``; twice as much is allowed.
        support: of the general model that the inliers agree with.
        freedom: how many wrong matches the general model can be made to fit beside the right ones.
    """
    wanted = _wanted(len(distance), support, freedom)
    return bool(len(distance) and np.count_nonzero(distance < EXPLAINED_THRESHOLD_FACTOR * threshold) >= wanted)


def may_explain(distance: Array, threshold: float, support: Support) -> bool:
    """False where the best of a kind of degenerate models, by an earlier search among the same matches, falls so far
    short that another search finds none that :func:`explains` them.

    Arguments as there.
    """
    explained = np.count_nonzero(distance < EXPLAINED_THRESHOLD_FACTOR * threshold)
    return bool(explained >= CLEAR_SHORTFALL * _wanted(len(distance), support))


def _wanted(count: int, support: Support, freedom: int = 0) -> float:
    """How many of ``count`` matches a degenerate model must explain."""
    # Two standard deviations of a Poisson count: accidents do not come in their exact mean number.
    accidents = support.chance_count + 2.0 * sqrt(support.chance_count) + freedom
    count = min(count, support.count)
    return EXPLAINED_SHARE * (count - min(accidents, MAX_ACCIDENTAL_SHARE * count))


def may_lie_on_line(points: Array, threshold: float, support: Support) -> bool:
    """False where no line explains points (N, 2), told without finding the best: see :func:`explains`.

    The least height of a triangle of points within d of one line is at most 2 d, and each point off the line spoils at
    most one of N / 3 triangles that share none.
    """
    third = len(points) // 3
    a, b, c = points[:third], points[third : 2 * third], points[2 * third : 3 * third]
    sides = np.stack([b - a, c - b, a - c])  # (3, T, 2)
    twice_area = np.abs(sides[0, :, 0] * sides[1, :, 1] - sides[0, :, 1] * sides[1, :, 0])
    longest = np.sqrt(np.einsum("stk,stk->st", sides, sides).max(axis=0))
    flat = twice_area <= 2.0 * EXPLAINED_THRESHOLD_FACTOR * threshold * longest
    return bool(third - np.count_nonzero(flat) <= len(points) - _wanted(len(points), support))


def may_only_turn(correspondences: Array, threshold: float, support: Support) -> bool:
    """False where no rotation explains matches (N, 4), told without finding one: see :func:`explains`.

    A rotation keeps the angles between viewing rays, and each match that disagrees spoils at most one of N / 2 pairs of
    matches that share none.

    Args:
        threshold: inlier threshold, pixels over the shortest focal length.
    """
    half = len(correspondences) // 2
    sines = []
    for part in (correspondences[:, :2], correspondences[:, 2:]):
        rays = homogeneous_columns(part)
        first, second = rays[:, :half], rays[:, half : 2 * half]
        squares = np.einsum("in,in->n", rays, rays)
        dots = np.einsum("in,in->n", first, second)
        sines.append(np.sqrt(np.maximum(1.0 - dots**2 / (squares[:half] * squares[half : 2 * half]), 0.0)))
    # Half the root of two squared transfer errors is within d: the smaller error, and so the angle between a ray and
    # what the rotation makes of the other, is within √2 d.
    tolerance = 2.0 * np.sqrt(2.0) * EXPLAINED_THRESHOLD_FACTOR * threshold
    alike = np.abs(sines[0] - sines[1]) <= tolerance
    wanted = _wanted(len(correspondences), support, DIRECTION_FREEDOM)
    return bool(half - np.count_nonzero(alike) <= len(correspondences) - wanted)
