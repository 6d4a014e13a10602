"""HDF5 dumps of the OANet family (YFCC100M, SUN3D): putative matches and true poses, pair by pair.

A dump holds twelve groups, each with the datasets ``"0"`` … ``"P-1"``, one per pair of images (Zhang et al., ICCV 2019,
the format that later papers of the family share).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..inputs.attributes import MatchAttributes
from .scene_bundle import ScenePair
from .source import ROTATION_TOLERANCE, Image, digest_files, find_files

GROUPS = ("xs", "ys", "Rs", "ts", "ratios", "mutuals", "cx1s", "cy1s", "cx2s", "cy2s", "f1s", "f2s")
"""All that a dump has; ``ys``, the squared distances to the true geometry, follow from the rest and are not read."""


@dataclass(frozen=True)
class OanetPair:
    """One pair of a dump with its N putative matches.

    Attributes:
        index: of the pair in the file.
        correspondences: (N, 4) float64 on the normalised image planes.
        R, t: (3, 3) and (3,) float64, ``X2 = R X1 + t``; the scale of ``t`` is unknown.
        ratio: (N,) float32, distance to the nearest over distance to the second nearest descriptor.
        mutual: (N,) bool, two-way nearest neighbours.
        K1, K2: (3, 3) float64 intrinsics, from the dump's ``f`` and ``cx``, ``cy``, which are pixels from the
            centre of the top-left pixel (the writers add (w − 1) / 2 to an offset from the image centre).
    """

    index: int
    correspondences: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    ratio: NDArray[np.float32]
    mutual: NDArray[np.bool_]
    K1: NDArray[np.float64]
    K2: NDArray[np.float64]

    def attributes(self) -> MatchAttributes:
        """What the dump knows of each match: its ratio, and whether it is best of the list."""
        return MatchAttributes(ratio=self.ratio, best=best_by_mutual(self.correspondences[:, 2:], self.mutual))


class OanetFile:
    """A dump on disk; ``len`` is its number of pairs, indexing reads one :class:`OanetPair`.

    Only the layout is checked on opening; a pair is read and checked when it is asked for. The file is opened anew in
    every process that gets the object by pickling.

    Raises:
        DatasetError: the file is missing, no HDF5 or of another layout, or a pair holds what cannot be (a matrix that
            is not a rotation, no translation, values that are not finite, another shape); file and group are named.
        ImportError: h5py is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file: Any = None
        self._count = self._check_layout()

    def __len__(self) -> int:
        return self._count

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None}

    def close(self) -> None:
        """Close the file; it opens again when a pair is asked for."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def match_count(self, index: int) -> int:
        """Number of matches of a pair, without reading them."""
        return int(self._dataset("xs", index).shape[-2])

    def __getitem__(self, index: int) -> OanetPair:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: pair {index} of {len(self)}")
        xs = self._read("xs", index)
        if xs.ndim != 3 or xs.shape[0] != 1 or xs.shape[2] != 4:
            raise DatasetError(f"{self.path}: xs/{index} has the shape {xs.shape} instead of (1, N, 4)")
        count = xs.shape[1]
        return OanetPair(
            index=index,
            correspondences=xs[0],
            R=self._rotation(index),
            t=self._translation(index),
            ratio=self._read("ratios", index, count).astype(np.float32),
            mutual=self._read("mutuals", index, count) > 0,
            K1=self._intrinsics(index, 1),
            K2=self._intrinsics(index, 2),
        )

    def _open(self) -> Any:
        import h5py

        if self._file is None:
            try:
                self._file = h5py.File(self.path, "r")
            except OSError as error:
                raise DatasetError(f"{self.path}: cannot be read as HDF5 ({error})") from error
        return self._file

    def _check_layout(self) -> int:
        import h5py

        file = self._open()
        missing = [name for name in GROUPS if not isinstance(file.get(name), h5py.Group)]
        if missing:
            found = ", ".join(sorted(file)) or "nothing"
            raise DatasetError(
                f"{self.path}: not a dump in OANet's format, groups missing: {', '.join(missing)} (found: {found})"
            )
        counts = {name: len(file[name]) for name in GROUPS}
        if len(set(counts.values())) > 1:
            listed = ", ".join(f"{name} {count}" for name, count in counts.items())
            raise DatasetError(f"{self.path}: groups differ in their number of pairs: {listed}")
        count = counts["xs"]
        for name in GROUPS if count else ():
            if "0" not in file[name] or str(count - 1) not in file[name]:
                raise DatasetError(f'{self.path}: {name} does not hold the datasets "0" … "{count - 1}"')
        self.close()
        return count

    def _dataset(self, group: str, index: int) -> Any:
        dataset = self._open()[group].get(str(index))
        if dataset is None:
            raise DatasetError(f'{self.path}: {group} holds no dataset "{index}"')
        return dataset

    def _read(self, group: str, index: int, size: int | None = None) -> NDArray[np.float64]:
        """One dataset as float64, flat with ``size`` values where that is given."""
        try:
            values = np.asarray(self._dataset(group, index)[()], dtype=np.float64)
        except (TypeError, ValueError, OSError) as error:  # text, or a torn file
            raise DatasetError(f"{self.path}: {group}/{index} cannot be read as numbers ({error})") from error
        if size is not None:
            if values.size != size:
                raise DatasetError(f"{self.path}: {group}/{index} has the shape {values.shape}, expected {size} values")
            values = values.reshape(-1)
        if not np.isfinite(values).all():
            raise DatasetError(f"{self.path}: {group}/{index} holds NaN or infinite values")
        return values

    def _rotation(self, index: int) -> NDArray[np.float64]:
        R = self._read("Rs", index, 9).reshape(3, 3)
        if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            raise DatasetError(f"{self.path}: Rs/{index} is not a rotation")
        return R

    def _translation(self, index: int) -> NDArray[np.float64]:
        t = self._read("ts", index, 3)
        if not t.any():
            raise DatasetError(f"{self.path}: ts/{index} is zero: the pair has no epipolar geometry")
        return t

    def _intrinsics(self, index: int, image: int) -> NDArray[np.float64]:
        focal = self._read(f"f{image}s", index).reshape(-1)
        if focal.size not in (1, 2) or (focal <= 0).any():
            raise DatasetError(f"{self.path}: f{image}s/{index} is {focal.tolist()}, expected one or two focal lengths")
        cx, cy = (self._read(f"{axis}{image}s", index, 1)[0] for axis in ("cx", "cy"))
        return np.array([[focal[0], 0.0, cx], [0.0, focal[-1], cy], [0.0, 0.0, 1.0]])


def best_by_mutual(points2: NDArray[np.float64], mutual: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Best-of-list flags (N,) of a full one-way list, from its two-way nearest neighbours.

    Among the matches that reach one keypoint of image 2 (N, 2), the mutual one has the smallest distance; a list
    without distances tells no more, so that groups without a mutual match keep all their members.
    """
    if len(points2) == 0:
        return np.zeros(0, dtype=bool)
    _, keypoint = np.unique(points2, axis=0, return_inverse=True)
    keypoint = keypoint.reshape(-1)
    decided = np.bincount(keypoint, weights=mutual) > 0
    return np.asarray(mutual | ~decided[keypoint])


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
