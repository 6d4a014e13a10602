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

from .eight_point import Array, constant, homogeneous_products, lines_table, smallest_eigenvector_row

# Widths of the kernel, normalised coordinates; the last is about a pixel.
KERNEL_WIDTHS = (0.1, 0.052, 0.027, 0.014, 0.0072, 0.0037, 0.0019, 0.001)
# A match counts half at this logit: doubtful ones cost more than they bring.
WEIGHT_LOGIT = 3.0
ORTHONORMALISATIONS = 12
DAMPING = 1e-6
# _CROSS[i, j] is the cross product of the basis vectors e_i and e_j.
_CROSS = np.array(
    [[[0, 0, 0], [0, 0, 1], [0, -1, 0]], [[0, 0, -1], [0, 0, 0], [1, 0, 0]], [[0, 1, 0], [-1, 0, 0], [0, 0, 0]]], float
)
# [e_k]× for the three axes: rows of a rotation's derivative.
_GENERATORS = _CROSS.transpose(0, 2, 1)
# Columns of what a step sees of a match: derivatives by ω and δ, the error, two coefficients of each epipolar line.
_UNKNOWNS, _ERROR, _COLUMNS = 6, 6, 11


def _columns_table() -> Array:
    """vec((1, t) ⊗ vec(R)) @ table, as (9, 11): x2 ⊗ x1 @ that = the columns of a step.

    By ω: x2ᵀ [t]× [e_k]× R x1; by δ: x2ᵀ [e_k]× R x1; the error x2ᵀ [t]× R x1; a and b of both epipolar lines.
    """
    table = np.zeros((4, 9, 9, _COLUMNS))
    for entry in range(9):
        R = np.eye(9)[entry].reshape(3, 3)
        for axis, generator in enumerate(_GENERATORS):
            table[0, entry, :, 3 + axis] = (generator @ R).ravel()
            for other in range(3):
                table[1 + axis, entry, :, other] = (generator @ _GENERATORS[other] @ R).ravel()
            table[1 + axis, entry, :, _ERROR:] = ((generator @ R).ravel() @ lines_table()).reshape(9, 5)
    return table.reshape(36, 9 * _COLUMNS)


def _decomposition_table() -> Array:
    """vec((vec(E), t) ⊗ vec(E)) @ table = cofactors of √2 E less [t]× √2 E, row by row (Horn 1990), E of unit norm."""
    table = np.zeros((12, 9, 9))
    for i in range(3):
        down, up = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            right, left = (j + 1) % 3, (j + 2) % 3
            table[3 * down + right, 3 * up + left, 3 * i + j] += 2.0
            table[3 * down + left, 3 * up + right, 3 * i + j] -= 2.0
    for axis, generator in enumerate(_GENERATORS):
        for entry in range(9):
            table[9 + axis, entry] -= 2**0.5 * (generator @ np.eye(9)[entry].reshape(3, 3)).ravel()
    return table.reshape(108, 9)


def _rotation_table() -> Array:
    """vec(q ⊗ q) @ table = the rotation of a unit quaternion q = (w, x, y, z), row by row."""
    table = np.zeros((4, 4, 3, 3))
    table[0, 0] = np.eye(3)
    for k in range(3):
        table[0, 1 + k] += 2.0 * _GENERATORS[k]
        for j in range(3):
            table[1 + j, 1 + k, j, k] += 2.0
        table[1 + k, 1 + k] -= np.eye(3)
    return table.reshape(16, 9)


_COLUMNS_TABLE, _DECOMPOSITION, _ROTATION = _columns_table(), _decomposition_table(), _rotation_table()
_CROSS_TABLE = _CROSS.transpose(0, 2, 1).reshape(3, 9)
# (1, t) where t stands among the unknowns; the step of t, and of half of the rotation vector, from the solution.
_TRANSLATION = np.zeros((_COLUMNS, 4))
_TRANSLATION[3:6, 1:] = np.eye(3)
_HALF_ROTATION = np.zeros((_COLUMNS, 4))
_HALF_ROTATION[:3, 1:] = 0.5 * np.eye(3)


