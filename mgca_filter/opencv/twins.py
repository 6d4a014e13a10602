"""OpenCV's names, argument orders, defaults and return types over the filter.

What OpenCV's arguments mean here, for :func:`findEssentialMat` and :func:`findFundamentalMat`:

- *points*: bare points are all that these functions get, so the network judges by position alone. A script that had
  ratios, keypoint sizes and angles before the call has lost them by then: :func:`mgca_filter.filter_matches` takes the
  keypoints and matches themselves and does markedly better. Points in units of the focal length (``cameraMatrix`` the
  identity, threshold 1e-3) are recognised by their size.
- *method*: every robust method gives the filter's own fit, which asks MAGSAC and PROSAC among others and takes the most
  likely answer. ``cv2.FM_7POINT`` and ``cv2.FM_8POINT`` ask for a solver, not for a filter: they go to OpenCV as they
  are.
- *prob*, *confidence*: probability that the robust fit has drawn a sample without outliers. *maxIters*: its samples.
- *threshold*, *ransacReprojThreshold*: Sampson distance, pixels, up to which the mask calls a match an inlier. The fit
  itself works at a threshold of its own.
- *mask*: an output, as in OpenCV: an array uint8 (N, 1) passed in is written to; what it holds is not read.
- *UsacParams*: ``confidence``, ``threshold``, ``maxIterations`` and ``randomGeneratorState`` as above; the rest is not
  used.

What comes back: a matrix (3, 3) float64, never several stacked, and always a mask (N, 1) of 0 and 1, uint8. A script
that hands the matrix on, to ``cv2.recoverPose`` say, gets one wherever OpenCV would have given one: where the filter
stands by none (a camera that only turns or stands still, unrelated images) it is the best that its robust fit found,
else OpenCV's own, and the mask tells what is right about it: the matches that agree with the rotation, or none. It is
None where OpenCV finds nothing either. Data never raises. ``mgca_filter``'s log (level INFO) tells the status of every
call; :func:`mgca_filter.filter_matches` gives it as a value.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..inputs.keypoints import read_keypoints
from ..inputs.options import FilterOptions, check_integer, check_number
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter, filter_matches
from ..result import FilterResult
from .overloads import call_overload

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]
Answer = tuple["Array | None", Mask]

Function = TypeVar("Function", bound=Callable[..., Any])

_SOLVERS = (cv2.FM_7POINT, cv2.FM_8POINT)
# Bound at import, like those of the robust fit: the names in cv2 may be swapped.
_find_essential_mat, _find_fundamental_mat = cv2.findEssentialMat, cv2.findFundamentalMat


_log = logging.getLogger("mgca_filter")


def _typed_like(original: Function) -> Callable[[Callable[..., Any]], Function]:
    """Editors and type checkers see the overloads of OpenCV's function; nothing happens at run time."""
    return lambda twin: twin  # type: ignore[return-value]


@_typed_like(cv2.findEssentialMat)
def findEssentialMat(*args: Any, **kwargs: Any) -> Answer:
    """Essential matrix and inlier mask, ``cv2.findEssentialMat`` in all its overloads.

    ::

        findEssentialMat(points1, points2, cameraMatrix[, method[, prob[, threshold[, maxIters[, mask]]]]])
        findEssentialMat(points1, points2[, focal[, pp[, method[, prob[, threshold[, maxIters[, mask]]]]]]])
        findEssentialMat(points1, points2, cameraMatrix1, distCoeffs1, cameraMatrix2, distCoeffs2
                         [, method[, prob[, threshold[, mask]]]])
        findEssentialMat(points1, points2, cameraMatrix1, cameraMatrix2, dist_coeff1, dist_coeff2, params[, mask])

    Points are arrays (N, 2), (N, 1, 2) or (1, N, 2), pixels; see the module for the meaning of the other arguments.

    Returns:
        E (3, 3) float64 of unit Frobenius norm, rank 2 and two equal singular values, ``x2^T E x1 = 0``, or None
        where OpenCV finds none either; and the mask (N, 1) uint8.

    Raises:
        TypeError: the arguments fit no overload. ValueError: one has another shape or range.
    """
    result: Answer = call_overload("findEssentialMat", _ESSENTIAL_OVERLOADS, args, kwargs)
    return result


@_typed_like(cv2.findFundamentalMat)
def findFundamentalMat(*args: Any, **kwargs: Any) -> Answer:
    """Fundamental matrix and inlier mask, ``cv2.findFundamentalMat`` in all its overloads.

    ::

        findFundamentalMat(points1, points2, method, ransacReprojThreshold, confidence, maxIters[, mask])
        findFundamentalMat(points1, points2[, method[, ransacReprojThreshold[, confidence[, mask]]]])
        findFundamentalMat(points1, points2, params[, mask])

    As OpenCV does, a threshold that is not positive becomes 3 and a confidence outside (0, 1) becomes 0.99.

    Returns:
        F (3, 3) float64 with F[2, 2] = 1, ``p2^T F p1 = 0`` in pixels, or None; and the mask (N, 1) uint8. From
        ``FM_7POINT`` up to three matrices stacked, as OpenCV stacks them.

    Raises:
        TypeError: the arguments fit no overload. ValueError: one has another shape.
    """
    result: Answer = call_overload("findFundamentalMat", _FUNDAMENTAL_OVERLOADS, args, kwargs)
    return result


