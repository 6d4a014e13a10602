"""Eigenvectors without LAPACK, the weighted eight-point algorithm, epipolar distances in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from networks import sign_free_difference
from torch import Tensor

from mgca_filter.geometry import epipolar
from mgca_filter.geometry.epipolar import essential_from_pose
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.network.eight_point import (
    residual_channel,
    smallest_eigenvector,
    symmetric_epipolar_distance_squared,
    weighted_eight_point,
)


def views(count: int, seed: int = 0, noise: float = 0.0) -> tuple[Tensor, np.ndarray]:
    """Correspondences (1, count, 4) of a random pose, and its essential matrix."""
    rng = np.random.default_rng(seed)
    R, t = rotation_from_vector(rng.uniform(-0.3, 0.3, 3)), rng.normal(size=3)
    X = np.column_stack([rng.uniform(-3, 3, (count, 2)), rng.uniform(4, 10, count)])
    X2 = X @ R.T + t / np.linalg.norm(t)
    correspondences = np.hstack([X[:, :2] / X[:, 2:], X2[:, :2] / X2[:, 2:]])
    correspondences += rng.normal(0, noise, correspondences.shape)
    return torch.from_numpy(correspondences[None].astype(np.float32)), essential_from_pose(R, t)


def uniform(count: int) -> Tensor:
    return torch.full((1, count), 1.0 / count)


def eigenvector_angles_deg(systems: np.ndarray) -> np.ndarray:
    """Angles between the float32 result and float64 ``eigh``."""
    found = smallest_eigenvector(torch.from_numpy(systems.astype(np.float32))).double().numpy()
    truth = np.linalg.eigh(systems)[1][:, :, 0]
    sine = np.linalg.norm(found - truth * np.sum(found * truth, 1, keepdims=True), axis=1)
    return np.degrees(np.arcsin(np.clip(sine, 0, 1)))


def test_eigenvectors_of_random_systems_with_a_gap():
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.normal(size=(60, 9, 9)))[0]
    values = np.sort(rng.uniform(0.1, 1.0, (60, 9)), 1)
    values[:, 0] = rng.uniform(0.0, 0.05, 60)
    angles = eigenvector_angles_deg((Q * values[:, None]) @ Q.transpose(0, 2, 1))
    assert angles.max() < 0.01


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_eigenvectors_of_noisy_two_view_systems(noise):
    systems = []
    for seed in range(40):
        x = views(60, seed, noise)[0][0].double().numpy()
        phi = np.einsum("ni,nj->nij", epipolar.homogeneous(x[:, 2:]), epipolar.homogeneous(x[:, :2])).reshape(-1, 9)
        phi = phi / np.sqrt(np.mean(phi**2, axis=0))  # columns of equal size, as conditioning makes them
        systems.append(phi.T @ phi / len(phi))
    angles = eigenvector_angles_deg(np.array(systems))
    assert np.median(angles) < 0.02
    assert angles.max() < 1.0


def test_eigenvectors_have_unit_length_and_ignore_the_scale():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(20, 9, 9)).astype(np.float32)
    A = torch.from_numpy(A @ A.transpose(0, 2, 1))
    v = smallest_eigenvector(A)
    torch.testing.assert_close(v.norm(dim=1), torch.ones(20), atol=1e-5, rtol=0)
    for scale in (1e-6, 1e6):
        torch.testing.assert_close(smallest_eigenvector(A * scale), v, atol=1e-4, rtol=0)


def test_equal_eigenvalues_give_some_unit_vector():
    systems = torch.stack([torch.eye(9), torch.zeros(9, 9), torch.diag(torch.tensor([0.0] * 5 + [1.0] * 4))])
    v = smallest_eigenvector(systems)
    torch.testing.assert_close(v.norm(dim=1), torch.ones(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(v[2, 5:], torch.zeros(4), atol=1e-5, rtol=0)  # inside the null space


@pytest.mark.parametrize("count", [8, 9, 30, 500])
def test_exact_correspondences_give_the_essential_matrix(count):
    for seed in range(10):
        x, E = views(count, seed)
        found = weighted_eight_point(x, uniform(count))
        # Eight points are the minimum: the gap above the null space, and with it the accuracy, may be small.
        assert sign_free_difference(found, torch.from_numpy(E[None]).float()) < (0.2 if count < 30 else 0.02)
        distance = symmetric_epipolar_distance_squared(x, found)
        assert float(distance.sqrt().median()) < 1e-3


def test_essential_matrices_have_unit_norm():
    x = torch.cat([views(20, seed, 0.01)[0] for seed in range(5)])
    E = weighted_eight_point(x, uniform(20).expand(5, 20))
    torch.testing.assert_close(E.norm(dim=(1, 2)), torch.ones(5), atol=1e-5, rtol=0)


def test_matches_of_weight_zero_have_no_say():
    x, E = views(60)
    polluted = torch.cat([x, torch.rand(1, 40, 4, generator=torch.Generator().manual_seed(0)) - 0.5], 1)
    weights = torch.cat([uniform(60), torch.zeros(1, 40)], 1)
    torch.testing.assert_close(
        weighted_eight_point(polluted, weights), weighted_eight_point(x, uniform(60)), atol=1e-4, rtol=0
    )
    without_weights = weighted_eight_point(polluted, uniform(100))
    assert sign_free_difference(without_weights, torch.from_numpy(E[None]).float()) > 0.05


def test_swapped_images_transpose_the_essential_matrix():
    x, _ = views(50, noise=1e-4)
    E, swapped = (weighted_eight_point(c, uniform(50)) for c in (x, x[..., [2, 3, 0, 1]]))
    assert sign_free_difference(E, swapped.transpose(1, 2)) < 1e-2


@pytest.mark.parametrize(
    "x", [torch.zeros(1, 9, 4), torch.rand(1, 1, 4), torch.rand(1, 3, 4), torch.ones(1, 20, 4) * 1e3]
)
def test_hopeless_points_give_a_finite_matrix_and_gradient(x):
    x = x.requires_grad_()
    E = weighted_eight_point(x, uniform(x.shape[1]))
    E.square().sum().add(E.sum()).backward()
    assert torch.isfinite(E).all()
    assert torch.isfinite(x.grad).all()


def test_gradient_of_the_weights_is_that_of_finite_differences():
    x, _ = views(30, noise=5e-3)
    x = x.double()
    weights = torch.rand(1, 30, generator=torch.Generator().manual_seed(0)).double().requires_grad_()

    def solve(w: Tensor) -> Tensor:
        return weighted_eight_point(x, w.softmax(-1)).square()

    assert torch.autograd.gradcheck(solve, (weights,), atol=1e-4)


def test_distance_is_that_of_the_reference():
    x, E = views(80, noise=0.05)
    E = E + 0.05  # no essential matrix: the formula does not ask for one
    found = symmetric_epipolar_distance_squared(x, torch.from_numpy(E[None]).float())[0].numpy()
    expected = epipolar.symmetric_epipolar_distance_squared(x[0].numpy(), E)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-9)


def test_residual_channel_tells_distances_on_a_log_scale():
    x, E = views(80, noise=0.02)
    E = torch.from_numpy(E[None]).float()
    residual = residual_channel(x, E)
    distance = symmetric_epipolar_distance_squared(x, E)
    assert float(residual.min()) >= -1.0
    assert float(residual.max()) <= 1.5
    assert (residual.argsort() == distance.argsort()).all()
    far = torch.tensor([[[0.0, 0.0, 5.0, 5.0]]])
    flat = torch.tensor([[[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]])  # epipolar lines are the rows
    torch.testing.assert_close(residual_channel(far, flat), torch.tensor([[1.5]]))
    on_label = torch.tensor([[[0.0, 0.0, 0.3, (0.5e-4) ** 0.5]]])
    torch.testing.assert_close(residual_channel(on_label, flat), torch.tensor([[0.0]]), atol=0.01, rtol=0)
    torch.testing.assert_close(residual_channel(torch.zeros(1, 1, 4), flat), torch.tensor([[-1.0]]))
    torch.testing.assert_close(residual_channel(torch.zeros(1, 1, 4), flat, 1e-3), torch.tensor([[-1.5]]))
