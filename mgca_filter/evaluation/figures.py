"""Pictures from the summary alone: recall over error, precision over recall, reliability, time against accuracy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .pairs import ALL_SCENES
from .summary import is_ours

MAX_RIVALS = 6
"""Rivals in the picture of recall: the best by mAP@20, beside all rows of ours."""

_GREY = "#8a8f98"
_LEGEND_ROW_INCHES = 0.17
_STYLE: dict[Any, Any] = {
    "figure.figsize": (6.4, 4.2),
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e5e8",
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "svg.hashsalt": "mgca_filter",  # the same figures give the same file
    "svg.fonttype": "none",
}


def draw_figures(summary: Mapping[str, Any], folder: str | Path, prefix: str = "") -> list[Path]:
    """Write every picture that the summary has the figures for, as SVG; returns the files.

    Args:
        summary: what :func:`summary.summarize` returned, or the JSON that it was written to.
        folder: made where it is not there.
        prefix: of the file names ``recall``, ``precision_recall``, ``reliability``, ``time_accuracy``.

    Raises:
        ImportError: matplotlib is not installed.
    """
    import matplotlib
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    curves = summary.get("curves", {})
    wanted: dict[str, tuple[Callable[[Any, Mapping[str, Any]], None], bool]] = {
        "recall": (draw_recall, "recall" in curves),
        "precision_recall": (draw_precision_recall, bool(curves.get("precision_recall", {}).get("methods"))),
        "reliability": (draw_reliability, bool(curves.get("reliability"))),
        "time_accuracy": (draw_time_accuracy, any("median_ms" in row for row in _headline(summary))),
    }
    files = []
    with matplotlib.rc_context(_STYLE):
        for name, (draw, possible) in wanted.items():
            if not possible:
                continue
            figure = Figure(layout="constrained")
            draw(figure.add_subplot(), summary)
            files.append(folder / f"{prefix}{name}.svg")
            figure.savefig(files[-1], metadata={"Date": None})
    return files


def draw_recall(axes: Any, summary: Mapping[str, Any]) -> None:
    """Share of pairs below each pose error, mean over scenes; ours solid, rivals dashed."""
    from matplotlib import colormaps

    curves = summary["curves"]["recall"]
    axes.set_prop_cycle(color=[colormaps["tab20"](i) for i in range(20)])  # more lines than the usual ten colours
    for name in _shown(summary):
        style = {"linestyle": "-", "linewidth": 1.8} if is_ours(name) else {"linestyle": "--", "linewidth": 1.1}
        shares = [100.0 * share for share in curves["methods"][name]]
        axes.plot(curves["error_deg"], shares, label=name, **style)
    axes.set(xlabel="pose error, degrees", ylabel="pairs below it, % (mean over scenes)", xlim=(0, 20), ylim=(0, 100))
    axes.legend(loc="lower right")


def draw_precision_recall(axes: Any, summary: Mapping[str, Any]) -> None:
    """Precision over recall as the threshold on the logit moves; a dot where it is 0."""
    curves = summary["curves"]["precision_recall"]
    zero = curves["logit"].index(0.0)
    for name, curve in _different(curves["methods"]).items():
        known = [(r, p) for r, p in zip(curve["recall"], curve["precision"]) if r is not None and p is not None]
        (line,) = axes.plot(*zip(*known), label=name, linewidth=1.5) if known else (None,)
        recall, precision = curve["recall"][zero], curve["precision"][zero]
        if line is not None and recall is not None and precision is not None:
            axes.plot(recall, precision, "o", color=line.get_color(), markersize=5)
    axes.set(xlabel="recall (matches of a scene together, mean over scenes)", ylabel="precision")
    axes.set(xlim=(0, 1.01), ylim=(0, 1.01))
    axes.legend(loc="lower left")


def draw_reliability(axes: Any, summary: Mapping[str, Any]) -> None:
    """Share of true matches over the probability that was promised; the diagonal is what it should be."""
    axes.plot([0, 1], [0, 1], color=_GREY, linewidth=1.0, linestyle=":")
    for name, table in _different(summary["curves"]["reliability"]).items():
        bins = table["bins"]
        label = f"{name} (calibration error {100 * table['error']:.1f} %)"
        axes.plot(
            [one["probability"] for one in bins], [one["share_right"] for one in bins], "o-", markersize=4, label=label
        )
    axes.set(xlabel="probability given", ylabel="share of true matches", xlim=(0, 1), ylim=(0, 1))
    axes.legend(loc="upper left")


def draw_time_accuracy(axes: Any, summary: Mapping[str, Any]) -> None:
    """mAP@20 over the median time of each row, both means over scenes; numbers refer to the legend."""
    timed = [row for row in _headline(summary) if "median_ms" in row]
    rows = sorted(timed, key=lambda row: -float(row["mAP@20"]))
    for number, row in enumerate(rows, 1):
        ours = is_ours(row["method"])
        colour = "#1b7f4b" if ours else _GREY
        label = f"{number}  {row['method']}"
        axes.plot(row["median_ms"], row["mAP@20"], "s" if ours else "o", color=colour, markersize=5, label=label)
        axes.annotate(str(number), (row["median_ms"], row["mAP@20"]), (4, 3), textcoords="offset points", fontsize=7)
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(xscale="log", xlabel="median time per pair, ms", ylabel="mAP@20, % (mean over scenes)")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handletextpad=0.2)
    axes.figure.set_size_inches(9.0, max(4.8, 0.8 + _LEGEND_ROW_INCHES * len(rows)))


def _different(methods: Mapping[str, Any]) -> dict[str, Any]:
    """Methods without those whose curve another has drawn: rows that share the network's scores."""
    drawn: dict[str, Any] = {}
    for name, curve in methods.items():
        if curve not in drawn.values():
            drawn[name] = curve
    return drawn


def _headline(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [row for row in summary["rows"] if row["scene"] == ALL_SCENES]


def _shown(summary: Mapping[str, Any]) -> Sequence[str]:
    """All rows of ours and the best rivals, best first."""
    ranked = [row["method"] for row in sorted(_headline(summary), key=lambda row: -float(row["mAP@20"]))]
    rivals = [name for name in ranked if not is_ours(name)][:MAX_RIVALS]
    return [name for name in ranked if is_ours(name) or name in rivals]
