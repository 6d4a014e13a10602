"""How the input of a pair looks: what a caller's matcher knew, and what the caller's own filter left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..inputs.attributes import Column, candidate_mask
from .pairs import TrainingPair

Regime = Literal["candidates", "filtered", "bare"]
REGIMES: tuple[Regime, ...] = ("candidates", "filtered", "bare")
FILTERS = ("ratio", "mutual", "ratio and mutual", "best")
FILTER_RATIO = (0.7, 0.9)
MINIMUM_MATCHES = 32
DISTANCE_COLUMNS = [Column.RATIO, Column.BEST, Column.RATIO_KNOWN, Column.BEST_KNOWN]
SHAPE_COLUMNS = [Column.LOG2_SIZE, Column.COS_TURN, Column.SIN_TURN, Column.SHAPE_KNOWN]
THINNED = 0.2  # share of the filtered lists of which a random part is left only


@dataclass(frozen=True)
class SamplingConfig:
    """Which pairs and matches a batch holds.

    Attributes:
        batch_size: pairs of a step.
        matches: numbers of matches that a batch may be cut to; one is drawn for each batch.
        matches_weights: how often each of them is drawn.
        candidates, filtered, bare: shares of the three kinds of input: all that the matcher knows; lists that
            were filtered beforehand (ratio 0.7–0.9, mutual, best of the list); nothing but points.
        scene_exponent: a scene is drawn with weight pairs ** exponent.
        holdout_every: of each scene every n-th pair is kept for known-scene validation; 0 keeps none.
        pool_batches: batches that are drawn together and sorted by length, so that little is cut away.
    """

    batch_size: int = 16
    matches: tuple[int, ...] = (256, 384, 512, 1024)
    matches_weights: tuple[float, ...] = (0.3, 0.4, 0.26, 0.04)
    candidates: float = 0.6
    filtered: float = 0.2
    bare: float = 0.2
    scene_exponent: float = 0.5
    holdout_every: int = 40
    pool_batches: int = 8

    def __post_init__(self) -> None:
        if not self.matches or len(self.matches) != len(self.matches_weights):
            raise ValueError("matches and matches_weights must be equally long")
        if min(self.batch_size, self.pool_batches, *self.matches) < 1:
            raise ValueError("batch_size, pool_batches and matches must be positive")
        for names in (("candidates", "filtered", "bare"), ("matches_weights",)):
            weights = np.hstack([getattr(self, name) for name in names])
            if weights.min() < 0 or weights.sum() <= 0:
                raise ValueError(f"{', '.join(names)} must be non-negative and not all zero")


def draw_input(
    rng: np.random.Generator, pair: TrainingPair, sampling: SamplingConfig
) -> tuple[Regime, NDArray[np.intp], NDArray[np.float32]]:
    """Kind of input, rows of the pair that may enter, and encoded attributes (M, 8) as the caller has them."""
    attributes = pair.attributes.encode(len(pair))
    shares = np.array([sampling.candidates, sampling.filtered, sampling.bare])
    regime = REGIMES[int(rng.choice(3, p=shares / shares.sum()))]
    rows = np.arange(len(attributes))
    if regime == "filtered":
        rows = _filtered_rows(rng, pair, attributes)
    attributes = _forget(rng, attributes, regime)
    return regime, rows[candidate_mask(attributes[rows])], attributes


def filter_rows(pair: TrainingPair, attributes: NDArray[np.float32], kind: str, max_ratio: float) -> NDArray[np.intp]:
    """Rows that a user's own filter leaves; a filter that asks for what the source does not know leaves all."""
    keep = np.ones(len(attributes), dtype=bool)
    if kind.startswith("ratio"):
        keep &= (attributes[:, Column.RATIO] < max_ratio) | (attributes[:, Column.RATIO_KNOWN] == 0)
    if kind.endswith("mutual"):
        keep &= pair.mutual
    if kind == "best":
        keep &= (attributes[:, Column.BEST] > 0) | (attributes[:, Column.BEST_KNOWN] == 0)
    return np.flatnonzero(keep)


def _filtered_rows(rng: np.random.Generator, pair: TrainingPair, attributes: NDArray[np.float32]) -> NDArray[np.intp]:
    """What one of the filters leaves, or part of that; all rows where fewer than 32 would remain."""
    rows = filter_rows(pair, attributes, str(rng.choice(FILTERS)), rng.uniform(*FILTER_RATIO))
    if len(rows) < MINIMUM_MATCHES:
        return np.arange(len(attributes))
    if rng.random() < THINNED:
        count = int(np.exp(rng.uniform(np.log(MINIMUM_MATCHES), np.log(len(rows) + 1))))
        rows = np.sort(rng.permutation(rows)[: max(count, MINIMUM_MATCHES)])
    return rows


def _forget(rng: np.random.Generator, attributes: NDArray[np.float32], regime: Regime) -> NDArray[np.float32]:
    """Attributes as a caller would have them who kept less than the matcher knew."""
    out = attributes.copy()
    if regime == "bare" or (regime == "filtered" and rng.random() < 0.5):
        out[:, DISTANCE_COLUMNS] = 0.0
        if regime == "bare" or rng.random() < 0.5:
            out[:, SHAPE_COLUMNS] = 0.0
            return out
    if rng.random() < 0.15:
        out[:, SHAPE_COLUMNS] = 0.0
    return out
