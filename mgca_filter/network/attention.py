"""Context graph attention (CGA): attention over content and position, then a three-branch feed-forward."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .point_cn import LinearNorm


class ContextPositionAttention(nn.Module):
    """Context position attention (CPA), MGCA-Net section 3.2.1, in both published forms.

    1. Q, K, V = ReLU(BN(linear(F)));  P = linear(points 1) + linear(points 2)
    2. ``point`` (the text): (softmax(Q K^T / sqrt(C)) + softmax(Q P^T)) V over matches, N x N
       ``channel`` (the published code): softmax(τ Q^T (K + P) / N) V over channels, C x C

    The published channel form sums over N and divides by sqrt(C), so its temperature drifts with N; here the
    product is a mean over matches and the temperature τ is learned (it starts at sqrt(C)).
    """

    def __init__(self, channels: int, form: Literal["channel", "point"] = "channel", positional: bool = True) -> None:
        super().__init__()
        self.form = form
        self.query = LinearNorm(channels, channels)
        self.key = LinearNorm(channels, channels)
        self.value = LinearNorm(channels, channels)
        # Two linear maps of two coordinates each, summed, are one linear map of the four coordinates.
        self.position = nn.Linear(4, channels) if positional else None
        if form == "channel":
            self.log_temperature = nn.Parameter(torch.tensor(0.5 * math.log(channels)))

    def forward(self, features: Tensor, correspondences: Tensor) -> Tensor:
        query = F.relu(self.query(features))  # (B, N, C)
        key = F.relu(self.key(features))
        value = F.relu(self.value(features))
        position = self.position(correspondences) if self.position is not None else None
        if self.form == "channel":
            if position is not None:
                key = key + position
            mean_key = key * (self.log_temperature.exp() / key.shape[1])
            affinity = query.transpose(1, 2) @ mean_key  # (B, C, C)
            return value @ affinity.float().softmax(-1).to(value.dtype).transpose(1, 2)
        attended = F.scaled_dot_product_attention(query, key, value)
        if position is not None:
            attended = attended + F.scaled_dot_product_attention(query, position.to(query.dtype), value, scale=1.0)
        return attended


class _Bottleneck(nn.Module):
    """conv(C → C/4) → norm → GELU → conv(C/4 → C) → norm.

    Pooled branches hold one vector per pair, too few for the statistics of a batch: they get LayerNorm
    where the branch over matches has BatchNorm.
    """

    def __init__(self, channels: int, pooled: bool) -> None:
        super().__init__()
        hidden = channels // 4
        self.reduce: nn.Module
        self.expand: nn.Module
        if pooled:
            self.reduce = nn.Sequential(nn.Linear(channels, hidden), nn.LayerNorm(hidden))
            self.expand = nn.Linear(hidden, channels)
        else:
            self.reduce = LinearNorm(channels, hidden)
            self.expand = LinearNorm(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.expand(F.gelu(self.reduce(x)))


class MultiBranchFeedForward(nn.Module):
    """MB-FFN, MGCA-Net section 3.2.2, in the form of the published code.

    u = conv(x);  gate = sigmoid(local(u) + average-pooled(u) + max-pooled(u));  out = conv(gate) + u + x
    """

    def __init__(self, channels: int, pooled_branches: bool = True) -> None:
        super().__init__()
        self.input = nn.Linear(channels, channels)
        self.local = _Bottleneck(channels, pooled=False)
        self.average = _Bottleneck(channels, pooled=True) if pooled_branches else None
        self.maximum = _Bottleneck(channels, pooled=True) if pooled_branches else None
        self.output = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        u = self.input(x)  # (B, N, C)
        gate = self.local(u)
        if self.average is not None and self.maximum is not None:
            pooled = self.average(u.mean(1, keepdim=True)) + self.maximum(u.amax(1, keepdim=True))
            gate = gate + pooled  # (B, 1, C) broadcast over matches
        return self.output(torch.sigmoid(gate)) + u + x


class ContextGraphAttention(nn.Module):
    """CGA = CPA → + residual → LayerNorm → MB-FFN → LayerNorm → + the first LayerNorm's output."""

    def __init__(
        self,
        channels: int,
        form: Literal["channel", "point"] = "channel",
        positional: bool = True,
        pooled_branches: bool = True,
    ) -> None:
        super().__init__()
        self.attention = ContextPositionAttention(channels, form, positional)
        self.norm1 = nn.LayerNorm(channels)
        self.feed_forward = MultiBranchFeedForward(channels, pooled_branches)
        self.norm2 = nn.LayerNorm(channels)

    def forward(self, features: Tensor, correspondences: Tensor) -> Tensor:
        x = self.norm1(features + self.attention(features, correspondences))  # (B, N, C)
        return x + self.norm2(self.feed_forward(x))
