"""``python -m mgca_filter.training.ablation --data FOLDER --steps N --out FOLDER``: the paper's ablation, and ours.

A row is a training config changed in one thing, or a stage of the paper's build-up. Every row has the same budget,
seeds and data order. A row that was cut off goes on where it stopped; one that is done is not done again.
``ablation.md`` and ``ablation.json`` are written anew after each row.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ..atomic_file import replaced_when_done
from ..data.scene_bundle import ScenePair, load_scene_bundles
from ..errors import MgcaFilterError
from ..network.weights import count_parameters
from ..tables import render_table
from .config import ConfigError, SourceConfig, TrainingConfig, load_config
from .datasets import TrainingDataset
from .loop import WEIGHTS, DivergedError, Trainer
from .sources import open_sources
from .validation import quick_validation, select_pairs

CONFIGS = Path(__file__).parent / "configs"
RESULT = "result.json"
COLUMNS = ("fit_mAP@5", "fit_mAP@20", "fit_AUC@5", "essential_mAP@20", "precision", "recall", "F")


RENDERED_SHARE = 0.25
PRETRAINING_SHARE = 0.25

_ONE_STAGE: Mapping[str, Any] = {"stages": 1, "csmgc": False, "final_consensus": False}
_PLAIN_STAGES: Mapping[str, Any] = {"csmgc": False, "final_consensus": False}


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        name: as the table has it.
        network: changes to the full network.
        rendered: a quarter of the pairs are rendered worlds.
        pretrained: a quarter of the steps are spent on image-free pairs first; the budget stays the same.
    """

    name: str
    network: Mapping[str, Any] = field(default_factory=dict)
    rendered: bool = False
    pretrained: bool = False

    @property
    def slug(self) -> str:
        """The name as a folder's name."""
        return "".join(c if c.isalnum() else "_" for c in self.name)


ROWS = (
    # The paper's table, from the bottom up.
    Row("baseline", {**_ONE_STAGE, "cga": False}),
    Row("CGA", _ONE_STAGE),
    Row("iterations", {**_PLAIN_STAGES, "cga": False}),
    Row("iterations + CGA", _PLAIN_STAGES),
    Row("iterations + CSMGC", {"cga": False}),
    Row("full"),
    # The full network with one thing changed.
    Row("point attention", {"attention": "point"}),
    Row("no positional term", {"positional": False}),
    Row("no pooled branches", {"pooled_branches": False}),
    Row("no squeeze-excitation", {"squeeze_excitation": False}),
    Row("no final consensus", {"final_consensus": False}),
    Row("k = 3", {"neighbours": 3}),
    Row("k = 9", {"neighbours": 9}),
    Row("no side information", {"attributes": False}),
    # Other data.
    Row("rendered worlds", rendered=True),
    Row("synthetic pre-training", pretrained=True),
)


def row_phases(row: Row, base: TrainingConfig, steps: int, seed: int, rendered: str) -> list[TrainingConfig]:
    """The runs of a row, one after the other, each started from the last one's weights.

    Args:
        base: the full network, its data and schedule. steps: budget of the row.
        rendered: path of rendered worlds, from the data folder.
    """
    config = replace(base, name=row.name, seed=seed, network=replace(base.network, **row.network))
    if row.rendered:
        total = sum(source.weight for source in base.sources)
        share = total * RENDERED_SHARE / (1.0 - RENDERED_SHARE)
        config = replace(config, sources=(*base.sources, SourceConfig("bundles", rendered, share)))
    if not row.pretrained:
        return [_with_steps(config, steps)]
    first = max(1, round(PRETRAINING_SHARE * steps))
    synthetic = replace(config, sources=(SourceConfig("synthetic"),), scenes=(), tuning_scenes=(), validation=())
    return [_with_steps(synthetic, first), _with_steps(config, max(1, steps - first))]


