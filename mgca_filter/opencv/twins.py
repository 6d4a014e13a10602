"""OpenCV's names, argument orders, defaults and return types over the filter.

What OpenCV's arguments mean here, for :func:`findEssentialMat` and :func:`findFundamentalMat`:

- *points*: bare points are all that these functions get, so the network judges by position alone. A script that had
  ratios, keypoint sizes and angles before the call has lost them by then: :func:`mgca_filter.filter_matches` takes the
  keypoints and matches themselves and does markedly better. Points in units of the focal length (``cameraMatrix`` the
  identity, threshold 1e-3) are recognised by their size.
- *method*: ``cv2.USAC_MAGSAC`` scores samples by MAGSAC; every other robust method gives the filter's default.
  ``cv2.FM_7POINT`` and ``cv2.FM_8POINT`` ask for a solver, not for a filter: they go to OpenCV as they are.
- *prob*, *confidence*: probability that the robust fit has drawn a sample without outliers. *maxIters*: its samples.
- *threshold*, *ransacReprojThreshold*: Sampson distance, pixels, up to which the mask calls a match an inlier. The fit
  itself works at a threshold of its own.
- *mask*: an output, as in OpenCV: an array uint8 (N, 1) passed in is written to; what it holds is not read.
- *UsacParams*: ``confidence``, ``threshold``, ``maxIterations`` and ``randomGeneratorState`` as above, ``score``
  chooses MAGSAC; the rest is not used.

What comes back: a matrix (3, 3) float64, never several stacked, or None; and always a mask (N, 1) of 0 and 1, uint8.
Data never raises. Where the images differ by a rotation alone there is no essential matrix: it is None, and the mask
marks the matches that agree with the rotation. ``mgca_filter``'s log (level INFO) tells the status of every call.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import cv2
import numpy as np

from ..match_filter import filter_matches
from .fit import Answer, fit_essential, fit_fundamental, read_fit, read_params, solve_fundamental
from .overloads import call_overload

Function = TypeVar("Function", bound=Callable[..., Any])

_SOLVERS = (cv2.FM_7POINT, cv2.FM_8POINT)

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
        E (3, 3) float64 of unit Frobenius norm, rank 2 and two equal singular values, ``x2^T E x1 = 0``, or None; and
        the mask (N, 1) uint8.

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
    fit = read_fit(method, prob, threshold, maxIters)
    return fit_essential(points1, points2, cameraMatrix, cameraMatrix, None, None, fit, mask)


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
    return fit_essential(points1, points2, K, K, None, None, read_fit(method, prob, threshold, maxIters), mask)


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
    fit = read_fit(method, prob, threshold, 1000)
    return fit_essential(points1, points2, cameraMatrix1, cameraMatrix2, distCoeffs1, distCoeffs2, fit, mask)


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
    fit = read_params(params)
    return fit_essential(points1, points2, cameraMatrix1, cameraMatrix2, dist_coeff1, dist_coeff2, fit, mask)


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
        return solve_fundamental(points1, points2, method, mask)
    threshold = ransacReprojThreshold if ransacReprojThreshold > 0 else 3.0
    confidence = confidence if 0.0 < confidence < 1.0 else 0.99
    return fit_fundamental(points1, points2, read_fit(method, confidence, threshold, maxIters), mask)


def _fundamental_by_params(points1: Any, points2: Any, params: cv2.UsacParams, mask: Any = None) -> Answer:
    return fit_fundamental(points1, points2, read_params(params), mask)


_ESSENTIAL_OVERLOADS = (
    _essential_of_one_camera,
    _essential_of_focal_length,
    _essential_of_two_cameras,
    _essential_by_params,
)
_FUNDAMENTAL_OVERLOADS = (_fundamental_with_limit, _fundamental_of_points, _fundamental_by_params)
