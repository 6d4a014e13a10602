"""Small networks and their inputs, for the tests of network, training and export."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from mgca_filter.network import MGCANet, NetworkConfig

torch.set_num_threads(1)  # networks this small only lose by sharing the work

TINY = NetworkConfig(channels=8, clusters=8, stages=2)


def randomise_norms(module: nn.Module, seed: int = 0) -> nn.Module:
    """Give every norm statistics and an affine part that are not the identity, as training would."""
    generator = torch.Generator().manual_seed(seed)
    for child in module.modules():
        for name, tensor in [*child.named_parameters(recurse=False), *child.named_buffers(recurse=False)]:
            if name == "running_var" or (name == "weight" and tensor.dim() == 1):
                tensor.data = 0.5 + torch.rand(tensor.shape, generator=generator)
            elif name == "running_mean" or (name == "bias" and hasattr(child, "running_var")):
                tensor.data = 0.3 * torch.randn(tensor.shape, generator=generator)
    return module


def tiny_network(config: NetworkConfig = TINY, seed: int = 0) -> MGCANet:
    """A network in evaluation mode with random weights and random norms."""
    torch.manual_seed(seed)
    network = MGCANet(config)
    randomise_norms(network, seed)
    return network.eval().requires_grad_(False)


def two_view_batch(count: int, batch: int = 1, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Correspondences (batch, count, 4), half of them right, and attributes (batch, count, 8), all known."""
    rng = np.random.default_rng([seed, count])
    X = np.concatenate([rng.uniform(-2, 2, (batch, count, 2)), rng.uniform(4, 9, (batch, count, 1))], -1)
    angle = 0.1
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    X2 = X @ R.T + np.array([-1.0, 0.2, 0.1])
    x1, x2 = X[..., :2] / X[..., 2:], X2[..., :2] / X2[..., 2:]
    right = rng.random((batch, count)) < 0.5
    x2 = np.where(right[..., None], x2, rng.uniform(-0.5, 0.5, x2.shape))
    turn = np.where(right, rng.normal(0, 0.1, right.shape), rng.uniform(-np.pi, np.pi, right.shape))
    attributes = np.ones((batch, count, 8))
    attributes[..., 0] = rng.uniform(0.4, 0.95, right.shape)
    attributes[..., 2] = rng.normal(0, 0.5, right.shape)
    attributes[..., 3], attributes[..., 4] = np.cos(turn), np.sin(turn)
    correspondences = np.concatenate([x1, x2], -1)
    return torch.from_numpy(correspondences.astype(np.float32)), torch.from_numpy(attributes.astype(np.float32))


def sign_free_difference(E: Tensor, other: Tensor) -> float:
    """Largest difference of two batches of essential matrices (B, 3, 3), each up to its sign."""
    differences = torch.minimum((E - other).abs().amax((1, 2)), (E + other).abs().amax((1, 2)))
    return float(differences.max())


def settled_network(config: NetworkConfig) -> MGCANet:
    """A random network whose norms know the statistics of its input."""
    torch.manual_seed(2)
    network = MGCANet(config).train()
    with torch.no_grad():
        for seed in range(8):
            network(*two_view_batch(64, batch=2, seed=seed))
    return network.eval().requires_grad_(False)
