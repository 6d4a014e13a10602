"""Does one homography explain the pair? A fit to scored matches, and how surprising its support would be by chance.

A contrario (Moisan & Stival 2004; Moisan, Moulon & Monasse 2012): if matches paired points at random, how many
homographies would be supported as well? A homography fixes both coordinates of a match, so that ten right matches in
hundreds are a surprise where an epipolar line, which fixes one, is met by accident too often. Counted are the heads of
the list at several lengths, because a small object has its matches at the head of a good order, at several thresholds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import lgamma, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import sampson_distance
from ..geometry.homography import sampson_distance_to_homography, transfer
from ..types import SizeLike
from . import degeneracy
from .homography_fit import FAMILIES, HomographyOptions, estimate_homography

Array = NDArray[np.float64]

# log10 of the number of false alarms below which a homography is more than chance.
MEANINGFUL_LOG10_NFA = -2.0
# log10 of the number of false alarms of the matches off the plane below which the scene has depth: below that of
# chance, for wrong matches of a pattern depend on each other, and the epipolar model was chosen among many for them.
PARALLAX_LOG10_NFA = -5.0
# Planes are seldom perfect: a match is off the plane beyond this multiple of the threshold.
OFF_PLANE_FACTOR = 2.0
# Once H is known, two matches off the plane determine the fundamental matrix.
_PARALLAX_FREEDOM = 2
_SMALLEST_HEAD = 16
_THRESHOLD_FACTORS = (0.5, 1.0, 2.0)
_CHANCE_ROWS = 400


@dataclass(frozen=True)
class PlaneEvidence:
    """A homography and what speaks for it.

    Attributes:
        H: (3, 3), ``p2 ~ H p1`` in pixels, H[2, 2] = 1; None where none fits.
        inlier: (N,) bool, matches within the threshold; all False without H.
        count: independent ones among them.
        log10_false_alarms: log10 of the number of homographies that chance would support as well; infinite without H.
    """

    H: Array | None
    inlier: NDArray[np.bool_]
    count: int
    log10_false_alarms: float

    @property
    def meaningful(self) -> bool:
        """The support is more than chance gives."""
        return self.log10_false_alarms < MEANINGFUL_LOG10_NFA


def find_plane(
    correspondences: Array,
    scores: NDArray[np.floating[Any]] | None,
    size1: SizeLike | None,
    size2: SizeLike | None,
    *,
    options: HomographyOptions | None = None,
    order: NDArray[np.intp] | None = None,
    frames: Array | None = None,
) -> PlaneEvidence:
    """Fit a homography to scored matches and judge its support.

    Args:
        correspondences: (N, 4) pixels; rows that are not finite bear no witness.
        scores: (N,) probabilities; None = all alike.
        size1, size2: (width, height), pixels: the room that a random point has; None = the extent of the points.
        options, order, frames: as in :func:`mgca_filter.fit.homography_fit.estimate_homography`.

    Returns:
        The homography with its inliers and log10 number of false alarms. Never raises for data.
    """
    options = HomographyOptions() if options is None else options
    rows = np.asarray(correspondences, dtype=np.float64).reshape(-1, 4)
    fit = estimate_homography(rows, options, scores, order, frames)
    if fit is None:
        return PlaneEvidence(None, np.zeros(len(rows), dtype=bool), 0, float("inf"))
    if order is None:
        order = np.arange(len(rows)) if scores is None else np.argsort(-np.asarray(scores), kind="stable")
    order = order[np.isfinite(rows[order]).all(axis=1)]
    count, log10_nfa = _fewest_false_alarms(rows[order], fit.H, size1, size2, options)
    return PlaneEvidence(fit.H, fit.inlier, count, log10_nfa)


def parallax_false_alarms(correspondences: Array, H: Array, M: Array, threshold: float) -> float:
    """log10 of the number of false alarms of the matches off the plane that agree with the epipolar model.

    Two of them determine the model when the homography is known; the others are a surprise where the scene is a plane
    or the camera only turned.

    Args:
        correspondences: (N, 4). H: (3, 3). M: (3, 3), ``x2^T M x1 = 0``. threshold: Sampson distance of an inlier. All
            in one unit: pixels with F, or normalised with E.
    """
    rows = np.asarray(correspondences, dtype=np.float64).reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(axis=1)]
    off = rows[sampson_distance_to_homography(rows, H) > OFF_PLANE_FACTOR * threshold]
    if len(off) <= _PARALLAX_FREEDOM:
        return float("inf")
    witnesses = _independent(off, sampson_distance(off, M), threshold, 2.0 * threshold)
    rate = degeneracy.chance_rate(off, M, threshold)
    return _log10_nfa(len(off), int(np.count_nonzero(witnesses)), _PARALLAX_FREEDOM, rate)


def homography_explains(correspondences: Array, H: Array, M: Array, threshold: float) -> bool:
    """True where one homography explains the pair as well as the epipolar model does: a plane, or a turning camera.

    Arguments as in :func:`parallax_false_alarms`.
    """
    return parallax_false_alarms(correspondences, H, M, threshold) > PARALLAX_LOG10_NFA


def homography_false_alarms(
    correspondences: Array,
    H: Array,
    threshold: float,
    size1: SizeLike | None = None,
    size2: SizeLike | None = None,
    family: str = "homography",
) -> float:
    """log10 of the number of false alarms of ``H`` on matches (N, 4) in pixels, the most promising first."""
    options = HomographyOptions(threshold=threshold, family=family)
    return _fewest_false_alarms(np.asarray(correspondences, dtype=np.float64), H, size1, size2, options)[1]


def _fewest_false_alarms(
    rows: Array, H: Array, size1: SizeLike | None, size2: SizeLike | None, options: HomographyOptions
) -> tuple[int, float]:
    """Independent inliers at the threshold among all, and the least log10 NFA over heads and thresholds."""
    freedom = FAMILIES[options.family] // 2
    distance = sampson_distance_to_homography(rows, H)
    heads = [len(rows)]
    while heads[-1] // 2 >= _SMALLEST_HEAD:
        heads.append(heads[-1] // 2)
    tests = log(len(heads) * len(_THRESHOLD_FACTORS), 10.0)
    least, count_at_threshold = float("inf"), 0
    thresholds = [factor * options.threshold for factor in _THRESHOLD_FACTORS]
    rates = chance_rates(rows, H, thresholds, size1, size2)
    for factor, threshold, rate in zip(_THRESHOLD_FACTORS, thresholds, rates):
        witnesses = _independent(rows, distance, threshold, 2.0 * options.threshold)
        if factor == 1.0:
            count_at_threshold = int(np.count_nonzero(witnesses))
        for head in heads:
            inliers = int(np.count_nonzero(witnesses[:head]))
            least = min(least, _log10_nfa(head, inliers, freedom, rate))
    return count_at_threshold, least + tests


def _independent(rows: Array, distance: Array, threshold: float, radius: float) -> NDArray[np.bool_]:
    """Inliers (N,) of which no two lie in the same cell of either image: one blob is found several times."""
    chosen = np.zeros(len(rows), dtype=bool)
    near = np.flatnonzero(distance < threshold)
    taken: list[set[tuple[int, ...]]] = [set(), set()]
    for row, cells in zip(near, np.floor(rows[near] / radius).astype(np.int64).reshape(-1, 2, 2).tolist()):
        keys = [tuple(cell) for cell in cells]
        if keys[0] in taken[0] or keys[1] in taken[1]:
            continue
        for key, seen in zip(keys, taken):
            seen.add(key)
        chosen[row] = True
    return chosen


def chance_rates(
    correspondences: Array,
    H: Array,
    thresholds: Sequence[float],
    size1: SizeLike | None = None,
    size2: SizeLike | None = None,
) -> list[float]:
    """Share of the wrong pairings of the same points (N, 4) that agree with a homography, all in pixels, by threshold.

    Measured on all pairings of some of the points; what the areas of the images foretell counts as one observed
    agreement, so that a rate that was never observed is not zero.
    """
    step = max(1, -(-len(correspondences) // _CHANCE_ROWS))
    rows = correspondences[::step]
    count = len(rows)
    with np.errstate(all="ignore"):
        mapped = transfer(rows[:, :2], H)
        back = transfer(rows[:, 2:], np.asarray(np.linalg.pinv(H), dtype=np.float64))
        forward = _squared_distances(mapped, rows[:, 2:])  # (N, N): point i of image 1, point j of image 2
        backward = _squared_distances(rows[:, :2], back)
        # Of a similarity of scale s the Sampson distance is d / √(1 + s²): the two transfer errors give it without
        # a derivative of each pairing.
        squared = forward * backward / (forward + backward)
    np.fill_diagonal(squared, np.inf)
    area = [
        float(np.prod(size)) if size is not None else float(np.prod(np.ptp(part, axis=0)))
        for size, part in ((size1, correspondences[:, :2]), (size2, correspondences[:, 2:]))
    ]
    rates: list[float] = []
    for threshold in thresholds:
        room = max(max(area), np.pi * threshold**2)
        expected = min(2.0 * np.pi * threshold**2 / room, 0.5)
        agreeing = np.count_nonzero(squared < threshold**2)
        rates.append((agreeing + 1.0) / (count * (count - 1) + 1.0 / expected))
    return rates


def _squared_distances(a: Array, b: Array) -> Array:
    """(N, M) of points (N, 2) and (M, 2)."""
    return np.asarray(np.subtract.outer(a[:, 0], b[:, 0]) ** 2 + np.subtract.outer(a[:, 1], b[:, 1]) ** 2)


def _log10_nfa(count: int, inliers: int, freedom: int, rate: float) -> float:
    """log10 of how many maps chance would support by ``inliers`` of ``count`` matches."""
    if inliers <= freedom:
        return float("inf")

    def log_binomial(n: int, k: int) -> float:
        return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)

    tests = log(count) + log_binomial(count, inliers) + log_binomial(inliers, freedom)
    return (tests + (inliers - freedom) * log(min(rate, 1.0))) / log(10.0)
