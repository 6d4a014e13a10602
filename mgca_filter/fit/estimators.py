"""OpenCV's and PoseLib's robust estimators of two-view models: one call, one model or None.

The only caller of robust estimators. Points lie on the normalised image planes; thresholds come in pixels with the mean
focal length that converts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import essential_from_pose, sampson_distance

Array = NDArray[np.float64]

# A homography constrains both coordinates and planes are seldom perfect: it gets twice the threshold of E.
HOMOGRAPHY_THRESHOLD_FACTOR = 2.0
_HOMOGRAPHY_CONFIDENCE, _HOMOGRAPHY_ITERATIONS = 0.999, 1000
# OpenCV's presets USAC_PROSAC and USAC_MAGSAC, which cannot be seeded themselves: with these settings UsacParams gives
# their very bits at seed 0. Sampler, score, local optimisation with its iterations and sample size.
_PRESETS = {
    "prosac": (cv2.SAMPLING_PROSAC, cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_INNER_LO, 20, 12),
    "magsac": (cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA, 10, 14),
    "homography": (cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_INNER_LO, 20, 12),
    "homography in order": (cv2.SAMPLING_PROSAC, cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_INNER_LO, 20, 12),
}
# A rough run: rounds of local optimisation, and the most that is asked of the probability of a clean sample.
_ROUGH_LO_ITERATIONS, _ROUGH_CONFIDENCE = 3, 0.95
# For F OpenCV's USAC_MAGSAC optimises on larger samples.
_MAGSAC_FUNDAMENTAL_LO_SAMPLE = 50
# PoseLib may take ten times as many before it gives up, which takes seconds.
_POSELIB_MAX_ITERATIONS = 10_000
# Bound at import: ``patch_cv2`` swaps the names in cv2, and the fit must not call the filter that it is part of.
_find_essential_mat, _find_fundamental_mat = cv2.findEssentialMat, cv2.findFundamentalMat
_find_homography = cv2.findHomography


@dataclass(frozen=True)
class EstimatorOptions:
    """Options of one run.

    Attributes:
        method: ``"prosac"``, ``"magsac"``, ``"ransac"`` or ``"poselib"``; PROSAC and PoseLib use the order.
        threshold_px: Sampson distance that counts as inlier, pixels.
        confidence: probability that a sample without outliers was drawn.
        max_iterations: largest number of samples.
        seed: of the random numbers.
        rough: of ``"magsac"``: the model is refined afterwards, and need not be good.
    """

    method: str = "prosac"
    threshold_px: float = 0.5
    confidence: float = 0.9999
    max_iterations: int = 5000
    seed: int = 0
    rough: bool = False


def fit_epipolar(rows: Array, focal_px: float, options: EstimatorOptions, calibrated: bool) -> Array | None:
    """Essential (``calibrated``) or fundamental matrix (3, 3) of unit Frobenius norm, in normalised coordinates.

    Args:
        rows: (N, 4) distinct matches on the normalised image planes, the most promising first.
        focal_px: mean focal length, pixels.
        options: of the estimator.
        calibrated: estimate E with five points; else F with seven.

    Returns:
        The matrix, or None where the estimator finds nothing.

    Raises:
        ImportError: ``method="poselib"`` without PoseLib.
    """
    if options.method == "poselib":
        return _fit_poselib(rows, focal_px, options, calibrated)
    return _fit_opencv(rows, focal_px, options, calibrated)


def _fit_opencv(rows: Array, focal_px: float, options: EstimatorOptions, calibrated: bool) -> Array | None:
    """The model by one of OpenCV's estimators; None where it finds nothing."""
    if options.method == "ransac" and options.seed:
        # The classic RANSAC has a generator of its own with a fixed seed: shuffling is what changes its draws.
        rows = rows[np.random.default_rng(options.seed).permutation(len(rows))]
    # For F OpenCV holds some constants in pixels (MAGSAC fails on the normalised plane); E it normalises itself.
    unit = 1.0 if calibrated else focal_px
    x1, x2 = (np.ascontiguousarray(part * unit) for part in (rows[:, :2], rows[:, 2:]))
    threshold = options.threshold_px / focal_px * unit
    limits = (options.confidence, options.max_iterations)
    try:
        if options.method == "ransac" and calibrated:
            M, _ = _find_essential_mat(x1, x2, np.eye(3), cv2.RANSAC, limits[0], threshold, limits[1])
        elif options.method == "ransac":
            M, _ = _find_fundamental_mat(x1, x2, cv2.FM_RANSAC, threshold, *limits)
        else:
            params = usac_params(options.method, threshold, *limits, options.seed)
            if options.rough:
                params.loIterations = _ROUGH_LO_ITERATIONS
                params.confidence = min(options.confidence, _ROUGH_CONFIDENCE)
            if not calibrated and options.method == "magsac":
                params.loSampleSize = _MAGSAC_FUNDAMENTAL_LO_SAMPLE
            if calibrated:
                # None, not zeros, for the distortion: a vector of coefficients crashes OpenCV 5.0 in this overload.
                M, _ = _find_essential_mat(x1, x2, np.eye(3), np.eye(3), None, None, params)
            else:
                M, _ = _find_fundamental_mat(x1, x2, params)
    except cv2.error:
        return None
    return _best_of_stack(M, np.diag([unit, unit, 1.0]), rows, options.threshold_px / focal_px)


