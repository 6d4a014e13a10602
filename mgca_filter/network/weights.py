"""Weights as safetensors: data, never pickles; the metadata say which network they fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..errors import ModelError
from .config import NetworkConfig
from .mgca_net import MGCANet


def save_network(network: MGCANet, path: str | Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write the weights of a network; ``config`` is added to the metadata."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    save_file(tensors, str(path), {**(metadata or {}), "config": network.config.to_json()})


def read_metadata(path: str | Path) -> dict[str, str]:
    """Metadata of a weights file.

    Raises:
        ModelError: the file is missing or no safetensors file.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            return dict(file.metadata() or {})
    except (OSError, SafetensorError) as error:
        raise ModelError(f"{path}: cannot be read as safetensors weights ({error})") from error


def load_network(path: str | Path) -> MGCANet:
    """Network with the weights of a file, on the CPU, in evaluation mode.

    Raises:
        ModelError: the file is missing, truncated, or holds weights of another network.
    """
    metadata = read_metadata(path)
    if "config" not in metadata:
        raise ModelError(f"{path}: no network config in the metadata")
    try:
        network = MGCANet(NetworkConfig.from_json(metadata["config"]))
        with safe_open(str(path), framework="pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        network.load_state_dict(state)
    except (ValueError, RuntimeError, SafetensorError, OSError) as error:
        raise ModelError(f"{path}: weights do not fit the network they name ({error})") from error
    return network.eval().requires_grad_(False)


def count_parameters(network: torch.nn.Module) -> int:
    """Number of trainable parameters."""
    return sum(parameter.numel() for parameter in network.parameters())
