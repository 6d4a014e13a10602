"""Two views through a fisheye of 170 degrees, with matches up to the rim."""

from __future__ import annotations

import cv2
import numpy as np

from mgca_filter import Fisheye

K = np.array([[300.0, 0.0, 511.5], [0.0, 300.0, 511.5], [0.0, 0.0, 1.0]])
LENS = Fisheye(-0.02, 0.004, -0.001, 0.0002)
R, T = cv2.Rodrigues(np.array([0.05, 0.2, -0.1]))[0], np.array([1.0, 0.1, 0.3])
RINGS = ((0, 40), (40, 60), (60, 70), (70, 85))


def two_views(count: int = 900, wrong: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2) of two fisheye views of 170 degrees, the angles off the first axis (N,), and which are right."""
    rng = np.random.default_rng(0)
    theta, phi = np.radians(85) * np.sqrt(rng.random(4 * count)), rng.uniform(0, 6.28, 4 * count)
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    X = rays * rng.uniform(4, 12, (4 * count, 1))
    front = np.flatnonzero((X @ R.T + T)[:, 2] > 0.3)[:count]
    X = X[front]
    lens, zero = np.array([LENS.k1, LENS.k2, LENS.k3, LENS.k4]), np.zeros(3)
    p, q = (
        cv2.fisheye.projectPoints(Z[:, None], zero, zero, K, lens)[0][:, 0] + rng.normal(0, 0.3, (count, 2))
        for Z in (X, X @ R.T + T)
    )
    q[:wrong] = q[rng.permutation(wrong)]
    return p, q, np.degrees(theta[front]), np.arange(count) >= wrong


P, Q, ANGLE, RIGHT = two_views()


def recalls(mask: np.ndarray) -> list[float]:
    """Share of the right matches that a mask keeps, ring by ring from the middle to the rim."""
    return [float(mask[RIGHT & (low <= ANGLE) & (high > ANGLE)].mean()) for low, high in RINGS]
