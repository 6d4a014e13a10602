"""``python -m mgca_filter run script.py``: an unchanged OpenCV script with the filter in place, and what changed.

Every call that the filter takes over is also made to OpenCV's own function, on the same arguments, for the table that
is printed on standard error when the script ends. The script goes on with the filter's answer.
"""

from __future__ import annotations

import argparse
import runpy
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..errors import MgcaFilterError
from ..match_filter import MatchFilter
from .patch import TWINS, locate, swapped

EXIT_USAGE = 2


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
        self._lock = threading.Lock()

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
            caller = sys._getframe(1)
            place = f"{Path(caller.f_code.co_filename).name}:{caller.f_lineno}"
            with self._lock:
                self._calls.append(Call(place, name, len(matches), opencv, ours))
            return answer

        return call

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
        return "\n".join(lines) if places else "no call that the filter takes over was made"


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
        return Outcome(0 if mask is None else int(np.count_nonzero(mask)), matrix is not None, ms)
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
    sys.argv = [str(path), *arguments]
    sys.path.insert(0, str(path.resolve().parent))
    try:
        with swapped(recording):
            runpy.run_path(str(path), run_name="__main__")
    finally:
        sys.stdout.flush()
        print(f"\nmgca_filter in place of OpenCV in {path}\n{log.table()}", file=sys.stderr)
    return log


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = the script ended, 2 = there is no script or no filter; else what the script exits with."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter run", description=__doc__)
    parser.add_argument("script", type=Path, help="Python script that calls cv2")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="what the script gets")
    options = parser.parse_args(arguments)
    if not options.script.is_file():
        print(f"mgca_filter run: {options.script}: no such file", file=sys.stderr)
        return EXIT_USAGE
    try:
        MatchFilter()  # opens the model, so that the first call's time is that of a call
    except MgcaFilterError as error:
        print(f"mgca_filter run: {error}", file=sys.stderr)
        return EXIT_USAGE
    run_script(options.script, options.arguments)
    return 0
