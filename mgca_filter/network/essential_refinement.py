"""Refinement of an essential matrix on its manifold, from matrix products alone: it lives in the exported graph.

The eight-point algorithm minimises an algebraic error over all 3x3 matrices, which near-planar scenes leave
undetermined. Here the five degrees of freedom of a pose are left: Gauss–Newton on the Sampson error, with matches
weighted by their logits and by a Geman–McClure kernel that narrows from step to step (graduated non-convexity).
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from .eight_point import smallest_eigenvector

# Widths of the kernel, normalised coordinates; the last is about a pixel.
KERNEL_WIDTHS = (0.1, 0.052, 0.027, 0.014, 0.0072, 0.0037, 0.0019, 0.001)
# A match counts half at this logit: doubtful ones cost more than they bring.
WEIGHT_LOGIT = 3.0
ORTHONORMALISATIONS = 12
DAMPING = 1e-6
_NEXT, _LAST = (1, 2, 0), (2, 0, 1)
# _CROSS[i, j] is the cross product of the basis vectors e_i and e_j.
_CROSS = np.array(
    [[[0, 0, 0], [0, 0, 1], [0, -1, 0]], [[0, 0, -1], [0, 0, 0], [1, 0, 0]], [[0, 1, 0], [-1, 0, 0], [0, 0, 0]]]
)


def refine_essential(correspondences: Tensor, logits: Tensor, essential: Tensor) -> Tensor:
    """Essential matrices (B, 3, 3) of unit Frobenius norm and two equal singular values, sign free.

    Gradients reach the logits through the last step alone, taken as if the pose before it were a constant: where the
    steps have converged that is the derivative of the minimum (implicit differentiation), at the price of one step.

    Args:
        correspondences: (B, N, 4) on the normalised image planes.
        logits: (B, N) of the matches.
        essential: (B, 3, 3) to start from, of any scale and rank; comes back where matches are degenerate.
    """
    one = torch.ones_like(correspondences[..., :1])
    x1 = torch.cat([correspondences[..., :2], one], -1)  # (B, N, 3)
    x2 = torch.cat([correspondences[..., 2:], one], -1)
    weights = torch.sigmoid(logits - WEIGHT_LOGIT)
    weights = (weights / weights.sum(1, keepdim=True).clamp_min(1e-12)).unsqueeze(-1)  # (B, N, 1)
    if weights.requires_grad:
        # Degenerate matches teach nothing.
        weights.register_hook(partial(torch.nan_to_num, nan=0.0, posinf=0.0, neginf=0.0))
    R, t = _decompose(essential.detach())
    for width in KERNEL_WIDTHS[:-1]:
        R, t = _step(x1, x2, weights.detach(), R, t, width)
    R, t = _step(x1, x2, weights, R, t, KERNEL_WIDTHS[-1])
    refined = _cross_matrix(t) @ R
    squared_norm = refined.square().sum((1, 2), keepdim=True)
    # Two for a unit translation and a rotation. Degenerate matches may end in what is not a number: never above 1.
    return torch.where(squared_norm > 1.0, refined / squared_norm.clamp_min(1.0).sqrt(), essential)


def _step(x1: Tensor, x2: Tensor, weights: Tensor, R: Tensor, t: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """One Gauss–Newton step: R ← exp(ω) R, t ← t + δ, scaled to unit length."""
    X = x1 @ R.transpose(1, 2)  # (B, N, 3), viewing rays of image 1 in the second camera
    v = x2 @ _cross_matrix(t)  # x2 × t: the epipolar plane through x2
    error = (X * v).sum(-1, keepdim=True)  # x2ᵀ E x1
    normal = (X @ _cross_matrix(t))[..., :2].square().sum(-1, keepdim=True)
    normal = (normal + (v @ R)[..., :2].square().sum(-1, keepdim=True)).clamp_min(1e-12)  # of both epipolar lines
    kernel = width**2 * normal / (width**2 * normal + error.square())
    jacobian = torch.cat([_cross_products(X, torch.cat([v, x2], -1)), error], -1)  # (B, N, 7): by ω, by δ; the error
    system = (jacobian * (weights * kernel.square() / normal)).transpose(1, 2) @ jacobian  # (B, 7, 7)
    along = F.pad(t, (3, 1)).unsqueeze(2)  # (B, 7, 1); the length of t is free: hold it
    eye = torch.eye(7, dtype=t.dtype, device=t.device)
    diagonal = system * eye
    trace = diagonal.sum((1, 2), keepdim=True)
    system = system + trace * (along @ along.transpose(1, 2)) + DAMPING * diagonal + 1e-9 * eye
    step = -_solve(system[:, :6])  # (B, 6)
    t = t + step[:, 3:]
    return _cayley(step[:, :3]) @ R, t / t.square().sum(1, keepdim=True).clamp_min(1e-12).sqrt()


def _decompose(E: Tensor) -> tuple[Tensor, Tensor]:
    """A rotation (B, 3, 3) and a unit translation (B, 3) with [t]× R near E, up to sign (Horn 1990)."""
    E = E / (0.5 * E.square().sum((1, 2), keepdim=True)).clamp_min(1e-30).sqrt()
    t = smallest_eigenvector(E @ E.transpose(1, 2))
    down, up = E[:, _NEXT], E[:, _LAST]
    cofactors = down[:, :, _NEXT] * up[:, :, _LAST] - down[:, :, _LAST] * up[:, :, _NEXT]
    R = cofactors - _cross_matrix(t) @ E
    for _ in range(ORTHONORMALISATIONS):  # Newton–Schulz
        R = 1.5 * R - 0.5 * R @ R.transpose(1, 2) @ R
    return R, t


def _solve(augmented: Tensor) -> Tensor:
    """Solutions (B, n) of symmetric positive definite systems [A | b] (B, n, n + 1): Gauss–Jordan, unrolled."""
    n = augmented.shape[1]
    eye = torch.eye(n, dtype=augmented.dtype, device=augmented.device)
    for k in range(n):
        pivot = augmented[:, k : k + 1] / augmented[:, k : k + 1, k : k + 1]  # (B, 1, n + 1)
        augmented = augmented - (augmented[:, :, k : k + 1] - eye[:, k : k + 1]) * pivot
    return augmented[:, :, n]


def _cayley(rotation_vector: Tensor) -> Tensor:
    """Rotations (B, 3, 3) about (B, 3) by about its length, a rotation for any length (Cayley)."""
    half = 0.5 * rotation_vector
    square = half.square().sum(1).view(-1, 1, 1)
    eye = torch.eye(3, dtype=half.dtype, device=half.device)
    outer = half.unsqueeze(2) * half.unsqueeze(1)
    return ((1.0 - square) * eye + 2.0 * _cross_matrix(half) + 2.0 * outer) / (1.0 + square)


def _cross_products(a: Tensor, b: Tensor) -> Tensor:
    """a × b (B, N, 6) of vectors a (B, N, 3) with each of two vectors b (B, N, 6)."""
    table = np.concatenate([np.kron(np.eye(2), part) for part in _CROSS])  # (18, 6)
    products = (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(2)  # (B, N, 18)
    return products @ torch.tensor(table, dtype=a.dtype, device=a.device)


def _cross_matrix(v: Tensor) -> Tensor:
    """Matrices (B, 3, 3) with [v]× w = v × w, of vectors (B, 3)."""
    table = torch.tensor(_CROSS.transpose(0, 2, 1).reshape(3, 9), dtype=v.dtype, device=v.device)
    return (v @ table).view(-1, 3, 3)
