"""OpenCV's names, argument orders, defaults and return types over the filter.

What OpenCV's arguments mean here, for :func:`findEssentialMat`, :func:`findFundamentalMat`, :func:`findHomography`,
:func:`estimateAffine2D` and :func:`estimateAffinePartial2D`:

- *points*: bare points are all that these functions get, so the network judges by position alone. A script that had
  ratios, keypoint sizes and angles before the call has lost them by then: :func:`mgca_filter.filter_matches` takes the
  keypoints and matches themselves and does markedly better. Points in units of the focal length (``cameraMatrix`` the
  identity, threshold 1e-3) are recognised by their size.
- *method*: every robust method gives the filter's own fit, which asks MAGSAC and PROSAC among others and takes the most
  likely answer. ``cv2.FM_7POINT``, ``cv2.FM_8POINT`` and 0 for a homography ask for a solver, not for a filter: they go
  to OpenCV as they are. ``cv2.LMEDS``, which knows no threshold, gets 0.3 % of the extent of the second points where it
  estimates homographies, affine maps or similarities.
- *prob*, *confidence*: probability that the robust fit has drawn a sample without outliers. *maxIters*: its samples.
- *threshold*, *ransacReprojThreshold*: Sampson distance, pixels, up to which the mask calls a match an inlier; of
  homographies, affine maps and similarities the transfer error in the second image, as in OpenCV. The fit itself works
  at a threshold of its own.
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
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..fit.homography_fit import HomographyFit, HomographyOptions, estimate_homography
from ..fit.planarity import MEANINGFUL_LOG10_NFA, homography_false_alarms
from ..geometry.epipolar import essential_from_pose, project_to_essential
from ..geometry.homography import scaled_homography, transfer
from ..inputs.keypoints import read_keypoints
from ..inputs.options import FilterOptions, check_integer, check_number
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter, filter_matches
from ..result import FilterResult, Status
from .overloads import call_overload

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]
Answer = tuple["Array | None", Mask]

Function = TypeVar("Function", bound=Callable[..., Any])

_SOLVERS = (cv2.FM_7POINT, cv2.FM_8POINT)
# Bound at import, like those of the robust fit: the names in cv2 may be swapped.
_find_essential_mat, _find_fundamental_mat = cv2.findEssentialMat, cv2.findFundamentalMat


@dataclass(frozen=True)
class _Family:
    """A family of plane maps: OpenCV's own function for it, to which fewer points than ``fewest`` go as they are."""

    name: str
    by_opencv: Callable[..., Any]
    fewest: int


_HOMOGRAPHY = _Family("homography", cv2.findHomography, 5)
_AFFINE = _Family("affine", cv2.estimateAffine2D, 4)
_SIMILARITY = _Family("similarity", cv2.estimateAffinePartial2D, 3)

# Points of a map that extend over less than this are normalised; an image of this many pixels stands in for theirs.
_FEWEST_PIXELS, _USUAL_PIXELS = 10.0, 1000.0
# One plane's unit may be metres where the other's is pixels: a larger ratio of their extents is no zoom.
_LARGEST_ZOOM = 8.0
# LMedS knows no threshold: this share of the extent of the second points takes its place.
_LMEDS_THRESHOLD_SHARE = 3e-3
# The fit starts at this transfer error, pixels, or at the caller's threshold where that is smaller.
_MAP_FIT_THRESHOLD_PX = 3.0
# Where fewer of the matches that the caller's threshold admits lie within the fit's own, they are coarse.
_SHARP_SHARE = 0.7
_ROBUST_METHODS = (
    cv2.RANSAC, cv2.LMEDS, cv2.RHO, cv2.USAC_DEFAULT, cv2.USAC_PARALLEL, cv2.USAC_FM_8PTS, cv2.USAC_FAST,
    cv2.USAC_ACCURATE, cv2.USAC_PROSAC, cv2.USAC_MAGSAC,
)  # fmt: skip

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


