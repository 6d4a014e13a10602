"""Random piecewise-planar scenes: ground, facades, rooms and boxes, as textured parallelograms.

World frame: x to the right, y down, z away from the first camera; lengths in metres, though nothing depends on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..augmentation import rotation_matrix

FloatArray = NDArray[np.float64]

KINDS = ("facade", "room", "objects", "facets")
REPEAT_PROBABILITY = 0.15  # of a wall whose patches all show the same picture, as windows do
BACKDROP_M = 60.0


@dataclass(frozen=True)
class Face:
    """Parallelogram ``origin + a u + b v`` with a, b in [0, 1], and the seed of the picture on it."""

    origin: FloatArray
    u: FloatArray
    v: FloatArray
    texture: int

    def corners(self) -> FloatArray:
        """(4, 3), in order round the face."""
        return np.array([self.origin, self.origin + self.u, self.origin + self.u + self.v, self.origin + self.v])


@dataclass(frozen=True)
class World:
    """Faces, the point that cameras look at, and the distance from which the first of them does."""

    kind: str
    faces: tuple[Face, ...]
    target: FloatArray
    distance: float
    enclosed: bool  # cameras must stay between the target and where the first one stands


def draw_world(rng: np.random.Generator) -> World:
    """A scene of one of the :data:`KINDS`; some face lies behind every pixel."""
    kind = str(rng.choice(KINDS))
    faces, target, distance = {"facade": _facade, "room": _room, "objects": _objects, "facets": _facets}[kind](rng)
    faces = faces + _hollow_box(rng, target, np.full(3, 2.0 * BACKDROP_M), BACKDROP_M / 2)
    return World(kind, tuple(faces), target, distance, enclosed=kind == "room")


def split_face(rng: np.random.Generator, origin: ArrayLike, u: ArrayLike, v: ArrayLike, patch: float) -> list[Face]:
    """A large parallelogram as patches of about ``patch`` metres, each with its own picture, or all with one."""
    origin, u, v = (np.asarray(a, dtype=np.float64) for a in (origin, u, v))
    columns, rows = (max(1, round(float(np.linalg.norm(side)) / patch)) for side in (u, v))
    repeated = int(rng.integers(2**31)) if rng.random() < REPEAT_PROBABILITY else None
    return [
        Face(
            origin + (i / columns) * u + (j / rows) * v,
            u / columns,
            v / rows,
            int(rng.integers(2**31)) if repeated is None else repeated,
        )
        for i in range(columns)
        for j in range(rows)
    ]


def _box(rng: np.random.Generator, centre: ArrayLike, size: ArrayLike, R: FloatArray, patch: float) -> list[Face]:
    """The six sides of a box with edges ``size`` turned by R."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    axes = R * half  # columns: half edges
    faces: list[Face] = []
    for k in range(3):
        for sign in (-1.0, 1.0):
            e, f = axes[:, (k + 1) % 3], axes[:, (k + 2) % 3]
            faces += split_face(rng, np.asarray(centre) + sign * axes[:, k] - e - f, 2 * e, 2 * f, patch)
    return faces


def _hollow_box(rng: np.random.Generator, centre: ArrayLike, size: ArrayLike, patch: float) -> list[Face]:
    return _box(rng, centre, size, np.eye(3), patch)


def _upright(rng: np.random.Generator, spread_deg: float = 180.0) -> FloatArray:
    return rotation_matrix(1, np.radians(rng.uniform(-spread_deg, spread_deg)))


def _any_rotation(rng: np.random.Generator) -> FloatArray:
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _boxes(
    rng: np.random.Generator, count: int, low: Sequence[float], high: Sequence[float], sizes: tuple[float, float]
) -> list[Face]:
    """Boxes with centres between ``low`` and ``high``, most of them upright."""
    faces: list[Face] = []
    for _ in range(count):
        size = np.exp(rng.uniform(np.log(sizes[0]), np.log(sizes[1]), 3))
        R = _upright(rng) if rng.random() < 0.7 else _any_rotation(rng)
        faces += _box(rng, rng.uniform(low, high), size, R, 2.0 * float(size.max()))
    return faces


