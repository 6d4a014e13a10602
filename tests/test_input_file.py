"""Files of users: any encoding, and never more than a limit of them."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from mgca_filter.input_file import read_bytes, read_text


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_text_of_any_system(tmp_path: Path, encoding: str) -> None:
    mark = "\ufeff" if encoding in ("utf-16-le", "utf-16-be") else ""
    path = tmp_path / "names.txt"
    path.write_bytes((mark + "b\u00fcro.png\r\nb.png\r\n").encode(encoding))
    assert read_text(path).splitlines() == ["b\u00fcro.png", "b.png"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b" \n\t", "empty"),
        (b"\xff\xfe\0", "not a text"),
        (b"a\0b", "not a text"),
        (b"caf\xe9", "not a text"),
    ],
)
def test_what_is_no_text_is_a_value_error(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(ValueError, match=words):
        read_text(tmp_path / "x")


def test_no_more_than_the_limit_is_read(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"12345")
    assert read_bytes(tmp_path / "x", 5) == b"12345"
    with pytest.raises(ValueError, match="longer than 4 bytes"):
        read_bytes(tmp_path / "x", 4)
    os.truncate(tmp_path / "x", 2**40)  # takes no room on the disk
    with pytest.raises(ValueError, match="longer than"):
        read_bytes(tmp_path / "x", 2**31)
    with pytest.raises(ValueError, match="longer than"):
        read_bytes(Path("/dev/zero"), 3_000_000)
    with pytest.raises(OSError, match="none"):
        read_bytes(tmp_path / "none", 5)


def test_pipes_are_read_to_their_end(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(b"12345",))
    writer.start()
    assert read_bytes(tmp_path / "pipe", 5) == b"12345"
    writer.join()
