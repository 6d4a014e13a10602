"""Robust fit of a homography, an affine map or a similarity to scored matches: hypotheses from unlike sources, least
squares on the most promising of them, choice by weighted support.

Samples come from growing heads of the list (PROSAC's idea, drawn in bulk), from neighbours of a match in both images
(a small object has few right matches, close together) and, where keypoint size and angle are known, from single
matches, each of which is a similarity then. All of a batch are solved, checked and scored at once in numpy. Samples
that a real plane cannot give are dropped before they are scored: the four points must keep their orientation, which
is the same as lying on one side of the horizon (Hartley & Zisserman, 2nd ed., sec. 21; Chum, Werner & Matas 2004).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import homogeneous
from ..geometry.homography import (
    AFFINE_FREEDOM,
    PROJECTIVE_FREEDOM,
    SIMILARITY_FREEDOM,
    HomographyResiduals,
    facing,
    local_frames,
    refine_homography,
    sampson_distance_to_homography,
    scaled_homography,
)
from ..geometry.matrix_product import product
from .evidence import distinct_rows

Array = NDArray[np.float64]

FAMILIES = {"homography": PROJECTIVE_FREEDOM, "affine": AFFINE_FREEDOM, "similarity": SIMILARITY_FREEDOM}
"""Degrees of freedom of each family of maps; a sample of it has half as many points."""

# A plane seen so obliquely that it shrinks by more than this in one direction holds no keypoints.
MAX_STRETCH = 30.0
# Matches that hypotheses are compared on, the best of the list.
_MAX_SCORED = 1000
_BATCH_SAMPLES = 240
_SMALLEST_HEAD = 12
_NEIGHBOURS = 8
# Of every batch this many hypotheses are refined.
_REFINED_PER_BATCH = 2
_FRAME_HYPOTHESES = 500
# A match that the scores reject still counts a little: they may be wrong about a small object.
_LEAST_WEIGHT = 0.2
# A sample has two coordinates of noise a match: the first step of its refinement reaches this much further.
_WIDE_FACTOR = 3.0
_CAUCHY_SIGMAS, _POLISH_ROUNDS = 1.25, 6
# Matches farther than this many thresholds from a homography do not come near by polishing it.
_REACH = 12.0


@dataclass(frozen=True)
class HomographyOptions:
    """Options of the fit.

    Attributes:
        threshold: Sampson distance of an inlier, in the unit of the points (√2 of it is a transfer error in one image).
        family: ``"homography"``, ``"affine"`` or ``"similarity"``.
        confidence: probability that a sample without outliers was drawn.
        max_iterations: largest number of samples.
        seed: of the sampling.
        reflection: maps that mirror are possible, too: one of the planes has its y axis upwards, say.
    """

    threshold: float = 2.0
    family: str = "homography"
    confidence: float = 0.9999
    max_iterations: int = 5000
    seed: int = 0
    reflection: bool = False


@dataclass(frozen=True)
class HomographyFit:
    """A fitted map.

    Attributes:
        H: (3, 3), ``p2 ~ H p1``, with H[2, 2] = 1; of unit Frobenius norm where the origin maps to infinity.
        distance: (N,) Sampson distances of the matches, infinite beyond the horizon and where one is not finite.
        inlier: (N,) bool, distance below the threshold.
        support: weights of the inliers, each less the further off it is; matches that share a point share its weight.
    """

    H: Array
    distance: Array
    inlier: NDArray[np.bool_]
    support: float


def estimate_homography(
    correspondences: Array,
    options: HomographyOptions = HomographyOptions(),
    weights: NDArray[np.floating[Any]] | None = None,
    order: NDArray[np.intp] | None = None,
    frames: Array | None = None,
) -> HomographyFit | None:
    """Fit a map to matches of which many are wrong.

    Args:
        correspondences: (N, 4) pixels, or any unit that both images share; rows that are not finite are passed over.
        options: threshold, family, limits, seed.
        weights: (N,) probability that each match is right; None = all alike.
        order: (K,) rows, the most promising first; rows that it leaves out do not enter the fit but are measured at its
            end. None = by weight.
        frames: (N, 2) = log2(size2 / size1), angle2 − angle1 in radians of the keypoints, NaN where unknown: sources of
            hypotheses, and nothing else.

    Returns:
        The fit, or None where the distinct matches are fewer than a sample or every map folds or degenerates. Never
        raises for data; the same input and seed give the same bits.

    Raises:
        ValueError: ``family`` is none of :data:`FAMILIES`, or the threshold is not positive.
    """
    if options.family not in FAMILIES:
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {options.family!r}")
    if not options.threshold > 0:
        raise ValueError(f"threshold: expected a positive number, got {options.threshold}")
    all_rows = np.asarray(correspondences, dtype=np.float64).reshape(-1, 4)
    given = np.ones(len(all_rows)) if weights is None else np.asarray(weights, dtype=np.float64)
    order = np.argsort(-given, kind="stable") if order is None else order
    with np.errstate(all="ignore"):
        order = order[np.isfinite(all_rows[order]).all(axis=1) & np.isfinite(given[order])]
        order = order[np.sort(distinct_rows(all_rows[order]))]
        search = _Search.of(all_rows, given, order, frames, options)
        H = None if search is None else search.run()
        if search is None or H is None:
            return None
        support = search.support(H)
        H = search.in_original_unit(H)
        distance = sampson_distance_to_homography(all_rows[order], H)
        everywhere = np.full(len(all_rows), np.inf)
        usable = np.isfinite(all_rows).all(axis=1)
        everywhere[usable] = sampson_distance_to_homography(all_rows[usable], facing(all_rows[order], H))
        everywhere[order] = distance
    return HomographyFit(scaled_homography(H), everywhere, everywhere < options.threshold, support)


def polish_homography(correspondences: Array, H: Array, options: HomographyOptions = HomographyOptions()) -> Array:
    """Least squares on all matches that agree with a homography, from a good one.

    Args:
        correspondences: (N, 4), finite, in the unit of ``H``. H: (3, 3). options: the threshold, and the reflection.

    Returns:
        (3, 3) of OpenCV's scale; ``H`` where the matches are too few or the result is no plane's.
    """
    with np.errstate(all="ignore"):
        rows = correspondences[np.sort(distinct_rows(correspondences))]
        rows = rows[sampson_distance_to_homography(rows, H) < _REACH * options.threshold]
        search = _Search.of(rows, np.ones(len(rows)), np.arange(len(rows)), None, options)
        if search is None or not np.isfinite(H).all():
            return H
        return scaled_homography(search.in_original_unit(search.polished(search.in_search_unit(facing(rows, H)))))


class _Search:
    """Hypotheses of one pair, and the best so far; points are centred and of unit size."""

    def __init__(
        self,
        rows: Array,
        weights: Array,
        frames: Array | None,
        threshold: float,
        options: HomographyOptions,
        centres: Array,
        unit: float,
    ) -> None:
        self._rows, self._weights, self._frames = rows, weights, frames
        self._threshold, self._options = threshold, options
        self._freedom = FAMILIES[options.family]
        self._sample_size = self._freedom // 2
        self._rng = np.random.default_rng(options.seed)
        self._centres, self._unit = centres, unit
        scored = slice(None, _MAX_SCORED)
        self._x1, self._x2, self._scored_weights = homogeneous(rows[scored, :2]), rows[scored, 2:], weights[scored]
        self._best: Array | None = None
        self._best_support = 0.0

    @classmethod
    def of(
        cls,
        all_rows: Array,
        weights: Array,
        order: NDArray[np.intp],
        frames: Array | None,
        options: HomographyOptions,
    ) -> _Search | None:
        """The search among the rows ``order``; None where they are too few or without extent."""
        rows = all_rows[order]
        if len(rows) < FAMILIES[options.family] // 2:
            return None
        centres = rows.mean(axis=0)
        unit = float(np.sqrt(np.mean((rows - centres) ** 2)))
        if not (np.isfinite(unit) and unit > 0):
            return None
        shared = np.maximum(_multiplicity(rows[:, :2]), _multiplicity(rows[:, 2:]))
        weight = np.maximum(np.clip(weights[order], 0.0, 1.0), _LEAST_WEIGHT) / shared
        own_frames = None if frames is None else np.asarray(frames, dtype=np.float64)[order]
        return cls((rows - centres) / unit, weight, own_frames, options.threshold / unit, options, centres, unit)

    def in_original_unit(self, H: Array) -> Array:
        """``H`` between the points as they came in."""
        to_unit1, to_unit2 = self._to_unit()
        return np.asarray(np.linalg.inv(to_unit2) @ H @ to_unit1, dtype=np.float64)

    def in_search_unit(self, H: Array) -> Array:
        """``H`` of the points as they came in between those that are centred and of unit size, of unit norm."""
        to_unit1, to_unit2 = self._to_unit()
        H = to_unit2 @ H @ np.linalg.inv(to_unit1)
        return np.asarray(H / np.linalg.norm(H), dtype=np.float64)

    def _to_unit(self) -> list[Array]:
        return [
            np.array([[1.0, 0.0, -c[0]], [0.0, 1.0, -c[1]], [0.0, 0.0, self._unit]])
            for c in (self._centres[:2], self._centres[2:])
        ]

    def run(self) -> Array | None:
        """The best-supported map (3, 3), polished, or None."""
        if self._frames is not None:
            self._consider(self._frame_hypotheses())
        if len(self._rows) == self._sample_size:
            self._consider(self._solve(np.arange(self._sample_size)[None]))
        for samples in self._batches():
            self._consider(self._solve(samples))
            if self._enough():
                break
        if self._best is None:
            return None
        return self.polished(self._best)

    # 1. Samples

    def _batches(self) -> Iterator[NDArray[np.intp]]:
        """Batches (B, S) of row numbers until ``max_iterations`` are drawn."""
        count = len(self._rows)
        if count <= self._sample_size:
            return
        heads = [count]
        while heads[-1] // 2 >= max(_SMALLEST_HEAD, self._sample_size):
            heads.append(heads[-1] // 2)
        self._heads = heads[::-1]
        self._drawn = np.zeros(len(heads))
        near = self._neighbours()
        left = self._options.max_iterations
        while left > 0:
            size = min(left, _BATCH_SAMPLES)
            left -= size
            from_near = size // 4 if near is not None else 0
            per_head = -(-(size - from_near) // len(heads))
            parts = [self._rng.integers(0, head, (per_head, self._sample_size)) for head in self._heads]
            self._drawn += per_head
            if near is not None and from_near:
                first = (count * self._rng.random(from_near) ** 2).astype(np.intp)  # rather from the head
                others = self._rng.integers(0, near.shape[1], (from_near, self._sample_size - 1))
                parts.append(np.column_stack([first, near[first[:, None], others]]))
            samples = np.vstack(parts)
            ascending = np.sort(samples, axis=1)
            yield samples[np.all(ascending[:, 1:] != ascending[:, :-1], axis=1)]

    def _neighbours(self) -> NDArray[np.intp] | None:
        """Rows (N, 8) nearest to each match in both images at once; None where there are hardly more."""
        rows = self._rows[:_MAX_SCORED]
        if len(rows) < 3 * _NEIGHBOURS:
            return None
        squared = np.sum(rows**2, axis=1)
        distance = squared[:, None] + squared[None] - product(2.0 * rows, rows.T)
        np.fill_diagonal(distance, np.inf)
        near = np.argpartition(distance, _NEIGHBOURS, axis=1)[:, :_NEIGHBOURS]
        if len(self._rows) > len(rows):
            return np.vstack([near, near[np.arange(len(self._rows) - len(rows)) % len(rows)]])
        return near

    # 2. Hypotheses

    def _solve(self, samples: NDArray[np.intp]) -> Array:
        """Maps (B, 3, 3) through the samples that a plane can give, positive on their side."""
        a, b = self._rows[samples][..., :2], self._rows[samples][..., 2:]
        if self._freedom == SIMILARITY_FREEDOM:
            return self._similarities(a, b)
        triangles1, triangles2 = _triangle(a), _triangle(b)
        det1, det2 = np.linalg.det(triangles1), np.linalg.det(triangles2)
        proper = (np.abs(det1) > 1e-12) & (np.abs(det2) > 1e-12)
        if not self._options.reflection:
            proper &= det1 * det2 > 0
        a, b, triangles1, triangles2 = (values[proper] for values in (a, b, triangles1, triangles2))
        inverse1 = np.linalg.inv(triangles1)
        if self._freedom == AFFINE_FREEDOM:
            return np.asarray(triangles2 @ inverse1, dtype=np.float64)
        fourth1 = np.einsum("bij,bj->bi", inverse1, _homogeneous(a[:, 3]))
        fourth2 = np.einsum("bij,bj->bi", np.linalg.inv(triangles2), _homogeneous(b[:, 3]))
        ratios = fourth2 / fourth1
        # All ratios positive: the sample lies on one side of the horizon, and no three of it change orientation.
        proper = np.isfinite(ratios).all(axis=1) & (ratios > 1e-6).all(axis=1) & (ratios < 1e6).all(axis=1)
        proper &= (np.abs(fourth1) > 1e-9).all(axis=1)
        H = (triangles2[proper] * ratios[proper][:, None, :]) @ inverse1[proper]
        return np.asarray(H / np.linalg.norm(H, axis=(1, 2), keepdims=True), dtype=np.float64)

    def _similarities(self, a: Array, b: Array) -> Array:
        """Similarities (B, 3, 3) of two points each, (B, 2, 2)."""
        za, zb = a[..., 0] + 1j * a[..., 1], b[..., 0] + 1j * b[..., 1]
        turn = (zb[:, 1] - zb[:, 0]) / (za[:, 1] - za[:, 0])
        proper = np.isfinite(turn) & (np.abs(turn) > 0)
        turn, move = turn[proper], (zb[:, 0] - turn * za[:, 0])[proper]
        return _similarity_matrices(turn, move)

    def _frame_hypotheses(self) -> Array:
        """Similarities (B, 3, 3) of single matches by their keypoints' sizes and angles, the most promising first."""
        assert self._frames is not None
        known = np.flatnonzero(np.isfinite(self._frames).all(axis=1))[:_FRAME_HYPOTHESES]
        log2_scale, turn_angle = self._frames[known].T
        turn = 2.0**log2_scale * np.exp(1j * turn_angle)
        first, second = (self._rows[known, i] + 1j * self._rows[known, i + 1] for i in (0, 2))
        return _similarity_matrices(turn, second - turn * first)

    # 3. Choice

    def _consider(self, hypotheses: Array) -> None:
        """Refine the most promising of (B, 3, 3) and keep the best of all."""
        if len(hypotheses) == 0:
            return
        # Hypotheses are rough: what they are going to reach after refinement shows at a wider threshold.
        supports = self._screen(hypotheses, _WIDE_FACTOR * self._threshold)
        for index in np.argsort(-supports, kind="stable")[:_REFINED_PER_BATCH]:
            self._offer(self._refine(hypotheses[index]))

    def _screen(self, hypotheses: Array, threshold: float) -> Array:
        """Support (B,) under a first-order distance that takes the local scale for alike in all directions."""
        mapped = hypotheses @ self._x1.T  # (B, 3, N)
        w = mapped[:, 2]
        squared = (mapped[:, 0] / w - self._x2[:, 0]) ** 2 + (mapped[:, 1] / w - self._x2[:, 1]) ** 2
        area_scale = np.abs(np.linalg.det(hypotheses))[:, None] / np.abs(w) ** 3
        squared /= threshold**2 * (1.0 + area_scale)
        agreement = np.where((w > 0) & (squared < 1.0), 1.0 - squared, 0.0)
        return np.asarray(agreement @ self._scored_weights, dtype=np.float64)

    def _refine(self, H: Array) -> Array:
        for factor, rounds in ((_WIDE_FACTOR, 4), (1.0, 8)):
            H = self._least_squares(H, factor * self._threshold, rounds)
        return H

    def _least_squares(self, H: Array, threshold: float, rounds: int) -> Array:
        """All inliers count alike: scores tell right from wrong, not sharp from blurred, and they are highest where
        the matches are many, so that weighing by them bends the map (measured: 6 points of AUC@5 on raw lists)."""
        return refine_homography(self._rows, H, threshold, None, rounds, self._freedom)

    def support(self, H: Array) -> float:
        """Summed weights of the matches that agree with ``H``, less the further off they are (MSAC)."""
        residuals = HomographyResiduals(self._rows, H, self._threshold, self._weights)
        return float(self._weights.sum() - residuals.cost / self._threshold**2)

    def _offer(self, H: Array) -> None:
        support = self.support(H)
        if support > self._best_support and self._is_possible(H):
            self._best, self._best_support = H, support

    def _is_possible(self, H: Array) -> bool:
        """False where a map mirrors, collapses or stretches the inliers as no plane does."""
        near = HomographyResiduals(self._rows, H, self._threshold, self._weights).near
        if not np.isfinite(H).all() or 2 * np.count_nonzero(near) < self._freedom:
            return False
        frames = local_frames(self._rows[near, :2], H)
        if not np.isfinite(frames).all():
            return False
        # Singular values of 2 x 2 matrices, by their squares' sum and their product.
        squares, area = np.einsum("nij,nij->n", frames, frames), np.linalg.det(frames)
        longest = np.sqrt(0.5 * (squares + np.sqrt(np.maximum(squares**2 - 4.0 * area**2, 0.0))))
        orientation = np.sign(area)
        alike = bool(np.all(orientation == orientation[0])) and (self._options.reflection or orientation[0] > 0)
        shortest = float((np.abs(area) / longest).min())
        return alike and float(longest.max()) < MAX_STRETCH and shortest > 1.0 / MAX_STRETCH

    def _enough(self) -> bool:
        """True where some head of the list has given enough samples for its share of inliers."""
        if self._best is None:
            return False
        near = HomographyResiduals(self._rows, self._best, self._threshold, self._weights).near
        share = np.array([np.count_nonzero(near[:head]) / head for head in self._heads])
        missed = self._drawn * np.log1p(-np.minimum(share**self._sample_size, 1.0 - 1e-12))
        return bool(np.min(missed) < np.log(1.0 - self._options.confidence))

    # 4. Polish

    def polished(self, H: Array) -> Array:
        """Least squares with Cauchy weights at the scale of the noise, among the inliers."""
        ones = np.ones(len(self._rows))
        for _ in range(_POLISH_ROUNDS):
            residuals = HomographyResiduals(self._rows, H, self._threshold, ones)
            near = residuals.near
            if 2 * np.count_nonzero(near) <= self._freedom:
                return H
            # The median of a Rayleigh distribution is 1.18 of its standard deviation.
            sigma = float(np.sqrt(np.median(residuals.squared[near]))) / 1.18
            scale = max(_CAUCHY_SIGMAS * sigma, 1e-12)
            weights = 1.0 / (1.0 + np.where(near, residuals.squared, 0.0) / scale**2)
            polished = refine_homography(self._rows, H, self._threshold, weights, 3, self._freedom)
            if not self._is_possible(polished):
                return H
            H = polished
        return H


def _triangle(points: Array) -> Array:
    """Matrices (B, 3, 3) whose columns are the first three of points (B, S, 2)."""
    return np.asarray(np.swapaxes(_homogeneous(points[:, :3]), 1, 2), dtype=np.float64)


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def _similarity_matrices(turn: NDArray[np.complex128], move: NDArray[np.complex128]) -> Array:
    """Matrices (B, 3, 3) of z → turn z + move, (B,) each."""
    zero, one = np.zeros(len(turn)), np.ones(len(turn))
    entries = [turn.real, -turn.imag, move.real, turn.imag, turn.real, move.imag, zero, zero, one]
    return np.asarray(np.stack(entries, axis=1).reshape(-1, 3, 3), dtype=np.float64)


def _multiplicity(points: Array) -> Array:
    """How often each of points (N, 2) occurs, (N,)."""
    _, inverse, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(counts[np.ravel(inverse)], dtype=np.float64)