@_typed_like(cv2.findHomography)
def findHomography(*args: Any, **kwargs: Any) -> Answer:
    """Homography and inlier mask, ``cv2.findHomography`` in all its overloads.

    ::

        findHomography(srcPoints, dstPoints[, method[, ransacReprojThreshold[, mask[, maxIters[, confidence]]]]])
        findHomography(srcPoints, dstPoints, params[, mask])

    Method 0 (least squares), points in three coordinates and fewer than five points go to OpenCV as they are. As
    OpenCV does, a threshold that is not positive becomes 3; it is the transfer error in the second image up to which
    the mask calls a match an inlier.

    Returns:
        H (3, 3) float64 with H[2, 2] = 1, ``p2 ~ H p1``, or None where OpenCV finds none either; and the mask (N, 1)
        uint8, all zero where the support of H is no more than chance gives.

    Raises:
        TypeError: the arguments fit no overload. ValueError: one has another shape or range. cv2.error: what OpenCV
        says of the calls that go to it.
    """
    result: Answer = call_overload("findHomography", _HOMOGRAPHY_OVERLOADS, args, kwargs)
    return result


@_typed_like(cv2.estimateAffine2D)
def estimateAffine2D(*args: Any, **kwargs: Any) -> Answer:
    """Affine map and inlier mask, ``cv2.estimateAffine2D`` in all its overloads.

    ::

        estimateAffine2D(from_, to[, inliers[, method[, ransacReprojThreshold[, maxIters[, confidence
                         [, refineIters]]]]]])
        estimateAffine2D(pts1, pts2, params[, inliers])

    Fewer than four points go to OpenCV as they are; ``refineIters`` has no effect, for the fit always refines.

    Returns:
        The map (2, 3) float64, or None where OpenCV finds none either; and the mask (N, 1), as in
        :func:`findHomography`, whose errors are these functions', too.
    """
    result: Answer = call_overload("estimateAffine2D", _AFFINE_OVERLOADS, args, kwargs)
    return result


@_typed_like(cv2.estimateAffinePartial2D)
def estimateAffinePartial2D(*args: Any, **kwargs: Any) -> Answer:
    """Similarity and inlier mask, ``cv2.estimateAffinePartial2D``; as :func:`estimateAffine2D`.

    ::

        estimateAffinePartial2D(from_, to[, inliers[, method[, ransacReprojThreshold[, maxIters[, confidence
                                [, refineIters]]]]]])

    Fewer than three points go to OpenCV as they are.
    """
    result: Answer = call_overload("estimateAffinePartial2D", _SIMILARITY_OVERLOADS, args, kwargs)
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


def _homography_of_points(
    srcPoints: Any,
    dstPoints: Any,
    method: int = 0,
    ransacReprojThreshold: float = 3.0,
    mask: Any = None,
    maxIters: int = 2000,
    confidence: float = 0.995,
) -> Answer:
    if method not in _ROBUST_METHODS or _is_opencvs_own(srcPoints, dstPoints, _HOMOGRAPHY):
        limits = (ransacReprojThreshold, mask, maxIters, confidence)
        return _with_mask(_HOMOGRAPHY.by_opencv(srcPoints, dstPoints, method, *limits), srcPoints)
    threshold = ransacReprojThreshold if ransacReprojThreshold > 0 else 3.0
    options = _read_fit(confidence, threshold, maxIters)
    return _fit_map(_HOMOGRAPHY, srcPoints, dstPoints, options, method == cv2.LMEDS, mask)


def _homography_by_params(srcPoints: Any, dstPoints: Any, params: cv2.UsacParams, mask: Any = None) -> Answer:
    return _map_by_params(_HOMOGRAPHY, srcPoints, dstPoints, params, mask)


def _affine_by_params(pts1: Any, pts2: Any, params: cv2.UsacParams, inliers: Any = None) -> Answer:
    return _map_by_params(_AFFINE, pts1, pts2, params, inliers)


def _map_by_params(family: _Family, points1: Any, points2: Any, params: cv2.UsacParams, mask: Any) -> Answer:
    if _is_opencvs_own(points1, points2, family):
        return _with_mask(family.by_opencv(points1, points2, params, mask), points1)
    return _fit_map(family, points1, points2, _read_params(params), False, mask)


