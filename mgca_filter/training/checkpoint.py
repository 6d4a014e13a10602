"""Training state on disk: written atomically, read without pickled code, enough to go on bit for bit."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

from ..atomic_file import replaced_when_done
from .config import ConfigError, TrainingConfig, config_from_dict
from .schedule import LossWatch


def save_checkpoint(
    path: Path,
    config: TrainingConfig,
    step: int,
    network: nn.Module,
    average: nn.Module,
    optimizer: Optimizer,
    watch: LossWatch,
) -> None:
    """Write the state after ``step`` steps; a crash in the middle leaves the previous file whole.

    The data of a step depend on the seed and its number, the learning rate on the number: neither needs saving.
    """
    state = {
        "config": json.dumps(config.to_dict()),
        "step": step,
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "loss_watch": asdict(watch),
        "torch_rng": torch.get_rng_state(),
    }
    with replaced_when_done(path) as temporary:
        torch.save(state, temporary)


def restore_checkpoint(
    path: Path,
    config: TrainingConfig,
    network: nn.Module,
    average: nn.Module,
    optimizer: Optimizer,
    watch: LossWatch,
) -> int:
    """Put a saved state back and return the number of steps done.

    Options that are newer than the state count as having had their defaults.

    Raises:
        ConfigError: the state was written under another config.
    """
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    changed = _changed_keys(path, state["config"], config)
    if changed:
        raise ConfigError(f"{path}: was written under another config ({changed}); start a new run directory")
    network.load_state_dict(state["network"])
    average.load_state_dict(state["average"])
    optimizer.load_state_dict(state["optimizer"])
    for name, value in state["loss_watch"].items():
        setattr(watch, name, value)
    torch.set_rng_state(state["torch_rng"])
    return int(state["step"])


def _changed_keys(path: Path, saved: str, config: TrainingConfig) -> str:
    """Names of the options whose values differ, comma-separated; empty where none do."""
    try:
        before = config_from_dict(json.loads(saved), str(path)).to_dict()
    except ValueError as error:  # written before options were named as they are now
        raise ConfigError(f"{path}: its config cannot be read ({error}); start a new run directory") from error
    after = config.to_dict()
    names = []
    for key, value in after.items():
        if isinstance(value, dict):
            names += [f"{key}.{name}" for name in value if value[name] != before[key][name]]
        elif value != before[key]:
            names.append(key)
    return ", ".join(names)
