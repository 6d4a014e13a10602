"""Features of images on disk, one file each, found again as long as image and detector are the same."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..features import ImageFeatures, detector_resolution
from ..images import MAX_FILE_BYTES
from ..input_file import read_bytes
from .journal import file_stamp, output_file
from .run import Workers, progress_bar

# Of what is in a file; another one, and all images are read again.
_REVISION = 3
_UNREADABLE = (OSError, ValueError, KeyError, zipfile.BadZipFile)


@dataclass(frozen=True)
class FeatureCache:
    """A folder of ``.npz`` files.

    Attributes:
        folder: where they lie. images: the folder that the names of the images are relative to.
        detector, max_keypoints: as in :func:`mgca_filter.match_images`.
    """

    folder: Path
    images: Path
    detector: str
    max_keypoints: int

    def fill(self, names: Sequence[str], workers: Workers, quiet: bool = False) -> list[str]:
        """Extract what is missing; returns the images that cannot be read or decoded."""
        self.folder.mkdir(parents=True, exist_ok=True)
        missing = [name for name in names if not self._path(name).is_file()]
        unreadable = []

        def tasks() -> Iterator[tuple[Any, ...]]:
            for name in missing:
                yield name, _bytes_or_none(self.images / name), self.detector, self.max_keypoints

        with progress_bar("images", len(names), len(names) - len(missing), quiet) as bar:
            for name, features, orientation in workers.map("extract", tasks()):
                if features is None:
                    unreadable.append(name)
                else:
                    self._write(name, features, orientation)
                bar.update()
        return sorted(unreadable)

    def read(self, name: str) -> ImageFeatures | None:
        """Features of an image; None where there are none."""
        try:
            with np.load(self._path(name)) as data:
                table, descriptors, (width, height) = data["keypoints"], data["descriptors"], data["image_size"]
                K = data["K"]
        except _UNREADABLE:
            return None
        size = (int(width), int(height))
        return ImageFeatures(
            table[:, :2], table[:, 2], table[:, 3], descriptors, K if K.size else None, size, detector_resolution(size)
        )

    def shape(self, name: str) -> tuple[tuple[int, int], int] | None:
        """(width, height) of an image as it is shown, and its EXIF orientation; None where there are no features."""
        try:
            with np.load(self._path(name)) as data:
                (width, height), orientation = data["image_size"], data["orientation"]
        except _UNREADABLE:
            return None
        return (int(width), int(height)), int(orientation)

    def _write(self, name: str, features: ImageFeatures, orientation: int) -> None:
        size, angle, descriptors = (np.asarray(v) for v in (features.size, features.angle, features.descriptors))
        with output_file(self._path(name)) as partial, partial.open("wb") as file:
            np.savez(
                file,
                keypoints=np.column_stack([features.points, size, angle]).astype(np.float32),
                descriptors=descriptors,
                image_size=np.array(features.image_size),
                K=np.zeros((0, 0)) if features.K is None else features.K,
                orientation=np.array(orientation),
            )

    def _path(self, name: str) -> Path:
        key = repr((_REVISION, name, file_stamp(self.images / name), self.detector, self.max_keypoints))
        return self.folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.npz"


def _bytes_or_none(path: Path) -> bytes:
    """The file, empty where it cannot be read or is too long: one bad image does not stop the others."""
    try:
        return read_bytes(path, MAX_FILE_BYTES)
    except (OSError, ValueError):
        return b""
