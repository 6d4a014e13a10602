"""Training samples from scene bundles: what a step sees depends on the seed and the step's number alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from ..correspondences import candidate_mask
from ..epipolar import homogeneous, symmetric_epipolar_distance_squared
from ..errors import BundleError
from ..scene_bundle import SceneBundle, ScenePair
from .augmentation import (
    AugmentationConfig,
    draw_homographies,
    sees_all,
    transform_attributes,
    transform_epipolar,
    transform_points,
)
from .labels import POSITIVE, clean_labels

Regime = Literal["candidates", "filtered", "bare"]
VIRTUAL_GRID = 20
SAMPSON_STEPS = 8
MINIMUM_POSITIVES = 8
MINIMUM_MATCHES = 32  # pairs with fewer would cut their whole batch down
PRIOR_MATCHES = 256
HOLDOUT_REMAINDER = 7


@dataclass(frozen=True)
class SamplingConfig:
    """Which pairs and matches a batch holds.

    Attributes:
        batch_size: pairs of a step.
        matches: numbers of matches that a batch may be cut to; one is drawn for each batch.
        matches_weights: how often each of them is drawn.
        candidates, filtered, bare: shares of the three kinds of input: all that the matcher knows; lists that
            were filtered beforehand (ratio 0.7–0.9, mutual); nothing but points.
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


@dataclass(frozen=True)
class Draw:
    """One sample before it is built: which pair, how its input looks, which matches may enter."""

    scene: int
    pair: int
    regime: Regime
    seed: tuple[int, ...]
    rows: NDArray[np.intp]
    attributes: NDArray[np.float32]  # encoded, of all raw matches of the pair


def is_held_out(pair_index: int, holdout_every: int) -> bool:
    """Whether a pair of a training scene is kept for known-scene validation."""
    return holdout_every > 0 and pair_index % holdout_every == HOLDOUT_REMAINDER % holdout_every


class SceneBundleDataset(Dataset[dict[str, Tensor]]):
    """Item ``step`` is the whole batch of that step; workers and resumes change nothing about it.

    Of several processes each takes its share of the batch: ``shard`` is (rank, number of processes).
    """

    def __init__(
        self,
        bundles: Sequence[SceneBundle],
        sampling: SamplingConfig,
        augmentation: AugmentationConfig,
        seed: int,
        steps: int,
        shard: tuple[int, int] = (0, 1),
    ) -> None:
        self.bundles = list(bundles)
        self.sampling = sampling
        self.augmentation = augmentation
        self.seed = seed
        self.steps = steps
        self.rank, self.world = shard
        if sampling.batch_size % self.world:
            raise ValueError(f"a batch of {sampling.batch_size} pairs does not divide among {self.world} processes")
        self.pairs = [
            [
                index
                for index, count in enumerate(bundle.match_counts())
                if count >= MINIMUM_MATCHES and not is_held_out(index, sampling.holdout_every)
            ]
            for bundle in self.bundles
        ]
        sizes = np.array([len(pairs) for pairs in self.pairs], dtype=np.float64)
        if not sizes.any():
            raise BundleError(f"no pair with {MINIMUM_MATCHES} matches or more to train on")
        weights = np.where(sizes > 0, np.maximum(sizes, 1.0) ** sampling.scene_exponent, 0.0)
        self.scene_probability = weights / weights.sum()
        self._pool = lru_cache(maxsize=1)(self._draw_pool)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "_pool"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._pool = lru_cache(maxsize=1)(self._draw_pool)

    def __len__(self) -> int:
        return self.steps

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
        samples = [self.build_sample(draw, count) for draw in batch[self.rank :: self.world]]
        return {name: torch.from_numpy(np.stack([s[name] for s in samples])) for name in samples[0]}

    def _draw_pool(self, pool: int) -> tuple[list[Draw], NDArray[np.intp]]:
        """All samples of a pool of batches, short ones first, and the order of its batches."""
        batches = self.sampling.pool_batches
        draws = [self.draw((self.seed, pool, 0, i)) for i in range(batches * self.sampling.batch_size)]
        draws.sort(key=lambda draw: len(draw.rows))
        return draws, np.random.default_rng([self.seed, pool, 1]).permutation(batches)

    def draw(self, seed: tuple[int, ...]) -> Draw:
        """Scene first, then a pair of it, then the kind of input."""
        rng = np.random.default_rng(seed)
        scene = int(rng.choice(len(self.bundles), p=self.scene_probability))
        index = int(rng.choice(self.pairs[scene]))
        pair = self.bundles[scene][index]
        attributes = pair.attributes.encode(len(pair.points1))
        shares = np.array([self.sampling.candidates, self.sampling.filtered, self.sampling.bare])
        regimes: tuple[Regime, ...] = ("candidates", "filtered", "bare")
        regime = regimes[int(rng.choice(3, p=shares / shares.sum()))]
        rows = np.arange(len(attributes))
        if regime == "filtered":
            rows = _filtered_rows(rng, pair, attributes)
        attributes = _forget(rng, attributes, regime)
        rows = rows[candidate_mask(attributes[rows])]
        return Draw(scene, index, regime, seed, rows, attributes)

    def build_sample(self, draw: Draw, count: int) -> dict[str, NDArray[np.generic]]:
        """Arrays of one sample.

        ``correspondences`` (N, 4), ``attributes`` (N, 8), ``labels`` (N,) 1 / 0 / −1; ``virtual`` (400, 4) points
        on the true epipolar geometry and ``virtual_valid`` (); ``prior_attributes`` (256, 8) and
        ``prior_labels`` (256,) of raw matches, candidates or not.
        """
        rng = np.random.default_rng((*draw.seed, 1))
        pair = self.bundles[draw.scene][draw.pair]
        labels = clean_labels(pair)
        rows = rng.permutation(draw.rows)[:count]
        x = pair.correspondences[rows]
        H1, H2 = draw_homographies(rng, self.augmentation)
        if not (sees_all(H1, x[:, :2]) and sees_all(H2, x[:, 2:])):
            H1, H2 = np.eye(3), np.eye(3)
        x1, J1 = transform_points(H1, x[:, :2])
        x2, J2 = transform_points(H2, x[:, 2:])
        assert pair.attributes.angle1 is not None
        angle1 = np.radians(pair.attributes.angle1[rows].astype(np.float64))
        attributes = transform_attributes(draw.attributes[rows], angle1, J1, J2)
        F = transform_epipolar(pair.E, H1, H2)
        correspondences = np.hstack([x1, x2])
        if draw.regime == "bare" and rng.random() < 0.5:  # no ratio, no best-of-list: a swap stays true
            correspondences, F = correspondences[:, [2, 3, 0, 1]], F.T
            attributes[:, [2, 4]] *= -1.0
        virtual, valid = virtual_correspondences(F)
        prior_rows = rng.integers(len(labels), size=PRIOR_MATCHES)
        return {
            "correspondences": correspondences.astype(np.float32),
            "attributes": attributes,
            "labels": labels[rows],
            "virtual": virtual,
            "virtual_valid": np.float32(valid and np.count_nonzero(labels[rows] == POSITIVE) >= MINIMUM_POSITIVES),
            "prior_attributes": draw.attributes[prior_rows],
            "prior_labels": labels[prior_rows],
        }


