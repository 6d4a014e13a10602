"""Where training pairs come from: scene bundles, OANet dumps, rendered worlds, image-free pairs; mixed by weights.

A source draws a pair from a random generator and from nothing else, so that what a step sees depends on the seed
and the step's number alone, however many processes draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np

from ..data.oanet_hdf5 import OanetFile
from ..data.scene_bundle import SceneBundle, bundle_files
from ..errors import BundleError, DatasetError
from ..geometry.epipolar import essential_from_pose
from .config import ConfigError, SourceConfig, TrainingConfig
from .pairs import TrainingPair, epipolar_labels
from .sampling import MINIMUM_MATCHES
from .synthetic import SyntheticSource
from .worlds.photographs import PhotoFolder
from .worlds.view_pairs import match_views
from .worlds.views import draw_views

HOLDOUT_REMAINDER = 7


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


def is_held_out(pair_index: int, holdout_every: int) -> bool:
    """Whether a pair of a training scene is kept for known-scene validation."""
    return holdout_every > 0 and pair_index % holdout_every == HOLDOUT_REMAINDER % holdout_every


class BundleSource:
    """Draws a scene with weight pairs ** ``scene_exponent``, then a pair of it that is not held out.

    Args:
        bundles: at least one.
        scene_exponent, holdout_every: as in :class:`mgca_filter.training.sampling.SamplingConfig`.
        labels: "clean" or "epipolar"; a bundle that holds its own labels keeps them.

    Raises:
        BundleError: no pair has 32 matches or more.
    """

    def __init__(
        self,
        bundles: Sequence[SceneBundle],
        scene_exponent: float = 0.5,
        holdout_every: int = 0,
        labels: str = "clean",
    ) -> None:
        self.bundles = list(bundles)
        self.labels = labels
        self.pairs = [
            [
                index
                for index, count in enumerate(bundle.match_counts())
                if count >= MINIMUM_MATCHES and not is_held_out(index, holdout_every)
            ]
            for bundle in self.bundles
        ]
        sizes = np.array([len(pairs) for pairs in self.pairs], dtype=np.float64)
        if not sizes.any():
            raise BundleError(f"no pair with {MINIMUM_MATCHES} matches or more to train on")
        weights = np.where(sizes > 0, np.maximum(sizes, 1.0) ** scene_exponent, 0.0)
        self.scene_probability = weights / weights.sum()

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """Scene first, then a pair of it."""
        scene = int(rng.choice(len(self.bundles), p=self.scene_probability))
        return self.pair(scene, int(rng.choice(self.pairs[scene])))

    def pair(self, scene: int, index: int) -> TrainingPair:
        """Pair ``index`` of bundle ``scene``."""
        pair = self.bundles[scene][index]
        labels = pair.labels
        if labels is None and self.labels == "epipolar":
            labels = epipolar_labels(pair.correspondences, pair.E)
        return TrainingPair(pair.name, pair.correspondences, pair.R, pair.t, pair.attributes, pair.mutual, labels)


class OanetSource:
    """Draws every pair of a dump that has 32 matches or more with the same probability.

    Args:
        path: HDF5 file.
        labels: "clean", or "epipolar" as the papers of the family have them.

    Raises:
        DatasetError: the file cannot be read as a dump, or holds no pair with enough matches.
        ImportError: h5py is not installed.
    """

    def __init__(self, path: str | Path, labels: str = "clean") -> None:
        self.file = OanetFile(path)
        self.labels = labels
        counts = np.array([self.file.match_count(index) for index in range(len(self.file))])
        self.pairs = np.flatnonzero(counts >= MINIMUM_MATCHES)
        if len(self.pairs) == 0:
            raise DatasetError(f"{path}: xs: no pair with {MINIMUM_MATCHES} matches or more to train on")
        self.file.close()  # worker processes open it for themselves

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """A pair with its ratios and, as "best of the list", what its mutual neighbours tell."""
        pair = self.file[int(rng.choice(self.pairs))]
        known = None
        if self.labels == "epipolar":
            known = epipolar_labels(pair.correspondences, essential_from_pose(pair.R, pair.t))
        name = f"{self.file.path.stem}/{pair.index}"
        return TrainingPair(name, pair.correspondences, pair.R, pair.t, pair.attributes(), pair.mutual, known)


class RenderedSource:
    """Worlds made of the photographs of a folder, rendered when they are asked for: endless, and as slow as SIFT.

    A pair costs about half a second of one core. Where training is faster than that, render beforehand
    (``python -m mgca_filter.training.render``) and read the bundle.

    Raises:
        PhotoError: the folder holds no photograph, or one of them cannot be read.
    """

    def __init__(self, folder: str | Path) -> None:
        self.photos = PhotoFolder.open(folder)
        for index in range(len(self.photos)):
            self.photos.check(index)

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """Two views of a random world; another world where too little of it matches."""
        while True:
            pair = match_views(*draw_views(rng, self.photos, 2))
            if pair.usable:
                break
        matches = pair.matches
        return TrainingPair(
            "rendered", pair.correspondences, pair.R, pair.t, matches.attributes, matches.mutual, pair.labels
        )


@dataclass(frozen=True)
class OpenedSources:
    """The mixture to train on, the bundles in it, and those of the tuning scenes, which are in no mixture."""

    source: DataSource
    training: list[SceneBundle]
    tuning: list[SceneBundle]


def open_sources(config: TrainingConfig, data: Path) -> OpenedSources:
    """Open and check all sources of a config, each file once; their paths start from the folder ``data``.

    Raises:
        ConfigError: a scene that the config names is in none of the bundles, or no scene is left to train on.
        MgcaFilterError: a bundle, dump or photograph cannot be used; it is named.
        ImportError: a package that a source needs is not installed.
    """
    read = cache(SceneBundle)  # two sources may name one bundle
    bundles = {
        index: [read(file) for file in bundle_files(data / source.path)]
        for index, source in enumerate(config.sources)
        if source.kind == "bundles"
    }
    everything = list(dict.fromkeys(bundle for group in bundles.values() for bundle in group))
    names = {bundle.photographs for bundle in everything}
    for key in ("scenes", "tuning_scenes", "doubtful_scenes"):
        missing = [scene for scene in getattr(config, key) if scene not in names]
        if missing:
            raise ConfigError(f"{key}: not in the data folder: {', '.join(missing)}")
    chosen = names.intersection(config.scenes or names).difference(config.tuning_scenes, config.doubtful_scenes)
    training = [bundle for bundle in everything if bundle.photographs in chosen]
    for bundle in training:
        bundle.check_training_pairs()
    sources = [
        _open(source, config, data, [bundle for bundle in bundles.get(index, []) if bundle.photographs in chosen])
        for index, source in enumerate(config.sources)
    ]
    mixed = sources[0] if len(sources) == 1 else MixedSource(sources, [source.weight for source in config.sources])
    # A learned matcher's lists have no raw matches to make validation's kinds of input from.
    tuning = [bundle for bundle in everything if bundle.photographs in config.tuning_scenes and not bundle.learned]
    return OpenedSources(mixed, training, tuning)


def _open(source: SourceConfig, config: TrainingConfig, data: Path, bundles: list[SceneBundle]) -> DataSource:
    if source.kind == "bundles":
        if not bundles:
            raise ConfigError(
                f"scenes: nothing is left to train on in {data / source.path} besides what tuning_scenes names"
            )
        return BundleSource(bundles, config.sampling.scene_exponent, config.sampling.holdout_every, source.labels)
    if source.kind == "oanet":
        return OanetSource(data / source.path, source.labels)
    if source.kind == "rendered":
        return RenderedSource(data / source.path)
    return SyntheticSource()
