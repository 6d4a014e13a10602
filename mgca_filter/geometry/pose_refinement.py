"""Least squares on the pose: Levenberg–Marquardt on the truncated Sampson error of all matches.

The pose has five degrees of freedom: a rotation vector applied on the left of R and two steps of the unit
translation on its tangent plane (PoseLib and Hartley & Zisserman, 2nd ed., sec. 11.4.3, do the same).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .epipolar import cross_matrix, homogeneous

Array = NDArray[np.float64]

_INITIAL_DAMPING = 1e-4
# Steps so short that they need more damping than this no longer pay.
_MAX_DAMPING = 1.0
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
    x1, x2 = homogeneous(correspondences[:, :2]), homogeneous(correspondences[:, 2:])
    now = _Residuals(x1, x2, R, t, threshold)
    damping = _INITIAL_DAMPING
    for _ in range(rounds):
        if np.count_nonzero(now.near) < MIN_INLIERS:
            break
        residuals, jacobian = now.linearise()
        hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
        previous = now.cost
        while damping < _MAX_DAMPING:
            damped = hessian + damping * np.diag(np.diag(hessian) + _SMALLEST_CURVATURE)
            step = -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
            new = _Residuals(x1, x2, *_apply_step(now.R, now.t, step), threshold)
            if new.cost < now.cost:
                now = new
                damping *= 0.1
                break
            damping *= 10.0
        if now.cost > (1.0 - _CONVERGED_DECREASE) * previous:
            break
    return now.R, now.t


def truncated_cost(correspondences: Array, R: Array, t: Array, threshold: float) -> float:
    """Sum of squared Sampson distances, each cut off at ``threshold``: what MSAC minimises."""
    x1, x2 = homogeneous(correspondences[:, :2]), homogeneous(correspondences[:, 2:])
    return _Residuals(x1, x2, R, t, threshold).cost


class _Residuals:
    """What a pose leaves of homogeneous points x1, x2 (N, 3), and how that changes with the pose.

    Attributes:
        R, t: the pose.
        near: (N,) within the threshold.
        cost: sum of the squared Sampson distances, each cut off at the threshold.
    """

    def __init__(self, x1: Array, x2: Array, R: Array, t: Array, threshold: float) -> None:
        self.R, self.t = R, t
        T = cross_matrix(t)
        self._x2 = x2
        self._rays = x1 @ R.T  # of image 1, in the second camera
        self._planes = x2 @ T  # x2 × t: normals of the epipolar planes
        self._error = np.einsum("ni,ni->n", self._rays, self._planes)  # x2ᵀ E x1
        line2, line1 = self._rays @ T[:2].T, self._planes @ R[:, :2]
        squared_norm = np.einsum("ni,ni->n", line2, line2) + np.einsum("ni,ni->n", line1, line1)
        self._squared_norm = np.maximum(squared_norm, np.finfo(np.float64).tiny)
        squared = self._error**2 / self._squared_norm
        self.near = squared < threshold**2
        self.cost = float(np.minimum(squared, threshold**2).sum())

    def linearise(self) -> tuple[Array, Array]:
        """Signed Sampson distances (K,) of the near matches and their derivatives (K, 5), line normals held fixed."""
        scale = 1.0 / np.sqrt(self._squared_norm[self.near])
        rays = self._rays[self.near] * scale[:, None]
        by_rotation = _cross(rays, self._planes[self.near])
        by_translation = _cross(rays, self._x2[self.near]) @ _tangent_basis(self.t).T
        return self._error[self.near] * scale, np.hstack([by_rotation, by_translation])


def _cross(a: Array, b: Array) -> Array:
    """Cross products of rows (N, 3): ``np.cross`` takes five times as long on a few hundred."""
    (a0, a1, a2), (b0, b1, b2) = a.T, b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=1)


def _tangent_basis(t: Array) -> Array:
    """Two unit vectors (2, 3) orthogonal to ``t``."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(t))] = 1.0
    T = cross_matrix(t)
    first = T @ axis
    first /= np.linalg.norm(first)
    return np.stack([first, T @ first])


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
    return rotation_from_vector(step[:3]) @ R, t_new / np.linalg.norm(t_new)
