"""Detect, describe and match: from two images to keypoints, descriptors and putative matches."""

from __future__ import annotations

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


def match_descriptors(
    descriptors1: NDArray[Any], descriptors2: NDArray[Any], norm: int | None = None
) -> tuple[tuple[cv2.DMatch, ...], ...]:
    """Two nearest neighbours in image 2 of every descriptor of image 1, as ``knnMatch`` returns them.

    Args:
        descriptors1, descriptors2: (N, D), of the same dtype. Without descriptors on either side there are no
            matches.
        norm: ``cv2.NORM_*``; None = Hamming distance for uint8, Euclidean distance for all others.

    Raises:
        ValueError: the two descriptor arrays differ in dtype or length D.
    """
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return ()
    if descriptors1.dtype != descriptors2.dtype or descriptors1.shape[1:] != descriptors2.shape[1:]:
        raise ValueError(
            f"descriptors2: expected {descriptors1.dtype} of length {descriptors1.shape[1:]} like descriptors1, "
            f"got {descriptors2.dtype} of length {descriptors2.shape[1:]}"
        )
    if norm is None:
        norm = cv2.NORM_HAMMING if descriptors1.dtype == np.uint8 else cv2.NORM_L2
    return tuple(tuple(row) for row in cv2.BFMatcher(norm).knnMatch(descriptors1, descriptors2, k=2))
