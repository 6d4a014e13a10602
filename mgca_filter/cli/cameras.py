"""Cameras on the command line: numbers, or the files in which K and lens distortion are kept.

Files: K as 4, 9, 12 or 16 numbers (``np.savetxt``, ScanNet, KITTI's P); COLMAP's ``cameras.txt`` (its pixel centre is
(0.5, 0.5), models as in COLMAP's documentation); OpenCV's and ROS's YAML, XML and JSON (``cv2.FileStorage``, which
``calibrateCamera``'s samples write, ``camera_info``); ``.npy``, and ``.npz`` as in OpenCV's tutorial. ``FILE:NAME``
chooses one camera of several, by COLMAP's id or by the name of its matrix.
"""

from __future__ import annotations

import argparse
import math
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import Distortion, Fisheye
from ..geometry.orientation import is_quarter_turn, shown_camera, shown_size
from ..images import intrinsics_as_shown, size_of_intrinsics
from ..input_file import read_text

Array = NDArray[np.float64]

HALF_PIXEL = 0.5
# Parameters of COLMAP's models: how many are focal lengths, and what the coefficients after cx, cy make.
_COLMAP_MODELS: Mapping[str, tuple[int, int, Callable[..., Any]]] = {
    "SIMPLE_PINHOLE": (1, 0, lambda: None),
    "PINHOLE": (2, 0, lambda: None),
    "SIMPLE_RADIAL": (1, 1, lambda k: np.array([k, 0.0, 0.0, 0.0])),
    "RADIAL": (1, 2, lambda k1, k2: np.array([k1, k2, 0.0, 0.0])),
    "OPENCV": (2, 4, lambda *c: np.array(c)),
    "FULL_OPENCV": (2, 8, lambda *c: np.array(c)),
    "OPENCV_FISHEYE": (2, 4, Fisheye),
    "SIMPLE_RADIAL_FISHEYE": (1, 1, Fisheye),
    "RADIAL_FISHEYE": (1, 2, Fisheye),
}
_K_NAMES = (
    *("camera_matrix", "cameraMatrix", "Camera_Matrix", "CameraMatrix", "K", "mtx", "intrinsic_matrix", "intrinsics"),
    *("M1", "M2", "K1", "K2", "cameraMatrix1", "cameraMatrix2"),
)
# The coefficients that belong to a matrix, by the matrix's name; any of the common names goes with the others.
_D_NAMES = {"M1": ("D1",), "M2": ("D2",), "K1": ("D1",), "K2": ("D2",)} | {
    f"cameraMatrix{side}": (f"distCoeffs{side}",) for side in (1, 2)
}
_COMMON_D_NAMES = (
    *("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "distortion", "dist", "D"),
)
_FISHEYES = ("fisheye", "equidistant", "kannala_brandt")
_DISTORTION_LENGTHS = (4, 5, 8, 12, 14)
_NUMBERS = re.compile(r"[\s,;\[\]()]+")


@dataclass(frozen=True)
class Camera:
    """What the command line says of a camera.

    Attributes:
        K: (3, 3), pixels, OpenCV's pixel centre.
        distortion: OpenCV's coefficients, those of a fisheye, or None.
        size: (width, height) of its images, or None where that is not said.
        source: how the user named it.
        stored: it is known to be that of the files as they are stored, which COLMAP's are.
    """

    K: Array
    distortion: Distortion | None
    size: tuple[int, int] | None
    source: str
    stored: bool = False


@dataclass(frozen=True)
class CameraArgument:
    """One camera, or several of which the image decides: those of a ``cameras.txt`` with its ``images.txt``."""

    text: str
    cameras: Mapping[str, Camera]
    images: Mapping[str, str]

    def of(self, image: Path) -> Camera:
        """The camera of an image file.

        Raises:
            ValueError: there are several, and nothing says which.
        """
        if len(self.cameras) == 1:
            return next(iter(self.cameras.values()))
        key = self.images.get(match_name(image, self.images) or "")
        if key is not None and key in self.cameras:
            return self.cameras[key]
        names = ", ".join(list(self.cameras)[:4]) + (", ..." if len(self.cameras) > 4 else "")
        raise ValueError(f"{self.text}: holds {len(self.cameras)} cameras; {self.text}:NAME says which of {names}")

    def only(self) -> Camera:
        """The camera, where there is one.

        Raises:
            ValueError: there are several.
        """
        return self.of(Path())


def match_name(image: Path, names: Mapping[str, Any] | Sequence[str]) -> str | None:
    """Which of the names, relative to some folder, is that of an image file: the longest that its path ends with."""
    path = image.resolve().as_posix()
    found = [name for name in names if path.endswith("/" + name.replace("\\", "/").lstrip("./"))]
    if not found:
        found = [name for name in names if name.replace("\\", "/").rsplit("/", 1)[-1] == image.name]
        return found[0] if len(found) == 1 else None
    return max(found, key=len)


def camera(text: str) -> CameraArgument:
    """Camera from ``fx,fy,cx,cy``, ``FILE`` or ``FILE:NAME``, for argparse."""
    if re.fullmatch(r"[-+.\deE\s]+(,[-+.\deE\s]*)*|[-+\w.\s]*(,[-+\w.\s]*){2,}", text) and not Path(text).exists():
        return CameraArgument(text, {"": Camera(intrinsics(text), None, None, text)}, {})
    try:
        return _from_file(text)
    except OSError as error:
        reason = "no such file, and not fx,fy,cx,cy" if isinstance(error, FileNotFoundError) else error.strerror
        raise argparse.ArgumentTypeError(f"{text}: {reason}") from None
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}") from None


