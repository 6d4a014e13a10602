"""What each row costs: all of them on the same pairs, one after the other, on one thread of one process.

``time_methods`` takes the times; ``match_times`` looks for the iterations with which a baseline takes as long as a row
of ours on this machine.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from ..data.scene_bundle import ScenePair
from .environment import CpuMeter, one_thread, processor_name
from .methods import Method
from .metrics import FloatArray
from .predict import answer_pair
from .registry import parse_method
from .store import ResultStore

logger = logging.getLogger(__name__)

MIN_ITERATIONS, MAX_ITERATIONS = 50, 1 << 20
BISECTIONS = 2
TIE = 0.05  # of the target: times closer to each other than this are the same to a noisy clock
STALL_ITERATIONS = 16_000  # below it, what every pair costs anyway hides the iterations
STALLED = 1.03
"""Twice the iterations take at least this times as long, unless the estimator stops early whatever it is allowed."""


@dataclass(frozen=True)
class Timing:
    """Times of one run.

    Attributes:
        milliseconds: wall clock of each timed pair, by method and scene.
        machine: the processor's name.
        others_load: number of processors that other programs used meanwhile, on average.
    """

    milliseconds: dict[str, dict[str, list[float]]]
    machine: str
    others_load: float


def time_methods(methods: Sequence[Method], pairs: Sequence[ScenePair], store: ResultStore) -> Timing:
    """Times of every method on every pair, at seed 0; taken once for the same methods, pairs and processor.

    Whatever else the machine does hits all methods alike, so that their times can be compared with each other.
    """

    def measure() -> dict[str, Any]:
        logger.info("timing %d rows in turn on %d pairs", len(methods), len(pairs))
        meter = CpuMeter()
        times = interleaved_ms(methods, pairs)
        scenes = list(dict.fromkeys(pair.scene for pair in pairs))
        rows = {scene: [i for i, pair in enumerate(pairs) if pair.scene == scene] for scene in scenes}
        milliseconds = {
            method.name: {scene: [float(times[m, i]) for i in rows[scene]] for scene in scenes}
            for m, method in enumerate(methods)
        }
        return asdict(Timing(milliseconds, processor_name(), meter.others_load()))

    settings = {method.name: method.settings() for method in methods}
    depends_on = {"methods": settings, **circumstances(pairs)}
    return Timing(**store.once("times", depends_on, measure))


def circumstances(pairs: Sequence[ScenePair]) -> dict[str, Any]:
    """What times depend on besides the methods: the pairs, by name and digest of their points, and the processor."""
    digests = [hashlib.sha256(pair.points1.tobytes() + pair.points2.tobytes()).hexdigest() for pair in pairs]
    return {"pairs": {pair.name: digest for pair, digest in zip(pairs, digests)}, "machine": processor_name()}


def interleaved_ms(methods: Sequence[Method], pairs: Sequence[ScenePair]) -> FloatArray:
    """Wall clock (methods, pairs): pair by pair all methods in turn, each pair beginning with another one."""
    times = np.zeros((len(methods), len(pairs)))
    with one_thread():
        for method in methods if pairs else ():
            answer_pair(method, pairs[0], 0)  # not timed: sessions are opened, buffers allocated
        for i, pair in enumerate(pairs):
            for m in ((i + k) % len(methods) for k in range(len(methods))):
                started = time.perf_counter()
                answer_pair(methods[m], pair, 0)
                times[m, i] = 1e3 * (time.perf_counter() - started)
    return times


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
    """Iterations with which each baseline takes as long as ``like`` in the median over the same pairs.

    Confidence is 1 − 1e-9, so that few stop early; where an estimator does, or one iteration costs more than all of
    ours, the time that comes closest is taken, and ``share`` says so.

    Args:
        names: baselines, without a number of iterations.
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
        baseline = parse_method(f"{name} {iterations} iterations")
        ours, theirs = np.median(interleaved_ms([like, baseline], pairs), axis=1)
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
