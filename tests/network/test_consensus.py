"""Consensus between stages: which maps enter, in which order, and how they are gated."""

from __future__ import annotations

import pytest
import torch
from networks import randomise_norms
from torch import Tensor, nn
from torch.nn import functional as F

from mgca_filter.network.consensus import (
    CrossStageConsensus,
    FinalConsensus,
    GraphConsensus,
    SqueezeExcitation,
    SqueezeExcitationResidual,
)
from mgca_filter.network.graph import nearest_neighbours

CHANNELS = 8


def build(module: nn.Module) -> nn.Module:
    return randomise_norms(module).eval().requires_grad_(False)


def maps(number: int, count: int = 20) -> list[Tensor]:
    generator = torch.Generator().manual_seed(count)
    return [torch.randn(2, count, CHANNELS, generator=generator) for _ in range(number)]


def test_squeeze_excitation_scales_channels_of_each_pair():
    block = SqueezeExcitation(CHANNELS).requires_grad_(False)
    (x,) = maps(1)
    gate = block(x) / x
    torch.testing.assert_close(gate, gate[:, :1].expand_as(gate), atol=1e-4, rtol=1e-3)
    assert ((gate > 0) & (gate < 1)).all()
    assert (gate[0, 0] - gate[1, 0]).abs().max() > 1e-4


def test_residual_block_with_and_without_gate():
    (x,) = maps(1)
    block = build(SqueezeExcitationResidual(CHANNELS))
    body = block.linear2(F.relu(block.linear1(x)))
    torch.testing.assert_close(block(x), F.relu(x + body * block.gate.gate(body.mean(1, keepdim=True))))
    bare = build(SqueezeExcitationResidual(CHANNELS, squeeze_excitation=False))
    torch.testing.assert_close(bare(x), F.relu(x + bare.linear2(F.relu(bare.linear1(x)))))


def test_graphs_are_built_of_the_reduced_maps():
    block = build(GraphConsensus(CHANNELS, graphs=3, k=3))
    given = maps(3)
    reduced = [layer(x) for layer, x in zip(block.reduce, given)]
    assert {x.shape[-1] for x in reduced} == {CHANNELS // 2}
    expected = block.output(block.annular(reduced, [nearest_neighbours(x, 3) for x in reduced]))
    torch.testing.assert_close(block(given), expected)


def test_every_map_has_its_say():
    block = build(CrossStageConsensus(CHANNELS, earlier=1))
    current, graph, first, second = maps(4)
    reference = block(current, graph, [first, second])
    for changed in (
        block(-current, graph, [first, second]),
        block(current, -graph, [first, second]),
        block(current, graph, [-first, second]),
        block(current, graph, [first, -second]),
    ):
        assert (changed - reference).abs().max() > 1e-3


def test_second_stage_has_nine_columns_and_the_third_twelve():
    assert len(CrossStageConsensus(CHANNELS, earlier=0).consensus.annular.rings) == 3
    assert len(CrossStageConsensus(CHANNELS, earlier=1).consensus.annular.rings) == 4


def test_earlier_stages_are_gated_by_squeeze_excitation():
    with_gate = build(CrossStageConsensus(CHANNELS, earlier=1))
    without = build(CrossStageConsensus(CHANNELS, earlier=1, squeeze_excitation=False))
    current, graph, first, second = maps(4)
    gated = with_gate.gate[0](first)
    expected = with_gate.consensus([current, graph, second, gated])
    torch.testing.assert_close(with_gate(current, graph, [first, second]), expected)
    expected = without.consensus([current, graph, second, first])
    torch.testing.assert_close(without(current, graph, [first, second]), expected)


def test_all_earlier_stages_share_one_map():
    block = build(CrossStageConsensus(CHANNELS, earlier=2))
    current, graph, first, second, third = maps(5)
    together = block.gate(torch.cat([first, second], -1))
    expected = block.consensus([current, graph, third, together])
    torch.testing.assert_close(block(current, graph, [first, second, third]), expected)


@pytest.mark.parametrize(("stages", "k"), [(2, 3), (3, 2)])
def test_final_consensus_has_six_columns_and_a_residual(stages, k):
    block = build(FinalConsensus(CHANNELS, stages))
    outputs = maps(stages)
    assert block.consensus.k == k
    assert len(block.consensus.annular.rings) == 2
    torch.testing.assert_close(block(outputs), block.residual(outputs[-1] + block.consensus(outputs)))


def test_permuted_matches_permute_the_consensus():
    block = build(FinalConsensus(CHANNELS, 3))
    outputs = maps(3)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    permuted = block([x[:, order] for x in outputs])
    torch.testing.assert_close(permuted, block(outputs)[:, order], atol=1e-5, rtol=1e-4)