def intrinsics(text: str) -> Array:
    """K (3, 3) from ``fx,fy,cx,cy``, for argparse."""
    try:
        fx, fy, cx, cy = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected fx,fy,cx,cy in pixels, got {text!r}") from None
    if not all(math.isfinite(value) for value in (fx, fy, cx, cy)) or fx <= 0 or fy <= 0:
        raise argparse.ArgumentTypeError(f"expected finite numbers and positive focal lengths, got {text!r}")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def distortion(text: str) -> Distortion | None:
    """Lens distortion from ``k1,k2,p1,p2[,...]``, ``fisheye:k1,k2,k3,k4`` or a file that holds it, for argparse."""
    fisheye, _, numbers = text.partition("fisheye:")
    try:
        if Path(text).is_file():
            return _distortion_file(Path(text))
        values = [float(word) for word in (numbers or fisheye).split(",")]
    except ValueError as error:
        told = (
            f"{text}: {error}"
            if Path(text).is_file()
            else f"expected k1,k2,p1,p2[,...], fisheye:k1,... or a file: {text}"
        )
        raise argparse.ArgumentTypeError(told) from None
    try:
        return _as_distortion(values, bool(numbers))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _distortion_file(path: Path) -> Distortion | None:
    text = read_text(path)
    if _is_storage(path, text):
        values = _storage_values(text)
        named = [name for name in (*_COMMON_D_NAMES, "D1") if name in values]
        if not named:
            raise ValueError(f"no distortion coefficients ({', '.join(_COMMON_D_NAMES)})")
        return _as_distortion(values[named[0]], _is_fisheye(text))
    return _as_distortion(_plain_numbers(text), fisheye=False)


def _as_distortion(values: Any, fisheye: bool) -> Distortion | None:
    coefficients = np.asarray(values, dtype=np.float64).ravel()
    if not np.isfinite(coefficients).all():
        raise ValueError("distortion coefficients: expected finite numbers")
    if fisheye and len(coefficients) <= 4:
        return Fisheye(*coefficients.tolist())
    if fisheye or len(coefficients) not in _DISTORTION_LENGTHS:
        expected = "up to 4 for a fisheye" if fisheye else "4, 5, 8, 12 or 14"
        raise ValueError(f"distortion coefficients: expected {expected}, got {len(coefficients)}")
    return coefficients if coefficients.any() else None


_BINARY_HINT = "; `colmap model_converter --output_type TXT` writes one"


def _from_file(text: str) -> CameraArgument:
    path, name = Path(text), ""
    if not path.exists() and ":" in text:
        before, _, name = text.rpartition(":")
        path = Path(before)
    if path.is_dir():
        path = path / "cameras.txt"
    if path.suffix in (".npy", ".npz"):
        cameras = _numpy_cameras(path, text)
    else:
        try:
            content = read_text(path)
        except ValueError as error:
            raise ValueError(f"{error}{_BINARY_HINT if path.suffix == '.bin' else ''}") from None
        if _is_storage(path, content):
            cameras = _storage_cameras(content, text)
        elif any(line.split()[1:2] and line.split()[1] in COLMAP_NAMES for line in content.splitlines()):
            cameras = _colmap_cameras(content, text)
        else:
            cameras = {"": Camera(_matrix(_plain_numbers(content)), None, None, text)}
    if name:
        if name not in cameras:
            raise ValueError(f"no camera {name}, but {', '.join(cameras)}")
        cameras = {name: cameras[name]}
    images = path.with_name("images.txt")
    listed = (
        {} if len(cameras) == 1 or not images.is_file() else {n: c for n, (c, _, _) in colmap_images(images).items()}
    )
    return CameraArgument(text, cameras, listed)


