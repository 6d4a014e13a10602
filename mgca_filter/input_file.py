"""Files that users name, read up to a limit: a device that never ends and a file of a terabyte are told, not read."""

from __future__ import annotations

import stat
from pathlib import Path

LARGEST_TEXT_BYTES = 2**28
_CHUNK_BYTES = 2**20
_BYTE_ORDER_MARK = "\ufeff"


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a file, of a pipe or device too.

    Raises:
        OSError: it cannot be read. ValueError: it is longer than ``limit``.
    """
    too_long = ValueError(f"longer than {limit} bytes, the most that is read")
    with path.open("rb") as file:
        about = path.stat()
        if stat.S_ISREG(about.st_mode) and about.st_size > limit:
            raise too_long
        chunks, length = [], 0
        while chunk := file.read(_CHUNK_BYTES):
            length += len(chunk)
            if length > limit:
                raise too_long
            chunks.append(chunk)
    return b"".join(chunks)


def read_text(path: Path, *, may_be_empty: bool = False) -> str:
    """A text file of any system: UTF-8 or UTF-16, with or without a byte-order mark; line ends as they come.

    Raises:
        OSError: it cannot be read. ValueError: it is no text, or empty where it must not be.
    """
    data = read_bytes(path, LARGEST_TEXT_BYTES)
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    try:
        text = data.decode(encoding).lstrip(_BYTE_ORDER_MARK)
    except UnicodeDecodeError:
        raise ValueError("not a text file") from None
    if "\0" in text:
        raise ValueError("not a text file")
    if not (may_be_empty or text.strip()):
        raise ValueError("the file is empty")
    return text
