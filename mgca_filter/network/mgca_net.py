"""MGCA-Net: Multi-Graph Contextual Attention Network for two-view matches (IJCAI 2025)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .attention import ContextGraphAttention
from .config import ATTRIBUTE_CHANNELS, NetworkConfig
from .consensus import CrossStageConsensus, FinalConsensus
from .eight_point import MINIMUM_POINTS, residual_channel, weighted_eight_point
from .essential_refinement import refine_essential
from .graph import GraphBlock
from .order_aware import OrderAwareBlock
from .point_cn import PointCN

PRIOR_HIDDEN = 16
# Only scores that have seen a geometry once lead its refinement nearer to the truth more often than away from it.
FIRST_REFINED_STAGE = 2
REFINED_FLOOR = 1e-3  # of the residual: about a quarter of a pixel
MINIMUM_CONSENSUS = 8  # fewer matches fit any geometry: the prior alone speaks


class HeadOutput(NamedTuple):
    """What a head says: logits (B, N) and essential matrices (B, 3, 3) of unit Frobenius norm."""

    logits: Tensor
    essential: Tensor


class NetworkOutput(NamedTuple):
    """The answer of the network, and the outputs of all heads, the answer's last (all are supervised)."""

    logits: Tensor  # (B, N)
    essential: Tensor  # (B, 3, 3)
    heads: list[HeadOutput]


class StageFeatures(NamedTuple):
    """Feature maps (B, N, C) that later stages look at."""

    graph: Tensor
    output: Tensor


class Prior(nn.Module):
    """Logits (B, N) from the attributes (B, N, 8) of each match alone: the ratio test, learned.

    It is added to the logits of every head, and it alone scores matches that never enter the network.
    """

    def __init__(self) -> None:
        super().__init__()
        self.hidden = nn.Linear(ATTRIBUTE_CHANNELS, PRIOR_HIDDEN)
        self.output = nn.Linear(PRIOR_HIDDEN, 1)

    def forward(self, attributes: Tensor) -> Tensor:
        return self.output(F.gelu(self.hidden(attributes)))[..., 0]


