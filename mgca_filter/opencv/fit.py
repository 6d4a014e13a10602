"""The work behind OpenCV's names: points and thresholds in, the filter, matrices and masks of OpenCV's kind out."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import mean_focal_length
from ..inputs.keypoints import read_keypoints
from ..inputs.options import check_integer, check_number
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter
from ..result import FilterResult

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]
Answer = tuple["Array | None", Mask]

# A focal length, or without one an extent of the points, below this is no number of pixels: the caller normalised.
_FEWEST_PIXELS = 10.0
# The filter's own thresholds are pixels; an image of this size stands in where the points are normalised.
_USUAL_PIXELS = 1000.0
# Bound at import, like those of the robust fit: the names in cv2 may be swapped.
_find_fundamental_mat = cv2.findFundamentalMat

_log = logging.getLogger("mgca_filter")


@dataclass(frozen=True)
class FitArguments:
    """Robust-fit arguments of one call, checked; ``threshold`` in the unit of the points."""

    method: str
    confidence: float
    threshold: float
    max_iterations: int
    seed: int = 0


def read_fit(method: int, confidence: float, threshold: float, max_iterations: int, seed: int = 0) -> FitArguments:
    """Check OpenCV's scalar arguments.

    Raises:
        TypeError, ValueError: one is of another type or range.
    """
    return FitArguments(
        "magsac" if method == cv2.USAC_MAGSAC else "prosac",
        check_number(confidence, "prob", 0.0, 1.0),
        check_number(threshold, "threshold", 0.0, float("inf")),
        check_integer(max_iterations, "maxIters", 1),
        seed,
    )


def read_params(params: cv2.UsacParams) -> FitArguments:
    """The same from ``cv2.UsacParams``; errors as :func:`read_fit`."""
    method = cv2.USAC_MAGSAC if params.score == cv2.SCORE_METHOD_MAGSAC else cv2.RANSAC
    seed = abs(int(params.randomGeneratorState))
    return read_fit(method, params.confidence, params.threshold, params.maxIterations, seed)


def fit_essential(
    points1: Any, points2: Any, K1: Any, K2: Any, dist1: Any, dist2: Any, fit: FitArguments, mask: Any
) -> Answer:
    """E (3, 3) or None, and the mask (N, 1); arguments as in :func:`mgca_filter.findEssentialMat`."""
    points1, points2 = _read_points(points1, points2)
    K1, K2 = (np.asarray(K, dtype=np.float64) for K in (K1, K2))
    focal = mean_focal_length(K1, K2) if K1.shape == K2.shape == (3, 3) else 0.0
    if 0.0 < focal < _FEWEST_PIXELS:
        zoom = _USUAL_PIXELS / focal
        K1, K2 = (np.diag([zoom, zoom, 1.0]) @ K for K in (K1, K2))
        points1, points2 = points1 * zoom, points2 * zoom
        fit = replace(fit, threshold=fit.threshold * zoom)
    pair = MatchPair(points1, points2, None, K1, K2, _coefficients(dist1), _coefficients(dist2))
    result = _run(pair, fit, "findEssentialMat")
    return result.E, _as_opencv_mask(result.mask, mask)


def fit_fundamental(points1: Any, points2: Any, fit: FitArguments, mask: Any) -> Answer:
    """F (3, 3) or None, and the mask (N, 1); arguments as in :func:`mgca_filter.findFundamentalMat`."""
    points1, points2 = _read_points(points1, points2)
    extent = max(_extent(points1), _extent(points2))
    zoom = np.eye(3)
    if 0.0 < extent < _FEWEST_PIXELS:
        factor = _USUAL_PIXELS / extent
        zoom = np.array([[factor, 0.0, _USUAL_PIXELS], [0.0, factor, _USUAL_PIXELS], [0.0, 0.0, 1.0]])
        points1, points2 = (points * factor + _USUAL_PIXELS for points in (points1, points2))
        fit = replace(fit, threshold=fit.threshold * factor)
    result = _run(MatchPair(points1, points2, None), fit, "findFundamentalMat")
    F = None if result.F is None else zoom.T @ result.F @ zoom
    return _scaled(F), _as_opencv_mask(result.mask, mask)


def solve_fundamental(points1: Any, points2: Any, method: int, mask: Any) -> Answer:
    """OpenCV's 7- and 8-point solver; None and an empty mask where it refuses the points."""
    points1, points2 = _read_points(points1, points2)
    try:
        F, kept = _find_fundamental_mat(points1, points2, method)
    except cv2.error:
        F = None
    inliers = np.zeros(len(points1), dtype=bool) if F is None else np.asarray(kept).ravel() > 0
    return None if F is None else np.asarray(F, dtype=np.float64), _as_opencv_mask(inliers, mask)


def _run(pair: MatchPair, fit: FitArguments, name: str) -> FilterResult:
    match_filter = MatchFilter(threshold=fit.threshold, confidence=fit.confidence, method=fit.method, seed=fit.seed)
    match_filter.fit_options = replace(match_filter.fit_options, max_iterations=fit.max_iterations)
    result = match_filter.filter_many([pair])[0]
    _log.info("%s: %s, %d of %d matches", name, result.status.value, result.num_inliers, len(result.mask))
    return result


def _read_points(points1: Any, points2: Any) -> tuple[Array, Array]:
    """Pixels (N, 2), (N, 2) from the layouts that OpenCV takes."""
    both = []
    for name, points in (("points1", points1), ("points2", points2)):
        if isinstance(points, np.ndarray) and points.ndim == 3 and points.shape[0] == 1 and points.shape[2] == 2:
            points = points[0]
        both.append(read_keypoints(points, name).points)
    if len(both[0]) != len(both[1]):
        raise ValueError(f"points2: expected {len(both[0])} points like points1, got {len(both[1])}")
    return both[0], both[1]


def _coefficients(dist: Any) -> Any:
    """OpenCV takes an empty array for no distortion."""
    return None if dist is None or np.size(dist) == 0 else dist


def _extent(points: Array) -> float:
    finite = points[np.isfinite(points).all(axis=1)]
    return float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0


def _scaled(F: Array | None) -> Array | None:
    """OpenCV's scale: F[2, 2] = 1, where it is not zero."""
    if F is None:
        return None
    F = F / np.linalg.norm(F)
    return F / F[2, 2] if abs(F[2, 2]) > 1e-12 else F


def _as_opencv_mask(inliers: NDArray[np.bool_], mask: Any) -> Mask:
    """The mask (N, 1) of 0 and 1, in the caller's array where that fits."""
    column = inliers.astype(np.uint8)[:, None]
    if isinstance(mask, np.ndarray) and mask.dtype == np.uint8 and mask.shape == column.shape:
        mask[:] = column
        return mask
    return column
