"""The summary as tables: plain text, Markdown or LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from .environment import BUSY_LOAD
from .methods import UNREADABLE
from .pairs import ALL_PAIRS, ALL_SCENES
from .summary import INTERVAL_STATISTICS

Style = Literal["text", "markdown", "latex"]
COLUMNS = ("mAP@5", "mAP@20", "AUC@5", "AUC@10", "AUC@20", "P", "R", "F", "median_ms", "p95_ms")
DECISIONS = ("P", "R", "F", "mask_P", "mask_R", "mask_F", "paper_P", "paper_R", "paper_F", "paper_dropped")
MISSING = "–"


def format_report(summary: Mapping[str, Any], style: Style) -> str:
    """The summary as text: headline, mean over pairs, mAP@20 by scene and difficulty, decisions, intervals, notes.

    LaTeX holds the tables alone, for ``booktabs``.
    """
    tables = [*_mean_tables(summary), ("mAP@20 by scene", *_scene_table(summary["rows"]))]
    tables += [_difficulty_table(entry) for entry in summary["difficulty"]]
    tables.append(_decision_table(summary))
    if any("intervals" in row for row in summary["rows"]):
        tables.append(_interval_table(summary["rows"]))
    if summary["differences"]:
        tables.append(_difference_table(summary["differences"]))
    parts = [render_table(title, header, body, style) for title, header, body in tables]
    if style != "latex":
        parts += [_heading("Failures", style) + "\n\n" + _failure_lines(summary)]
        parts += [_heading("How it was measured", style) + "\n\n" + _measurement_lines(summary)]
    return "\n\n".join(parts) + "\n"


def timed_pairs(summary: Mapping[str, Any]) -> int:
    """Number of pairs that the times were taken on; 0 without times."""
    return max(int(row.get("timed_pairs", 0)) for row in summary["rows"] if row["scene"] == ALL_PAIRS)


def _heading(text: str, style: Style) -> str:
    return f"## {text}" if style == "markdown" else text


def render_table(title: str, header: Sequence[str], body: Sequence[Sequence[str]], style: Style) -> str:
    """A titled table in one of the styles: the first column to the left, the others to the right."""
    if style == "latex":
        return _latex_table(title, header, body)
    widths = [max(len(line[column]) for line in [header, *body]) for column in range(len(header))]
    lines = []
    for cells in [header, *body]:
        padded = [cells[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(cells[1:], widths[1:]))]
        lines.append(f"| {' | '.join(padded)} |" if style == "markdown" else "  ".join(padded).rstrip())
    rule = "|".join(["-" * (widths[0] + 2), *("-" * (width + 1) + ":" for width in widths[1:])])
    lines.insert(1, f"|{rule}|" if style == "markdown" else "  ".join("-" * width for width in widths))
    return _heading(title, style) + "\n\n" + "\n".join(lines)


def _latex_table(title: str, header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    rows = [" & ".join(_escape(cell) for cell in cells) + r" \\" for cells in [header, *body]]
    lines = [
        r"\begin{table}",
        r"  \centering",
        rf"  \begin{{tabular}}{{l{'r' * (len(header) - 1)}}}",
        r"    \toprule",
        f"    {rows[0]}",
        r"    \midrule",
        *(f"    {row}" for row in rows[1:]),
        r"    \bottomrule",
        r"  \end{tabular}",
        rf"  \caption{{{_escape(title)}}}",
        r"\end{table}",
    ]
    return "\n".join(lines)


def _escape(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "–": "--", "−": "$-$", "°": r"$^\circ$"}
    special |= {character: "\\" + character for character in "&%$#_{}"}
    return "".join(special.get(character, character) for character in text)


def _mean_tables(summary: Mapping[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    tables = []
    for title, scene in (("Mean over scenes (headline)", ALL_SCENES), ("Mean over pairs", ALL_PAIRS)):
        rows = [row for row in summary["rows"] if row["scene"] == scene]
        body = [[row["method"], str(row["pairs"]), *_cells(row, COLUMNS), f"{row['failures']:g}"] for row in rows]
        body += [[item["method"], *["not installed"] * (len(COLUMNS) + 2)] for item in summary.get("not_installed", [])]
        tables.append((title, ["method", "pairs", *COLUMNS, "failures"], body))
    return tables


def _cells(row: Mapping[str, Any], keys: Sequence[str]) -> list[str]:
    return [f"{row[key]:.1f}" if key in row else MISSING for key in keys]


def _scene_table(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    scenes = list(dict.fromkeys(row["scene"] for row in rows if row["scene"] not in (ALL_SCENES, ALL_PAIRS)))
    figures = {(row["method"], row["scene"]): row["mAP@20"] for row in rows}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    return ["method", *scenes], [[name, *(f"{figures[name, scene]:.1f}" for scene in scenes)] for name in methods]


def _difficulty_table(entry: Mapping[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    groups = entry["groups"]
    header = [f"{group['group']} ({group['pairs']})" for group in groups]
    body = [
        [method, *(f"{group['methods'][method]['mAP@20']:.1f}" for group in groups)] for method in groups[0]["methods"]
    ]
    return f"mAP@20 by {entry['property']} (number of pairs)", ["method", *header], body


def _decision_table(summary: Mapping[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    rows = [row for row in summary["rows"] if row["scene"] == ALL_PAIRS]
    title = "Decisions, mean over pairs: before the fit, the final mask, and the papers' own variant"
    return title, ["method", *DECISIONS], [[row["method"], *_cells(row, DECISIONS)] for row in rows]


def _interval_table(rows: Sequence[Mapping[str, Any]]) -> tuple[str, list[str], list[list[str]]]:
    body = [
        [row["method"], *("{:.1f} … {:.1f}".format(*row["intervals"][key]) for key in INTERVAL_STATISTICS)]
        for row in rows
        if row["scene"] == ALL_SCENES
    ]
    return "95 % bootstrap intervals of the headline", ["method", *INTERVAL_STATISTICS], body


def _difference_table(differences: Sequence[Mapping[str, Any]]) -> tuple[str, list[str], list[list[str]]]:
    body = []
    for entry in differences:
        cells = ["{:+.1f} [{:+.1f}, {:+.1f}]".format(*entry[key]) for key in INTERVAL_STATISTICS]
        body.append([f"{entry['method']} − ({entry['minus']})", *cells])
    title = "Differences in percentage points, 95 % paired bootstrap intervals"
    return title, ["difference", *INTERVAL_STATISTICS], body


def _failure_lines(summary: Mapping[str, Any]) -> str:
    lines = []
    unreadable = summary["unreadable"]
    if unreadable:
        lines.append(f"- {len(unreadable)} pairs could not be read and count as failures of every method:")
        lines += [f"  - {item['scene']}, pair {item['pair']}: {item['reason']}" for item in unreadable]
    for name, reasons in summary["failures"].items():
        shown = {reason: count for reason, count in reasons.items() if not reason.startswith(UNREADABLE)}
        if shown:
            lines.append(f"- {name}: " + ", ".join(f"{reason} ({count})" for reason, count in shown.items()))
    return "\n".join(lines) or "- none"


def _measurement_lines(summary: Mapping[str, Any]) -> str:
    lines = [f"- {note}" for note in summary["notes"]]
    lines += [f"- {item['method']}: not installed ({item['reason']})" for item in summary.get("not_installed", [])]
    lines += [
        "- {method}: takes {share:.2f} times as long as {like} in the median".format(**row)
        for row in summary.get("time_matched", [])
    ]
    timing = summary["timing"]
    if timing:
        caution = ": do not rely on these times." if timing["others_load"] > BUSY_LOAD else "."
        lines.append(
            f"- Timed on {timing['machine']}, {timed_pairs(summary)} pairs; other programs used "
            f"{timing['others_load']:.2f} processors meanwhile{caution}"
        )
    for key in ("commit", "seed", "versions", "machine"):
        if key in summary:
            value = summary[key]
            text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else str(value)
            lines.append(f"- {key}: {text}")
    return "\n".join(lines + _setting_lines(summary))


def _setting_lines(summary: Mapping[str, Any]) -> list[str]:
    """The estimators' options, one line for each that occurs."""
    methods = summary.get("settings", {}).get("methods", {})
    estimators = [settings["estimator"] for settings in methods.values() if "estimator" in settings]
    lines = ["- estimator: " + ", ".join(f"{key} {value}" for key, value in one.items()) for one in estimators]
    return list(dict.fromkeys(lines))
