"""A new COLMAP database from features and rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from .colmap import HALF_PIXEL, write_geometries
from .journal import PipelineError
from .worker import ImageFeatures, PairRow

# COLMAP's own guess for a camera of which nothing is known.
_GUESSED_FOCAL_FACTOR = 1.2


def write_database(
    path: Path,
    names: Sequence[str],
    read: Callable[[str], ImageFeatures | None],
    rows: Iterable[PairRow],
    K: NDArray[np.float64] | None,
) -> None:
    """Cameras, images, keypoints, descriptors where they are bytes long, kept matches and two-view geometries.

    Args:
        path: the file to make. names: images; those that ``read`` has no features for are left out.
        K: (3, 3) intrinsics in OpenCV's pixels of one pinhole camera for all images of a size, or None: one
            SIMPLE_RADIAL camera per image, of guessed focal length.

    Raises:
        PipelineError: the disk is full.
    """
    try:
        with closing(pycolmap.Database.open(path)) as database:
            with pycolmap.DatabaseTransaction(database):
                ids = _write_images(database, names, read, K)
            write_geometries(database, _with_matches(database, ids, rows))
    except (RuntimeError, ValueError) as error:
        raise PipelineError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error


def _write_images(
    database: Any, names: Sequence[str], read: Callable[[str], ImageFeatures | None], K: NDArray[np.float64] | None
) -> dict[str, int]:
    ids: dict[str, int] = {}
    cameras: dict[tuple[int, int], int] = {}
    for name in names:
        image = read(name)
        if image is None or image.image_size is None:
            continue
        if K is None or image.image_size not in cameras:
            cameras[image.image_size] = database.write_camera(_camera(image.image_size, K))
        ids[name] = database.write_image(pycolmap.Image(name=name, camera_id=cameras[image.image_size]))
        table = np.column_stack([image.points + HALF_PIXEL, _scale(image) / 2, np.radians(_angle(image))])
        database.write_keypoints(ids[name], table.astype(np.float32))
        if image.descriptors is not None and image.descriptors.shape[1:] == (128,):
            data = image.descriptors.astype(np.uint8)  # OpenCV's SIFT: integers 0 … 255 as float32
            database.write_descriptors(
                ids[name], pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=data)
            )
    return ids


def _scale(image: ImageFeatures) -> NDArray[Any]:
    return np.ones(len(image.points)) if image.size is None else image.size


def _angle(image: ImageFeatures) -> NDArray[Any]:
    return np.zeros(len(image.points)) if image.angle is None else image.angle


def _camera(size: tuple[int, int], K: NDArray[np.float64] | None) -> Any:
    width, height = size
    if K is None:
        params = [_GUESSED_FOCAL_FACTOR * max(size), width / 2, height / 2, 0.0]
        return pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    params = [K[0, 0], K[1, 1], K[0, 2] + HALF_PIXEL, K[1, 2] + HALF_PIXEL]
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
    camera.has_prior_focal_length = True
    return camera


def _with_matches(database: Any, ids: dict[str, int], rows: Iterable[PairRow]) -> Iterator[PairRow]:
    """The rows whose images are in the database, each after its kept matches were written."""
    for row in rows:
        if row.name1 in ids and row.name2 in ids:
            database.write_matches(ids[row.name1], ids[row.name2], row.kept)
            yield row
