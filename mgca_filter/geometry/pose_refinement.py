"""Least squares on the pose: Levenberg–Marquardt on the truncated Sampson error of all matches.

The pose has five degrees of freedom: a rotation vector applied on the left of R and two steps of the unit
translation on its tangent plane (PoseLib and Hartley & Zisserman, 2nd ed., sec. 11.4.3, do the same).
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from .epipolar import cross_matrix, homogeneous_columns

Array = NDArray[np.float64]

_INITIAL_DAMPING = 1e-4
# Steps so short that they need more damping than this no longer pay.
_MAX_DAMPING = 1.0
_SMALLEST_CURVATURE = 1e-12
_CONVERGED_DECREASE = 1e-4
MIN_INLIERS = 6
# Below this the cost of directions is a paraboloid around the best. Rings and spokes that others are tried on.
_LINEAR_DEG, _RINGS, _SPOKES, _SPREAD_ROWS = 0.1, 28, 12, 200
# Matches farther than this many thresholds from the pose that refinement starts at are left out of it.
REACH = 12.0


def refine_pose(correspondences: Array, R: Array, t: Array, threshold: float, rounds: int = 10) -> tuple[Array, Array]:
    """Refine a relative pose on the matches within ``threshold``, which are chosen anew in every round.

    Args:
        correspondences: (N, 4) on the normalised image planes, finite; those beyond :data:`REACH` thresholds are left
            out.
        R, t: (3, 3) and (3,) unit norm, ``X2 = R X1 + t``.
        threshold: Sampson distance where the error is cut off, normalised.
        rounds: largest number of steps.

    Returns:
        The refined R, t; its truncated cost is never above the one it started from.
    """
    now = SampsonTerms(correspondences, R, t)
    reached = np.abs(now.residual) < REACH * threshold
    if np.count_nonzero(reached) < MIN_INLIERS:
        return R, t
    if not reached.all():
        now = SampsonTerms(correspondences[reached], R, t)
    cost, near = _truncated(now.residual, threshold)
    damping = _INITIAL_DAMPING
    for _ in range(rounds):
        if np.count_nonzero(near) < MIN_INLIERS:
            break
        residual, J = now.linearise(near)
        hessian, gradient = J @ J.T, J @ residual
        previous = cost
        while damping < _MAX_DAMPING:
            damped = hessian + damping * np.diag(np.diag(hessian) + _SMALLEST_CURVATURE)
            step = -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
            new = now.moved(step)
            new_cost, new_near = _truncated(new.residual, threshold)
            if new_cost < cost:
                now, cost, near = new, new_cost, new_near
                damping *= 0.1
                break
            damping *= 10.0
        if cost > (1.0 - _CONVERGED_DECREASE) * previous:
            break
    return now.R, now.t


def truncated_cost(correspondences: Array, R: Array, t: Array, threshold: float) -> float:
    """Sum of squared Sampson distances, each cut off at ``threshold``: what MSAC minimises."""
    return _truncated(SampsonTerms(correspondences, R, t).residual, threshold)[0]


def pose_uncertainty_deg(inliers: Array, R: Array, t: Array, noise: float) -> float:
    """Standard deviation of a pose along its worst direction, degrees, from the curvature of its inliers' cost.

    Args:
        inliers: (K, 4) on the normalised image planes.
        R, t: the pose. noise: standard deviation of the Sampson distance, normalised.

    Returns:
        Between 0.001 and 90; 90 with fewer than six inliers.
    """
    if len(inliers) < MIN_INLIERS:
        return 90.0
    _, J = SampsonTerms(inliers, R, t).linearise()
    curvature = float(np.linalg.eigvalsh(J @ J.T)[0])
    return float(np.clip(np.degrees(noise / np.sqrt(max(curvature, 1e-18))), 1e-3, 90.0))


def direction_uncertainty_deg(inliers: Array, R: Array, t: Array, noise: float) -> float:
    """Standard deviation of the direction of translation along its worst direction, degrees; at most 90.

    From the curvature of the cost where that says that it is small; else from the likelihoods of directions all around,
    for over a few pixels of parallax the cost is no paraboloid. What the rotation takes up of the same residuals is
    accounted for.

    Arguments as of :func:`pose_uncertainty_deg`.
    """
    if len(inliers) < MIN_INLIERS:
        return 90.0
    _, J = SampsonTerms(inliers, R, t).linearise()
    information = J @ J.T
    rotation, cross, direction = information[:3, :3], information[:3, 3:], information[3:, 3:]
    damping = _SMALLEST_CURVATURE * np.eye(3)
    marginal = direction - cross.T @ np.linalg.solve(rotation + damping, cross)
    curvature = float(np.linalg.eigvalsh(marginal)[0])
    linear_deg = float(min(np.degrees(noise / np.sqrt(max(curvature, 1e-18))), 90.0))
    return linear_deg if linear_deg < _LINEAR_DEG else _direction_spread_deg(inliers, R, t, noise, linear_deg)


def _direction_spread_deg(inliers: Array, R: Array, t: Array, noise: float, scale_deg: float) -> float:
    """The same from the likelihoods of directions on rings around ``t``, from a fraction of ``scale_deg`` to 90."""
    step = max(1, -(-len(inliers) // _SPREAD_ROWS))
    rows = inliers[::step]
    edges = np.concatenate([[0.0], np.geomspace(np.radians(min(0.2 * scale_deg, 1.0)), np.pi / 2, _RINGS)])
    angle, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    turn = np.linspace(0.0, 2.0 * np.pi, _SPOKES, endpoint=False)
    across = np.stack([np.cos(turn), np.sin(turn)], axis=1)  # (S, 2)
    ring, spoke = np.repeat(np.arange(_RINGS), _SPOKES), np.tile(np.arange(_SPOKES), _RINGS)
    offsets = across[spoke] @ _tangent_basis(t)
    directions = np.cos(angle[ring])[:, None] * t + np.sin(angle[ring])[:, None] * offsets  # (D, 3)
    costs = _costs_of_directions(rows, R, np.vstack([t, directions]))
    costs = step * (costs[1:] - costs[0])
    log_weights = -0.5 * costs / noise**2 + np.log(np.sin(angle[ring]) * width[ring])
    weights = np.exp(log_weights - log_weights.max())
    moved = angle[ring][:, None] * across[spoke]
    moments = (weights[:, None] * moved).T @ moved / weights.sum()
    return float(min(np.degrees(np.sqrt(np.linalg.eigvalsh(moments)[1])), 90.0))


def _costs_of_directions(rows: Array, R: Array, directions: Array) -> Array:
    """Summed squared Sampson distances (D,) of matches (N, 4) to poses with directions (D, 3), the rotation moved from
    R as each likes best, to first order.

    Of a direction d the error is d · (r × x2), its derivative by the rotation A d with A = x2 rᵀ - (r · x2) I, and the
    squared norm of the line normals a quadratic form of d: all are sums of a few products of d with what the matches
    tell, so that products of matrices give them for all directions and matches at once.
    """
    x1, x2 = homogeneous_columns(rows[:, :2]), homogeneous_columns(rows[:, 2:])
    rays = R @ x1  # (3, N), in the second camera
    # Line normals in image 2, then in image 1, of unit directions: rows 0 and 1 of d × r and of Rᵀ (x2 × d).
    units = np.stack([cross_matrix(unit) for unit in np.eye(3)])  # (3, 3, 3)
    normals = np.concatenate([(units @ rays)[:, :2], R.T[:2] @ -(units @ x2)], axis=1)  # (3, 4, N)
    forms = np.einsum("jkn,lkn->jln", normals, normals).reshape(9, -1)
    squares = np.einsum("dj,dl->djl", directions, directions).reshape(-1, 9)  # (D, 9)
    weight = 1.0 / np.maximum(squares @ forms, np.finfo(np.float64).tiny)  # (D, N)
    error = directions @ _cross(rays, x2)
    A = x2[:, None] * rays[None] - np.sum(rays * x2, axis=0) * np.eye(3)[..., None]  # (3, 3, N)
    pairs = np.einsum("jln,kmn->jklmn", A, A).reshape(81, -1)
    gradient = np.einsum("djl,dl->dj", ((weight * error) @ A.reshape(9, -1).T).reshape(-1, 3, 3), directions)
    hessian = np.einsum("djkl,dl->djk", (weight @ pairs.T).reshape(-1, 3, 3, 9), squares)
    hessian += _SMALLEST_CURVATURE * np.eye(3)
    gain = np.einsum("dk,dk->d", gradient, np.linalg.solve(hessian, gradient[..., None])[..., 0])
    return np.asarray(np.einsum("dn,dn->d", weight * error, error) - gain, dtype=np.float64)


class SampsonTerms:
    """Sampson distances of matches (N, 4) to a pose, and how they change with it.

    Attributes:
        R, t: the pose.
        residual: (N,) signed Sampson distances, normalised.
    """

    def __init__(self, correspondences: Array, R: Array, t: Array) -> None:
        self._x1, self._x2 = homogeneous_columns(correspondences[:, :2]), homogeneous_columns(correspondences[:, 2:])
        self._measure(R, t)

    def _measure(self, R: Array, t: Array) -> None:
        self.R, self.t = R, t
        E = cross_matrix(t) @ R
        line2 = E @ self._x1  # (3, N)
        normals = np.concatenate([line2[:2], E.T[:2] @ self._x2])  # (4, N), of the lines in image 2, then in image 1
        squared_norm = np.einsum("in,in->n", normals, normals)
        self._scale = 1.0 / np.sqrt(np.maximum(squared_norm, np.finfo(np.float64).tiny))
        self.residual = np.einsum("in,in->n", line2, self._x2) * self._scale

    def moved(self, step: Array) -> SampsonTerms:
        """The same matches under the pose after a step (5,)."""
        new = copy(self)
        t = self.t + step[3:] @ _tangent_basis(self.t)
        new._measure(rotation_from_vector(step[:3]) @ self.R, t / np.linalg.norm(t))
        return new

    def linearise(self, used: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """Residuals (N,) and their derivatives (5, N), line normals held fixed; zero for those that are not used."""
        scale = self._scale if used is None else self._scale * used
        rays = self.R @ self._x1  # in the second camera
        turned = _cross(rays, self._x2)  # the derivative of the error by t
        J = np.empty((5, len(scale)))
        J[:3] = _cross(rays, cross_matrix(-self.t) @ self._x2)
        J[3:] = _tangent_basis(self.t) @ turned
        J *= scale
        return (self.residual if used is None else self.residual * used), J


def _cross(a: Array, b: Array) -> Array:
    """Vector products (3, N) of columns: ``np.cross`` takes several times as long."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _truncated(residual: Array, threshold: float) -> tuple[float, NDArray[np.bool_]]:
    """Sum of the squares, cut off at the threshold, and what lies within it (N,)."""
    squared = residual * residual
    return float(np.minimum(squared, threshold**2).sum()), squared < threshold**2


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
