"""Keypoints in: ``cv2.KeyPoint`` sequences or arrays of pixels, to one plain structure.

Pixels follow OpenCV throughout: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

DETECTORS = ("sift", "orb", "akaze")
DETECTOR_MAX_SIDE_PX = 1200
SIFT_FEATURE_COUNT = 2000
SIFT_CONTRAST_THRESHOLD = 1e-5
# In a narrower strip OpenCV's detectors find nothing, and some of them fail.
_NARROWEST_PX = 6


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one image.

    Attributes:
        points: (N, 2) float64 pixels; may hold NaN or infinite values, which later steps set aside.
        size: (N,) float32 diameters in pixels, or None where the caller gave bare points.
        angle: (N,) float32 orientations in degrees, −1 = unknown, or None.
    """

    points: NDArray[np.float64]
    size: NDArray[np.float32] | None = None
    angle: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points)


def read_keypoints(keypoints: Any, name: str = "keypoints") -> Keypoints:
    """Read a sequence of ``cv2.KeyPoint`` or an array (N, 2) or (N, 1, 2) of pixels.

    Args:
        keypoints: what the caller holds; an empty sequence gives no keypoints.
        name: name of the argument, for messages.

    Raises:
        TypeError: neither KeyPoints nor numbers, or a mixture of both.
        ValueError: an array of another shape.
    """
    if keypoints is None or isinstance(keypoints, (str, bytes, dict, cv2.KeyPoint)):
        raise TypeError(
            f"{name}: expected a sequence of cv2.KeyPoint or an array (N, 2), got {type(keypoints).__name__}"
        )
    if isinstance(keypoints, Sequence):
        if any(isinstance(item, cv2.KeyPoint) for item in keypoints):
            return _from_cv2(keypoints, name)
        if len(keypoints) == 0:
            return Keypoints(np.zeros((0, 2)))
    return Keypoints(_read_points(keypoints, name))


def _from_cv2(keypoints: Sequence[Any], name: str) -> Keypoints:
    # Types first, each only once, then one field after the other: a quarter of the time of going object by object.
    if not all(issubclass(kind, cv2.KeyPoint) for kind in set(map(type, keypoints))):
        i, item = next((i, item) for i, item in enumerate(keypoints) if not isinstance(item, cv2.KeyPoint))
        raise TypeError(f"{name}[{i}]: expected cv2.KeyPoint like its neighbours, got {type(item).__name__}")
    points = np.asarray(cv2.KeyPoint.convert(tuple(keypoints)), dtype=np.float64)
    size, angle = (
        np.fromiter(map(attrgetter(field), keypoints), dtype=np.float32, count=len(keypoints))
        for field in ("size", "angle")
    )
    return Keypoints(points, size, angle)


def _read_points(points: Any, name: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(points)
    except (ValueError, TypeError) as error:  # rows of different length
        raise ValueError(f"{name}: expected an array (N, 2) of pixels ({error})") from error
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{name}: expected cv2.KeyPoint or real numbers, got dtype {array.dtype}")
    if array.size == 0 and array.shape in ((0,), (0, 2), (0, 1, 2)):
        return np.zeros((0, 2))
    if array.ndim == 3 and array.shape[1:] == (1, 2):
        array = array[:, 0]
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name}: expected shape (N, 2) or (N, 1, 2), got {array.shape}")
    return array.astype(np.float64)


def create_detector(name: str = "sift", feature_count: int = SIFT_FEATURE_COUNT) -> cv2.Feature2D:
    """Make one of OpenCV's detectors: ``"sift"``, ``"orb"`` or ``"akaze"``.

    SIFT comes with the settings that the training data used, a contrast threshold low enough to fill
    ``feature_count`` on plain walls as well.

    Raises:
        ValueError: another name, or a feature count below 1.
    """
    if feature_count < 1:
        raise ValueError(f"feature_count: expected at least 1, got {feature_count}")
    if name == "sift":
        return cv2.SIFT.create(nfeatures=feature_count, contrastThreshold=SIFT_CONTRAST_THRESHOLD)
    if name == "orb":
        return cv2.ORB.create(nfeatures=feature_count)
    if name == "akaze":
        # OpenCV 5 moved AKAZE to the contrib module.
        akaze: type[cv2.xfeatures2d.AKAZE] = getattr(cv2, "AKAZE", None) or cv2.xfeatures2d.AKAZE
        return akaze.create(max_points=feature_count)
    raise ValueError(f"detector: expected {', '.join(DETECTORS)} or a cv2.Feature2D, got {name!r}")


def detect_keypoints(
    image: NDArray[Any], detector: cv2.Feature2D, name: str = "image", max_side_px: int = DETECTOR_MAX_SIDE_PX
) -> tuple[list[cv2.KeyPoint], NDArray[Any]]:
    """Detect and describe on a grey copy of at most ``max_side_px``, in pixels of the original.

    Args:
        image: uint8 (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA.
        detector: any ``cv2.Feature2D`` that describes.
        name: name of the argument, for messages.
        max_side_px: longer side of the image that the detector sees; larger ones shrink by area averages.

    Returns:
        Keypoints with positions and sizes in pixels of ``image``, and descriptors (N, D); no keypoints and
        an empty (0, 0) array when nothing is found.

    Raises:
        TypeError: ``image`` is not a uint8 array, or ``detector`` does not describe. ValueError: ``image`` has not the
            shape of an image.
    """
    grey = _grey(image, name)
    scale = min(1.0, max_side_px / max(grey.shape))
    if scale < 1.0:
        width, height = (max(1, round(side * scale)) for side in (grey.shape[1], grey.shape[0]))
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    else:
        small = grey
    nothing: tuple[list[cv2.KeyPoint], NDArray[Any]] = [], np.zeros((0, 0), dtype=np.float32)
    if min(small.shape) < _NARROWEST_PX:
        return nothing
    try:
        keypoints, descriptors = detector.detectAndCompute(small, None)
    except cv2.error as error:
        if error.code != cv2.Error.StsNotImplemented:
            raise
        raise TypeError(f"detector: expected one that describes, got {type(detector).__name__}") from error
    if descriptors is None or len(keypoints) == 0:
        return nothing
    scale_x, scale_y = small.shape[1] / grey.shape[1], small.shape[0] / grey.shape[0]
    return [_rescaled(k, scale_x, scale_y) for k in keypoints], descriptors


def _rescaled(keypoint: cv2.KeyPoint, scale_x: float, scale_y: float) -> cv2.KeyPoint:
    """The keypoint in the original: pixels are areas, so the half pixel at the border scales as well."""
    if scale_x == 1.0 and scale_y == 1.0:
        return keypoint
    x, y = keypoint.pt
    return cv2.KeyPoint(
        (x + 0.5) / scale_x - 0.5,
        (y + 0.5) / scale_y - 0.5,
        keypoint.size / (scale_x * scale_y) ** 0.5,
        keypoint.angle,
        keypoint.response,
        keypoint.octave,
        keypoint.class_id,
    )


def _grey(image: Any, name: str) -> NDArray[np.uint8]:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        got = f"dtype {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise TypeError(f"{name}: expected a uint8 image array, got {got}")
    if image.ndim not in (2, 3) or min(image.shape[:2]) == 0 or (image.ndim == 3 and image.shape[2] not in (1, 3, 4)):
        raise ValueError(f"{name}: expected shape (H, W), (H, W, 3) or (H, W, 4), got {image.shape}")
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
    grey: NDArray[np.uint8] = cv2.cvtColor(image, code)  # type: ignore[assignment]
    return grey
