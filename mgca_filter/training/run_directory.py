"""What a run leaves in its directory besides weights: config, origin, curves as CSV, TensorBoard and PNG."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from ..evaluation.environment import library_versions, machine_description, source_commit
from ..tables import render_table
from .config import TrainingConfig

LOG, VALIDATION, TABLE = "train.csv", "validation.csv", "validation.md"
TRAINING_CURVES = ("loss", "classification", "geometric", "learning_rate")


class RunDirectory:
    """The files of a run that tell how it went.

    ``config.json``; ``origin.json``: commit, versions, machine and command of every start; ``train.csv``,
    ``validation.csv`` and ``validation.md``; ``curves.png`` where matplotlib and ``tensorboard/`` where TensorBoard is
    installed.

    Args:
        folder: made if it is not there.
        config: the run.
        step: steps done; rows of a killed run beyond them are forgotten.
    """

    def __init__(self, folder: Path, config: TrainingConfig, step: int) -> None:
        self.folder = folder
        for name in (LOG, VALIDATION):
            _drop_rows_after(folder / name, step)
        (folder / "config.json").write_text(json.dumps(config.to_dict(), indent=2), encoding="utf-8")
        self._add_origin(step)
        self._tensorboard = _open_tensorboard(folder / "tensorboard", step)

    def log(self, step: int, figures: dict[str, float]) -> None:
        """Add a row of training figures."""
        self._append(LOG, "train", step, figures)

    def add_validation(self, step: int, figures: dict[str, float]) -> None:
        """Add a row of validation figures, and draw table and curves anew."""
        self._append(VALIDATION, "validation", step, figures)
        rows = read_rows(self.folder / VALIDATION)
        cells = [[row["step"], *(f"{float(v):.1f}" for k, v in row.items() if k != "step")] for row in rows]
        table = render_table(list(rows[0]), cells, align="r")
        (self.folder / TABLE).write_text(table + "\n", encoding="utf-8")
        draw_curves(self.folder / "curves.png", read_rows(self.folder / LOG), rows)

    def close(self) -> None:
        """Let TensorBoard's writer go."""
        if self._tensorboard is not None:
            self._tensorboard.close()

    def _append(self, name: str, group: str, step: int, figures: dict[str, float]) -> None:
        path = self.folder / name
        new = not path.is_file()
        row: dict[str, Any] = {"step": step, **figures}
        with open(path, "a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)
        if self._tensorboard is not None:
            for key, value in figures.items():
                self._tensorboard.add_scalar(f"{group}/{key}", value, step)
            self._tensorboard.flush()

    def _add_origin(self, step: int) -> None:
        path = self.folder / "origin.json"
        starts = json.loads(path.read_text(encoding="utf-8")) if path.is_file() and step else []
        origin = {
            "from_step": step,
            "commit": source_commit(),
            "command": sys.argv,
            "packages": {**library_versions(), "torch": torch.__version__},
            "machine": machine_description(),
        }
        path.write_text(json.dumps([*starts, origin], indent=2), encoding="utf-8")


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file with a header; none where the file is not there."""
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _open_tensorboard(folder: Path, step: int) -> Any:
    """A writer that forgets what was written beyond ``step``, or None without TensorBoard."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=step + 1)


def _drop_rows_after(path: Path, step: int) -> None:
    """Forget what a killed run logged beyond its last checkpoint, and a last row that it left unfinished."""
    if not path.is_file():
        return
    header, *rows = path.read_text(encoding="utf-8").splitlines() or [""]
    if step == 0 or not header:
        path.unlink()
        return
    whole = [row for row in rows if row.count(",") == header.count(",")]
    kept = [row for row in whole if int(row.split(",", 1)[0]) <= step]
    path.write_text("\n".join([header, *kept]) + "\n", encoding="utf-8")


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
