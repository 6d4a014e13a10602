"""Which start of the robust fit wins, and what the starts after the first bring and cost."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2

from ..data.scene_bundle import ScenePair
from ..geometry.epipolar import pose_error_deg
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter
from ..result import FilterResult
from .metrics import FAILURE_DEG, mean_average_precision

NO_MODEL = "none"


@dataclass(frozen=True)
class StartOutcome:
    """One pair with all starts and with the first alone.

    Attributes:
        origin: the start that gave the answer, ``"plane"``, or ``"none"``.
        error_deg, first_error_deg: pose error with all starts and with the first alone, 180 without a pose.
        cpu_ms, first_cpu_ms: processor time of the whole filter, likewise.
    """

    origin: str
    error_deg: float
    first_error_deg: float
    cpu_ms: float
    first_cpu_ms: float


def study_starts(pairs: Iterable[ScenePair], model: str | None) -> list[StartOutcome]:
    """Filter every pair twice: with all starts, and with the first alone."""
    cv2.setNumThreads(1)
    every, first = MatchFilter(model=model), MatchFilter(model=model)
    first.fit_options = replace(first.fit_options, starts=first.fit_options.runs[:1])
    outcomes = []
    for pair in pairs:
        (result, cpu_ms), (first_result, first_cpu_ms) = (_filter(one, pair) for one in (every, first))
        errors = (_error_deg(result, pair), _error_deg(first_result, pair))
        outcomes.append(StartOutcome(result.info["origin"] or NO_MODEL, *errors, cpu_ms, first_cpu_ms))
    return outcomes


def format_starts(name: str, outcomes: Sequence[StartOutcome]) -> str:
    """A row: pairs, shares of the origins, mAP@5 with all starts and the first alone, the others' share of the time."""
    origins = Counter(outcome.origin for outcome in outcomes)
    shares = ", ".join(f"{origin} {100.0 * origins[origin] / len(outcomes):.0f} %" for origin in sorted(origins))
    fields = ("error_deg", "first_error_deg", "cpu_ms", "first_cpu_ms")
    errors, first_errors, cpu_ms, first_ms = ([getattr(outcome, field) for outcome in outcomes] for field in fields)
    accuracy = [100.0 * mean_average_precision(values, 5) for values in (errors, first_errors)]
    share = 100.0 * (1.0 - sum(first_ms) / sum(cpu_ms))
    return f"| {name} | {len(outcomes)} | {shares} | {accuracy[0]:.1f} | {accuracy[1]:.1f} | {share:.0f} % |"


HEADER = (
    "| pairs | number | the answer came from | mAP@5, all starts | mAP@5, first alone | time of the others |\n"
    "|---|---:|---|---:|---:|---:|"
)


def _filter(match_filter: MatchFilter, pair: ScenePair) -> tuple[FilterResult, float]:
    """The answer, and the processor time in milliseconds."""
    cameras = (pair.K1, pair.K2, None, None, pair.image_size1, pair.image_size2)
    started = time.process_time()
    result = match_filter.filter_many([MatchPair(pair.points1, pair.points2, None, *cameras, pair.attributes)])[0]
    return result, 1e3 * (time.process_time() - started)


def _error_deg(result: FilterResult, pair: ScenePair) -> float:
    if result.R is None or result.t is None:
        return FAILURE_DEG
    return pose_error_deg(result.R, result.t, pair.R, pair.t)
