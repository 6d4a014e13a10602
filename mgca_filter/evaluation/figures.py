"""Pictures: curves from the summary alone, and what methods keep of pairs that have images.

Curves are recall over error, precision over recall, reliability, and time against accuracy. On pairs right matches are
green, wrong ones red, one strip for each method.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from ..data.scene_bundle import ScenePair
from ..data.source import Image
from ..drawing import MatchPanel, draw_matches
from ..errors import DatasetError
from ..geometry.epipolar import pose_error_deg
from .methods import Method
from .metrics import FAILURE_DEG, true_matches
from .pairs import ALL_SCENES, SceneSelection
from .predict import answer_pair
from .summary import Curves, Summary, SummaryRow, is_ours

Curve = TypeVar("Curve")

MAX_BASELINES = 6
"""Baselines in the picture of recall: the best by mAP@20, beside all rows of ours."""

JPEG_QUALITY = 85
SOLVED_DEG = 5.0
"""Pose error below which a strip's mark is green."""

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


def draw_figures(summary: Summary, folder: str | Path, prefix: str = "") -> list[Path]:
    """Write every picture that the summary has the figures for, as SVG; returns the files.

    Args:
        summary: what :func:`summarize.summarize` returned, or what was read from its file.
        folder: made where it is not there.
        prefix: of the file names ``recall``, ``precision_recall``, ``reliability``, ``time_accuracy``.

    Raises:
        ImportError: matplotlib is not installed.
    """
    import matplotlib
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    wanted: dict[str, Callable[[Any], None]] = {}
    if summary.curves is not None:
        wanted["recall"] = partial(draw_recall, curves=summary.curves, shown=_shown(summary))
        if summary.curves.precision_recall.methods:
            wanted["precision_recall"] = partial(draw_precision_recall, curves=summary.curves)
        if summary.curves.reliability:
            wanted["reliability"] = partial(draw_reliability, curves=summary.curves)
    if any(row.median_ms is not None for row in summary.rows_of(ALL_SCENES)):
        wanted["time_accuracy"] = partial(draw_time_accuracy, summary=summary)
    files = []
    with matplotlib.rc_context(_STYLE):
        for name, draw in wanted.items():
            figure = Figure(layout="constrained")
            draw(figure.add_subplot())
            files.append(folder / f"{prefix}{name}.svg")
            figure.savefig(files[-1], metadata={"Date": None})
    return files


def draw_recall(axes: Any, curves: Curves, shown: Sequence[str]) -> None:
    """Share of pairs below each pose error, mean over scenes, of those ``shown``; ours solid, baselines dashed."""
    from matplotlib import colormaps

    axes.set_prop_cycle(color=[colormaps["tab20"](i) for i in range(20)])  # more lines than the usual ten colours
    for name in shown:
        style = {"linestyle": "-", "linewidth": 1.8} if is_ours(name) else {"linestyle": "--", "linewidth": 1.1}
        shares = [100.0 * share for share in curves.recall.methods[name]]
        axes.plot(curves.recall.error_deg, shares, label=name, **style)
    axes.set(xlabel="pose error, degrees", ylabel="pairs below it, % (mean over scenes)", xlim=(0, 20), ylim=(0, 100))
    axes.legend(loc="lower right")


def draw_precision_recall(axes: Any, curves: Curves) -> None:
    """Precision over recall as the threshold on the logit moves; a dot where it is 0."""
    zero = curves.precision_recall.logit.index(0.0)
    for name, curve in _different(curves.precision_recall.methods).items():
        known = [(r, p) for r, p in zip(curve.recall, curve.precision) if r is not None and p is not None]
        (line,) = axes.plot(*zip(*known), label=name, linewidth=1.5) if known else (None,)
        recall, precision = curve.recall[zero], curve.precision[zero]
        if line is not None and recall is not None and precision is not None:
            axes.plot(recall, precision, "o", color=line.get_color(), markersize=5)
    axes.set(xlabel="recall (matches of a scene together, mean over scenes)", ylabel="precision")
    axes.set(xlim=(0, 1.01), ylim=(0, 1.01))
    axes.legend(loc="lower left")