def matchMGCA(
    size1: Sequence[int],
    size2: Sequence[int],
    keypoints1: Sequence[cv2.KeyPoint],
    keypoints2: Sequence[cv2.KeyPoint],
    matches1to2: Sequence[cv2.DMatch] | Sequence[Sequence[cv2.DMatch]],
    withRotation: bool = False,
    withScale: bool = False,
    thresholdFactor: float = 6.0,
) -> tuple[cv2.DMatch, ...]:
    """The matches that agree with one camera motion; shaped like ``cv2.xfeatures2d.matchGMS``.

    Args:
        size1, size2: (width, height) of the images, pixels.
        keypoints1, keypoints2: of both images.
        matches1to2: one-way nearest neighbours; ``knnMatch`` rows too, whose ratio the network uses.
        withRotation, withScale, thresholdFactor: settings of GMS, accepted so that calls need no change, and without
            effect: the filter handles rotation and scale in any case and sets no such threshold.

    Returns:
        The kept matches in their order; none where the images show no common geometry.

    Raises:
        TypeError, ValueError: an argument is of another type, shape or range.
    """
    result = filter_matches(keypoints1, keypoints2, matches1to2, size1=size1, size2=size2)
    _log.info("matchMGCA: %s", result.status.value)
    return tuple(match if isinstance(match, cv2.DMatch) else match[0] for match in result.matches)


def _essential_of_one_camera(
    points1: Any,
    points2: Any,
    cameraMatrix: Any,
    method: int = cv2.RANSAC,
    prob: float = 0.999,
    threshold: float = 1.0,
    maxIters: int = 1000,
    mask: Any = None,
) -> Answer:
    fit = _read_fit(prob, threshold, maxIters)
    return _fit_essential(points1, points2, cameraMatrix, cameraMatrix, None, None, fit, mask)


def _essential_of_focal_length(
    points1: Any,
    points2: Any,
    focal: float = 1.0,
    pp: Sequence[float] = (0.0, 0.0),
    method: int = cv2.RANSAC,
    prob: float = 0.999,
    threshold: float = 1.0,
    maxIters: int = 1000,
    mask: Any = None,
) -> Answer:
    K = np.array([[focal, 0.0, pp[0]], [0.0, focal, pp[1]], [0.0, 0.0, 1.0]])
    return _fit_essential(points1, points2, K, K, None, None, _read_fit(prob, threshold, maxIters), mask)


def _essential_of_two_cameras(
    points1: Any,
    points2: Any,
    cameraMatrix1: Any,
    distCoeffs1: Any,
    cameraMatrix2: Any,
    distCoeffs2: Any,
    method: int = cv2.RANSAC,
    prob: float = 0.999,
    threshold: float = 1.0,
    mask: Any = None,
) -> Answer:
    fit = _read_fit(prob, threshold, 1000)
    return _fit_essential(points1, points2, cameraMatrix1, cameraMatrix2, distCoeffs1, distCoeffs2, fit, mask)


def _essential_by_params(
    points1: Any,
    points2: Any,
    cameraMatrix1: Any,
    cameraMatrix2: Any,
    dist_coeff1: Any,
    dist_coeff2: Any,
    params: cv2.UsacParams,
    mask: Any = None,
) -> Answer:
    fit = _read_params(params)
    return _fit_essential(points1, points2, cameraMatrix1, cameraMatrix2, dist_coeff1, dist_coeff2, fit, mask)


def _fundamental_of_points(
    points1: Any,
    points2: Any,
    method: int = cv2.FM_RANSAC,
    ransacReprojThreshold: float = 3.0,
    confidence: float = 0.99,
    mask: Any = None,
) -> Answer:
    return _fundamental_with_limit(points1, points2, method, ransacReprojThreshold, confidence, 1000, mask)


def _fundamental_with_limit(
    points1: Any,
    points2: Any,
    method: int,
    ransacReprojThreshold: float,
    confidence: float,
    maxIters: int,
    mask: Any = None,
) -> Answer:
    if method in _SOLVERS:
        return _solve_fundamental(points1, points2, method, mask)
    threshold = ransacReprojThreshold if ransacReprojThreshold > 0 else 3.0
    confidence = confidence if 0.0 < confidence < 1.0 else 0.99
    return _fit_fundamental(points1, points2, _read_fit(confidence, threshold, maxIters), mask)


