"""Sources of hypotheses: one function each, all of one shape, unlike in what they see and how they draw.

A source takes the evidence of a pair and returns the models that it proposes, at most a few, unrefined: essential
matrices, or fundamental matrices in normalised coordinates where the intrinsics are guessed. Sources of one *family*
see alike; that two of different families find the same pose is worth something.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import essential_from_pose, sampson_distance
from ..geometry.homography import poses_from_homography
from .estimators import HOMOGRAPHY_THRESHOLD_FACTOR, EstimatorOptions, fit_epipolar, fit_homography
from .evidence import MIN_MATCHES, Evidence

Array = NDArray[np.float64]

# A rough run on the list sees no more matches than this: what it proposes is refined and judged on all.
ROUGH_MATCHES = 600


class Family(IntEnum):
    """What a source sees."""

    NETWORK = 0
    LIST_UNIFORM = 1
    LIST_ORDERED = 2
    ACCEPTED = 3
    SCORE_ORDER = 4
    PLANE = 5
    POSELIB = 6


Source = Callable[[Evidence, EstimatorOptions], "list[Array]"]


@dataclass(frozen=True)
class Proposal:
    """A source as the fit calls it.

    Attributes:
        name: what :attr:`mgca_filter.FilterResult.info` calls it. family, source: see there.
        method: robust estimator, one of :class:`EstimatorOptions`.
        threshold_px: what it takes for an inlier, pixels.
        iterations: the most that it draws.
        number: added to the seed, so that no two draw the same samples.
        rough: with intrinsics, where what it proposes is refined, see :class:`EstimatorOptions`.
    """

    name: str
    family: Family
    source: Source
    method: str = "magsac"
    threshold_px: float = 0.5
    iterations: int = 0
    number: int = 0
    rough: bool = False


def network(evidence: Evidence, options: EstimatorOptions) -> list[Array]:
    """The network E."""
    E = evidence.network_essential
    usable = E is not None and evidence.calibrated and np.isfinite(E).all() and E.any()
    return [np.asarray(E, dtype=np.float64)] if usable else []


def listed(evidence: Evidence, options: EstimatorOptions) -> list[Array]:
    """A robust estimator on the list, as a classical pipeline runs it; ordered estimators get the list's own order.

    A rough run gets the most promising matches of a long list, or, where nothing tells them, some of all parts of it.
    """
    rows = evidence.by_list_order()
    if options.rough and len(rows) > ROUGH_MATCHES:
        ordered = np.isfinite(evidence.order).any()
        rows = rows[:ROUGH_MATCHES] if ordered else rows[np.arange(ROUGH_MATCHES) * len(rows) // ROUGH_MATCHES]
    return _estimate(rows, evidence, options)


def accepted(evidence: Evidence, options: EstimatorOptions) -> list[Array]:
    """A robust estimator on what the network accepts, best first."""
    return _estimate(evidence.correspondences[evidence.accepted()], evidence, options)


def above(margin: float) -> Source:
    """A robust estimator on what has a logit above a margin, best first."""

    def source(evidence: Evidence, options: EstimatorOptions) -> list[Array]:
        return _estimate(evidence.correspondences[evidence.above(margin)], evidence, options)

    return source


def dominant_plane(evidence: Evidence, R: Array, t: Array, seed: int) -> Array | None:
    """Homography (3, 3) of the dominant plane among the inliers of a pose, on the normalised image planes."""
    threshold = 1.0 / evidence.focal_px
    rows = evidence.correspondences[evidence.accepted()]
    near = rows[sampson_distance(rows, essential_from_pose(R, t)) < threshold]
    return fit_homography(near[:, :2], near[:, 2:], HOMOGRAPHY_THRESHOLD_FACTOR * threshold, seed)


def plane(H: Array | None) -> list[Array]:
    """Essential matrices that the homography of a plane allows: of the pose that led to it, and its twin.

    Where most matches lie on one plane two poses explain them about equally well, and sampling, which asks for no
    depths, meets one of them by chance.
    """
    # Of the four poses two and two differ in the sign of t alone, which E does not know.
    return [] if H is None else [essential_from_pose(*pose) for pose in poses_from_homography(H)[::2]]


def _estimate(rows: Array, evidence: Evidence, options: EstimatorOptions) -> list[Array]:
    """What a robust estimator makes of rows (N, 4), best first."""
    if len(rows) < MIN_MATCHES:
        return []
    M = fit_epipolar(rows, evidence.focal_px, options, evidence.calibrated)
    return [] if M is None else [M]
