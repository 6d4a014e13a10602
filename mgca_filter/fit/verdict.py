"""From the fitted model to the answer: mask, matrices and status of a pair.

In order: is there anything to judge, does a rotation alone explain it, are the intrinsics contradicted, how sure is the
pose, and where it is not, does a plane explain the pair; else the pose stands, on one plane or not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import fundamental_from_essential, sampson_distance
from ..geometry.homography import homography_distance, sampson_distance_to_homography
from ..geometry.pose_refinement import direction_uncertainty_deg
from ..inputs.options import FilterOptions
from ..inputs.pair import PairInput
from ..result import Status
from . import degeneracy
from .choice import Coefficients
from .estimators import HOMOGRAPHY_THRESHOLD_FACTOR, EstimatorOptions, fit_epipolar, fit_homography
from .evidence import FIRM_MATCHES, MIN_MATCHES, Evidence, distinct_rows
from .focal_check import better_focal_factor
from .homography_fit import HomographyOptions, estimate_homography, polish_homography
from .planarity import (
    MEANINGFUL_LOG10_NFA,
    PARALLAX_LOG10_NFA,
    find_plane,
    homography_explains,
    homography_false_alarms,
    parallax_false_alarms,
)
from .robust_fit import REFINE_PX, TwoViewModel

Array = NDArray[np.float64]

# The fundamental matrix that may contradict the intrinsics: a run on few, well-chosen matches.
_CONTRADICTION_PX, _CONTRADICTION_ITERATIONS = 1.0, 1000
# A plane in doubt is looked for quickly first, at a generous threshold.
_QUICK_PLANE_PX = 3.0
_PLANE_PX = 2.0
# A plane on which fewer of the inliers lie is one of several of a scene with depth. Where the matches off it have fewer
# false alarms, log10, no other plane explains the pair.
_LEAST_PLANE_SHARE, _CLEAR_PARALLAX_LOG10_NFA = 0.7, -20.0
# Inliers that are hardly more than a pose takes must be this share of the list, which else holds as many by chance.
_FEW_SHARE = 2.0 / 3.0


@dataclass(frozen=True)
class Verdict:
    """Status of a pair and what is left of its model; fields as in :class:`mgca_filter.FilterResult`."""

    status: Status
    mask: NDArray[np.bool_]
    E: Array | None = None
    F: Array | None = None
    R: Array | None = None
    t: Array | None = None
    H: Array | None = None
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
    if len(evidence) < FIRM_MATCHES and too_few(pair):
        return Verdict(Status.TOO_FEW_MATCHES, nothing)
    if model is None:
        return Verdict(Status.NO_GEOMETRY, nothing)
    threshold = REFINE_PX / pair.focal_px
    witnesses = evidence.above(0.0)
    near = sampson_distance(evidence.correspondences[witnesses], model.M) < threshold
    if np.count_nonzero(near) < FIRM_MATCHES:
        witnesses = np.arange(len(evidence))
        near = sampson_distance(evidence.correspondences, model.M) < threshold
    fitted = evidence.correspondences[witnesses]
    inlier_rows, inliers = evidence.rows[witnesses[near]], fitted[near]
    doubted = not pair.calibrated or len(inliers) < _FEW_SHARE * len(fitted)
    if len(inliers) < (FIRM_MATCHES if doubted else MIN_MATCHES):
        return _plane_or(Verdict(Status.NO_GEOMETRY, nothing), pair, evidence, mask_threshold_px, options)
    support = degeneracy.measure_support(fitted, model.M, threshold)
    for part in (inliers[:, :2], inliers[:, 2:]):
        on_line = degeneracy.may_lie_on_line(part, threshold, support)
        if on_line and degeneracy.explains(degeneracy.line_distance(part, threshold), threshold, support):
            return Verdict(Status.NO_GEOMETRY, nothing)
    info: dict[str, Any] = {"support": support.count, "log10_false_alarms": support.log10_nfa}
    weak = support.count < degeneracy.MIN_SUPPORT or support.log10_nfa > degeneracy.LOW_SUPPORT_LOG10_NFA
    if not weak:
        turned = _test_rotation(pair, model, evidence.rows[witnesses], near, support, mask_threshold_px, info)
        if turned is not None:
            return turned
    suspicious = _contradicts_intrinsics(pair, fitted, support, options)
    withheld, doubtful = _doubts(model, support, weak, coefficients)
    doubtful = doubtful or len(inliers) < FIRM_MATCHES
    if withheld and not suspicious:
        unrelated = Verdict(Status.UNRELATED, nothing, info=info)
        return _plane_or(unrelated, pair, evidence, mask_threshold_px, options)
    residual = float(np.median(sampson_distance(inliers, model.M)))
    noise = max(degeneracy.TO_SIGMA * residual, degeneracy.LEAST_NOISE_PX / pair.focal_px)
    info["translation_sigma_deg"] = direction_uncertainty_deg(inliers, model.R, model.t, noise)
    verdict = _keep_model(pair, model.answer, mask_threshold_px, info)
    if suspicious:
        return replace(verdict, status=Status.SUSPICIOUS_INTRINSICS)
    if doubtful:
        plane = _plane_or(verdict, pair, evidence, mask_threshold_px, options)
        info = {**info, "homography": plane.H} if plane.H is not None else info
        return replace(verdict, status=Status.LOW_SUPPORT, H=plane.H, info=info)
    verdict = _test_plane(pair, model, evidence, (evidence.rows[witnesses], inlier_rows), support, options, verdict)
    factor = better_focal_factor(fitted, model.R, model.t, threshold) if pair.calibrated else None
    if factor is not None:
        info = {**verdict.info, "focal_factor": factor}
        return replace(verdict, status=Status.SUSPICIOUS_INTRINSICS, info=info)
    return verdict


def judge_homography(pair: PairInput, evidence: Evidence, mask_threshold_px: float, options: FilterOptions) -> Verdict:
    """The answer where the caller asks for a homography: the one that the matches support best, if it is no chance.

    Arguments as of :func:`judge`. E, F, R and t are None; the mask holds the matches within the threshold of it.
    """
    nothing = np.zeros(len(pair.valid), dtype=bool)
    if count_distinct(pair.correspondences[pair.valid]) < 4:
        return Verdict(Status.TOO_FEW_MATCHES, nothing)
    rows = np.hstack(pair.pixels(evidence.rows))
    plane = find_plane(rows, evidence.scores, None, None, options=_plane_options(options))
    if plane.H is None:
        return Verdict(Status.NO_GEOMETRY, nothing)
    info = {"support": plane.count, "log10_false_alarms": plane.log10_false_alarms}
    if not plane.meaningful:
        return Verdict(Status.UNRELATED, nothing, info=info)
    H = _polished_on_all(pair, plane.H, options)
    return _keep_homography(pair, H, Status.OK, mask_threshold_px, info)


def too_few(pair: PairInput) -> bool:
    """True where the distinct matches are fewer than a pose takes, or, without intrinsics, a fundamental matrix."""
    return count_distinct(pair.correspondences[pair.valid]) < (MIN_MATCHES if pair.calibrated else FIRM_MATCHES)


def count_distinct(correspondences: Array) -> int:
    """Number of distinct rows of (N, 4)."""
    return len(distinct_rows(correspondences))


def _doubts(
    model: TwoViewModel, support: degeneracy.Support, weak: bool, coefficients: Coefficients
) -> tuple[bool, bool]:
    """Whether the model is to be withheld, and whether it is doubtful.

    The confidence decides; a fundamental matrix, which has none, must be more than chance.
    """
    if model.confidence is not None:
        least, usable = coefficients["verdict"]
        return model.confidence < least, model.confidence < usable
    return support.log10_nfa > degeneracy.UNRELATED_LOG10_NFA, weak


def _keep_model(pair: PairInput, model: TwoViewModel, mask_threshold_px: float, info: dict[str, Any]) -> Verdict:
    """The model as it is, with the mask of all matches."""
    F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K)
    mask = np.zeros(len(pair.valid), dtype=bool)
    if pair.calibrated:
        distance_px = pair.epipolar_distance_px(pair.valid, model.M)
    else:
        distance_px = sampson_distance(np.hstack(pair.pixels(pair.valid)), F)
    mask[pair.valid] = distance_px < mask_threshold_px
    return Verdict(Status.OK, mask, model.E, pair.fundamental_in_units(F), model.R, model.t, info=info)


def _keep_homography(
    pair: PairInput, H: Array, status: Status, mask_threshold_px: float, info: dict[str, Any]
) -> Verdict:
    """A homography of the pixels as the model, with the mask of all matches."""
    mask = np.zeros(len(pair.valid), dtype=bool)
    rows = np.hstack(pair.pixels(pair.valid))
    mask[pair.valid] = sampson_distance_to_homography(rows, H) < mask_threshold_px
    H = pair.homography_in_units(H)
    return Verdict(status, mask, H=H, info={**info, "homography": H})


def _contradicts_intrinsics(
    pair: PairInput, fitted: Array, support: degeneracy.Support, options: FilterOptions
) -> bool:
    """True where F, which knows no intrinsics, explains far more of the matches (N, 4) than the caller's allow."""
    if not pair.calibrated or 2 * support.count >= len(fitted):
        return False
    run = EstimatorOptions("prosac", _CONTRADICTION_PX, options.confidence, _CONTRADICTION_ITERATIONS, options.seed)
    F = fit_epipolar(fitted, pair.focal_px, run, calibrated=False)
    if F is None:
        return False
    free = degeneracy.measure_support(fitted, F, REFINE_PX / pair.focal_px)
    return (
        free.count >= degeneracy.INTRINSICS_SUPPORT_FACTOR * support.count + degeneracy.MIN_SUPPORT
        and free.log10_nfa < degeneracy.LOW_SUPPORT_LOG10_NFA
    )


