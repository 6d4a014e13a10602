"""Least squares on the pose: Levenberg–Marquardt on a robust cost of the Sampson errors of all matches.

The pose has five degrees of freedom: a rotation vector applied on the left of R and two steps of the unit
translation on its tangent plane (PoseLib and Hartley & Zisserman, 2nd ed., sec. 11.4.3, do the same).
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from .epipolar import cross_matrices, cross_matrix, homogeneous_columns
from .least_squares import promises
from .matrix_product import product

Array = NDArray[np.float64]
# Cost of residuals (N,), and by how much each counts in the squares that stand for it near by, (N,).
Loss = Callable[[Array], tuple[float, Array]]

_INITIAL_DAMPING = 1e-4
# Steps so short that they need more damping than this no longer pay.
_MAX_DAMPING = 1.0
_SMALLEST_CURVATURE = 1e-12
_CONVERGED_DECREASE, _FINELY_CONVERGED_DECREASE = 1e-4, 1e-5
MIN_INLIERS = 6
# Below this the cost of directions is a paraboloid around the best. Rings and spokes that others are tried on.
_LINEAR_DEG, _RINGS, _SPOKES, _SPREAD_ROWS = 0.1, 28, 12, 200
# What small turns about the axes make of a vector: its products with them.
_TURNS = cross_matrices(np.eye(3))
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
    terms = SampsonTerms(*_columns(correspondences), R, t)
    reached = np.abs(terms.residual) < REACH * threshold
    if np.count_nonzero(reached) < MIN_INLIERS:
        return R, t
    return _minimise(terms.take(reached), lambda r: _truncated(r, threshold), rounds, _CONVERGED_DECREASE)


def refine_pose_by_weights(
    correspondences: Array, R: Array, t: Array, scale: Array, weights: Array, reach: float, rounds: int = 15
) -> tuple[Array, Array]:
    """Refine a relative pose by a Cauchy loss: a match counts the less, the farther off it is in terms of its noise.

    Args:
        correspondences: (N, 4) on the normalised image planes, finite.
        R, t: (3, 3) and (3,) unit norm, ``X2 = R X1 + t``.
        scale: (N,) Sampson distance at which a match counts half, normalised.
        weights: (N,) what a match counts beside its noise, above 0.
        reach: Sampson distance beyond which matches are left out, normalised.
        rounds: largest number of steps.

    Returns:
        The refined R, t; its cost is never above the one it started from.
    """
    terms = SampsonTerms(*_columns(correspondences), R, t)
    reached = np.abs(terms.residual) < reach
    if np.count_nonzero(reached) < MIN_INLIERS:
        return R, t
    scale, weights = scale[reached], weights[reached]
    of_squares = weights / scale**2
    largest = of_squares.max()
    of_costs, of_squares = weights / largest, of_squares / largest

    def cauchy(residual: Array) -> tuple[float, Array]:
        relative = (residual / scale) ** 2
        return float((of_costs * np.log1p(relative)).sum()), of_squares / (1.0 + relative)

    return _minimise(terms.take(reached), cauchy, rounds, _FINELY_CONVERGED_DECREASE)


def _minimise(start: SampsonTerms, loss: Loss, rounds: int, converged: float) -> tuple[Array, Array]:
    """R, t of the least cost after so many steps; one that gains less than a share ``converged`` is the last."""
    now = start
    cost, weights = loss(now.residual)
    damping = _INITIAL_DAMPING
    for _ in range(rounds):
        if np.count_nonzero(weights) < MIN_INLIERS:
            break
        derivatives = now.derivatives()
        J = derivatives * weights
        hessian, gradient = J @ derivatives.T, J @ now.residual
        diagonal = np.diag(np.diag(hessian) + _SMALLEST_CURVATURE)
        previous = cost
        while damping < _MAX_DAMPING:
            step = -np.asarray(np.linalg.solve(hessian + damping * diagonal, gradient), dtype=np.float64)
            if not promises(hessian, gradient, step, converged * cost):
                return now.R, now.t
            new = now.moved(step)
            new_cost, new_weights = loss(new.residual)
            if new_cost < cost:
                now, cost, weights = new, new_cost, new_weights
                damping *= 0.1
                break
            damping *= 10.0
        if cost > (1.0 - converged) * previous:
            break
    return now.R, now.t


def truncated_cost(correspondences: Array, R: Array, t: Array, threshold: float) -> float:
    """Sum of squared Sampson distances, each cut off at ``threshold``: what MSAC minimises."""
    return _truncated(SampsonTerms(*_columns(correspondences), R, t).residual, threshold)[0]


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
    J = SampsonTerms(*_columns(inliers), R, t).derivatives()
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
    J = SampsonTerms(*_columns(inliers), R, t).derivatives()
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
    offsets = across[spoke] @ tangent_basis(t)
    directions = np.cos(angle[ring])[:, None] * t + np.sin(angle[ring])[:, None] * offsets  # (D, 3)
    costs = costs_of_directions(rows, R, np.vstack([t, directions]))
    costs = step * (costs[1:] - costs[0])
    log_weights = -0.5 * costs / noise**2 + np.log(np.sin(angle[ring]) * width[ring])
    weights = np.exp(log_weights - log_weights.max())
    moved = angle[ring][:, None] * across[spoke]
    moments = (weights[:, None] * moved).T @ moved / weights.sum()
    return float(min(np.degrees(np.sqrt(np.linalg.eigvalsh(moments)[1])), 90.0))


def costs_of_directions(rows: Array, R: Array, directions: Array) -> Array:
    """Summed squared Sampson distances (D,) of matches (N, 4) to poses with directions (D, 3), the rotation moved from
    R as each likes best, to first order.

    Of a direction d the error is d · (r × x2), its derivative by the rotation A d with A = x2 rᵀ - (r · x2) I, and the
    squared norm of the line normals a quadratic form of d: all are sums of a few products of d with what the matches
    tell, so that products of matrices give them for all directions and matches at once.
    """
    x1, x2 = homogeneous_columns(rows[:, :2]), homogeneous_columns(rows[:, 2:])
    rays = R @ x1  # (3, N), in the second camera
    # Line normals in image 2, then in image 1, of unit directions: rows 0 and 1 of d × r and of Rᵀ (x2 × d).
    normals = np.concatenate([(_TURNS @ rays)[:, :2], R.T[:2] @ -(_TURNS @ x2)], axis=1)  # (3, 4, N)
    forms = np.einsum("jkn,lkn->jln", normals, normals).reshape(9, -1)
    squares = np.einsum("dj,dl->djl", directions, directions).reshape(-1, 9)  # (D, 9)
    weight = 1.0 / np.maximum(product(squares, forms), np.finfo(np.float64).tiny)  # (D, N)
    error = directions @ _cross(rays, x2)
    A = x2[:, None] * rays[None] - np.sum(rays * x2, axis=0) * np.eye(3)[..., None]  # (3, 3, N)
    pairs = np.einsum("jln,kmn->jklmn", A, A).reshape(81, -1)
    gradient = np.einsum("djl,dl->dj", product(weight * error, A.reshape(9, -1).T).reshape(-1, 3, 3), directions)
    hessian = np.einsum("djkl,dl->djk", product(weight, pairs.T).reshape(-1, 3, 3, 9), squares)
    hessian += _SMALLEST_CURVATURE * np.eye(3)
    gain = np.einsum("dk,dk->d", gradient, np.linalg.solve(hessian, gradient[..., None])[..., 0])
    return np.asarray(np.einsum("dn,dn->d", weight * error, error) - gain, dtype=np.float64)


class SampsonTerms:
    """Sampson distances of matches to a pose, and how they change with it.

    Args:
        x1, x2: (3, N) on the normalised image planes, with a row of ones.
        R, t: the pose.

    Attributes:
        R, t: as given.
        residual: (N,) signed Sampson distances, normalised.
    """

    def __init__(self, x1: Array, x2: Array, R: Array, t: Array) -> None:
        self.R, self.t = R, t
        self._x1, self._x2 = x1, x2
        E = cross_matrix(t) @ R
        line2 = E @ x1  # (3, N)
        normals = np.concatenate([line2[:2], E.T[:2] @ x2])  # (4, N), of the lines in image 2, then in image 1
        squared_norm = np.einsum("in,in->n", normals, normals)
        self._scale = 1.0 / np.sqrt(np.maximum(squared_norm, np.finfo(np.float64).tiny))
        self.residual = np.einsum("in,in->n", line2, x2) * self._scale

    def take(self, rows: NDArray[np.bool_]) -> SampsonTerms:
        """Those of a selection (N,) of the matches."""
        return self if rows.all() else SampsonTerms(self._x1[:, rows], self._x2[:, rows], self.R, self.t)

    def moved(self, step: Array) -> SampsonTerms:
        """Those of the pose after a step (5,)."""
        return SampsonTerms(self._x1, self._x2, *apply_step(self.R, self.t, step))

    def derivatives(self) -> Array:
        """Derivatives (5, N) of the residuals by a rotation on the left of R and two steps of t, normals held fixed."""
        T = cross_matrix(self.t)
        across = (tangent_basis(self.t) @ _TURNS.reshape(3, 9)).reshape(2, 3, 3)
        of_E = np.concatenate([T @ _TURNS, across]) @ self.R  # (5, 3, 3)
        return np.asarray(np.einsum("kin,in->kn", of_E @ self._x1, self._x2 * self._scale))


def _columns(correspondences: Array) -> tuple[Array, Array]:
    """Points of both images (3, N), (3, N) of matches (N, 4)."""
    return homogeneous_columns(correspondences[:, :2]), homogeneous_columns(correspondences[:, 2:])


def _cross(a: Array, b: Array) -> Array:
    """Vector products (3, N) of columns: ``np.cross`` takes several times as long."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _truncated(residual: Array, threshold: float) -> tuple[float, Array]:
    """Sum of the squares, cut off at the threshold; what lies within it (N,) counts 1, the rest 0."""
    squared = residual * residual
    return float(np.minimum(squared, threshold**2).sum()), (squared < threshold**2).astype(np.float64)


