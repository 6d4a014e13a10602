"""Pairs of HDF5 dumps in OANet's format."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .oanet_hdf5 import OanetFile
from .scene_bundle import ScenePair
from .source import Image, digest_files, find_files


@dataclass(frozen=True)
class OanetSource:
    """The pairs of one dump; the scene is the file's name, since a dump doesn't say which scene a pair is of."""

    path: Path
    sha256: str
    count: int

    @property
    def scene(self) -> str:
        return self.path.stem

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> ScenePair:
        pair = _dump(self.path, self.sha256)[index]
        points1, points2 = _pixels(pair.correspondences[:, :2], pair.K1), _pixels(pair.correspondences[:, 2:], pair.K2)
        return ScenePair(
            scene=self.scene,
            index=index,
            image1=f"{index}, image 1",
            image2=f"{index}, image 2",
            points1=points1,
            points2=points2,
            K1=pair.K1,
            K2=pair.K2,
            image_size1=_smallest_size(points1, pair.K1),
            image_size2=_smallest_size(points2, pair.K2),
            R=pair.R,
            t=pair.t,
            attributes=pair.attributes(),
            mutual=pair.mutual,
        )

    def images(self, pair: ScenePair) -> tuple[Image, Image] | None:
        """None: a dump holds no images and doesn't name them."""
        return None


@lru_cache(maxsize=2)
def _dump(path: Path, sha256: str) -> OanetFile:
    return OanetFile(path)


def _pixels(x: NDArray[np.float64], K: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(x * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]])


def _smallest_size(points: NDArray[np.float64], K: NDArray[np.float64]) -> tuple[int, int]:
    """(width, height) of the smallest image that is centred on the principal point and holds all points (N, 2).

    Dumps do not tell the size; grid-based filters need one.
    """
    centre = K[:2, 2]
    reach = np.abs(points - centre).max(axis=0, initial=0.0)
    width, height = np.ceil(2.0 * np.maximum(centre, reach) + 1.0).astype(int)
    return int(width), int(height)


def open_dumps(path: Path, images: Path | None = None) -> list[OanetSource]:
    """One source for each ``.hdf5`` or ``.h5`` of a folder, or for the one that ``path`` names.

    Raises:
        DatasetError: there is none, or one is of another layout.
        ImportError: h5py is not installed.
    """
    files = find_files(path, (".hdf5", ".h5"), "HDF5 dump")
    return [OanetSource(file, digest_files([file]), len(OanetFile(file))) for file in files]
