"""Graphs over the nearest neighbours in feature space, convolved per match instead of per edge.

An edge holds [x_i, x_i − x_j]. A linear map of it is W_c x_i − W_n x_j with W_c the sum of both halves, so
that maps of edges become maps of matches followed by a gather: the products shrink by the factor k.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .point_cn import ChannelBatchNorm, ContextNorm, LinearNorm, NormLinear

RING = 3  # neighbours that one annular kernel covers
FAR = 1e30
# Up to so many matches each is compared with all others, the networks having been trained on 2000; of more, in windows,
# with so many around its block of so many.
MANY, WINDOW, BLOCK = 2048, 1024, 256


def nearest_neighbours(features: Tensor, k: int, windows: bool = False) -> Tensor:
    """Indices (B, N, k) of the nearest matches in feature space (B, N, C), nearest first.

    The match itself is one of them. Where there are fewer than k matches the match itself fills the rest:
    k padding keys that are never near stand behind the real ones, so that k is a constant of the graph.

    In ``windows`` each of more than :data:`MANY` matches is compared with :data:`WINDOW` others alone, and time grows
    with N instead of N²: in the order of :func:`along_variation` a block of matches sees those around it, among which
    nearly all neighbours are.
    """
    x = features.detach().float()
    x = x - x.mean(1, keepdim=True)  # distances survive, cancellation does not
    with torch.autocast(x.device.type, enabled=False):  # neighbours must not depend on the training precision
        if not windows or x.shape[1] <= MANY:
            return _nearest(x, x, k)
        order = along_variation(x).argsort(-1, descending=True)  # (B, N)
        ordered, found = gather_rows(x, order), []
        for first in range(0, x.shape[1], BLOCK):
            start = min(max(first - (WINDOW - BLOCK) // 2, 0), x.shape[1] - WINDOW)
            found.append(_nearest(ordered[:, first : first + BLOCK], ordered[:, start : start + WINDOW], k) + start)
        nearest = order.unsqueeze(-1).expand(-1, -1, k).gather(1, torch.cat(found, 1))
        return nearest.gather(1, order.argsort(-1).unsqueeze(-1).expand(-1, -1, k))


def _nearest(x: Tensor, others: Tensor, k: int) -> Tensor:
    """Numbers (B, N, k) of the nearest rows of ``others`` (B, M, C) to each row of x (B, N, C); its own for none."""
    # Per row i, the order of |x_i − x_j|² is that of |x_j|²/2 − x_i·x_j.
    penalty = F.pad(0.5 * others.square().sum(-1, keepdim=True), (0, 0, 0, k), value=FAR)
    keys = torch.cat([F.pad(others, (0, 0, 0, k)), -penalty], -1)  # (B, M + k, C + 1)
    queries = torch.cat([x, torch.ones_like(x[..., :1])], -1)
    indices = (queries @ keys.transpose(1, 2)).topk(k, dim=-1).indices  # of (B, N, M + k)
    own = torch.arange(x.shape[1], device=x.device).view(1, -1, 1)
    return torch.where(indices < others.shape[1], indices, own)


def along_variation(x: Tensor) -> Tensor:
    """Where centred features (..., N, C) lie, (..., N), along the direction in which they vary most, roughly.

    One step of the power method, from a start that stands for no direction in particular.
    """
    start = torch.linspace(1.0, 2.0, x.shape[-1], device=x.device).unsqueeze(-1)
    return (x @ (x.transpose(-1, -2) @ (x @ start)))[..., 0]


def batch_rows(indices: Tensor, count: int) -> Tensor:
    """Indices (B, ...) into ``count`` rows of each pair as indices into the rows of the whole batch."""
    start = torch.arange(indices.shape[0], device=indices.device) * count
    return indices + start.view([-1] + [1] * (indices.dim() - 1))


def gather_rows(rows: Tensor, indices: Tensor) -> Tensor:
    """Rows (B, M, C) at indices (B, ...) → (B, ..., C)."""
    return F.embedding(batch_rows(indices, rows.shape[1]), rows.flatten(0, 1))


class AnnularConvolution(nn.Module):
    """Annular convolution over the sorted neighbours of one or several graphs.

    The columns of all graphs — neighbours by rising distance, one graph after the other — are cut into rings
    of three; a 1x3 kernel with stride 3 maps each ring (BN, ReLU), a 1xR kernel joins the R rings (BN, ReLU).

    Args:
        channels: width of the graphs' features; an edge has twice as many.
        outputs: width of the result.
        graphs: number of graphs.
        k: neighbours taken of each graph; ``graphs * k`` must be a multiple of 3.
    """

    def __init__(self, channels: int, outputs: int, graphs: int, k: int) -> None:
        super().__init__()
        if graphs * k % RING:
            raise ValueError(f"{graphs} graphs of {k} neighbours do not fill rings of {RING}")
        columns = [(graph, rank) for graph in range(graphs) for rank in range(k)]
        # Of each ring: {graph: [(rank of the neighbour, position in the kernel), ...]}
        self.rings: list[dict[int, list[tuple[int, int]]]] = []
        for first in range(0, len(columns), RING):
            ring: dict[int, list[tuple[int, int]]] = {}
            for position, (graph, rank) in enumerate(columns[first : first + RING]):
                ring.setdefault(graph, []).append((rank, position))
            self.rings.append(ring)
        self.outputs = outputs
        bound = (2 * RING * channels) ** -0.5
        self.centre = nn.Parameter(torch.empty(RING, channels, outputs).uniform_(-bound, bound))
        self.neighbour = nn.Parameter(torch.empty(RING, channels, outputs).uniform_(-bound, bound))
        self.ring_norm = ChannelBatchNorm(outputs)
        self.join = LinearNorm(len(self.rings) * outputs, outputs)

    def forward(self, maps: Sequence[Tensor], indices: Sequence[Tensor]) -> Tensor:
        """Features (B, N, channels) and neighbours (B, N, k), one of each per graph → (B, N, outputs)."""
        rows = [batch_rows(index, x.shape[1]) for x, index in zip(maps, indices, strict=True)]
        # What a match contributes as a neighbour, by graph and position in the ring: (B * N, outputs).
        neighbours: dict[tuple[int, int], Tensor] = {}
        centres: dict[tuple[int, tuple[int, ...]], Tensor] = {}
        rings = []
        for ring in self.rings:
            terms = []
            for graph, taken in ring.items():
                positions = tuple(position for _, position in taken)
                if (graph, positions) not in centres:
                    centres[graph, positions] = maps[graph] @ self.centre[list(positions)].sum(0)
                term = centres[graph, positions]
                for rank, position in taken:
                    if (graph, position) not in neighbours:
                        neighbours[graph, position] = (maps[graph] @ self.neighbour[position]).flatten(0, 1)
                    # One neighbour after the other: a sum of gathers is faster than the sum over a gathered axis.
                    term = term - F.embedding(rows[graph][..., rank], neighbours[graph, position])
                terms.append(term)
            rings.append(sum(terms[1:], terms[0]))
        ringed = F.relu(self.ring_norm(torch.stack(rings, 2)))  # (B, N, R, outputs)
        return F.relu(self.join(ringed.flatten(2)))


class EdgeMaximum(nn.Module):
    """Context norm → BN → ReLU → 1x1 conv of each edge, then the maximum over the neighbours."""

    def __init__(self, channels: int, outputs: int) -> None:
        super().__init__()
        self.centre_norm = ContextNorm(channels)
        self.difference_norm = ContextNorm(channels, dims=(1, 2))
        self.centre = nn.Linear(channels, outputs)
        self.difference = nn.Linear(channels, outputs, bias=False)

    def forward(self, x: Tensor, indices: Tensor) -> Tensor:
        difference = x.unsqueeze(2) - gather_rows(x, indices)  # (B, N, k, C)
        edges = self.difference(F.relu(self.difference_norm(difference)))
        return self.centre(F.relu(self.centre_norm(x))) + edges.amax(2)


class AttentionalFusion(nn.Module):
    """Gate between two feature maps: 2 a w + 2 b (1 − w), w = sigmoid(local(a + b) + global(a + b))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = channels // 4
        self.local = nn.Sequential(LinearNorm(channels, hidden), nn.ReLU(), LinearNorm(hidden, channels))
        # One vector per pair is too little for batch statistics: LayerNorm instead.
        self.pooled = nn.Sequential(
            nn.Linear(channels, hidden), nn.LayerNorm(hidden), nn.ReLU(), nn.Linear(hidden, channels)
        )

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        both = a + b
        w = torch.sigmoid(self.local(both) + self.pooled(both.mean(1, keepdim=True)))
        return 2.0 * (b + (a - b) * w)


class GraphBlock(nn.Module):
    """GNN block: annular convolution and edge maximum over k neighbours, joined by attentional fusion.

    Both branches are ``expansion`` C wide (2 in the published code) and reduced to C before the fusion.
    """

    def __init__(self, channels: int, k: int, expansion: int = 1, windows: bool = False) -> None:
        super().__init__()
        self.k, self.windows = k, windows
        width = expansion * channels
        self.annular = AnnularConvolution(channels, width, graphs=1, k=k)
        self.maximum = EdgeMaximum(channels, width)
        self.reduce1 = NormLinear(width, channels) if expansion > 1 else nn.Identity()
        self.reduce2 = NormLinear(width, channels) if expansion > 1 else nn.Identity()
        self.fusion = AttentionalFusion(channels)

    def forward(self, x: Tensor) -> Tensor:
        indices = nearest_neighbours(x, self.k, self.windows)  # (B, N, k)
        annular = self.reduce1(self.annular([x], [indices]))
        return self.fusion(annular, self.reduce2(self.maximum(x, indices)))
