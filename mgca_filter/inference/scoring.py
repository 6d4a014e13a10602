"""Scores of all matches of a pair: who enters the network, and what the others get."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..inputs.attributes import candidate_mask
from . import Backend

MAX_NETWORK_MATCHES = 8000
# Logit of a match without usable coordinates: low enough for a probability of zero under any calibration.
INVALID_LOGIT = -100.0
# Rejected matches stay this far below the decision threshold, whatever the prior says; over the last part of the way
# their logits are compressed, so that no two that the prior tells apart come out alike.
_REJECTED_MARGIN = 1e-3
_COMPRESSED = 0.25


@dataclass(frozen=True)
class NetworkInput:
    """What one pair sends through the network.

    Attributes:
        rows: (N,) rows of the pair's matches. correspondences: (N, 4) float32. attributes: (N, 8) float32.
    """

    rows: NDArray[np.intp]
    correspondences: NDArray[np.float32]
    attributes: NDArray[np.float32]


@dataclass(frozen=True)
class NetworkOutput:
    """Raw answer for one pair: logits (N,) float32 and essential matrix (3, 3), free sign."""

    logits: NDArray[np.float32]
    essential: NDArray[np.float32]


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


def assemble_logits(
    attributes: NDArray[np.float32],
    valid: NDArray[np.bool_],
    sent: NetworkInput,
    output: NetworkOutput | None,
    backend: Backend,
) -> NDArray[np.float32]:
    """Logits (M,) of all matches: the network's, the prior's below the decision threshold, or invalid."""
    metadata = backend.metadata
    ceiling = metadata.decision_threshold - _REJECTED_MARGIN
    logits = np.full(len(valid), INVALID_LOGIT, dtype=np.float32)
    logits[valid] = _below(metadata.prior.logits(attributes[valid]), ceiling)
    if output is not None:
        # Degenerate input (all points equal, say) may leave the network without a finite answer.
        logits[sent.rows] = np.where(np.isfinite(output.logits), output.logits, INVALID_LOGIT)
    return logits


def _below(logits: NDArray[np.float32], ceiling: float) -> NDArray[np.float32]:
    """Logits (N,) in their order, all below ``ceiling``; those far below it as they are."""
    knee = ceiling - _COMPRESSED
    above = np.maximum(logits.astype(np.float64) - knee, 0.0)
    compressed = ceiling - _COMPRESSED**2 / (_COMPRESSED + above)
    return np.where(above > 0.0, compressed, logits).astype(np.float32)
