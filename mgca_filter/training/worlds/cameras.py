"""Random views of a world: where cameras stand, what they look at, how far they zoom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.epipolar import homogeneous
from ..augmentation import rotation_matrix
from .world import World

FloatArray = NDArray[np.float64]

LONG_SIDE_PX = (640, 800)
ASPECTS = (4 / 3, 3 / 2, 16 / 9)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera, X_camera = R X + t; ``size`` = width, height in pixels, the first pixel's centre at (0, 0)."""

    K: FloatArray
    R: FloatArray
    t: FloatArray
    size: tuple[int, int]

    def rays(self, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) → directions (N, 3) in the camera frame with z = 1."""
        return homogeneous(points) @ np.linalg.inv(self.K).T

    def project(self, X: FloatArray) -> tuple[FloatArray, FloatArray]:
        """World points (N, 3) → pixels (N, 2) and depths (N,); pixels mean something where the depth is positive."""
        p = (X @ self.R.T + self.t) @ self.K.T
        depth = p[:, 2]
        return p[:, :2] / np.where(np.abs(depth) > 1e-12, depth, 1e-12)[:, None], depth

    def shrunk(self, factor: float) -> Camera:
        """The same view in fewer pixels."""
        S = np.array([[factor, 0, 0.5 * factor - 0.5], [0, factor, 0.5 * factor - 0.5], [0, 0, 1]])
        width, height = (max(1, round(side * factor)) for side in self.size)
        return Camera(S @ self.K, self.R, self.t, (width, height))


def draw_camera(rng: np.random.Generator, world: World, first: Camera | None = None) -> Camera:
    """The first view of a world, or a further one: moved round the target by a random angle, zoomed, rolled."""
    size = _draw_size(rng) if first is None or rng.random() < 0.3 else first.size
    if first is None:
        focal = max(size) * np.exp(rng.normal(np.log(0.95), 0.22))
        centre = rng.normal(0.0, 0.03, 3) * world.distance
    else:
        focal = first.K[0, 0] * max(size) / max(first.size) * np.exp(rng.normal(0.0, 0.18))
        centre = _moved(rng, world, -first.R.T @ first.t)
    target = world.target + rng.normal(0.0, 0.12, 3) * world.distance
    roll = rng.uniform(-180.0, 180.0) if rng.random() < 0.06 else rng.normal(0.0, 5.0)
    R = rotation_matrix(2, np.radians(roll)) @ _looking_along(target - centre)
    offset = rng.normal(0.0, 0.01, 2) * max(size)
    K = np.array([[focal, 0, (size[0] - 1) / 2 + offset[0]], [0, focal, (size[1] - 1) / 2 + offset[1]], [0, 0, 1]])
    return Camera(K, R, -R @ centre, size)


def _draw_size(rng: np.random.Generator) -> tuple[int, int]:
    long = int(rng.integers(LONG_SIDE_PX[0], LONG_SIDE_PX[1] + 1))
    short = round(long / float(rng.choice(ASPECTS)))
    return (short, long) if rng.random() < 0.2 else (long, short)


def _moved(rng: np.random.Generator, world: World, centre: FloatArray) -> FloatArray:
    """The camera's centre turned about the target, and nearer or farther."""
    arm = centre - world.target
    turn = np.radians(np.clip(np.exp(rng.normal(np.log(24.0), 0.8)), 1.0, 80.0)) * rng.choice([-1.0, 1.0])
    rise = np.radians(rng.normal(0.0, 6.0))
    arm = rotation_matrix(1, turn) @ rotation_matrix(0, rise) @ arm
    near_to_far = np.exp(rng.normal(0.0, 0.28))
    moved: FloatArray = world.target + arm * (min(near_to_far, 1.05) if world.enclosed else near_to_far)
    return moved


def _looking_along(direction: FloatArray) -> FloatArray:
    """Rotation (3, 3) world → camera with the optical axis along ``direction`` and x level."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0], z)
    x = x / np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])
