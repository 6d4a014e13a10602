"""COLMAP databases: keypoints and matches in, ``two_view_geometries`` out; or a new database from features and rows.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5); everything here is shifted to (0, 0) on the way in and back
on the way out.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..features import ImageFeatures
from .journal import Journal, PipelineError, output_file
from .run import Report, Summary, Workers, run_identity, run_pairs, work_folder
from .worker import PairRow, Unusable

HALF_PIXEL = 0.5
# COLMAP's own guess for a camera of which nothing is known.
_GUESSED_FOCAL_FACTOR = 1.2
# Named in the sqlite3 module from Python 3.11 on.
_SQLITE_BUSY, _SQLITE_LOCKED = 5, 6
# Pixels of COLMAP to pixels of OpenCV, homogeneous.
_TO_OPENCV = np.array([[1.0, 0.0, -HALF_PIXEL], [0.0, 1.0, -HALF_PIXEL], [0.0, 0.0, 1.0]])
# Half the width of the difference that stands for a derivative; keypoints are float32.
_STRETCH_STEP_PX = 0.25
_PINHOLES = (pycolmap.CameraModelId.SIMPLE_PINHOLE, pycolmap.CameraModelId.PINHOLE)
_Configuration = pycolmap.TwoViewGeometryConfiguration
_CONFIGURATIONS = {
    ("ok", True): _Configuration.CALIBRATED,
    ("ok", False): _Configuration.UNCALIBRATED,
    ("planar", True): _Configuration.PLANAR,
    ("planar", False): _Configuration.PLANAR_OR_PANORAMIC,
    ("pure_rotation", True): _Configuration.PANORAMIC,
    ("pure_rotation", False): _Configuration.PLANAR_OR_PANORAMIC,
    # The pose alone is in doubt, which is not among what is written.
    ("low_support", False): _Configuration.UNCALIBRATED,
}


@dataclass(frozen=True)
class ColmapJob:
    """Database in, database out.

    Attributes:
        database: read, and changed only where ``output`` is the same path.
        output: gets everything that ``database`` holds, with our ``two_view_geometries``.
        use_descriptors: compute each match's distance ratio from SIFT descriptors where the database holds them.
        report: an HTML report of the run, or None.
    """

    database: Path
    output: Path
    use_descriptors: bool = True
    report: Report | None = None

    def run(self, workers: Workers, filter_options: dict[str, Any], quiet: bool = False) -> Summary:
        """Filter all pairs, write the output; a killed run goes on where it stopped.

        Raises:
            PipelineError: the database is missing, broken or locked, or the output cannot be written.
        """
        if not self.database.is_file():
            raise PipelineError(f"{self.database}: no such database")
        work = work_folder(self.output)
        journal = Journal(work / "journal.log")
        copy = work / "copy.db"
        try:
            for leftover in work.glob("copy.db*"):
                leftover.unlink()
            copy_database(self.database, copy)
            with closing(open_database(copy, self.database)) as database:
                with _damage(self.database):
                    content = {"content": content_digest(copy), "descriptors": self.use_descriptors}
                    source = DatabaseSource(database, self.use_descriptors)
                journal.begin({**content, **run_identity(filter_options)})
                summary = run_pairs(source, workers, journal, quiet)
                write_geometries(database, source.ids, journal.rows())
            self._deliver(copy)
            if self.report is not None:
                self.report.write(journal.rows())
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
        _sqlite_errors(source),
        closing(sqlite3.connect(f"{source.resolve().as_uri()}?{mode}", timeout=1.0, uri=True)) as reader,
    ):
        reader.execute("SELECT COUNT(*) FROM sqlite_master")
        with _sqlite_errors(target), closing(sqlite3.connect(target, timeout=1.0)) as writer:
            reader.backup(writer, progress=_raise_when_locked)


def _raise_when_locked(status: int, remaining: int, total: int) -> None:
    """Left alone, ``Connection.backup`` tries for ever."""
    if status in (_SQLITE_BUSY, _SQLITE_LOCKED):
        raise sqlite3.OperationalError("database is locked")


@contextmanager
def _sqlite_errors(path: Path) -> Iterator[None]:
    """SQLite's exceptions as one line that names the file: locked, full, or broken."""
    try:
        yield
    except sqlite3.Error as error:
        words = str(error)
        if "locked" in words or "busy" in words:
            words = "locked by another process"
        elif "full" in words or "disk I/O" in words:
            words = "cannot be written, the disk is full; what is finished is kept, run the command again to go on"
        raise PipelineError(f"{path}: {words}") from error


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """What SQLite and pycolmap say of a database that holds what cannot be, as one line that names the file."""
    try:
        with _sqlite_errors(path):
            yield
    except (RuntimeError, ValueError) as error:
        raise PipelineError(f"{path}: a damaged database, or one of another version ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    """What pycolmap says, without its place in the source and on one line."""
    return re.sub(r"^\[\S+\] ", "", " ".join(str(error).split()))


def open_database(path: Path, name: Path | None = None) -> Any:
    """``pycolmap.Database`` of an existing file; ``name`` is what messages call it.

    Raises:
        PipelineError: it is none of COLMAP's, or damaged.
    """
    with _damage(name or path), closing(sqlite3.connect(path)) as plain:
        tables = {name for (name,) in plain.execute("SELECT name FROM sqlite_master WHERE type='table'")}
    missing = {"cameras", "images", "keypoints", "descriptors", "matches"} - tables
    if missing:
        raise PipelineError(f"{name or path}: not a COLMAP database, tables missing: {', '.join(sorted(missing))}")
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # its warning of what it raises all the same
    try:
        with _damage(name or path):
            return pycolmap.Database.open(path)
    finally:
        pycolmap.logging.minloglevel = level


def content_digest(path: Path) -> str:
    """Digest of what the filter reads of a database; opening one changes its time, and even its bytes."""
    digest = hashlib.blake2b(digest_size=16)
    with closing(sqlite3.connect(path)) as database:
        database.text_factory = bytes  # names need not be UTF-8
        for table in ("cameras", "images", "keypoints", "descriptors", "matches"):
            for row in database.execute(f"SELECT * FROM {table} ORDER BY 1"):
                for value in row:
                    digest.update(value if isinstance(value, bytes) else repr(value).encode())
    return digest.hexdigest()


class DatabaseSource:
    """The pairs of a database that have matches.

    A pair or image whose rows cannot be used costs its own pairs only.

    Attributes:
        ids: id of the image of each name; bytes of a name that are not UTF-8 are written as in Python, ``\\xdf``.
    """

    def __init__(self, database: Any, use_descriptors: bool) -> None:
        self._database = database
        self._use_descriptors = use_descriptors
        images = database.read_all_images()
        names = {image.image_id: _name(image) for image in images}
        self.ids = {name: image_id for image_id, name in names.items()}
        self._cameras = {names[image.image_id]: image.camera_id for image in images}
        pair_ids, _ = database.read_num_matches()
        id_pairs = sorted(pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids)
        self._pairs = [(names[id1], names[id2]) for id1, id2 in id_pairs if id1 in names and id2 in names]

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images, that of the smaller id first, as COLMAP's pair ids order them."""
        return self._pairs

    def image(self, name: str) -> ImageFeatures | Unusable:
        """Keypoints freed of distortion, where the image's camera has an image plane."""
        camera_id = self._cameras[name]
        try:
            if not self._database.exists_camera(camera_id):
                return Unusable(f"{name}: its camera {camera_id} is not in the database")
            camera = self._database.read_camera(camera_id)
            if camera.is_spherical():
                return Unusable(f"{name}: its camera {camera_id} is spherical, it has no image plane")
            K = _TO_OPENCV @ camera.calibration_matrix()
            if not (np.isfinite(camera.params).all() and K[0, 0] > 0 and K[1, 1] > 0):
                return Unusable(f"{name}: its camera {camera_id} has parameters {camera.params_to_string()}")
            return self._features(camera, self.ids[name], K)
        except (RuntimeError, ValueError) as error:
            return Unusable(f"{name}: {_reason(error)}")

    def _features(self, camera: Any, image_id: int, K: NDArray[np.float64]) -> ImageFeatures:
        table = self._database.read_keypoints(image_id)
        size, angle = keypoint_shapes(table)
        return ImageFeatures(
            undistorted(camera, table[:, :2]),
            size,
            angle,
            self._sift_descriptors(image_id, len(table)),
            K if camera.has_prior_focal_length else None,
            (camera.width, camera.height),
            stretch=stretch(camera, table[:, :2]),
        )

    def _sift_descriptors(self, image_id: int, count: int) -> NDArray[np.uint8] | None:
        """Descriptors (count, 128), where they are wanted, there, and SIFT's."""
        if not self._use_descriptors:
            return None
        descriptors = self._database.read_descriptors(image_id)
        is_sift = descriptors.type == pycolmap.FeatureExtractorType.SIFT and len(descriptors.data) == count
        return np.asarray(descriptors.data, np.uint8) if is_sift else None

    def matches(self, name1: str, name2: str) -> NDArray[Any] | Unusable:
        """Matches (M, 2) as the database holds them."""
        try:
            matches: NDArray[Any] = self._database.read_matches(self.ids[name1], self.ids[name2])
        except (RuntimeError, ValueError) as error:
            return Unusable(f"{name1} with {name2}: {_reason(error)}")
        return matches


def _name(image: Any) -> str:
    """Name of an image; pycolmap refuses to read one that is not UTF-8."""
    try:
        return str(image.name)
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "backslashreplace")


