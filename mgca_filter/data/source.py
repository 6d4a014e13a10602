"""What a source of pairs is, and what the formats share."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from .scene_bundle import ScenePair

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R Rᵀ − I that passes for a rotation: text files carry few digits."""

Image = NDArray[np.uint8]


class PairSource(Protocol):
    """The pairs of one scene; small and picklable, since worker processes get it."""

    @property
    def scene(self) -> str:
        """Name of the scene: the row of the tables."""

    @property
    def path(self) -> Path:
        """Where it comes from, for messages."""

    @property
    def sha256(self) -> str:
        """Digest of all that the pairs are read from, so that results of other data are never taken for these."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> ScenePair:
        """One pair.

        Raises:
            DatasetError: the pair cannot be read; the message names what is wrong. It counts as a failure then.
        """

    def images(self, pair: ScenePair) -> tuple[Image, Image] | None:
        """Both images (h, w, 3) BGR in whose pixels the pair's points lie, or None where there are none."""


def find_files(path: Path, suffixes: tuple[str, ...], what: str) -> list[Path]:
    """The file that ``path`` names, or the files of a folder that end in one of ``suffixes``, by name.

    Raises:
        DatasetError: there is none.
    """
    files = [path] if path.is_file() else sorted(f for f in path.glob("*") if f.suffix in suffixes)
    if not files:
        raise DatasetError(f"{path}: no {what} ({', '.join(suffixes)}) found")
    return files


def digest_files(paths: Iterable[Path], settings: str = "") -> str:
    """SHA-256 over the contents of files, and over settings; a file that is missing counts as such."""
    digest = hashlib.sha256(settings.encode())
    for path in paths:
        if not path.is_file():
            digest.update(f"missing {path.name}".encode())
            continue
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def check_folder(folder: Path, names: Sequence[str], where: str) -> None:
    """Raise DatasetError where not one of the images is in the folder: one missing fails its pairs, all are a mistake.

    ``where`` names the list or reconstruction that the names come from.
    """
    if names and not any((folder / name).is_file() for name in names):
        raise DatasetError(f"{where}: none of its {len(names)} images is in {folder}")


def check_pose(R: NDArray[np.float64], t: NDArray[np.float64], where: str) -> None:
    """Raise DatasetError, beginning with ``where``, unless R (3, 3) is a rotation and t (3,) a direction."""
    if not np.isfinite(R).all() or not np.isfinite(t).all():
        raise DatasetError(f"{where}: the pose holds NaN or infinite values")
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise DatasetError(f"{where}: the pose's matrix is not a rotation")
    if not t.any():
        raise DatasetError(f"{where}: the translation is zero, so that there is no epipolar geometry")


def check_intrinsics(K: NDArray[np.float64], where: str) -> None:
    """Raise DatasetError, beginning with ``where``, unless K (3, 3) is a matrix of intrinsics."""
    form = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1]) and K[1, 0] == 0
    if not form:
        raise DatasetError(f"{where}: not a matrix of intrinsics: {K.tolist()}")


def read_image(path: Path) -> Image:
    """Image (h, w, 3) uint8 BGR as its pixels are stored: intrinsics know nothing of an EXIF rotation.

    Raises:
        DatasetError: the file is missing or no image.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: image missing")
    image: Any = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise DatasetError(f"{path}: not an image that OpenCV can read")
    return np.asarray(image, dtype=np.uint8)