def _facade(rng: np.random.Generator) -> tuple[list[Face], FloatArray, float]:
    """A wall with boxes standing out of it, sometimes round a corner, above a ground."""
    distance = rng.uniform(5.0, 20.0)
    eye = 1.7 + rng.uniform(0.0, 3.0)
    width, height = distance * rng.uniform(1.0, 3.0), distance * rng.uniform(0.6, 1.8)
    R = _upright(rng, 40.0)
    foot = np.array([rng.uniform(-0.2, 0.2) * distance, eye, distance])
    along, normal = R[:, 0], R[:, 2]
    patch = distance * rng.uniform(0.2, 0.6)
    faces = split_face(rng, foot - 0.5 * width * along, width * along, np.array([0.0, -height, 0.0]), patch)
    if rng.random() < 0.5:
        side = rng.choice([-0.5, 0.5]) * width * along
        faces += split_face(rng, foot + side, rng.choice([-1.0, 1.0]) * width * normal, [0.0, -height, 0.0], patch)
    for _ in range(int(rng.integers(0, 25))):
        place = foot + rng.uniform(-0.45, 0.45) * width * along - np.array([0.0, rng.uniform(0.1, 0.9) * height, 0.0])
        size = distance * np.exp(rng.uniform(np.log(0.03), np.log(0.2), 3)) * [1.0, 1.0, 0.5]
        faces += _box(rng, place, size, R, 2.0 * float(size.max()))
    low, high = [-0.5 * width, eye - 1.0, 0.35 * distance], [0.5 * width, eye, 0.9 * distance]
    faces += _boxes(rng, int(rng.integers(0, 5)), low, high, (0.04 * distance, 0.25 * distance))
    faces += split_face(rng, [-40.0, eye, 0.5], [80.0, 0, 0], [0, 0, 59.0], patch * 2)
    return faces, foot - [0.0, rng.uniform(0.2, 0.6) * height, 0.0], distance


def _room(rng: np.random.Generator) -> tuple[list[Face], FloatArray, float]:
    """The inside of a box with furniture along its walls."""
    width, height, depth = rng.uniform(3.0, 8.0), rng.uniform(2.3, 3.5), rng.uniform(3.0, 9.0)
    centre = np.array([0.0, 0.0, 0.5 * depth - 0.6])
    R = _upright(rng, 25.0)
    faces = _box(rng, centre, [width, height, depth], R, rng.uniform(0.8, 2.5))
    low, high = [-0.5 * width, -0.3 * height, 0.3 * depth], [0.5 * width, 0.5 * height, depth - 0.6]
    faces += _boxes(rng, int(rng.integers(3, 16)), low, high, (0.1, 1.2))
    distance = rng.uniform(0.5, 0.8) * depth
    return faces, np.array([rng.uniform(-0.2, 0.2) * width, rng.uniform(-0.1, 0.2) * height, distance]), distance


def _objects(rng: np.random.Generator) -> tuple[list[Face], FloatArray, float]:
    """Boxes on a ground or table, seen from any height: objects nearby and buildings from the air."""
    distance = rng.uniform(1.0, 20.0)
    pitch = np.radians(rng.uniform(8.0, 75.0))
    tilt = rotation_matrix(0, pitch)
    target = np.array([0.0, 0.0, distance])
    extent = distance * rng.uniform(1.0, 4.0)
    corner = target + tilt @ [-extent, 0.0, -0.6 * extent]
    patch = distance * rng.uniform(0.25, 0.8)
    faces = split_face(rng, corner, 2 * extent * tilt[:, 0], 1.2 * extent * tilt[:, 2], patch)
    for _ in range(int(rng.integers(4, 22))):
        size = distance * np.exp(rng.uniform(np.log(0.05), np.log(0.35), 3))
        place = np.array([rng.normal(0.0, 0.25), 0.0, rng.normal(0.0, 0.25)]) * distance
        R = tilt @ (_upright(rng) if rng.random() < 0.75 else _any_rotation(rng))
        faces += _box(rng, target + tilt @ (place - [0.0, 0.5 * size[1], 0.0]), size, R, 2.0 * float(size.max()))
    return faces, target, distance


def _facets(rng: np.random.Generator) -> tuple[list[Face], FloatArray, float]:
    """Tilted patches at many depths, as of rocks, plants and clutter."""
    distance = rng.uniform(2.0, 10.0)
    faces: list[Face] = []
    for _ in range(int(rng.integers(20, 70))):
        depth = distance * np.exp(rng.normal(0.0, 0.35))
        centre = np.array([rng.uniform(-0.7, 0.7) * depth, rng.uniform(-0.5, 0.5) * depth, depth])
        R = _any_rotation(rng)
        size = distance * np.exp(rng.uniform(np.log(0.1), np.log(0.6), 2))
        u, v = size[0] * R[:, 0], size[1] * R[:, 1]
        faces.append(Face(centre - 0.5 * (u + v), u, v, int(rng.integers(2**31))))
    faces += split_face(
        rng, [-4 * distance, -3 * distance, 2.5 * distance], [8 * distance, 0, 0], [0, 6 * distance, 0], distance
    )
    return faces, np.array([0.0, 0.0, distance]), distance