def _affine_of_points(family: _Family) -> Callable[..., Answer]:
    """The overload with scalar arguments, which affine maps and similarities share."""

    def of_points(
        from_: Any,
        to: Any,
        inliers: Any = None,
        method: int = cv2.RANSAC,
        ransacReprojThreshold: float = 3.0,
        maxIters: int = 2000,
        confidence: float = 0.99,
        refineIters: int = 10,
    ) -> Answer:
        if method not in _ROBUST_METHODS or _is_opencvs_own(from_, to, family):
            limits = (ransacReprojThreshold, maxIters, confidence, refineIters)
            return _with_mask(family.by_opencv(from_, to, inliers, method, *limits), from_)
        options = _read_fit(confidence, ransacReprojThreshold, maxIters)
        return _fit_map(family, from_, to, options, method == cv2.LMEDS, inliers)

    return of_points


def _is_opencvs_own(points1: Any, points2: Any, family: _Family) -> bool:
    """True for points that are fewer than the family's fewest, or in three coordinates."""
    shapes = [np.shape(points) for points in (points1, points2)]
    return any(len(shape) > 1 and shape[-1] == 3 and 2 not in shape for shape in shapes) or any(
        int(np.prod(shape)) < 2 * family.fewest for shape in shapes
    )


def _with_mask(answer: tuple[Any, Any], points: Any) -> Answer:
    """OpenCV's answer with a mask in any case."""
    M, mask = answer
    count = max(np.shape(points)[:2])
    return M, np.zeros((count, 1), np.uint8) if mask is None else mask


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
    if result.status is Status.PURE_ROTATION and result.R is not None:
        E = _essential_of_rotation(result.R)
    elif (
        result.status is not Status.OK and np.array_equal(K1, K2) and _stood_still(points1, points2, options.threshold)
    ):
        E = _essential_of_rotation(np.eye(3))
    if E is None:
        E = _find_by_opencv(_find_essential_mat, points1, points2, K1, None, K2, None)
        E = None if E is None else project_to_essential(E)  # OpenCV's own is one to a few digits only
    return E, _as_opencv_mask(result.mask, mask)


def _stood_still(points1: Array, points2: Array, threshold: float) -> bool:
    """Most points (N, 2) moved less than the threshold: neither did the camera."""
    moved = np.linalg.norm(points2 - points1, axis=1)
    moved = moved[np.isfinite(moved)]
    return len(moved) > 0 and float(np.median(moved)) < threshold


def _essential_of_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """An essential matrix (3, 3) from which ``cv2.recoverPose`` takes this rotation.

    Where the camera only turned, no depth tells the two rotations that E allows apart, and OpenCV takes the first of
    its decomposition; which one that is hangs on the direction of translation, and any will do.
    """
    candidates = [essential_from_pose(R, t) for t in (*np.eye(3), *(1.0 - np.eye(3)), *-np.eye(3))]
    return max(candidates, key=lambda E: float(np.vdot(cv2.decomposeEssentialMat(E)[0], R)))


def _fit_fundamental(points1: Any, points2: Any, options: FilterOptions, mask: Any) -> Answer:
    """F (3, 3), or None where nothing can be found, and the mask (N, 1); arguments as in ``findFundamentalMat``."""
    points1, points2 = _read_points(points1, points2)
    result = _run(MatchPair(points1, points2, None), options, "findFundamentalMat")
    F = result.F if result.F is not None else _find_by_opencv(_find_fundamental_mat, points1, points2)
    return _scaled(F), _as_opencv_mask(result.mask, mask)


def _fit_map(family: _Family, points1: Any, points2: Any, options: FilterOptions, lmeds: bool, mask: Any) -> Answer:
    """A map of a family, (3, 3) or (2, 3), or None where nothing can be found, and the mask (N, 1)."""
    points1, points2 = _read_points(points1, points2)
    T1, T2 = _to_comparable_pixels(points1, points2)
    threshold = options.threshold * T2[0, 0]
    x1, x2 = transfer(points1, T1), transfer(points2, T2)
    if lmeds:
        threshold = max(_LMEDS_THRESHOLD_SHARE * _extent(x2), np.finfo(np.float64).tiny)
    scored = _run(MatchPair(x1, x2, None), replace(options, threshold=1.0, method="none"), family.name)
    found = _fit_in_pixels(family.name, np.hstack([x1, x2]), scored.scores.astype(np.float64), threshold, options)
    if found is None:
        return _map_by_opencv(family, points1, points2), _as_opencv_mask(np.zeros(len(points1), dtype=bool), mask)
    fit, meaningful = found
    distance = np.linalg.norm(transfer(x1, fit.H) - x2, axis=1)
    inlier = (distance < threshold) & np.isfinite(fit.distance) & meaningful
    H = scaled_homography(np.linalg.inv(T2) @ fit.H @ T1)
    return H if family is _HOMOGRAPHY else H[:2], _as_opencv_mask(inlier, mask)


