"""``mgca-match run script.py``: an unchanged OpenCV script with the filter in place, and what changed.

Every call that the filter takes over is also made to OpenCV's own function, on the same arguments, for the table that
is printed on standard error when the script ends. The script goes on with the filter's answer. Below the table stands
what the filter did not see: calls of OpenCV's other estimators, and processes that the script started.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np

from .patch import TWINS, locate, swapped

UNCOVERED = ("recoverPose", "estimateTranslation2D")
"""OpenCV's other robust estimators between two images; ``recoverPose`` is one where it fits E itself."""


@dataclass(frozen=True)
class Outcome:
    """One function on one call: matches kept, whether it found a model, milliseconds."""

    kept: int
    found: bool
    ms: float


@dataclass(frozen=True)
class Call:
    """One call of the script: where, which function, how many matches, and both answers."""

    place: str
    function: str
    matches: int
    opencv: Outcome
    ours: Outcome


class CallLog:
    """The calls of a script, from all its threads."""

    def __init__(self) -> None:
        self._calls: list[Call] = []
        self._uncovered: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._children_s = _children_seconds()

    def recording(self, name: str, original: Callable[..., Any], twin: Callable[..., Any]) -> Callable[..., Any]:
        """``twin`` as a function that also asks ``original`` and notes what both made of it."""

        def call(*args: Any, **kwargs: Any) -> Any:
            opencv = _try_opencv(original, args, kwargs)
            started = time.perf_counter()
            answer = twin(*args, **kwargs)
            ours = _outcome(answer, started)
            # The mask of an estimator has a row per match; GMS gets its matches as the fifth argument.
            of_gms = name.endswith("matchGMS")
            matches = kwargs.get("matches1to2", args[4] if len(args) > 4 else ()) if of_gms else answer[1]
            with self._lock:
                self._calls.append(Call(_place(sys._getframe(1)), name, len(matches), opencv, ours))
            return answer

        return call

    def counting(self, name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        """``original``, one of :data:`UNCOVERED`, as a function that notes where it is called."""

        def call(*args: Any, **kwargs: Any) -> Any:
            given_a_matrix = name == "recoverPose" and args and np.shape(args[0]) == (3, 3)
            if not given_a_matrix:
                with self._lock:
                    self._uncovered[f"{_place(sys._getframe(1))} {name}"] += 1
            return original(*args, **kwargs)

        return call

    def unseen(self) -> list[str]:
        """Sentences on what the table does not hold."""
        lines = [f"not taken over: {where}, {count} calls" for where, count in self._uncovered.items()]
        if _children_seconds() > self._children_s or multiprocessing.active_children():
            lines.append("the script started other processes: their calls are not in this table")
        return lines

    def table(self) -> str:
        """One row per place in the script: sums over its calls of matches, kept ones and milliseconds."""
        header = ("call", "calls", "matches", "OpenCV kept", "no model", "ms", "filter kept", "no model", "ms")
        places = list(dict.fromkeys((call.place, call.function) for call in self._calls))
        rows: list[Sequence[str]] = [header]
        for place, function in places:
            calls = [call for call in self._calls if (call.place, call.function) == (place, function)]
            row = [f"{place} {function}", str(len(calls)), str(sum(call.matches for call in calls))]
            for outcomes in ([call.opencv for call in calls], [call.ours for call in calls]):
                row.append(str(sum(outcome.kept for outcome in outcomes)))
                row.append(str(sum(not outcome.found for outcome in outcomes)))
                row.append(f"{sum(outcome.ms for outcome in outcomes):.1f}")
            rows.append(row)
        widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
        lines = ["  ".join(f"{word:>{w}}" if i else f"{word:<{w}}" for i, (word, w) in enumerate(zip(row, widths)))
                 for row in rows]  # fmt: skip
        return "\n".join([*(lines if places else ["no call that the filter takes over was made"]), *self.unseen()])


def _place(frame: FrameType) -> str:
    """File and line of a caller."""
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"


def _children_seconds() -> float:
    """Processor time of the child processes that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def _try_opencv(original: Callable[..., Any], args: Sequence[Any], kwargs: dict[str, Any]) -> Outcome:
    """OpenCV's answer; what it raises counts as no model. It gets copies, for it writes into masks."""
    own = [np.copy(value) if isinstance(value, np.ndarray) else value for value in args]
    named = {key: np.copy(value) if isinstance(value, np.ndarray) else value for key, value in kwargs.items()}
    started = time.perf_counter()
    try:
        return _outcome(original(*own, **named), started)
    except cv2.error:
        return Outcome(0, False, 1e3 * (time.perf_counter() - started))


def _outcome(answer: Any, started: float) -> Outcome:
    ms = 1e3 * (time.perf_counter() - started)
    if len(answer) == 2 and (answer[1] is None or isinstance(answer[1], np.ndarray)):
        matrix, mask = answer
        kept = 0 if mask is None else int(np.count_nonzero(mask))
        return Outcome(kept, matrix is not None and kept > 0, ms)
    return Outcome(len(answer), len(answer) > 0, ms)


def run_script(path: Path, arguments: Sequence[str]) -> CallLog:
    """Run a Python script as ``python path arguments`` would, with the filter in the place of OpenCV's functions.

    What the script raises, ``SystemExit`` included, comes out of here after the table has been printed on stderr.
    """
    log = CallLog()
    recording = {}
    for name, twin in TWINS.items():
        module, attribute = locate(name)
        if hasattr(module, attribute):
            recording[name] = log.recording(name, getattr(module, attribute), twin)
    for name in UNCOVERED:
        if hasattr(cv2, name):  # estimateTranslation2D is of OpenCV 4.13
            recording[name] = log.counting(name, getattr(cv2, name))
    sys.argv = [str(path), *arguments]
    sys.path.insert(0, str(path.resolve().parent))
    try:
        with swapped(recording):
            runpy.run_path(str(path), run_name="__main__")
    finally:
        sys.stdout.flush()
        print(f"\nmgca_filter in place of OpenCV in {path}\n{log.table()}", file=sys.stderr)
    return log
