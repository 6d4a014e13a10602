"""Scores of all matches of a pair: who enters a network, what the others get, what several networks say together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..inputs.attributes import candidate_mask
from . import Backend, ModelMetadata
from .calibration import sigmoid

MAX_NETWORK_MATCHES = 8000
# Logit of a match without usable coordinates: low enough for a probability of zero under any calibration.
INVALID_LOGIT = -100.0
# What scores less is no match for sure: a deeper network need not see it, unless there would be too few.
HOPELESS_SCORE, FEWEST_UNDECIDED = 1e-3, 64
# Rejected matches stay this far below the decision threshold, whatever the prior says; over the last part of the way
# their logits are compressed, so that no two that the prior tells apart come out alike.
_REJECTED_MARGIN = 1e-3
_COMPRESSED = 0.25


@dataclass(frozen=True)
class NetworkInput:
    """What one pair sends through a network.

    Attributes:
        rows: (N,) rows of the pair's matches. correspondences: (N, 4) float32. attributes: (N, 8) float32.
    """

    rows: NDArray[np.intp]
    correspondences: NDArray[np.float32]
    attributes: NDArray[np.float32]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> NetworkInput:
        """The part of it that a mask (N,) chooses."""
        return NetworkInput(self.rows[chosen], self.correspondences[chosen], self.attributes[chosen])


@dataclass(frozen=True)
class NetworkOutput:
    """Raw answer for one pair: logits (N,) float32 and essential matrix (3, 3), free sign."""

    logits: NDArray[np.float32]
    essential: NDArray[np.float32]

    @property
    def finite_logits(self) -> NDArray[np.float32]:
        """(N,); invalid where degenerate input, all points equal, say, left the network without a finite answer."""
        return np.where(np.isfinite(self.logits), self.logits, np.float32(INVALID_LOGIT))


@dataclass(frozen=True)
class Opinion:
    """What the networks that were asked say of M matches, each as much as another.

    Attributes:
        margins: (M,) float32, logits above the decision threshold. log_odds: (M,) float32, calibrated.
        networks: how many were asked.
    """

    margins: NDArray[np.float32]
    log_odds: NDArray[np.float32]
    networks: int = 1

    @classmethod
    def of(cls, logits: NDArray[np.float32], metadata: ModelMetadata) -> Opinion:
        """What one network says, whose logits (M,) these are."""
        return cls(logits - np.float32(metadata.decision_threshold), metadata.calibration.log_odds(logits))

    @property
    def scores(self) -> NDArray[np.float32]:
        """Probabilities (M,) that the matches are right."""
        with np.errstate(under="ignore"):
            return sigmoid(self.log_odds).astype(np.float32)

    @classmethod
    def mean(cls, opinions: Sequence[Opinion]) -> Opinion:
        """What several say before any was asked: by their priors, say."""
        margins, log_odds = (
            np.mean([getattr(one, name) for one in opinions], axis=0) for name in ("margins", "log_odds")
        )
        return cls(margins, log_odds, networks=0)

    def joined(self, other: Opinion, rows: NDArray[np.intp]) -> Opinion:
        """With what one more network says of N matches that it saw, which stand in ``rows`` (N,) here."""
        networks = self.networks + other.networks
        share = np.float32(other.networks / networks)
        margins, log_odds = self.margins.copy(), self.log_odds.copy()
        for mean, new in ((margins, other.margins), (log_odds, other.log_odds)):
            mean[rows] = (1 - share) * mean[rows] + share * new
        return Opinion(margins, log_odds, networks)

    def undecided(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Those (N,) of the matches ``rows`` (N,) that a deeper network should see; a few, the best, in any case."""
        log_odds = self.log_odds[rows]
        undecided: NDArray[np.bool_] = log_odds > math.log(HOPELESS_SCORE / (1.0 - HOPELESS_SCORE))
        if np.count_nonzero(undecided) < FEWEST_UNDECIDED:
            undecided[np.argsort(-log_odds, kind="stable")[:FEWEST_UNDECIDED]] = True
        return undecided


def select_network_input(
    correspondences: NDArray[np.float64],
    attributes: NDArray[np.float32],
    valid: NDArray[np.bool_],
    backend: Backend,
    seed: int,
) -> NetworkInput:
    """Choose the candidates among the valid matches, at most 8000.

    Beyond 8000 the best by ratio go; bare points, of which nothing is known, send a seeded sample.

    Args:
        correspondences: (M, 4) normalised. attributes: (M, 8). valid: (M,) usable coordinates.
        backend: its metadata hold the candidate rule.
        seed: of the sample.
    """
    metadata = backend.metadata
    rows = np.flatnonzero(valid)
    candidates = candidate_mask(attributes[rows], metadata.candidate_max_ratio, metadata.candidate_min_count)
    rows = rows[candidates]
    if len(rows) > MAX_NETWORK_MATCHES:
        tie_break = np.random.default_rng(seed).permutation(len(rows))
        ratio = np.where(attributes[rows, 5] > 0, attributes[rows, 0], 1.0)
        rows = np.sort(rows[np.lexsort((tie_break, ratio))[:MAX_NETWORK_MATCHES]])
    with np.errstate(under="ignore"):  # coordinates next to zero, whatever the caller's np.seterr
        return NetworkInput(
            rows,
            np.ascontiguousarray(correspondences[rows], dtype=np.float32),
            np.ascontiguousarray(attributes[rows], dtype=np.float32),
        )


def run_network(backend: Backend, inputs: Sequence[NetworkInput]) -> list[NetworkOutput]:
    """One forward pass over pairs that send equally many matches, at least one.

    Raises:
        BackendError: the runtime refused.
    """
    logits, essential = backend.infer(
        np.stack([item.correspondences for item in inputs]), np.stack([item.attributes for item in inputs])
    )
    return [NetworkOutput(logits[i], essential[i]) for i in range(len(inputs))]


def prior_logits(
    attributes: NDArray[np.float32], unseen: NDArray[np.bool_], metadata: ModelMetadata
) -> NDArray[np.float32]:
    """Logits (M,), below the decision threshold, of the matches ``unseen`` (M,) by a network; of others invalid."""
    ceiling = metadata.decision_threshold - _REJECTED_MARGIN
    logits = np.full(len(unseen), INVALID_LOGIT, dtype=np.float32)
    logits[unseen] = _below(metadata.prior.logits(attributes[unseen]), ceiling)
    return logits


def _below(logits: NDArray[np.float32], ceiling: float) -> NDArray[np.float32]:
    """Logits (N,) in their order, all below ``ceiling``; those far below it as they are."""
    knee = ceiling - _COMPRESSED
    above = np.maximum(logits.astype(np.float64) - knee, 0.0)
    compressed = ceiling - _COMPRESSED**2 / (_COMPRESSED + above)
    return np.where(above > 0.0, compressed, logits).astype(np.float32)