def _test_rotation(
    pair: PairInput,
    model: TwoViewModel,
    fitted_rows: NDArray[np.intp],
    near: NDArray[np.bool_],
    support: degeneracy.Support,
    mask_threshold_px: float,
    info: dict[str, Any],
) -> Verdict | None:
    """The verdict where a rotation alone explains as many matches, so that they say nothing of a translation.

    Args:
        fitted_rows: (N,) rows of the pair's matches that bear witness.
        near: (N,) bool, those of them that agree with the model.
    """
    zooms = np.stack([camera.K[:2, :2] for camera in (pair.intrinsics1, pair.intrinsics2)])
    shortest_px = float(np.linalg.svd(zooms, compute_uv=False).min())
    if not degeneracy.may_only_turn(pair.correspondences[fitted_rows], REFINE_PX / shortest_px, support):
        return None
    R = degeneracy.fit_rotation(pair.correspondences[fitted_rows[near]], REFINE_PX / pair.focal_px)
    H = pair.intrinsics2.K @ R @ np.linalg.inv(pair.intrinsics1.K)
    # Of a zoom both in pixels, whose noise is that of the keypoints in either image.
    rows = np.hstack(pair.pixels(fitted_rows))
    distance_px = sampson_distance_to_homography(rows, H)
    if not degeneracy.explains(distance_px, REFINE_PX, support, degeneracy.DIRECTION_FREEDOM):
        return None
    F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K)
    # All of them, for those that agree with the model are chosen by how little noise they have along one direction.
    if pair.calibrated and not degeneracy.prefers_rotation(distance_px, sampson_distance(rows, F)):
        return None
    verdict = _keep_homography(pair, H, Status.PURE_ROTATION, mask_threshold_px, info)
    return replace(verdict, R=R)


