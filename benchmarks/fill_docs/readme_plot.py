"""The README's plot and table of results: a few rows of the scoreboard that stand for all.

``python -m benchmarks.fill_docs.readme_plot docs/scoreboard.json`` draws the plot alone; ``fill_docs.scoreboard`` calls
what is here for the whole.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mgca_filter.evaluation.pairs import ALL_PAIRS, ALL_SCENES
from mgca_filter.evaluation.summary import Summary, SummaryRow
from mgca_filter.tables import render_table

ROOT = Path(__file__).resolve().parents[2]
PLOT = "docs/figures/readme.png"
COLUMNS = {"mAP@5": "mAP@5", "AUC@5": "AUC@5", "AUC@20": "AUC@20", "ms": "median_ms"}
OURS = {"product": "mgca_filter", "product poselib": "mgca_filter with PoseLib"}
# Where a label may stand beside its point: shift in points, and alignment.
_PLACES = (
    ((0, 8), "center", "bottom"),
    ((0, -9), "center", "top"),
    ((9, 0), "left", "center"),
    ((-9, 0), "right", "center"),
)
# What each label stands for: the best row of those that the test lets through.
_KINDS: dict[str, Callable[[str], bool]] = {
    "RANSAC on all matches": lambda name: name.startswith("NN + RANSAC"),
    "MAGSAC on all matches": lambda name: name.startswith("NN + MAGSAC"),
    "ratio test + RANSAC": lambda name: name.startswith("ratio") and "RANSAC" in name,
    "mutual + ratio test + MAGSAC": lambda name: name.startswith("mutual + ratio") and "MAGSAC" in name,
    "mutual + ratio test + PROSAC": lambda name: name.startswith("mutual + ratio") and "PROSAC" in name,
    "mutual + ratio test + PoseLib": lambda name: name.startswith("mutual + ratio") and "PoseLib" in name,
}
TABLE = (
    *("RANSAC on all matches", "ratio test + RANSAC", "mutual + ratio test + MAGSAC"),
    *("mutual + ratio test + PROSAC", "mutual + ratio test + PoseLib", "mgca_filter"),
)


def chosen_rows(summary: Summary) -> dict[str, SummaryRow]:
    """Eight rows by label, means over scenes: the best of each kind of baseline, and ours.

    Rows on the network's order and rows with a number of iterations of their own are no baselines of their kind.
    """
    rows = summary.rows_of(ALL_SCENES)
    chosen = {}
    for label, is_kind in _KINDS.items():
        plain = [row for row in rows if "network" not in row.method and "iterations" not in row.method]
        kind = [row for row in plain if is_kind(row.method)]
        if kind:
            chosen[label] = max(kind, key=lambda row: row.figures["mAP@20"])
    return chosen | {label: row for row in rows for name, label in OURS.items() if row.method == name}


def results_table(summary: Summary) -> str:
    """Six rows and four columns, with what has to be known to read them."""
    chosen = chosen_rows(summary)
    body = []
    for label in (label for label in TABLE if label in chosen):
        row = chosen[label]
        name = "**mgca_filter**, default options" if label == "mgca_filter" else f"{label}: `{row.method}`"
        *figures, ms = (row.figures[column] for column in COLUMNS.values())
        body.append([name, *(f"{figure:.1f}" for figure in figures), f"{ms:.0f}"])
    scenes = len(summary.scenes)
    pairs = max((row.pairs for row in summary.rows_of(ALL_PAIRS)), default=0)
    return render_table(["", *COLUMNS], body) + (
        f"\n\n{pairs} pairs of {scenes} scenes that training never saw, means over scenes, per cent; a pair without a "
        "pose counts as 180° off. Each baseline is the best of its kind, at the threshold that suits it best."
    )


def draw(summary: Summary, path: Path) -> Path:
    """Time against accuracy, eight labelled points; returns the file."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 4.5), dpi=110, layout="constrained")
    chosen = chosen_rows(summary)
    for label, row in chosen.items():
        ours = label in OURS.values()
        place = row.figures["median_ms"], row.figures["AUC@20"]
        axes.scatter(*place, s=70, color="#0072b2" if ours else "#8c8c8c", marker="o" if ours else "s", zorder=3)
    axes.set_xscale("log")
    axes.set_xlabel("milliseconds a pair, one thread")
    axes.set_ylabel("AUC@20 of the pose error, per cent")
    axes.grid(alpha=0.3, which="both")
    axes.margins(x=0.22, y=0.14)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:g}"[0] in "25" else "")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    _label(axes, {label: (row.figures["median_ms"], row.figures["AUC@20"]) for label, row in chosen.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)
    return path


def _label(axes: Any, points: Mapping[str, tuple[float, float]]) -> None:
    """Write each label where it covers the fewest others and the fewest points, ours first."""
    figure = axes.figure
    figure.canvas.draw()
    pixels = {label: axes.transData.transform(point) for label, point in points.items()}
    taken: list[Any] = []
    for label in sorted(points, key=lambda label: label not in OURS.values()):
        weight = "bold" if label in OURS.values() else "normal"
        tried: list[tuple[Any, int, Any, Any]] = []
        for shift, ha, va in _PLACES:
            text = axes.annotate(
                label, points[label], shift, textcoords="offset points", ha=ha, va=va, fontsize=9, fontweight=weight
            )
            box = text.get_window_extent()
            inside = axes.get_window_extent().expanded(1.0, 1.0)
            outside = not (inside.contains(*box.min) and inside.contains(*box.max))
            covered = sum(box.overlaps(other) for other in taken) + sum(box.contains(*p) for p in pixels.values())
            tried.append((covered + outside, len(tried), text, box))
        best = min(tried, key=lambda entry: entry[:2])
        taken.append(best[3])
        for entry in tried:
            if entry is not best:
                entry[2].remove()


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scoreboard", type=Path)
    parser.add_argument("--out", type=Path, default=ROOT / PLOT)
    options = parser.parse_args(arguments)
    print(draw(Summary.read(options.scoreboard), options.out))


if __name__ == "__main__":
    main()
