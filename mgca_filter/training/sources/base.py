"""The interface of a data source, and a mixture of several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..pairs import TrainingPair


class DataSource(Protocol):
    """Draws training pairs; picklable, because worker processes draw too."""

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """A pair that depends on the state of ``rng`` alone."""
        ...


class MixedSource:
    """Several sources, each drawn from in proportion to its weight."""

    def __init__(self, sources: Sequence[DataSource], weights: Sequence[float]) -> None:
        if len(sources) != len(weights) or min(weights) < 0 or sum(weights) <= 0:
            raise ValueError(f"weights: expected {len(sources)} non-negative numbers, not all zero, got {weights}")
        self.sources = tuple(sources)
        self.probability = np.array(weights, dtype=np.float64) / sum(weights)

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """Source first, then a pair of it."""
        return self.sources[int(rng.choice(len(self.sources), p=self.probability))].draw(rng)
