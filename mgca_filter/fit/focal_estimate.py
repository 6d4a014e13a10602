"""Focal lengths of both images from their matches alone: those under which a pose agrees best.

A fundamental matrix of two views with otherwise known intrinsics determines one that both share, unless the viewing
axes are parallel or meet (Hartley & Zisserman, 2nd ed., sec. 19.3; Sturm 2001). Poses are refined under focal lengths
on a grid, and what they leave of the matches, with a little belief in usual lenses, tells which is right and how
surely. Where one focal length leaves more than two would, the images are of two cameras (``focal_pair.py``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import project_to_essential, sampson_distance
from ..geometry.pose_refinement import refine_pose, truncated_cost
from .evidence import Evidence
from .focal_pair import FocalBelief, FocalPairFit
from .robust_fit import REFINE_PX, TwoViewModel, pose_from_essential

Array = NDArray[np.float64]

# Factors on the guessed focal length that are tried: from extreme wide-angle lenses to telephoto ones.
_FACTORS = np.geomspace(0.25, 4.0, 19)
# Where cameras lie from the guess, in the logarithm: mean and standard deviation over the scenes of the training data.
_USUAL, _USUAL_SPREAD = -0.3, 0.35
_THRESHOLD_PX = 2.0
# What makes of the curvature a standard deviation that two thirds of the training pairs keep.
_SIGMA_FACTOR, _LEAST_SIGMA = 3.0, 0.04
# Nobody zooms by more, usually: standard deviation of the logarithm of the ratio of which matches tell nothing.
_LARGEST_RATIO_SIGMA = 0.5
# How often a pose is within 10 degrees of the truth, by the log odds of the fit's confidence, which takes the focal
# lengths for known, and the logarithm of the degrees by which they leave it open: weights and offset, which
# `python -m benchmarks.without_intrinsics TRAIN --per-scene 8 --fit` finds.
_ODDS_WEIGHT, _SIGMA_WEIGHT, _OFFSET = 0.66, -0.80, 0.06
# From here on it is no more than even, whatever the fit says: less than half of such training poses are right.
_EVEN_SIGMA_DEG = 10.0
_LEAST_SIGMA_DEG, _LARGEST_SIGMA_DEG = 0.05, 180.0
_LEAST_CONFIDENCE = 1e-3
# Under a focal length far from the right one matches lie this far off before the pose is refined.
_REACH_PX = 16.0
_ROUNDS = 6
_MAX_ROWS = 300
_MIN_ROWS = 12
# Keypoints are not better than this.
_LEAST_NOISE_PX = 0.1
# With this share of the matches that agree with F an essential matrix takes its place.
_LEAST_AGREEMENT = 0.8


@dataclass(frozen=True)
class FocalEstimate:
    """Focal lengths of both images.

    Attributes:
        factors: on the guessed ones, of image 1 and 2; equal where both images share the factor.
        sigmas: standard deviations of their logarithms: 0.1 is ten per cent.
        ratio_sigma: the same of their ratio; where both images share the factor, how surely they do.
    """

    factors: tuple[float, float]
    sigmas: tuple[float, float]
    ratio_sigma: float = 0.0

    @property
    def shared(self) -> bool:
        """Both images have the same factor."""
        return self.factors[0] == self.factors[1]

    @property
    def covariance(self) -> Array:
        """Of the logarithms, (2, 2): both may be off together, and, as far as their ratio is open, against each other.

        Where both images share the factor, too: that they do is an assumption.
        """
        half = 0.5 * min(self.ratio_sigma, _LARGEST_RATIO_SIGMA)
        together, against = np.ones((2, 2)), np.array([[1.0, -1.0], [-1.0, 1.0]])
        return self.sigmas[0] * self.sigmas[1] * together + half**2 * against


def estimate_focals(evidence: Evidence, F: Array) -> list[FocalEstimate]:
    """The focal lengths under which the matches agree best with a pose.

    Args:
        evidence: scored matches, on the image planes normalised by the guessed focal lengths.
        F: (3, 3) in the same coordinates.

    Returns:
        Estimates, the most plausible first: two different factors where the matches ask for them, then one that both
        images share. None where the matches are few. Where they say little, the guess has the greater weight, and the
        standard deviation tells.
    """
    focal_px = evidence.focal_px
    agreeing = evidence.correspondences[evidence.above(0.0)]
    distance_px = sampson_distance(agreeing, F) * focal_px
    near = distance_px < REFINE_PX
    step = max(1, -(-int(np.count_nonzero(near)) // _MAX_ROWS))
    rows = agreeing[near][::step]
    if len(rows) < _MIN_ROWS:
        return []
    trials = [_pose_under(rows, F, factor, focal_px) for factor in _FACTORS]
    costs = np.array([trial.cost_px for trial in trials])
    shared, best = _shared_factor(costs, len(rows))
    estimates = [] if shared is None else [shared]
    trial = trials[best]
    if trial.R is not None and trial.t is not None and np.isfinite(trial.cost_px):
        noise_px = max(float(np.sqrt(np.mean(distance_px[near] ** 2))), _LEAST_NOISE_PX)
        fit = FocalPairFit(rows, _THRESHOLD_PX / focal_px, noise_px / focal_px, FocalBelief(_USUAL, _USUAL_SPREAD))
        two, ratio_sigma = fit.differing(trial.R, trial.t, float(np.log(_FACTORS[best])))
        estimates = [replace(estimate, ratio_sigma=ratio_sigma) for estimate in estimates]
        if two is not None:
            first, second = (float(factor) for factor in np.exp(two.logs))
            sigma1, sigma2 = (float(sigma) for sigma in np.hypot(two.sigmas, _LEAST_SIGMA))
            estimates.insert(0, FocalEstimate((first, second), (sigma1, sigma2), two.ratio_sigma))
    return estimates


def _shared_factor(costs: Array, count: int) -> tuple[FocalEstimate | None, int]:
    """The factor that both images share, and the position of the nearest on the grid, from costs (19,) in px²."""
    if not np.isfinite(costs).any():
        return None, 0
    # The noise is what the best of them leaves.
    noise = max(float(np.nanmin(costs)) / count, _LEAST_NOISE_PX**2)
    logs = np.log(_FACTORS)
    penalised = np.where(np.isfinite(costs), costs / noise, np.inf) + ((logs - _USUAL) / _USUAL_SPREAD) ** 2
    best = int(np.clip(np.argmin(penalised), 1, len(logs) - 2))
    if not np.isfinite(penalised[best - 1 : best + 2]).all():
        return None, best
    curve = np.polyfit(logs[best - 1 : best + 2], penalised[best - 1 : best + 2], 2)
    if curve[0] <= 0:
        return None, best
    at = float(np.clip(-curve[1] / (2.0 * curve[0]), logs[best - 1], logs[best + 1]))
    # A sum of squares over the noise rises by one at a standard deviation, if matches were independent.
    factor, sigma = float(np.exp(at)), float(np.hypot(_SIGMA_FACTOR / np.sqrt(curve[0]), _LEAST_SIGMA))
    return FocalEstimate((factor, factor), (sigma, sigma)), best


def agrees_as_well(evidence: Evidence, model: TwoViewModel, free: Evidence, free_model: TwoViewModel) -> bool:
    """True where nearly as many matches agree with an essential matrix as with the F that knows no intrinsics.

    Args:
        evidence, model: under the estimated focal length. free, free_model: under the guessed one.
    """
    counts = [
        np.count_nonzero(sampson_distance(e.correspondences[e.above(0.0)], m.M) < REFINE_PX / e.focal_px)
        for e, m in ((evidence, model), (free, free_model))
    ]
    return bool(counts[0] >= _LEAST_AGREEMENT * counts[1])


def pose_sigma_deg(evidence: Evidence, model: TwoViewModel, estimate: FocalEstimate) -> float:
    """Standard deviation of a pose, along its worst direction, that comes of the focal lengths' alone, degrees.

    Args:
        evidence, model: under the estimated focal lengths.
    """
    rows = evidence.correspondences[evidence.above(0.0)]
    rows = rows[sampson_distance(rows, model.M) < REFINE_PX / evidence.focal_px]
    if len(rows) < _MIN_ROWS:
        return _LARGEST_SIGMA_DEG
    fit = FocalPairFit(rows, np.inf, 1.0, FocalBelief(0.0, 1.0))
    derivative = fit.pose_derivative(model.R, model.t)
    moved = derivative @ estimate.covariance @ derivative.T
    variance = max(float(np.linalg.eigvalsh(part)[-1]) for part in (moved[:3, :3], moved[3:, 3:]))
    return float(np.clip(np.degrees(np.sqrt(max(variance, 0.0))), _LEAST_SIGMA_DEG, _LARGEST_SIGMA_DEG))


def confidence_under_estimate(confidence: float, sigma_deg: float) -> float:
    """Probability that a pose is within 10 degrees under focal lengths that are not known but estimated.

    Args:
        confidence: of the fit, which takes them for known; the answer is never above it.
        sigma_deg: as of :func:`pose_sigma_deg`.
    """
    p = float(np.clip(confidence, _LEAST_CONFIDENCE, 1.0 - _LEAST_CONFIDENCE))
    log_odds = _ODDS_WEIGHT * np.log(p / (1.0 - p)) + _SIGMA_WEIGHT * np.log(sigma_deg) + _OFFSET
    largest = confidence if sigma_deg < _EVEN_SIGMA_DEG else min(confidence, 0.5)
    return float(min(largest, 1.0 / (1.0 + np.exp(-log_odds))))


@dataclass(frozen=True)
class _Trial:
    """The best pose under a factor, and the squared Sampson errors that it leaves, each cut off, summed, in px²."""

    R: Array | None
    t: Array | None
    cost_px: float


def _pose_under(rows: Array, F: Array, factor: float, focal_px: float) -> _Trial:
    """The pose that suits ``factor`` times the guess, from F."""
    zoom = np.diag([factor, factor, 1.0])
    scaled, focal = rows / factor, focal_px * factor
    pose = pose_from_essential(project_to_essential(zoom @ F @ zoom), scaled, focal / _REACH_PX)
    if pose is None:
        return _Trial(None, None, float("inf"))
    threshold = _THRESHOLD_PX / focal
    R, t = refine_pose(scaled, *pose, _REACH_PX / focal, _ROUNDS)
    R, t = refine_pose(scaled, R, t, threshold, _ROUNDS)
    return _Trial(R, t, truncated_cost(scaled, R, t, threshold) * focal**2)
