"""Consensus between stages: graphs of several feature maps, convolved together (CSMGC)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .graph import AnnularConvolution, nearest_neighbours
from .point_cn import LinearNorm

CONSENSUS_NEIGHBOURS = 3
FINAL_COLUMNS = 6


class SqueezeExcitation(nn.Module):
    """Channel gates from the mean over the matches (Hu et al., CVPR 2018)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gate = nn.Sequential(
            nn.Linear(channels, channels // 4), nn.ReLU(), nn.Linear(channels // 4, channels), nn.Sigmoid()
        )

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gate(x.mean(1, keepdim=True))


class SqueezeExcitationResidual(nn.Module):
    """[1x1 conv → BN → ReLU → 1x1 conv → BN → squeeze-and-excitation] + shortcut, ReLU."""

    def __init__(self, channels: int, squeeze_excitation: bool = True) -> None:
        super().__init__()
        self.linear1 = LinearNorm(channels, channels)
        self.linear2 = LinearNorm(channels, channels)
        self.gate = SqueezeExcitation(channels) if squeeze_excitation else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.gate(self.linear2(F.relu(self.linear1(x)))))


class GraphConsensus(nn.Module):
    """Feature maps (B, N, C) → 1x1 conv to C/2 → nearest-neighbour graphs → annular convolution → MLP."""

    def __init__(self, channels: int, graphs: int, k: int) -> None:
        super().__init__()
        self.k = k
        self.reduce = nn.ModuleList([nn.Linear(channels, channels // 2) for _ in range(graphs)])
        self.annular = AnnularConvolution(channels // 2, channels, graphs, k)
        self.output = nn.Sequential(LinearNorm(channels, channels), nn.ReLU(), nn.Linear(channels, channels))

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        reduced = [reduce(x) for reduce, x in zip(self.reduce, maps, strict=True)]
        return self.output(self.annular(reduced, [nearest_neighbours(x, self.k) for x in reduced]))


class CrossStageConsensus(nn.Module):
    """CSMGC of stage 2 and later, MGCA-Net section 3.3, in the form of the published code.

    Graphs of the current features, of the previous stage's graph block and of its output; from stage 3 on also
    of the outputs of all stages before that, concatenated, gated by squeeze-and-excitation and reduced to C.
    (The text takes the outputs of the two attention blocks and puts the MLP before the convolution.)

    Args:
        channels: width C.
        earlier: number of stages before the previous one.
    """

    def __init__(self, channels: int, earlier: int, squeeze_excitation: bool = True) -> None:
        super().__init__()
        self.gate: nn.Module | None = None
        if earlier:
            gate = SqueezeExcitation(earlier * channels) if squeeze_excitation else nn.Identity()
            reduce = nn.Linear(earlier * channels, channels) if earlier > 1 else nn.Identity()
            self.gate = nn.Sequential(gate, reduce)
        self.consensus = GraphConsensus(channels, 4 if earlier else 3, CONSENSUS_NEIGHBOURS)

    def forward(self, current: Tensor, previous_graph: Tensor, outputs: Sequence[Tensor]) -> Tensor:
        """``outputs`` are the outputs of all earlier stages, first stage first."""
        maps = [current, previous_graph, outputs[-1]]
        if self.gate is not None:
            maps.append(self.gate(torch.cat(list(outputs[:-1]), -1)))
        return self.consensus(maps)


class FinalConsensus(nn.Module):
    """Consensus over the outputs of all stages: six columns, residual, two squeeze-and-excitation blocks."""

    def __init__(self, channels: int, stages: int, squeeze_excitation: bool = True) -> None:
        super().__init__()
        self.consensus = GraphConsensus(channels, stages, FINAL_COLUMNS // stages)
        self.residual = nn.Sequential(
            *[SqueezeExcitationResidual(channels, squeeze_excitation) for _ in range(2)],
        )

    def forward(self, outputs: Sequence[Tensor]) -> Tensor:
        return self.residual(outputs[-1] + self.consensus(outputs))
