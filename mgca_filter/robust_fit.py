"""Robust fit of the two-view model to scored matches: with ``homography.py`` the only caller of OpenCV's estimators.

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
from .homography import HOMOGRAPHY_THRESHOLD_FACTOR, fit_homography, poses_from_homography, usac_params
from .pose_refinement import refine_pose, truncated_cost

Array = NDArray[np.float64]

METHODS = ("prosac", "magsac", "ransac", "poselib", "none")
MIN_MATCHES = 8
# A pose from the dominant plane is worth refining when it starts below this multiple of the cost to beat.
RIVAL_COST_FACTOR = 1.5
_POSELIB_MIN_ITERATIONS = 1000
# Bound at import: ``patch_cv2`` swaps the names in cv2, and the fit must not call the filter that it is part of.
_find_essential_mat, _find_fundamental_mat = cv2.findEssentialMat, cv2.findFundamentalMat
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
        refine: finish with least squares on the pose, from this model and from the dominant plane's.
        refine_threshold_px: where the refinement cuts the error off, pixels.
    """

    method: str = "prosac"
    threshold_px: float = 0.5
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
            R, t = _refine_best_start(rows, R, t, focal_px, options)
        E = essential_from_pose(R, t)
        M = E
    return TwoViewModel(M=M, E=E, R=R, t=t)


def _refine_best_start(
    rows: Array, R: Array, t: Array, focal_px: float, options: RobustFitOptions
) -> tuple[Array, Array]:
    """Refine the pose and its rivals from the dominant plane; keep the one of least truncated cost.

    Where most matches lie on one plane two poses explain them about equally well, and sampling meets one of them
    by chance. The few matches off the plane, and the depths, tell which is right.
    """
    threshold = options.refine_threshold_px / focal_px
    R, t = refine_pose(rows, R, t, threshold)
    near = rows[sampson_distance(rows, essential_from_pose(R, t)) < threshold]
    H = fit_homography(near[:, :2], near[:, 2:], HOMOGRAPHY_THRESHOLD_FACTOR * threshold, options.seed)
    poses = [(R, t)]
    limit = RIVAL_COST_FACTOR * truncated_cost(rows, R, t, threshold)
    for start in [] if H is None else poses_from_homography(H):
        if truncated_cost(rows, *start, threshold) < limit:
            poses.append(refine_pose(rows, *start, threshold))
    return poses[int(np.argmin([truncated_cost(rows, *pose, threshold, in_front=True) for pose in poses]))]


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


def _first_of_equals(rows: Array) -> NDArray[np.intp]:
    """Positions of the distinct rows in their order: a match that is listed ten times supports a model once."""
    _, first = np.unique(rows, axis=0, return_index=True)
    return np.sort(first)


def _fit_opencv(rows: Array, focal_px: float, options: RobustFitOptions, calibrated: bool) -> Array | None:
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
            prosac = options.method == "prosac"
            sampler = cv2.SAMPLING_PROSAC if prosac else cv2.SAMPLING_UNIFORM
            score = cv2.SCORE_METHOD_MSAC if prosac else cv2.SCORE_METHOD_MAGSAC
            params = usac_params(sampler, score, threshold, *limits, options.seed)
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
    costs = [np.sum(np.minimum(sampson_distance(rows, m), threshold) ** 2) for m in models]
    if not models:
        return None
    best = np.asarray(models[int(np.argmin(costs))], dtype=np.float64)
    return best / float(np.linalg.norm(best))


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
        return _best_of_stack(F, np.diag([focal_px, focal_px, 1.0]), rows, options.threshold_px / focal_px)
    camera = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal_px, 0.0, 0.0]}
    pose, information = poselib.estimate_relative_pose(points1, points2, camera, camera, ransac, {})
    if information.get("num_inliers", 0) == 0:
        return None
    return _best_of_stack(essential_from_pose(pose.R, pose.t), np.eye(3), rows, options.threshold_px / focal_px)