def _filtered_rows(rng: np.random.Generator, pair: ScenePair, attributes: NDArray[np.float32]) -> NDArray[np.intp]:
    """Rows that a user's own filter would have left: a ratio test, a cross-check, or both."""
    kind = int(rng.integers(3))
    keep = np.ones(len(attributes), dtype=bool)
    if kind != 1:
        keep &= attributes[:, 0] < rng.uniform(0.7, 0.9)
    if kind != 0:
        keep &= pair.mutual
    rows = np.flatnonzero(keep)
    return rows if len(rows) >= 32 else np.arange(len(attributes))


def _forget(rng: np.random.Generator, attributes: NDArray[np.float32], regime: Regime) -> NDArray[np.float32]:
    """Attributes as a caller would have them who kept less than the matcher knew."""
    out = attributes.copy()
    if regime == "bare" or (regime == "filtered" and rng.random() < 0.5):
        out[:, [0, 1, 5, 6]] = 0.0
        if regime == "bare" or rng.random() < 0.5:
            out[:, [2, 3, 4, 7]] = 0.0
            return out
    if rng.random() < 0.15:
        out[:, [2, 3, 4, 7]] = 0.0
    return out


def virtual_correspondences(F: NDArray[np.float64]) -> tuple[NDArray[np.float32], bool]:
    """Grid of 20 x 20 points on [−1, 1)² of both images, moved onto epipolar geometry F → (400, 4), usable.

    Repeated Sampson corrections (Hartley & Zisserman 12.4) reach the variety in a few steps and cost a
    hundredth of ``cv2.correctMatches``, which finds the nearest point of it; rows that do not converge, near
    the epipoles, are replaced by one that did.
    """
    ticks = np.arange(VIRTUAL_GRID) * (2.0 / VIRTUAL_GRID) - 1.0
    grid = np.stack(np.meshgrid(ticks, ticks, indexing="xy"), -1).reshape(-1, 2)
    virtual = np.hstack([grid, grid])
    for _ in range(SAMPSON_STEPS):
        line2, line1 = homogeneous(virtual[:, :2]) @ F.T, homogeneous(virtual[:, 2:]) @ F
        error = np.sum(homogeneous(virtual[:, 2:]) * line2, axis=1)
        gradient = np.hstack([line1[:, :2], line2[:, :2]])
        virtual = virtual - gradient * (error / np.maximum(np.sum(gradient**2, axis=1), 1e-12))[:, None]
    good = np.isfinite(virtual).all(1) & (np.abs(virtual).max(1) < 3.0)
    good &= symmetric_epipolar_distance_squared(np.where(np.isfinite(virtual), virtual, 0.0), F) < 1e-8
    if not good.any():
        return np.zeros(virtual.shape, np.float32), False
    virtual[~good] = virtual[good][0]
    return virtual.astype(np.float32), True
