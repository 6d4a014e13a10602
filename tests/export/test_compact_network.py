"""The network that is exported says what the trained one says, in whatever form."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from networks import TINY, randomise_norms, settled_network, tiny_network, two_view_batch
from torch import nn

from mgca_filter.export import compact_network
from mgca_filter.export.compact_network import compact, nearest_rows, nearest_rows_in_order
from mgca_filter.network.attention import ContextGraphAttention
from mgca_filter.network.consensus import GraphConsensus
from mgca_filter.network.graph import GraphBlock, nearest_neighbours
from mgca_filter.network.order_aware import OrderAwareBlock
from mgca_filter.network.point_cn import PointCN


def features(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def compacted(module: nn.Module) -> tuple[nn.Module, nn.Module]:
    """A module with random weights and norms, and what stands for it."""
    module = randomise_norms(module).eval().requires_grad_(False)
    return module, compact(nn.Sequential(module))[0]


@pytest.mark.parametrize("width", [8, 12])
def test_point_cn(width: int) -> None:
    torch.manual_seed(0)
    module, copy = compacted(PointCN(8, width))
    x = features(2, 30, 8)
    torch.testing.assert_close(copy(x), module(x), atol=1e-5, rtol=1e-5)


def test_order_aware_block() -> None:
    torch.manual_seed(0)
    module, copy = compacted(OrderAwareBlock(8, 5))
    x = features(2, 30, 8)
    torch.testing.assert_close(copy(x), module(x), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("pooled", [False, True])
@pytest.mark.parametrize("positional", [False, True])
@pytest.mark.parametrize("form", ["channel", "point"])
def test_context_graph_attention(form, positional, pooled) -> None:
    torch.manual_seed(0)
    module, copy = compacted(ContextGraphAttention(8, form, positional, pooled))
    x, correspondences = features(2, 30, 8), features(2, 30, 4, seed=1)
    torch.testing.assert_close(copy(x, correspondences), module(x, correspondences), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("expansion", [1, 2])
@pytest.mark.parametrize("k", [3, 6])
@pytest.mark.parametrize("count", [1, 5, 30])
def test_graph_block(expansion: int, k: int, count: int) -> None:
    torch.manual_seed(0)
    module, copy = compacted(GraphBlock(8, k, expansion))
    x = features(2, count, 8)
    torch.testing.assert_close(copy(x), module(x), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("graphs", "k"), [(3, 3), (4, 3), (3, 2), (2, 3)])
@pytest.mark.parametrize("count", [1, 2, 30])
def test_graph_consensus(graphs: int, k: int, count: int) -> None:
    torch.manual_seed(0)
    module, copy = compacted(GraphConsensus(8, graphs, k))
    maps = [features(2, count, 8, seed=graph) for graph in range(graphs)]
    torch.testing.assert_close(copy(maps), module(maps), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 300])
def test_rows_of_neighbours_are_those_of_the_network(count: int) -> None:
    spaces = features(2, 3, count, 5)
    rows = nearest_rows(spaces, 4)
    for number, x in enumerate(spaces.flatten(0, 1)):
        expected = nearest_neighbours(x[None], 4)[0] + number * count
        torch.testing.assert_close(rows.flatten(0, 1)[number], expected)


@pytest.mark.parametrize("count", [1, 5, 40, 300])
@pytest.mark.parametrize("window", [16, 2048])
def test_an_order_in_which_neighbours_lie_together_does_not_change_them(monkeypatch, count: int, window: int) -> None:
    monkeypatch.setattr(compact_network, "MANY", window)
    spaces = features(2, 3, count, 5)
    torch.testing.assert_close(nearest_rows_in_order(spaces, 4), nearest_rows(spaces, 4))


@pytest.mark.parametrize(
    "changes",
    [
        {"stages": 1},
        {"stages": 3, "refined_feedback": True},
        {"stages": 3, "final_consensus": False},
        {"stages": 2, "csmgc": False, "cga": False, "squeeze_excitation": False},
        {"stages": 1, "graph_expansion": 2, "neighbours": 3},
    ],
)
def test_the_whole_network_in_every_form(changes: dict[str, object]) -> None:
    network = settled_network(dataclasses.replace(TINY, **changes))
    batch = two_view_batch(12, batch=2)  # few, so that rounding has no neighbours to swap
    torch.testing.assert_close(compact(network)(*batch).logits, network(*batch).logits, atol=5e-3, rtol=1e-3)


def test_the_network_itself_stays() -> None:
    network = tiny_network()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    compact(network)
    after = network.state_dict()
    assert all(torch.equal(tensor, after[name]) for name, tensor in before.items())
