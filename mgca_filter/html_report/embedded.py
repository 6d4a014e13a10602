"""Images and columns of numbers as text, small enough for one file."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.uint8]

MAX_SIDE_PX = 1600
_QUALITIES = (88, 80, 72, 64, 56, 48)
_NOTHING = 65535  # code of NaN


def embed_images(
    images: Sequence[Image], budget_bytes: int, max_side_px: int = MAX_SIDE_PX, least_side_px: int = 160
) -> list[str]:
    """JPEG data addresses of BGR images that have ``budget_bytes`` characters together, at most.

    The longer side is at most ``max_side_px``. Quality is lowered first, then size; what is over the budget at
    ``least_side_px`` is embedded all the same.
    """
    side = max_side_px
    while True:
        shrunk = [_shrink(image, side) for image in images]
        for quality in _QUALITIES:
            encoded = [_data_address(image, quality) for image in shrunk]
            if sum(map(len, encoded)) <= budget_bytes:
                return encoded
        if side <= least_side_px:
            return encoded
        side = max(least_side_px, int(side * 0.8))


def _shrink(image: Image, side: int) -> Image:
    height, width = image.shape[:2]
    scale = side / max(height, width)
    if scale >= 1.0:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _data_address(image: Image, quality: int) -> str:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    encoded = cv2.imencode(".jpg", image, options)[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def pack(values: ArrayLike) -> dict[str, Any]:
    """A column (N,) in 16 bits a value: ``lo``, ``hi`` and ``codes``, base64 of little-endian numbers 0 … 65534.

    A value is lo + (hi − lo) · code / 65534, so that it is exact to (hi − lo) / 131 068; code 65535 stands for what is
    not finite.
    """
    column = np.asarray(values, dtype=np.float64).ravel()
    finite = np.isfinite(column)
    lo, hi = (float(column[finite].min()), float(column[finite].max())) if finite.any() else (0.0, 0.0)
    codes = np.full(len(column), _NOTHING, dtype="<u2")
    codes[finite] = np.rint((column[finite] - lo) / max(hi - lo, 1e-300) * (_NOTHING - 1))
    return {"lo": lo, "hi": hi, "codes": base64.b64encode(codes.tobytes()).decode("ascii")}


def pack_mask(mask: ArrayLike) -> str:
    """A mask (N,) as base64 of its bits, the first in the lowest bit of the first byte."""
    bits = np.packbits(np.asarray(mask, dtype=bool).ravel(), bitorder="little")
    return base64.b64encode(bits.tobytes()).decode("ascii")
