"""A training run as one file: network, data, augmentation and schedule, all frozen."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ..network import NetworkConfig
from .augmentation import AugmentationConfig
from .sampling import SamplingConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


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
        precision: "bf16" runs matrix products in bfloat16; the solve and the graphs stay in float32.
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

    ``scenes`` names the bundles to train on; empty = all that the sources hold. ``tuning_scenes`` are kept
    out of training: what is chosen often is chosen on them. ``validation`` names further bundles or OANet dumps,
    from the folder that ``--data`` names, to look at while training.
    """

    name: str
    seed: int = 0
    scenes: tuple[str, ...] = ()
    tuning_scenes: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    sources: tuple[SourceConfig, ...] = (SourceConfig(),)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as the run directory and the checkpoints keep them."""
        return asdict(self)


TABLES = {"sampling": SamplingConfig, "augmentation": AugmentationConfig, "schedule": ScheduleConfig}


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
    values = dict(values)
    for name in ("network", *TABLES):
        if not isinstance(values.get(name, {}), dict):
            raise ConfigError(f"{where}: {name}: expected a table, got {values[name]!r}")
    entries = values.pop("sources", [{}])
    if not isinstance(entries, (list, tuple)) or not entries or not all(isinstance(e, dict) for e in entries):
        raise ConfigError(f"{where}: sources: expected a list of tables, got {entries!r}")
    try:
        network = NetworkConfig.from_dict(values.pop("network", {}))
    except ValueError as error:
        raise ConfigError(f"{where}: network: {error}") from error
    tables = {name: _table(where, name, kind, values.pop(name, {})) for name, kind in TABLES.items()}
    sources = tuple(_table(where, f"sources[{i}]", SourceConfig, entry) for i, entry in enumerate(entries))
    rest = _checked(where, "", TrainingConfig, values)
    if "name" not in rest:
        raise ConfigError(f"{where}: name: missing")
    return TrainingConfig(**rest, **tables, network=network, sources=sources)


def _table(where: str, name: str, kind: type, values: dict[str, Any]) -> Any:
    checked = _checked(where, name, kind, values)
    try:
        return kind(**checked)
    except ValueError as error:
        raise ConfigError(f"{where}: {name}: {error}") from error


def _checked(path: str, table: str, kind: type, values: dict[str, Any]) -> dict[str, Any]:
    """Values whose keys and types are those of the dataclass ``kind``; lists become tuples."""
    hints = get_type_hints(kind)
    checked = {}
    for key, value in values.items():
        where = f"{table}.{key}" if table else key
        if key not in hints:
            raise ConfigError(f"{path}: {where}: unknown key")
        hint = hints[key]
        if get_origin(hint) is Literal:
            if value not in get_args(hint):
                raise ConfigError(f"{path}: {where}: expected one of {', '.join(get_args(hint))}, got {value!r}")
            checked[key] = value
        elif get_origin(hint) is tuple:
            if not isinstance(value, (list, tuple)):
                raise ConfigError(f"{path}: {where}: expected a list, got {value!r}")
            checked[key] = tuple(_scalar(path, where, get_args(hint)[0], item) for item in value)
        else:
            checked[key] = _scalar(path, where, hint, value)
    return checked


def _scalar(path: str, where: str, kind: type, value: Any) -> Any:
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ConfigError(f"{path}: {where}: expected {kind.__name__}, got {value!r}")
    return value
