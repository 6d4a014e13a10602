"""Image files: from their bytes to pixels, and what speaks against intrinsics of an image."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from .exif import exif_orientation
from .geometry.orientation import UPRIGHT, is_quarter_turn, shown_intrinsics, shown_size
from .image_header import promised_size

MAX_PIXELS = 2**28
"""Of a file that is decoded, unless the environment says otherwise: 16384 x 16384, more than any camera takes."""
MAX_FILE_BYTES = 2**31
"""Of an image file; :data:`MAX_PIXELS` take 3 bytes each where nothing is compressed, 6 of 16 bits."""
MAX_PIXELS_VARIABLE = "OPENCV_IO_MAX_IMAGE_PIXELS"
"""OpenCV's own limit, which it reads once, when it is loaded, and which is 2^30 by default."""

# Values that lie beyond are clipped: hot and dead pixels would take up the range.
_STRETCHED_SHARE = (0.001, 0.999)
# Of the longer side of an image: shorter focal lengths are those of a fisheye at the very least.
_SHORTEST_FOCAL_SHARE = 0.1
# A principal point is near the middle of its image; these shares of its sides are far off.
_MIDDLE = (0.25, 0.75)


def decode_photo(data: bytes) -> tuple[NDArray[np.uint8], int]:
    """Colour image (h, w, 3) BGR uint8 as it is to be shown, and the EXIF orientation that it was stored in, 1 to 8.

    As ``cv2.imread``, of every format that carries EXIF data (JPEG, TIFF, PNG, WebP), whatever the version of OpenCV
    makes of them. Depth, limits and errors as :func:`decode_image`.
    """
    orientation = exif_orientation(data)
    image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # OpenCV turns TIFF files even where it is told not to.
    return (image if data[:2] in (b"II", b"MM") else _as_shown(image, orientation)), orientation


def _as_shown(image: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    if orientation == UPRIGHT:
        return image
    if orientation >= 5:
        image = np.asarray(cv2.transpose(image), dtype=np.uint8)
    # Along which axes the image, transposed where it has to be, is mirrored as well: cv2.flip's code.
    code = {2: 1, 3: -1, 4: 0, 6: 1, 7: -1, 8: 0}.get(orientation)
    return image if code is None else np.asarray(cv2.flip(image, code), dtype=np.uint8)


def decode_image(data: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    """Colour image (h, w, 3) BGR uint8, upright as its EXIF says unless ``flags`` of ``cv2.imdecode`` say otherwise.

    Of 16 bits a channel the upper 8 are taken where the values fill half of the range or more; else, as thermal,
    10-bit and 12-bit cameras write them, the values are stretched.

    A file whose header promises more than :data:`MAX_PIXELS`, or than ``OPENCV_IO_MAX_IMAGE_PIXELS`` says in the
    environment, is refused before anything is allocated for it.

    Raises:
        ValueError: the file is empty, broken, no image, or promises too many pixels.
    """
    if not data:
        raise ValueError("the file is empty")
    _check_size(data)
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


def _check_size(data: bytes) -> None:
    size = promised_size(data)
    wish = os.environ.get(MAX_PIXELS_VARIABLE, "")
    limit = int(wish) if wish.isdecimal() else MAX_PIXELS
    if size is not None and size[0] * size[1] > limit:
        raise ValueError(
            f"its header promises {size[0]} x {size[1]} pixels, more than {limit}; {MAX_PIXELS_VARIABLE} in the "
            "environment sets another limit"
        )


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


def intrinsics_unit_doubt(K: NDArray[np.float64], size: tuple[int, int]) -> str | None:
    """A sentence where the focal length of ``K`` (3, 3) is hardly one in pixels of an image of (width, height)."""
    if K[0, 0] >= _SHORTEST_FOCAL_SHARE * max(size):
        return None
    return (
        f"a focal length of {K[0, 0]:g} px is that of no lens for an image of {size[0]} x {size[1]}; K is in pixels, "
        "not in millimetres or shares of the image"
    )


def size_of_intrinsics(K: NDArray[np.float64], photos: Iterable[tuple[tuple[int, int], int]]) -> tuple[int, int] | None:
    """The size (width, height) that one K (3, 3) of several photos belongs to; None without photos.

    Args:
        photos: (width, height) as it is shown, and EXIF orientation, of each.

    Returns:
        The commonest of the sizes in which the photos are shown or stored, for K may be meant for either; of equally
        common ones that whose middle the principal point is nearer to.
    """
    counts = Counter(
        size
        for shown, orientation in photos
        for size in {shown, shown_size(orientation, shown) if is_quarter_turn(orientation) else shown}
    )
    return max(counts, key=lambda size: (counts[size], -_off_centre(K, size), size), default=None)


def _off_centre(K: NDArray[np.float64], size: tuple[int, int]) -> float:
    return float(np.abs(K[:2, 2] / size - 0.5).max())


def intrinsics_as_shown(
    K: NDArray[np.float64], K_size: tuple[int, int], shown: tuple[int, int], orientation: int
) -> NDArray[np.float64] | None:
    """K (3, 3) of a photo as it is shown, from that of images of ``K_size``; None where the photo is of another size.

    A photo that is of that size as it is stored, because EXIF ``orientation`` turns it by a quarter, gets K turned with
    it. ``shown`` is its (width, height) as it is shown.
    """
    if shown == K_size:
        return K
    if is_quarter_turn(orientation) and shown_size(orientation, shown) == K_size:
        return shown_intrinsics(K, orientation, K_size)
    return None
