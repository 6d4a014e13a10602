"""Synthetic dumps in OANet's HDF5 format, for the tests of training and evaluation; skips them without h5py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import K, Scene

from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import symmetric_epipolar_distance_squared

h5py = pytest.importorskip("h5py")


def oanet_datasets(scene: Scene) -> dict[str, np.ndarray]:
    """The twelve datasets of one pair, shaped as the dumps have them; every second match is mutual."""
    xs = np.hstack([normalize_points(points, K) for points in (scene.points1, scene.points2)])
    count = len(xs)
    camera = {f"{name}{i}s": np.array([K[row, 2]]) for i in (1, 2) for row, name in enumerate(("cx", "cy"))}
    return {
        "xs": xs[None].astype(np.float32),
        "ys": symmetric_epipolar_distance_squared(xs, scene.E)[:, None],
        "Rs": scene.R,
        "ts": scene.t[:, None],
        "ratios": scene.attributes.ratio,
        "mutuals": np.arange(count) % 2 == 0,
        **camera,
        "f1s": np.array([K[0, 0], K[1, 1]]),
        "f2s": np.array([K[0, 0], K[1, 1]]),
    }


def write_oanet(path: Path, scenes: Sequence[Scene], changes: dict[str, np.ndarray | None] | None = None) -> Path:
    """A dump with one pair for each scene; ``changes`` replace datasets such as ``"Rs/1"``, None leaves one out."""
    datasets = {
        f"{group}/{i}": values for i, scene in enumerate(scenes) for group, values in oanet_datasets(scene).items()
    }
    with h5py.File(path, "w") as file:
        for name, values in {**datasets, **(changes or {})}.items():
            if values is not None:
                file[name] = values
    return path