def undistorted(camera: Any, points: NDArray[Any]) -> NDArray[np.float64]:
    """COLMAP's keypoints (N, 2) as OpenCV's pixels of a pinhole with the camera's calibration matrix."""
    K = _TO_OPENCV @ camera.calibration_matrix()
    on_plane = np.asarray(camera.cam_from_img(points.astype(np.float64)), dtype=np.float64).reshape(-1, 2)
    pixels: NDArray[np.float64] = on_plane * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels


def stretch(camera: Any, points: NDArray[Any]) -> NDArray[np.float64] | None:
    """Derivatives (N, 2, 2) of :func:`undistorted` by the keypoints (N, 2); None for a camera without distortion."""
    if camera.model in _PINHOLES:
        return None
    columns = [
        (undistorted(camera, points + step) - undistorted(camera, points - step)) / (2.0 * _STRETCH_STEP_PX)
        for step in _STRETCH_STEP_PX * np.eye(2)
    ]
    return np.stack(columns, axis=2)


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


def write_geometries(database: Any, ids: dict[str, int], rows: Iterable[PairRow]) -> None:
    """Replace all two-view geometries of an open database; ``ids`` of its images by name.

    Raises:
        PipelineError: the disk is full.
    """
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
    geometry.config = _Configuration.DEGENERATE
    if row.verified:
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