def draw_reliability(axes: Any, curves: Curves) -> None:
    """Share of true matches over the probability that was promised; the diagonal is what it should be."""
    axes.plot([0, 1], [0, 1], color=_GREY, linewidth=1.0, linestyle=":")
    for name, table in _different(curves.reliability).items():
        label = f"{name} (calibration error {100 * table.error:.1f} %)"
        given, right = [one.probability for one in table.bins], [one.share_right for one in table.bins]
        axes.plot(given, right, "o-", markersize=4, label=label)
    axes.set(xlabel="probability given", ylabel="share of true matches", xlim=(0, 1), ylim=(0, 1))
    axes.legend(loc="upper left")


def draw_time_accuracy(axes: Any, summary: Summary) -> None:
    """mAP@20 over the median time of each row, both means over scenes; numbers refer to the legend."""
    rows = [row for row in _ranked(summary) if row.median_ms is not None]
    for number, row in enumerate(rows, 1):
        ours, place = is_ours(row.method), (row.median_ms, row.pose["mAP@20"])
        colour = "#1b7f4b" if ours else _GREY
        label = f"{number}  {row.method}"
        axes.plot(*place, "s" if ours else "o", color=colour, markersize=5, label=label)
        axes.annotate(str(number), place, (4, 3), textcoords="offset points", fontsize=7)
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(xscale="log", xlabel="median time per pair, ms", ylabel="mAP@20, % (mean over scenes)")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handletextpad=0.2)
    axes.figure.set_size_inches(9.0, max(4.8, 0.8 + _LEGEND_ROW_INCHES * len(rows)))


def _different(methods: Mapping[str, Curve]) -> dict[str, Curve]:
    """Methods without those whose curve another has drawn: rows that share the network's scores."""
    drawn: dict[str, Curve] = {}
    for name, curve in methods.items():
        if curve not in drawn.values():
            drawn[name] = curve
    return drawn


def _ranked(summary: Summary) -> list[SummaryRow]:
    """Means over scenes, best mAP@20 first."""
    return sorted(summary.rows_of(ALL_SCENES), key=lambda row: -row.pose["mAP@20"])


def _shown(summary: Summary) -> list[str]:
    """All rows of ours and the best baselines, best first."""
    ranked = [row.method for row in _ranked(summary)]
    baselines = [name for name in ranked if not is_ours(name)][:MAX_BASELINES]
    return [name for name in ranked if is_ours(name) or name in baselines]


def draw_pairs(
    methods: Sequence[Method], selections: Sequence[SceneSelection], folder: str | Path, per_scene: int
) -> list[Path]:
    """Write ``SCENE_INDEX.jpg`` for ``per_scene`` pairs of each scene that has images; returns the files.

    Pairs lie evenly over a scene's selection. Drawn are the matches of each method's final mask.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for selection in selections:
        places = np.unique(np.linspace(0, len(selection) - 1, per_scene + 2)[1:-1].round().astype(int))
        for index in (selection.indices[place] for place in places):
            try:
                pair = selection.source[index]
                images = selection.source.images(pair)
            except DatasetError:
                continue  # listed with the figures
            if images is None:
                continue
            files.append(folder / f"{pair.scene}_{index}.jpg")
            picture = np.vstack([_strip(method, pair, images) for method in methods])
            cv2.imwrite(str(files[-1]), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return files


def _strip(method: Method, pair: ScenePair, images: tuple[Image, Image]) -> Image:
    answer = answer_pair(method, pair, 0)
    mask, error_deg = answer.mask, FAILURE_DEG
    if answer.R is not None and answer.t is not None:
        error_deg = pose_error_deg(answer.R, answer.t, pair.R, pair.t)
    right = true_matches(pair.correspondences, pair.E)[mask]
    facts = [f"{np.count_nonzero(right)} right", f"{np.count_nonzero(~right)} wrong", f"pose error {error_deg:.1f} deg"]
    panel = MatchPanel(right, method.name, facts, success=error_deg < SOLVED_DEG, words=("right", "wrong"))
    return draw_matches(*images, pair.points1[mask], pair.points2[mask], panel)
