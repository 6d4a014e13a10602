"""The summary as tables: plain text, Markdown or LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..tables import MISSING, Style, heading, render_table
from .difficulty import DifficultyTable
from .environment import BUSY_LOAD
from .methods import UNREADABLE
from .pairs import ALL_PAIRS, ALL_SCENES
from .summary import INTERVAL_STATISTICS, Difference, Summary, SummaryRow

COLUMNS = ("mAP@5", "mAP@20", "AUC@5", "AUC@10", "AUC@20", "P", "R", "F", "median_ms", "p95_ms")
DECISIONS = ("P", "R", "F", "mask_P", "mask_R", "mask_F", "paper_P", "paper_R", "paper_F", "paper_dropped")


class _Table(NamedTuple):
    title: str
    header: list[str]
    body: list[list[str]]


def format_report(summary: Summary, style: Style) -> str:
    """The summary as text: headline, mean over pairs, mAP@20 by scene and difficulty, decisions, intervals, notes.

    LaTeX holds the tables alone, for ``booktabs``.
    """
    tables = [*_mean_tables(summary), _scene_table(summary)]
    tables += [_difficulty_table(table) for table in summary.difficulty]
    tables.append(_decision_table(summary))
    if any(row.intervals is not None for row in summary.rows):
        tables.append(_interval_table(summary))
    if summary.differences:
        tables.append(_difference_table(summary.differences))
    parts = [render_table(table.header, table.body, style, title=table.title) for table in tables]
    if style != "latex":
        parts += [heading("Failures", style) + "\n\n" + _failure_lines(summary)]
        parts += [heading("How it was measured", style) + "\n\n" + _measurement_lines(summary)]
    return "\n\n".join(parts) + "\n"


def _mean_tables(summary: Summary) -> list[_Table]:
    tables = []
    for title, scene in (("Mean over scenes (headline)", ALL_SCENES), ("Mean over pairs", ALL_PAIRS)):
        body = [
            [row.method, str(row.pairs), *_cells(row, COLUMNS), f"{row.failures:g}"] for row in summary.rows_of(scene)
        ]
        body += [[item.method, *["not installed"] * (len(COLUMNS) + 2)] for item in summary.context.not_installed]
        tables.append(_Table(title, ["method", "pairs", *COLUMNS, "failures"], body))
    return tables


def _cells(row: SummaryRow, names: Sequence[str]) -> list[str]:
    figures = row.figures
    return [f"{figures[name]:.1f}" if name in figures else MISSING for name in names]


def _scene_table(summary: Summary) -> _Table:
    figures = {(row.method, row.scene): row.pose["mAP@20"] for row in summary.rows}
    methods = dict.fromkeys(row.method for row in summary.rows)
    body = [[name, *(f"{figures[name, scene]:.1f}" for scene in summary.scenes)] for name in methods]
    return _Table("mAP@20 by scene", ["method", *summary.scenes], body)


def _difficulty_table(table: DifficultyTable) -> _Table:
    header = [f"{group.group} ({group.pairs})" for group in table.groups]
    body = [
        [method, *(f"{group.methods[method]['mAP@20']:.1f}" for group in table.groups)]
        for method in table.groups[0].methods
    ]
    return _Table(f"mAP@20 by {table.property} (number of pairs)", ["method", *header], body)


def _decision_table(summary: Summary) -> _Table:
    title = "Decisions, mean over pairs: before the fit, the final mask, and the papers' own variant"
    body = [[row.method, *_cells(row, DECISIONS)] for row in summary.rows_of(ALL_PAIRS)]
    return _Table(title, ["method", *DECISIONS], body)


def _interval_table(summary: Summary) -> _Table:
    body = [
        [row.method, *("{:.1f} … {:.1f}".format(*row.intervals[key]) for key in INTERVAL_STATISTICS)]
        for row in summary.rows_of(ALL_SCENES)
        if row.intervals is not None
    ]
    return _Table("95 % bootstrap intervals of the headline", ["method", *INTERVAL_STATISTICS], body)


def _difference_table(differences: Sequence[Difference]) -> _Table:
    body = []
    for one in differences:
        cells = ["{:+.1f} [{:+.1f}, {:+.1f}]".format(*one.figures[key]) for key in INTERVAL_STATISTICS]
        body.append([f"{one.method} − ({one.minus})", *cells])
    title = "Differences in percentage points, 95 % paired bootstrap intervals"
    return _Table(title, ["difference", *INTERVAL_STATISTICS], body)


def _failure_lines(summary: Summary) -> str:
    lines = []
    if summary.unreadable:
        lines.append(f"- {len(summary.unreadable)} pairs could not be read and count as failures of every method:")
        lines += [f"  - {item.scene}, pair {item.pair}: {item.reason}" for item in summary.unreadable]
    for name, reasons in summary.failures.items():
        shown = {reason: count for reason, count in reasons.items() if not reason.startswith(UNREADABLE)}
        if shown:
            lines.append(f"- {name}: " + ", ".join(f"{reason} ({count})" for reason, count in shown.items()))
    return "\n".join(lines) or "- none"


def _measurement_lines(summary: Summary) -> str:
    context, timing = summary.context, summary.timing
    lines = [f"- {note}" for note in summary.notes]
    lines += [f"- {item.method}: not installed ({item.reason})" for item in context.not_installed]
    lines += [
        f"- {row.method}: takes {row.share:.2f} times as long as {row.like} in the median"
        for row in context.time_matched
    ]
    if timing is not None:
        caution = ": do not rely on these times." if timing.others_load > BUSY_LOAD else "."
        lines.append(
            f"- Timed on {timing.machine}, {summary.timed_pairs} pairs; other programs used "
            f"{timing.others_load:.2f} processors meanwhile{caution}"
        )
    if context.commit is not None:
        lines.append(f"- commit: {context.commit}")
    if context.seed is not None:
        lines.append(f"- seed: {context.seed}")
    lines += [f"- versions: {_listed(context.versions)}"] * bool(context.versions)
    lines += [f"- machine: {_listed(context.machine)}"] * bool(context.machine)
    # The estimators' options, one line for each that occurs.
    methods = context.settings.get("methods", {})
    estimators = [settings["estimator"] for settings in methods.values() if "estimator" in settings]
    lines += dict.fromkeys(f"- estimator: {_listed(estimator)}" for estimator in estimators)
    return "\n".join(lines)


def _listed(facts: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in facts.items())