def _fundamental_by_params(points1: Any, points2: Any, params: cv2.UsacParams, mask: Any = None) -> Answer:
    return _fit_fundamental(points1, points2, _read_params(params), mask)


def _read_fit(confidence: float, threshold: float, max_iterations: int, seed: int = 0) -> FilterOptions:
    """Options of the filter from OpenCV's scalar arguments; the threshold stays in the unit of the points.

    Raises:
        TypeError, ValueError: one is of another type or range.
    """
    return FilterOptions(
        threshold=check_number(threshold, "threshold", 0.0, float("inf")),
        confidence=check_number(confidence, "prob", 0.0, 1.0),
        max_iterations=check_integer(max_iterations, "maxIters", 1),
        seed=seed,
    )


def _read_params(params: cv2.UsacParams) -> FilterOptions:
    """The same from ``cv2.UsacParams``; errors as :func:`_read_fit`."""
    seed = abs(int(params.randomGeneratorState))
    return _read_fit(params.confidence, params.threshold, params.maxIterations, seed)


def _fit_essential(
    points1: Any, points2: Any, K1: Any, K2: Any, dist1: Any, dist2: Any, options: FilterOptions, mask: Any
) -> Answer:
    """E (3, 3), or None where nothing can be found, and the mask (N, 1); arguments as in ``findEssentialMat``."""
    points1, points2 = _read_points(points1, points2)
    K1, K2 = (np.asarray(K, dtype=np.float64) for K in (K1, K2))
    pair = MatchPair(points1, points2, None, K1, K2, _coefficients(dist1), _coefficients(dist2))
    result = _run(pair, options, "findEssentialMat")
    E = result.E if result.E is not None else result.info["fitted_essential"]
    if E is None:
        E = _find_by_opencv(_find_essential_mat, points1, points2, K1, None, K2, None)
    return E, _as_opencv_mask(result.mask, mask)


def _fit_fundamental(points1: Any, points2: Any, options: FilterOptions, mask: Any) -> Answer:
    """F (3, 3), or None where nothing can be found, and the mask (N, 1); arguments as in ``findFundamentalMat``."""
    points1, points2 = _read_points(points1, points2)
    result = _run(MatchPair(points1, points2, None), options, "findFundamentalMat")
    F = result.F if result.F is not None else _find_by_opencv(_find_fundamental_mat, points1, points2)
    return _scaled(F), _as_opencv_mask(result.mask, mask)


def _find_by_opencv(function: Callable[..., Any], points1: Array, points2: Array, *arguments: Any) -> Array | None:
    """The matrix (3, 3) of OpenCV's own function, the first where it stacks several; None where it finds none."""
    usable = np.isfinite(points1).all(axis=1) & np.isfinite(points2).all(axis=1)
    try:
        M, _ = function(points1[usable], points2[usable], *arguments)
    except cv2.error:
        return None
    if M is None or np.shape(M)[0] < 3 or not np.isfinite(M[:3]).all():
        return None
    return np.asarray(M[:3], dtype=np.float64)


def _solve_fundamental(points1: Any, points2: Any, method: int, mask: Any) -> Answer:
    """OpenCV's 7- and 8-point solver; None and an empty mask where it refuses the points."""
    points1, points2 = _read_points(points1, points2)
    try:
        F, kept = _find_fundamental_mat(points1, points2, method)
    except cv2.error:
        F = None
    inliers = np.zeros(len(points1), dtype=bool) if F is None else np.asarray(kept).ravel() > 0
    return None if F is None else np.asarray(F, dtype=np.float64), _as_opencv_mask(inliers, mask)


def _run(pair: MatchPair, options: FilterOptions, name: str) -> FilterResult:
    result = MatchFilter(**vars(options)).filter_many([pair])[0]
    _log.info("%s: %s, %d of %d matches", name, result.status.value, result.num_inliers, len(result.mask))
    return result


def _read_points(points1: Any, points2: Any) -> tuple[Array, Array]:
    """Pixels (N, 2), (N, 2) from the layouts that OpenCV takes."""
    both = []
    for name, points in (("points1", points1), ("points2", points2)):
        both.append(read_keypoints(points, name).points)
    if len(both[0]) != len(both[1]):
        raise ValueError(f"points2: expected {len(both[0])} points like points1, got {len(both[1])}")
    return both[0], both[1]


def _coefficients(dist: Any) -> Any:
    """OpenCV takes an empty array for no distortion."""
    return None if dist is None or np.size(dist) == 0 else dist


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


_ESSENTIAL_OVERLOADS = (
    _essential_of_one_camera,
    _essential_of_focal_length,
    _essential_of_two_cameras,
    _essential_by_params,
)
_FUNDAMENTAL_OVERLOADS = (_fundamental_with_limit, _fundamental_of_points, _fundamental_by_params)
