"""Context graph attention: both forms against loops over matches and channels."""

from __future__ import annotations

import math

import pytest
import torch
from networks import randomise_norms
from torch import Tensor, nn
from torch.nn import functional as F

from mgca_filter.network.attention import ContextGraphAttention, ContextPositionAttention, MultiBranchFeedForward

CHANNELS = 8


def build(kind: type[nn.Module], *arguments: object) -> nn.Module:
    torch.manual_seed(1)
    return randomise_norms(kind(CHANNELS, *arguments)).eval().requires_grad_(False)


def inputs(count: int, batch: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count)
    return (
        torch.randn(batch, count, CHANNELS, generator=generator),
        torch.rand(batch, count, 4, generator=generator) - 0.5,
    )


def projections(attention: ContextPositionAttention, x: Tensor, correspondences: Tensor) -> tuple[Tensor, ...]:
    """Q, K, V and P (N, C) of one pair; P as the sum of one map for each image."""
    q, k, v = (F.relu(layer(x[None]))[0] for layer in (attention.query, attention.key, attention.value))
    if attention.position is None:
        return q, k, v, torch.zeros_like(k)
    weight, bias = attention.position.weight, attention.position.bias
    p = correspondences[:, :2] @ weight[:, :2].T + correspondences[:, 2:] @ weight[:, 2:].T + bias
    return q, k, v, p


@pytest.mark.parametrize("positional", [True, False])
def test_channel_form_attends_between_channels(positional):
    attention = build(ContextPositionAttention, "channel", positional)
    attention.log_temperature.fill_(0.7)
    x, correspondences = inputs(11)
    for pair in range(2):
        q, k, v, p = projections(attention, x[pair], correspondences[pair])
        expected = torch.zeros(11, CHANNELS)
        for c in range(CHANNELS):
            products = [math.exp(0.7) * float((q[:, c] * (k + p)[:, d]).mean()) for d in range(CHANNELS)]
            share = torch.tensor(products).softmax(0)
            for d in range(CHANNELS):
                expected[:, c] += share[d] * v[:, d]
        torch.testing.assert_close(attention(x, correspondences)[pair], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("positional", [True, False])
def test_point_form_attends_between_matches(positional):
    attention = build(ContextPositionAttention, "point", positional)
    x, correspondences = inputs(11)
    for pair in range(2):
        q, k, v, p = projections(attention, x[pair], correspondences[pair])
        expected = torch.zeros(11, CHANNELS)
        for i in range(11):
            content = torch.stack([q[i] @ k[j] / math.sqrt(CHANNELS) for j in range(11)]).softmax(0)
            position = torch.stack([q[i] @ p[j] for j in range(11)]).softmax(0)
            for j in range(11):
                expected[i] += (content[j] + (position[j] if positional else 0.0)) * v[j]
        torch.testing.assert_close(attention(x, correspondences)[pair], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("copies", [2, 5])
def test_channel_form_does_not_depend_on_the_number_of_matches(copies):
    attention = build(ContextPositionAttention, "channel")
    x, correspondences = inputs(13)
    once = attention(x, correspondences)
    often = attention(x.repeat(1, copies, 1), correspondences.repeat(1, copies, 1))
    torch.testing.assert_close(often, once.repeat(1, copies, 1), atol=1e-5, rtol=1e-5)


def test_channel_temperature_starts_at_the_root_of_the_width():
    attention = ContextPositionAttention(16)
    assert math.isclose(float(attention.log_temperature.detach().exp()), 4.0, rel_tol=1e-6)


@pytest.mark.parametrize("form", ["channel", "point"])
def test_permuted_matches_permute_the_attention(form):
    block = build(ContextGraphAttention, form)
    x, correspondences = inputs(40)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        block(x[:, order], correspondences[:, order]), block(x, correspondences)[:, order], atol=1e-5, rtol=1e-4
    )


def test_position_matters_only_with_the_positional_term():
    x, correspondences = inputs(20)
    other = correspondences.flip(1)
    for form in ("channel", "point"):
        with_position = build(ContextPositionAttention, form, True)
        without = build(ContextPositionAttention, form, False)
        assert (with_position(x, correspondences) - with_position(x, other)).abs().max() > 1e-4
        torch.testing.assert_close(without(x, correspondences), without(x, other), atol=0, rtol=0)


@pytest.mark.parametrize("pooled", [True, False])
def test_feed_forward_gates_by_three_branches(pooled):
    block = build(MultiBranchFeedForward, pooled)
    x, _ = inputs(9)
    u = block.input(x)
    expected = torch.zeros_like(x)
    for pair in range(2):
        for n in range(9):
            gate = block.local(u[pair : pair + 1, n : n + 1])[0, 0]
            if pooled:
                mean = torch.stack([u[pair, m] for m in range(9)]).mean(0)
                peak = torch.stack([u[pair, m] for m in range(9)]).amax(0)
                gate = gate + block.average(mean[None])[0] + block.maximum(peak[None])[0]
            expected[pair, n] = block.output(torch.sigmoid(gate)) + u[pair, n] + x[pair, n]
    torch.testing.assert_close(block(x), expected, atol=1e-5, rtol=1e-4)


def test_context_graph_attention_adds_its_first_norm():
    block = build(ContextGraphAttention)
    x, correspondences = inputs(9)
    first = block.norm1(x + block.attention(x, correspondences))
    expected = first + block.norm2(block.feed_forward(first))
    torch.testing.assert_close(block(x, correspondences), expected, atol=1e-6, rtol=1e-6)
