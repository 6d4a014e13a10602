"""Losses against figures worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from networks import TINY, two_view_batch

from mgca_filter.network import HeadOutput, MGCANet, NetworkOutput
from mgca_filter.network.essential_refinement import refine_essential
from mgca_filter.training.loss import (
    GEOMETRIC_CLAMP,
    REFINED_DISTANCE,
    balanced_cross_entropy,
    geometric_loss,
    network_loss,
    precision_recall,
    refined_loss,
)

ROWS = torch.tensor([[[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]])  # epipolar lines are the rows of the images


def softplus(x: float) -> float:
    return math.log1p(math.exp(x))


def test_right_and_wrong_matches_weigh_one_half_each():
    logits = torch.tensor([[2.0, -1.0, 0.5, 3.0, 9.0]])
    labels = torch.tensor([[1, 0, 0, 0, -1]])
    expected = 0.5 * softplus(-2.0) + 0.5 * (softplus(-1.0) + softplus(0.5) + softplus(3.0)) / 3
    assert math.isclose(float(balanced_cross_entropy(logits, labels)), expected, rel_tol=1e-6)


def test_pairs_are_averaged_and_may_lack_a_class():
    logits = torch.tensor([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]])
    labels = torch.tensor([[1, 1], [0, 0], [-1, -1]])
    expected = (0.5 * (softplus(-1) + softplus(-2)) / 2 + 0.5 * (softplus(1) + softplus(2)) / 2 + 0.0) / 3
    assert math.isclose(float(balanced_cross_entropy(logits, labels)), expected, rel_tol=1e-6)


def test_left_out_matches_have_no_gradient():
    logits = torch.zeros(1, 4, requires_grad=True)
    balanced_cross_entropy(logits, torch.tensor([[1, 0, -1, -1]])).backward()
    torch.testing.assert_close(logits.grad, torch.tensor([[-0.25, 0.25, 0.0, 0.0]]))


def test_geometric_loss_is_the_clamped_mean_distance():
    off = 0.1
    virtual = torch.tensor([[[0.0, 0.0, 0.3, 0.0], [0.0, 0.0, 0.3, off], [0.0, 0.0, 0.0, 50.0]]])
    expected = (0.0 + 2 * off**2 + GEOMETRIC_CLAMP) / 3
    assert math.isclose(float(geometric_loss(ROWS, virtual, torch.ones(1))), expected, rel_tol=1e-5)


def test_geometric_loss_counts_valid_pairs_only():
    virtual = torch.zeros(2, 1, 4)
    virtual[:, 0, 3] = torch.tensor([0.1, 0.2])
    E = ROWS.repeat(2, 1, 1)
    assert math.isclose(float(geometric_loss(E, virtual, torch.tensor([1.0, 0.0]))), 0.02, rel_tol=1e-5)
    assert math.isclose(float(geometric_loss(E, virtual, torch.tensor([1.0, 1.0]))), 0.05, rel_tol=1e-5)
    assert float(geometric_loss(E, virtual, torch.zeros(2))) == 0.0


def test_geometric_loss_ignores_the_sign_of_e():
    virtual = torch.rand(1, 10, 4)
    E = torch.rand(1, 3, 3)
    torch.testing.assert_close(geometric_loss(E, virtual, torch.ones(1)), geometric_loss(-E, virtual, torch.ones(1)))


def test_refined_loss_is_the_logarithm_of_the_mean_distance_of_valid_pairs():
    off = 0.01
    far = [0.0, 0.0, 0.0, 50.0]
    virtual = torch.tensor([[[0.0, 0.0, 0.3, 0.0], [0.0, 0.0, 0.3, off]], [far, far]])
    E = ROWS.repeat(2, 1, 1)
    near, lost = math.log1p(off**2 / REFINED_DISTANCE), math.log1p(GEOMETRIC_CLAMP / REFINED_DISTANCE)
    assert math.isclose(float(refined_loss(E, virtual, torch.tensor([1.0, 0.0]))), near, rel_tol=1e-5)
    assert math.isclose(float(refined_loss(E, virtual, torch.ones(2))), 0.5 * (near + lost), rel_tol=1e-5)
    assert float(refined_loss(E, virtual, torch.zeros(2))) == 0.0


@pytest.mark.parametrize(("weight", "refined_weight"), [(0.0, 0.0), (0.5, 0.0), (2.0, 0.3)])
def test_all_heads_and_the_refined_answer_are_summed(weight, refined_weight):
    labels = torch.tensor([[1, 0, 0]])
    virtual = torch.tensor([[[0.0, 0.0, 0.3, 0.1]]])
    heads = [HeadOutput(torch.tensor([[float(i), 0.0, -1.0]]), ROWS + 0.1 * i) for i in range(3)]
    correspondences = torch.rand(1, 3, 4)
    batch = {"correspondences": correspondences, "labels": labels, "virtual": virtual, "virtual_valid": torch.ones(1)}
    total, parts = network_loss(NetworkOutput(*heads[-1], heads), batch, weight, refined_weight)
    classification = [balanced_cross_entropy(head.logits, labels) for head in heads]
    geometry = [geometric_loss(head.essential, virtual, torch.ones(1)) for head in heads]
    answer = refine_essential(correspondences, *heads[-1])
    refined = refined_loss(answer, virtual, torch.ones(1))
    torch.testing.assert_close(total, sum(classification) + weight * sum(geometry) + refined_weight * refined)
    torch.testing.assert_close(parts["classification"], classification[-1])
    torch.testing.assert_close(parts["geometric"], geometry[-1])
    torch.testing.assert_close(parts["refined"], refined if refined_weight else torch.tensor(0.0))


def test_loss_falls_on_one_pair():
    torch.manual_seed(0)
    network = MGCANet(TINY).train()
    correspondences, attributes = two_view_batch(60, batch=2)
    labels = (attributes[..., 3] > 0.9).long()
    batch = {"labels": labels, "virtual": torch.zeros(2, 1, 4), "virtual_valid": torch.zeros(2)}
    optimizer = torch.optim.Adam(network.parameters(), 1e-2)
    losses = []
    for _ in range(15):
        loss, _ = network_loss(network(correspondences, attributes), batch, 0.5)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[0]


def test_precision_and_recall_count_labelled_matches():
    logits = torch.tensor([[1.0, 1.0, -1.0, 1.0, -1.0], [-1.0, -1.0, -1.0, -1.0, -1.0]])
    labels = torch.tensor([[1, 0, 1, -1, 0], [1, 0, 0, 0, 0]])
    precision, recall = precision_recall(logits, labels)
    assert (float(precision), float(recall)) == (0.25, 0.25)