def _best_of_stack(M: Any, scale: Array, rows: Array, threshold: float) -> Array | None:
    """The best of the models that an estimator stacks, (3k, 3); None where none is usable.

    Args:
        M: for points multiplied by ``scale`` (3, 3); the answer, of unit Frobenius norm, is for ``rows`` (N, 4).
    """
    if M is None or np.size(M) == 0 or np.size(M) % 9:
        return None
    models = [scale @ m @ scale for m in np.reshape(M, (-1, 3, 3)) if np.isfinite(m).all() and np.any(m)]
    if not models:
        return None
    best = 0
    if len(models) > 1:
        best = int(np.argmin([np.sum(np.minimum(sampson_distance(rows, m), threshold) ** 2) for m in models]))
    model = np.asarray(models[best], dtype=np.float64)
    return model / float(np.linalg.norm(model))


def _fit_poselib(rows: Array, focal_px: float, options: EstimatorOptions, calibrated: bool) -> Array | None:
    """The model by PoseLib's LO-RANSAC with progressive sampling; None where it finds nothing."""
    try:
        import poselib
    except ImportError as error:
        raise ImportError("method='poselib' needs PoseLib: pip install 'mgca_filter[poselib]'") from error
    ransac = {
        "max_epipolar_error": options.threshold_px,
        "progressive_sampling": True,
        "success_prob": options.confidence,
        "max_iterations": min(options.max_iterations, _POSELIB_MAX_ITERATIONS),
        "min_iterations": min(1000, options.max_iterations),
        "seed": options.seed,
    }
    # One camera of the mean focal length puts PoseLib's thresholds in the pixels that this package uses.
    points1, points2 = rows[:, :2] * focal_px, rows[:, 2:] * focal_px
    if not calibrated:
        F, information = poselib.estimate_fundamental(points1, points2, ransac, {})
        if information.get("num_inliers", 0) == 0:  # then F is whatever lay in memory
            return None
        return _best_of_stack(F, np.diag([focal_px, focal_px, 1.0]), rows, options.threshold_px / focal_px)
    camera = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal_px, 0.0, 0.0]}
    pose, information = poselib.estimate_relative_pose(points1, points2, camera, camera, ransac, {})
    if information.get("num_inliers", 0) == 0:
        return None
    return _best_of_stack(essential_from_pose(pose.R, pose.t), np.eye(3), rows, options.threshold_px / focal_px)


def usac_params(preset: str, threshold: float, confidence: float, max_iterations: int, seed: int) -> cv2.UsacParams:
    """OpenCV's settings of one of :data:`_PRESETS`."""
    params = cv2.UsacParams()
    params.sampler, params.score, params.loMethod, params.loIterations, params.loSampleSize = _PRESETS[preset]
    params.threshold, params.confidence = threshold, confidence
    params.maxIterations, params.randomGeneratorState = max_iterations, seed % 2**31
    return params


def fit_homography(
    points1: Array, points2: Array, threshold: float, seed: int = 0, ordered: bool = False
) -> Array | None:
    """Homography (3, 3) with ``p2 ~ H p1`` of points (N, 2), scaled to H[2, 2] = 1, or None.

    Args:
        threshold: transfer error of an inlier, in the unit of the points. seed: of the sampling.
        ordered: the most promising points come first, and are drawn first.
    """
    if len(points1) < 4:
        return None
    # OpenCV holds some constants in pixels: in units of the threshold, any coordinates look like pixels to it.
    scale = np.diag([1.0 / threshold, 1.0 / threshold, 1.0])
    preset = "homography in order" if ordered else "homography"
    params = usac_params(preset, 1.0, _HOMOGRAPHY_CONFIDENCE, _HOMOGRAPHY_ITERATIONS, seed)
    try:
        H, _ = _find_homography(points1 / threshold, points2 / threshold, params)
    except cv2.error:
        return None
    if H is None or np.shape(H) != (3, 3) or not np.isfinite(H).all():
        return None
    H = np.linalg.inv(scale) @ H @ scale
    if abs(H[2, 2]) < 1e-12:
        return None
    return np.asarray(H / H[2, 2], dtype=np.float64)
