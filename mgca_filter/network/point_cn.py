"""Normalisation over the matches of a pair, and the residual block made of it."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CONTEXT_NORM_EPS = 1e-3
BATCH_NORM_EPS = 1e-5
BATCH_NORM_MOMENTUM = 0.1


class ChannelBatchNorm(nn.BatchNorm1d):
    """BatchNorm over the last axis of (..., C): every match of every pair is one sample."""

    running_mean: Tensor
    running_var: Tensor

    def forward(self, x: Tensor) -> Tensor:
        if self.training:
            return super().forward(x.reshape(-1, x.shape[-1])).reshape(x.shape)
        scale = self.weight * torch.rsqrt(self.running_var + self.eps)
        return x * scale + (self.bias - self.running_mean * scale)


class ContextNorm(nn.Module):
    """Context normalisation followed by BatchNorm, as one scale and shift.

    Context normalisation: per pair and channel, zero mean and unit variance over the matches (Yi et al.,
    CVPR 2018), without an affine part. What it gives has mean 0 and variance v / (v + eps), v the variance
    over the matches, so the batch statistics that BatchNorm needs follow from v alone, exactly, and both
    norms together cost one pass. ``dims`` are the axes that hold matches: 1 for (B, N, C), 1 and 2 for
    edges (B, N, k, C).
    """

    running_var: Tensor

    def __init__(self, channels: int, dims: tuple[int, ...] = (1,)) -> None:
        super().__init__()
        self.dims = dims
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        x = x.float()  # a mean over many matches is worth more digits than autocast leaves
        centred = x - x.mean(self.dims, keepdim=True)
        variance = centred.square().mean(self.dims, keepdim=True)
        context_scale = torch.rsqrt(variance + CONTEXT_NORM_EPS)  # (B, 1, C)
        batch_variance = self.running_var
        if self.training:
            batch_variance = (variance * context_scale.square()).flatten(0, -2).mean(0)
            self.running_var.lerp_(batch_variance.detach(), BATCH_NORM_MOMENTUM)
        scale = context_scale * (self.weight * torch.rsqrt(batch_variance + BATCH_NORM_EPS))
        return centred * scale + self.bias


class LinearNorm(nn.Module):
    """1x1 convolution followed by BatchNorm: a pair that export folds into one matrix product."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = ChannelBatchNorm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.linear(x))


class NormLinear(nn.Module):
    """Context norm → BN → ReLU → 1x1 conv, the building block of the OANet family."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.norm = ContextNorm(inputs)
        self.linear = nn.Linear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.linear(F.relu(self.norm(x)))


class PointCN(nn.Module):
    """[context norm → BN → GELU → 1x1 conv] twice, plus a shortcut (1x1 conv where the width changes)."""

    def __init__(self, inputs: int, outputs: int | None = None) -> None:
        super().__init__()
        outputs = outputs or inputs
        self.norm1 = ContextNorm(inputs)
        self.linear1 = nn.Linear(inputs, outputs)
        self.norm2 = ContextNorm(outputs)
        self.linear2 = nn.Linear(outputs, outputs)
        self.shortcut = nn.Linear(inputs, outputs) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        y = self.linear1(F.gelu(self.norm1(x)))  # (B, N, outputs)
        y = self.linear2(F.gelu(self.norm2(y)))
        return self.shortcut(x) + y
