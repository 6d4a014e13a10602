"""EXIF of photographs: the focal length that the camera wrote into the file, and how it was held.

Tags as in "Exchangeable image file format for digital still cameras: Exif Version 2.32" (CIPA DC-008), in a TIFF
directory: the file itself, the APP1 segment of a JPEG, or the chunk of a PNG or WebP.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_EXIF_DIRECTORY = 0x8769
_ORIENTATION = 0x0112
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_PIXEL_X, _PIXEL_Y = 0xA002, 0xA003
_FOCAL_PLANE_X_RESOLUTION, _FOCAL_PLANE_UNIT = 0xA20E, 0xA210
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# How each type of number is packed; a rational is a pair.
_TYPES = {1: "B", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii"}
# COLMAP's: between the 36 mm of a 3:2 film, and the 34.6 mm that a 4:3 sensor of the same diagonal is wide.
_FILM_SIDE_MM = 35.0
# Focal lengths beyond these shares of the longer side are those of no lens, or of a tag that means something else.
_LEAST_SHARE, _LARGEST_SHARE = 0.2, 50.0


def exif_intrinsics(data: bytes, size: tuple[int, int]) -> NDArray[np.float64] | None:
    """K (3, 3) of a photograph, its principal point in the middle, from the focal length in its EXIF.

    The focal length in pixels is that for 35 mm film / 35 times the longer side, as COLMAP has it, or, without that
    tag, from the focal length in millimetres and the resolution of the sensor.

    Args:
        data: bytes of a JPEG, TIFF, PNG or WebP file; anything else gives None, and nothing raises.
        size: (width, height) of the image that K is for, pixels: upright or as stored, whole or resized.
    """
    focal = _focal_length(_read_tags(data), max(size))
    if focal is None or not _LEAST_SHARE * max(size) < focal < _LARGEST_SHARE * max(size):
        return None
    width, height = size
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


def exif_orientation(data: bytes) -> int:
    """How a photograph is to be shown, 1 (as it is stored) to 8; 1 where the file says nothing, and nothing raises.

    Args:
        data: bytes of a JPEG, TIFF, PNG or WebP file, or of any other.
    """
    orientation = _read_tags(data).get(_ORIENTATION, 1.0)
    return int(orientation) if orientation in range(1, 9) else 1


def _focal_length(tags: dict[int, float], side: int) -> float | None:
    """Focal length in pixels of an image whose longer side is ``side`` pixels."""
    if tags.get(_FOCAL_LENGTH_35MM, 0.0) > 0:
        return tags[_FOCAL_LENGTH_35MM] / _FILM_SIDE_MM * side
    focal_mm, per_unit = tags.get(_FOCAL_LENGTH, 0.0), tags.get(_FOCAL_PLANE_X_RESOLUTION, 0.0)
    unit_mm = _MM_PER_UNIT.get(int(tags.get(_FOCAL_PLANE_UNIT, 2.0)))
    taken = max(tags.get(_PIXEL_X, 0.0), tags.get(_PIXEL_Y, 0.0))
    if focal_mm <= 0 or per_unit <= 0 or unit_mm is None or taken <= 0:
        return None
    return focal_mm * per_unit / unit_mm * side / taken


def _read_tags(data: bytes) -> dict[int, float]:
    """Numbers of the first directory and of the EXIF directory by tag; what is damaged is left out."""
    tiff = _tiff_part(data)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if order is None or len(tiff) < 8:
        return {}
    tags = _read_directory(tiff, order, struct.unpack_from(order + "I", tiff, 4)[0])
    if _EXIF_DIRECTORY in tags:
        tags |= _read_directory(tiff, order, int(tags[_EXIF_DIRECTORY]))
    return tags


def _tiff_part(data: bytes) -> bytes:
    """The TIFF in a JPEG's EXIF segment, or in a PNG's or WebP's EXIF chunk; any other file as it is."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return _chunk(data, 8, ">I4s", b"eXIf", lambda length: 12 + length)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        exif = _chunk(data, 12, "<4sI", b"EXIF", lambda length: 8 + length + length % 2)
        return exif[6:] if exif[:6] == b"Exif\0\0" else exif
    if data[:2] != b"\xff\xd8":
        return data
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] not in (0xD9, 0xDA):  # end, or the picture
        if data[at + 1] == 0xFF:  # padding
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : at + 2 + length]
        at += 2 + length
    return b""


def _chunk(data: bytes, at: int, head: str, wanted: bytes, step: Callable[[int], int]) -> bytes:
    """Content of the first chunk of a name; ``step`` from one chunk's start to the next by its length."""
    while at + 8 <= len(data):
        words = struct.unpack_from(head, data, at)
        name, length = (words[1], words[0]) if head[0] == ">" else words
        if name == wanted:
            return data[at + 8 : at + 8 + length]
        at += step(length)
    return b""


def _read_directory(tiff: bytes, order: str, start: int) -> dict[int, float]:
    """Tags of the directory at ``start`` that hold one number."""
    tags: dict[int, float] = {}
    if start + 2 > len(tiff):
        return tags
    (count,) = struct.unpack_from(order + "H", tiff, start)
    for entry in range(start + 2, min(start + 2 + 12 * count, len(tiff) - 11), 12):
        tag, kind, number = struct.unpack_from(order + "HHI", tiff, entry)
        packed = _TYPES.get(kind)
        if packed is None or number != 1:
            continue
        at = entry + 8
        if len(packed) == 2:
            (at,) = struct.unpack_from(order + "I", tiff, at)
        if at + struct.calcsize(order + packed) <= len(tiff):
            values = struct.unpack_from(order + packed, tiff, at)
            if len(values) == 1 or values[1] != 0:
                tags[tag] = values[0] if len(values) == 1 else values[0] / values[1]
    return tags
