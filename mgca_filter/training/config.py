"""A training run as one file: network, data, augmentation and schedule, all frozen."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ..network import NetworkConfig
from .augmentation import AugmentationConfig
from .datasets import SamplingConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


class ConfigError(ValueError):
    """A training config cannot be used; the message names file and key."""


@dataclass(frozen=True)
class ScheduleConfig:
    """Optimiser and schedule.

    Attributes:
        steps: number of optimiser steps.
        learning_rate: peak of AdamW's learning rate.
        final_fraction: the cosine ends at this fraction of the peak.
        warmup_steps: linear warm-up.
        weight_decay: of matrices; biases and norms have none.
        geometric_weight: weight of the geometric loss, from ``geometric_from`` (a fraction of the steps) on.
        prior_weight: weight of the prior's own classification loss on raw matches.
        clip_norm: gradients are clipped to this norm.
        ema_decay: of the running average of the weights, which is what is evaluated and shipped.
        precision: "bf16" runs matrix products in bfloat16; the solve and the graphs stay in float32.
    """

    steps: int = 6000
    learning_rate: float = 1.5e-3
    final_fraction: float = 0.02
    warmup_steps: int = 200
    weight_decay: float = 1e-4
    geometric_weight: float = 0.5
    geometric_from: float = 0.1
    prior_weight: float = 0.2
    clip_norm: float = 1.0
    ema_decay: float = 0.998
    precision: Literal["bf16", "fp32"] = "bf16"


@dataclass(frozen=True)
class TrainingConfig:
    """Everything a run depends on besides the data itself.

    ``scenes`` names the bundles to train on; empty = all that the data folder holds. ``tuning_scenes`` are kept
    out of training: what is chosen often is chosen on them.
    """

    name: str
    seed: int = 0
    scenes: tuple[str, ...] = ()
    tuning_scenes: tuple[str, ...] = ()
    network: NetworkConfig = field(default_factory=NetworkConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as the run directory and the checkpoints keep them."""
        return asdict(self)


def load_config(path: str | Path) -> TrainingConfig:
    """Read a TOML file with the tables network, sampling, augmentation and schedule.

    Raises:
        ConfigError: the file cannot be read, or holds a key or value that does not fit; it is named.
    """
    path = Path(path)
    try:
        values: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    tables = {"sampling": SamplingConfig, "augmentation": AugmentationConfig, "schedule": ScheduleConfig}
    for name in ("network", *tables):
        if not isinstance(values.get(name, {}), dict):
            raise ConfigError(f"{path}: {name}: expected a table, got {values[name]!r}")
    try:
        name = "network"
        parsed: dict[str, Any] = {name: NetworkConfig.from_dict(values.pop(name, {}))}
        for name, kind in tables.items():
            parsed[name] = kind(**_checked(path, name, kind, values.pop(name, {})))
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{path}: {name}: {error}") from error
    rest = _checked(path, "", TrainingConfig, values)
    if "name" not in rest:
        raise ConfigError(f"{path}: name: missing")
    return TrainingConfig(**rest, **parsed)


def _checked(path: Path, table: str, kind: type, values: dict[str, Any]) -> dict[str, Any]:
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
            if not isinstance(value, list):
                raise ConfigError(f"{path}: {where}: expected a list, got {value!r}")
            checked[key] = tuple(_scalar(path, where, get_args(hint)[0], item) for item in value)
        else:
            checked[key] = _scalar(path, where, hint, value)
    return checked


def _scalar(path: Path, where: str, kind: type, value: Any) -> Any:
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ConfigError(f"{path}: {where}: expected {kind.__name__}, got {value!r}")
    return value
