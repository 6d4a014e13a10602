"""Batches by step: what a step sees depends on the seed and the step's number alone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from .augmentation import AugmentationConfig
from .samples import Draw, build_sample, draw_sample
from .sampling import SamplingConfig
from .sources import DataSource


class TrainingDataset(Dataset[dict[str, Tensor]]):
    """Item ``step`` is the whole batch of that step; workers and resumes change nothing about it.

    Batches are drawn in pools (see :meth:`pools`); a process that makes all steps of a pool draws it once.

    Args:
        source: where pairs come from.
        shard: (rank, number of processes) where several share each batch.

    Raises:
        ValueError: the batch does not divide among the processes.
    """

    def __init__(
        self,
        source: DataSource,
        sampling: SamplingConfig,
        augmentation: AugmentationConfig,
        seed: int,
        steps: int,
        shard: tuple[int, int] = (0, 1),
    ) -> None:
        self.source = source
        self.sampling = sampling
        self.augmentation = augmentation
        self.seed = seed
        self.steps = steps
        self.rank, self.world = shard
        if sampling.batch_size % self.world:
            raise ValueError(
                f"sampling.batch_size: {sampling.batch_size} pairs do not divide among {self.world} processes"
            )
        self._pool = lru_cache(maxsize=1)(self._draw_pool)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "_pool"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._pool = lru_cache(maxsize=1)(self._draw_pool)

    def __len__(self) -> int:
        return self.steps

    def pools(self, first: int, last: int) -> list[list[int]]:
        """Steps ``first`` … ``last`` − 1, grouped by the pool that they are drawn in."""
        size = self.sampling.pool_batches
        borders = [first, *range((first // size + 1) * size, last, size), last]
        return [list(range(start, end)) for start, end in zip(borders, borders[1:]) if start < end]

    def __getitem__(self, step: int) -> dict[str, Tensor]:
        """Batch of a step: see :func:`build_sample` for the fields, each with a leading batch axis."""
        pool, position = divmod(step, self.sampling.pool_batches)
        draws, order = self._pool(pool)
        size = self.sampling.batch_size
        batch = draws[order[position] * size : (order[position] + 1) * size]
        rng = np.random.default_rng([self.seed, step, 2])
        weights = np.array(self.sampling.matches_weights)
        count = int(rng.choice(self.sampling.matches, p=weights / weights.sum()))
        count = min([count] + [len(draw.rows) for draw in batch])
        samples = [build_sample(draw, count, self.augmentation) for draw in batch[self.rank :: self.world]]
        return {name: torch.from_numpy(np.stack([s[name] for s in samples])) for name in samples[0]}

    def _draw_pool(self, pool: int) -> tuple[list[Draw], NDArray[np.intp]]:
        """All samples of a pool of batches, short ones first, and the order of its batches."""
        batches = self.sampling.pool_batches
        seeds = [(self.seed, pool, 0, i) for i in range(batches * self.sampling.batch_size)]
        draws = [draw_sample(self.source, self.sampling, seed) for seed in seeds]
        draws.sort(key=lambda draw: len(draw.rows))
        return draws, np.random.default_rng([self.seed, pool, 1]).permutation(batches)
