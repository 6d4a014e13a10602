"""What a run has finished, pair by pair on disk; and output that appears whole or not at all."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..atomic_file import replaced_when_done
from ..errors import MgcaFilterError
from .worker import PairRow

# The file: these bytes, then records. A record is the length and the CRC-32 of what follows them, a line of JSON, and
# the bytes of the arrays that the line names. The first record is the description of the run, each other one a pair.
_MAGIC = b"mgca_filter journal 1\n"
_HEAD = struct.Struct("<II")
_ARRAYS = {"kept": "<u4", "scores": "<f4", "E": "<f8", "F": "<f8", "H": "<f8", "R": "<f8", "t": "<f8"}
_MAX_FAILURES = 5
_PLAIN = ("name1", "name2", "status", "num_matches", "calibrated", "confidence", "message")


class PipelineError(MgcaFilterError):
    """A pipeline cannot go on: a file is missing, broken, locked or full; the message names it in one line."""


class Journal:
    """Rows of the pairs that are done: a log that only grows, and survives ``kill -9`` at any moment.

    Each row is handed to the system when it is added. A last record that a killed run or a full disk left torn is
    dropped when the file is opened, with whatever follows a damaged one. The file is locked while it is open.

    Args:
        path: the file; made when it does not exist.

    Attributes:
        statistics: by status, how many pairs, matches in and matches kept.
        failures: distinct messages of failed pairs, the first few of them in order.

    Raises:
        PipelineError: another run has the file open, it is no journal, or the disk is full; from every method.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.statistics: dict[str, tuple[int, int, int]] = {}
        self.failures: list[str] = []
        self._offsets: dict[tuple[str, str], int] = {}
        self._description: dict[str, Any] | None = None
        with _disk_errors(path):
            self._file = path.open("a+b", buffering=0)
            try:
                _lock(self._file, path)
                self._end = self._read_all()
                self._file.truncate(self._end)
                if self._end == 0:
                    self._append(_MAGIC)
            except BaseException:
                self._file.close()
                raise

    def begin(self, description: dict[str, Any]) -> None:
        """Start, or go on with, the run that ``description`` determines (input and options, as JSON values).

        Raises:
            PipelineError: the journal holds rows of another description.
        """
        wanted = json.loads(json.dumps(description))
        if self._description is None:
            self._append(_record(wanted))
            self._description = wanted
        elif self._description != wanted:
            difference = _difference(self._description, wanted)
            raise PipelineError(f"{self.path.parent}: left by a run with {difference}; delete it or resume that run")

    def __contains__(self, pair: tuple[str, str]) -> bool:
        return pair in self._offsets

    def add(self, row: PairRow) -> None:
        """Write the row of a pair that is not there yet; it outlives this process when this returns."""
        arrays = {name: value for name in _ARRAYS if (value := getattr(row, name)) is not None}
        head = {name: getattr(row, name) for name in _PLAIN} | {"arrays": {n: a.shape for n, a in arrays.items()}}
        offset = self._end
        self._append(_record(head, b"".join(a.astype(_ARRAYS[n]).tobytes() for n, a in arrays.items())))
        self._count(offset, head)

    def rows(self) -> Iterator[PairRow]:
        """All rows, sorted by the names of the images."""
        with _disk_errors(self.path):
            for pair in sorted(self._offsets):
                self._file.seek(self._offsets[pair])
                payload = self._read_record(self._end)
                if payload is None:
                    raise PipelineError(f"{self.path}: damaged while it was open")
                yield _row(payload)

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def _read_all(self) -> int:
        """Take in every whole record; returns where the last of them ends, 0 for a new file."""
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(0)
        magic = self._file.read(len(_MAGIC)) or b""
        if not _MAGIC.startswith(magic):
            raise PipelineError(f"{self.path}: not a journal of this version; delete its folder to start again")
        if magic != _MAGIC:
            return 0
        end = self._file.tell()
        while (payload := self._read_record(size)) is not None:
            head = json.loads(payload.partition(b"\n")[0])
            if self._description is None:
                self._description = head
            else:
                self._count(end, head)
            end = self._file.tell()
        return end

    def _read_record(self, size: int) -> bytes | None:
        """The record at the position in a file of ``size`` bytes; None where it is torn or damaged."""
        start = self._file.read(_HEAD.size) or b""
        if len(start) < _HEAD.size:
            return None
        length, checksum = _HEAD.unpack(start)
        if self._file.tell() + length > size:
            return None
        payload: bytes = self._file.read(length)
        return payload if zlib.crc32(payload) == checksum else None

    def _append(self, record: bytes) -> None:
        """Write at the end of the file, without a buffer; what did not fit is taken back."""
        with _disk_errors(self.path):
            try:
                rest = memoryview(record)
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError:
                self._file.truncate(self._end)
                raise
        self._end += len(record)

    def _count(self, offset: int, head: dict[str, Any]) -> None:
        self._offsets[head["name1"], head["name2"]] = offset
        pairs, given, kept = self.statistics.get(head["status"], (0, 0, 0))
        kept += head["arrays"]["kept"][0]
        self.statistics[head["status"]] = (pairs + 1, given + head["num_matches"], kept)
        if head["message"]:
            self.failures = sorted({*self.failures, head["message"]})[:_MAX_FAILURES]


def _record(head: dict[str, Any], arrays: bytes = b"") -> bytes:
    payload = json.dumps(head).encode() + b"\n" + arrays
    return _HEAD.pack(len(payload), zlib.crc32(payload)) + payload


def _row(payload: bytes) -> PairRow:
    line, _, rest = payload.partition(b"\n")
    head, arrays, start = json.loads(line), dict[str, Any](), 0
    for name, shape in head.pop("arrays").items():
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(rest, _ARRAYS[name], count, start).reshape(shape)
        start += arrays[name].nbytes
    return PairRow(**head, **arrays)


def _lock(file: IO[bytes], path: Path) -> None:
    """Keep other processes off an open file, until it is closed or its process ends, however it ends."""
    try:
        try:
            import fcntl
        except ImportError:  # Windows
            import msvcrt

            file.seek(2**30)  # a byte that nobody writes: locked bytes cannot be read there
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:
        raise PipelineError(f"{path}: locked by another process") from error


def file_stamp(path: Path) -> list[int]:
    """Size and time of change, which tell whether an input is still the one that a run started with."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    keys = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    return ", ".join(f"{key} {before.get(key)!r} instead of {now.get(key)!r}" for key in keys)


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """The system's exceptions as one line that names the file."""
    try:
        yield
    except OSError as error:
        words = error.strerror or str(error)
        raise PipelineError(
            f"{path}: cannot be written ({words}); what is finished is kept, run the command again to go on"
        ) from error


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
