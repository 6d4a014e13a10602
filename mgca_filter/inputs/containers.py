"""The containers that Python and OpenCV programs hold things in, as plain sequences or arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any

import cv2
import numpy as np

_NO_LISTS = (str, bytes, Mapping, Set, cv2.KeyPoint, cv2.DMatch)


def unpacked(value: Any) -> Any:
    """What a container holds: object arrays and one-way iterators become lists, ``cv2.UMat`` its array.

    Rows of a two-dimensional object array, and rows of a list that are object arrays themselves, become lists as well.
    Everything else, and whatever has no order, comes back as it is.
    """
    if isinstance(value, cv2.UMat):
        return value.get()
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype == object and value.ndim else value
    if isinstance(value, _NO_LISTS) or hasattr(value, "__array__"):
        return value
    if isinstance(value, Iterable) and not isinstance(value, Sequence):
        value = list(value)
    if isinstance(value, Sequence) and any(isinstance(row, np.ndarray) and row.dtype == object for row in value):
        return [row.tolist() if isinstance(row, np.ndarray) and row.dtype == object else row for row in value]
    return value
