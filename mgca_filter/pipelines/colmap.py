"""COLMAP databases: keypoints and matches in, ``two_view_geometries`` out.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5); everything here is shifted to (0, 0) on the way in and back
on the way out.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from .engines import Engine
from .journal import Journal, PipelineError, output_file, sqlite_errors
from .run import Summary, run_identity, run_pairs, work_folder
from .worker import ImageFeatures, PairRow

HALF_PIXEL = 0.5
# Named in the sqlite3 module from Python 3.11 on.
_SQLITE_BUSY, _SQLITE_LOCKED = 5, 6
# Pixels of COLMAP to pixels of OpenCV, homogeneous.
_TO_OPENCV = np.array([[1.0, 0.0, -HALF_PIXEL], [0.0, 1.0, -HALF_PIXEL], [0.0, 0.0, 1.0]])
_Configuration = pycolmap.TwoViewGeometryConfiguration
_CONFIGURATIONS = {
    ("ok", True): _Configuration.CALIBRATED,
    ("ok", False): _Configuration.UNCALIBRATED,
    ("planar", True): _Configuration.PLANAR,
    ("planar", False): _Configuration.PLANAR_OR_PANORAMIC,
    ("pure_rotation", True): _Configuration.PANORAMIC,
    ("pure_rotation", False): _Configuration.PLANAR_OR_PANORAMIC,
}


@dataclass(frozen=True)
class ColmapJob:
    """Database in, database out.

    Attributes:
        database: read, and changed only where ``output`` is the same path.
        output: gets everything that ``database`` holds, with our ``two_view_geometries``.
        use_descriptors: compute each match's distance ratio from SIFT descriptors where the database holds them.
    """

    database: Path
    output: Path
    use_descriptors: bool = True

    def run(self, engine: Engine, filter_options: dict[str, Any], quiet: bool = False) -> Summary:
        """Filter all pairs, write the output; a killed run goes on where it stopped.

        Raises:
            PipelineError: the database is missing, broken or locked, or the output cannot be written.
        """
        if not self.database.is_file():
            raise PipelineError(f"{self.database}: no such database")
        work = work_folder(self.output)
        journal = Journal(work / "journal.db")
        copy = work / "copy.db"
        try:
            for leftover in work.glob("copy.db*"):
                leftover.unlink()
            copy_database(self.database, copy)
            with closing(open_database(copy, self.database)) as database:
                content = {"content": content_digest(copy), "descriptors": self.use_descriptors}
                journal.begin({**content, **run_identity(filter_options)})
                summary = run_pairs(DatabaseSource(database, self.use_descriptors), engine, journal, quiet)
                write_geometries(database, journal.rows())
            self._deliver(copy)
        finally:
            journal.close()
        shutil.rmtree(work)
        return summary

    def _deliver(self, finished: Path) -> None:
        if self.output.exists() and self.output.samefile(self.database):
            copy_database(finished, self.output)  # one transaction: the old content or the new
        else:
            with output_file(self.output) as partial:
                finished.replace(partial)


def copy_database(source: Path, target: Path) -> None:
    """Copy an SQLite database with what its write-ahead log holds, respecting the locks of both.

    Raises:
        PipelineError: one of them is locked by another process or no database, or the disk is full.
    """
    # Even to read, SQLite wants to write a log beside the file; where the folder forbids that, nobody else writes.
    mode = "mode=rw" if os.access(source.resolve().parent, os.W_OK) else "immutable=1"
    with (
        sqlite_errors(source),
        closing(sqlite3.connect(f"{source.resolve().as_uri()}?{mode}", timeout=1.0, uri=True)) as reader,
    ):
        reader.execute("SELECT COUNT(*) FROM sqlite_master")
        with sqlite_errors(target), closing(sqlite3.connect(target, timeout=1.0)) as writer:
            reader.backup(writer, progress=_raise_when_locked)


def _raise_when_locked(status: int, remaining: int, total: int) -> None:
    """Left alone, ``Connection.backup`` tries for ever."""
    if status in (_SQLITE_BUSY, _SQLITE_LOCKED):
        raise sqlite3.OperationalError("database is locked")


def open_database(path: Path, name: Path | None = None) -> Any:
    """``pycolmap.Database`` of an existing file; ``name`` is what messages call it.

    Raises:
        PipelineError: it is none of COLMAP's.
    """
    with closing(sqlite3.connect(path)) as plain:
        tables = {name for (name,) in plain.execute("SELECT name FROM sqlite_master WHERE type='table'")}
    missing = {"cameras", "images", "keypoints", "descriptors", "matches"} - tables
    if missing:
        raise PipelineError(f"{name or path}: not a COLMAP database, tables missing: {', '.join(sorted(missing))}")
    return pycolmap.Database.open(path)


def content_digest(path: Path) -> str:
    """Digest of what the filter reads of a database; opening one changes its time, and even its bytes."""
    digest = hashlib.blake2b(digest_size=16)
    with closing(sqlite3.connect(path)) as database:
        for table in ("cameras", "images", "keypoints", "descriptors", "matches"):
            for row in database.execute(f"SELECT * FROM {table} ORDER BY 1"):
                for value in row:
                    digest.update(value if isinstance(value, bytes) else repr(value).encode())
    return digest.hexdigest()


class DatabaseSource:
    """The pairs of a database that have matches."""

    def __init__(self, database: Any, use_descriptors: bool) -> None:
        self._database = database
        self._use_descriptors = use_descriptors
        self._cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        self._images = {image.name: image for image in database.read_all_images()}

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images, that of the smaller id first, as COLMAP's pair ids order them."""
        names = {image.image_id: name for name, image in self._images.items()}
        pair_ids, _ = self._database.read_num_matches()
        id_pairs = sorted(pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids)
        return [(names[id1], names[id2]) for id1, id2 in id_pairs if id1 in names and id2 in names]

    def image(self, name: str) -> ImageFeatures | None:
        """Keypoints freed of distortion; None for a camera without an image plane (a spherical one)."""
        image = self._images[name]
        camera = self._cameras[image.camera_id]
        if camera.is_spherical():
            return None
        table = self._database.read_keypoints(image.image_id)
        size, angle = keypoint_shapes(table)
        return ImageFeatures(
            undistorted(camera, table[:, :2]),
            size,
            angle,
            self._sift_descriptors(image.image_id, len(table)),
            _TO_OPENCV @ camera.calibration_matrix() if camera.has_prior_focal_length else None,
            (camera.width, camera.height),
        )

    def _sift_descriptors(self, image_id: int, count: int) -> NDArray[np.uint8] | None:
        """Descriptors (count, 128), where they are wanted, there, and SIFT's."""
        if not self._use_descriptors:
            return None
        descriptors = self._database.read_descriptors(image_id)
        is_sift = descriptors.type == pycolmap.FeatureExtractorType.SIFT and len(descriptors.data) == count
        return np.asarray(descriptors.data, np.uint8) if is_sift else None

    def matches(self, name1: str, name2: str) -> NDArray[Any]:
        """Matches (M, 2) as the database holds them."""
        id1, id2 = (self._images[name].image_id for name in (name1, name2))
        matches: NDArray[Any] = self._database.read_matches(id1, id2)
        return matches