def tangent_basis(t: Array) -> Array:
    """Two unit vectors (2, 3) orthogonal to ``t``."""
    x, y, z = t.tolist()
    sizes = [abs(x), abs(y), abs(z)]
    # Its product with the axis that it is farthest from, then with that. In plain floats: arrays of three are slow.
    a, b, c = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[sizes.index(min(sizes))]
    norm = hypot(a, b, c)
    a, b, c = a / norm, b / norm, c / norm
    return np.array([[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a]])


def rotation_from_vector(vector: Array) -> Array:
    """Rotation (3, 3) about ``vector`` (3,) by its length in radians (Rodrigues)."""
    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)


def apply_step(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    """The pose after a step (5,): a rotation vector on the left of R, then two moves across ``t``."""
    moved = t + step[3:] @ tangent_basis(t)
    return rotation_from_vector(step[:3]) @ R, moved / sqrt(moved @ moved)


def apply_steps(R: Array, t: Array, steps: Array) -> tuple[Array, Array]:
    """The poses R (S, 3, 3), t (S, 3) after each of some steps (S, 5) alone; see :func:`apply_step`."""
    angle = np.sqrt(np.einsum("si,si->s", steps[:, :3], steps[:, :3]))
    axis = steps[:, :3] / np.maximum(angle, np.finfo(np.float64).tiny)[:, None]
    K = cross_matrices(axis)
    turns = np.eye(3) + np.sin(angle)[:, None, None] * K + (1.0 - np.cos(angle))[:, None, None] * (K @ K)
    moved = t + steps[:, 3:] @ tangent_basis(t)
    return turns @ R, moved / np.linalg.norm(moved, axis=1, keepdims=True)