def _with_steps(config: TrainingConfig, steps: int) -> TrainingConfig:
    """The same schedule over fewer steps: a short run must not be all warm-up."""
    warmup = min(config.schedule.warmup_steps, steps // 10)
    return replace(config, schedule=replace(config.schedule, steps=steps, warmup_steps=warmup))


@dataclass(frozen=True)
class Ablation:
    """What all rows share."""

    base: TrainingConfig
    data: Path
    out: Path
    steps: int
    seeds: tuple[int, ...]
    rendered: str
    device: str
    workers: int
    pairs: Sequence[ScenePair]

    def run_row(self, row: Row) -> dict[str, Any]:
        """Mean figures of a row over the seeds, and their spread; trains what is not trained yet."""
        results = [self._run(row, seed) for seed in self.seeds]
        figures = {name: [result["figures"][name] for result in results] for name in COLUMNS}
        return {
            "row": row.name,
            "parameters": results[0]["parameters"],
            **{name: float(np.mean(values)) for name, values in figures.items()},
            "spread": {name: float(np.ptp(values)) for name, values in figures.items()},
        }

    def _run(self, row: Row, seed: int) -> dict[str, Any]:
        folder = self.out / row.slug / str(seed)
        phases = row_phases(row, self.base, self.steps, seed, self.rendered)
        identity = json.loads(json.dumps([phase.to_dict() for phase in phases]))
        path = folder / RESULT
        if path.is_file():
            result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if result["config"] != identity or result["validation"] != [pair.name for pair in self.pairs]:
                raise ConfigError(f"{path}: comes from another config or other validation pairs; choose another --out")
            return result
        start, weights, done = time.perf_counter(), None, []
        for number, phase in enumerate(phases):
            source = open_sources(phase, self.data).source
            dataset = TrainingDataset(source, phase.sampling, phase.augmentation, seed, phase.schedule.steps)
            trainer = Trainer(phase, dataset, folder / str(number), None, 1, self.device, self.workers, weights)
            trainer.run()
            weights = folder / str(number) / WEIGHTS
            done.append(trainer)
        result = {
            "config": identity,
            "validation": [pair.name for pair in self.pairs],
            "parameters": count_parameters(done[-1].network),
            "seconds": time.perf_counter() - start,
            "figures": quick_validation(done[-1].average, self.pairs),
        }
        with replaced_when_done(path) as partial:
            partial.write_text(json.dumps(result, indent=1), encoding="utf-8")
        return result

    def write(self, rows: Sequence[dict[str, Any]], command: str) -> None:
        """Table of the rows that are done."""
        budget = {
            "steps": self.steps,
            "samples": self.steps * self.base.sampling.batch_size,
            "seeds": list(self.seeds),
            "validation_pairs": len(self.pairs),
        }
        text = json.dumps({"command": command, "budget": budget, "rows": list(rows)}, indent=1)
        (self.out / "ablation.json").write_text(text, encoding="utf-8")
        several = len(self.seeds) > 1
        cells = [
            [row["row"], f"{row['parameters'] / 1e6:.2f} M"]
            + [f"{row[name]:.1f}" + (f" ± {row['spread'][name] / 2:.1f}" if several else "") for name in COLUMNS]
            for row in rows
        ]
        lines = [
            f"`{command}`",
            "",
            f"{budget['samples']} samples a row ({self.steps} steps of {self.base.sampling.batch_size}), "
            f"seeds {', '.join(map(str, self.seeds))}, {len(self.pairs)} validation pairs; averaged over pairs"
            + (" and seeds, ± half the range." if several else "."),
            "",
            render_table(["row", "parameters", *(name.replace("_", " ") for name in COLUMNS)], cells),
        ]
        (self.out / "ablation.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    names = [row.name for row in ROWS]
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.training.ablation", description="Run the ablation.")
    parser.add_argument(
        "--config", type=Path, default=CONFIGS / "ablation.toml", help="the full network and its schedule"
    )
    parser.add_argument("--data", type=Path, required=True, help="as for training")
    parser.add_argument("--steps", type=int, required=True, help="budget of every row")
    parser.add_argument("--out", type=Path, required=True, help="folder for runs and table; what is done is kept")
    parser.add_argument("--rows", nargs="+", choices=names, default=names, metavar="ROW", help=", ".join(names))
    parser.add_argument("--seeds", nargs="+", type=int, help="train every row with each; the config's own by default")
    parser.add_argument(
        "--rendered", default="", help="bundle of rendered worlds, from the data folder; needed by its row"
    )
    parser.add_argument("--validation", type=Path, help="scene bundles to judge by; the tuning scenes by default")
    parser.add_argument("--per-scene", type=int, default=12, help="validation pairs of each scene")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.steps < 1:
        parser.error("--steps: at least 1")
    return options


def prepare(options: argparse.Namespace) -> tuple[Ablation, list[Row]]:
    """Check config and data of all rows before the first one trains.

    Raises:
        ConfigError: the config does not fit, or a row needs ``--rendered``.
        MgcaFilterError: the data cannot be used.
    """
    base = load_config(options.config)
    opened = open_sources(base, options.data)
    rows = [row for row in ROWS if row.name in options.rows]
    if any(row.rendered for row in rows):
        if not options.rendered:
            raise ConfigError("--rendered: the row 'rendered worlds' needs a bundle of them; or choose --rows")
        load_scene_bundles(options.data / options.rendered)
    bundles = load_scene_bundles(options.validation) if options.validation else opened.tuning
    pairs = select_pairs(bundles, options.per_scene)
    if not pairs:
        raise ConfigError(f"{options.config}: tuning_scenes: none to judge by; name --validation")
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = tuple(options.seeds or [base.seed])
    shared = (options.steps, seeds, options.rendered, options.device, options.workers, pairs)
    return Ablation(base, options.data, options.out, *shared), rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 1 = a row diverged, 2 = config or data cannot be used."""
    options = parse_arguments(arguments)
    command = "python -m mgca_filter.training.ablation " + " ".join(sys.argv[1:] if arguments is None else arguments)
    try:
        ablation, rows = prepare(options)
        done: list[dict[str, Any]] = []
        with tqdm(rows, unit="row") as progress:
            for row in progress:
                progress.set_postfix_str(row.name)
                done.append(ablation.run_row(row))
                ablation.write(done, command)
    except (ConfigError, MgcaFilterError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except DivergedError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
