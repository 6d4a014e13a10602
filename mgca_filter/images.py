"""From the bytes of an image file to its pixels: what is broken or absurdly large is refused, with the reason."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_header import MAX_PIXELS, promised_size


def decode_image(data: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    """Colour image (h, w, 3) BGR uint8, upright as its EXIF says unless ``flags`` of ``cv2.imdecode`` say otherwise.

    Raises:
        ValueError: the file is empty, broken, no image, or promises more than 2^28 pixels.
    """
    if not data:
        raise ValueError("the file is empty")
    width, height = promised_size(data) or (0, 0)
    if width * height > MAX_PIXELS:
        raise ValueError(f"its header promises {width} x {height} pixels, at most {MAX_PIXELS} are read")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError) as error:
        # OpenCV refuses more than 2^30 pixels unless OPENCV_IO_MAX_IMAGE_PIXELS says otherwise.
        raise ValueError("OpenCV cannot decode it; it is broken or too large") from error
    if image is None:
        raise ValueError("not an image that OpenCV can decode")
    return np.asarray(image, dtype=np.uint8)
