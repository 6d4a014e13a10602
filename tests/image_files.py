"""Small image files whose headers promise many pixels, one for each format that OpenCV reads and writes."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
from exif_files import ORIENTATION, tiff_tags, with_exif

# What stands before width and height, how far behind its beginning they are, and how they are packed.
_FIXED = {
    ".bmp": (b"BM", 18, "<ii"),
    ".gif": (b"GIF8", 6, "<HH"),
    ".sr": (b"\x59\xa6\x6a\x95", 4, ">II"),
    ".jp2": (b"\xff\x4f\xff\x51", 8, ">II"),
    ".avif": (b"ispe", 8, ">II"),
}


def turned(suffix: str, image: np.ndarray, orientation: int) -> bytes:
    """A file that stores ``image`` (h, w) or (h, w, 3) and says by its EXIF how it is to be shown."""
    if suffix == ".tiff":
        return _tiff(image, orientation)
    data = cv2.imencode(suffix, image, [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else [])[1].tobytes()
    if suffix == ".jpg":
        return with_exif(data, {ORIENTATION: orientation})
    exif = tiff_tags({ORIENTATION: orientation})
    if suffix == ".png":
        at = data.index(b"IDAT") - 4
        return data[:at] + _png_chunk(b"eXIf", exif) + data[at:]
    if suffix == ".webp":
        height, width = image.shape[:2]
        sides = struct.pack("<I", width - 1)[:3] + struct.pack("<I", height - 1)[:3]
        chunks = b"VP8X" + struct.pack("<I", 10) + bytes([8, 0, 0, 0]) + sides + data[12:]
        chunks += b"EXIF" + struct.pack("<I", len(exif)) + exif + b"\0" * (len(exif) % 2)
        return b"RIFF" + struct.pack("<I", 4 + len(chunks)) + b"WEBP" + chunks
    raise ValueError(suffix)


def _tiff(image: np.ndarray, orientation: int) -> bytes:
    """Grey pixels in one strip, uncompressed; cv2 writes no orientation."""
    height, width = image.shape
    bits, pixels = 8 * image.itemsize, image.tobytes()
    values = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 0, 274: orientation, 277: 1, 278: height}
    values[279] = len(pixels)
    values[273] = 8 + 2 + 12 * len(values) + 4
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, values[tag]) for tag in sorted(values))
    entries = entries.replace(
        struct.pack("<HHII", 274, 4, 1, orientation), struct.pack("<HHIHH", 274, 3, 1, orientation, 0)
    )
    return b"II*\0" + struct.pack("<IH", 8, len(values)) + entries + bytes(4) + pixels


def promising(suffix: str, width: int, height: int) -> bytes:
    """A file of a few bytes to a kilobyte whose header promises ``width`` x ``height`` pixels."""
    if suffix == ".png":
        header = _png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        return b"\x89PNG\r\n\x1a\n" + header + _png_chunk(b"IDAT", zlib.compress(b"\0" * 10)) + _png_chunk(b"IEND", b"")
    data = bytearray(cv2.imencode(suffix, np.full((48, 72, 3), 77, np.uint8))[1].tobytes())
    if suffix in _FIXED:
        magic, offset, layout = _FIXED[suffix]
        at = data.index(magic) + offset
        struct.pack_into(layout, data, at, *((width, height) if layout != ">HH" else (height, width)))
        return bytes(data)
    if suffix == ".jpg":
        frame = data.index(b"\xff\xc0")
        data[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    elif suffix in (".ppm", ".pfm", ".pam", ".hdr"):
        old, new = {
            ".pam": ("WIDTH 72\nHEIGHT 48", f"WIDTH {width}\nHEIGHT {height}"),
            ".hdr": ("-Y 48 +X 72", f"-Y {height} +X {width}"),
        }.get(suffix, ("72 48", f"{width} {height}"))
        start = data.index(old.encode())
        data[start : start + len(old)] = new.encode()
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
