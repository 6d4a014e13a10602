"""``python -m mgca_filter.training.report WEIGHTS BUNDLES --out FOLDER``: what a network does with each kind of input.

Kinds of input: raw, ratio 0.75, cross-check, bare points. Scenes: unknown ones (BUNDLES), and held-out pairs of scenes
that training saw (``--known``): the gap between the two says whether data or model is the limit. Besides, precision,
recall and F against the logit threshold.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ..data.scene_bundle import SceneBundle, ScenePair, load_scene_bundles
from ..errors import BundleError, MgcaFilterError
from ..inference.network_backend import NetworkBackend
from ..match_filter import MatchFilter
from ..network import load_network
from ..tables import render_table
from .sampling import SamplingConfig
from .validation import INPUT_KINDS, PairFigures, evaluate_pair, held_out_pairs, select_pairs, summarize

THRESHOLDS = np.arange(-4.0, 4.01, 0.5)
Summary = dict[str, dict[str, dict[str, Any]]]  # scenes → kind of input → figures by name
Figures = dict[str, dict[str, list[PairFigures]]]  # scenes → kind of input → pairs


def evaluate(match_filter: MatchFilter, groups: Mapping[str, Sequence[ScenePair]]) -> Figures:
    """Figures of every group of pairs with every kind of input."""
    return {
        group: {
            kind: [evaluate_pair(match_filter, pair, choose(pair)) for pair in tqdm(pairs, desc=f"{group}, {kind}")]
            for kind, choose in INPUT_KINDS.items()
        }
        for group, pairs in groups.items()
    }


def threshold_study(pairs: Sequence[PairFigures]) -> list[dict[str, float]]:
    """Mean precision, recall and F (per cent) at each logit threshold."""
    rows = []
    for threshold in THRESHOLDS:
        values = 100.0 * np.mean([pair.at(float(threshold)) for pair in pairs], axis=0)
        rows.append({"logit": float(threshold), **dict(zip(("precision", "recall", "F"), map(float, values)))})
    return rows


def summarize_all(figures: Figures) -> Summary:
    """By scenes and kind of input: number of pairs and of matches, figures, threshold study."""
    return {
        group: {
            kind: {
                "pairs": len(pairs),
                "matches": float(np.mean([len(pair.truth) for pair in pairs])),
                **summarize(pairs),
                "thresholds": threshold_study(pairs),
            }
            for kind, pairs in kinds.items()
        }
        for group, kinds in figures.items()
    }


def write_markdown(summary: Summary, path: Path, command: str) -> None:
    """Both tables, and the command that made them."""
    names = [name for name in next(iter(next(iter(summary.values())).values())) if name != "thresholds"]
    figures = [
        [group, kind, *(f"{values[name]:.{0 if name in ('pairs', 'matches') else 1}f}" for name in names)]
        for group, kinds in summary.items()
        for kind, values in kinds.items()
    ]
    columns = [(group, kind) for group, kinds in summary.items() for kind in kinds]
    studies = [
        [f"{threshold:+.1f}"]
        + [
            "{precision:.1f} / {recall:.1f} / {F:.1f}".format(**summary[group][kind]["thresholds"][row])
            for group, kind in columns
        ]
        for row, threshold in enumerate(THRESHOLDS)
    ]
    lines = [
        f"`{command}`",
        "",
        render_table(["scenes", "input", *names], figures, align="llr"),
        "",
        "Precision / recall / F against the logit threshold:",
        "",
        render_table(["logit >", *(", ".join(column) for column in columns)], studies, align="r"),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def draw_thresholds(summary: Summary, path: Path) -> None:
    """Precision, recall and F against the threshold, one picture for each kind of input.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.4), layout="constrained")
    axes = figure.subplots(1, len(INPUT_KINDS), sharey=True)
    for axis, kind in zip(axes, INPUT_KINDS):
        for (group, kinds), style in zip(summary.items(), ("-", ":")):
            study = kinds[kind]["thresholds"]
            for name, colour in (("precision", "C0"), ("recall", "C1"), ("F", "C2")):
                axis.plot(THRESHOLDS, [row[name] for row in study], style, color=colour, label=f"{name}, {group}")
        axis.set_title(kind)
        axis.set_xlabel("logit threshold")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("per cent")
    axes[0].legend(fontsize="x-small")
    figure.savefig(path, dpi=110)


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.training.report", description="Report on weights.")
    parser.add_argument("weights", type=Path, help="weights.safetensors of a run")
    parser.add_argument("bundles", type=Path, help="scene bundles that the run did not train on")
    parser.add_argument("--scenes", nargs="*", help="only these of them, such as a run's tuning scenes")
    parser.add_argument("--known", type=Path, help="scene bundles of the run, of which held-out pairs are taken")
    parser.add_argument("--known-scenes", nargs="*", help="only these of them")
    parser.add_argument("--holdout-every", type=int, default=SamplingConfig().holdout_every, help="as in the config")
    parser.add_argument("--per-scene", type=int, default=24, help="pairs of each scene")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, required=True, help="folder for report.md, report.json, thresholds.png")
    return parser.parse_args(arguments)


def _bundles(folder: Path, scenes: Sequence[str] | None) -> list[SceneBundle]:
    """Bundles of a folder, or those of the scenes named.

    Raises:
        BundleError: a scene is not there.
    """
    bundles = load_scene_bundles(folder)
    missing = sorted(set(scenes or ()) - {bundle.scene for bundle in bundles})
    if missing:
        raise BundleError(f"{folder}: no scene bundle named {', '.join(missing)}")
    return [bundle for bundle in bundles if not scenes or bundle.scene in scenes]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = weights or bundles cannot be used."""
    options = parse_arguments(arguments)
    command = "python -m mgca_filter.training.report " + " ".join(sys.argv[1:] if arguments is None else arguments)
    try:
        network = load_network(options.weights).to(options.device)
        groups = {"unknown": select_pairs(_bundles(options.bundles, options.scenes), options.per_scene)}
        if options.known is not None:
            known = _bundles(options.known, options.known_scenes)
            groups["known"] = held_out_pairs(known, options.holdout_every, options.per_scene)
            if not groups["known"]:
                raise BundleError(f"{options.known}: no pair is held out with --holdout-every {options.holdout_every}")
    except MgcaFilterError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    summary = summarize_all(evaluate(MatchFilter.over(NetworkBackend(network)), groups))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "report.json").write_text(json.dumps({"command": command, **summary}, indent=1), encoding="utf-8")
    write_markdown(summary, options.out / "report.md", command)
    draw_thresholds(summary, options.out / "thresholds.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
