"""Photographs with the EXIF that cameras write."""

from __future__ import annotations

import struct

# Tag, type and value of what the tests need; types: 3 = short, 4 = long, 5 = rational.
FOCAL_35MM, FOCAL_MM, X_RESOLUTION, UNIT, PIXEL_X, ORIENTATION = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0x0112
_TYPES = {FOCAL_35MM: 3, FOCAL_MM: 5, X_RESOLUTION: 5, UNIT: 3, PIXEL_X: 4, ORIENTATION: 3}


def tiff_tags(values: dict[int, float], order: str = "<") -> bytes:
    """A TIFF without a picture: orientation in the first directory, all else in the EXIF directory."""
    first = {tag: value for tag, value in values.items() if tag == ORIENTATION}
    exif = {tag: value for tag, value in values.items() if tag != ORIENTATION}
    start = 8 + 2 + 12 * (len(first) + 1) + 4
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    pointer = struct.pack(order + "HHII", 0x8769, 4, 1, start)
    rationals = start + 2 + 12 * len(exif) + 4
    directory, after = b"", b""
    for tag, value in sorted(exif.items()):
        if _TYPES[tag] == 5:
            data = struct.pack(order + "I", rationals + len(after))
            after += struct.pack(order + "II", round(value * 1000), 1000)
        else:
            data = _short(value, order) if _TYPES[tag] == 3 else struct.pack(order + "I", int(value))
        directory += struct.pack(order + "HHI", tag, _TYPES[tag], 1) + data
    own = b"".join(struct.pack(order + "HHI", tag, 3, 1) + _short(value, order) for tag, value in first.items())
    parts = [head, struct.pack(order + "H", len(first) + 1), own, pointer, bytes(4)]
    parts += [struct.pack(order + "H", len(exif)), directory, bytes(4), after]
    return b"".join(parts)


def _short(value: float, order: str) -> bytes:
    return struct.pack(order + "HH", int(value), 0)


def with_exif(jpeg: bytes, values: dict[int, float], order: str = "<") -> bytes:
    """The JPEG with an EXIF segment of the tags."""
    segment = b"Exif\0\0" + tiff_tags(values, order)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]
