"""A training run as one file: network, data, augmentation and schedule, all frozen."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import dacite

from ..network import NetworkConfig
from .augmentation import AugmentationConfig
from .sampling import SamplingConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

T = TypeVar("T")


class ConfigError(ValueError):
    """A training config cannot be used; the message names file and key."""


@dataclass(frozen=True)
class SourceConfig:
    """One data source, an entry of ``[[sources]]``.

    Attributes:
        kind: "bundles" (scene bundles), "oanet" (a dump in OANet's HDF5 format), "rendered" (worlds made of a
            folder of photographs while training) or "synthetic" (image-free pairs, from no file).
        path: file or folder, from the folder that ``--data`` names; empty = that folder itself.
        weight: how often it is drawn, in proportion to the others.
        labels: "clean", or "epipolar": the field's threshold of 1e-4; sources that know the truth ignore it.
    """

    kind: Literal["bundles", "oanet", "rendered", "synthetic"] = "bundles"
    path: str = ""
    weight: float = 1.0
    labels: Literal["clean", "epipolar"] = "clean"

    def __post_init__(self) -> None:
        if self.weight <= 0:
            raise ValueError(f"weight must be positive, not {self.weight}")
        if self.kind == "synthetic" and self.path:
            raise ValueError(f"path: synthetic pairs come from no file, got {self.path!r}")


@dataclass(frozen=True)
class ScheduleConfig:
    """Optimiser and schedule.

    Attributes:
        kind: after the warm-up, "cosine" or "steps".
        steps: number of optimiser steps.
        learning_rate: peak of AdamW's learning rate.
        final_fraction: the cosine ends at this fraction of the peak.
        milestones, factor: of the kind "steps": the rate is multiplied by the factor at each milestone.
        warmup_steps: linear warm-up.
        weight_decay: of matrices; biases and norms have none.
        geometric_weight: weight of the geometric loss, from ``geometric_from`` (a fraction of the steps) on.
        refined_weight: weight of the loss of the refined essential matrix, likewise.
        prior_weight: weight of the prior's own classification loss on raw matches.
        clip_norm: gradients are clipped to this norm.
        ema_decay: of the running average of the weights, which is what is evaluated and shipped.
        divergence_factor: the run stops when the averaged loss is this multiple of its lowest value; 0 = never.
        precision: "bf16" runs matrix products in bfloat16; the solve and the graphs stay in float32. Processors that
            have no bfloat16 of their own take twice as long with it as with "fp32".
    """

    kind: Literal["cosine", "steps"] = "cosine"
    steps: int = 6000
    learning_rate: float = 1.5e-3
    final_fraction: float = 0.02
    milestones: tuple[int, ...] = ()
    factor: float = 0.4
    warmup_steps: int = 200
    weight_decay: float = 1e-4
    geometric_weight: float = 0.5
    refined_weight: float = 0.0
    geometric_from: float = 0.1
    prior_weight: float = 0.2
    clip_norm: float = 1.0
    ema_decay: float = 0.998
    divergence_factor: float = 3.0
    precision: Literal["bf16", "fp32"] = "bf16"

    def __post_init__(self) -> None:
        if self.steps < 1 or self.warmup_steps < 0:
            raise ValueError("steps must be positive and warmup_steps not negative")
        if self.milestones and self.kind != "steps":
            raise ValueError('milestones belong to the kind "steps"')


@dataclass(frozen=True)
class TrainingConfig:
    """Everything a run depends on besides the data itself.

    ``scenes`` names what to train on; empty = all that the sources hold. ``tuning_scenes`` are kept out of training:
    what is chosen often is chosen on them. ``doubtful_scenes``, whose poses are suspect, are in neither. A name stands
    for the bundles of all detectors: ``lounge`` for ``lounge.orb2k`` as well. ``validation`` names further bundles or
    OANet dumps, from the folder that ``--data`` names, to look at while training.
    """

    name: str
    seed: int = 0
    scenes: tuple[str, ...] = ()
    tuning_scenes: tuple[str, ...] = ()
    doubtful_scenes: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    sources: tuple[SourceConfig, ...] = (SourceConfig(),)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as the run directory and the checkpoints keep them."""
        return asdict(self)


TABLES: dict[str, type] = {"sampling": SamplingConfig, "augmentation": AugmentationConfig, "schedule": ScheduleConfig}


def load_config(path: str | Path) -> TrainingConfig:
    """Read a TOML file with the tables network, sampling, augmentation and schedule, and the list sources.

    Raises:
        ConfigError: the file cannot be read, or holds a key or value that does not fit; it is named.
    """
    path = Path(path)
    try:
        values: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    return config_from_dict(values, str(path))


def config_from_dict(values: dict[str, Any], where: str) -> TrainingConfig:
    """A config from plain values, as TOML and :meth:`TrainingConfig.to_dict` give them.

    Raises:
        ConfigError: a key or value does not fit; the message starts with ``where`` and the key.
    """
    entries = values.get("sources", [{}])
    if not isinstance(entries, (list, tuple)) or not entries:
        raise ConfigError(f"{where}: sources: expected a list of tables, got {entries!r}")
    tables: dict[str, Any] = {name: _read(kind, values.get(name, {}), where, name) for name, kind in TABLES.items()}
    sources = tuple(_read(SourceConfig, entry, where, f"sources[{i}]") for i, entry in enumerate(entries))
    network = _network(values.get("network", {}), where)
    return _read(TrainingConfig, {**values, **tables, "sources": sources, "network": network}, where)


def _network(values: Any, where: str) -> NetworkConfig:
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: network: expected a table, got {values!r}")
    try:
        return NetworkConfig.from_dict(values)
    except ValueError as error:
        raise ConfigError(f"{where}: network: {error}") from error


def _read(kind: type[T], values: Any, where: str, table: str = "") -> T:
    """The dataclass ``kind`` from a table of the file ``where``; ``table`` is its name, "" = the file itself."""
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: {table}: expected a table, got {values!r}")
    prefix = f"{where}: {table}." if table else f"{where}: "
    try:
        return dacite.from_dict(kind, values, _STRICT)
    except dacite.UnexpectedDataError as error:
        raise ConfigError(f"{prefix}{sorted(error.keys)[0]}: unknown key") from error
    except dacite.MissingValueError as error:
        raise ConfigError(f"{prefix}{error.field_path}: missing") from error
    except dacite.WrongTypeError as error:
        expected = _describe(error.field_type)
        raise ConfigError(f"{prefix}{error.field_path}: expected {expected}, got {error.value!r}") from error
    except ValueError as error:  # a range that the dataclass itself checks
        raise ConfigError(f"{where}: {table}: {error}") from error


def _describe(kind: Any) -> str:
    """A type in the words of a config file."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    return f"a list of {get_args(kind)[0].__name__}" if get_origin(kind) is tuple else str(kind.__name__)


def _number(kind: type) -> Callable[[Any], Any]:
    """Lets whole numbers pass as float, and no bool as a number, which Python would."""

    def read(value: Any) -> Any:
        if isinstance(value, bool):
            raise dacite.WrongTypeError(kind, value)
        return float(value) if kind is float and isinstance(value, int) else value

    return read


def _list(kind: Any) -> Callable[[Any], Any]:
    """Lists become tuples; text is no list of letters."""

    def read(value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            raise dacite.WrongTypeError(kind, value)
        return tuple(value)

    return read


_STRICT = dacite.Config(
    strict=True,
    type_hooks={kind: _number(kind) for kind in (int, float)}
    | {kind: _list(kind) for kind in (tuple[int, ...], tuple[float, ...], tuple[str, ...])},
)
