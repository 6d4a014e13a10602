"""From logits to probabilities, and the prior that scores what never entered the network.

Scores near zero underflow, which is as right as it can be, also where the caller has ``np.seterr(all="raise")``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.matrix_product import product

# Abramowitz & Stegun 7.1.26: absolute error below 1.5e-7, the resolution of float32 logits.
_ERF_P = 0.3275911
_ERF_COEFFICIENTS = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)


def sigmoid(logits: ArrayLike) -> NDArray[np.float64]:
    """1 / (1 + exp(−x)) without overflow."""
    x = np.asarray(logits, dtype=np.float64)
    with np.errstate(under="ignore"):
        e = np.exp(-np.abs(x))
        return np.where(x >= 0, 1.0, e) / (1.0 + e)


@dataclass(frozen=True)
class Calibration:
    """Platt scaling fitted on validation pairs: probability = sigmoid(scale · logit + offset)."""

    scale: float = 1.0
    offset: float = 0.0

    def log_odds(self, logits: ArrayLike) -> NDArray[np.float32]:
        """Logarithms (N,) float32 of the odds that a match is an inlier, from its logit (N,)."""
        return (self.scale * np.asarray(logits, dtype=np.float64) + self.offset).astype(np.float32)

    def probabilities(self, logits: ArrayLike) -> NDArray[np.float32]:
        """Probability (N,) float32 that a match is an inlier, from its logit (N,)."""
        with np.errstate(under="ignore"):
            return sigmoid(self.log_odds(logits)).astype(np.float32)

    def logits(self, probabilities: ArrayLike) -> NDArray[np.float32]:
        """The logits (N,) float32 that probabilities (N,) come from; 0 and 1 give those of 1e-9 below and above."""
        p = np.clip(np.asarray(probabilities, dtype=np.float64), 1e-9, 1.0 - 1e-9)
        return ((np.log(p) - np.log1p(-p) - self.offset) / self.scale).astype(np.float32)


def largest_set_of_precision(scores: NDArray[np.float32], precision: float) -> NDArray[np.bool_]:
    """The most matches (N,) bool, best scores first, whose mean score is at least ``precision``.

    The mean of calibrated scores is the share of right matches to be expected. Equal scores stay together, so that
    the order of the matches does not matter; where not even the best reach the precision, none is kept.
    """
    descending = np.sort(scores.astype(np.float64))[::-1]
    if not len(descending):
        return np.zeros(0, dtype=bool)
    expected = np.cumsum(descending) / np.arange(1, len(descending) + 1)
    last_of_equals = np.append(descending[:-1] != descending[1:], True)
    enough = np.flatnonzero((expected >= precision) & last_of_equals)
    kept: NDArray[np.bool_] = scores >= (descending[enough[-1]] if len(enough) else np.inf)
    return kept


@dataclass(frozen=True)
class AttributePrior:
    """Logit of a match from its attributes alone: ``weight2 · gelu(weight1 a + bias1) + bias2``.

    Attributes:
        weight1: (H, 8). bias1: (H,). weight2: (H,). bias2: scalar.
    """

    weight1: NDArray[np.float64]
    bias1: NDArray[np.float64]
    weight2: NDArray[np.float64]
    bias2: float

    def logits(self, attributes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Logits (N,) float32 from encoded attributes (N, 8)."""
        with np.errstate(all="ignore"):
            hidden = gelu(product(attributes.astype(np.float64), self.weight1.T) + self.bias1)
            return (hidden @ self.weight2 + self.bias2).astype(np.float32)


def gelu(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaussian error linear unit in its exact form, x · Φ(x)."""
    with np.errstate(all="ignore"):
        z = np.abs(x) / np.sqrt(2.0)
        k = 1.0 / (1.0 + _ERF_P * z)
        polynomial = np.zeros_like(k)
        for coefficient in _ERF_COEFFICIENTS:
            polynomial = (polynomial + coefficient) * k
        erf = np.sign(x) * (1.0 - polynomial * np.exp(-z * z))
        activated: NDArray[np.float64] = 0.5 * x * (1.0 + erf)
    return activated