def refine_essential(correspondences: Tensor, logits: Tensor, essential: Tensor) -> Tensor:
    """Essential matrices (B, 3, 3) of unit Frobenius norm and two equal singular values, sign free.

    Gradients reach the logits through the last step alone, taken as if the pose before it were a constant: where the
    steps have converged that is the derivative of the minimum (implicit differentiation), at the price of one step.

    Args:
        correspondences: (B, N, 4) on the normalised image planes.
        logits: (B, N) of the matches.
        essential: (B, 3, 3) to start from, of any scale and rank; comes back where matches are degenerate.
    """
    phi = homogeneous_products(correspondences)  # (B, N, 9)
    weights = torch.sigmoid(logits - WEIGHT_LOGIT)
    weights = (weights / weights.sum(1, keepdim=True).clamp_min(1e-12)).unsqueeze(-1)  # (B, N, 1)
    if weights.requires_grad:
        # Degenerate matches teach nothing.
        weights.register_hook(partial(torch.nan_to_num, nan=0.0, posinf=0.0, neginf=0.0))
    R, t = _decompose(essential.detach())
    for width in KERNEL_WIDTHS[:-1]:
        R, t = _step(phi, weights.detach(), R, t, width)
    R, t = _step(phi, weights, R, t, KERNEL_WIDTHS[-1])
    refined = (t[:, 1:].transpose(1, 2) @ constant(_CROSS_TABLE, t)).view(-1, 3, 3) @ R
    norm = refined.norm(dim=(1, 2), keepdim=True)
    # √2 for a unit translation and a rotation. Degenerate matches may end in what is not a number: never above 1.
    return torch.where(norm > 1.0, refined / norm.clamp_min(1.0), essential)


def _step(phi: Tensor, weights: Tensor, R: Tensor, t: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """One Gauss–Newton step: R ← exp(ω) R, t ← t + δ, scaled to unit length.

    Args:
        phi: x2 ⊗ x1 (B, N, 9). weights: (B, N, 1). R: (B, 3, 3). t: (1, t) as a column (B, 4, 1).
    """
    table = (t @ R.reshape(-1, 1, 9)).view(-1, 1, 36) @ constant(_COLUMNS_TABLE, R)
    columns = phi @ table.view(-1, 9, _COLUMNS)  # (B, N, 11)
    sums = np.zeros((_COLUMNS, 2))  # of the squares: width² normal, and that + error²
    sums[_ERROR + 1 :] = width**2
    sums[_ERROR, 1] = 1.0
    # kernel² / normal over width², the kernel being width² normal / (width² normal + error²)
    numerator, denominator = (columns.square() @ constant(sums, R) + 1e-18).split([1, 1], -1)
    robust = columns * (weights * (numerator / denominator.square()))
    system = robust.transpose(1, 2) @ columns  # (B, 11, 11): the unknowns and the error come first
    eye = torch.eye(_COLUMNS, dtype=R.dtype, device=R.device)
    trace = (system * constant(np.diag([1.0] * 7 + [0.0] * 4), R)).sum((1, 2), keepdim=True)
    along = constant(_TRANSLATION, R) @ t  # the length of t is free: hold it
    system = system * (1.0 + DAMPING * eye) + 1e-9 * eye + (trace * along) @ along.transpose(1, 2)
    solution = _solve(system)  # (B, 11, 1)
    t = t - constant(_TRANSLATION.T, R) @ solution
    t = t / torch.cat([t[:, :1], t[:, 1:].norm(dim=1, keepdim=True).expand(-1, 3, -1)], 1)
    q = constant(np.eye(4)[:, :1], R) - constant(_HALF_ROTATION.T, R) @ solution  # (B, 4, 1), a rotation for any length
    q = q / q.norm(dim=1, keepdim=True)
    turn = (q @ q.transpose(1, 2)).view(-1, 1, 16) @ constant(_ROTATION, R)  # Cayley's
    return turn.view(-1, 3, 3) @ R, t


def _decompose(E: Tensor) -> tuple[Tensor, Tensor]:
    """A rotation (B, 3, 3) and a unit translation, (1, t) as a column (B, 4, 1), with [t]× R near E, up to sign."""
    vector = E.reshape(-1, 9, 1)
    vector = vector / vector.norm(dim=1, keepdim=True)
    E = vector.view(-1, 3, 3)
    t = smallest_eigenvector_row(E @ E.transpose(1, 2)).transpose(1, 2)
    t = t / t.norm(dim=1, keepdim=True)  # (B, 3, 1)
    products = torch.cat([vector, t], 1) @ vector.transpose(1, 2)  # (B, 12, 9)
    R = (products.view(-1, 1, 108) @ constant(_DECOMPOSITION, E)).view(-1, 3, 3)
    eye = torch.eye(3, dtype=E.dtype, device=E.device)
    for _ in range(ORTHONORMALISATIONS):  # Newton–Schulz
        R = R @ (1.5 * eye - 0.5 * (R.transpose(1, 2) @ R))
    return R, F.pad(t, (0, 0, 1, 0), value=1.0)


def _solve(system: Tensor) -> Tensor:
    """Solutions (B, 11, 1) for the first six unknowns of [A | b] in the first rows and columns: Gauss–Jordan."""
    for k in range(_UNKNOWNS):
        axis = np.eye(_COLUMNS)[:, k : k + 1]
        row = constant(axis.T, system) @ system  # (B, 1, 11)
        column = system @ constant(axis, system) - constant(axis, system)
        system = system - column @ (row / (row @ constant(axis, system)))
    return system[:, :, _ERROR : _ERROR + 1]
