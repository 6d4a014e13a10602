"""Choice among hypotheses, and the confidence of what was chosen.

The choice is the likelihood of the matches, each of which is right with a probability that its score gives, and then
lies about its epipolar line by a mixture of normal distributions, in front of both cameras; or it is wrong, and
anywhere. Matches are far from independent: those that lie together in both images, on a repeated window above all, are
right or wrong together and count less each. Long lists stay too sure of themselves even so: there the support, the
summed scores of the matches near by, is added, and counts the more, the longer the list is.
The confidence is a logistic regression on measurements of the chosen hypothesis: how much of the list it explains, how
far the best *other* answer falls behind, which unlike sources found the same, how firmly its inliers hold it. All
hypotheses are measured on all distinct matches in one vectorised pass. The numbers are data, a dict of lists of floats,
fitted on training scenes (``choice.json``) and carried by every model file, from which Python and C++ read them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import cross_matrices, homogeneous_columns, sampson_distance
from ..geometry.pose_refinement import pose_uncertainty_deg

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Coefficients = Mapping[str, Sequence[float]]

# The signs of depths say something only where the rays are this far from parallel, pixels.
MIN_PARALLAX_PX = 1.5
# Matches within this distance, pixels, are explained.
INLIER_PX = 1.0
# Without scores the share of right matches is at least and at most this.
MIN_SHARE, MAX_SHARE = 0.02, 0.8
# Residuals between these, pixels, say how densely wrong matches lie around an epipolar line.
BACKGROUND_PX = (6.0, 18.0)
# Beyond this angle two hypotheses are alternatives and not the same answer.
ALTERNATIVE_DEG = 5.0
AGREEMENT_DEG = (2.0, 5.0, 10.0)
# Half a pixel is the noise of SIFT's keypoints, more than enough; scales of the likelihood multiply it.
NOISE_PX = 0.5
# Shares of right matches in a group, and rounds in which they are found.
_LEAST_SHARE, _LARGEST_SHARE, _SHARE_ROUNDS = 1e-3, 0.99, 8
# The support is measured at these distances, pixels, each relative to the best hypothesis' and with this weight.
_SUPPORT_PX, _SUPPORT_WEIGHTS = (1.0, 2.0, 4.0), (1.0, 1.0, 0.5)
# Gaps between log-likelihoods are compressed beyond this.
GAP_UNIT = 3.0
# Hypotheses whose log-likelihoods differ by less are equally likely.
TIE = 3.0
_TINY = 1e-12
# So many cells are counted without asking first which of them hold a match.
_COUNTED_CELLS = 10_000

FEATURES = (
    *("log count", "log weighted count", "log share", "log weighted share"),
    *("log significance", "log weighted significance", "likelihood per inlier"),
    *("likelihood to alternative", "plain likelihood to alternative", "support to alternative"),
    *("plain likelihood to best", "weighted support to best", "share behind"),
    *("near network E 3 deg", "near network E 10 deg", "no network E"),
    *(f"other families within {angle:g} deg" for angle in AGREEMENT_DEG),
    *("log scale", "log matches", "log sum of scores", "log uncertainty deg"),
)
"""Measurements of the chosen hypothesis, in the order of ``coefficients["confidence"]``, which ends in the offset."""

EARLY_FEATURES = (
    "log count",
    "log share",
    "plain likelihood to alternative",
    "share behind",
    "log uncertainty deg",
    "log significance",
)
"""The same without a network, in the order of ``coefficients["early_confidence"]``."""


# Coefficients by name, and how many numbers each has; of those of the mixture only that they are equally many.
COEFFICIENTS = {
    "score_trust": 3,
    "noise_px": None,
    "noise_weights": None,
    "noise_scales": None,
    "outlier_width_px": 1,
    "seen_behind": 1,
    "support_weight": 1,
    "crowding": 2,
    "early_end": 5,
    "settled": 3,
    "verdict": 2,
    "confidence": len(FEATURES) + 1,
    "early_confidence": len(EARLY_FEATURES) + 1,
}


def fitted_coefficients() -> dict[str, list[float]]:
    """The coefficients that were fitted last, for a network that has no model file yet."""
    return check_coefficients(json.loads(Path(__file__).with_name("choice.json").read_text(encoding="utf-8")))


def check_coefficients(values: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    """The coefficients, every list of the right length and of finite numbers.

    Raises:
        ValueError: one is missing, or has another length or values.
    """
    checked = {}
    for name, count in COEFFICIENTS.items():
        if name not in values:
            raise ValueError(f"{name} is missing")
        numbers = [float(value) for value in values[name]]
        if not numbers or not np.isfinite(numbers).all() or (count is not None and len(numbers) != count):
            raise ValueError(f"{name}: expected {count or 'some'} finite numbers, got {numbers}")
        checked[name] = numbers
    if len(checked["noise_px"]) != len(checked["noise_weights"]):
        raise ValueError("noise_px and noise_weights differ in length")
    return checked


@dataclass(frozen=True)
class Hypotheses:
    """Poses that lie before the choice, ``X2 = R X1 + t``.

    Attributes:
        R: (H, 3, 3). t: (H, 3) unit norm.
        family: (H,) integers: hypotheses of one family come from like sources, and do not bear each other out.
    """

    R: Array
    t: Array
    family: NDArray[np.intp]


@dataclass(frozen=True)
class Residuals:
    """Hypotheses on matches.

    Attributes:
        distance_px: (H, N) Sampson distances in pixels.
        behind: (H, N) True where a match lies behind a camera and its rays are not nearly parallel.
    """

    distance_px: Array
    behind: BoolArray

    def explained(self, reach_px: float = INLIER_PX) -> BoolArray:
        """Which matches (H, N) lie within a distance, pixels, of what a hypothesis wants, and in front of it."""
        return np.asarray((self.distance_px < reach_px) & ~self.behind)


@dataclass(frozen=True)
class Judgement:
    """The chosen hypothesis.

    Attributes:
        chosen: its position.
        features: what is known of it, by the names of :data:`FEATURES`.
        likelihood: (H,) log-likelihood ratios of all hypotheses.
        distance_px: (N,) Sampson distances of the matches to it; infinite where a match lies behind a camera.
        share: of right matches under it.
        scale: of the noise, by which :data:`NOISE_PX` is multiplied.
    """

    chosen: int
    features: Mapping[str, float]
    likelihood: Array
    distance_px: Array
    share: float
    scale: float


def measure_residuals(correspondences: Array, R: Array, t: Array, focal_px: float) -> Residuals:
    """Residuals of poses R (H, 3, 3), t (H, 3) on matches (N, 4) of the normalised image planes."""
    E = cross_matrices(t) @ R
    distance_px = sampson_distance(correspondences, E) * focal_px
    return Residuals(distance_px, lie_behind(correspondences, R, t, focal_px))


def lie_behind(correspondences: Array, R: Array, t: Array, focal_px: float) -> BoolArray:
    """Which matches (N, 4) lie behind a camera under poses R (H, 3, 3), t (H, 3), (H, N); see :class:`Residuals`."""
    x1, x2 = homogeneous_columns(correspondences[:, :2]), homogeneous_columns(correspondences[:, 2:])
    # A rotation keeps the length of a ray, and its product with t.
    aa, bb = np.einsum("in,in->n", x1, x1), np.einsum("in,in->n", x2, x2)
    ab = np.einsum("hin,in->hn", R @ x1, x2)
    at, bt = (t[:, None] @ R)[:, 0] @ x1, t @ x2
    both = aa * bb
    parallax = both - ab * ab > (MIN_PARALLAX_PX / focal_px) ** 2 * both
    return np.asarray(((ab * bt < bb * at) | (aa * bt < ab * at)) & parallax)


def pairwise_angles_deg(R: Array, t: Array, R_other: Array, t_other: Array) -> Array:
    """Larger of the angles of rotation and of direction (sign ignored) between poses, (H, G) degrees."""
    cosine = (np.tensordot(R, R_other, axes=([1, 2], [1, 2])) - 1.0) / 2.0
    rotation = np.arccos(np.clip(cosine, -1.0, 1.0))
    direction = np.arccos(np.clip(np.abs(t @ t_other.T), 0.0, 1.0))
    return np.asarray(np.degrees(np.maximum(rotation, direction)))


def independent_counts(correspondences: Array, weights: Array, coefficients: Coefficients) -> Array:
    """What each match (N,) counts: less, the more of them lie together in both images.

    Args:
        correspondences: (N, 4) on the normalised image planes.
        weights: (N,) probabilities of the matches.
        coefficients: ``crowding``: side of a cell in either image, as a share of the diagonal of its points' extent,
            and power p: a match in a cell whose probabilities sum to s > 1 counts s ** -p.
    """
    side, power = coefficients["crowding"]
    low, high = correspondences.min(axis=0), correspondences.max(axis=0)
    diagonal = np.repeat(np.hypot(*(high - low).reshape(2, 2).T), 2)
    cells = np.floor((correspondences - low) / (side * np.maximum(diagonal, _TINY))).astype(np.int64)
    per_axis = int(1.0 / side) + 2
    number = cells @ np.array([1, per_axis, per_axis**2, per_axis**3])
    cell = number if per_axis**4 <= _COUNTED_CELLS else np.unique(number, return_inverse=True)[1]
    return np.asarray(np.maximum(np.bincount(cell, weights), 1.0)[cell] ** -power)


def _angles_to(hypotheses: Hypotheses, one: int) -> Array:
    """Angles (H,) of all hypotheses to one of them, degrees."""
    return pairwise_angles_deg(hypotheses.R, hypotheses.t, hypotheses.R[[one]], hypotheses.t[[one]])[:, 0]


def log_likelihoods(
    residuals: Residuals, probability: Array, coefficients: Coefficients, counts: Array | None = None
) -> Array:
    """Log-likelihood ratios (H, S) against all matches being wrong, for each scale of the noise; (H, S, K) of K counts.

    Args:
        probability: (N,) that a match is right, below 1.
        counts: (N,) or (N, K) what each match counts (:func:`independent_counts`); None = 1.
        coefficients: ``noise_px`` and ``noise_weights`` of the mixture, ``noise_scales``, ``outlier_width_px``: the
            width across which a wrong match may lie; ``seen_behind``: share of right matches that lie behind a camera
            all the same, because they are off *along* their epipolar line, as in a corridor walked down.
    """
    odds = coefficients["outlier_width_px"][0] * np.sqrt(2.0 / np.pi) * probability / (1.0 - probability)  # (N,)
    odds = odds * np.where(residuals.behind, coefficients["seen_behind"][0], 1.0)  # (H, N)
    squared = residuals.distance_px**2
    columns = []
    for scale in coefficients["noise_scales"]:
        density = np.zeros_like(squared)
        for sigma, weight in zip(coefficients["noise_px"], coefficients["noise_weights"]):
            density += (weight / (scale * sigma)) * np.exp((-0.5 / (scale * sigma) ** 2) * squared)
        columns.append(np.log1p(odds * density) @ (np.ones(len(probability)) if counts is None else counts))
    return np.stack(columns, axis=1)


def support_bonus(
    residuals: Residuals, weights: Array, coefficients: Coefficients, matches: int | None = None
) -> Array:
    """What the support (H,) adds to the log-likelihood: 0 for a hypothesis that has the most at every distance.

    Args:
        weights: (N,) what each match counts.
        coefficients: ``support_weight``, of the logarithm, times the number of matches to the power of one and a half.
        matches: that number, where these N are some of them; None = N.
    """
    front = ~residuals.behind
    total = np.zeros(len(front))
    for reach, weight in zip(_SUPPORT_PX, _SUPPORT_WEIGHTS):
        support = (np.maximum(1.0 - (residuals.distance_px / reach) ** 2, 0.0) * front) @ weights
        total += weight * support / max(float(support.max()), _TINY)
    relative = np.maximum(total / sum(_SUPPORT_WEIGHTS), _TINY)
    factor = coefficients["support_weight"][0] * (len(weights) if matches is None else matches) ** 1.5
    return np.asarray(factor * np.log(relative))


def prior(scores: Array, coefficients: Coefficients) -> Array:
    """Probability (N,) that a match is right as the likelihood believes it: ``trust · score ** power + floor``."""
    trust, power, floor = coefficients["score_trust"]
    return np.minimum(trust * scores**power + floor, 0.98)


def judge(
    correspondences: Array,
    scores: Array | None,
    hypotheses: Hypotheses,
    focal_px: float,
    network_poses: tuple[Array, Array] | None,
    coefficients: Coefficients,
) -> Judgement:
    """Choose among hypotheses and measure the chosen one.

    Args:
        correspondences: (N, 4) on the normalised image planes, each keypoint once.
        scores: (N,) probabilities of the matches; None before the network.
        focal_px: mean focal length, pixels.
        network_poses: R (G, 3, 3), t (G, 3): the poses that the network E allows, or None.
        coefficients: see :func:`log_likelihoods` and :func:`prior`.
    """
    residuals = measure_residuals(correspondences, hypotheses.R, hypotheses.t, focal_px)
    distance, front = residuals.distance_px, ~residuals.behind
    count = len(correspondences)
    near = residuals.explained()
    inliers = near.sum(axis=1)
    share = float(np.clip(inliers.max() / max(count, 1), MIN_SHARE, MAX_SHARE))
    weights = np.full(count, share) if scores is None else scores
    counts = independent_counts(correspondences, weights, coefficients)
    both_counts = np.stack([counts, np.ones(count)], axis=1)
    of_both = log_likelihoods(residuals, np.full(count, share), coefficients, both_counts)
    plain_by_scale = of_both[:, :, 0]
    if scores is not None:
        of_both = log_likelihoods(residuals, prior(scores, coefficients), coefficients, both_counts)
    by_scale = of_both[:, :, 0]
    # One scale for all hypotheses: that of the most likely one.
    column = int(np.argmax(by_scale.max(axis=0)))
    likelihood, plain = by_scale[:, column], plain_by_scale[:, column]
    merit = likelihood + support_bonus(residuals, weights * counts, coefficients)
    answer = int(np.argmax(merit))
    # Crowded matches count less for one answer against another; between hypotheses of one answer, and near ties, all
    # matches tell the best.
    alike = (_angles_to(hypotheses, answer) < ALTERNATIVE_DEG) | (merit > merit[answer] - TIE)
    whole = of_both[:, column, 1] + support_bonus(residuals, weights, coefficients)
    chosen = int(np.argmax(np.where(alike, whole, -np.inf)))
    support = (np.maximum(1.0 - distance**2, 0.0) * front) @ weights
    angles = _angles_to(hypotheses, chosen)
    alternatives = angles > ALTERNATIVE_DEG

    def gap(values: Array) -> float:
        """How far the chosen one lies above the best of those that are another answer."""
        return float(values[chosen] - (values[alternatives].max() if alternatives.any() else 0.0))

    other = hypotheses.family != hypotheses.family[chosen]
    agreeing = [len(set(hypotheses.family[other & (angles < limit)].tolist())) for limit in AGREEMENT_DEG]
    to_network = 180.0
    if network_poses is not None:
        to_network = float(pairwise_angles_deg(hypotheses.R[[chosen]], hypotheses.t[[chosen]], *network_poses).min())
    low, high = BACKGROUND_PX
    around = (distance[chosen] > low) & (distance[chosen] < high)
    background = np.array([around.sum(), weights[around].sum()]) / (high - low)
    number, weighted = float(inliers[chosen]), float(weights[near[chosen]].sum())
    scale = float(coefficients["noise_scales"][column])
    spread = pose_uncertainty_deg(
        correspondences[(distance[chosen] < 3.0 * NOISE_PX * scale) & front[chosen]],
        hypotheses.R[chosen],
        hypotheses.t[chosen],
        NOISE_PX * scale / focal_px,
    )
    everything_near = int(np.count_nonzero(distance[chosen] < INLIER_PX))
    features = {
        "log count": np.log(number + 1.0),
        "log weighted count": np.log(weighted + 1.0),
        "log share": np.log(explained_share(number, count)),
        "log weighted share": np.log((weighted + 0.1) / (weights.sum() + 0.2)),
        "log significance": _significance(number, background[0]),
        "log weighted significance": _significance(weighted, background[1]),
        "likelihood per inlier": likelihood[chosen] / (counts[(distance[chosen] < 2.0) & front[chosen]].sum() + 5.0),
        "likelihood to alternative": np.arcsinh(gap(likelihood) / GAP_UNIT),
        "plain likelihood to alternative": np.arcsinh(gap(plain) / GAP_UNIT),
        "support to alternative": np.arcsinh(gap(support) / GAP_UNIT),
        "plain likelihood to best": np.arcsinh((plain[chosen] - plain.max()) / GAP_UNIT),
        "weighted support to best": np.arcsinh((support[chosen] - support.max()) / GAP_UNIT),
        "share behind": 1.0 - number / max(everything_near, 1),
        "near network E 3 deg": np.exp(-to_network / 3.0),
        "near network E 10 deg": np.exp(-to_network / 10.0),
        "no network E": float(network_poses is None),
        **{f"other families within {limit:g} deg": float(n) for limit, n in zip(AGREEMENT_DEG, agreeing)},
        "log scale": np.log(scale),
        "log matches": np.log(count + 1.0),
        "log sum of scores": np.log(weights.sum() + 1.0),
        "log uncertainty deg": np.log(spread),
    }
    distances = np.where(front[chosen], distance[chosen], np.inf)
    return Judgement(chosen, {k: float(v) for k, v in features.items()}, likelihood, distances, share, scale)


def explained_share(inliers: float, count: int) -> float:
    """Share of ``count`` matches that a pose explains, by Laplace's rule."""
    return (inliers + 1.0) / (count + 2.0)


