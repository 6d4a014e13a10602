"""Training and validation curves as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

TRAINING_CURVES = ("loss", "classification", "geometric", "learning_rate")


def draw_curves(path: Path, training: Sequence[dict[str, str]], validation: Sequence[dict[str, str]]) -> None:
    """Write a PNG of the rows of ``train.csv`` and ``validation.csv``; nothing where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    for axis, name in zip(axes, TRAINING_CURVES):
        rows = [row for row in training if row.get(name)]
        axis.plot([int(row["step"]) for row in rows], [float(row[name]) for row in rows], linewidth=0.8)
        axis.set_title(name.replace("_", " "))
    names = [name for name in (validation[0] if validation else {}) if name != "step"]
    poses = [name for name in names if "@" in name]
    for axis, title, chosen in (
        (axes[4], "matches, per cent", [name for name in names if name not in poses]),
        (axes[5], "poses, per cent", poses),
    ):
        for name in chosen:
            axis.plot([int(r["step"]) for r in validation], [float(r[name]) for r in validation], ".-", label=name)
        axis.set_title(title)
        if chosen:
            axis.legend(fontsize="small")
    for axis in axes:
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
