"""How many pixels an image file promises, read from its first bytes: before any decoder allocates them."""

from __future__ import annotations

import struct

# 16384 x 16384, 0.8 GB in colour: beyond any camera. A small file can promise far more, for compression shrinks a plain
# picture a thousandfold.
MAX_PIXELS = 2**28
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
# Start-of-frame markers of JPEG; C4, C8 and CC are something else.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_STANDALONE = frozenset((0x01, *range(0xD0, 0xD9)))


def promised_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) in the header of a PNG or JPEG file; None where the header is cut off or of another format."""
    try:
        if data.startswith(_PNG):
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        return _jpeg_size(data) if data.startswith(_JPEG) else None
    except (struct.error, IndexError):
        return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Walk the segments, each a marker and a length, up to the frame header."""
    position = 2
    while data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
        elif marker in _STANDALONE:
            position += 2
        elif marker in _FRAMES:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        else:
            position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return None
