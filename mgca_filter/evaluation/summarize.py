"""Outcomes of all methods to one summary: means, bootstrap intervals, paired differences, curves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from .difficulty import PairProperties, figures_by_difficulty
from .methods import UNREADABLE, PairOutcome
from .metrics import (
    FAILURE_DEG,
    LOGIT_EDGES,
    POSE_STATISTICS,
    FloatArray,
    SceneErrors,
    ScoreCounts,
    calibration_gap,
    mean_of_the_nonzero,
    mean_over_pairs,
    mean_over_scenes,
    median_error,
    percentile_interval,
    precision_recall_curve,
    reliability,
    resampled_figures,
    share_below,
)
from .pairs import ALL_PAIRS, ALL_SCENES
from .predict import SceneOutcomes
from .summary import (
    INTERVAL_STATISTICS,
    Context,
    Curves,
    Difference,
    PrecisionRecallCurve,
    PrecisionRecallCurves,
    RecallCurves,
    Reliability,
    Summary,
    SummaryRow,
    TimingConditions,
    UnreadablePair,
)
from .timing import Timing

COUNTS = ("failures", "unreadable", "paper_dropped", "timed_pairs")
"""Numbers of pairs, which the mean over scenes adds up; ``pairs`` itself among them."""

RECALL_STEP_DEG = 0.5
RECALL_LIMIT_DEG = 20.0
_CURVE_DIGITS = 4


def scene_errors(outcomes: SceneOutcomes) -> dict[str, FloatArray]:
    """Pose errors (seeds, pairs) by scene, degrees."""
    return {
        scene: np.array([[outcome.error_deg for outcome in run] for run in runs]) for scene, runs in outcomes.items()
    }


def summarize(
    results: Mapping[str, SceneOutcomes],
    context: Context | None = None,
    timing: Timing | None = None,
    *,
    reference: str | None = None,
    replicates: int = 1000,
    seed: int = 0,
) -> Summary:
    """Everything a report shows.

    Args:
        results: outcomes by method, as :func:`predict.predict` returns them.
        context: written beside the rows as it is.
        timing: times of the same methods, as :func:`timing.time_methods` returns them; without, rows hold none.
        reference: method whose differences from every other are listed; None = the first product row, else the last.
        replicates: of the bootstrap; 0 leaves the intervals and differences out.
        seed: of the bootstrap.
    """
    errors = {name: scene_errors(outcomes) for name, outcomes in results.items()}
    times = {} if timing is None else timing.milliseconds
    rows = [
        row
        for name, outcomes in results.items()
        for row in _method_rows(name, outcomes, errors[name], times.get(name, {}))
    ]
    differences: list[Difference] = []
    if replicates > 0:
        resampled = {name: _resampled(scenes, replicates, seed) for name, scenes in errors.items()}
        rows = [_with_intervals(row, resampled[row.method].get(row.scene)) for row in rows]
        differences = _differences(errors, resampled, choose_reference(list(results), reference))
    return Summary(
        rows=rows,
        differences=differences,
        failures={name: _failures(outcomes) for name, outcomes in results.items()},
        unreadable=_unreadable(results),
        difficulty=figures_by_difficulty(errors, _properties(results)),
        curves=Curves(recall_curves(errors), precision_recall_curves(results), reliability_tables(results)),
        timing=None if timing is None else TimingConditions(timing.machine, timing.others_load),
        context=Context() if context is None else context,
    )


def _method_rows(
    name: str, outcomes: SceneOutcomes, errors: SceneErrors, times: Mapping[str, list[float]]
) -> list[SummaryRow]:
    rows = []
    for scene, runs in outcomes.items():
        pose = {key: 100.0 * float(statistic(errors[scene])) for key, statistic in POSE_STATISTICS.items()}
        pose["median_error_deg"] = float(median_error(errors[scene]))
        figures = {**pose, **_decisions(runs), **_times(times.get(scene, []))}
        rows.append(SummaryRow.of(name, scene, len(runs[0]), figures))
    pairs = sum(row.pairs for row in rows)
    # The papers' variant and times are lacking where not one pair of a scene could be read.
    columns: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.figures.items():
            columns.setdefault(key, []).append(value)
    mean = {key: sum(v) if key in COUNTS else float(np.mean(v)) for key, v in columns.items()}
    pooled_runs = [[outcome for runs in outcomes.values() for outcome in runs[s]] for s in range(_seeds(outcomes))]
    pooled = {key: 100.0 * mean_over_pairs(statistic, errors) for key, statistic in POSE_STATISTICS.items()}
    pooled["median_error_deg"] = mean_over_pairs(median_error, errors)
    pooled_times = _times([value for scene in times.values() for value in scene])
    return [
        *rows,
        SummaryRow.of(name, ALL_SCENES, pairs, mean),
        SummaryRow.of(name, ALL_PAIRS, pairs, {**pooled, **_decisions(pooled_runs), **pooled_times}),
    ]


def _seeds(outcomes: SceneOutcomes) -> int:
    return len(next(iter(outcomes.values())))


def _decisions(runs: list[list[PairOutcome]]) -> dict[str, float]:
    """Means of P, R and F over pairs and seeds, medians of both parts of the error, numbers of pairs per seed."""
    outcomes = [outcome for run in runs for outcome in run]
    kept = 100.0 * np.mean([outcome.kept for outcome in outcomes], axis=0)
    mask = 100.0 * np.mean([outcome.mask for outcome in outcomes], axis=0)
    figures = dict(zip(("P", "R", "F", "mask_P", "mask_R", "mask_F"), (float(v) for v in (*kept, *mask))))
    for part in ("rotation_deg", "translation_deg"):
        values = [FAILURE_DEG if getattr(o, part) is None else getattr(o, part) for o in outcomes]
        figures[f"median_{part}"] = float(np.median(values))
    paper = [outcome.paper for outcome in outcomes if not outcome.unreadable]
    if paper and all(values is not None for values in paper):
        for key, values in zip(("paper_P", "paper_R", "paper_F"), zip(*paper)):
            mean, dropped = mean_of_the_nonzero(values)
            figures |= {key: 100.0 * mean, "paper_dropped": dropped / len(runs)}
    figures["failures"] = sum(bool(outcome.failure) for outcome in outcomes) / len(runs)
    figures["unreadable"] = sum(outcome.unreadable for outcome in outcomes) / len(runs)
    return figures


def _times(milliseconds: Sequence[float]) -> dict[str, float]:
    """Median and 95th percentile, and on how many pairs; nothing without any."""
    if not milliseconds:
        return {}
    median, p95 = np.percentile(milliseconds, [50, 95])
    return {"median_ms": float(median), "p95_ms": float(p95), "timed_pairs": len(milliseconds)}


def _resampled(errors: SceneErrors, replicates: int, seed: int) -> dict[str, dict[str, FloatArray]]:
    """By scene, and for the mean over scenes, figures (replicates,) in per cent on resampled pairs.

    The draws are the same for all methods, so that they can be paired.
    """
    figures: dict[str, dict[str, FloatArray]] = {scene: {} for scene in (*errors, ALL_SCENES)}
    for key in INTERVAL_STATISTICS:
        values = 100.0 * resampled_figures(errors, POSE_STATISTICS[key], replicates=replicates, seed=seed)
        for scene, scene_values in zip(errors, values):
            figures[scene][key] = scene_values
        figures[ALL_SCENES][key] = values.mean(axis=0)
    return figures


def _with_intervals(row: SummaryRow, resampled: Mapping[str, FloatArray] | None) -> SummaryRow:
    """The row with its intervals; there are none of the mean over pairs."""
    if resampled is None:
        return row
    return replace(row, intervals={key: percentile_interval(values) for key, values in resampled.items()})


def choose_reference(names: Sequence[str], reference: str | None) -> str:
    """The row that others are compared with: the one named, else the first product row, else the last.

    Raises:
        ValueError: the one named is not among the names.
    """
    if reference is not None:
        if reference not in names:
            raise ValueError(f"reference {reference!r} is not among the methods: {', '.join(names)}")
        return reference
    return next((name for name in names if name.endswith("product")), names[-1])


def _differences(
    errors: Mapping[str, SceneErrors], resampled: Mapping[str, Mapping[str, Mapping[str, FloatArray]]], reference: str
) -> list[Difference]:
    differences = []
    for name in errors:
        if name == reference:
            continue
        figures = {}
        for key in INTERVAL_STATISTICS:
            statistic = POSE_STATISTICS[key]
            value = mean_over_scenes(statistic, errors[reference]) - mean_over_scenes(statistic, errors[name])
            apart = resampled[reference][ALL_SCENES][key] - resampled[name][ALL_SCENES][key]
            figures[key] = (100.0 * value, *percentile_interval(apart))
        differences.append(Difference(reference, name, figures))
    return differences


def _failures(outcomes: SceneOutcomes) -> dict[str, int]:
    """Number of failures by reason, all seeds counted."""
    counter = Counter(o.failure for runs in outcomes.values() for run in runs for o in run if o.failure)
    return dict(counter.most_common())


def _properties(results: Mapping[str, SceneOutcomes]) -> list[PairProperties | None]:
    """How hard each pair is, scene by scene: from any outcome that says so, since older ones may not."""
    found = {
        (scene, outcome.pair): outcome.properties
        for outcomes in results.values()
        for scene, runs in outcomes.items()
        for run in runs
        for outcome in run
        if outcome.properties is not None
    }
    first = next(iter(results.values()))
    return [found.get((scene, outcome.pair)) for scene, runs in first.items() for outcome in runs[0]]


def _unreadable(results: Mapping[str, SceneOutcomes]) -> list[UnreadablePair]:
    """The pairs that could not be read; every method fails on them alike."""
    found = {
        (scene, outcome.pair): outcome.failure.removeprefix(UNREADABLE)
        for outcomes in results.values()
        for scene, runs in outcomes.items()
        for outcome in runs[0]
        if outcome.unreadable
    }
    return [UnreadablePair(scene, pair, reason) for (scene, pair), reason in found.items()]


def recall_curves(errors: Mapping[str, SceneErrors]) -> RecallCurves:
    """Share of pairs below each limit of the pose error, by method."""
    limits = np.arange(0.0, RECALL_LIMIT_DEG + RECALL_STEP_DEG, RECALL_STEP_DEG)
    methods = {
        name: [
            round(mean_over_scenes(partial(share_below, limit_deg=limit), scenes), _CURVE_DIGITS) for limit in limits
        ]
        for name, scenes in errors.items()
    }
    return RecallCurves([float(limit) for limit in limits], methods)


def precision_recall_curves(results: Mapping[str, SceneOutcomes]) -> PrecisionRecallCurves:
    """Precision and recall as the threshold on the logit moves; methods without logits are left out."""
    methods = {}
    for name, outcomes in results.items():
        scenes = [counts for runs in outcomes.values() if (counts := _counts(runs[0]))]
        if not scenes:
            continue
        curves = [precision_recall_curve(counts) for counts in scenes]
        precision, recall = (_mean_of_known([curve[side] for curve in curves]) for side in (0, 1))
        methods[name] = PrecisionRecallCurve(precision, recall)
    return PrecisionRecallCurves(list(LOGIT_EDGES), methods)


def reliability_tables(results: Mapping[str, SceneOutcomes]) -> dict[str, Reliability]:
    """By method what its probabilities are worth; methods without any are left out."""
    tables = {}
    for name, outcomes in results.items():
        counts = [one for runs in outcomes.values() for one in _counts(runs[0])]
        if not counts:
            continue
        bins = reliability(counts)
        tables[name] = Reliability(bins, calibration_gap(bins))
    return tables


def _counts(outcomes: list[PairOutcome]) -> list[ScoreCounts]:
    return [outcome.counts for outcome in outcomes if outcome.counts is not None]


def _mean_of_known(curves: list[FloatArray]) -> list[float | None]:
    stacked = np.array(curves)
    known = np.isfinite(stacked)
    total, count = np.where(known, stacked, 0.0).sum(axis=0), known.sum(axis=0)
    return [round(float(t / c), _CURVE_DIGITS) if c else None for t, c in zip(total, count)]
