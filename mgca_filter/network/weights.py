"""Weights as safetensors: data, never pickles; the metadata say which network they fit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..errors import ModelError
from .config import NetworkConfig
from .mgca_net import MGCANet

_STAGE_NUMBER = re.compile(r"^(stages|heads)\.(\d+)\.")


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


def transfer_weights(source: MGCANet, target: MGCANet) -> None:
    """Let ``target`` start from the weights of a network of equal width.

    A stage that the source lacks starts as a copy of its last one; of a source with more stages the first are taken,
    without their final consensus. Where a layer sees more inputs than in the source, the further ones count nothing
    at first; what has no counterpart keeps its random start. Equal networks end up with equal weights.

    Raises:
        ValueError: the networks differ in more than their stages and what is fed back.
    """
    same = replace(source.config, stages=target.config.stages, refined_feedback=target.config.refined_feedback)
    if same != target.config:
        raise ValueError(f"weights of {source.config} are no start for {target.config}")
    known = source.state_dict()
    if source.config.stages > target.config.stages:  # a consensus of more stages than there are
        known = {name: tensor for name, tensor in known.items() if not name.startswith("final")}
    for name, tensor in target.state_dict().items():
        old = known.get(_STAGE_NUMBER.sub(lambda match: _last_known(match, source.config.stages), name))
        if old is None:
            continue
        if old.shape != tensor.shape:
            tensor.zero_()
        tensor[tuple(slice(size) for size in old.shape)] = old


def _last_known(match: re.Match[str], stages: int) -> str:
    return f"{match[1]}.{min(int(match[2]), stages - 1)}."


def count_parameters(network: torch.nn.Module) -> int:
    """Number of trainable parameters."""
    return sum(parameter.numel() for parameter in network.parameters())
