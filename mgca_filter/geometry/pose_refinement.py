"""Least squares on the pose: Levenberg–Marquardt on the truncated Sampson error of all matches.

The pose has five degrees of freedom: a rotation vector applied on the left of R and two steps of the unit
translation on its tangent plane (PoseLib and Hartley & Zisserman, 2nd ed., sec. 11.4.3, do the same).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .epipolar import cross_matrix

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
    reached = np.abs(SampsonTerms(correspondences, R, t).residual()) < REACH * threshold
    if np.count_nonzero(reached) < MIN_INLIERS:
        return R, t
    correspondences = correspondences[reached]
    now = SampsonTerms(correspondences, R, t)
    cost, near = _truncated(now.residual(), threshold)
    damping = _INITIAL_DAMPING
    for _ in range(rounds):
        if np.count_nonzero(near) < MIN_INLIERS:
            break
        residual, J = now.linearise(near)
        hessian, gradient = J.T @ J, J.T @ residual
        previous = cost
        while damping < _MAX_DAMPING:
            damped = hessian + damping * np.diag(np.diag(hessian) + _SMALLEST_CURVATURE)
            step = -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
            new = SampsonTerms(correspondences, *_apply_step(now.R, now.t, step))
            new_cost, new_near = _truncated(new.residual(), threshold)
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
    return _truncated(SampsonTerms(correspondences, R, t).residual(), threshold)[0]


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
    terms = SampsonTerms(inliers, R, t)
    _, J = terms.linearise(np.ones(len(inliers), dtype=bool))
    curvature = float(np.linalg.eigvalsh(J.T @ J)[0])
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
    _, J = SampsonTerms(inliers, R, t).linearise(np.ones(len(inliers), dtype=bool))
    information = J.T @ J
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
    costs = step * (_costs_of_directions(rows, R, directions) - _costs_of_directions(rows, R, t[None]))
    log_weights = -0.5 * costs / noise**2 + np.log(np.sin(angle[ring]) * width[ring])
    weights = np.exp(log_weights - log_weights.max())
    moved = angle[ring][:, None] * across[spoke]
    moments = (weights[:, None] * moved).T @ moved / weights.sum()
    return float(min(np.degrees(np.sqrt(np.linalg.eigvalsh(moments)[1])), 90.0))


def _costs_of_directions(rows: Array, R: Array, directions: Array) -> Array:
    """Summed squared Sampson distances (D,) of matches (N, 4) to poses with directions (D, 3), the rotation moved from
    R as each likes best, to first order."""
    x1, x2 = (np.column_stack([part, np.ones(len(rows))]) for part in (rows[:, :2], rows[:, 2:]))
    rays = x1 @ R.T  # (N, 3), in the second camera
    normals = np.cross(x2[None], directions[:, None])  # (D, N, 3)
    lines2, lines1 = np.cross(directions[:, None], rays[None]), normals @ R
    squared_norm = np.sum(lines2[..., :2] ** 2, axis=2) + np.sum(lines1[..., :2] ** 2, axis=2)
    scale = 1.0 / np.sqrt(np.maximum(squared_norm, np.finfo(np.float64).tiny))  # (D, N)
    residual = np.einsum("nk,dnk->dn", rays, normals) * scale
    J = np.cross(rays[None], normals) * scale[..., None]  # (D, N, 3)
    gradient = np.einsum("dnk,dn->dk", J, residual)
    hessian = np.einsum("dnj,dnk->djk", J, J) + _SMALLEST_CURVATURE * np.eye(3)
    gain = np.einsum("dk,dk->d", gradient, np.linalg.solve(hessian, gradient[..., None])[..., 0])
    return np.asarray(np.sum(residual**2, axis=1) - gain, dtype=np.float64)


class SampsonTerms:
    """Sampson distances of matches (N, 4) to a pose, and how they change with it; column by column, which is fastest.

    Attributes:
        R, t: the pose.
    """

    def __init__(self, correspondences: Array, R: Array, t: Array) -> None:
        self.R, self.t = R, t
        x1, y1, x2, y2 = correspondences.T
        self._x2, self._y2 = x2, y2
        r0, r1, r2 = self._rays = [R[i, 0] * x1 + R[i, 1] * y1 + R[i, 2] for i in range(3)]  # in the second camera
        t0, t1, t2 = t
        n0, n1, n2 = self._normals = [y2 * t2 - t1, t0 - x2 * t2, x2 * t1 - y2 * t0]  # x2 × t
        self._error = r0 * n0 + r1 * n1 + r2 * n2  # x2ᵀ E x1
        l0, l1 = t1 * r2 - t2 * r1, t2 * r0 - t0 * r2  # epipolar lines in image 2, then in image 1
        m0, m1 = (n0 * R[0, i] + n1 * R[1, i] + n2 * R[2, i] for i in range(2))
        squared_norm = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        self._scale = 1.0 / np.sqrt(np.maximum(squared_norm, np.finfo(np.float64).tiny))

    def residual(self) -> Array:
        """Signed Sampson distances (N,), normalised."""
        return np.asarray(self._error * self._scale)

    def linearise(self, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Residuals (K,) of the used matches and their derivatives (K, 5), line normals held fixed."""
        scale = self._scale[used]
        r0, r1, r2 = (part[used] * scale for part in self._rays)
        n0, n1, n2 = (part[used] for part in self._normals)
        x2, y2 = self._x2[used], self._y2[used]
        J = np.empty((len(scale), 5))
        J[:, 0], J[:, 1], J[:, 2] = r1 * n2 - r2 * n1, r2 * n0 - r0 * n2, r0 * n1 - r1 * n0
        J[:, 3:] = np.stack([r1 - r2 * y2, r2 * x2 - r0, r0 * y2 - r1 * x2], axis=1) @ _tangent_basis(self.t).T
        return self._error[used] * scale, J


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


def _apply_step(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    t_new = t + step[3:] @ _tangent_basis(t)
    return rotation_from_vector(step[:3]) @ R, t_new / np.linalg.norm(t_new)
