"""Files are whole or as they were, whatever happens while they are written."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from mgca_filter.atomic_file import replaced_when_done


def test_the_file_appears_when_the_block_is_done(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    with replaced_when_done(path) as partial:
        partial.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_block_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    path.write_text("old")

    def write_half() -> None:
        with replaced_when_done(path) as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "today.json").write_text("old")
    (tmp_path / "latest.json").symlink_to("today.json")
    with replaced_when_done(tmp_path / "latest.json") as partial:
        partial.write_text("new")
    assert (tmp_path / "latest.json").is_symlink()
    assert (tmp_path / "today.json").read_text() == "new"


def test_what_is_no_file_is_written_and_not_replaced(tmp_path: Path) -> None:
    """A pipe here; the same would turn /dev/null into a file where the user may."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    heard: list[str] = []
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text()))
    reader.start()
    with replaced_when_done(pipe) as partial:
        partial.write_text("new")
    reader.join()
    assert heard == ["new"]
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), replaced_when_done(path):
        pass
    assert path.read_text() == "old"
