"""From the fitted model to the answer: mask, matrices and status of a pair."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import fundamental_from_essential, sampson_distance
from ..geometry.homography import homography_distance
from ..inputs.options import FilterOptions
from ..inputs.pair import PairInput
from ..result import Status
from . import degeneracy
from .choice import Coefficients
from .estimators import HOMOGRAPHY_THRESHOLD_FACTOR, EstimatorOptions, fit_epipolar, fit_homography
from .evidence import MIN_MATCHES, Evidence, distinct_rows
from .focal_check import better_focal_factor
from .robust_fit import REFINE_PX, TwoViewModel

Array = NDArray[np.float64]

# The fundamental matrix that may contradict the intrinsics: a run on few, well-chosen matches.
THRESHOLD_PX, _F_ITERATIONS = 0.5, 1000


@dataclass(frozen=True)
class Verdict:
    """Status of a pair and what is left of its model; fields as in :class:`mgca_filter.FilterResult`."""

    status: Status
    mask: NDArray[np.bool_]
    E: Array | None = None
    F: Array | None = None
    R: Array | None = None
    t: Array | None = None
    info: dict[str, Any] = field(default_factory=dict)


def judge(
    pair: PairInput,
    model: TwoViewModel | None,
    evidence: Evidence,
    mask_threshold_px: float,
    coefficients: Coefficients,
    options: FilterOptions,
) -> Verdict:
    """Re-test all matches against the model and decide what it is worth.

    Args:
        pair: the pair, M matches.
        model: the fitted model, or None.
        evidence: what it was fitted to; what the network accepts bears witness.
        mask_threshold_px: Sampson distance below which a match is kept, pixels.
        coefficients: ``verdict``: confidence below which a pose is withheld, and below which it is doubtful.
        options: confidence and seed of the robust fits that the tests of degeneracy need.
    """
    nothing = np.zeros(len(pair.valid), dtype=bool)
    if count_distinct(pair.correspondences[pair.valid]) < MIN_MATCHES:
        return Verdict(Status.TOO_FEW_MATCHES, nothing)
    if model is None:
        return Verdict(Status.NO_GEOMETRY, nothing)
    threshold = REFINE_PX / pair.focal_px
    witnesses = evidence.above(0.0)
    near = sampson_distance(evidence.correspondences[witnesses], model.M) < threshold
    if np.count_nonzero(near) < MIN_MATCHES:
        witnesses = np.arange(len(evidence))
        near = sampson_distance(evidence.correspondences, model.M) < threshold
    fitted = evidence.correspondences[witnesses]
    inlier_rows, inliers = evidence.rows[witnesses[near]], fitted[near]
    if len(inliers) < MIN_MATCHES:
        return Verdict(Status.NO_GEOMETRY, nothing)
    support = degeneracy.measure_support(fitted, model.M, threshold)
    for part in (inliers[:, :2], inliers[:, 2:]):
        if degeneracy.explains(degeneracy.line_distance(part, threshold), threshold, support):
            return Verdict(Status.NO_GEOMETRY, nothing)
    info: dict[str, Any] = {"support": support.count, "log10_false_alarms": support.log10_nfa}
    suspicious = _contradicts_intrinsics(pair, fitted, support, options)
    withheld, doubtful = _doubts(model, support, coefficients)
    if withheld and not suspicious:
        return Verdict(Status.UNRELATED, nothing, info=info)
    verdict = _keep_model(pair, model, mask_threshold_px, info)
    if suspicious:
        return replace(verdict, status=Status.SUSPICIOUS_INTRINSICS)
    if doubtful:
        return replace(verdict, status=Status.LOW_SUPPORT)
    factor = better_focal_factor(fitted, model.R, model.t, threshold) if pair.calibrated else None
    if factor is not None:
        return replace(verdict, status=Status.SUSPICIOUS_INTRINSICS, info={**info, "focal_factor": factor})
    return _test_degenerate(pair, inlier_rows, support, mask_threshold_px, options.seed, verdict)


def _doubts(model: TwoViewModel, support: degeneracy.Support, coefficients: Coefficients) -> tuple[bool, bool]:
    """Whether the model is to be withheld, and whether it is doubtful.

    The confidence decides; a fundamental matrix, which has none, must be more than chance.
    """
    if model.confidence is not None:
        least, usable = coefficients["verdict"]
        return model.confidence < least, model.confidence < usable
    few = support.count < degeneracy.MIN_SUPPORT or support.log10_nfa > degeneracy.LOW_SUPPORT_LOG10_NFA
    return support.log10_nfa > degeneracy.UNRELATED_LOG10_NFA, few


def count_distinct(correspondences: Array) -> int:
    """Number of distinct rows of (N, 4)."""
    return len(distinct_rows(correspondences))


def _keep_model(pair: PairInput, model: TwoViewModel, mask_threshold_px: float, info: dict[str, Any]) -> Verdict:
    """The model as it is, with the mask of all matches."""
    F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K)
    mask = np.zeros(len(pair.valid), dtype=bool)
    if pair.calibrated:
        distance_px = sampson_distance(pair.correspondences[pair.valid], model.M) * pair.focal_px
    else:
        distance_px = sampson_distance(np.hstack(pair.pixels(pair.valid)), F)
    mask[pair.valid] = distance_px < mask_threshold_px
    return Verdict(Status.OK, mask, model.E, pair.fundamental_in_units(F), model.R, model.t, info)


def _contradicts_intrinsics(
    pair: PairInput, fitted: Array, support: degeneracy.Support, options: FilterOptions
) -> bool:
    """True where F, which knows no intrinsics, explains far more of the matches (N, 4) than the caller's allow."""
    if not pair.calibrated or 2 * support.count >= len(fitted):
        return False
    run = EstimatorOptions("prosac", 2.0 * THRESHOLD_PX, options.confidence, _F_ITERATIONS, options.seed)
    F = fit_epipolar(fitted, pair.focal_px, run, calibrated=False)
    if F is None:
        return False
    free = degeneracy.measure_support(fitted, F, REFINE_PX / pair.focal_px)
    return (
        free.count >= degeneracy.INTRINSICS_SUPPORT_FACTOR * support.count + degeneracy.MIN_SUPPORT
        and free.log10_nfa < degeneracy.LOW_SUPPORT_LOG10_NFA
    )


