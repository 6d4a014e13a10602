"""Robust fit of the two-view model to scored matches: several starts beside the network's own answer, refined, and the
choice between them.

All points are on the normalised image planes and thresholds come in pixels with the mean focal length that
converts them. With intrinsics that can be trusted the model is an essential matrix; with guessed ones it is a
fundamental matrix, estimated in the same coordinates because they condition it well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import (
    decompose_essential,
    essential_from_pose,
    pose_error_deg,
    project_to_essential,
    sampson_distance,
    triangulated_depths,
)
from ..geometry.homography import poses_from_homography
from ..geometry.pose_refinement import refine_pose
from ..inputs.options import FilterOptions
from .estimators import HOMOGRAPHY_THRESHOLD_FACTOR, EstimatorOptions, fit_epipolar, fit_homography
from .ranking import RankedMatches

Array = NDArray[np.float64]

MIN_MATCHES = 8
# A pose from the dominant plane is worth refining when it starts with this share of the support to beat.
RIVAL_SUPPORT_SHARE = 0.5
# Two starts that end this close together, both with this share of the best support, have found the answer.
AGREEMENT_DEG, AGREEMENT_SUPPORT_SHARE = 1.0, 0.97


@dataclass(frozen=True)
class Start:
    """One run of the estimator.

    Attributes:
        margin: it sees the matches whose logit lies above the decision threshold by more than this.
        threshold_factor: its threshold in multiples of the fit's.
    """

    margin: float = 0.0
    threshold_factor: float = 1.0


# Estimators stop at the first model that looks good enough and miss better ones; what they see decides which they
# meet. Up to four views of the matches, and the choice by support, find most of what any one of them would.
STARTS = (Start(-1.0, 2.0), Start(-1.0, 1.0), Start(0.0, 2.0), Start(-2.0, 1.0))
# PoseLib samples more thoroughly and takes longer: one is enough.
POSELIB_STARTS = (STARTS[2],)
SINGLE_START = (Start(),)


@dataclass(frozen=True)
class RobustFitOptions:
    """Options of the robust fit.

    Attributes:
        method: ``"prosac"``, ``"magsac"``, ``"ransac"`` or ``"poselib"``; PROSAC and PoseLib use the order.
        threshold_px: Sampson distance that the estimator takes for an inlier, pixels.
        confidence: probability that a sample without outliers was drawn.
        max_iterations: largest number of samples of a start.
        seed: of the estimator's random numbers.
        starts: runs of the estimator, of which the best-supported model is kept, and which end as soon as two poses
            agree, the network's among them; None = those that suit the method.
        refine: finish with least squares on the pose, from these models and from the dominant plane's.
        refine_threshold_px: where refinement and support cut the error off, pixels.
    """

    method: str = FilterOptions.method
    threshold_px: float = 0.5
    confidence: float = FilterOptions.confidence
    max_iterations: int = FilterOptions.max_iterations
    seed: int = FilterOptions.seed
    starts: tuple[Start, ...] | None = None
    refine: bool = True
    refine_threshold_px: float = 1.0

    @classmethod
    def of(cls, options: FilterOptions) -> RobustFitOptions:
        """What the filter's options ask of the fit."""
        return cls(
            method=options.method,
            confidence=options.confidence,
            max_iterations=options.max_iterations,
            seed=options.seed,
        )

    @property
    def runs(self) -> tuple[Start, ...]:
        """The starts, or those that suit the method."""
        if self.starts is not None:
            return self.starts
        return POSELIB_STARTS if self.method == "poselib" else STARTS

    def estimator(self, index: int) -> EstimatorOptions:
        """What start number ``index`` tells the estimator; each draws other samples."""
        threshold_px = self.runs[index].threshold_factor * self.threshold_px
        return EstimatorOptions(self.method, threshold_px, self.confidence, self.max_iterations, self.seed + index)


@dataclass(frozen=True)
class TwoViewModel:
    """Model of a pair of images, on the normalised image planes.

    Attributes:
        M: (3, 3) of unit Frobenius norm, ``x2^T M x1 = 0``: the essential matrix, or, with guessed intrinsics,
            the fundamental matrix expressed in normalised coordinates.
        E: (3, 3) essential matrix of unit Frobenius norm. R: (3, 3) rotation. t: (3,) unit norm.
        origin: where it was found: ``"network"``, ``"start 1"``, ``"start 2"``, … or ``"plane"``.
    """

    M: Array
    E: Array
    R: Array
    t: Array
    origin: str


@dataclass(frozen=True)
class _Fit:
    """The matrix M (3, 3) that the network or a start found, the matches (K, 4) to refine it on, and its name."""

    M: Array
    seen: Array
    origin: str


@dataclass(frozen=True)
class _Pose:
    """A pose, where it was found and how well it is supported."""

    R: Array
    t: Array
    origin: str
    support: float


def estimate_model(
    matches: RankedMatches,
    focal_px: float,
    options: RobustFitOptions = RobustFitOptions(),
    calibrated: bool = True,
    network_essential: NDArray[np.floating[Any]] | None = None,
) -> TwoViewModel | None:
    """Fit the two-view model to ranked matches.

    Args:
        matches: what may be fitted to.
        focal_px: mean focal length, pixels: converts the thresholds.
        options: method, thresholds, starts, seed.
        calibrated: the intrinsics can be trusted: estimate E with five points; else F with seven.
        network_essential: (3, 3) of any scale, the network's own E, which stands first among what the starts find; one
            that is not finite, and any with guessed intrinsics, is passed over.

    Returns:
        The model, or None where the matches are too few or the estimator finds nothing. Never raises for data.

    Raises:
        ImportError: ``method="poselib"`` without PoseLib.
    """
    if len(matches.correspondences) < MIN_MATCHES:
        return None
    fits = _fits(matches, focal_px, options, calibrated)
    if calibrated:
        return _best_calibrated(matches, chain(_proposed(matches, network_essential), fits), focal_px, options)
    return _best_uncalibrated(matches, fits, focal_px, options)


