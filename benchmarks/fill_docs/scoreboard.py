"""Put the scoreboard into its page, README, model card and figures: ``python -m benchmarks.fill_docs.scoreboard FILE``.

The whole of it stands once, in ``docs/reference/scoreboard.md``; README and model card get six rows of it, the README a
plot of eight. ``FILE`` comes from ``python -m mgca_filter.evaluation BUNDLES --json docs/scoreboard.json``. Figures
need matplotlib; those that the file holds the curves for are written to ``docs/figures``, and what the filter, its best
baseline and plain RANSAC keep of the example pair: right matches green, wrong ones red. The model card also gets the
figures by scene and by difficulty, beside those of the strongest baselines.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from mgca_filter.evaluation.environment import BUSY_LOAD
from mgca_filter.evaluation.figures import draw_figures, draw_pairs
from mgca_filter.evaluation.pairs import ALL_PAIRS, ALL_SCENES, select_pairs
from mgca_filter.evaluation.registry import BASELINE_ROWS, parse_method
from mgca_filter.evaluation.summary import Summary, best_baseline
from mgca_filter.tables import render_table

from . import readme_plot
from .pages import fill_file

ROOT = Path(__file__).resolve().parents[2]
README, MODEL_CARD, PAGE = "README.md", "mgca_filter/models/mgca_small.md", "docs/reference/scoreboard.md"
FIGURES = "docs/figures"
EXAMPLE = "examples/images/courtyard.txt"
COLUMNS = ("mAP@5", "mAP@20", "AUC@5", "AUC@10", "AUC@20", "P", "R", "F", "median_ms")
LABELS = {
    "product": "**mgca_filter**, default options",
    "product poselib": '**mgca_filter**, `method="poselib"`',
    "product bare": "**mgca_filter**, points only (no ratio, size, angle)",
    "network E": "network E, no RANSAC",
    "network RANSAC": "network + RANSAC 1e-3 (the papers' protocol)",
    "mutual + ratio 0.9 + network order + PROSAC 0.5 px": "mutual + ratio 0.9, sorted by our scores, PROSAC 0.5 px",
    "mutual + ratio 0.9 + network order + PoseLib progressive 0.75 px": "the same with PoseLib progressive 0.75 px",
}
NOT_OPENCV = ("PoseLib", "DEGENSAC")


def table(summary: Summary, scene: str, columns: Sequence[str]) -> str:
    """The rows of ``scene`` in their order."""
    body = [
        [LABELS.get(row.method, row.method), *(f"{row.figures[column]:.1f}" for column in columns)]
        for row in summary.rows_of(scene)
    ]
    return render_table(["", *(column.replace("median_ms", "ms") for column in columns)], body)


def scoreboard(summary: Summary) -> str:
    """Both tables with what has to be known to read them.

    Raises:
        ValueError: the summary has no times, or no row of raw matches.
    """
    timing, settings, over_pairs = summary.timing, summary.context.settings, summary.rows_of(ALL_PAIRS)
    raw = [row for row in over_pairs if row.method.startswith("NN +")]
    if timing is None or not raw:
        raise ValueError("the pages show times, and the share of right matches from a row of raw matches")
    caution = " The machine was busy with other work: times are rough." if timing.others_load > BUSY_LOAD else ""
    seeds, timed = settings["seeds"], summary.timed_pairs
    averaged = f"averaged over {seeds} seeds" if seeds > 1 else "run once"
    command = f"python -m mgca_filter.evaluation BUNDLES --seeds {seeds} --times {timed // len(summary.scenes)}"
    matched = ""
    if summary.context.time_matched:
        matched = " Rows with a number of iterations got as much time as the filter, as far as they would take it."
        command += " --time-matched product"
    opencv = summary.context.versions.get("opencv-contrib-python-headless", "?")
    parts = [
        f"Validation: all {raw[0].pairs} pairs of {len(summary.scenes)} scenes that training never saw; "
        f"{raw[0].kept.P:.0f} % of a pair's raw SIFT matches lie near the true epipolar line. Mean over scenes, per "
        "cent; a pair without a pose counts as "
        f"180°. Estimators that take a seed are {averaged}. P, R, F: the decision before the robust fit (ours: logit "
        f"> 0), over all raw matches. ms: median over {timed} pairs, all rows in turn on each, one "
        f"thread. Baselines run at the threshold that suits each best.{matched}",
        table(summary, ALL_SCENES, COLUMNS),
        "Mean over pairs:",
        table(summary, ALL_PAIRS, COLUMNS[:5]),
        f"OpenCV {opencv}, {summary.context.machine.get('processor', 'CPU')}.{caution} "
        f"Command: `{command}`; figures with bootstrap intervals, by scene: "
        "`docs/scoreboard.json`; curves and a picture: `docs/figures`; protocol and formats: `docs/evaluation.md`.",
    ]
    return "\n\n".join(parts)


def difficulty(summary: Summary) -> str:
    """The filter by scene and difficulty of the pairs, beside the best row of OpenCV's and the best of all others."""
    opencv_rows = [row for row in summary.rows if not any(name in row.method for name in NOT_OPENCV)]
    baselines = dict.fromkeys(best_baseline(rows, "product") for rows in (opencv_rows, summary.rows))

    def cells(name: str, pairs: int, figures: Mapping[str, Mapping[str, float]]) -> list[str]:
        ours = figures["product"]
        values = [ours["mAP@5"], ours["mAP@20"], *(figures[baseline]["mAP@20"] for baseline in baselines)]
        return [name, str(pairs), *(f"{value:.1f}" for value in values)]

    body = []
    for scene in summary.scenes:
        rows = summary.rows_of(scene)
        body.append(cells(f"scene `{scene}`", rows[0].pairs, {row.method: row.pose for row in rows}))
    for entry in summary.difficulty:
        body += [cells(f"{entry.property} {group.group}", group.pairs, group.methods) for group in entry.groups]
    return render_table(["", "pairs", "mAP@5", "mAP@20", *(f"mAP@20, {name}" for name in baselines)], body)


def main(arguments: Sequence[str] | None = None) -> None:
    """Rewrite the sections between the markers, and the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scoreboard", type=Path)
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout to write to (default: this one)")
    options = parser.parse_args(arguments)
    try:
        summary = Summary.read(options.scoreboard)
        board = scoreboard(summary)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
    results = {"results": readme_plot.results_table(summary)}
    fill_file(options.root / README, results)
    fill_file(options.root / PAGE, {"scoreboard": board})
    fill_file(options.root / MODEL_CARD, {**results, "difficulty": difficulty(summary)})
    print(readme_plot.draw(summary, options.root / readme_plot.PLOT))
    pictured = dict.fromkeys([BASELINE_ROWS[0], best_baseline(summary.rows, "product"), "product"])
    rows = [parse_method(name) for name in pictured]
    example = select_pairs(ROOT / EXAMPLE, data_format="pairs")
    for figure in (
        *draw_figures(summary, options.root / FIGURES),
        *draw_pairs(rows, example, options.root / FIGURES, 1),
    ):
        print(figure)


if __name__ == "__main__":
    main()
