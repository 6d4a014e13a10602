"""The pose that is expected to lie nearest to the truth, where the matches leave that open.

Several poses, or a whole valley of them, may explain few matches about as well, and the one that explains them best is
best by luck. There the answer is a Bayes estimate: the pose with the largest expected closeness to the truth under the
posterior that the likelihood of the choice stands for. The posterior is a sample: around each of the best hypotheses
poses are drawn from a normal distribution, wider than the curvature of its residuals says, and weighed by importance
sampling (Robert & Casella, Monte Carlo Statistical Methods, 2nd ed., sec. 3.3). The numbers drawn are quasi-random and
always the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import homogeneous_columns
from ..geometry.pose_refinement import MIN_INLIERS, SampsonTerms, apply_steps
from . import choice
from .choice import Coefficients, Residuals
from .evidence import FIRM_MATCHES

Array = NDArray[np.float64]

# Hypotheses that are drawn around: so many at most, so far apart at least, and no log-likelihood so far below the best.
_CENTRES, _APART_DEG, _DEPTH = 8, 0.5, 20.0
# Poses drawn around each beside itself, in standard deviations times the spread; a direction that nothing holds has a
# deviation of the widest, radians.
_DRAWN, _SPREAD, _WIDEST = 96, 1.5, 0.3
# Matches this close to a centre, pixels, tell how firmly it is held, times the scale of the noise; those within the
# reach of any centre tell the poses drawn from each other.
_HOLDING_PX, _REACH_PX = 2.0, 6.0
# Where focal lengths are huge, what a direction adds to the information may be less than the rounding of the others.
_ROUNDING = 1e-12
# Matches are not independent: their log-likelihood counts half.
_TEMPERING = 0.5
# A pose this many degrees from the truth is worth half.
_HALF_WORTH_DEG = 16.0
# Draws of less than this share of the largest weight do not count.
_LEAST_WEIGHT = 1e-3
# An answer explains this share of the matches that the best hypothesis does, and no fewer than a pose takes.
_EXPLAINED_SHARE = 0.6
# Dimensions that meet in the transform of Box and Muller: those that give the least covariance.
_RADII, _TURNS = [3, 1, 5], [0, 4, 2]


def _quasi_normals(count: int) -> Array:
    """Points (count + 1, 5) that fill a standard normal distribution evenly, the first of them 0.

    An additive recurrence in six dimensions (M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018)
    and the transform of Box and Muller.
    """
    ratio = 1.0
    for _ in range(64):  # of x ** 7 = x + 1
        ratio = (1.0 + ratio) ** (1.0 / 7.0)
    uniform = (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, 7.0))) % 1.0
    radius, turn = np.sqrt(-2.0 * np.log(uniform[:, _RADII])), 2.0 * np.pi * uniform[:, _TURNS]
    normals = np.concatenate([radius * np.cos(turn), radius[:, :2] * np.sin(turn[:, :2])], axis=1)
    return np.vstack([np.zeros(5), normals])


_NORMALS = _quasi_normals(_DRAWN)


def expected_best(
    correspondences: Array, scores: Array, R: Array, t: Array, scale: float, focal_px: float, coefficients: Coefficients
) -> tuple[Array, Array] | None:
    """The pose, of all that are drawn, that is expected to lie nearest to the truth.

    Args:
        correspondences: (N, 4) on the normalised image planes, each keypoint once.
        scores: (N,) probabilities of the matches.
        R, t: (H, 3, 3), (H, 3) unit norm: the hypotheses, ``X2 = R X1 + t``.
        scale: of the noise, as the choice found it.
        focal_px: mean focal length, pixels.
        coefficients: of the choice.

    Returns:
        R (3, 3) and t (3,); None where the matches hold no hypothesis, or no pose explains enough of them.
    """
    posterior = _Posterior(correspondences, scores, scale, focal_px, coefficients)
    residuals = choice.measure_residuals(correspondences, R, t, focal_px)
    centres = _distinct(R, t, posterior.log_density(residuals))
    draws, held = [], residuals.explained(_HOLDING_PX * scale)
    for one in centres:
        if np.count_nonzero(held[one]) >= MIN_INLIERS:
            draws.append(posterior.draw(held[one], R[one], t[one]))
    if not draws:
        return None
    drawn_R, drawn_t, log_proposal = (np.concatenate(part) for part in zip(*draws))
    reached = np.flatnonzero((residuals.distance_px[centres] < _REACH_PX).any(axis=0))
    near = choice.measure_residuals(correspondences[reached], drawn_R, drawn_t, focal_px)
    log_weight = _TEMPERING * posterior.log_density(near, reached) - log_proposal
    # One draw alone never outweighs all others.
    weight = np.exp(np.minimum(log_weight - np.sort(log_weight)[-2], 0.0))
    heavy = weight > _LEAST_WEIGHT
    drawn_R, drawn_t, weight = drawn_R[heavy], drawn_t[heavy], weight[heavy]
    least = max(_EXPLAINED_SHARE * np.count_nonzero(residuals.explained()[centres[0]]), FIRM_MATCHES)
    candidates = np.flatnonzero(near.explained()[heavy].sum(axis=1) >= least)
    if len(candidates) == 0:
        return None
    angles = choice.pairwise_angles_deg(drawn_R[candidates], drawn_t[candidates], drawn_R, drawn_t)
    best = candidates[np.argmax((1.0 / (1.0 + (angles / _HALF_WORTH_DEG) ** 2)) @ weight)]
    return drawn_R[best], drawn_t[best]


class _Posterior:
    """What the matches of a pair say of a pose."""

    def __init__(
        self, correspondences: Array, scores: Array, scale: float, focal_px: float, coefficients: Coefficients
    ) -> None:
        self._correspondences = correspondences
        self._weights, self._probability = scores, choice.prior(scores, coefficients)
        self._counts = choice.independent_counts(correspondences, scores, coefficients)
        self._coefficients = {**coefficients, "noise_scales": [scale]}
        self._noise = choice.NOISE_PX * scale / focal_px

    def log_density(self, residuals: Residuals, rows: NDArray[np.intp] | slice = slice(None)) -> Array:
        """Log-density (H,) of poses up to a constant, from their residuals on a selection of the matches."""
        counts, weights = self._counts[rows], self._weights[rows]
        likelihood = choice.log_likelihoods(residuals, self._probability[rows], self._coefficients, counts)[:, 0]
        return likelihood + choice.support_bonus(residuals, weights * counts, self._coefficients, len(self._weights))

    def draw(self, holding: NDArray[np.bool_], R: Array, t: Array) -> tuple[Array, Array, Array]:
        """Poses R (S, 3, 3), t (S, 3) around one that a selection of the matches holds, itself the first, and the
        log-density (S,) up to a constant by which they are drawn."""
        rows = self._correspondences[holding]
        terms = SampsonTerms(homogeneous_columns(rows[:, :2]), homogeneous_columns(rows[:, 2:]), R, t)
        J = terms.derivatives() * (np.sqrt(self._counts[holding]) / self._noise)
        information = J @ J.T
        damping = 1.0 / _WIDEST**2 + _ROUNDING * np.trace(information)
        root = np.linalg.cholesky(information + damping * np.eye(5))
        steps = _SPREAD * np.asarray(np.linalg.solve(root.T, _NORMALS.T).T, dtype=np.float64)
        log_proposal = np.log(np.diag(root)).sum() - 0.5 * np.einsum("sk,sk->s", _NORMALS, _NORMALS)
        return *apply_steps(R, t, steps), log_proposal


def _distinct(R: Array, t: Array, log_density: Array) -> list[int]:
    """The best poses that differ from each other, the best first."""
    angles = choice.pairwise_angles_deg(R, t, R, t)
    centres: list[int] = []
    for one in np.argsort(-log_density, kind="stable").tolist():
        if len(centres) == _CENTRES or log_density[one] < log_density.max() - _DEPTH:
            break
        if not centres or angles[one, centres].min() > _APART_DEG:
            centres.append(one)
    return centres
