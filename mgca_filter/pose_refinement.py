"""Least squares on the pose: Levenberg–Marquardt on the truncated Sampson error of all matches.

The pose has five degrees of freedom: a rotation vector applied on the left of R and two steps of the unit
translation on its tangent plane (PoseLib and Hartley & Zisserman, 2nd ed., sec. 11.4.3, do the same).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .epipolar import cross_matrix, homogeneous, sampson_distance

Array = NDArray[np.float64]

_INITIAL_DAMPING = 1e-4
_MAX_DAMPING = 1e6
_SMALLEST_CURVATURE = 1e-12
_CONVERGED_DECREASE = 1e-4
MIN_INLIERS = 6


def refine_pose(correspondences: Array, R: Array, t: Array, threshold: float, rounds: int = 10) -> tuple[Array, Array]:
    """Refine a relative pose on the matches within ``threshold``, which are chosen anew in every round.

    Args:
        correspondences: (N, 4) on the normalised image planes, finite.
        R, t: (3, 3) and (3,) unit norm, ``X2 = R X1 + t``.
        threshold: Sampson distance where the error is cut off, normalised.
        rounds: largest number of steps.

    Returns:
        The refined R, t; its truncated cost is never above the one it started from.
    """
    cost = truncated_cost(correspondences, R, t, threshold)
    damping = _INITIAL_DAMPING
    for _ in range(rounds):
        near = correspondences[sampson_distance(correspondences, cross_matrix(t) @ R) < threshold]
        if len(near) < MIN_INLIERS:
            break
        residuals, jacobian = _residuals_and_jacobian(near, R, t)
        hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
        previous = cost
        while damping < _MAX_DAMPING:
            damped = hessian + damping * np.diag(np.diag(hessian) + _SMALLEST_CURVATURE)
            R_new, t_new = _apply_step(R, t, -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64))
            cost_new = truncated_cost(correspondences, R_new, t_new, threshold)
            if cost_new < cost:
                R, t, cost = R_new, t_new, cost_new
                damping *= 0.1
                break
            damping *= 10.0
        if cost > (1.0 - _CONVERGED_DECREASE) * previous:
            break
    return R, t


def truncated_cost(correspondences: Array, R: Array, t: Array, threshold: float) -> float:
    """Sum of squared Sampson distances, each cut off at ``threshold``: what MSAC minimises."""
    distance = np.minimum(sampson_distance(correspondences, cross_matrix(t) @ R), threshold)
    return float(np.sum(distance**2))


def _tangent_basis(t: Array) -> Array:
    """Two unit vectors (2, 3) orthogonal to ``t``."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(t))] = 1.0
    first = np.cross(t, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(t, first)])


def rotation_from_vector(vector: Array) -> Array:
    """Rotation (3, 3) about ``vector`` (3,) by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + cross_matrix(vector)
    k = cross_matrix(vector / angle)
    R: Array = np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)
    return R


def _apply_step(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    t_new = t + step[3:] @ _tangent_basis(t)
    U, _, Vt = np.linalg.svd(rotation_from_vector(step[:3]) @ R)  # stays a rotation however many the steps
    return U @ Vt, t_new / np.linalg.norm(t_new)


def _residuals_and_jacobian(correspondences: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """Signed Sampson distances (N,) and their derivatives (N, 5)."""
    x1, x2 = homogeneous(correspondences[:, :2]), homogeneous(correspondences[:, 2:])
    T = cross_matrix(t)
    E = T @ R
    derivatives = np.stack(
        [T @ cross_matrix(axis) @ R for axis in np.eye(3)] + [cross_matrix(b) @ R for b in _tangent_basis(t)]
    )  # (5, 3, 3)
    line2, line1 = x1 @ E.T, x2 @ E
    d_line2 = np.einsum("kij,nj->nki", derivatives, x1)  # (N, 5, 3)
    d_line1 = np.einsum("kij,ni->nkj", derivatives[:, :, :2], x2)  # (N, 5, 2)
    error = np.sum(x2 * line2, axis=1)
    squared_norm = np.sum(line2[:, :2] ** 2, axis=1) + np.sum(line1[:, :2] ** 2, axis=1)
    scale = np.sqrt(np.maximum(squared_norm, np.finfo(np.float64).tiny))
    d_error = np.einsum("ni,nki->nk", x2, d_line2)
    d_scale = np.einsum("ni,nki->nk", line2[:, :2], d_line2[:, :, :2]) + np.einsum("ni,nki->nk", line1[:, :2], d_line1)
    d_scale /= scale[:, None]
    return error / scale, (d_error - (error / scale)[:, None] * d_scale) / scale[:, None]
