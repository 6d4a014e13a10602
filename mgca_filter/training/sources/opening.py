"""From a config's list of sources to the sources themselves, and to the pairs that are kept for validation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...data.scene_bundle import SceneBundle, load_scene_bundles
from ..config import ConfigError, SourceConfig, TrainingConfig
from .base import DataSource, MixedSource
from .bundles import BundleSource, check_pairs
from .oanet import OanetSource
from .rendered import RenderedSource
from .synthetic import SyntheticSource


@dataclass(frozen=True)
class OpenedSources:
    """The mixture to train on, the bundles in it, and those of the tuning scenes, which are in no mixture."""

    source: DataSource
    training: list[SceneBundle]
    tuning: list[SceneBundle]


def open_sources(config: TrainingConfig, data: Path) -> OpenedSources:
    """Open and check all sources of a config; their paths start from the folder ``data``.

    Raises:
        ConfigError: a scene that the config names is in none of the bundles, or no scene is left to train on.
        MgcaFilterError: a bundle, dump or photograph cannot be used; it is named.
        ImportError: a package that a source needs is not installed.
    """
    bundles = {
        index: load_scene_bundles(data / source.path)
        for index, source in enumerate(config.sources)
        if source.kind == "bundles"
    }
    everything = [bundle for group in bundles.values() for bundle in group]
    names = {bundle.scene for bundle in everything}
    for key, wanted in (("scenes", config.scenes), ("tuning_scenes", config.tuning_scenes)):
        missing = [scene for scene in wanted if scene not in names]
        if missing:
            raise ConfigError(f"{key}: not in the data folder: {', '.join(missing)}")
    chosen = names.intersection(config.scenes or names).difference(config.tuning_scenes)
    training = [bundle for bundle in everything if bundle.scene in chosen]
    for bundle in training:
        check_pairs(bundle)
    sources = [
        _open(source, config, data, [bundle for bundle in bundles.get(index, []) if bundle.scene in chosen])
        for index, source in enumerate(config.sources)
    ]
    mixed = sources[0] if len(sources) == 1 else MixedSource(sources, [source.weight for source in config.sources])
    return OpenedSources(mixed, training, [bundle for bundle in everything if bundle.scene in config.tuning_scenes])


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