def _proposed(matches: RankedMatches, network_essential: NDArray[np.floating[Any]] | None) -> Iterator[_Fit]:
    """What the network proposes, to be refined on the matches that it accepts."""
    if network_essential is not None and np.isfinite(network_essential).all():
        yield _Fit(network_essential.astype(np.float64), matches.above(0.0).correspondences, "network")


def _fits(matches: RankedMatches, focal_px: float, options: RobustFitOptions, calibrated: bool) -> Iterator[_Fit]:
    """What the starts find, one after the other."""
    for index, start in enumerate(options.runs):
        seen = matches.above(start.margin).correspondences
        M = fit_epipolar(seen, focal_px, options.estimator(index), calibrated)
        if M is not None:
            yield _Fit(M, seen, f"start {index + 1}")


def _best_calibrated(
    matches: RankedMatches, fits: Iterable[_Fit], focal_px: float, options: RobustFitOptions
) -> TwoViewModel | None:
    """The best-supported pose among the refined fits and the plane's rivals of the best of them."""
    threshold = options.refine_threshold_px / focal_px
    poses: list[_Pose] = []
    for fit in fits:
        pose = pose_from_essential(project_to_essential(fit.M), fit.seen[sampson_distance(fit.seen, fit.M) < threshold])
        if pose is None:
            continue
        R, t = refine_pose(fit.seen, *pose, threshold) if options.refine else pose
        poses.append(_Pose(R, t, fit.origin, matches.pose_support(R, t, threshold)))
        if _agree(poses):
            break
    if not poses:
        return None
    best = max(poses, key=lambda pose: pose.support)
    if options.refine:
        rivals = _plane_rivals(matches, best, threshold, options.seed)
        best = max([best, *rivals], key=lambda pose: pose.support)
    E = essential_from_pose(best.R, best.t)
    return TwoViewModel(M=E, E=E, R=best.R, t=best.t, origin=best.origin)


def _agree(poses: Sequence[_Pose]) -> bool:
    """True where the best-supported pose has been found twice."""
    best = max(poses, key=lambda pose: pose.support)
    return any(
        other is not best
        and other.support > AGREEMENT_SUPPORT_SHARE * best.support
        and pose_error_deg(other.R, other.t, best.R, best.t) < AGREEMENT_DEG
        for other in poses
    )


def _best_uncalibrated(
    matches: RankedMatches, fits: Iterable[_Fit], focal_px: float, options: RobustFitOptions
) -> TwoViewModel | None:
    """The best-supported fundamental matrix, and the pose that the guessed intrinsics make of it."""
    threshold = options.refine_threshold_px / focal_px
    best = max(fits, key=lambda fit: matches.support(fit.M, threshold), default=None)
    if best is None:
        return None
    E = project_to_essential(best.M)
    pose = pose_from_essential(E, best.seen[sampson_distance(best.seen, best.M) < threshold])
    return None if pose is None else TwoViewModel(best.M, E, *pose, origin=best.origin)


def _plane_rivals(matches: RankedMatches, best: _Pose, threshold: float, seed: int) -> list[_Pose]:
    """Refined poses that the dominant plane of a pose's inliers allows.

    Where most matches lie on one plane two poses explain them about equally well, and sampling meets one of them
    by chance. The few matches off the plane, and the depths, tell which is right.
    """
    accepted = matches.above(0.0).correspondences
    near = accepted[sampson_distance(accepted, essential_from_pose(best.R, best.t)) < threshold]
    H = fit_homography(near[:, :2], near[:, 2:], HOMOGRAPHY_THRESHOLD_FACTOR * threshold, seed)
    rivals = []
    for start in [] if H is None else poses_from_homography(H):
        if matches.pose_support(*start, threshold) > RIVAL_SUPPORT_SHARE * best.support:
            R, t = refine_pose(accepted, *start, threshold)
            rivals.append(_Pose(R, t, "plane", matches.pose_support(R, t, threshold)))
    return rivals


def estimate_pose(
    matches: RankedMatches,
    focal_px: float,
    options: RobustFitOptions = RobustFitOptions(),
    network_essential: NDArray[np.floating[Any]] | None = None,
) -> tuple[Array, Array] | None:
    """Relative pose R (3, 3), t (3,) of calibrated images, or None; arguments as in :func:`estimate_model`."""
    model = estimate_model(matches, focal_px, options, network_essential=network_essential)
    return None if model is None else (model.R, model.t)


def pose_from_essential(E: Array, correspondences: Array) -> tuple[Array, Array] | None:
    """The pose of an essential matrix (3, 3) that puts most of the matches (N, 4) in front of both cameras.

    However far they are: ``cv2.recoverPose``, which takes five times as long, drops what is beyond its limit.
    """
    if len(correspondences) == 0 or not np.isfinite(E).all():
        return None

    def in_front(pose: tuple[Array, Array]) -> int:
        depth1, depth2 = triangulated_depths(correspondences, *pose)
        return int(np.count_nonzero((depth1 > 0) & (depth2 > 0)))

    return max(decompose_essential(E), key=in_front)
