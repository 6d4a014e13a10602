"""Homographies ``p2 ~ H p1``: distances, scale, local frames, least squares on all matches, and the poses that a plane
allows.

The *side* of a point is the sign of its third coordinate after the map. A plane that a camera sees lies on one side
of the horizon: a homography that puts matches on both sides of it folds the image and is none of a real plane.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .epipolar import homogeneous
from .least_squares import promises

Array = NDArray[np.float64]

_TINY = np.finfo(np.float64).tiny
_INITIAL_DAMPING = 1e-6
_MAX_DAMPING = 1e3
_CONVERGED_DECREASE = 1e-9


def poses_from_homography(H: Array) -> list[tuple[Array, Array]]:
    """Relative poses R (3, 3), t (3,) unit norm under which a plane induces ``H`` between normalised points.

    Up to four (Malis & Vargas 2007); none where H is a rotation.
    """
    try:
        _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    except cv2.error:
        return []
    poses = []
    for R, t in zip(rotations, translations):
        norm = float(np.linalg.norm(t))
        if np.isfinite(R).all() and np.isfinite(norm) and norm > 1e-9:
            poses.append((np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel() / norm))
    return poses


def homography_distance(points1: Array, points2: Array, H: Array) -> Array:
    """Distance (N,) of matches to a homography ``p2 ~ H p1``, in the unit of the points.

    Half the root of the summed squared transfer errors in both directions: like Sampson's, it splits the error
    between the two images. Infinite where a point maps to infinity.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        forward = transfer(points1, H) - points2
        backward = transfer(points2, np.asarray(np.linalg.pinv(H), dtype=np.float64)) - points1
        distance = 0.5 * np.sqrt(np.sum(forward**2, axis=1) + np.sum(backward**2, axis=1))
    return np.where(np.isfinite(distance), distance, np.inf)


def transfer(points: Array, H: Array) -> Array:
    """Where ``H`` (3, 3) maps points (N, 2); not finite on the line that goes to infinity."""
    mapped = homogeneous(points) @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        transferred: Array = mapped[:, :2] / mapped[:, 2:]
    return transferred


def sampson_distance_to_homography(correspondences: Array, H: Array) -> Array:
    """First-order distance (N,) of matches (N, 4) to the nearest pair that ``H`` maps exactly, in their unit.

    The root of ``eᵀ (J Jᵀ)⁻¹ e`` with the two algebraic errors e and their derivatives J by the four coordinates
    (Hartley & Zisserman, 2nd ed., sec. 4.2.6; Chum, Pajdla & Sturm 2005). An error of d pixels in one image under a
    pure translation is a distance of d / √2. Infinite for matches on the other side of the horizon than most of
    those that agree, see the module; all infinite where H is not finite.
    """
    if not np.isfinite(H).all():
        return np.full(len(correspondences), np.inf)
    H = facing(correspondences, H)
    return np.sqrt(HomographyResiduals(correspondences, H, np.inf, np.ones(len(correspondences))).squared)


def facing(correspondences: Array, H: Array) -> Array:
    """``H`` of unit norm and of the sign that puts the matches (N, 4) that agree best on the positive side."""
    H = H / max(float(np.linalg.norm(H)), _TINY)
    if len(correspondences) == 0:
        return H
    w = homogeneous(correspondences[:, :2]) @ H[2]
    with np.errstate(all="ignore"):
        squared = np.sum((transfer(correspondences[:, :2], H) - correspondences[:, 2:]) ** 2, axis=1)
        size = float(np.max(np.abs(correspondences[np.isfinite(correspondences)]), initial=_TINY))
        votes = np.sign(w) / (squared + (1e-9 * size) ** 2)
    return -H if np.sum(votes[np.isfinite(votes)]) < 0 else H