COLMAP_NAMES = frozenset(
    (*_COLMAP_MODELS, "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION")
)


def _colmap_cameras(content: str, source: str) -> dict[str, Camera]:
    cameras = {}
    for number, line in enumerate(content.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            key, model, width, height = words[0], words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (IndexError, ValueError):
            raise ValueError(f"line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None
        if model not in _COLMAP_MODELS:
            raise ValueError(f"line {number}: camera model {model} is not known here ({', '.join(_COLMAP_MODELS)})")
        focals, coefficients, lens = _COLMAP_MODELS[model]
        if len(values) != focals + 2 + coefficients:
            raise ValueError(f"line {number}: {model} has {focals + 2 + coefficients} parameters, got {len(values)}")
        K = np.array(
            [
                [values[0], 0, values[focals] - HALF_PIXEL],
                [0, values[focals - 1], values[focals + 1] - HALF_PIXEL],
                [0, 0, 1.0],
            ]
        )
        cameras[key] = Camera(_checked(K), lens(*values[focals + 2 :]), (width, height), source, stored=True)
    if not cameras:
        raise ValueError("no camera in it")
    return cameras


def colmap_images(path: Path) -> dict[str, tuple[str, Array, Array]]:
    """Camera id, R (3, 3) and t (3,), world to camera, of each image of COLMAP's ``images.txt``, by name.

    Raises:
        OSError, ValueError: it cannot be read, or is none.
    """
    images = {}
    lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
    for line in lines[::2]:  # every second one lists keypoints, and may be empty
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            qw, qx, qy, qz, *t = (float(word) for word in words[1:8])
            name, q = words[9].strip(), np.array([qw, qx, qy, qz])
        except (IndexError, ValueError):
            raise ValueError(
                "expected lines IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, as COLMAP writes them"
            ) from None
        images[name] = (words[8], rotation_of_quaternion(q), np.array(t))
    return images


def rotation_of_quaternion(q: Array) -> Array:
    """(3, 3) of a quaternion (w, x, y, z) of any length above zero.

    Raises:
        ValueError: its length is zero.
    """
    length = float(np.linalg.norm(q))
    if not length > 0:
        raise ValueError("a quaternion of length zero")
    w, (x, y, z) = q[0] / length, q[1:] / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Array = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    return rotation


def _is_storage(path: Path, text: str) -> bool:
    return path.suffix.lower() in (".yml", ".yaml", ".xml", ".json") or text.lstrip().startswith(("%YAML", "<?xml"))


def _storage_values(text: str) -> dict[str, Array]:
    """Matrices and lists of numbers of a ``cv2.FileStorage``, ROS's ``rows, cols, data`` among them, by name."""
    start = text.lstrip()
    if not start.startswith(("%YAML", "<?xml", "{")):
        start = "%YAML:1.0\n---\n" + re.sub(r"\A---\s*\n", "", start)
    start = re.sub(r"\A%YAML 1\.\d", "%YAML:1.0", start)
    values: dict[str, Array] = {}
    try:
        storage = cv2.FileStorage(start, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        for name in root.keys() if root.isMap() else ():
            found = _node_numbers(root.getNode(name))
            if found is not None:
                values[name] = found
    except (cv2.error, SystemError) as error:
        raise ValueError("cannot be read as OpenCV's YAML, XML or JSON") from error
    return values


def _node_numbers(node: Any) -> Array | None:
    """Numbers of a node: a matrix of OpenCV's, a map with ``data``, a list, however nested, or one number; or None."""
    if node.isMap():
        if not node.getNode("dt").empty():
            return np.asarray(node.mat(), dtype=np.float64)
        data = node.getNode("data")
        return None if data.empty() else _node_numbers(data)
    if node.isSeq():
        parts = [_node_numbers(node.at(i)) for i in range(node.size())]
        known = [part.ravel() for part in parts if part is not None]
        return np.concatenate([np.zeros(0), *known]) if len(known) == len(parts) else None
    return np.array([node.real()]) if node.isInt() or node.isReal() else None


def _is_fisheye(text: str) -> bool:
    found = re.search(r"(distortion_model|camera_model|fisheye_model)\W+(\w+)", text)
    return found is not None and (found[2].lower() in _FISHEYES or (found[1] == "fisheye_model" and found[2] == "1"))


def _storage_cameras(text: str, source: str) -> dict[str, Camera]:
    values = _storage_values(text)
    sides = [values.get(name) for name in ("image_width", "image_height")]
    width, height = sides if all(side is not None and side.size == 1 for side in sides) else (None, None)
    size = None if width is None or height is None else (int(width[0]), int(height[0]))
    return _named_cameras(values, size, source, _is_fisheye(text))


def _numpy_cameras(path: Path, source: str) -> dict[str, Camera]:
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {"": Camera(_matrix(loaded), None, None, source)}
        with loaded as archive:
            known = {*_K_NAMES, *_COMMON_D_NAMES, "D1", "D2", "distCoeffs1", "distCoeffs2"}
            values = {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files if name in known}
    except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"cannot be read as numpy's arrays ({' '.join(str(error).split())})") from None
    return _named_cameras(values, None, source, fisheye=False)


def _named_cameras(
    values: Mapping[str, Array], size: tuple[int, int] | None, source: str, fisheye: bool
) -> dict[str, Camera]:
    cameras = {}
    for name in _K_NAMES:
        if name not in values:
            continue
        coefficients = next((values[d] for d in _D_NAMES.get(name, _COMMON_D_NAMES) if d in values), None)
        lens = None if coefficients is None or coefficients.size == 0 else _as_distortion(coefficients, fisheye)
        cameras[name] = Camera(_matrix(values[name]), lens, size, source)
    if not cameras:
        raise ValueError(f"no camera matrix in it ({', '.join(_K_NAMES[:6])}, ...)")
    return cameras


def _plain_numbers(text: str) -> Array:
    words = [word for line in text.splitlines() for word in _NUMBERS.split(line.split("#")[0]) if word]
    if words and words[0].endswith(":"):  # KITTI's "P0:"
        words = words[1:]
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise ValueError(f"expected numbers ({error})") from None


def _matrix(values: Array) -> Array:
    """K (3, 3) of 4, 9, 12 (3, 4) or 16 (4, 4) numbers."""
    numbers = np.asarray(values, dtype=np.float64).ravel()
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return _checked(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
    columns = {9: 3, 12: 4, 16: 4}.get(len(numbers))
    if columns is None:
        raise ValueError(f"expected K as 9 numbers (3 x 3) or 4 (fx fy cx cy), got {len(numbers)}")
    return _checked(numbers.reshape(-1, columns)[:3, :3])


def _checked(K: Array) -> Array:
    if (
        not np.isfinite(K).all()
        or K[0, 0] <= 0
        or K[1, 1] <= 0
        or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
    ):
        raise ValueError(
            f"expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths, got {K.tolist()}"
        )
    return K


def camera_as_shown(one: Camera, path: Path, shown: tuple[int, int], orientation: int) -> Camera:
    """The camera of a photo as it is shown, ``shown`` = (width, height), which EXIF ``orientation`` may have turned.

    Raises:
        ValueError: the camera is one of images of another size, or its coefficients cannot be turned.
    """
    stored = shown_size(orientation, shown)
    if one.size is not None and one.size not in (shown, stored):
        hint = ""
        if one.size[0] * shown[1] == one.size[1] * shown[0]:
            fx, fy, cx, cy = one.K[[0, 1, 0, 1], [0, 1, 2, 2]]
            f = shown[0] / one.size[0]
            hint = f"; resized with it, K is {f * fx:g},{f * fy:g},{f * (cx + 0.5) - 0.5:g},{f * (cy + 0.5) - 0.5:g}"
        raise ValueError(
            f"{one.source}: a camera of {one.size[0]} x {one.size[1]} pixels, {path} has {shown[0]} x {shown[1]}{hint}"
        )
    size = one.size or size_of_intrinsics(one.K, [(shown, orientation)]) or shown
    K = intrinsics_as_shown(one.K, size, shown, orientation)
    if K is None or K is one.K or not is_quarter_turn(orientation):
        return one
    return Camera(K, _turned(one.distortion, orientation), shown, one.source)


def _turned(lens: Distortion | None, orientation: int) -> Distortion | None:
    """Coefficients of the turned camera: the radial ones stay, (p2, p1) is a vector on the image plane."""
    if lens is None or isinstance(lens, Fisheye):
        return lens
    if len(lens) > 8 and lens[8:].any():
        raise ValueError("thin prism and tilt coefficients cannot be turned with a photo: turn the file first")
    turned = lens.copy()
    turned[[3, 2]] = shown_camera(orientation)[:2, :2] @ lens[[3, 2]]
    return turned
