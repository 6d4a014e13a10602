"""Pairs of a COLMAP reconstruction with its images: those that share enough of its points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..features import FEATURE_SETTINGS, ImageFeatures
from .scene_bundle import ScenePair
from .source import Image, check_folder, check_pose, detect, digest_files, match_views, read_image

MIN_COVISIBLE_POINTS = 15
"""Reconstructed points that two images must share to make a pair."""

HALF_PIXEL = 0.5
"""The centre of the top-left pixel is (0.5, 0.5) in COLMAP and (0, 0) in OpenCV and here."""


@dataclass(frozen=True)
class _Photo:
    """One registered image: COLMAP's camera (model, size, parameters) and its pose, world → camera."""

    name: str
    model: str
    size: tuple[int, int]
    parameters: tuple[float, ...]
    R: NDArray[np.float64]
    t: NDArray[np.float64]

    def camera(self) -> Any:
        import pycolmap

        width, height = self.size
        return pycolmap.Camera(model=self.model, width=width, height=height, params=list(self.parameters))

    def intrinsics(self) -> NDArray[np.float64]:
        """(3, 3) for pixels from the centre of the top-left one: those of the camera with its distortion removed."""
        K = np.array(self.camera().calibration_matrix(), dtype=np.float64)
        K[:2, 2] -= HALF_PIXEL
        return K


@dataclass(frozen=True)
class ColmapSource:
    """The pairs of one reconstruction, by the names of their images; the scene is the folder's name."""

    path: Path
    scene: str
    image_folder: Path
    photos: tuple[_Photo, ...]
    pairs: tuple[tuple[int, int], ...]
    sha256: str

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> ScenePair:
        one, two = (self.photos[i] for i in self.pairs[index])
        R = two.R @ one.R.T
        t = two.t - R @ one.t
        check_pose(R, t, f"{self.path}: {one.name} and {two.name}")
        return match_views(self.scene, index, (one.name, two.name), (self.view(one), self.view(two)), R, t)

    def view(self, photo: _Photo) -> ImageFeatures:
        """A photograph's features, with their distortion removed."""
        features = detect(self.image_folder / photo.name)
        assert features.image_size is not None
        if features.image_size != photo.size:
            width, height = features.image_size
            raise DatasetError(
                f"{self.image_folder / photo.name}: {width} x {height} px, "
                f"but its camera has {photo.size[0]} x {photo.size[1]} px"
            )
        K = photo.intrinsics()
        points = features.points
        if len(points):
            x = np.asarray(photo.camera().cam_from_img(points + HALF_PIXEL), dtype=np.float64)
            points = x @ K[:2, :2].T + K[:2, 2]
        return replace(features, points=points, K=K)

    def images(self, pair: ScenePair) -> tuple[Image, Image] | None:
        """Both photographs with their distortion removed."""
        one, two = (self.photos[i] for i in self.pairs[pair.index])
        return self._undistorted(one), self._undistorted(two)

    def _undistorted(self, photo: _Photo) -> Image:
        image = read_image(self.image_folder / photo.name)
        K, (width, height) = photo.intrinsics(), photo.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        rays = np.column_stack([(pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T, np.ones(len(pixels))])
        source = np.asarray(photo.camera().img_from_cam(rays)) - HALF_PIXEL
        places = source.reshape(height, width, 2).astype(np.float32)
        return np.asarray(cv2.remap(image, places, None, cv2.INTER_LINEAR), dtype=np.uint8)  # type: ignore[call-overload]


def open_reconstruction(path: Path, images: Path | None = None) -> list[ColmapSource]:
    """The source of a reconstruction's folder (``cameras``, ``images``, ``points3D`` as ``.bin`` or ``.txt``).

    ``sparse/0`` and ``sparse`` beneath ``path`` are found too; the images are in ``path/images`` by default.

    Raises:
        DatasetError: there is no reconstruction, or it cannot be read.
        ImportError: pycolmap is not installed.
    """
    import pycolmap

    candidates = [path, path / "sparse" / "0", path / "sparse"]
    folder = next((c for c in candidates if any((c / f"cameras{end}").is_file() for end in (".bin", ".txt"))), None)
    if folder is None:
        raise DatasetError(f"{path}: no COLMAP reconstruction (cameras.bin or cameras.txt) found")
    try:
        reconstruction = pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap raises what its C++ parts raise
        raise DatasetError(f"{folder}: cannot be read as a COLMAP reconstruction ({error})") from error
    image_folder = path / "images" if images is None else images
    registered = sorted((reconstruction.image(i) for i in reconstruction.reg_image_ids()), key=lambda image: image.name)
    photos = tuple(_photo(image) for image in registered)
    pairs = covisible_pairs([observed_points(image) for image in registered])
    check_folder(image_folder, [photo.name for photo in photos], str(folder))
    files = [folder / f"{part}{end}" for part in ("cameras", "images", "points3D") for end in (".bin", ".txt")]
    digest = digest_files([*files, *(image_folder / photo.name for photo in photos)], FEATURE_SETTINGS)
    return [ColmapSource(folder, path.resolve().name, image_folder, photos, pairs, digest)]


def _photo(image: Any) -> _Photo:
    camera, pose = image.camera, image.cam_from_world()
    R = np.array(pose.rotation.matrix(), dtype=np.float64)
    size = (int(camera.width), int(camera.height))
    parameters = tuple(float(value) for value in camera.params)
    return _Photo(image.name, camera.model.name, size, parameters, R, np.array(pose.translation, dtype=np.float64))


def observed_points(image: Any) -> NDArray[np.int64]:
    """Ascending ids of the reconstructed points that a ``pycolmap.Image`` sees."""
    return np.unique(np.array([point.point3D_id for point in image.get_observation_points2D()], dtype=np.int64))


def covisible_pairs(
    observed: list[NDArray[np.int64]], minimum: int = MIN_COVISIBLE_POINTS
) -> tuple[tuple[int, int], ...]:
    """Pairs (i, j), i < j, of images that share at least ``minimum`` points, from the ids that each observes."""
    pairs = []
    for i, points in enumerate(observed):
        for j in range(i + 1, len(observed)):
            if len(np.intersect1d(points, observed[j], assume_unique=True)) >= minimum:
                pairs.append((i, j))
    return tuple(pairs)
