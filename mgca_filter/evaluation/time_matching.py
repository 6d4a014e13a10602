"""Robust estimators with the milliseconds that the filter uses: how many iterations that is on this machine."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from ..scene_bundle import ScenePair
from .environment import processor_name
from .methods import Method
from .predict import evaluate_pair
from .registry import parse_method

SAMPLE_PAIRS = 60
MIN_ITERATIONS, MAX_ITERATIONS = 50, 1 << 20
BISECTIONS = 2
TIE = 0.05  # of the target: times closer to each other than this are the same to a noisy clock
STALL_ITERATIONS = 16_000  # below it, what every pair costs anyway hides the iterations
STALLED = 1.03
"""Twice the iterations take at least this times as long, unless the estimator stops early whatever it is allowed."""


@dataclass(frozen=True)
class TimeMatch:
    """A row with its iterations.

    Attributes:
        method: name of the row, iterations included. iterations: the most that it may spend.
        reached_ms: its median time on the sample. like, target_ms: the row it was matched to, and that one's time.
    """

    method: str
    iterations: int
    reached_ms: float
    like: str
    target_ms: float


def match_times(
    names: Sequence[str], like: Method, pairs: Sequence[ScenePair], folder: Path | None = None
) -> list[TimeMatch]:
    """Iterations with which each rival takes as long as ``like`` in the median over the same pairs.

    Confidence is 1 − 1e-9, so that few stop early; where an estimator does, or one iteration costs more than all of
    ours, the time that comes closest is taken, and ``reached_ms`` says so.

    Args:
        names: rivals, without a number of iterations.
        like: the row whose time they get.
        pairs: at least one; times are measured here, in turn, on one thread.
        folder: where the answer is kept, so that a second run uses the same rows.
    """
    path = None if folder is None else folder / f"time-matched.{_digest(names, like, pairs)}.json"
    if path is not None and path.exists():
        return [TimeMatch(**fields) for fields in json.loads(path.read_text())]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        target_ms = _median_ms(like, pairs)
        matches = [_search(name, like.name, target_ms, pairs) for name in names]
    finally:
        cv2.setNumThreads(threads)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps([asdict(match) for match in matches], indent=1))
    return matches


def _digest(names: Sequence[str], like: Method, pairs: Sequence[ScenePair]) -> str:
    content = [list(names), like.name, like.settings(), [pair.name for pair in pairs], processor_name()]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _search(name: str, like: str, target_ms: float, pairs: Sequence[ScenePair]) -> TimeMatch:
    """Doubles or halves the iterations past the target, then divides the bracket in the logarithm."""

    def measure(iterations: int) -> float:
        return _median_ms(parse_method(f"{name} {iterations} iterations"), pairs)

    tried = {1000: measure(1000)}
    factor = 2.0 if tried[1000] < target_ms else 0.5
    iterations = 1000
    while (tried[iterations] < target_ms) == (factor > 1):
        following = int(np.clip(iterations * factor, MIN_ITERATIONS, MAX_ITERATIONS))
        if following == iterations:
            break
        tried[following] = measure(following)
        stalled = factor > 1 and tried[following] < STALLED * tried[iterations]
        iterations = following
        if stalled and iterations >= STALL_ITERATIONS:
            break
    for _ in range(BISECTIONS):
        below = [n for n in tried if tried[n] < target_ms]
        above = [n for n in tried if tried[n] >= target_ms]
        if below and above:
            middle = round(float(np.sqrt(max(below) * min(above))))
            tried[middle] = measure(middle)

    def distance(iterations: int) -> tuple[float, int]:
        # Of times a few per cent apart, the most iterations that keep below ours, the fewest of those that do not.
        apart = (tried[iterations] - target_ms) / target_ms
        return round(abs(apart) / TIE) * TIE, -iterations if apart <= 0 else iterations

    best = min(tried, key=distance)
    return TimeMatch(f"{name} {best} iterations", best, tried[best], like, target_ms)


def _median_ms(method: Method, pairs: Sequence[ScenePair]) -> float:
    evaluate_pair(method, pairs[0], 0)  # not timed: sessions are opened, buffers allocated
    return float(np.median([evaluate_pair(method, pair, 0).elapsed_ms for pair in pairs]))
