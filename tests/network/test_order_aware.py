"""Pooling to clusters, filters between them, and back to the matches."""

from __future__ import annotations

import pytest
import torch
from networks import randomise_norms
from torch import Tensor
from torch.nn import functional as F

from mgca_filter.network.order_aware import OrderAwareBlock, OrderAwareFilter

CHANNELS, CLUSTERS = 6, 5


def features(count: int, batch: int = 2) -> Tensor:
    return torch.randn(batch, count, CHANNELS, generator=torch.Generator().manual_seed(count))


@pytest.fixture
def block() -> OrderAwareBlock:
    torch.manual_seed(0)
    return randomise_norms(OrderAwareBlock(CHANNELS, CLUSTERS)).eval().requires_grad_(False)


def test_filter_mixes_channels_then_clusters_then_channels():
    torch.manual_seed(0)
    layer = randomise_norms(OrderAwareFilter(CHANNELS, CLUSTERS)).eval().requires_grad_(False)
    x = features(CLUSTERS)
    y = layer.channel1(x)
    norm = layer.cluster_norm
    scaled = (y - norm.running_mean[:, None]) / (norm.running_var[:, None] + norm.eps).sqrt()
    activated = F.relu(scaled * norm.weight[:, None] + norm.bias[:, None])  # one norm for each cluster
    mixed = torch.zeros_like(y)
    for to in range(CLUSTERS):
        for source in range(CLUSTERS):
            mixed[:, to] += layer.cluster.weight[to, source] * activated[:, source]
        mixed[:, to] += layer.cluster.bias[to]
    expected = x + layer.channel2(y + mixed)
    torch.testing.assert_close(layer(x), expected, atol=1e-5, rtol=1e-4)


def test_block_pools_filters_and_returns(block):
    x = features(9)
    to_cluster, to_match = block.pool(x), block.unpool(x)  # (B, N, clusters)
    expected = torch.zeros_like(x)
    for pair in range(2):
        clusters = torch.zeros(1, CLUSTERS, CHANNELS)
        for m in range(CLUSTERS):
            share = to_cluster[pair, :, m].softmax(0)
            for n in range(9):
                clusters[0, m] += share[n] * x[pair, n]
        clusters = block.filters(clusters)
        for n in range(9):
            share = to_match[pair, n].softmax(0)
            for m in range(CLUSTERS):
                expected[pair, n] += share[m] * clusters[0, m]
    torch.testing.assert_close(block(x), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 50])
def test_permuted_matches_permute_the_result(block, count):
    x = features(count)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(block(x[:, order]), block(x)[:, order], atol=1e-5, rtol=1e-4)


def test_duplicated_matches_change_nothing(block):
    x = features(20)
    torch.testing.assert_close(block(x.repeat(1, 3, 1)), block(x).repeat(1, 3, 1), atol=1e-5, rtol=1e-4)


def test_number_of_filters_is_an_option():
    count = [sum(p.numel() for p in OrderAwareBlock(CHANNELS, CLUSTERS, n).parameters()) for n in (1, 2, 3)]
    assert count[2] - count[1] == count[1] - count[0] > 0