def undistorted(camera: Any, points: NDArray[Any]) -> NDArray[np.float64]:
    """COLMAP's keypoints (N, 2) as OpenCV's pixels of a pinhole with the camera's calibration matrix."""
    K = _TO_OPENCV @ camera.calibration_matrix()
    on_plane = np.asarray(camera.cam_from_img(points.astype(np.float64)), dtype=np.float64).reshape(-1, 2)
    pixels: NDArray[np.float64] = on_plane * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels


def keypoint_shapes(table: NDArray[Any]) -> tuple[NDArray[Any] | None, NDArray[Any] | None]:
    """Diameters in pixels and angles in degrees (N,) of keypoint rows (N, 2 | 4 | 6), None where they say nothing.

    COLMAP's rows are x, y; x, y, scale, orientation; or x, y and an affine shape.
    """
    if table.shape[1] == 6:
        a11, a12, a21, a22 = table[:, 2:].T
        scale, orientation = (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2, np.arctan2(a21, a11)
    elif table.shape[1] == 4:
        scale, orientation = table[:, 2], table[:, 3]
    else:
        return None, None
    if np.ptp(scale) == 0 and np.ptp(orientation) == 0:  # importers fill in 1 and 0 for keypoints without a shape
        return None, None
    return 2.0 * scale, np.degrees(orientation) % 360.0


def write_geometries(database: Any, rows: Iterable[PairRow]) -> None:
    """Replace all two-view geometries of an open database.

    Raises:
        PipelineError: the disk is full.
    """
    ids = {image.name: image.image_id for image in database.read_all_images()}
    try:
        with pycolmap.DatabaseTransaction(database):
            database.clear_two_view_geometries()
            for row in rows:
                database.write_two_view_geometry(ids[row.name1], ids[row.name2], two_view_geometry(row))
    except (RuntimeError, ValueError) as error:
        raise PipelineError(f"the database cannot be written: {' '.join(str(error).split())}") from error


def two_view_geometry(row: PairRow) -> Any:
    """``pycolmap.TwoViewGeometry`` in COLMAP's pixels; degenerate and without matches where nothing explains the pair.

    Where cameras have distortion, F and H hold for undistorted pixels. E and pose are left out where intrinsics
    are not known.
    """
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = _CONFIGURATIONS.get((row.status, row.calibrated), _Configuration.DEGENERATE)
    geometry.inlier_matches = row.kept
    if row.F is not None:
        geometry.F = _TO_OPENCV.T @ row.F @ _TO_OPENCV
    if row.H is not None:
        geometry.H = np.linalg.inv(_TO_OPENCV) @ row.H @ _TO_OPENCV
    if row.calibrated and row.R is not None:
        translation = np.zeros(3) if row.t is None else row.t
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(row.R), translation)
        geometry.E = row.E
    return geometry