def _test_plane(
    pair: PairInput,
    model: TwoViewModel,
    evidence: Evidence,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    support: degeneracy.Support,
    options: FilterOptions,
    verdict: Verdict,
) -> Verdict:
    """The verdict with the homography that explains the inliers as well, where there is one.

    It explains nearly all of them; or most, and the others are no more than what an epipolar model, which is free to
    move about a plane, gathers by accident.

    Args:
        rows: of the pair's matches those that bear witness, and of these those that agree with the model.
    """
    fitted_rows, inlier_rows = rows
    points1, points2 = pair.pixels(inlier_rows)
    if model.plane is not None:
        found = pair.intrinsics2.K @ model.plane @ np.linalg.inv(pair.intrinsics1.K)
        distance_px = homography_distance(points1, points2, found)
        least = degeneracy.CLEAR_SHORTFALL * _LEAST_PLANE_SHARE
        if not degeneracy.may_explain(distance_px, REFINE_PX, support) and _explained_share(distance_px) < least:
            return verdict
    quick = fit_homography(points1, points2, HOMOGRAPHY_THRESHOLD_FACTOR * REFINE_PX, options.seed)
    if quick is None:
        return verdict
    distance_px = homography_distance(points1, points2, quick)
    explained = degeneracy.explains(distance_px, REFINE_PX, support)
    if not explained and _explained_share(distance_px) < _LEAST_PLANE_SHARE:
        return verdict
    H = None
    if not explained:
        fitted = np.hstack(pair.pixels(fitted_rows))
        F = fundamental_from_essential(model.M, pair.intrinsics1.K, pair.intrinsics2.K)
        log10_nfa = parallax_false_alarms(fitted, quick, F, REFINE_PX)
        if log10_nfa < _CLEAR_PARALLAX_LOG10_NFA:
            return verdict
        if log10_nfa <= PARALLAX_LOG10_NFA:
            H = _best_homography(pair, evidence, options, quick)
            if not homography_explains(fitted, H, F, REFINE_PX):
                return verdict
    H = pair.homography_in_units(_polished_on_all(pair, quick, options) if H is None else H)
    planar = replace(verdict, status=Status.PLANAR, H=H, info={**verdict.info, "homography": H})
    # Seven points on a plane leave F a family of solutions: it still sorts matches but holds no pose.
    return planar if pair.calibrated else replace(planar, E=None, R=None, t=None)


