"""Order-aware block (OANet, ICCV 2019): matches → learned clusters → matches."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

from .point_cn import ChannelBatchNorm, NormLinear


class OrderAwareFilter(nn.Module):
    """Channel conv → conv over the clusters, residual → channel conv, residual."""

    def __init__(self, channels: int, clusters: int) -> None:
        super().__init__()
        self.channel1 = NormLinear(channels, channels)
        self.cluster_norm = ChannelBatchNorm(clusters)
        self.cluster = nn.Linear(clusters, clusters)
        self.channel2 = NormLinear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        y = self.channel1(x)  # (B, clusters, C)
        spatial = self.cluster(F.relu(self.cluster_norm(y.transpose(1, 2))))  # (B, C, clusters)
        y = y + spatial.transpose(1, 2)
        return x + self.channel2(y)


class OrderAwareBlock(nn.Module):
    """DiffPool to a fixed number of clusters, order-aware filters between them, DiffUnpool back.

    1. pooled = softmax over matches(embed(x))ᵀ x            (B, clusters, C)
    2. three order-aware filters
    3. out = softmax over clusters(embed(x)) pooled          (B, N, C)
    """

    def __init__(self, channels: int, clusters: int, filters: int = 3) -> None:
        super().__init__()
        self.pool = NormLinear(channels, clusters)
        self.filters = nn.Sequential(*[OrderAwareFilter(channels, clusters) for _ in range(filters)])
        self.unpool = NormLinear(channels, clusters)

    def forward(self, x: Tensor) -> Tensor:
        assignment = self.pool(x).transpose(1, 2).float().softmax(-1)  # (B, clusters, N)
        clusters = self.filters(assignment.to(x.dtype) @ x)
        return self.unpool(x).float().softmax(-1).to(x.dtype) @ clusters