def _fit_in_pixels(
    family: str, rows: Array, scores: Array, threshold: float, options: FilterOptions
) -> tuple[HomographyFit, bool] | None:
    """The fit to matches (N, 4) in pixels, and whether its support is more than chance; None where there is none.

    At a threshold of the fit's own first, for callers are generous; at theirs as well where the first finds nothing
    or where the matches that theirs admits spread beyond it, and the one that more matches agree with is kept.
    """
    order = np.argsort(-scores, kind="stable")
    usable = order[np.isfinite(rows[order]).all(axis=1)]
    best: tuple[int, HomographyFit, bool] | None = None
    for transfer_error in dict.fromkeys((min(threshold, _MAP_FIT_THRESHOLD_PX), threshold)):
        fit_options = HomographyOptions(
            threshold=transfer_error / np.sqrt(2.0),
            family=family,
            confidence=options.confidence,
            max_iterations=options.max_iterations,
            seed=options.seed,
            reflection=True,
        )
        fit = estimate_homography(rows, fit_options, scores, order)
        if fit is None:
            continue
        log10_nfa = homography_false_alarms(rows[usable], fit.H, fit_options.threshold, family=family)
        meaningful = log10_nfa < MEANINGFUL_LOG10_NFA
        admitted = int(np.count_nonzero(fit.distance < threshold / np.sqrt(2.0)))
        if best is None or (meaningful, admitted) > (best[2], best[0]):
            best = admitted, fit, meaningful
        if meaningful and np.count_nonzero(fit.inlier) > _SHARP_SHARE * admitted:
            break
    return None if best is None else best[1:]


def _to_comparable_pixels(points1: Array, points2: Array) -> tuple[Array, Array]:
    """Scales (3, 3) of both point sets that make numbers of pixels of them.

    The second's is 1 but for normalised points, and so is the first's unless its unit is another than the second's.
    """
    extents = [max(_extent(points), np.finfo(np.float64).tiny) for points in (points1, points2)]
    zoom2 = _USUAL_PIXELS / extents[1] if extents[1] < _FEWEST_PIXELS else 1.0
    ratio = extents[0] / (extents[1] * zoom2)
    zoom1 = 1.0 / ratio if not 1.0 / _LARGEST_ZOOM < ratio < _LARGEST_ZOOM else 1.0
    return np.diag([zoom1, zoom1, 1.0]), np.diag([zoom2, zoom2, 1.0])


def _map_by_opencv(family: _Family, points1: Array, points2: Array) -> Array | None:
    """OpenCV's own map where ours is none."""
    usable = np.isfinite(points1).all(axis=1) & np.isfinite(points2).all(axis=1)
    try:
        M, _ = family.by_opencv(points1[usable], points2[usable], method=cv2.RANSAC)
    except cv2.error:
        return None
    return None if M is None or np.size(M) == 0 or not np.isfinite(M).all() else np.asarray(M, dtype=np.float64)


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


def _extent(points: Array) -> float:
    """The longer side of the box around the finite points (N, 2)."""
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


_ESSENTIAL_OVERLOADS = (
    _essential_of_one_camera,
    _essential_of_focal_length,
    _essential_of_two_cameras,
    _essential_by_params,
)
_FUNDAMENTAL_OVERLOADS = (_fundamental_with_limit, _fundamental_of_points, _fundamental_by_params)
_HOMOGRAPHY_OVERLOADS = (_homography_of_points, _homography_by_params)
_AFFINE_OVERLOADS = (_affine_of_points(_AFFINE), _affine_by_params)
_SIMILARITY_OVERLOADS = (_affine_of_points(_SIMILARITY),)
