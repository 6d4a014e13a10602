"""Put the scoreboard into README, model card and figures: ``python export/write_tables.py docs/scoreboard.json``.

The JSON file comes from ``python -m mgca_filter.evaluation BUNDLES --json docs/scoreboard.json``. Figures need
matplotlib; those that the file holds the curves for are written to ``docs/figures``, and what the filter, its best
rival and plain RANSAC keep of the example pair: right matches green, wrong ones red. The model card also gets the
figures by scene and by difficulty, beside those of the strongest rivals.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pages import fill_file

from mgca_filter.evaluation.environment import BUSY_LOAD
from mgca_filter.evaluation.figures import draw_figures
from mgca_filter.evaluation.pairs import ALL_PAIRS, ALL_SCENES, select_pairs
from mgca_filter.evaluation.qualitative import draw_pairs
from mgca_filter.evaluation.registry import RIVAL_ROWS, parse_method
from mgca_filter.evaluation.report import timed_pairs
from mgca_filter.evaluation.summary import best_rival

ROOT = Path(__file__).resolve().parent.parent
README, MODEL_CARD = "README.md", "mgca_filter/models/mgca_small.md"
FIGURES = "docs/figures"
EXAMPLE = "examples/images/courtyard.txt"
COLUMNS = ("mAP@5", "mAP@20", "AUC@5", "AUC@10", "AUC@20", "P", "R", "F", "median_ms")
LABELS = {
    "product": "**mgca_filter**, default options",
    "product poselib": '**mgca_filter**, `method="poselib"`',
    "product bare": "**mgca_filter**, bare points (no ratio, size, angle)",
    "network E": "the network's own E, no RANSAC",
    "network RANSAC": "network + RANSAC 1e-3 (the papers' protocol)",
    "mutual + ratio 0.9 + network order + PROSAC 0.5 px": "mutual + ratio 0.9, sorted by our scores, PROSAC 0.5 px",
    "mutual + ratio 0.9 + network order + PoseLib progressive 0.75 px": "the same with PoseLib progressive 0.75 px",
}
NOT_OPENCV = ("PoseLib", "DEGENSAC")


def table(rows: list[dict[str, Any]], scene: str, columns: tuple[str, ...]) -> list[str]:
    """Markdown lines of one table: the rows of ``scene`` in their order."""
    lines = ["| | " + " | ".join(columns).replace("median_ms", "ms") + " |", "|---|" + "---:|" * len(columns)]
    for row in rows:
        if row["scene"] == scene:
            figures = " | ".join(f"{row[column]:.1f}" for column in columns)
            lines.append(f"| {LABELS.get(row['method'], row['method'])} | {figures} |")
    return lines


def scoreboard(summary: dict[str, Any]) -> str:
    """Both tables with what has to be known to read them."""
    rows = summary["rows"]
    scenes = sorted({row["scene"] for row in rows} - {"all", "pairs"})
    pairs = next(row["pairs"] for row in rows if row["scene"] == "pairs")
    raw_share = next(row["P"] for row in rows if row["method"].startswith("NN +") and row["scene"] == "pairs")
    versions = summary["versions"]
    timing = summary["timing"]
    caution = " The machine was busy with other work: times are rough." if timing["others_load"] > BUSY_LOAD else ""
    seeds = summary["settings"]["seeds"]
    averaged = f"averaged over {seeds} seeds" if seeds > 1 else "run once"
    command = f"python -m mgca_filter.evaluation BUNDLES --seeds {seeds} --times {timed_pairs(summary) // len(scenes)}"
    matched = ""
    if summary["time_matched"]:
        matched = " Rows with a number of iterations got as much time as the filter, as far as they would take it."
        command += " --time-matched product"
    lines = [
        f"Validation: all {pairs} pairs of {len(scenes)} scenes that training never saw; {raw_share:.0f} % of a pair's "
        "raw SIFT matches lie near the true epipolar line. Mean over scenes, per cent; a pair without a pose counts as "
        f"180°. Estimators that take a seed are {averaged}. P, R, F: the decision before the robust fit (ours: logit "
        f"> 0), over all raw matches. ms: median over {timed_pairs(summary)} pairs, all rows in turn on each, one "
        f"thread. Rivals run at the threshold that suits each best.{matched}",
        "",
        *table(rows, "all", COLUMNS),
        "",
        "Mean over pairs:",
        "",
        *table(rows, "pairs", COLUMNS[:5]),
        "",
        f"OpenCV {versions.get('opencv-contrib-python-headless', '?')}, {summary['machine'].get('processor', 'CPU')}."
        f"{caution} "
        f"Command: `{command}`; figures with bootstrap intervals, by scene: "
        "`docs/scoreboard.json`; curves and a picture: `docs/figures`; protocol and formats: `docs/evaluation.md`.",
    ]
    return "\n".join(lines)


def difficulty(summary: dict[str, Any]) -> str:
    """The filter by scene and difficulty of the pairs, beside the best row of OpenCV's and the best of all rivals."""
    opencv_rows = [row for row in summary["rows"] if not any(name in row["method"] for name in NOT_OPENCV)]
    rivals = dict.fromkeys(best_rival({"rows": rows}, "product") for rows in (opencv_rows, summary["rows"]))
    header = ["", "pairs", "mAP@5", "mAP@20", *(f"mAP@20, {rival}" for rival in rivals)]
    lines = [f"| {' | '.join(header)} |", "|---|" + "---:|" * (len(header) - 1)]

    def add(name: str, pairs: int, figures: dict[str, dict[str, float]]) -> None:
        ours = figures["product"]
        values = [ours["mAP@5"], ours["mAP@20"], *(figures[rival]["mAP@20"] for rival in rivals)]
        lines.append(f"| {name} | {pairs} | " + " | ".join(f"{value:.1f}" for value in values) + " |")

    by_scene: dict[str, dict[str, dict[str, Any]]] = {}
    for row in summary["rows"]:
        by_scene.setdefault(row["scene"], {})[row["method"]] = row
    for scene, figures in by_scene.items():
        if scene not in (ALL_SCENES, ALL_PAIRS):
            add(f"scene `{scene}`", figures["product"]["pairs"], figures)
    for entry in summary["difficulty"]:
        for group in entry["groups"]:
            add(f"{entry['property']} {group['group']}", group["pairs"], group["methods"])
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the sections between the markers, and the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scoreboard", type=Path)
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout to write to (default: this one)")
    options = parser.parse_args(arguments)
    summary = json.loads(options.scoreboard.read_text(encoding="utf-8"))
    places = {"scoreboard": scoreboard(summary)}
    fill_file(options.root / README, places)
    fill_file(options.root / MODEL_CARD, {**places, "difficulty": difficulty(summary)})
    pictured = dict.fromkeys([RIVAL_ROWS[0], best_rival(summary, "product"), "product"])
    rows = [parse_method(name) for name in pictured]
    example = select_pairs(ROOT / EXAMPLE, data_format="pairs")
    for figure in (
        *draw_figures(summary, options.root / FIGURES),
        *draw_pairs(rows, example, options.root / FIGURES, 1),
    ):
        print(figure)


if __name__ == "__main__":
    main()
