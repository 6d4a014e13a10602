"""Image files: from their bytes to pixels, and what speaks against intrinsics of an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Values that lie beyond are clipped: hot and dead pixels would take up the range.
_STRETCHED_SHARE = (0.001, 0.999)
# A principal point is near the middle of its image; these shares of its sides are far off.
_MIDDLE = (0.25, 0.75)


def decode_image(data: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    """Colour image (h, w, 3) BGR uint8, upright as its EXIF says unless ``flags`` of ``cv2.imdecode`` say otherwise.

    Of 16 bits a channel the upper 8 are taken where the values fill half of the range or more; else, as thermal,
    10-bit and 12-bit cameras write them, the values are stretched.

    OpenCV refuses files that promise more than 2^30 pixels, or than ``OPENCV_IO_MAX_IMAGE_PIXELS`` says in the
    environment from which OpenCV is loaded, before it allocates them.

    Raises:
        ValueError: the file is empty, broken, no image, or promises too many pixels.
    """
    if not data:
        raise ValueError("the file is empty")
    encoded = np.frombuffer(data, np.uint8)
    try:
        image = cv2.imdecode(encoded, flags | cv2.IMREAD_ANYDEPTH)
        if image is not None and image.dtype not in (np.uint8, np.uint16):
            image = cv2.imdecode(encoded, flags)
    except (cv2.error, MemoryError) as error:
        raise ValueError("OpenCV cannot decode it; it is broken or too large") from error
    if image is None:
        raise ValueError("not an image that OpenCV can decode")
    return _eight_bits(np.asarray(image, dtype=np.uint16)) if image.dtype == np.uint16 else np.asarray(image, np.uint8)


def _eight_bits(image: NDArray[np.uint16]) -> NDArray[np.uint8]:
    counts = sum(cv2.calcHist([image], [channel], None, [65536], [0, 65536]).ravel() for channel in range(3))
    low, high = np.searchsorted(np.cumsum(counts, dtype=np.float64), np.multiply(_STRETCHED_SHARE, image.size))
    if high - low >= 2**15:
        return (image >> 8).astype(np.uint8)
    raised = np.clip(image, low, high) - np.uint16(low)
    return np.asarray(cv2.convertScaleAbs(raised, alpha=255.0 / max(1, high - low)), dtype=np.uint8)


def principal_point_doubt(K: NDArray[np.float64], size: tuple[int, int]) -> str | None:
    """What speaks against ``K`` (3, 3) being the intrinsics of an image of (width, height) pixels, or None."""
    x, y = K[:2, 2] / size
    if _MIDDLE[0] <= x <= _MIDDLE[1] and _MIDDLE[0] <= y <= _MIDDLE[1]:
        return None
    return f"the principal point {K[0, 2]:g},{K[1, 2]:g} is far from the middle of an image of {size[0]} x {size[1]}"
