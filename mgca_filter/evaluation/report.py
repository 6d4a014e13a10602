"""Outcomes to tables: one summary for JSON, text and Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .methods import PairOutcome
from .metrics import (
    POSE_STATISTICS,
    FloatArray,
    SceneErrors,
    bootstrap_interval,
    mean_over_pairs,
    mean_over_scenes,
    median_error,
    paired_bootstrap_interval,
)
from .predict import SceneOutcomes

ALL_SCENES, ALL_PAIRS = "all", "pairs"
INTERVAL_STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
COLUMNS = ("mAP@5", "mAP@20", "AUC@5", "AUC@10", "AUC@20", "P", "R", "F", "median_ms")

NOTES = (
    "mAP, AUC, P, R and F in per cent, errors in degrees; a pair without a pose counts as 180 degrees.",
    "P, R, F: the decision before the robust fit (rivals: their selection; the filter: logit > 0) over all matches "
    "against the label 1e-4; mask_P, mask_R, mask_F: the final inliers.",
    "Times: wall clock of filter and estimator with one OpenCV thread; ONNX Runtime uses its own number of threads.",
    "OpenCV's estimators and the filter's OpenCV fit are deterministic and run once; PoseLib is averaged over seeds.",
    "PROSAC and PoseLib with progressive sampling get their matches sorted by ratio.",
)


def scene_errors(outcomes: SceneOutcomes) -> dict[str, FloatArray]:
    """Pose errors (seeds, pairs) by scene, degrees."""
    return {
        scene: np.array([[outcome.error_deg for outcome in run] for run in runs]) for scene, runs in outcomes.items()
    }


def summarize(
    results: Mapping[str, SceneOutcomes],
    context: Mapping[str, Any],
    *,
    reference: str | None = None,
    replicates: int = 1000,
    seed: int = 0,
) -> dict[str, Any]:
    """Everything a report shows, ready for JSON.

    Args:
        results: outcomes by method, as :func:`predict.predict` returns them.
        context: written beside the rows as it is: versions, seed, commit, machine, settings.
        reference: method whose differences from every other are listed; None = the first product row, else the last.
        replicates: of the bootstrap; 0 leaves the intervals and differences out.
        seed: of the bootstrap.

    Returns:
        ``rows`` (one per method and scene, then scene "all" = mean over scenes and "pairs" = mean over pairs),
        ``differences``, ``failures`` (reasons by method), ``timing`` and ``notes``, and the context's own fields.
    """
    errors = {name: scene_errors(outcomes) for name, outcomes in results.items()}
    rows = [row for name, outcomes in results.items() for row in _method_rows(name, outcomes, errors[name])]
    differences: list[dict[str, Any]] = []
    if replicates > 0:
        for row in rows:
            if row["scene"] == ALL_SCENES:
                row["intervals"] = _intervals(errors[row["method"]], replicates, seed)
        differences = _differences(errors, _choose_reference(results, reference), replicates, seed)
    return {
        "rows": rows,
        "differences": differences,
        "failures": {name: _failures(outcomes) for name, outcomes in results.items()},
        "timing": _timing(results),
        "notes": list(NOTES),
        **context,
    }


def _method_rows(name: str, outcomes: SceneOutcomes, errors: SceneErrors) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for scene, runs in outcomes.items():
        figures = {key: 100.0 * statistic(errors[scene]) for key, statistic in POSE_STATISTICS.items()}
        figures["median_error_deg"] = median_error(errors[scene])
        rows.append({"method": name, "scene": scene, "pairs": len(runs[0]), **figures, **_decisions_and_times(runs)})
    pairs = sum(row["pairs"] for row in rows)
    numbers = [key for key in rows[0] if key not in ("method", "scene", "pairs", "failures")]
    failures = sum(row["failures"] for row in rows)
    mean = {key: float(np.mean([row[key] for row in rows])) for key in numbers}
    headline = {"method": name, "scene": ALL_SCENES, "pairs": pairs, **mean, "failures": failures}
    pooled_runs = [[outcome for runs in outcomes.values() for outcome in runs[s]] for s in range(_seeds(outcomes))]
    pooled = {key: 100.0 * mean_over_pairs(statistic, errors) for key, statistic in POSE_STATISTICS.items()}
    pooled["median_error_deg"] = mean_over_pairs(median_error, errors)
    pooled_row = {"method": name, "scene": ALL_PAIRS, "pairs": pairs, **pooled, **_decisions_and_times(pooled_runs)}
    return [*rows, headline, pooled_row]


def _seeds(outcomes: SceneOutcomes) -> int:
    return len(next(iter(outcomes.values())))


def _decisions_and_times(runs: list[list[PairOutcome]]) -> dict[str, float]:
    """Means of P, R, F and medians of the times over pairs and seeds; the number of failures per seed."""
    outcomes = [outcome for run in runs for outcome in run]
    kept = 100.0 * np.mean([outcome.kept for outcome in outcomes], axis=0)
    mask = 100.0 * np.mean([outcome.mask for outcome in outcomes], axis=0)
    return {
        **dict(zip(("P", "R", "F", "mask_P", "mask_R", "mask_F"), (float(v) for v in (*kept, *mask)))),
        "median_ms": float(np.median([outcome.elapsed_ms for outcome in outcomes])),
        "median_cpu_ms": float(np.median([outcome.cpu_ms for outcome in outcomes])),
        "failures": sum(bool(outcome.failure) for outcome in outcomes) / len(runs),
    }


def _intervals(errors: SceneErrors, replicates: int, seed: int) -> dict[str, list[float]]:
    intervals = {}
    for key in INTERVAL_STATISTICS:
        bounds = bootstrap_interval(errors, POSE_STATISTICS[key], replicates=replicates, seed=seed)
        intervals[key] = [100.0 * bound for bound in bounds]
    return intervals


def _choose_reference(results: Mapping[str, SceneOutcomes], reference: str | None) -> str:
    names = list(results)
    if reference is not None:
        if reference not in names:
            raise ValueError(f"reference {reference!r} is not among the methods: {', '.join(names)}")
        return reference
    return next((name for name in names if name.endswith("product")), names[-1])


def _differences(errors: Mapping[str, SceneErrors], reference: str, replicates: int, seed: int) -> list[dict[str, Any]]:
    """Reference minus each other method, mean over scenes, per cent points, with 95 % paired bootstrap intervals."""
    differences = []
    for name in errors:
        if name == reference:
            continue
        entry: dict[str, Any] = {"method": reference, "minus": name}
        for key in INTERVAL_STATISTICS:
            statistic = POSE_STATISTICS[key]
            value = mean_over_scenes(statistic, errors[reference]) - mean_over_scenes(statistic, errors[name])
            bounds = paired_bootstrap_interval(
                errors[reference], errors[name], statistic, replicates=replicates, seed=seed
            )
            entry[key] = [100.0 * number for number in (value, *bounds)]
        differences.append(entry)
    return differences


def _failures(outcomes: SceneOutcomes) -> dict[str, int]:
    """Number of failures by reason, all seeds counted."""
    counter = Counter(o.failure for runs in outcomes.values() for run in runs for o in run if o.failure)
    return dict(counter.most_common())


def _timing(results: Mapping[str, SceneOutcomes]) -> dict[str, Any]:
    outcomes = [o for by_scene in results.values() for runs in by_scene.values() for run in runs for o in run]
    busy = sum(outcome.busy for outcome in outcomes) / len(outcomes)
    return {"machines": sorted({outcome.machine for outcome in outcomes}), "share_on_busy_machine": busy}


def format_report(summary: Mapping[str, Any], *, markdown: bool) -> str:
    """The summary as plain text or Markdown: headline, mean over pairs, mAP@20 by scene, differences, notes."""
    parts = []
    for title, scene in (("Mean over scenes (headline)", ALL_SCENES), ("Mean over pairs", ALL_PAIRS)):
        rows = [row for row in summary["rows"] if row["scene"] == scene]
        header = ["method", "pairs", *COLUMNS, "failures"]
        body = [
            [row["method"], str(row["pairs"]), *(f"{row[key]:.1f}" for key in COLUMNS), f"{row['failures']:g}"]
            for row in rows
        ]
        parts += [_heading(title, markdown), _table(header, body, markdown)]
    parts += [_heading("mAP@20 by scene", markdown), _scene_table(summary["rows"], markdown)]
    if summary["differences"]:
        parts += [_heading("Differences in per cent points, 95 % paired bootstrap intervals", markdown)]
        parts += [_difference_table(summary["differences"], markdown)]
    parts += [_heading("Failures", markdown), _failure_lines(summary["failures"])]
    parts += [_heading("How it was measured", markdown), _measurement_lines(summary)]
    return "\n\n".join(parts) + "\n"


def _heading(text: str, markdown: bool) -> str:
    return f"## {text}" if markdown else text


def _table(header: Sequence[str], body: Sequence[Sequence[str]], markdown: bool) -> str:
    """Columns aligned in both forms: the first to the left, figures to the right."""
    widths = [max(len(line[column]) for line in [header, *body]) for column in range(len(header))]
    lines = []
    for cells in [header, *body]:
        padded = [cells[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(cells[1:], widths[1:]))]
        lines.append(f"| {' | '.join(padded)} |" if markdown else "  ".join(padded).rstrip())
    rule = "|".join(["-" * (widths[0] + 2), *("-" * (width + 1) + ":" for width in widths[1:])])
    lines.insert(1, f"|{rule}|" if markdown else "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def _scene_table(rows: Sequence[Mapping[str, Any]], markdown: bool) -> str:
    scenes = list(dict.fromkeys(row["scene"] for row in rows if row["scene"] not in (ALL_SCENES, ALL_PAIRS)))
    figures = {(row["method"], row["scene"]): row["mAP@20"] for row in rows}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    body = [[name, *(f"{figures[name, scene]:.1f}" for scene in scenes)] for name in methods]
    return _table(["method", *scenes], body, markdown)


def _difference_table(differences: Sequence[Mapping[str, Any]], markdown: bool) -> str:
    body = []
    for entry in differences:
        cells = ["{:+.1f} [{:+.1f}, {:+.1f}]".format(*entry[key]) for key in INTERVAL_STATISTICS]
        body.append([f"{entry['method']} − ({entry['minus']})", *cells])
    return _table(["difference", *INTERVAL_STATISTICS], body, markdown)


def _failure_lines(failures: Mapping[str, Mapping[str, int]]) -> str:
    lines = []
    for name, reasons in failures.items():
        if reasons:
            lines.append(f"- {name}: " + ", ".join(f"{reason} ({count})" for reason, count in reasons.items()))
    return "\n".join(lines) or "- none"


def _measurement_lines(summary: Mapping[str, Any]) -> str:
    lines = [f"- {note}" for note in summary["notes"]]
    busy = summary["timing"]["share_on_busy_machine"]
    lines.append(
        f"- Timed on {', '.join(summary['timing']['machines'])}; {100 * busy:.0f} % of it while other programs"
    )
    lines[-1] += " were at work on the machine" + (": do not rely on these times." if busy > 0 else ".")
    for key in ("commit", "seed", "versions", "machine"):
        if key in summary:
            value = summary[key]
            text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else str(value)
            lines.append(f"- {key}: {text}")
    return "\n".join(lines)