def local_frames(points: Array, H: Array) -> Array:
    """Derivatives (N, 2, 2) of the map ``H`` at points (N, 2): how it turns, stretches and mirrors what is near."""
    mapped = homogeneous(points) @ H.T
    w = mapped[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        image = mapped[:, :2] / w[:, None]
        frames: Array = (H[None, :2, :2] - image[:, :, None] * H[None, 2:, :2]) / w[:, None, None]
    return frames


def scaled_homography(H: Array) -> Array:
    """OpenCV's scale, H[2, 2] = 1; unit Frobenius norm where the origin maps to infinity."""
    H = H / np.linalg.norm(H)
    return H / H[2, 2] if abs(H[2, 2]) > 1e-12 else H


class HomographyResiduals:
    """What a homography leaves of matches (N, 4), and how that changes with its entries.

    Attributes:
        H: (3, 3) of the sign under which the matches are on the positive side.
        squared: (N,) squared Sampson distances, infinite on the other side.
        near: (N,) within the threshold.
        cost: weighted sum of the squared distances, each cut off at the threshold.
    """

    def __init__(self, correspondences: Array, H: Array, threshold: float, weights: Array) -> None:
        self.H = H
        self._points, self._weights = correspondences, weights
        x1, y1, x2, y2 = correspondences.T
        u, v, w = (H[i, 0] * x1 + H[i, 1] * y1 + H[i, 2] for i in range(3))
        self._error1, self._error2 = x2 * w - u, y2 * w - v
        # J Jᵀ = [[a, b], [b, c]] of the two errors by x1, y1, x2, y2.
        j11, j12 = x2 * H[2, 0] - H[0, 0], x2 * H[2, 1] - H[0, 1]
        j21, j22 = y2 * H[2, 0] - H[1, 0], y2 * H[2, 1] - H[1, 1]
        a = np.maximum(j11**2 + j12**2 + w**2, _TINY)
        b = j11 * j21 + j12 * j22
        c = j21**2 + j22**2 + w**2
        # Its Cholesky factor whitens errors and derivatives.
        self._l11 = np.sqrt(a)
        self._l21 = b / self._l11
        self._l22 = np.sqrt(np.maximum(c - self._l21**2, _TINY))
        self._r1 = self._error1 / self._l11
        self._r2 = (self._error2 - self._l21 * self._r1) / self._l22
        squared = self._r1**2 + self._r2**2
        self.squared = np.where((w > 0) & np.isfinite(squared), squared, np.inf)
        self.near = self.squared < threshold**2
        self.cost = float(weights @ np.minimum(self.squared, threshold**2)) if np.isfinite(threshold) else np.nan

    def normal_equations(self, directions: Array) -> tuple[Array, Array]:
        """Hessian (P, P) and gradient (P,) of half the cost along ``directions`` (9, P), J Jᵀ held fixed."""
        near, weight = self.near, np.sqrt(self._weights[self.near])
        x2, y2 = self._points[near, 2], self._points[near, 3]
        p = homogeneous(self._points[near, :2])
        zero = np.zeros_like(p)
        first = np.hstack([-p, zero, x2[:, None] * p]) / self._l11[near, None]
        second = (np.hstack([zero, -p, y2[:, None] * p]) - self._l21[near, None] * first) / self._l22[near, None]
        jacobian = np.vstack([first * weight[:, None], second * weight[:, None]]) @ directions
        residuals = np.concatenate([self._r1[near] * weight, self._r2[near] * weight])
        return jacobian.T @ jacobian, jacobian.T @ residuals


PROJECTIVE_FREEDOM, AFFINE_FREEDOM, SIMILARITY_FREEDOM = 8, 6, 4
_AFFINE_DIRECTIONS: Array = np.eye(9)[:, :6]
# Along the real and the imaginary part of the turn, then along both coordinates of the shift.
_SIMILARITY_DIRECTIONS: Array = np.zeros((9, 4))
_SIMILARITY_DIRECTIONS[[0, 4, 1, 3, 2, 5], [0, 0, 1, 1, 2, 3]] = [1, 1, -1, 1, 1, 1]


def _directions(H: Array, freedom: int) -> Array:
    """Directions (9, P) in which the entries of ``H`` may move."""
    if freedom == AFFINE_FREEDOM:
        return _AFFINE_DIRECTIONS
    if freedom == SIMILARITY_FREEDOM:
        return _SIMILARITY_DIRECTIONS
    h = H.ravel() / np.linalg.norm(H)
    # The Householder reflection that takes h to an axis: its other rows are orthogonal to h.
    axis = int(np.argmax(np.abs(h)))
    v = h.copy()
    v[axis] += np.copysign(1.0, h[axis])
    reflection = np.eye(9) - 2.0 * np.outer(v, v) / (v @ v)
    return np.asarray(np.delete(reflection, axis, axis=1), dtype=np.float64)


def refine_homography(
    correspondences: Array,
    H: Array,
    threshold: float,
    weights: Array | None = None,
    rounds: int = 10,
    freedom: int = PROJECTIVE_FREEDOM,
) -> Array:
    """Levenberg–Marquardt on the truncated Sampson error; the matches within are chosen anew in every round.

    Args:
        correspondences: (N, 4), finite, best centred and of unit size.
        H: (3, 3), its sign such that the right matches are on the positive side (:func:`facing`).
        threshold: Sampson distance where the error is cut off, in the unit of the points.
        weights: (N,) what each match counts; None = all alike.
        rounds: largest number of steps.
        freedom: 8 = homography, 6 = affine map, 4 = similarity; ``H`` must be one, with H[2, 2] = 1 if it is not 8.

    Returns:
        The refined matrix (3, 3); its truncated cost is never above the one it started from.
    """
    weights = np.ones(len(correspondences)) if weights is None else weights
    now = HomographyResiduals(correspondences, H, threshold, weights)
    damping = _INITIAL_DAMPING
    for _ in range(rounds):
        if 2 * np.count_nonzero(now.near) < freedom:
            break
        directions = _directions(now.H, freedom)
        hessian, gradient = now.normal_equations(directions)
        diagonal = np.diag(np.diag(hessian) + 1e-12 * max(float(np.trace(hessian)), _TINY))
        previous = now.cost
        worthless = _CONVERGED_DECREASE * float(weights[now.near] @ now.squared[now.near])
        while damping < _MAX_DAMPING:
            try:
                step = np.asarray(np.linalg.solve(hessian + damping * diagonal, -gradient), dtype=np.float64)
            except np.linalg.LinAlgError:
                damping *= 10.0
                continue
            if not promises(hessian, gradient, step, worthless):
                return now.H
            new_H = now.H + (directions @ step).reshape(3, 3)
            if freedom == PROJECTIVE_FREEDOM:
                new_H = new_H / np.linalg.norm(new_H)
            new = HomographyResiduals(correspondences, new_H, threshold, weights)
            if new.cost < now.cost:
                now = new
                damping = max(0.1 * damping, 1e-12)
                break
            damping *= 10.0
        if now.cost >= (1.0 - _CONVERGED_DECREASE) * previous:
            break
    return now.H
