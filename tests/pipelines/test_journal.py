"""The journal: what was added is there, to the bit, after any end of the process and any tear of the file."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pipeline_command import ROOT

from mgca_filter.pipelines.journal import Journal, PipelineError
from mgca_filter.pipelines.worker import PairRow

DESCRIPTION = {"threshold": 1.0, "K": [[1.5, 0.0], [0.0, 1.5]], "model": None}


def row(name1: str, name2: str, kept: int = 5, status: str = "ok", seed: int = 0, message: str = "") -> PairRow:
    rng = np.random.default_rng(seed)
    matrices = {name: rng.normal(size=(3, 3)) for name in ("E", "F", "R")} | {"t": rng.normal(size=3)}
    return PairRow(
        name1,
        name2,
        status,
        9,
        rng.integers(0, 2**32, (kept, 2), dtype=np.uint32),
        rng.random(kept, dtype=np.float32),
        kept > 0,
        **(matrices if kept else {}),
        confidence=float(rng.random()) if kept else None,
        message=message,
    )


ROWS = [row("b", "c", seed=1), row("a", "c d\n", kept=0, status="failed", message="ü: broken"), row("a", "b", seed=2)]


def assert_same(found: PairRow, expected: PairRow) -> None:
    for name, value in vars(expected).items():
        if isinstance(value, np.ndarray):
            assert getattr(found, name).dtype == value.dtype
            np.testing.assert_array_equal(getattr(found, name), value)
        else:
            assert getattr(found, name) == value


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A closed journal with three rows."""
    journal = Journal(tmp_path / "journal.log")
    journal.begin(DESCRIPTION)
    for each in ROWS:
        journal.add(each)
    journal.close()
    return journal.path


def test_rows_come_back_sorted_and_to_the_bit(path: Path) -> None:
    journal = Journal(path)
    journal.begin(DESCRIPTION)
    for found, expected in zip(journal.rows(), sorted(ROWS, key=lambda each: (each.name1, each.name2)), strict=True):
        assert_same(found, expected)
    assert all((each.name1, each.name2) in journal for each in ROWS)
    assert ("c", "b") not in journal
    assert journal.statistics == {"ok": (2, 18, 10), "failed": (1, 9, 0)}
    assert journal.failures == ["ü: broken"]
    journal.close()


def test_what_is_torn_is_dropped_wherever_it_is_torn(path: Path, tmp_path: Path) -> None:
    """Cut the file after every byte: whole rows stay, in their order, and the missing ones can be added again."""
    whole = path.read_bytes()
    counts = []
    for length in range(0, len(whole) + 1, 7):
        torn = tmp_path / "torn.log"
        torn.write_bytes(whole[:length])
        journal = Journal(torn)
        journal.begin(DESCRIPTION)
        there = [each for each in ROWS if (each.name1, each.name2) in journal]
        assert there == ROWS[: len(there)]
        counts.append(len(there))
        for each in ROWS[len(there) :]:
            journal.add(each)
        journal.close()
        assert torn.read_bytes() == whole
    assert counts == sorted(counts)
    assert set(counts) >= {0, 1, 2}


def test_a_damaged_row_goes_with_what_follows_it(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[data.index(b"broken")] ^= 1
    path.write_bytes(data)
    journal = Journal(path)
    assert [("b", "c") in journal, ("a", "c d\n") in journal, ("a", "b") in journal] == [True, False, False]
    journal.close()


def test_another_description_is_refused_by_name(path: Path) -> None:
    journal = Journal(path)
    with pytest.raises(PipelineError, match=r"left by a run with threshold 1\.0 instead of 2\.0; delete it"):
        journal.begin({**DESCRIPTION, "threshold": 2.0})
    journal.close()


@pytest.mark.parametrize("content", [b"SQLite format 3\0" * 100, b"hello"])
def test_another_file_is_refused_and_stays(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "journal.log"
    path.write_bytes(content)
    with pytest.raises(PipelineError, match=r"journal\.log: not a journal"):
        Journal(path)
    assert path.read_bytes() == content


HOLD_OPEN = """
import sys
from pathlib import Path
from mgca_filter.pipelines.journal import Journal
journal = Journal(Path(sys.argv[1]))
print("open", flush=True)
sys.stdin.read()
"""


def test_one_process_at_a_time(path: Path) -> None:
    command = [sys.executable, "-c", HOLD_OPEN, str(path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as other:
        assert other.stdout.readline() == b"open\n"
        with pytest.raises(PipelineError, match=r"journal\.log: locked by another process"):
            Journal(path)
        other.kill()
    Journal(path).close()  # the lock goes with the process
    assert len(path.read_bytes()) > 500


def test_a_full_disk_takes_back_the_row_that_did_not_fit(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = path.read_bytes()
    journal = Journal(path)

    class FullDisk:
        """The journal's file on a disk that takes ten more bytes."""

        def __init__(self, file) -> None:
            self._file, self._room = file, 10

        def __getattr__(self, name):
            return getattr(self._file, name)

        def write(self, data) -> int:
            if self._room == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            written, self._room = self._file.write(data[: self._room]), 0
            return written

    with monkeypatch.context() as patch:
        patch.setattr(journal, "_file", FullDisk(journal._file))
        with pytest.raises(PipelineError, match=r"journal\.log: cannot be written \(No space left"):
            journal.add(row("x", "y"))
    assert path.read_bytes() == before
    assert ("x", "y") not in journal
    journal.add(row("x", "y"))
    journal.close()
    reopened = Journal(path)
    assert ("x", "y") in reopened
    reopened.close()
