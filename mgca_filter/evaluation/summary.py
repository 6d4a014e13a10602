"""Outcomes to figures: one summary, ready for JSON, from which tables and pictures are made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .curves import precision_recall_curves, recall_curves, reliability_tables
from .difficulty import PairProperties, figures_by_difficulty
from .methods import UNREADABLE, PairOutcome
from .metrics import (
    FAILURE_DEG,
    POSE_STATISTICS,
    FloatArray,
    SceneErrors,
    mean_of_the_nonzero,
    mean_over_pairs,
    mean_over_scenes,
    median_error,
    percentile_interval,
    resampled_figures,
)
from .pairs import ALL_PAIRS, ALL_SCENES
from .predict import SceneOutcomes
from .timing import Timing

INTERVAL_STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
COUNTS = ("failures", "unreadable", "paper_dropped", "timed_pairs")
"""Numbers of pairs, which the mean over scenes adds up; ``pairs`` itself among them."""

NOTES = (
    "mAP, AUC, P, R and F in per cent, errors in degrees; a pair without a pose counts as 180 degrees.",
    "P, R, F: the decision before the robust fit (rivals: their selection; the filter: logit > 0) over all matches "
    "against the label 1e-4; mask_P, mask_R, mask_F: the final inliers. Every pair counts.",
    "paper_P, paper_R, paper_F: as published evaluations of the family have them, logit > 2 and pairs whose value is "
    "0 or NaN left out of the mean. Not to be compared with the figures beside them.",
    "Times: wall clock of tests, network and estimator on one thread, detection and matching not counted; pair by pair "
    "all rows in turn, so that whatever else the machine does hits them alike.",
    "OpenCV's estimators fix their own seeds and run once; PoseLib, DEGENSAC and the filter are averaged over seeds.",
    "Candidates are the raw matches that the filter's shipped models look at; the baseline angle lies between the "
    "viewing rays of a right match (median of the pair). By difficulty: means over pairs.",
    "PROSAC and PoseLib with progressive sampling get their matches sorted: by ratio, or by the network's scores.",
)


def scene_errors(outcomes: SceneOutcomes) -> dict[str, FloatArray]:
    """Pose errors (seeds, pairs) by scene, degrees."""
    return {
        scene: np.array([[outcome.error_deg for outcome in run] for run in runs]) for scene, runs in outcomes.items()
    }


def summarize(
    results: Mapping[str, SceneOutcomes],
    context: Mapping[str, Any],
    timing: Timing | None = None,
    *,
    reference: str | None = None,
    replicates: int = 1000,
    seed: int = 0,
) -> dict[str, Any]:
    """Everything a report shows, ready for JSON.

    Args:
        results: outcomes by method, as :func:`predict.predict` returns them.
        context: written beside the rows as it is: versions, seed, commit, machine, settings.
        timing: times of the same methods, as :func:`timing.time_methods` returns them; without, rows hold none.
        reference: method whose differences from every other are listed; None = the first product row, else the last.
        replicates: of the bootstrap; 0 leaves the intervals and differences out.
        seed: of the bootstrap.

    Returns:
        ``rows`` (one per method and scene, then scene "all" = mean over scenes and "pairs" = mean over pairs),
        ``differences``, ``failures`` (reasons by method), ``unreadable`` (pairs that no method could have solved),
        ``difficulty`` (figures on easier and harder pairs), ``curves``, ``timing`` and ``notes``, and the context's own
        fields.
    """
    errors = {name: scene_errors(outcomes) for name, outcomes in results.items()}
    times = {} if timing is None else timing.milliseconds
    rows = [
        row
        for name, outcomes in results.items()
        for row in _method_rows(name, outcomes, errors[name], times.get(name, {}))
    ]
    differences: list[dict[str, Any]] = []
    if replicates > 0:
        resampled = {name: _resampled(scenes, replicates, seed) for name, scenes in errors.items()}
        for row in rows:
            if row["scene"] in resampled[row["method"]]:
                figures = resampled[row["method"]][row["scene"]]
                row["intervals"] = {key: percentile_interval(values) for key, values in figures.items()}
        differences = _differences(errors, resampled, choose_reference(list(results), reference))
    return {
        "rows": rows,
        "differences": differences,
        "failures": {name: _failures(outcomes) for name, outcomes in results.items()},
        "unreadable": _unreadable(results),
        "difficulty": figures_by_difficulty(errors, _properties(results)),
        "curves": {
            "recall": recall_curves(errors),
            "precision_recall": precision_recall_curves(results),
            "reliability": reliability_tables(results),
        },
        "timing": None if timing is None else {"machine": timing.machine, "others_load": timing.others_load},
        "notes": list(NOTES),
        **context,
    }


def _method_rows(
    name: str, outcomes: SceneOutcomes, errors: SceneErrors, times: Mapping[str, list[float]]
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for scene, runs in outcomes.items():
        figures = {key: 100.0 * float(statistic(errors[scene])) for key, statistic in POSE_STATISTICS.items()}
        figures["median_error_deg"] = float(median_error(errors[scene]))
        rows.append(
            {
                "method": name,
                "scene": scene,
                "pairs": len(runs[0]),
                **figures,
                **_decisions(runs),
                **_times(times.get(scene, [])),
            }
        )
    pairs = sum(row["pairs"] for row in rows)
    # The papers' variant and times are lacking where not one pair of a scene could be read.
    keys = dict.fromkeys(key for row in rows for key in row if key not in ("method", "scene", "pairs"))
    columns = {key: [row[key] for row in rows if key in row] for key in keys}
    mean = {key: float(np.mean(values)) for key, values in columns.items() if key not in COUNTS}
    sums = {key: sum(columns[key]) for key in COUNTS if key in columns}
    headline = {"method": name, "scene": ALL_SCENES, "pairs": pairs, **mean, **sums}
    pooled_runs = [[outcome for runs in outcomes.values() for outcome in runs[s]] for s in range(_seeds(outcomes))]
    pooled = {key: 100.0 * mean_over_pairs(statistic, errors) for key, statistic in POSE_STATISTICS.items()}
    pooled["median_error_deg"] = mean_over_pairs(median_error, errors)
    pooled_row = {
        "method": name,
        "scene": ALL_PAIRS,
        "pairs": pairs,
        **pooled,
        **_decisions(pooled_runs),
        **_times([value for scene in times.values() for value in scene]),
    }
    return [*rows, headline, pooled_row]


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


def is_ours(method: str) -> bool:
    """Whether a row is the filter's own, by its name."""
    return "product" in method or "network" in method


