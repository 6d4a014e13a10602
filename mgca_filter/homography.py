"""Homographies: fit, residual, and the relative poses that a plane allows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .epipolar import homogeneous

Array = NDArray[np.float64]

# A homography constrains both coordinates and planes are seldom perfect: it gets twice the threshold of E.
HOMOGRAPHY_THRESHOLD_FACTOR = 2.0
# With this local optimisation UsacParams returns, at seed 0, the very bits of OpenCV's USAC_PROSAC preset, which
# cannot be seeded itself.
_LO_ITERATIONS, _LO_SAMPLE_SIZE = 20, 12
_CONFIDENCE, _MAX_ITERATIONS = 0.999, 1000


def usac_params(
    sampler: int, score: int, threshold: float, confidence: float, max_iterations: int, seed: int
) -> cv2.UsacParams:
    """OpenCV's estimator settings; ``sampler`` and ``score`` are ``cv2.SAMPLING_*`` and ``cv2.SCORE_METHOD_*``."""
    params = cv2.UsacParams()
    params.sampler, params.score = sampler, score
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.loIterations, params.loSampleSize = _LO_ITERATIONS, _LO_SAMPLE_SIZE
    params.threshold, params.confidence = threshold, confidence
    params.maxIterations, params.randomGeneratorState = max_iterations, seed % 2**31
    return params


def fit_homography(points1: Array, points2: Array, threshold: float, seed: int = 0) -> Array | None:
    """Homography (3, 3) with ``p2 ~ H p1`` of points (N, 2), scaled to H[2, 2] = 1, or None.

    Args:
        threshold: transfer error of an inlier, in the unit of the points. seed: of the sampling.
    """
    if len(points1) < 4:
        return None
    # OpenCV holds some constants in pixels: in units of the threshold, any coordinates look like pixels to it.
    scale = np.diag([1.0 / threshold, 1.0 / threshold, 1.0])
    params = usac_params(cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC, 1.0, _CONFIDENCE, _MAX_ITERATIONS, seed)
    try:
        H, _ = cv2.findHomography(points1 / threshold, points2 / threshold, params)
    except cv2.error:
        return None
    if H is None or np.shape(H) != (3, 3) or not np.isfinite(H).all():
        return None
    H = np.linalg.inv(scale) @ H @ scale
    if abs(H[2, 2]) < 1e-12:
        return None
    return np.asarray(H / H[2, 2], dtype=np.float64)


def poses_from_homography(H: Array) -> list[tuple[Array, Array]]:
    """Relative poses R (3, 3), t (3,) unit norm under which a plane induces ``H`` between normalised points.

    Up to four (Malis & Vargas 2007); none where H is a rotation.
    """
    try:
        _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    except cv2.error:
        return []
    poses = []
    for R, t in zip(rotations, translations):
        norm = float(np.linalg.norm(t))
        if np.isfinite(R).all() and np.isfinite(norm) and norm > 1e-9:
            poses.append((np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel() / norm))
    return poses


def homography_distance(points1: Array, points2: Array, H: Array) -> Array:
    """Distance (N,) of matches to a homography ``p2 ~ H p1``, in the unit of the points.

    Half the root of the summed squared transfer errors in both directions: like Sampson's, it splits the error
    between the two images. Infinite where a point maps to infinity.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        forward = _transfer(points1, H) - points2
        backward = _transfer(points2, np.asarray(np.linalg.pinv(H), dtype=np.float64)) - points1
        distance = 0.5 * np.sqrt(np.sum(forward**2, axis=1) + np.sum(backward**2, axis=1))
    return np.where(np.isfinite(distance), distance, np.inf)


def _transfer(points: Array, H: Array) -> Array:
    mapped = homogeneous(points) @ H.T
    transferred: Array = mapped[:, :2] / mapped[:, 2:]
    return transferred