def _explained_share(distance_px: Array) -> float:
    return float(np.mean(distance_px < degeneracy.EXPLAINED_THRESHOLD_FACTOR * REFINE_PX))


def _plane_or(
    verdict: Verdict, pair: PairInput, evidence: Evidence, mask_threshold_px: float, options: FilterOptions
) -> Verdict:
    """A plane that explains a pair whose pose is doubtful, more than chance would; else the verdict as it is."""
    rows = np.hstack(pair.pixels(evidence.rows))
    sharp = rows[evidence.accepted()]
    quick = fit_homography(sharp[:, :2], sharp[:, 2:], _QUICK_PLANE_PX, options.seed, ordered=True)
    if quick is None or homography_false_alarms(sharp, quick, _PLANE_PX) > MEANINGFUL_LOG10_NFA:
        return verdict
    if verdict.F is None:
        H = _best_homography(pair, evidence, options, quick)
    else:  # beside a pose the plane is a remark
        H = _polished_on_all(pair, quick, options)
    log10_nfa = homography_false_alarms(rows, H, _PLANE_PX)
    agreeing = int(np.count_nonzero(sampson_distance_to_homography(sharp, H) < _PLANE_PX))
    if log10_nfa > MEANINGFUL_LOG10_NFA or agreeing < degeneracy.MIN_SUPPORT:
        return verdict
    info = {**verdict.info, "support": agreeing, "log10_false_alarms": log10_nfa}
    return _keep_homography(pair, H, Status.PLANAR, mask_threshold_px, info)


def _best_homography(pair: PairInput, evidence: Evidence, options: FilterOptions, quick: Array) -> Array:
    """The homography (3, 3) of the pixels that the matches support best; ``quick`` where none is found."""
    rows = np.hstack(pair.pixels(evidence.rows))
    fit = estimate_homography(rows, _plane_options(options), evidence.scores)
    return quick if fit is None else _polished_on_all(pair, fit.H, options)


def _polished_on_all(pair: PairInput, H: Array, options: FilterOptions) -> Array:
    """``H`` after least squares on all matches that agree with it: also on those that the network did not see, which
    hardly meet a homography by accident."""
    return polish_homography(np.hstack(pair.pixels(pair.valid)), H, _plane_options(options))


def _plane_options(options: FilterOptions) -> HomographyOptions:
    return HomographyOptions(threshold=_PLANE_PX, confidence=options.confidence, seed=options.seed)
