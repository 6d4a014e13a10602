"""Broken and odd image files, each with the exit statuses that ``mgca-match`` may answer with."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

_PNG = b"\x89PNG\r\n\x1a\n"


def png_that_promises(width: int, height: int) -> bytes:
    """A PNG of a few bytes whose header promises ``width`` x ``height`` grey pixels."""
    header = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return _PNG + header + _chunk(b"IDAT", zlib.compress(b"\0" * 10)) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _flat(path: Path, good: bytes) -> None:
    cv2.imwrite(str(path), np.full((40, 60), 128, np.uint8))


def _one_pixel(path: Path, good: bytes) -> None:
    cv2.imwrite(str(path), np.zeros((1, 1), np.uint8))


def _sixteen_bits(path: Path, good: bytes) -> None:
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 65536, (90, 120), dtype=np.uint16))


def _grey(encoded: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _thermal(path: Path, good: bytes) -> None:
    """16 bits of which the scene uses a thousand counts."""
    cv2.imwrite(str(path), _grey(good).astype(np.uint16) * 4 + 7000)


def _with_segment(content: bytes) -> Callable[[Path, bytes], object]:
    """The good picture as JPEG with an EXIF segment of some bytes."""

    def write(path: Path, good: bytes) -> object:
        jpeg = cv2.imencode(".jpg", _grey(good), [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        segment = b"Exif\0\0" + content
        return path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:])

    return write


def _orientation(value: int) -> bytes:
    return b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, value, 0, 0)


def _jpeg_that_promises(good: bytes) -> bytes:
    data = bytearray(cv2.imencode(".jpg", _grey(good))[1].tobytes())
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", 30_000, 30_000)
    return bytes(data)


def _bmp_that_promises(good: bytes) -> bytes:
    data = bytearray(cv2.imencode(".bmp", _grey(good))[1].tobytes())
    data[18:26] = struct.pack("<ii", 30_000, -30_000)
    return bytes(data)


def _terabyte(path: Path, good: bytes) -> None:
    """It takes no room on the disk."""
    path.write_bytes(good)
    os.truncate(path, 2**40)


_GIF = b"GIF89a" + struct.pack("<HH", 65_000, 65_000) + b"\xf0\0\0" + bytes(6) + b";"
_GARBAGE = np.random.default_rng(2).integers(0, 256, 3000, dtype=np.uint8).tobytes()
_TURNS_IN_CIRCLES = b"II*\0" + struct.pack("<IHHHII", 8, 1, 0x8769, 4, 1, 8)
_ABSURD_FOCAL_LENGTH = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0xA405, 3, 1, 65_535, 0, 0)


def _with_alpha(path: Path, good: bytes) -> None:
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (90, 120, 4), dtype=np.uint8))


def _noise(path: Path, good: bytes) -> None:
    cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 256, (90, 120), dtype=np.uint8))


FILES: dict[str, tuple[Callable[[Path, bytes], object], tuple[int, ...]]] = {
    "missing": (lambda path, good: path.unlink(missing_ok=True), (2,)),
    "empty": (lambda path, good: path.write_bytes(b""), (2,)),
    "text": (lambda path, good: path.write_bytes(b"no image"), (2,)),
    "cut off in the header": (lambda path, good: path.write_bytes(good[:20]), (2,)),
    "cut off in the middle": (lambda path, good: path.write_bytes(good[: len(good) // 2]), (0, 1, 2)),
    "damaged in the middle": (
        lambda path, good: path.write_bytes(good[:200] + bytes(b ^ 255 for b in good[200:260]) + good[260:]),
        (0, 1, 2),
    ),
    "promises 100 000 x 100 000": (lambda path, good: path.write_bytes(png_that_promises(100_000, 100_000)), (2,)),
    "promises 30 000 x 30 000": (lambda path, good: path.write_bytes(png_that_promises(30_000, 30_000)), (2,)),
    "promises 20 000 x 20 000": (lambda path, good: path.write_bytes(png_that_promises(20_000, 20_000)), (2,)),
    "JPEG that promises 30 000 x 30 000": (lambda path, good: path.write_bytes(_jpeg_that_promises(good)), (2,)),
    "BMP that promises 30 000 x 30 000": (lambda path, good: path.write_bytes(_bmp_that_promises(good)), (2,)),
    "GIF that promises 65 000 x 65 000": (lambda path, good: path.write_bytes(_GIF), (2,)),
    "PPM that promises 30 000 x 30 000": (
        lambda path, good: path.write_bytes(b"P6\n# x\n30000 30000\n255\n" + good),
        (2,),
    ),
    "TIFF whose directory is itself": (lambda path, good: path.write_bytes(b"II*\0\4\0\0\0" + good), (2,)),
    "a terabyte": (_terabyte, (2,)),
    "EXIF: turned": (_with_segment(_orientation(6)), (0,)),
    "EXIF: mirrored": (_with_segment(_orientation(2)), (1, 0)),
    "EXIF: orientation 99": (_with_segment(_orientation(99)), (0,)),
    "promises 0 x 0": (lambda path, good: path.write_bytes(png_that_promises(0, 0)), (2,)),
    "one colour": (_flat, (1,)),
    "one pixel": (_one_pixel, (1,)),
    "noise": (_noise, (1,)),
    "16 bits": (_sixteen_bits, (1,)),
    "16 bits, few of them used": (_thermal, (0,)),
    "EXIF: empty": (_with_segment(b""), (0,)),
    "EXIF: garbage": (_with_segment(_GARBAGE), (0,)),
    "EXIF: garbage behind a header": (_with_segment(b"MM\0*\0\0\0\10" + _GARBAGE), (0,)),
    "EXIF: points to itself": (_with_segment(_TURNS_IN_CIRCLES), (0,)),
    "EXIF: focal length 65 m": (_with_segment(_ABSURD_FOCAL_LENGTH), (0,)),
    "with alpha": (_with_alpha, (1,)),
    "the same image twice": (lambda path, good: path.write_bytes(good), (0,)),
}
"""By kind: writes the file, given the bytes of a good one; and the exit statuses that are right."""