def _test_degenerate(
    pair: PairInput,
    inlier_rows: NDArray[np.intp],
    support: degeneracy.Support,
    mask_threshold_px: float,
    seed: int,
    verdict: Verdict,
) -> Verdict:
    """Replace the verdict where a rotation or a plane explains the inliers as well."""
    threshold_px = REFINE_PX
    points1, points2 = pair.pixels(inlier_rows)
    K1, K2 = pair.intrinsics1.K, pair.intrinsics2.K
    R = degeneracy.fit_rotation(pair.correspondences[inlier_rows], threshold_px / pair.focal_px)
    H = K2 @ R @ np.linalg.inv(K1)
    if degeneracy.explains(homography_distance(points1, points2, H), threshold_px, support):
        mask = np.zeros(len(pair.valid), dtype=bool)
        mask[pair.valid] = homography_distance(*pair.pixels(pair.valid), H) < mask_threshold_px
        info = {**verdict.info, "homography": pair.homography_in_units(H)}
        return Verdict(Status.PURE_ROTATION, mask, R=R, info=info)
    plane = fit_homography(points1, points2, HOMOGRAPHY_THRESHOLD_FACTOR * threshold_px, seed)
    if plane is not None and degeneracy.explains(homography_distance(points1, points2, plane), threshold_px, support):
        info = {**verdict.info, "homography": pair.homography_in_units(plane)}
        if pair.calibrated:
            return replace(verdict, status=Status.PLANAR, info=info)
        # Seven points on a plane leave F a family of solutions: it still sorts matches but holds no pose.
        return replace(verdict, status=Status.PLANAR, E=None, R=None, t=None, info=info)
    return verdict
