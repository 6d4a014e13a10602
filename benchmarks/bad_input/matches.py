"""Every kind of degenerate, broken and hopeless matches, in every type that callers pass."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from mgca_filter.geometry.pose_refinement import rotation_from_vector

Array = NDArray[np.float64]
Points = tuple[Array, Array]

WIDTH, HEIGHT = 640.0, 480.0
K = np.array([[800.0, 0.0, 319.5], [0.0, 800.0, 239.5], [0.0, 0.0, 1.0]])
_T = np.array([1.0, 0.2, 0.1])


def _random(rng: Generator, count: int) -> Points:
    first, second = rng.uniform([0, 0], [WIDTH, HEIGHT], (2, count, 2))
    return first, second


def _views(pixels: Array, depth: Array, t: Array, rng: Generator) -> Points:
    """Two noisy views of points at ``depth`` behind ``pixels`` of the first one."""
    R = rotation_from_vector(np.array([0.05, -0.12, 0.03]))
    rays = np.column_stack([(pixels - K[:2, 2]) / K[0, 0], np.ones(len(pixels))])
    X2 = (rays * depth[:, None]) @ R.T + t
    second = X2[:, :2] / X2[:, 2:] * K[0, 0] + K[:2, 2]
    return pixels + rng.normal(0, 0.3, pixels.shape), second + rng.normal(0, 0.3, pixels.shape)


def _scene(rng: Generator, count: int) -> Points:
    return _views(_random(rng, count)[0], rng.uniform(4, 11, count), _T, rng)


def _plane(rng: Generator, count: int) -> Points:
    pixels = _random(rng, count)[0]
    return _views(pixels, 1.0 / (0.2 + 0.05 * (pixels[:, 0] - 320) / 320), _T, rng)


def _rotation(rng: Generator, count: int) -> Points:
    return _views(_random(rng, count)[0], np.ones(count), np.zeros(3), rng)


def _half_wrong(rng: Generator, count: int) -> Points:
    first, second = _scene(rng, count)
    wrong = rng.random(count) < 0.5
    second[wrong] = _random(rng, int(wrong.sum()))[1]
    return first, second


def _identical(rng: Generator, count: int) -> Points:
    first = _random(rng, count)[0]
    return first, first.copy()


def _equal(rng: Generator, count: int) -> Points:
    return np.full((count, 2), 17.0), np.full((count, 2), 31.0)


def _collinear(rng: Generator, count: int) -> Points:
    x = rng.uniform(0, WIDTH, count)
    return np.column_stack([x, 0.5 * x + 60]), np.column_stack([x + 9.0, 0.5 * x + 70])


def _grid(rng: Generator, count: int) -> Points:
    first, second = 100.0 * rng.integers(0, 5, (2, count, 2))
    return first, second


def _duplicated(rng: Generator, count: int) -> Points:
    first, second = _scene(rng, count)
    rows = rng.integers(0, max(1, count // 10), count)
    return first[rows], second[rows]


def _huge(rng: Generator, count: int) -> Points:
    first, second = _scene(rng, count)
    return first * 10.0 ** rng.uniform(0, 300), second * 10.0 ** rng.uniform(0, 300)


def _tiny(rng: Generator, count: int) -> Points:
    first, second = _scene(rng, count)
    return first * 1e-12, second * 1e-12


def _normalised(rng: Generator, count: int) -> Points:
    """What ``cv2.undistortPoints`` gives: no pixels."""
    first, second = _half_wrong(rng, count)
    return (first - K[:2, 2]) / K[0, 0], (second - K[:2, 2]) / K[0, 0]


def _millimetres(rng: Generator, count: int) -> Points:
    """On the sensor, behind a lens of 12 mm."""
    first, second = _normalised(rng, count)
    return 12.0 * first, 12.0 * second


def _unusable(rng: Generator, count: int) -> Points:
    value = rng.choice([np.nan, np.inf, -np.inf])
    return np.full((count, 2), value), np.full((count, 2), value)


def _mixture(rng: Generator, count: int) -> Points:
    """Rows of all kinds, one beside the other."""
    parts = [make(rng, count) for name, make in KINDS.items() if name != "mixture"]
    chosen = rng.integers(0, len(parts), count)
    rows = np.arange(count)
    first, second = (np.stack([part[side] for part in parts])[chosen, rows] for side in (0, 1))
    broken = rng.random((2, count)) < 0.1
    first[broken[0], 0] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e30], int(broken[0].sum()))
    second[broken[1], 1] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e30], int(broken[1].sum()))
    return first, second


KINDS: dict[str, Callable[[Generator, int], Points]] = {
    "true scene": _scene,
    "half of the matches wrong": _half_wrong,
    "wrong matches only": _random,
    "one plane": _plane,
    "rotation only": _rotation,
    "the same image twice": _identical,
    "all points equal": _equal,
    "collinear": _collinear,
    "coarse grid": _grid,
    "duplicated matches": _duplicated,
    "huge coordinates": _huge,
    "tiny coordinates": _tiny,
    "normalised": _normalised,
    "millimetres": _millimetres,
    "NaN or infinite": _unusable,
    "mixture": _mixture,
}
"""Points of a pair by kind: a generator and a count in, pixels (N, 2) and (N, 2) out."""


def _keypoints(points: Array) -> list[cv2.KeyPoint]:
    return [cv2.KeyPoint(float(x), float(y), 4.0, 30.0) for x, y in points]


def _as_dmatches(first: Array, second: Array, rng: Generator) -> tuple[Any, Any, Any]:
    matches = [cv2.DMatch(i, i, float(d)) for i, d in enumerate(rng.uniform(0, 300, len(first)))]
    return _keypoints(first), _keypoints(second), matches


def _as_knn(first: Array, second: Array, rng: Generator) -> tuple[Any, Any, Any]:
    """Rows of two, one and no candidates, as ``knnMatch`` writes them."""
    count = len(first)
    rows = []
    for i, candidates in enumerate(rng.choice([2, 1, 0], count, p=[0.9, 0.05, 0.05])):
        nearest, farther = np.sort(rng.uniform(0, 300, 2))
        both = (cv2.DMatch(i, i, float(nearest)), cv2.DMatch(i, int(rng.integers(count)), float(farther)))
        rows.append(both[:candidates])
    return _keypoints(first), _keypoints(second), rows


def _as_index_pairs(first: Array, second: Array, rng: Generator) -> tuple[Any, Any, Any]:
    rows = rng.permutation(len(first))
    return first, second, np.stack([rows, rows], axis=1).astype(str(rng.choice(["int32", "int64", "uint16"])))


def _in_object_arrays(first: Array, second: Array, rng: Generator) -> tuple[Any, Any, Any]:
    """As ``np.array(matches)[mask]`` leaves them."""
    keypoints1, keypoints2, matches = _as_dmatches(first, second, rng)
    return _object_array(keypoints1), _object_array(keypoints2), _object_array(matches)


def _object_array(items: list[Any]) -> NDArray[np.object_]:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


def _in_tuples_and_queues(first: Array, second: Array, rng: Generator) -> tuple[Any, Any, Any]:
    keypoints1, keypoints2, matches = _as_dmatches(first, second, rng)
    return tuple(keypoints1), deque(keypoints2), deque(matches)


def _one_by_two(first: Array, second: Array, rng: Generator) -> tuple[Any, Any, Any]:
    return first[None], second[None], None


FORMS: dict[str, Callable[[Array, Array, Generator], tuple[Any, Any, Any]]] = {
    "arrays": lambda first, second, rng: (first, second, None),
    "float32": lambda first, second, rng: (_float32(first)[:, None], _float32(second)[:, None], None),
    "lists": lambda first, second, rng: (first.tolist(), second.tolist(), None),
    "index pairs": _as_index_pairs,
    "DMatch": _as_dmatches,
    "knnMatch": _as_knn,
    "object arrays": _in_object_arrays,
    "tuples and queues": _in_tuples_and_queues,
    "(1, N, 2)": _one_by_two,
}
"""The types that callers pass: pixels in, ``(kp1, kp2, matches)`` out."""


def _float32(points: Array) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return points.astype(np.float32)
