"""Refinement of an essential matrix: closer to the truth, valid, the same for any sign and any order."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from networks import sign_free_difference
from torch import Tensor

from mgca_filter.geometry.epipolar import essential_from_pose
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.network.eight_point import weighted_eight_point
from mgca_filter.network.essential_refinement import refine_essential

WRONG = 40


def noisy_pair(seed: int, flat: bool = False, noise: float = 1e-3) -> tuple[Tensor, Tensor, Tensor]:
    """Correspondences (1, 160, 4) with noise (a pixel), logits (1, 160) that are mostly right, the true E."""
    rng = np.random.default_rng(seed)
    R, t = rotation_from_vector(rng.uniform(-0.3, 0.3, 3)), rng.normal(size=3)
    depth = rng.uniform(5.0, 5.2, 160) if flat else rng.uniform(4, 10, 160)
    X = np.column_stack([rng.uniform(-3, 3, (160, 2)), depth])
    X2 = X @ R.T + t / np.linalg.norm(t)
    rows = np.hstack([X[:, :2] / X[:, 2:], X2[:, :2] / X2[:, 2:]]) + rng.normal(0, noise, (160, 4))
    rows[:WRONG, 2:] = rng.uniform(-0.7, 0.7, (WRONG, 2))
    logits = rng.normal(4, 1, 160)
    logits[:WRONG] = rng.normal(-4, 1, WRONG)
    logits[: WRONG // 4] = 4.0  # some wrong matches deceive the network
    truth = torch.from_numpy(essential_from_pose(R, t)[None].astype(np.float32))
    return torch.from_numpy(rows[None].astype(np.float32)), torch.from_numpy(logits[None].astype(np.float32)), truth


def first_guess(rows: Tensor, logits: Tensor) -> Tensor:
    """The eight-point algorithm's, whose own weights leave the wrong matches out."""
    right = torch.arange(rows.shape[1]) >= WRONG
    return weighted_eight_point(rows, right[None].to(rows.dtype) / right.sum())


@pytest.mark.parametrize("flat", [False, True])
def test_far_closer_to_the_truth_on_planes_and_about_as_close_elsewhere(flat: bool) -> None:
    errors = []
    for seed in range(20):
        rows, logits, truth = noisy_pair(seed, flat=flat)
        start = first_guess(rows, logits)
        refined = refine_essential(rows, logits, start)
        errors.append([sign_free_difference(start, truth), sign_free_difference(refined, truth)])
    before, after = np.median(errors, axis=0)
    assert after < (0.3 * before if flat else 1.5 * before)


@pytest.mark.parametrize("seed", range(5))
def test_the_answer_is_an_essential_matrix(seed: int) -> None:
    rows, logits, _ = noisy_pair(seed)
    start = torch.randn(1, 3, 3, generator=torch.Generator().manual_seed(seed))
    values = torch.linalg.svdvals(refine_essential(rows, logits, start))[0]
    np.testing.assert_allclose(values.numpy(), [0.5**0.5, 0.5**0.5, 0.0], atol=1e-5)


def test_sign_and_scale_of_the_start_and_order_of_the_matches_do_not_matter() -> None:
    rows, logits, _ = (part.double() for part in noisy_pair(0))
    start = first_guess(rows, logits)
    refined = refine_essential(rows, logits, start)
    shuffled = torch.randperm(rows.shape[1], generator=torch.Generator().manual_seed(0))
    for other in (
        refine_essential(rows, logits, -3.0 * start),
        refine_essential(rows[:, shuffled], logits[:, shuffled], start),
    ):
        assert sign_free_difference(refined, other) < 1e-4


def test_pairs_of_a_batch_do_not_touch() -> None:
    pairs = [[part.double() for part in noisy_pair(seed)] for seed in range(3)]
    rows, logits = torch.cat([pair[0] for pair in pairs]), torch.cat([pair[1] for pair in pairs])
    start = torch.cat([first_guess(*pair[:2]) for pair in pairs])
    batch = refine_essential(rows, logits, start)
    single = torch.cat([refine_essential(*pair[:2], start[i : i + 1]) for i, pair in enumerate(pairs)])
    assert sign_free_difference(batch, single) < 1e-9


@pytest.mark.parametrize("count", [1, 7, 16])
def test_degenerate_matches_stay_finite(count: int) -> None:
    start = torch.eye(3)[None] / 3**0.5
    for rows in (torch.zeros(1, count, 4), torch.full((1, count, 4), 0.3), torch.full((1, count, 4), 1e6)):
        for logit in (-100.0, 0.0, 100.0):
            refined = refine_essential(rows, torch.full((1, count), logit), start)
            assert torch.isfinite(refined).all()


def test_gradients_are_those_of_the_minimum() -> None:
    rows, logits, truth = noisy_pair(0, noise=1e-4)
    clean = torch.arange(rows.shape[1]) >= WRONG
    rows, logits, truth = rows[:, clean].double(), logits[:, clean].double(), truth.double()
    direction = torch.from_numpy(np.random.default_rng(1).normal(size=(1, 3, 3)))

    def value(logits: Tensor) -> Tensor:
        refined = refine_essential(rows, logits, truth)
        return (refined * direction).sum() * (refined * truth).sum().sign()

    leaf = logits.clone().requires_grad_()
    value(leaf).backward()
    assert leaf.grad is not None
    steps = 1e-4 * torch.eye(logits.shape[1], dtype=torch.float64)
    differences = torch.stack([(value(logits + step) - value(logits - step)) / 2e-4 for step in steps])
    similarity = torch.nn.functional.cosine_similarity(leaf.grad[0], differences, dim=0)
    assert similarity > 0.99
    assert 0.9 < float(leaf.grad.norm() / differences.norm()) < 1.1


@pytest.mark.parametrize("count", [1, 7, 16])
def test_degenerate_matches_have_finite_gradients(count: int) -> None:
    for rows in (torch.zeros(1, count, 4), torch.full((1, count, 4), 0.3), torch.full((1, count, 4), 1e6)):
        logits = torch.zeros(1, count, requires_grad=True)
        refine_essential(rows, logits, torch.eye(3)[None]).square().sum().backward()
        assert logits.grad is not None
        assert torch.isfinite(logits.grad).all()
