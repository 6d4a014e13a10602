"""Small image files whose headers promise many pixels, one for each format that OpenCV reads and writes."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np


def promising(suffix: str, width: int, height: int) -> bytes:
    """A file of a few bytes to a kilobyte whose header promises ``width`` x ``height`` pixels."""
    if suffix == ".png":
        header = _png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        return b"\x89PNG\r\n\x1a\n" + header + _png_chunk(b"IDAT", zlib.compress(b"\0" * 10)) + _png_chunk(b"IEND", b"")
    data = bytearray(cv2.imencode(suffix, np.full((16, 24, 3), 77, np.uint8))[1].tobytes())
    if suffix == ".jpg":
        frame = data.index(b"\xff\xc0")
        data[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    elif suffix == ".bmp":
        data[18:26] = struct.pack("<ii", width, height)
    elif suffix == ".ppm":
        start = data.index(b"24 16")
        data[start : start + 5] = f"{width} {height}".encode()
    elif suffix == ".tiff":
        _set_tiff_tags(data, {256: width, 257: height, 278: height})
    elif suffix == ".webp":
        start = data.index(b"VP8L") + 9  # 14 bits of width - 1, 14 of height - 1, then flags
        (word,) = struct.unpack_from("<I", data, start)
        struct.pack_into("<I", data, start, (word >> 28 << 28) | (height - 1) << 14 | (width - 1))
    else:
        raise ValueError(suffix)
    return bytes(data)


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _set_tiff_tags(data: bytearray, values: dict[int, int]) -> None:
    """Write 32-bit values into the tags of the first directory of a little-endian TIFF."""
    (directory,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, directory)
    for entry in range(directory + 2, directory + 2 + 12 * count, 12):
        (tag,) = struct.unpack_from("<H", data, entry)
        if tag in values:
            struct.pack_into("<HII", data, entry + 2, 4, 1, values[tag])
