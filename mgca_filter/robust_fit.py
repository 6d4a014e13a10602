"""Robust fit of the two-view model to scored matches; the only place that calls OpenCV's or PoseLib's estimators.

All points are on the normalised image planes and thresholds come in pixels with the mean focal length that
converts them. With intrinsics that can be trusted the model is an essential matrix; with guessed ones it is a
fundamental matrix, estimated in the same coordinates because they condition it well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .epipolar import essential_from_pose, project_to_essential, sampson_distance
from .pose_refinement import refine_pose

Array = NDArray[np.float64]

METHODS = ("prosac", "magsac", "ransac", "poselib", "none")
MIN_MATCHES = 8
# With the following local optimisation UsacParams returns, at seed 0, the very bits of the USAC_PROSAC preset,
# which alone cannot be seeded.
_PROSAC_LO_ITERATIONS, _PROSAC_LO_SAMPLE_SIZE = 20, 12
_POSELIB_MIN_ITERATIONS = 1000
# recoverPose drops points farther than 50 baselines unless told otherwise.
_ANY_DISTANCE = 1e9


@dataclass(frozen=True)
class RobustFitOptions:
    """Options of the robust fit.

    Attributes:
        method: ``"prosac"``, ``"magsac"``, ``"ransac"`` or ``"poselib"``; PROSAC and PoseLib use the order.
        threshold_px: Sampson distance that the estimator takes for an inlier, pixels.
        confidence: probability that a sample without outliers was drawn.
        max_iterations: largest number of samples.
        seed: of the estimator's random numbers.
        refine: finish with least squares on the pose.
        refine_threshold_px: where the refinement cuts the error off, pixels.
    """

    method: str = "prosac"
    threshold_px: float = 0.75
    confidence: float = 0.9999
    max_iterations: int = 5000
    seed: int = 0
    refine: bool = True
    refine_threshold_px: float = 1.0


@dataclass(frozen=True)
class TwoViewModel:
    """Model of a pair of images, on the normalised image planes.

    Attributes:
        M: (3, 3) of unit Frobenius norm, ``x2^T M x1 = 0``: the essential matrix, or, with guessed intrinsics,
            the fundamental matrix expressed in normalised coordinates.
        E: (3, 3) essential matrix of unit Frobenius norm. R: (3, 3) rotation. t: (3,) unit norm.
    """

    M: Array
    E: Array
    R: Array
    t: Array


def match_order(
    scores: NDArray[np.float32], ratio: NDArray[np.float32], ratio_known: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Rows of the matches (N,), most promising first: the order in which PROSAC draws.

    Saturated scores order badly among themselves; the descriptor ratio, where it is known, tells them apart.
    """
    quality = scores.astype(np.float64) * np.where(ratio_known, 1.2 - ratio.astype(np.float64), 1.0)
    return np.argsort(-quality, kind="stable")


def estimate_model(
    correspondences: Array,
    order: NDArray[np.intp],
    focal_px: float,
    options: RobustFitOptions = RobustFitOptions(),
    calibrated: bool = True,
) -> TwoViewModel | None:
    """Fit the two-view model to the matches that ``order`` names, best first.

    Args:
        correspondences: (N, 4) on the normalised image planes, finite.
        order: (K,) rows of ``correspondences`` to fit to, the most promising first.
        focal_px: mean focal length, pixels: converts the thresholds.
        options: method, thresholds, seed.
        calibrated: the intrinsics can be trusted: estimate E with five points; else F with seven.

    Returns:
        The model, or None where the matches are too few or the estimator finds nothing. Never raises for data.

    Raises:
        ImportError: ``method="poselib"`` without PoseLib.
    """
    rows = np.ascontiguousarray(correspondences[order], dtype=np.float64)
    rows = rows[_first_of_equals(rows)]
    if len(rows) < MIN_MATCHES:
        return None
    if options.method == "poselib":
        M = _fit_poselib(rows, focal_px, options, calibrated)
    else:
        M = _fit_opencv(rows, focal_px, options, calibrated)
    if M is None:
        return None
    near = sampson_distance(rows, M) < options.refine_threshold_px / focal_px
    E = project_to_essential(M)
    pose = pose_from_essential(E, rows[near])
    if pose is None:
        return None
    R, t = pose
    if calibrated:
        if options.refine:
            R, t = refine_pose(rows, R, t, options.refine_threshold_px / focal_px)
        E = essential_from_pose(R, t)
        M = E
    return TwoViewModel(M=M, E=E, R=R, t=t)


def estimate_pose(
    correspondences: Array,
    order: NDArray[np.intp],
    focal_px: float,
    options: RobustFitOptions = RobustFitOptions(),
) -> tuple[Array, Array] | None:
    """Relative pose R (3, 3), t (3,) of calibrated images, or None; arguments as in :func:`estimate_model`."""
    model = estimate_model(correspondences, order, focal_px, options)
    return None if model is None else (model.R, model.t)


def pose_from_essential(E: Array, correspondences: Array) -> tuple[Array, Array] | None:
    """The pose of an essential matrix (3, 3) that puts most of the matches (N, 4) in front of both cameras."""
    if len(correspondences) == 0:
        return None
    x1, x2 = (np.ascontiguousarray(part) for part in (correspondences[:, :2], correspondences[:, 2:]))
    try:
        _, R, t, _, _ = cv2.recoverPose(E, x1, x2, np.eye(3), distanceThresh=_ANY_DISTANCE)
    except cv2.error:
        return None
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    return np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()