def confidence(judgement: Judgement, coefficients: Coefficients) -> float:
    """Probability that the chosen pose is within 10 degrees."""
    return _logistic(judgement, FEATURES, coefficients["confidence"])


def early_confidence(judgement: Judgement, coefficients: Coefficients) -> float:
    """The same for a choice without a network."""
    return _logistic(judgement, EARLY_FEATURES, coefficients["early_confidence"])


def explains_list(judgement: Judgement, coefficients: Coefficients) -> bool:
    """True where a pose found without the network needs none: the rule of the early end.

    It explains enough of the list, by enough matches, which all lie in front of the cameras and hold it firmly, and no
    other answer, a twin under the dominant plane above all, comes near. ``coefficients["early_end"]``: least share,
    least count, largest share behind, largest uncertainty in degrees, least log-likelihood above the best alternative.
    """
    share, number, behind, uncertainty_deg, gap = coefficients["early_end"]
    f = judgement.features
    return (
        f["log share"] > np.log(share)
        and f["log count"] > np.log(number)
        and f["share behind"] < behind
        and f["log uncertainty deg"] < np.log(uncertainty_deg)
        and f["plain likelihood to alternative"] > np.arcsinh(gap / GAP_UNIT)
    )


def posterior(residuals: Residuals, groups: Sequence[BoolArray], scale: float, coefficients: Coefficients) -> Array:
    """Probability (N,) that each match is right, from its residual alone: the scores of a pair that ended early.

    Args:
        residuals: of one hypothesis, (1, N).
        groups: masks (N,) of matches that are right about equally often; each has its own share, found by expectation
            maximisation. What is in none gets 0.
        scale: of the noise, by which :data:`NOISE_PX` is multiplied.
        coefficients: see :func:`log_likelihoods`.
    """
    squared = residuals.distance_px[0] ** 2
    density = np.zeros_like(squared)
    for sigma, weight in zip(coefficients["noise_px"], coefficients["noise_weights"]):
        density += np.sqrt(2.0 / np.pi) * (weight / (scale * sigma)) * np.exp((-0.5 / (scale * sigma) ** 2) * squared)
    ratio = coefficients["outlier_width_px"][0] * density
    ratio = ratio * np.where(residuals.behind[0], coefficients["seen_behind"][0], 1.0)
    probability = np.zeros_like(squared)
    for group in groups:
        share, of_group = 0.5, ratio[group]
        for _ in range(_SHARE_ROUNDS if len(of_group) else 0):
            odds = share / (1.0 - share) * of_group
            right = odds / (1.0 + odds)
            share = min(max(float(right.mean()), _LEAST_SHARE), _LARGEST_SHARE)
            probability[group] = right
    return np.asarray(probability)


def _significance(count: float, background: float) -> float:
    """log(1 + improbability) of seeing ``count`` where ``background`` is expected (Poisson, large deviations)."""
    expected = background + 0.5
    if count <= expected:
        return 0.0
    return float(np.log1p(count * np.log(count / expected) - (count - expected)))


def _logistic(judgement: Judgement, names: Sequence[str], weights: Sequence[float]) -> float:
    logit = sum(judgement.features[name] * weight for name, weight in zip(names, weights)) + weights[-1]
    return float(1.0 / (1.0 + np.exp(-np.clip(logit, -40.0, 40.0))))
