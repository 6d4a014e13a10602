"""What a source of pairs is, and what the formats share."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..features import ImageFeatures, create_detector, describe, match_features
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


@lru_cache(maxsize=128)
def detect(path: Path, quarter_turns: int = 0) -> ImageFeatures:
    """Features of an image file turned counter-clockwise by ``quarter_turns`` · 90°; kept for the latest 128 images.

    They are those that the training data has, plain SIFT and 2000 keypoints, in pixels of the stored image.

    Raises:
        DatasetError: the image is missing or cannot be read.
    """
    return describe(np.ascontiguousarray(np.rot90(read_image(path), quarter_turns)), create_detector(), str(path))


def match_views(
    scene: str,
    index: int,
    names: tuple[str, str],
    views: tuple[ImageFeatures, ImageFeatures],
    R: NDArray[np.float64],
    t: NDArray[np.float64],
) -> ScenePair:
    """The pair of two images with pose ``X2 = R X1 + t``, whose features hold camera and size.

    Keypoints without undistorted place are left out before matching.
    """
    view1, view2 = (view.take(np.flatnonzero(np.isfinite(view.points).all(axis=1))) for view in views)
    matches = match_features(view1, view2)
    (K1, size1), (K2, size2) = (_camera(name, view) for name, view in zip(names, views))
    return ScenePair(
        scene=scene,
        index=index,
        image1=names[0],
        image2=names[1],
        points1=view1.points[matches.index1],
        points2=view2.points[matches.index2],
        K1=K1,
        K2=K2,
        image_size1=size1,
        image_size2=size2,
        R=R,
        t=t,
        attributes=matches.attributes,
        mutual=matches.mutual,
    )


def _camera(name: str, view: ImageFeatures) -> tuple[NDArray[np.float64], tuple[int, int]]:
    if view.K is None or view.image_size is None:
        raise ValueError(f"{name}: its camera and size must be known")
    return view.K, view.image_size