def write_database(
    path: Path,
    names: Sequence[str],
    read: Callable[[str], ImageFeatures | None],
    rows: Iterable[PairRow],
    camera_model: str = "PINHOLE",
) -> None:
    """Cameras, images, keypoints, descriptors where they are bytes long, kept matches and two-view geometries.

    Args:
        path: the file to make. names: images; those that ``read`` has no features for are left out. Images of the same
            intrinsics share a camera; those without have a SIMPLE_RADIAL camera each, of guessed focal length.
        camera_model: of images with intrinsics, "PINHOLE", or "SIMPLE_RADIAL" where these are rough.

    Raises:
        PipelineError: the disk is full.
    """
    try:
        with closing(pycolmap.Database.open(path)) as database:
            with pycolmap.DatabaseTransaction(database):
                ids = _write_images(database, names, read, camera_model)
            write_geometries(database, ids, _with_matches(database, ids, rows))
    except (RuntimeError, ValueError) as error:
        raise PipelineError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error


def _write_images(
    database: Any, names: Sequence[str], read: Callable[[str], ImageFeatures | None], camera_model: str
) -> dict[str, int]:
    ids: dict[str, int] = {}
    cameras: dict[tuple[Any, ...], int] = {}
    for name in names:
        image = read(name)
        if image is None or image.image_size is None:
            continue
        key = (name,) if image.K is None else (*image.image_size, *image.K.ravel())
        if key not in cameras:
            cameras[key] = database.write_camera(_camera(image.image_size, image.K, camera_model))
        ids[name] = database.write_image(pycolmap.Image(name=name, camera_id=cameras[key]))
        table = np.column_stack([image.points + HALF_PIXEL, _scale(image) / 2, np.radians(_angle(image))])
        database.write_keypoints(ids[name], table.astype(np.float32))
        if image.descriptors is not None and image.descriptors.shape[1:] == (128,):
            data = pycolmap.FeatureDescriptors(
                type=pycolmap.FeatureExtractorType.SIFT, data=_sift_bytes(image.descriptors)
            )
            database.write_descriptors(ids[name], data)
    return ids


def _sift_bytes(descriptors: NDArray[Any]) -> NDArray[np.uint8]:
    """SIFT descriptors (N, 128) as COLMAP keeps them.

    OpenCV's are bytes already, of any dtype; those of unit norm (RootSIFT, which is COLMAP's own default as well) are
    multiplied by 512, rounded and cut off at 255 as by COLMAP's ``FeatureDescriptorsToUnsignedByte``.
    """
    unit_norm = descriptors.dtype.kind == "f" and descriptors.max(initial=0.0) <= 1.0
    return np.clip(np.rint(descriptors * (512.0 if unit_norm else 1.0)), 0, 255).astype(np.uint8)


def _scale(image: ImageFeatures) -> NDArray[Any]:
    return np.ones(len(image.points)) if image.size is None else image.size


def _angle(image: ImageFeatures) -> NDArray[Any]:
    return np.zeros(len(image.points)) if image.angle is None else image.angle


def _camera(size: tuple[int, int], K: NDArray[np.float64] | None, model: str) -> Any:
    width, height = size
    if K is None:
        params = [_GUESSED_FOCAL_FACTOR * max(size), width / 2, height / 2, 0.0]
        return pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + HALF_PIXEL, K[1, 2] + HALF_PIXEL
    params = [fx, fy, cx, cy] if model == "PINHOLE" else [fx, cx, cy, 0.0]
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    camera.has_prior_focal_length = True
    return camera


def _with_matches(database: Any, ids: dict[str, int], rows: Iterable[PairRow]) -> Iterator[PairRow]:
    """The rows whose images are in the database, each after its kept matches were written."""
    for row in rows:
        if row.name1 in ids and row.name2 in ids:
            database.write_matches(ids[row.name1], ids[row.name2], row.kept)
            yield row
