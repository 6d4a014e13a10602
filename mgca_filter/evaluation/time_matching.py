"""Robust estimators with the milliseconds that the filter uses: how many iterations that is on this machine."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from ..data.scene_bundle import ScenePair
from .methods import Method
from .registry import parse_method
from .store import ResultStore
from .timing import circumstances, interleaved_ms

logger = logging.getLogger(__name__)

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
        like: the row whose time it gets. share: its median time over that one's, both taken in turn.
    """

    method: str
    iterations: int
    like: str
    share: float


def match_times(names: Sequence[str], like: Method, pairs: Sequence[ScenePair], store: ResultStore) -> list[TimeMatch]:
    """Iterations with which each rival takes as long as ``like`` in the median over the same pairs.

    Confidence is 1 − 1e-9, so that few stop early; where an estimator does, or one iteration costs more than all of
    ours, the time that comes closest is taken, and ``share`` says so.

    Args:
        names: rivals, without a number of iterations.
        like: the row whose time they get.
        pairs: both are timed on them in turn, on one thread.
        store: where the answer is kept, so that a second run uses the same rows.

    Raises:
        ValueError: there is no pair.
    """
    if not pairs:
        raise ValueError("times cannot be matched: not one pair can be read")
    target = {"like": like.name, "settings": like.settings(), **circumstances(pairs)}
    searches = {name: partial(_search, name, like, pairs) for name in names}
    found = [store.once("time-matched", {"row": name, **target}, search) for name, search in searches.items()]
    return [TimeMatch(**match) for match in found]


def _search(name: str, like: Method, pairs: Sequence[ScenePair]) -> dict[str, Any]:
    """Fields of the match: iterations double or halve past the target, then the bracket is divided in the logarithm."""
    logger.info("%s: looking for the iterations that take as long as %s", name, like.name)

    def share(iterations: int) -> float:
        rival = parse_method(f"{name} {iterations} iterations")
        ours, theirs = np.median(interleaved_ms([like, rival], pairs), axis=1)
        return float(theirs / ours)

    tried = {1000: share(1000)}
    factor = 2.0 if tried[1000] < 1.0 else 0.5
    iterations = 1000
    while (tried[iterations] < 1.0) == (factor > 1):
        following = int(np.clip(iterations * factor, MIN_ITERATIONS, MAX_ITERATIONS))
        if following == iterations:
            break
        tried[following] = share(following)
        stalled = factor > 1 and tried[following] < STALLED * tried[iterations]
        iterations = following
        if stalled and iterations >= STALL_ITERATIONS:
            break
    for _ in range(BISECTIONS):
        below = [n for n in tried if tried[n] < 1.0]
        above = [n for n in tried if tried[n] >= 1.0]
        if below and above:
            middle = round(float(np.sqrt(max(below) * min(above))))
            tried[middle] = share(middle)

    def distance(iterations: int) -> tuple[float, int]:
        # Of times a few per cent apart, the most iterations that keep below ours, the fewest of those that do not.
        apart = tried[iterations] - 1.0
        return round(abs(apart) / TIE) * TIE, -iterations if apart <= 0 else iterations

    best = min(tried, key=distance)
    return asdict(TimeMatch(f"{name} {best} iterations", best, like.name, tried[best]))
