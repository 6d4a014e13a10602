"""How many pixels an image file promises, read from its header: what decoding will take is known before it is begun.

One reader for each format that OpenCV's wheels decode; sources are the formats' own specifications: JPEG (ITU-T T.81,
B.2.2), PNG (W3C, 11.2.1), WebP (RFC 9649), TIFF 6.0 and BigTIFF, BMP, netpbm and PFM, Sun raster, Radiance HDR, GIF89a,
JPEG 2000 (ITU-T T.800, A.5.1), AVIF (ISO/IEC 23008-12, 6.5.3).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

Size = tuple[int, int]


def promised_size(data: bytes) -> Size | None:
    """(width, height) in pixels that the header of an image file promises.

    None where the file is of no format that is known here, or ends before its size; nothing raises. Of a file with
    several images it is that of the first, of an AVIF the largest.
    """
    for magic, read in _READERS:
        if re.match(magic, data, re.DOTALL):
            try:
                size = read(data)
            except (struct.error, ValueError, IndexError):
                return None
            return None if size is None else (abs(size[0]), abs(size[1]))
    return None


def _jpeg(data: bytes) -> Size | None:
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:  # garbage, which decoders skip too
            at += 1
            continue
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame; those are tables
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker in (0xFF, 0x00, 0x01) or 0xD0 <= marker <= 0xD8:  # padding, and markers without a segment
            at += 1 if marker == 0xFF else 2
            continue
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _png(data: bytes) -> Size | None:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _webp(data: bytes) -> Size | None:
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        (word,) = struct.unpack_from("<I", data, 21)
        return 1 + (word & 0x3FFF), 1 + (word >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _tiff(data: bytes) -> Size | None:
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    directory = struct.unpack_from(order + "Q", data, 8)[0] if big else struct.unpack_from(order + "I", data, 4)[0]
    count = struct.unpack_from(order + ("Q" if big else "H"), data, directory)[0]
    first, length = (directory + 8, 20) if big else (directory + 2, 12)
    found: dict[int, int] = {}
    for entry in range(first, min(first + length * count, len(data) - length + 1), length):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in (256, 257):  # width, length
            letter = {3: "H", 4: "I", 16: "Q"}.get(kind, "I")
            (found[tag],) = struct.unpack_from(order + letter, data, entry + (12 if big else 8))
    return (found[256], found[257]) if len(found) == 2 else None


def _bmp(data: bytes) -> Size | None:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return width, height


def _netpbm(data: bytes) -> Size | None:
    found = re.match(rb"\s*(\d+)\s+(\d+)\s", re.sub(rb"#[^\n]*", b"", data[2:4096]))
    return None if found is None else (int(found[1]), int(found[2]))


def _pam(data: bytes) -> Size | None:
    fields = {name: int(number) for name, number in re.findall(rb"\n(WIDTH|HEIGHT)\s+(\d+)(?=\s)", data[:4096])}
    return (fields[b"WIDTH"], fields[b"HEIGHT"]) if len(fields) == 2 else None


def _sun_raster(data: bytes) -> Size | None:
    width, height = struct.unpack_from(">II", data, 4)
    return width, height


def _radiance(data: bytes) -> Size | None:
    found = re.search(rb"\n[-+]([XY]) (\d+) [-+][XY] (\d+)\s", data[:65536])
    if found is None:
        return None
    one, other = int(found[2]), int(found[3])
    return (one, other) if found[1] == b"X" else (other, one)


def _gif(data: bytes) -> Size | None:
    width, height = struct.unpack_from("<HH", data, 6)
    return width, height


def _jpeg_2000(data: bytes) -> Size | None:
    start = data.find(b"\xff\x4f\xff\x51")  # start of the codestream, and of its sizes
    if start < 0:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", data, start + 8)
    return right - left, bottom - top


def _avif(data: bytes) -> Size | None:
    boxes = re.finditer(rb"ispe\0{4}", data[:1_000_000])  # "image spatial extents" of the image, its tiles, its alpha
    sizes = [struct.unpack_from(">II", data, box.end()) for box in boxes if box.end() + 8 <= len(data)]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


_READERS: tuple[tuple[bytes, Callable[[bytes], Size | None]], ...] = (
    (rb"\xff\xd8", _jpeg),
    (rb"\x89PNG\r\n\x1a\n", _png),
    (rb"RIFF....WEBP", _webp),
    (rb"II[\x2a\x2b]\0|MM\0[\x2a\x2b]", _tiff),
    (rb"BM", _bmp),
    (rb"P[1-6]\s|PF\s|Pf\s", _netpbm),
    (rb"P7\s", _pam),
    (rb"\x59\xa6\x6a\x95", _sun_raster),
    (rb"#\?RADIANCE|#\?RGBE", _radiance),
    (rb"GIF8[79]a", _gif),
    (rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51", _jpeg_2000),
    (rb"....ftyp", _avif),
)