def fit_homography(points1: Array, points2: Array, threshold_px: float, seed: int = 0) -> Array | None:
    """Homography (3, 3) with ``p2 ~ H p1`` of pixels (N, 2), scaled to H[2, 2] = 1, or None."""
    if len(points1) < 4:
        return None
    try:
        params = _usac_params(cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC, threshold_px, 0.999, 2000, seed)
        H, _ = cv2.findHomography(np.ascontiguousarray(points1), np.ascontiguousarray(points2), params)
    except cv2.error:
        return None
    if H is None or not np.isfinite(H).all() or abs(H[2, 2]) < 1e-12:
        return None
    return np.asarray(H / H[2, 2], dtype=np.float64)


def _first_of_equals(rows: Array) -> NDArray[np.intp]:
    """Positions of the distinct rows in their order: a match that is listed ten times supports a model once."""
    _, first = np.unique(rows, axis=0, return_index=True)
    return np.sort(first)


def _usac_params(
    sampler: int, score: int, threshold: float, confidence: float, max_iterations: int, seed: int
) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.sampler, params.score = sampler, score
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.loIterations, params.loSampleSize = _PROSAC_LO_ITERATIONS, _PROSAC_LO_SAMPLE_SIZE
    params.threshold, params.confidence = threshold, confidence
    params.maxIterations, params.randomGeneratorState = max_iterations, seed % 2**31
    return params


def _fit_opencv(rows: Array, focal_px: float, options: RobustFitOptions, calibrated: bool) -> Array | None:
    """The model by one of OpenCV's estimators; None where it finds nothing."""
    threshold = options.threshold_px / focal_px
    if options.method == "ransac" and options.seed:
        # The classic RANSAC has a generator of its own with a fixed seed: shuffling is what changes its draws.
        rows = rows[np.random.default_rng(options.seed).permutation(len(rows))]
    x1, x2 = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    try:
        if options.method == "ransac":
            limits = {"maxIters": options.max_iterations}
            if calibrated:
                M, _ = cv2.findEssentialMat(
                    x1, x2, np.eye(3), method=cv2.RANSAC, prob=options.confidence, threshold=threshold, **limits
                )
            else:
                M, _ = cv2.findFundamentalMat(x1, x2, cv2.FM_RANSAC, threshold, options.confidence, **limits)
        else:
            prosac = options.method == "prosac"
            params = _usac_params(
                cv2.SAMPLING_PROSAC if prosac else cv2.SAMPLING_UNIFORM,
                cv2.SCORE_METHOD_MSAC if prosac else cv2.SCORE_METHOD_MAGSAC,
                threshold,
                options.confidence,
                options.max_iterations,
                options.seed,
            )
            if calibrated:
                M, _ = cv2.findEssentialMat(x1, x2, np.eye(3), np.eye(3), None, None, params)
            else:
                M, _ = cv2.findFundamentalMat(x1, x2, params)
    except cv2.error:
        return None
    return _best_of_stack(M, rows, threshold)


def _best_of_stack(M: Any, rows: Array, threshold: float) -> Array | None:
    """The best of the models that OpenCV stacks, (3k, 3), of unit Frobenius norm; None where none is usable."""
    if M is None or np.size(M) == 0 or np.size(M) % 9:
        return None
    models = [m / norm for m in np.reshape(M, (-1, 3, 3)) if np.isfinite(norm := np.linalg.norm(m)) and norm > 0]
    costs = [np.sum(np.minimum(sampson_distance(rows, m), threshold) ** 2) for m in models]
    return np.asarray(models[int(np.argmin(costs))], dtype=np.float64) if models else None


def _fit_poselib(rows: Array, focal_px: float, options: RobustFitOptions, calibrated: bool) -> Array | None:
    """The model by PoseLib's LO-RANSAC with progressive sampling; None where it finds nothing."""
    try:
        import poselib
    except ImportError as error:
        raise ImportError("method='poselib' needs PoseLib: pip install 'mgca-filter[poselib]'") from error
    ransac = {
        "max_epipolar_error": options.threshold_px,
        "progressive_sampling": True,
        "success_prob": options.confidence,
        "max_iterations": options.max_iterations,
        "min_iterations": min(_POSELIB_MIN_ITERATIONS, options.max_iterations),
        "seed": options.seed,
    }
    # One camera of the mean focal length puts PoseLib's thresholds in the pixels that this package uses.
    points1, points2 = rows[:, :2] * focal_px, rows[:, 2:] * focal_px
    if not calibrated:
        F, _ = poselib.estimate_fundamental(points1, points2, ransac, {})
        scale = np.diag([focal_px, focal_px, 1.0])
        return _best_of_stack(scale @ F @ scale, rows, options.threshold_px / focal_px)
    camera = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal_px, 0.0, 0.0]}
    pose, information = poselib.estimate_relative_pose(points1, points2, camera, camera, ransac, {})
    if information.get("num_inliers", 0) == 0:
        return None
    return _best_of_stack(essential_from_pose(pose.R, pose.t), rows, options.threshold_px / focal_px)