def best_rival(summary: Mapping[str, Any], reference: str) -> str:
    """The row of the highest mAP@20 beside the reference, not one of ours where there are others; alone, itself."""
    others = [row for row in summary["rows"] if row["scene"] == ALL_SCENES and row["method"] != reference]
    rivals = [row for row in others if not is_ours(row["method"])] or others
    return str(max(rivals, key=lambda row: row["mAP@20"])["method"]) if rivals else reference


def _differences(
    errors: Mapping[str, SceneErrors], resampled: Mapping[str, Mapping[str, Mapping[str, FloatArray]]], reference: str
) -> list[dict[str, Any]]:
    """Reference minus each other method, mean over scenes, per cent points, with 95 % paired bootstrap intervals."""
    differences = []
    for name in errors:
        if name == reference:
            continue
        entry: dict[str, Any] = {"method": reference, "minus": name}
        for key in INTERVAL_STATISTICS:
            statistic = POSE_STATISTICS[key]
            value = mean_over_scenes(statistic, errors[reference]) - mean_over_scenes(statistic, errors[name])
            apart = resampled[reference][ALL_SCENES][key] - resampled[name][ALL_SCENES][key]
            entry[key] = [100.0 * value, *percentile_interval(apart)]
        differences.append(entry)
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


def _unreadable(results: Mapping[str, SceneOutcomes]) -> list[dict[str, Any]]:
    """Scene, index and reason of each pair that could not be read; every method fails on it alike."""
    found = {
        (scene, outcome.pair): outcome.failure.removeprefix(UNREADABLE)
        for outcomes in results.values()
        for scene, runs in outcomes.items()
        for outcome in runs[0]
        if outcome.unreadable
    }
    return [{"scene": scene, "pair": pair, "reason": reason} for (scene, pair), reason in found.items()]
