"""What a run has finished, row by row on disk; and output that appears whole or not at all."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic_file import replaced_when_done
from ..errors import MgcaFilterError
from .worker import PairRow

_SCHEMA = """
CREATE TABLE IF NOT EXISTS job (description TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS pair_rows (
    name1 TEXT, name2 TEXT, status TEXT, num_matches INTEGER, num_kept INTEGER, calibrated INTEGER,
    kept BLOB, scores BLOB, E BLOB, F BLOB, H BLOB, R BLOB, t BLOB, message TEXT,
    PRIMARY KEY (name1, name2));
"""
_SHAPES = {"E": (3, 3), "F": (3, 3), "H": (3, 3), "R": (3, 3), "t": (3,)}


class PipelineError(MgcaFilterError):
    """A pipeline cannot go on: a file is missing, broken, locked or full; the message names it in one line."""


class Journal:
    """Rows of the pairs that are done, in an SQLite file that survives ``kill -9`` at any moment.

    Each row is committed when it is added. The file is locked while it is open.

    Args:
        path: the file; made when it does not exist.

    Raises:
        PipelineError: another run has the file open, it is no journal, or the disk is full; from every method.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with sqlite_errors(path):
            self._db = sqlite3.connect(path, timeout=1.0, isolation_level=None)
            self._db.execute("PRAGMA locking_mode=EXCLUSIVE")
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_SCHEMA)

    def begin(self, description: dict[str, Any]) -> None:
        """Start, or go on with, the run that ``description`` determines (input and options, as JSON values).

        Raises:
            PipelineError: the journal holds rows of another description.
        """
        wanted = json.dumps(description, sort_keys=True)
        with sqlite_errors(self.path):
            found = self._db.execute("SELECT description FROM job").fetchone()
            if found is None:
                self._db.execute("INSERT INTO job VALUES (?)", (wanted,))
        if found is not None and found[0] != wanted:
            difference = _difference(found[0], wanted)
            raise PipelineError(f"{self.path.parent}: left by a run with {difference}; delete it or resume that run")

    def __contains__(self, pair: tuple[str, str]) -> bool:
        with sqlite_errors(self.path):
            return self._db.execute("SELECT 1 FROM pair_rows WHERE name1=? AND name2=?", pair).fetchone() is not None

    def add(self, row: PairRow) -> None:
        """Write one row; it is there when this returns."""
        blobs = [None if (m := getattr(row, name)) is None else m.astype("<f8").tobytes() for name in _SHAPES]
        kept, scores = row.kept.astype("<u4").tobytes(), row.scores.astype("<f4").tobytes()
        values = (row.name1, row.name2, row.status, row.num_matches, len(row.kept), row.calibrated, kept, scores)
        with sqlite_errors(self.path):
            self._db.execute(
                "INSERT OR REPLACE INTO pair_rows VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)", (*values, *blobs, row.message)
            )

    def rows(self) -> Iterator[PairRow]:
        """All rows, sorted by the names of the images."""
        with sqlite_errors(self.path):
            for values in self._db.execute("SELECT * FROM pair_rows ORDER BY name1, name2"):
                name1, name2, status, num_matches, _, calibrated, kept, scores, *matrices, message = values
                yield PairRow(
                    name1,
                    name2,
                    status,
                    num_matches,
                    np.frombuffer(kept, "<u4").reshape(-1, 2),
                    np.frombuffer(scores, "<f4"),
                    bool(calibrated),
                    **{name: _matrix(blob, _SHAPES[name]) for name, blob in zip(_SHAPES, matrices)},
                    message=message,
                )

    def statistics(self) -> dict[str, tuple[int, int, int]]:
        """Pairs, matches in and matches kept by status."""
        query = (
            "SELECT status, COUNT(*), SUM(num_matches), SUM(num_kept) FROM pair_rows GROUP BY status ORDER BY 2 DESC"
        )
        with sqlite_errors(self.path):
            return {status: (pairs, given, kept) for status, pairs, given, kept in self._db.execute(query)}

    def failures(self, limit: int) -> list[str]:
        """Distinct messages of failed pairs, at most ``limit``."""
        query = "SELECT DISTINCT message FROM pair_rows WHERE message != '' ORDER BY 1 LIMIT ?"
        with sqlite_errors(self.path):
            return [message for (message,) in self._db.execute(query, (limit,))]

    def close(self) -> None:
        """Release the file."""
        self._db.close()


def _matrix(blob: bytes | None, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    return None if blob is None else np.frombuffer(blob, "<f8").reshape(shape)


def file_stamp(path: Path) -> list[int]:
    """Size and time of change, which tell whether an input is still the one that a run started with."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _difference(found: str, wanted: str) -> str:
    before, now = json.loads(found), json.loads(wanted)
    keys = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    return ", ".join(f"{key} {before.get(key)!r} instead of {now.get(key)!r}" for key in keys)


@contextmanager
def sqlite_errors(path: Path) -> Iterator[None]:
    """SQLite's exceptions as one line that names the file: locked, full, or broken."""
    try:
        yield
    except sqlite3.Error as error:
        words = str(error)
        if "locked" in words or "busy" in words:
            words = "locked by another process"
        elif "full" in words or "disk I/O" in words:
            words = "cannot be written, the disk is full; what is finished is kept, run the command again to go on"
        raise PipelineError(f"{path}: {words}") from error


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path``, as of :func:`mgca_filter.atomic_file.replaced_when_done`.

    Raises:
        PipelineError: writing fails, with an exception of the system or of HDF5.
    """
    try:
        with replaced_when_done(path) as temporary:
            yield temporary
    except (OSError, RuntimeError) as error:
        words = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise PipelineError(
            f"{path}: cannot be written ({words}); what is finished is kept, run the command again to go on"
        ) from error
