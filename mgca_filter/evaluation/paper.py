"""The paper's two tables beside our figures: ``python -m mgca_filter.evaluation.paper [--json OURS]``.

``OURS`` is what ``python -m mgca_filter.evaluation --json OURS`` wrote. A scene of it that bears the name of one of the
published dumps (``yfcc-sift-2000-test`` and so on) fills the dump's column; the mean over scenes of all others stands
in a column of its own, where the paper has nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..tables import MISSING, STYLES, Style, render_table
from .summary import Summary

NOT_MEASURED = "not measured"
OTHER_SCENES = "our scenes"
DATA = Path(__file__).with_name("paper_tables.json")

NOTES = (
    "The paper's P, R and F count logit > 2 and leave out pairs of value 0 or NaN: compare 'the papers' variant'; "
    "'all pairs' counts logit > 0, a baseline's own selection, and every pair.",
    "The paper's poses come without RANSAC: the row of ours to compare is 'network E'.",
    f"'{OTHER_SCENES}': mean over the scenes of our run that are none of the paper's dumps.",
)


def load_paper() -> dict[str, Any]:
    """The published tables: ``source``, ``splits`` (name and file name of the dump), ``tables`` with their rows."""
    content: dict[str, Any] = json.loads(DATA.read_text(encoding="utf-8"))
    return content


def format_paper(summary: Summary | None, style: Style = "text") -> str:
    """Both tables with the rows of ``summary`` (None = without), "not measured" where a figure is lacking."""
    paper = load_paper()
    parts = []
    for table in paper["tables"]:
        header = ["method", *(split["name"] for split in paper["splits"]), OTHER_SCENES]
        body = [[row["method"], *(_join(row[name]) for name in header[1:-1]), NOT_MEASURED] for row in table["rows"]]
        for suffix, metrics in table["ours"].items():
            body += [] if summary is None else _our_rows(summary, paper["splits"], suffix, metrics)
        title = f"{table['title']}: {' / '.join(table['metrics'])}, per cent"
        parts.append(render_table(header, body, style, title=title))
    if style != "latex":
        parts.append("\n".join(f"- {note}" for note in (f"Source: {paper['source']}", *NOTES)))
    return "\n\n".join(parts) + "\n"


def _our_rows(
    summary: Summary, splits: Sequence[Mapping[str, str]], suffix: str, metrics: Sequence[str]
) -> list[list[str]]:
    """One row for each method that has the metrics at all."""
    figures = {(row.method, row.scene): row.figures for row in summary.rows}
    dumps = [split["dump"] for split in splits]
    body = []
    for method in dict.fromkeys(row.method for row in summary.rows if metrics[0] in row.figures):
        known = [figures.get((method, dump), {}) for dump in dumps]
        cells = [_join([one.get(metric) for metric in metrics]) for one in known]
        others = [figures[method, scene] for scene in summary.scenes if scene not in dumps]
        means = [_mean([one.get(metric) for one in others]) for metric in metrics]
        body.append([method + suffix, *cells, _join(means)])
    return body


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _join(values: Sequence[float | None]) -> str:
    if all(value is None for value in values):
        return NOT_MEASURED
    return " / ".join(MISSING if value is None else f"{value:.2f}" for value in values)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 0 = done, 2 = the file of our figures cannot be read."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.evaluation.paper", description="The paper's tables.")
    parser.add_argument("--json", metavar="FILE", help="figures that the evaluation wrote, to stand beside")
    parser.add_argument("--style", choices=STYLES, default="text")
    options = parser.parse_args(arguments)
    try:
        summary = None if options.json is None else Summary.read(options.json)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(format_paper(summary, options.style), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