class Head(nn.Module):
    """Features → logits, and weights of the better half of the matches → essential matrix."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.logit = nn.Linear(channels, 1)
        self.weight = nn.Linear(channels, 2)

    def forward(self, features: Tensor, prior: Tensor, correspondences: Tensor) -> HeadOutput:
        logits = self.logit(features)[..., 0].float()
        enough = match_count(logits) >= MINIMUM_CONSENSUS  # (B, 1)
        logits = torch.where(enough, logits, 0.0) + prior
        a, b = self.weight(features).float().split(1, -1)
        # sigmoid(a) exp(b), normalised to sum 1, is the softmax of log sigmoid(a) + b.
        log_weights = (F.logsigmoid(a) + b)[..., 0] + torch.where(better_half(logits), 0.0, -1e4)
        with torch.autocast(logits.device.type, enabled=False):
            essential = weighted_eight_point(correspondences, log_weights.softmax(-1))
        return HeadOutput(logits, essential)


def match_count(logits: Tensor) -> Tensor:
    """Number of matches as a float tensor (B, 1), so that an exported graph computes it, too."""
    return torch.ones_like(logits).sum(-1, keepdim=True)


def better_half(logits: Tensor) -> Tensor:
    """Bool (B, N): the ceil(N/2) highest logits, never fewer than min(N, 16); ties at the border all count."""
    count = match_count(logits)
    kept = torch.maximum((0.5 * count).ceil(), count.clamp_max(MINIMUM_POINTS))
    threshold = logits.detach().sort(-1, descending=True).values.gather(1, kept.long() - 1)
    return logits >= threshold


class Stage(nn.Module):
    """One iteration of the network.

    1. 1x1 conv of the input channels
    2. from the second stage on: cross-stage consensus, concatenated to 2C, PointCN back to C
    3. PointCN → CGA → PointCN x2 → graph block
    4. order-aware block, concatenated to 2C, PointCN back to C
    5. PointCN → CGA → PointCN
    """

    def __init__(self, config: NetworkConfig, number: int) -> None:
        super().__init__()
        c = config.channels
        inputs = 4 + (2 if number else 0) + (ATTRIBUTE_CHANNELS if config.attributes else 0)
        self.input = nn.Linear(inputs, c)
        self.consensus: CrossStageConsensus | None = None
        if number and config.csmgc:
            self.consensus = CrossStageConsensus(c, number - 1, config.squeeze_excitation)
            self.consensus_fuse = PointCN(2 * c, c)
        self.point_cn1 = PointCN(c)
        self.attention1 = self._attention(config)
        self.point_cn2 = nn.Sequential(PointCN(c), PointCN(c))
        self.graph = GraphBlock(c, config.neighbours, config.graph_expansion, config.windows)
        self.order_aware = OrderAwareBlock(c, config.clusters)
        self.order_fuse = PointCN(2 * c, c)
        self.point_cn3 = PointCN(c)
        self.attention2 = self._attention(config)
        self.point_cn4 = PointCN(c)

    @staticmethod
    def _attention(config: NetworkConfig) -> ContextGraphAttention | None:
        if not config.cga:
            return None
        return ContextGraphAttention(config.channels, config.attention, config.positional, config.pooled_branches)

    def forward(self, inputs: Tensor, correspondences: Tensor, earlier: list[StageFeatures]) -> StageFeatures:
        x = self.input(inputs)  # (B, N, C)
        if self.consensus is not None:
            agreed = self.consensus(x, earlier[-1].graph, [stage.output for stage in earlier])
            x = self.consensus_fuse(torch.cat([x, agreed], -1))
        x = self.point_cn1(x)
        if self.attention1 is not None:
            x = self.attention1(x, correspondences)
        graph = self.graph(self.point_cn2(x))
        x = self.order_fuse(torch.cat([graph, self.order_aware(graph)], -1))
        x = self.point_cn3(x)
        if self.attention2 is not None:
            x = self.attention2(x, correspondences)
        return StageFeatures(graph, self.point_cn4(x))


class MGCANet(nn.Module):
    """The network: matches in, a logit for each and an essential matrix out.

    1. stage 1 sees the points (and attributes)
    2. stages 2 and 3 see, besides, the epipolar residual of the previous essential matrix and
       relu(tanh(previous logits)), both detached
    3. final consensus over the outputs of all stages gives the answer
    4. outside training, the essential matrix of the answer is refined on its manifold

    Feature maps are (B, N, C) inside: products with matches as rows, gathers of whole rows, no transposes.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        c = config.channels
        self.prior = Prior() if config.attributes else None
        self.stages = nn.ModuleList([Stage(config, number) for number in range(config.stages)])
        self.heads = nn.ModuleList([Head(c) for _ in range(config.stages)])
        self.final: FinalConsensus | None = None
        if config.final_consensus and config.stages > 1:
            self.final = FinalConsensus(c, config.stages, config.squeeze_excitation)
            self.final_head = Head(c)

    def forward(self, correspondences: Tensor, attributes: Tensor) -> NetworkOutput:
        """Score matches.

        Args:
            correspondences: (B, N, 4) float32, each image's points normalised by its own intrinsics.
            attributes: (B, N, 8) float32, raw values with flags, zeros where unknown (see
                :meth:`mgca_filter.MatchAttributes.encode`); ignored by a network without side information.
        """
        prior = self.prior(attributes).float() if self.prior is not None else torch.zeros_like(correspondences[..., 0])
        inputs = [correspondences, attributes] if self.prior is not None else [correspondences]
        heads: list[HeadOutput] = []
        features: list[StageFeatures] = []
        for stage, head in zip(self.stages, self.heads, strict=True):
            refined = self.config.refined_feedback and len(heads) >= FIRST_REFINED_STAGE
            channels = inputs + (self._feedback(correspondences, heads[-1], refined) if heads else [])
            features.append(stage(torch.cat(channels, -1), correspondences, features))
            heads.append(head(features[-1].output, prior, correspondences))
        if self.final is not None:
            agreed = self.final([stage.output for stage in features])
            heads.append(self.final_head(agreed, prior, correspondences))
        essential = heads[-1].essential
        if not self.training:
            essential = refine_essential(correspondences, heads[-1].logits, essential)
        return NetworkOutput(heads[-1].logits, essential, heads)

    @staticmethod
    def _feedback(correspondences: Tensor, previous: HeadOutput, refined: bool) -> list[Tensor]:
        logits, essential = previous.logits.detach(), previous.essential.detach()
        with torch.autocast(logits.device.type, enabled=False):
            if refined:
                essential = refine_essential(correspondences, logits, essential)
                residual = residual_channel(correspondences, essential, REFINED_FLOOR)
            else:
                residual = residual_channel(correspondences, essential)  # (B, N)
        enough = (match_count(logits) >= MINIMUM_POINTS).to(residual.dtype)
        return [(residual * enough).unsqueeze(-1), F.relu(torch.tanh(logits)).unsqueeze(-1)]
