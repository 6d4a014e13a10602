"""Training state on disk: written atomically, read without pickled code, enough to go on bit for bit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

from .config import ConfigError, TrainingConfig


def save_checkpoint(
    path: Path, config: TrainingConfig, step: int, network: nn.Module, average: nn.Module, optimizer: Optimizer
) -> None:
    """Write the state after ``step`` steps; a crash in the middle leaves the previous file whole.

    The data of a step depend on the seed and its number, the learning rate on the number: neither needs saving.
    """
    state = {
        "config": repr(config),
        "step": step,
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "torch_rng": torch.get_rng_state(),
    }
    temporary = path.with_suffix(".partial")
    with open(temporary, "wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def restore_checkpoint(
    path: Path, config: TrainingConfig, network: nn.Module, average: nn.Module, optimizer: Optimizer
) -> int:
    """Put a saved state back and return the number of steps done.

    Raises:
        ConfigError: the state was written under another config.
    """
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    if state["config"] != repr(config):
        raise ConfigError(f"{path}: was written under another config; start a new run directory")
    network.load_state_dict(state["network"])
    average.load_state_dict(state["average"])
    optimizer.load_state_dict(state["optimizer"])
    torch.set_rng_state(state["torch_rng"])
    return int(state["step"])
