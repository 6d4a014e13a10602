"""Two focal lengths, one an image, where the matches say that they differ: a zoom, or photographs of two cameras.

A fundamental matrix determines both, unless the viewing axes meet (Hartley & Zisserman, 2nd ed., sec. 19.3; Sturm,
2001). Pose and focal lengths are refined together, with a little belief in usual lenses, from what a shared focal
length gives; two are believed where they leave markedly less of the matches than one does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import cross_matrix, homogeneous_columns
from ..geometry.least_squares import promises
from ..geometry.pose_refinement import apply_step

Array = NDArray[np.float64]

# Real matches are far from independent, and cameras no perfect pinholes: a squared error weighs this much less.
TEMPER = 9.0
# Two focal lengths are believed where they lower the tempered sum of squares, with what they cost in belief, by this.
MIN_GAIN = 6.0
# Nearer to each other than this they are those of one camera, whose lens bends lines a little.
MIN_LOG_RATIO = 0.15
# And so many standard deviations apart: on a plane, say, a zoom cannot be told from a move.
MIN_RATIO_SIGMAS = 2.0
# Zooms between the images that refinement starts from, beside that of the shared focal length.
_ZOOMS = (0.4, 0.63, 1.6, 2.5)
_ROUNDS = 25
# Without any damping few matches leave a matrix that has no inverse.
_LEAST_DAMPING, _MAX_DAMPING, _CONVERGED_DECREASE = 1e-9, 1e4, 1e-5
_DIFFERENCE = 1e-6
_LARGEST_STEP = 0.3
_LARGEST_LOG = 2.3
# What makes of the curvature standard deviations that two thirds of the training pairs keep.
_SIGMA_FACTOR = 1.4


@dataclass(frozen=True)
class FocalBelief:
    """Where cameras lie from the guessed focal length, in its logarithm: mean and standard deviation."""

    mean: float
    spread: float


@dataclass(frozen=True)
class TwoFocals:
    """Pose and focal lengths of both images.

    Attributes:
        R, t: (3, 3) and (3,) unit norm.
        logs: (2,) logarithms of the factors on the guessed focal lengths.
        sigmas: (2,) their standard deviations.
        ratio_sigma: standard deviation of the logarithm of their ratio, which is often known much better.
        cost: tempered sum of squares, with the belief's share.
    """

    R: Array
    t: Array
    logs: Array
    sigmas: Array
    ratio_sigma: float
    cost: float

    @property
    def log_ratio(self) -> float:
        """Logarithm of the factor of image 2 over that of image 1."""
        return float(self.logs[1] - self.logs[0])


class FocalPairFit:
    """Least squares on a pose and two focal lengths.

    Args:
        rows: (N, 4) matches on the image planes normalised by the guessed focal lengths.
        threshold: Sampson distance where the error is cut off, in that unit.
        noise: standard deviation of the distances, likewise.
        belief: in usual lenses.
    """

    def __init__(self, rows: Array, threshold: float, noise: float, belief: FocalBelief) -> None:
        self._x1, self._x2 = homogeneous_columns(rows[:, :2]), homogeneous_columns(rows[:, 2:])  # (3, N)
        self._threshold, self._belief = threshold, belief
        self._scale = 1.0 / (TEMPER * noise**2)

    def differing(self, R: Array, t: Array, log_factor: float) -> tuple[TwoFocals | None, float]:
        """The best with two focal lengths, or None where one does about as well.

        Args:
            R, t, log_factor: pose and logarithm of the factor on both guesses that suit the matches best.

        Returns:
            The best, and how surely one does as well: the standard deviation of the logarithm of the ratio about it.
        """
        shared = np.array([log_factor, log_factor])
        before = self._cost(self._distances(R, t, shared), shared)
        beside = found = self._refined(R, t, shared)
        for zoom in _ZOOMS:
            half = 0.5 * np.log(zoom)
            other = self._refined(R, t, shared + np.array([-half, half]))
            if other.cost < found.cost:
                found = other
        if before - found.cost < MIN_GAIN:
            return None, beside.ratio_sigma
        apart = abs(found.log_ratio) > max(MIN_LOG_RATIO, MIN_RATIO_SIGMAS * found.ratio_sigma)
        return found if apart else None, beside.ratio_sigma

    def pose_derivative(self, R: Array, t: Array) -> Array:
        """How the best pose moves with the logarithms of both focal lengths, (5, 2): turns and moves of t, radians.

        Args:
            R, t: the pose that suits the matches best under the guessed focal lengths.
        """
        logs = np.zeros(2)
        jacobian = self._jacobian(R, t, logs, self._distances(R, t, logs))
        pose, focals = jacobian[:, :5], jacobian[:, 5:]
        hessian = pose.T @ pose
        damping = 1e-9 * float(np.trace(hessian)) * np.eye(5) + 1e-12 * np.eye(5)
        return -np.asarray(np.linalg.solve(hessian + damping, pose.T @ focals), dtype=np.float64)

    def _refined(self, R: Array, t: Array, logs: Array) -> TwoFocals:
        """Levenberg–Marquardt from a start."""
        distance = self._distances(R, t, logs)
        cost, damping = self._cost(distance, logs), 1e-3
        for _ in range(_ROUNDS):
            hessian, gradient = self._normal_equations(R, t, logs, distance)
            previous = cost
            enough = _CONVERGED_DECREASE * max(previous, 1.0)
            while damping < _MAX_DAMPING:
                damped = hessian + damping * np.diag(np.diag(hessian) + 1e-9)
                step: Array = -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
                step = step * min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-12))
                if not promises(hessian, gradient, step, enough):
                    break
                moved = _moved(R, t, logs, step)
                new_distance = self._distances(*moved)
                new_cost = self._cost(new_distance, moved[2])
                if new_cost < cost:
                    (R, t, logs), distance, cost = moved, new_distance, new_cost
                    damping = max(0.1 * damping, _LEAST_DAMPING)
                    break
                damping *= 10.0
            if cost > previous - enough:
                break
        hessian, _ = self._normal_equations(R, t, logs, distance)
        floor = 1e-9 + 1e-12 * float(np.trace(hessian))
        covariance = np.linalg.inv(hessian + floor * np.eye(7))[5:, 5:]
        directions = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 1.0]])
        variances = np.einsum("ij,jk,ik->i", directions, covariance, directions)
        sigmas = _SIGMA_FACTOR * np.sqrt(np.maximum(variances, 0.0))
        return TwoFocals(R, t, logs, sigmas[:2], float(sigmas[2]), cost)

    def _distances(self, R: Array, t: Array, logs: Array) -> Array:
        """Signed Sampson distances (N,) in the unit of the guessed focal lengths, whatever the factors.

        Next to zero a distance without sign has no derivative.
        """
        return np.asarray(self._distances_to(_matrix_under(R, t, logs)[None])[0])

    def _distances_to(self, M: Array) -> Array:
        """The same (K, N) of matrices (K, 3, 3), x2^T M x1 = 0."""
        lines2, normals1 = M @ self._x1, M.transpose(0, 2, 1)[:, :2] @ self._x2  # (K, 3, N), (K, 2, N)
        squared_norm = np.einsum("kin,kin->kn", lines2[:, :2], lines2[:, :2])
        squared_norm += np.einsum("kin,kin->kn", normals1, normals1)
        error = np.einsum("in,kin->kn", self._x2, lines2)
        return np.asarray(error / np.sqrt(np.maximum(squared_norm, np.finfo(np.float64).tiny)))

    def _cost(self, distance: Array, logs: Array) -> float:
        if np.abs(logs).max() > _LARGEST_LOG or not np.isfinite(distance).all():
            return float("inf")
        errors = float(np.minimum(distance**2, self._threshold**2).sum())
        belief = float(np.sum(((logs - self._belief.mean) / self._belief.spread) ** 2))
        return self._scale * errors + belief

    def _normal_equations(self, R: Array, t: Array, logs: Array, distance: Array) -> tuple[Array, Array]:
        """Hessian (7, 7) and gradient (7,) over turns, moves of t and logarithms."""
        jacobian = self._jacobian(R, t, logs, distance)
        hessian = self._scale * (jacobian.T @ jacobian)
        gradient = self._scale * (jacobian.T @ distance[np.abs(distance) < self._threshold])
        hessian[[5, 6], [5, 6]] += 1.0 / self._belief.spread**2
        gradient[5:] += (logs - self._belief.mean) / self._belief.spread**2
        return hessian, gradient

    def _jacobian(self, R: Array, t: Array, logs: Array, distance: Array) -> Array:
        """Derivatives (K, 7) of the distances within the threshold."""
        moved = np.stack([_matrix_under(*_moved(R, t, logs, _DIFFERENCE * unit)) for unit in np.eye(7)])
        derivatives = (self._distances_to(moved) - distance) / _DIFFERENCE
        return np.asarray(derivatives[:, np.abs(distance) < self._threshold].T)


def _matrix_under(R: Array, t: Array, logs: Array) -> Array:
    """(3, 3) for the image planes of the guessed focal lengths, x2^T M x1 = 0, of a pose under other ones."""
    shrink1, shrink2 = (np.diag([np.exp(-log), np.exp(-log), 1.0]) for log in logs)
    M: Array = shrink2 @ cross_matrix(t) @ R @ shrink1
    return M


def _moved(R: Array, t: Array, logs: Array, step: Array) -> tuple[Array, Array, Array]:
    """Pose and logarithms after a step (7,)."""
    return *apply_step(R, t, step[:5]), logs + step[5:]
