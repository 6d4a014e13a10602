"""Norms over the matches of a pair, and the residual block made of them."""

from __future__ import annotations

import pytest
import torch
from networks import randomise_norms
from torch import Tensor, nn
from torch.nn import functional as F

from mgca_filter.network.point_cn import (
    BATCH_NORM_EPS,
    CONTEXT_NORM_EPS,
    ChannelBatchNorm,
    ContextNorm,
    LinearNorm,
    PointCN,
)


def features(*shape: int, seed: int = 0) -> Tensor:
    """Random features whose channels and pairs differ in mean and spread."""
    generator = torch.Generator().manual_seed(seed)
    scale = 0.01 + 3 * torch.rand(shape[0], *[1] * (len(shape) - 2), shape[-1], generator=generator)
    return torch.randn(shape, generator=generator) * scale + 2 * scale


def context_normalised(x: Tensor, dims: tuple[int, ...] = (1,)) -> Tensor:
    """Zero mean and unit variance over the matches, as the paper defines it."""
    mean = x.mean(dims, keepdim=True)
    return (x - mean) / ((x - mean).square().mean(dims, keepdim=True) + CONTEXT_NORM_EPS).sqrt()


@pytest.mark.parametrize("shape", [(3, 50, 4), (2, 10, 6, 4)])
def test_channel_batch_norm_is_torchs_over_all_matches(shape):
    norm = randomise_norms(ChannelBatchNorm(4))
    reference = nn.BatchNorm1d(4)
    reference.load_state_dict(norm.state_dict())
    x = features(*shape)
    for mode in (True, False):  # training first: evaluation then uses the statistics it left
        ours, theirs = norm.train(mode)(x), reference.train(mode)(x.reshape(-1, 4)).reshape(shape)
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(norm.running_var, reference.running_var)
    torch.testing.assert_close(norm.running_mean, reference.running_mean)


@pytest.mark.parametrize(("shape", "dims"), [((3, 50, 4), (1,)), ((2, 10, 6, 4), (1, 2)), ((5, 2, 4), (1,))])
def test_context_norm_is_context_normalisation_then_batch_norm(shape, dims):
    norm = randomise_norms(ContextNorm(4, dims))
    weight, bias, before = norm.weight.detach().clone(), norm.bias.detach().clone(), norm.running_var.clone()
    x = features(*shape)
    normalised = context_normalised(x, dims).reshape(-1, 4)
    variance = normalised.var(0, unbiased=False)

    trained = norm.train()(x)
    expected = F.batch_norm(normalised, None, None, weight, bias, training=True, eps=BATCH_NORM_EPS)
    torch.testing.assert_close(trained, expected.reshape(shape), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(norm.running_var, 0.9 * before + 0.1 * variance, atol=1e-5, rtol=1e-5)

    evaluated = norm.eval()(x)
    expected = F.batch_norm(normalised, torch.zeros(4), norm.running_var, weight, bias, eps=BATCH_NORM_EPS)
    torch.testing.assert_close(evaluated, expected.reshape(shape), atol=1e-4, rtol=1e-4)


def test_context_norm_ignores_shift_and_scale_of_each_pair():
    norm = ContextNorm(4).eval()
    x = features(3, 50, 4)
    scale, shift = torch.tensor([3.0, 5.0, 7.0]).view(3, 1, 1), torch.tensor([-4.0, 0.0, 4.0]).view(3, 1, 1)
    large = 10 * x / x.std(1, keepdim=True)  # far above eps
    torch.testing.assert_close(norm(large * scale + shift), norm(large), atol=1e-3, rtol=1e-3)


def test_context_norm_of_equal_matches_is_its_bias():
    norm = randomise_norms(ContextNorm(4)).eval()
    x = torch.full((2, 7, 4), 5.0)
    torch.testing.assert_close(norm(x), norm.bias.expand(2, 7, 4), atol=1e-4, rtol=0)


def test_linear_norm_has_no_bias_besides_the_norms():
    layer = randomise_norms(LinearNorm(3, 4)).eval()
    assert [name for name, _ in layer.named_parameters()] == ["linear.weight", "norm.weight", "norm.bias"]
    norm = layer.norm
    expected = (features(2, 9, 3) @ layer.linear.weight.T - norm.running_mean) / (norm.running_var + norm.eps).sqrt()
    torch.testing.assert_close(layer(features(2, 9, 3)), expected * norm.weight + norm.bias, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("outputs", [4, 6])
def test_point_cn_is_two_normalised_layers_and_a_shortcut(outputs):
    torch.manual_seed(0)
    block = randomise_norms(PointCN(4, outputs)).eval()
    x = features(2, 30, 4)

    def half(y: Tensor, norm: ContextNorm, linear: nn.Linear) -> Tensor:
        y = context_normalised(y) / (norm.running_var + BATCH_NORM_EPS).sqrt() * norm.weight + norm.bias
        return F.gelu(y) @ linear.weight.T + linear.bias

    y = half(half(x, block.norm1, block.linear1), block.norm2, block.linear2)
    shortcut = x if outputs == 4 else x @ block.shortcut.weight.T + block.shortcut.bias
    torch.testing.assert_close(block(x), shortcut + y, atol=1e-4, rtol=1e-4)
