"""Neighbour graphs: the products per match against references that really build the edges."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from networks import randomise_norms
from torch import Tensor
from torch.nn import functional as F

from mgca_filter.network import graph
from mgca_filter.network.graph import (
    AnnularConvolution,
    AttentionalFusion,
    EdgeMaximum,
    GraphBlock,
    gather_rows,
    nearest_neighbours,
)
from mgca_filter.network.point_cn import BATCH_NORM_EPS, CONTEXT_NORM_EPS


def features(count: int, channels: int = 6, batch: int = 2, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, count, channels, generator=generator)


def brute_force_neighbours(x: Tensor, k: int) -> np.ndarray:
    """Indices (B, N, k) by sorting all distances; the match itself where matches run out."""
    rows = x.double().numpy()
    indices = np.empty((*rows.shape[:2], k), dtype=np.int64)
    for b, pair in enumerate(rows):
        for i, row in enumerate(pair):
            order = np.argsort(((pair - row) ** 2).sum(1), kind="stable")[:k]
            indices[b, i] = np.concatenate([order, np.full(k - len(order), i)])
    return indices


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7, 60])
@pytest.mark.parametrize("k", [2, 3, 6])
def test_neighbours_are_those_of_a_sort(count, k):
    x = features(count, seed=count)
    indices = nearest_neighbours(x, k)
    np.testing.assert_array_equal(indices.numpy(), brute_force_neighbours(x, k))
    np.testing.assert_array_equal(indices[..., 0].numpy(), np.tile(np.arange(count), (2, 1)))


@pytest.mark.parametrize("count", [40, 41, 100])
def test_neighbours_in_windows_are_the_nearest_in_reach(monkeypatch, count):
    monkeypatch.setattr(graph, "MANY", 40)
    monkeypatch.setattr(graph, "WINDOW", 24)
    monkeypatch.setattr(graph, "BLOCK", 8)
    x = features(count, seed=count)
    exact, windowed = nearest_neighbours(x, 3), nearest_neighbours(x, 3, windows=True)
    assert torch.equal(exact, windowed) == (count <= 40)
    assert torch.equal(windowed[..., 0], torch.arange(count).expand(2, -1))  # itself
    if count > 40:
        order = graph.along_variation(x - x.mean(1, keepdim=True)).argsort(-1, descending=True)
        for pair, found, places in zip(x, windowed, order):
            for rank, row in enumerate(places.tolist()):
                start = min(max(rank // 8 * 8 - 8, 0), count - 24)
                reach = places[start : start + 24]
                distance = (pair[reach] - pair[row]).square().sum(-1)
                torch.testing.assert_close(found[row], reach[distance.argsort()[:3]])


def test_neighbours_lie_where_features_vary_together():
    x = features(4000, 8) * torch.tensor([6.0, 1, 1, 1, 1, 1, 1, 1])
    exact, windowed = nearest_neighbours(x, 3), nearest_neighbours(x, 3, windows=True)
    assert (exact.unsqueeze(-1) == windowed.unsqueeze(-2)).any(-1).float().mean() > 0.95


def test_neighbours_survive_a_large_common_offset():
    x = features(40)
    # Rounding of the offset moves the points; what is asked is the neighbours of the moved points.
    moved = x + 1000.0
    np.testing.assert_array_equal(nearest_neighbours(moved, 4).numpy(), brute_force_neighbours(moved, 4))


def test_neighbours_of_equal_matches_are_at_distance_zero():
    x = features(5).repeat(1, 3, 1)
    picked = gather_rows(x, nearest_neighbours(x, 3))
    torch.testing.assert_close(picked, x.unsqueeze(2).expand_as(picked))


def test_gather_rows_stays_within_its_pair():
    rows = features(7, batch=3)
    indices = torch.randint(7, (3, 7, 4), generator=torch.Generator().manual_seed(0))
    picked = gather_rows(rows, indices)
    for b in range(3):
        torch.testing.assert_close(picked[b], rows[b][indices[b]])


def edges(x: Tensor, indices: Tensor) -> Tensor:
    """[x_i, x_i − x_j] as (B, 2C, N, k), the layout of the published networks."""
    neighbours = torch.stack([pair[rows] for pair, rows in zip(x, indices)])  # (B, N, k, C)
    centres = x.unsqueeze(2).expand_as(neighbours)
    return torch.cat([centres, centres - neighbours], -1).permute(0, 3, 1, 2)


@pytest.mark.parametrize(
    ("graphs", "k", "count"), [(1, 6, 20), (1, 3, 20), (3, 3, 20), (4, 3, 9), (3, 2, 20), (1, 6, 4)]
)
def test_annular_convolution_is_a_convolution_of_edges(graphs, k, count):
    torch.manual_seed(graphs)
    channels, outputs = 6, 8
    layer = randomise_norms(AnnularConvolution(channels, outputs, graphs, k)).eval().requires_grad_(False)
    maps = [features(count, channels, seed=graph) for graph in range(graphs)]
    indices = [nearest_neighbours(x, k) for x in maps]

    columns = torch.cat([edges(x, rows) for x, rows in zip(maps, indices)], 3)  # (B, 2C, N, graphs * k)
    # x_i meets the kernel's first half and, within x_i − x_j, its second: centre = first + second.
    difference = layer.neighbour.permute(2, 1, 0)  # (outputs, C, 3)
    first = layer.centre.permute(2, 1, 0) - difference
    ringed = F.conv2d(columns, torch.cat([first, difference], 1).unsqueeze(2), stride=(1, 3))
    norm = layer.ring_norm
    ringed = F.relu(
        F.batch_norm(ringed, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=BATCH_NORM_EPS)
    )
    rings = graphs * k // 3
    assert ringed.shape == (2, outputs, count, rings)
    join = layer.join.linear.weight.view(outputs, rings, outputs).permute(0, 2, 1).unsqueeze(2)  # a 1 x rings kernel
    joined, norm = F.conv2d(ringed, join), layer.join.norm
    joined = F.relu(
        F.batch_norm(joined, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=BATCH_NORM_EPS)
    )
    torch.testing.assert_close(layer(maps, indices), joined[..., 0].transpose(1, 2), atol=1e-4, rtol=1e-4)


def test_annular_convolution_depends_on_the_order_of_neighbours():
    layer = randomise_norms(AnnularConvolution(6, 8, 1, 6)).eval().requires_grad_(False)
    x = features(20)
    indices = nearest_neighbours(x, 6)
    assert (layer([x], [indices]) - layer([x], [indices.flip(-1)])).abs().max() > 1e-3


def test_annular_convolution_wants_full_rings():
    with pytest.raises(ValueError, match="rings of 3"):
        AnnularConvolution(6, 8, graphs=2, k=2)


def test_edge_maximum_is_a_convolution_of_edges_and_a_maximum():
    torch.manual_seed(0)
    block = randomise_norms(EdgeMaximum(6, 10)).eval().requires_grad_(False)
    x = features(15)
    indices = nearest_neighbours(x, 6)
    columns = edges(x, indices)  # (B, 2C, N, k)
    mean = columns.mean((2, 3), keepdim=True)
    normalised = (columns - mean) / ((columns - mean).square().mean((2, 3), keepdim=True) + CONTEXT_NORM_EPS).sqrt()
    norms = (block.centre_norm, block.difference_norm)
    variance, weight, bias = (
        torch.cat([getattr(norm, name) for norm in norms]) for name in ("running_var", "weight", "bias")
    )
    activated = F.relu(F.batch_norm(normalised, torch.zeros(12), variance, weight, bias, eps=BATCH_NORM_EPS))
    kernel = torch.cat([block.centre.weight, block.difference.weight], 1)[..., None, None]
    expected = F.conv2d(activated, kernel, block.centre.bias).amax(3).transpose(1, 2)  # (B, N, 10)
    torch.testing.assert_close(block(x, indices), expected, atol=1e-4, rtol=1e-4)


def test_fusion_of_equal_maps_doubles_them():
    block = randomise_norms(AttentionalFusion(8)).eval().requires_grad_(False)
    a = features(12, 8)
    torch.testing.assert_close(block(a, a), 2 * a, atol=1e-5, rtol=1e-5)


def test_fusion_stays_between_twice_one_map_and_twice_the_other():
    block = randomise_norms(AttentionalFusion(8)).eval().requires_grad_(False)
    a, b = features(12, 8, seed=1), features(12, 8, seed=2)
    fused = block(a, b)
    assert (fused <= 2 * torch.maximum(a, b) + 1e-5).all()
    assert (fused >= 2 * torch.minimum(a, b) - 1e-5).all()
    assert (fused - (a + b)).abs().max() > 1e-3  # the gate is not one half everywhere


def test_neighbours_do_not_depend_on_the_training_precision():
    x = features(200, 8)
    with torch.autocast("cpu", torch.bfloat16):
        indices = nearest_neighbours(x, 6)
    torch.testing.assert_close(indices, nearest_neighbours(x, 6))


@pytest.mark.parametrize("expansion", [1, 2])
@pytest.mark.parametrize("count", [1, 5, 40])
def test_graph_block_commutes_with_permutation(count, expansion):
    torch.manual_seed(0)
    block = randomise_norms(GraphBlock(8, 6, expansion)).eval().requires_grad_(False)
    x = features(count, 8)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(block(x[:, order]), block(x)[:, order], atol=1e-5, rtol=1e-4)
