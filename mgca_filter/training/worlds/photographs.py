"""A folder of photographs as pictures for the faces of worlds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import MgcaFilterError

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
LONG_SIDE_PX = 1200
LEVELS = 6
CACHED_PHOTOS = 256  # about 1.2 MB each

Pyramid = tuple[NDArray[np.uint8], ...]


class PhotoError(MgcaFilterError, ValueError):
    """A folder of photographs cannot be used; the message names it."""


@dataclass(frozen=True)
class PhotoFolder:
    """Photographs of a folder and its subfolders, in the order of their names.

    Raises:
        PhotoError: the folder holds no picture.
    """

    folder: Path
    paths: tuple[Path, ...]

    @classmethod
    def open(cls, folder: str | Path) -> PhotoFolder:
        """List a folder; its files are read when they are needed."""
        folder = Path(folder)
        paths = tuple(sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES))
        if not paths:
            raise PhotoError(f"{folder}: no photograph found (looked for {', '.join(SUFFIXES)})")
        return cls(folder, paths)

    def __len__(self) -> int:
        return len(self.paths)

    def check(self, index: int) -> None:
        """Read a photograph and forget it, so that a broken one is found before training starts.

        Raises:
            PhotoError: it cannot be used.
        """
        _read(self.paths[index])

    def pyramid(self, index: int) -> Pyramid:
        """Grey levels of a photograph at full, half, quarter … size.

        Raises:
            PhotoError: the file is no picture that OpenCV reads, or a tiny one.
        """
        return _read_pyramid(self.paths[index])


def _read(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None or min(image.shape) < 2**LEVELS:
        raise PhotoError(f"{path}: not a picture of at least {2**LEVELS} px that OpenCV can read")
    return np.asarray(image, dtype=np.uint8)


@lru_cache(maxsize=CACHED_PHOTOS)
def _read_pyramid(path: Path) -> Pyramid:
    image = _read(path)
    scale = LONG_SIDE_PX / max(image.shape)
    if scale < 1.0:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    levels = [image]
    for _ in range(LEVELS - 1):
        last = levels[-1]
        even = last[: last.shape[0] // 2 * 2, : last.shape[1] // 2 * 2]
        levels.append(np.asarray(cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    return tuple(levels)
