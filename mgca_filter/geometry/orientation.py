"""Photographs that are stored turned or mirrored: EXIF's eight orientations as maps of pixels and of camera frames.

An orientation says how the stored image is to be shown (CIPA DC-008, tag 0x0112): 1 as it is, 2 mirrored left to right,
3 turned by 180 degrees, 4 mirrored top to bottom, 5 transposed, 6 turned by 90 degrees clockwise, 7 mirrored about the
other diagonal, 8 turned by 90 degrees counter-clockwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

UPRIGHT = 1
# Columns: where a step to the right and a step down in the stored image lead in the image as it is shown.
_STEPS = {
    1: ((1, 0), (0, 1)),
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, -1), (1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, 1), (-1, 0)),
}


def is_quarter_turn(orientation: int) -> bool:
    """Width and height change places."""
    return orientation >= 5


def shown_size(orientation: int, stored_size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of the image as it is shown; the same function leads back."""
    width, height = stored_size
    return (height, width) if is_quarter_turn(orientation) else (width, height)


def shown_pixels(orientation: int, stored_size: tuple[int, int]) -> NDArray[np.float64]:
    """Stored pixels to shown pixels, homogeneous (3, 3), the centre of the top-left pixel at (0, 0)."""
    T = np.eye(3)
    T[:2, :2] = _STEPS[orientation]
    # The corner that lies furthest to the left and to the top becomes the origin.
    width, height = stored_size
    corners = np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)])
    T[:2, 2] = -(corners @ T[:2, :2].T).min(axis=0)
    return T


def shown_camera(orientation: int) -> NDArray[np.float64]:
    """The stored camera's frame to the shown one's, (3, 3): a turn about the optical axis, or a mirror (det -1)."""
    S = np.eye(3)
    S[:2, :2] = _STEPS[orientation]
    return S


def shown_intrinsics(K: NDArray[np.float64], orientation: int, stored_size: tuple[int, int]) -> NDArray[np.float64]:
    """K (3, 3) of the image as it is shown, from that of the image as it is stored."""
    return shown_pixels(orientation, stored_size) @ K @ shown_camera(orientation).T


def stored_intrinsics(K: NDArray[np.float64], orientation: int, stored_size: tuple[int, int]) -> NDArray[np.float64]:
    """K (3, 3) of the image as it is stored, from that of the image as it is shown."""
    return np.linalg.inv(shown_pixels(orientation, stored_size)) @ K @ shown_camera(orientation)
