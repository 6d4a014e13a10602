"""The true pose of a pair, from a file: so that the command can say how far off an answer is, and who is right.

Files: a relative pose X2 = R X1 + t as JSON with "R" and "t" (such as what ``--json`` writes) or as 12 or 16 numbers
([R | t], row by row); COLMAP's ``images.txt`` or its folder, which has the pose of each image by its name; a list of
pairs in SuperGlue's format, which has a line for the pair.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import essential_from_pose, rotation_error_deg, sampson_distance, translation_error_deg
from ..geometry.orientation import shown_camera
from ..input_file import read_text
from .cameras import colmap_images, match_name

Array = NDArray[np.float64]
RIGHT_PX = 3.0
"""A match within this distance (Sampson) of the true epipolar geometry is right, as in the HTML report."""
_SUPERGLUE_VALUES = 38
_ORTHONORMAL_WITHIN = 1e-3


@dataclass(frozen=True)
class TruePose:
    """X2 = R X1 + t, R (3, 3) and t (3,) of any length, between the cameras of the photos as they are shown."""

    R: Array
    t: Array

    def errors_deg(self, R: Array | None, t: Array | None) -> tuple[float | None, float | None]:
        """Angles between the rotations and between the directions of translation; None where there is nothing."""
        turned = None if R is None else rotation_error_deg(R, self.R)
        return turned, None if t is None or not np.any(self.t) else translation_error_deg(t, self.t)

    def right(self, correspondences: Array, focal_px: float) -> NDArray[np.bool_]:
        """Which of the normalised correspondences (M, 4) lie within :data:`RIGHT_PX` of their true epipolar lines."""
        distance_px = sampson_distance(correspondences, essential_from_pose(self.R, self.t)) * focal_px
        return np.asarray(distance_px < RIGHT_PX)


def existing(text: str) -> Path:
    """A file or folder that is there, for argparse."""
    path = Path(text)
    if not path.exists():
        raise argparse.ArgumentTypeError(f"{text}: no such file")
    return path


def read_truth(path: Path, images: tuple[Path, Path], orientations: tuple[int, int]) -> TruePose:
    """The true pose of two image files, whose EXIF orientations say how they are shown.

    COLMAP and lists of pairs know the files as they are stored; a pose alone is taken for the photos as they are shown.

    Raises:
        ValueError: the file cannot be read, or does not hold the pair; the message names it.
    """
    try:
        if path.is_dir():
            path = path / "images.txt"
        text = read_text(path)
        if text.lstrip().startswith("{"):
            return _checked(*_json_pose(text))
        lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
        words = lines[0].split() if lines else []
        if len(words) == _SUPERGLUE_VALUES:
            R, t = _listed_pose(lines, images)
        elif _is_number_table(lines):
            numbers = np.array([float(word) for line in lines for word in line.replace(",", " ").split()])
            if len(numbers) not in (12, 16):
                raise ValueError(f"expected 12 or 16 numbers, [R | t] row by row, got {len(numbers)}")
            pose = numbers.reshape(-1, 4)[:3]
            return _checked(pose[:, :3], pose[:, 3])
        else:
            R, t = _colmap_pose(path, images)
        S1, S2 = (shown_camera(orientation) for orientation in orientations)
        return _checked(S2 @ R @ S1.T, S2 @ t)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _json_pose(text: str) -> tuple[Array, Array]:
    try:
        document = json.loads(text)
        return np.array(document["R"], dtype=np.float64), np.array(document["t"], dtype=np.float64).ravel()
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError('expected a JSON object with "R" (3 x 3) and "t" (3)') from error


def _is_number_table(lines: list[str]) -> bool:
    try:
        return (
            len([float(word) for line in lines[:4] for word in line.replace(",", " ").split()]) > 0 and len(lines) <= 4
        )
    except ValueError:
        return False


def _listed_pose(lines: list[str], images: tuple[Path, Path]) -> tuple[Array, Array]:
    for line in lines:
        words = line.split()
        if len(words) != _SUPERGLUE_VALUES:
            continue
        T = np.array([float(word) for word in words[22:]]).reshape(4, 4)
        names = [match_name(image, words[:2]) for image in images]
        if names == words[:2]:
            return T[:3, :3], T[:3, 3]
        if names == words[1::-1]:
            return T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    raise ValueError(f"no line for {images[0].name} and {images[1].name}")


def _colmap_pose(path: Path, images: tuple[Path, Path]) -> tuple[Array, Array]:
    poses = colmap_images(path)
    (R1, t1), (R2, t2) = (poses[_known(image, list(poses))][1:] for image in images)
    R = R2 @ R1.T
    return R, t2 - R @ t1


def _known(image: Path, names: list[str]) -> str:
    name = match_name(image, names)
    if name is None:
        raise ValueError(f"holds no pose of {image.name}")
    return name


def _checked(R: Array, t: Array) -> TruePose:
    if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise ValueError("expected R (3 x 3) and t (3), finite")
    if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL_WITHIN or np.linalg.det(R) < 0:
        raise ValueError("R is no rotation")
    return TruePose(R, t)
