"""What each row costs: all of them on the same pairs, one after the other, on one thread of one process."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..data.scene_bundle import ScenePair
from .environment import CpuMeter, one_thread, processor_name
from .methods import Method
from .metrics import FloatArray
from .predict import answer_pair
from .store import ResultStore

logger = logging.getLogger(__name__)


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
