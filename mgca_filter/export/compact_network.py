"""The same network in fewer operations, for the copy that is exported: runtimes open small graphs faster.

Each module here stands for one of ``mgca_filter.network`` in evaluation mode and takes its weights; what training needs
— gradients, statistics of a batch, precision of autocast — is not there any more. Three things make a graph small:

- affine maps that follow each other are one, and maps of one input side by side are one product (folded weights);
- context normalisation with channels first is ``InstanceNormalization``;
- several graphs of one consensus are one batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..network import MGCANet
from ..network.attention import ContextPositionAttention, MultiBranchFeedForward
from ..network.consensus import GraphConsensus
from ..network.eight_point import weighted_eight_point
from ..network.graph import FAR, MANY, RING, AnnularConvolution, EdgeMaximum, GraphBlock, along_variation
from ..network.mgca_net import MINIMUM_CONSENSUS, Head, HeadOutput, Prior, better_half, match_count
from ..network.order_aware import OrderAwareBlock, OrderAwareFilter
from ..network.point_cn import (
    BATCH_NORM_EPS,
    CONTEXT_NORM_EPS,
    ChannelBatchNorm,
    ContextNorm,
    LinearNorm,
    NormLinear,
    PointCN,
)

ROOT_HALF = 0.5**0.5


@torch.no_grad()
def compact(network: MGCANet) -> MGCANet:
    """Copy of a network in evaluation mode that says the same in fewer operations."""
    copy = deepcopy(network).eval()
    _replace(copy)
    return copy


def _replace(parent: nn.Module) -> None:
    for name, child in parent.named_children():
        if type(child) in _COMPACT:
            setattr(parent, name, _COMPACT[type(child)](child))
        else:
            _replace(child)


def scale_and_shift(norm: ChannelBatchNorm) -> tuple[Tensor, Tensor]:
    """What a BatchNorm does in evaluation mode, by channel."""
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return scale, norm.bias - norm.running_mean * scale


def _linear(weight: Tensor, bias: Tensor | None) -> nn.Linear:
    """A linear map of the weights (outputs, inputs)."""
    linear = nn.Linear(weight.shape[1], weight.shape[0], bias is not None)
    linear.weight.copy_(weight)
    if bias is not None:
        linear.bias.copy_(bias)
    return linear


def _folded(layer: LinearNorm | nn.Linear) -> nn.Linear:
    """A linear map that has taken in the BatchNorm behind it."""
    if isinstance(layer, nn.Linear):
        return layer
    scale, shift = scale_and_shift(layer.norm)
    return _linear(layer.linear.weight * scale[:, None], shift)


def _side_by_side(layers: Sequence[nn.Linear]) -> nn.Linear:
    """Linear maps of one input as one, whose output holds theirs one after the other."""
    return _linear(torch.cat([layer.weight for layer in layers]), torch.cat([layer.bias for layer in layers]))


class _ChannelsFirst(nn.Module):
    """A linear map of (B, C, N), channels first.

    A product, no convolution: OpenCV gives convolutions a layout of their own, which its norms do not know.
    """

    def __init__(self, linear: nn.Linear, bias: bool = True) -> None:
        super().__init__()
        self.weight = linear.weight
        self.bias = nn.Parameter(linear.bias.unsqueeze(-1)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        y = self.weight @ x
        return y if self.bias is None else y + self.bias


class _ContextNorm(nn.Module):
    """Context normalisation and its BatchNorm of (B, C, N), channels first; ``factor`` times what they give."""

    scale: Tensor
    shift: Tensor

    def __init__(self, norm: ContextNorm, factor: float = 1.0) -> None:
        super().__init__()
        self.register_buffer("scale", norm.weight * torch.rsqrt(norm.running_var + BATCH_NORM_EPS) * factor)
        self.register_buffer("shift", norm.bias * factor)

    def forward(self, x: Tensor) -> Tensor:
        # The function of torch.nn refuses a single match.
        return torch.instance_norm(x, self.scale, self.shift, None, None, True, 0.0, CONTEXT_NORM_EPS, False)


class _RowsNorm(nn.Module):
    """The same of (B, rows, C): there are too many edges to transpose them."""

    scale: Tensor
    shift: Tensor

    def __init__(self, norm: ContextNorm) -> None:
        super().__init__()
        self.register_buffer("scale", norm.weight * torch.rsqrt(norm.running_var + BATCH_NORM_EPS))
        self.register_buffer("shift", norm.bias)

    def forward(self, x: Tensor) -> Tensor:
        centred = x - x.mean(1, keepdim=True)
        variance = centred.square().mean(1, keepdim=True)
        return centred * (self.scale / torch.sqrt(variance + CONTEXT_NORM_EPS)) + self.shift


def scaled_gelu(x: Tensor) -> Tensor:
    """GELU(√2 x) · √2: both factors are in the weights before and behind it (:data:`ROOT_HALF` each)."""
    return x + x * torch.erf(x)


def _scaled(linear: nn.Linear, bias: bool) -> nn.Linear:
    """A linear map behind :func:`scaled_gelu`, or, with its ``bias`` scaled as well, in front of it."""
    scaled = None if linear.bias is None else linear.bias * (ROOT_HALF if bias else 1.0)
    return _linear(linear.weight * ROOT_HALF, scaled)


class _PointCN(nn.Module):
    def __init__(self, block: PointCN) -> None:
        super().__init__()
        self.norm1, self.norm2 = (_ContextNorm(norm, ROOT_HALF) for norm in (block.norm1, block.norm2))
        self.linear1 = _ChannelsFirst(
            _scaled(block.linear1, False), bias=False
        )  # the norm behind it subtracts the bias
        linear2 = _scaled(block.linear2, False)
        self.shortcut: nn.Module = nn.Identity()
        if isinstance(block.shortcut, nn.Linear):
            linear2.bias.add_(block.shortcut.bias)
            self.shortcut = _ChannelsFirst(block.shortcut, bias=False)
        self.linear2 = _ChannelsFirst(linear2)

    def forward(self, x: Tensor) -> Tensor:
        x = x.transpose(1, 2)  # (B, C, N)
        y = self.linear1(scaled_gelu(self.norm1(x)))
        y = self.linear2(scaled_gelu(self.norm2(y)))
        return (self.shortcut(x) + y).transpose(1, 2)


class _NormLinear(nn.Module):
    """Channels first."""

    def __init__(self, layer: NormLinear) -> None:
        super().__init__()
        self.norm, self.linear = _ContextNorm(layer.norm), _ChannelsFirst(layer.linear)

    def forward(self, x: Tensor) -> Tensor:
        return self.linear(F.relu(self.norm(x)))


class _OrderAwareFilter(nn.Module):
    """Channels first: (B, C, clusters)."""

    scale: Tensor
    shift: Tensor

    def __init__(self, block: OrderAwareFilter) -> None:
        super().__init__()
        self.channel1, self.channel2 = _NormLinear(block.channel1), _NormLinear(block.channel2)
        scale, shift = scale_and_shift(block.cluster_norm)
        self.register_buffer("scale", scale)
        self.register_buffer("shift", shift)
        self.cluster = block.cluster

    def forward(self, x: Tensor) -> Tensor:
        y = self.channel1(x)
        y = y + self.cluster(F.relu(y * self.scale + self.shift))
        return x + self.channel2(y)


class _OrderAwareBlock(nn.Module):
    def __init__(self, block: Any) -> None:
        super().__init__()
        self.pool, self.unpool = _NormLinear(block.pool), _NormLinear(block.unpool)
        self.filters = nn.Sequential(*map(_OrderAwareFilter, block.filters))

    def forward(self, x: Tensor) -> Tensor:
        channels = x.transpose(1, 2)  # (B, C, N)
        assignment = self.pool(channels).softmax(-1)  # (B, clusters, N)
        clusters = self.filters((assignment @ x).transpose(1, 2))  # (B, C, clusters)
        return (clusters @ self.unpool(channels).softmax(1)).transpose(1, 2)


class _ContextPositionAttention(nn.Module):
    def __init__(self, block: ContextPositionAttention) -> None:
        super().__init__()
        query, key, value = map(_folded, (block.query, block.key, block.value))
        if block.form == "channel":
            temperature = block.log_temperature.exp()  # positive: it may go in front of the ReLU
            query = _linear(query.weight * temperature, query.bias * temperature)
        self.form, self.together, self.position = block.form, _side_by_side([query, key, value]), block.position

    def forward(self, features: Tensor, correspondences: Tensor) -> Tensor:
        query, key, value = F.relu(self.together(features)).split(features.shape[-1], -1)  # (B, N, C)
        position = self.position(correspondences) if self.position is not None else None
        if self.form == "channel":
            if position is not None:
                key = key + position
            affinity = key.transpose(1, 2) @ query / key.shape[1]  # (B, C of the keys, C of the queries)
            return value @ affinity.softmax(1)
        attended = F.scaled_dot_product_attention(query, key, value)
        if position is not None:
            attended = attended + F.scaled_dot_product_attention(query, position, value, scale=1.0)
        return attended


class _MultiBranchFeedForward(nn.Module):
    """u, the hidden layer of the local branch and what is added in the end are affine in x: one product."""

    def __init__(self, block: Any) -> None:
        super().__init__()
        first, reduce = block.input, _folded(block.local.reduce)
        channels = first.in_features
        hidden = _scaled(_linear(reduce.weight @ first.weight, reduce.weight @ first.bias + reduce.bias), True)
        added = _linear(first.weight + torch.eye(channels), first.bias + block.output.bias)
        self.widths = [channels, hidden.out_features, channels]
        self.together = _side_by_side([first, hidden, added])
        self.output = _linear(block.output.weight, None)
        self.expand = _scaled(_folded(block.local.expand), False)
        self.pooled: nn.ModuleList | None = None
        if block.average is not None and block.maximum is not None:
            branches = (block.average, block.maximum)
            self.pooled = nn.ModuleList([branch.reduce for branch in branches])
            for branch in branches:
                branch.reduce[1].weight *= ROOT_HALF
                branch.reduce[1].bias *= ROOT_HALF
            layers = [_scaled(branch.expand, False) for branch in branches]
            bias = sum((layer.bias for layer in layers), self.expand.bias)
            self.pooled_expand = _linear(torch.cat([layer.weight for layer in layers], 1), bias)
            self.expand = _linear(self.expand.weight, None)

    def forward(self, x: Tensor) -> Tensor:
        u, hidden, added = self.together(x).split(self.widths, -1)  # (B, N, C)
        gate = self.expand(scaled_gelu(hidden))
        if self.pooled is not None:
            average, maximum = self.pooled
            pooled = torch.cat([average(u.mean(1, keepdim=True)), maximum(u.amax(1, keepdim=True))], -1)
            gate = gate + self.pooled_expand(scaled_gelu(pooled))  # (B, 1, C) broadcast over matches
        return self.output(torch.sigmoid(gate)) + added


class _AnnularConvolution(nn.Module):
    """Takes the features of all graphs, and their neighbours' features, gathered once.

    Side by side, the columns of a ring are one vector, and the kernel one matrix for all rings.
    """

    centre: Tensor
    neighbour: Tensor
    shift: Tensor

    def __init__(self, block: AnnularConvolution, offset: Tensor | None = None) -> None:
        """``offset`` (graphs · C) is what the features still lack."""
        super().__init__()
        scale, shift = scale_and_shift(block.ring_norm)
        channels, outputs = block.centre.shape[1:]
        rings = block.rings
        graphs = 1 + max(graph for ring in rings for graph in ring)
        centre = torch.zeros(graphs, channels, len(rings), outputs)
        for number, ring in enumerate(rings):
            for graph, taken in ring.items():
                for _, position in taken:
                    centre[graph, :, number] += block.centre[position]
        self.rings, self.width = len(rings), RING * channels
        self.register_buffer("centre", (centre * scale).reshape(graphs * channels, -1))
        self.register_buffer("neighbour", (block.neighbour * -scale).reshape(self.width, outputs))
        shift = shift.repeat(len(rings))
        if offset is not None:
            columns = offset.view(graphs, 1, channels).expand(-1, len(rings) * RING // graphs, -1)
            shift = shift + offset @ self.centre + (columns.reshape(-1, self.width) @ self.neighbour).flatten()
        self.register_buffer("shift", shift)
        self.join = _folded(block.join)

    def forward(self, features: Tensor, neighbours: Tensor) -> Tensor:
        """Features (B, N, graphs · C) and those of the neighbours (B, N, graphs, k, C) → (B, N, outputs)."""
        columns = neighbours.reshape(*features.shape[:2], self.rings, self.width) @ self.neighbour
        ringed = columns.flatten(2) + (features @ self.centre + self.shift)  # (B, N, rings · outputs)
        return F.relu(self.join(F.relu(ringed)))


class _EdgeMaximum(nn.Module):
    def __init__(self, block: EdgeMaximum) -> None:
        super().__init__()
        self.centre_norm, self.difference_norm = _ContextNorm(block.centre_norm), _RowsNorm(block.difference_norm)
        self.centre, self.difference = _ChannelsFirst(block.centre), block.difference

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """Features (B, N, C) and those of the neighbours (B, N, k, C) → (B, N, outputs)."""
        k, channels = neighbours.shape[2:]
        difference = (x.unsqueeze(2) - neighbours).reshape(x.shape[0], -1, channels)  # (B, N · k, C)
        edges = self.difference(F.relu(self.difference_norm(difference)))
        centre = self.centre(F.relu(self.centre_norm(x.transpose(1, 2)))).transpose(1, 2)
        return centre + edges.reshape(*x.shape[:2], k, -1).amax(2)


class _AttentionalFusion(nn.Module):
    """Of maps that are twice as large: the factor is in the weights that make them."""

    def __init__(self, block: Any) -> None:
        super().__init__()
        self.local, self.pooled = block.local, block.pooled
        _replace(self)
        for first in (block.local[0], block.pooled[0]):
            first.weight *= 0.5

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        both = a + b
        w = torch.sigmoid(self.local(both) + self.pooled(both.mean(1, keepdim=True)))
        return b + (a - b) * w


class _GraphBlock(nn.Module):
    def __init__(self, block: Any) -> None:
        super().__init__()
        self.k, self.fusion = block.k, _AttentionalFusion(block.fusion)
        self.nearest_rows = nearest_rows_in_order if block.windows else nearest_rows
        self.annular, self.maximum = _AnnularConvolution(block.annular), _EdgeMaximum(block.maximum)
        self.reduce1, self.reduce2 = block.reduce1, block.reduce2
        if isinstance(block.reduce1, nn.Identity):
            last: list[nn.Module] = [self.annular.join, self.maximum.centre, self.maximum.difference]
        else:
            last = [block.reduce1.linear, block.reduce2.linear]
        for layer in last:
            for parameter in layer.parameters():
                parameter.mul_(2.0)

    def forward(self, x: Tensor) -> Tensor:
        neighbours = F.embedding(self.nearest_rows(x, self.k), x.flatten(0, 1))  # (B, N, k, C)
        annular = self.reduce1(self.annular(x, neighbours))
        return self.fusion(annular, self.reduce2(self.maximum(x, neighbours)))


class _GraphConsensus(nn.Module):
    """The reduced maps go without their biases: those move no neighbour, and are in the shift of the rings."""

    def __init__(self, block: Any) -> None:
        super().__init__()
        self.k, self.graphs = block.k, len(block.reduce)
        self.reduce = nn.ModuleList([_linear(layer.weight, None) for layer in block.reduce])
        self.annular = _AnnularConvolution(block.annular, torch.cat([layer.bias for layer in block.reduce]))
        self.output = block.output
        _replace(self)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        reduced = torch.cat([reduce(x) for reduce, x in zip(self.reduce, maps)], -1)  # (B, N, graphs · C)
        graphs = reduced.view(*reduced.shape[:2], self.graphs, -1).transpose(1, 2)
        rows = nearest_rows(graphs, self.k).transpose(1, 2)  # (B, N, graphs, k)
        return self.output(self.annular(reduced, F.embedding(rows, graphs.reshape(-1, graphs.shape[-1]))))


def nearest_rows(features: Tensor, k: int) -> Tensor:
    """Rows (..., N, k) of the nearest matches in feature spaces (..., N, C), counted over all of these.

    Neighbours are those of :func:`mgca_filter.network.graph.nearest_neighbours`.
    """
    return _rows_nearest(features - features.mean(-2, keepdim=True), k)


def nearest_rows_in_order(features: Tensor, k: int) -> Tensor:
    """The same, looked for in an order in which nearest matches lie near each other, so that windows of it will do.

    It is that of :func:`mgca_filter.network.graph.along_variation`; up to :data:`MANY` matches stay where they are.
    """
    *outer, count, channels = features.shape
    x = features - features.mean(-2, keepdim=True)
    place = torch.arange(count)
    along = torch.where(place[-1:] < MANY, -place.float(), along_variation(x))
    starts = _starts(outer, count)[..., 0]
    order = along.argsort(-1, descending=True) + starts
    nearest = order.flatten()[_rows_nearest(F.embedding(order, x.reshape(-1, channels)), k)]
    back = order.float().argsort(-1) + starts
    return F.embedding(back, nearest.reshape(-1, k))


def _rows_nearest(x: Tensor, k: int) -> Tensor:
    """Of centred features (..., N, C); distances survive, cancellation does not."""
    *outer, count, channels = x.shape
    padded = F.pad(x, (0, 0, 0, k), value=FAR**0.5)
    penalty = padded.square() @ torch.full((channels, 1), -0.5)
    keys = torch.cat([padded, penalty], -1)  # (..., N + k, C + 1)
    nearness = F.pad(x, (0, 1), value=1.0) @ keys.transpose(-1, -2)
    indices = nearness.topk(k, dim=-1).indices
    own = torch.arange(count).view(-1, 1)
    return torch.where(indices < count, indices, own) + _starts(outer, count)


def _starts(outer: Sequence[int], count: int) -> Tensor:
    """First row (..., 1, 1) of each feature space."""
    return count * torch.arange(math.prod(outer)).view(-1, *outer[1:], 1, 1)


class _Head(nn.Module):
    def __init__(self, head: Head) -> None:
        super().__init__()
        self.together = _side_by_side([head.logit, head.weight])

    def forward(self, features: Tensor, prior: Tensor, correspondences: Tensor) -> HeadOutput:
        logits, a, b = self.together(features).split(1, -1)  # (B, N, 1)
        logits = torch.where(match_count(prior) >= MINIMUM_CONSENSUS, logits[..., 0], 0.0) + prior
        log_weights = (F.logsigmoid(a) + b)[..., 0] + torch.where(better_half(logits), 0.0, -1e4)
        return HeadOutput(logits, weighted_eight_point(correspondences, log_weights.softmax(-1)))


class _Prior(nn.Module):
    def __init__(self, prior: Prior) -> None:
        super().__init__()
        self.hidden, self.output = _scaled(prior.hidden, True), _scaled(prior.output, False)

    def forward(self, attributes: Tensor) -> Tensor:
        return self.output(scaled_gelu(self.hidden(attributes)))[..., 0]


_COMPACT: dict[type[nn.Module], Callable[..., nn.Module]] = {
    PointCN: _PointCN,
    OrderAwareBlock: _OrderAwareBlock,
    ContextPositionAttention: _ContextPositionAttention,
    MultiBranchFeedForward: _MultiBranchFeedForward,
    GraphBlock: _GraphBlock,
    GraphConsensus: _GraphConsensus,
    LinearNorm: _folded,
    Head: _Head,
    Prior: _Prior,
}
