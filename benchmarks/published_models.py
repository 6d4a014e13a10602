"""Is the fast model enough? ``python -m benchmarks.published_models FOLDER [FOLDER ...]``.

The filter as it is, which asks both networks, and with either alone, on the same lists, of every detector and kind; and
what a forward pass costs on one thread, in turn. ``--fill`` puts the tables into the fast model's card. ``--candidate
FILE`` compares a model that is not published with the deep one, each alone.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.metrics import percentile_interval
from mgca_filter.evaluation.our_rows import ProductMethod
from mgca_filter.evaluation.predict import predict
from mgca_filter.evaluation.store import ResultStore
from mgca_filter.evaluation.summarize import scene_errors
from mgca_filter.inference import Backend, shared_backend
from mgca_filter.match_filter import PUBLISHED_MODELS, model_path
from mgca_filter.tables import render_table

from .fill_docs.pages import fill_file, provenance
from .input_kinds import COMPARED, OURS, STATISTICS, Comparison
from .match_lists import KINDS, DetectorScene, ListKind, open_detector_scenes
from .speed import network_input
from .study import run_study, study_parser

PLACE, DEEP, FAST = "published_models", "default", "fast"
REFERENCE = "reference"
STATISTICS_AND_DIFFERENCES = (" / ".join(STATISTICS), *(f"difference in {key}" for key in COMPARED))
SIZES, REPEATS = (100, 500, 2000), 9


def comparisons(
    scenes: Sequence[DetectorScene],
    kinds: Sequence[ListKind],
    store: ResultStore,
    workers: int,
    candidate: Path,
    reference: Path | None,
) -> dict[tuple[str, str], Comparison]:
    """A model file against another, None = the default filter, on the lists of each detector and kind."""
    found = {}
    for detector in dict.fromkeys(scene.detector for scene in scenes):
        for kind in kinds:
            listed = [scene.lists(kind) for scene in scenes if scene.detector == detector]
            selections = [selection for selection in listed if selection is not None]
            if not selections:
                continue
            errors = {}
            for name, model in ((OURS, candidate), (REFERENCE, reference)):
                method = ProductMethod("product", model=None if model is None else str(model))
                errors[name] = scene_errors(
                    predict([method], selections, store=store, seeds=1, workers=workers)[method.name]
                )
            pairs = sum(runs.shape[1] for runs in errors[OURS].values())
            found[detector, kind.name] = Comparison.of(errors, np.zeros((1, pairs), dtype=bool))
    return found


def format_comparisons(found: dict[tuple[str, str], Comparison], candidate: str, reference: str) -> str:
    """A row a detector and kind of list, and their mean."""
    rows = []
    for (detector, kind), one in found.items():
        differences = [_difference(*one.against(REFERENCE, key)) for key in COMPARED]
        rows.append(
            [detector, kind, str(one.lists), *(_figures([one], name) for name in (REFERENCE, OURS)), *differences]
        )
    lists = str(sum(one.lists for one in found.values()))
    rows.append(["mean", "", lists, _figures(list(found.values()), REFERENCE), *mean_cells(found)])
    header = ["detector", "list", "lists", reference, candidate, *(f"difference in {key}" for key in COMPARED)]
    return render_table(header, rows)


def mean_cells(found: dict[tuple[str, str], Comparison]) -> list[str]:
    """Figures of the candidate and its differences, means over detectors and kinds of list."""
    cells = [_figures(list(found.values()), OURS)]
    for key in COMPARED:
        middle = float(np.mean([one.differences[REFERENCE][key] for one in found.values()]))
        draws = np.mean([one.resampled[REFERENCE][key] for one in found.values()], axis=0)
        cells.append(_difference(middle, *percentile_interval(draws)))
    return cells


def _figures(found: Sequence[Comparison], name: str) -> str:
    return " / ".join(f"{np.mean([one.figures[name][key] for one in found]):.1f}" for key in STATISTICS)


def _difference(middle: float, low: float, high: float) -> str:
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def network_ms(backends: dict[str, Backend], count: int) -> dict[str, float]:
    """Least duration of a forward pass of each model on ``count`` matches, milliseconds, in turn."""
    inputs, best = network_input(count), dict.fromkeys(backends, float("inf"))
    for _ in range(REPEATS):
        for name, backend in backends.items():
            started = time.perf_counter()
            backend.infer(*inputs)
            best[name] = min(best[name], 1000.0 * (time.perf_counter() - started))
    return best


def format_times() -> str:
    """Milliseconds of the network by number of matches, one thread, and their ratio."""
    backends = {name: shared_backend(model_path(name), "onnxruntime") for name in PUBLISHED_MODELS}
    rows = []
    for count in SIZES:
        ms = network_ms(backends, count)
        rows.append([str(count), *(f"{ms[name]:.1f}" for name in backends), f"{ms[FAST] / ms[DEEP]:.2f}"])
    return render_table(["matches", *(f"{model_path(name).stem}, ms" for name in backends), "ratio"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("published_models", __doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("bundles", metavar="FOLDER", nargs="+", type=Path, help="folders of scene bundles, or bundles")
    parser.add_argument("--candidate", type=Path, metavar="FILE", help="a model file, against the deep model alone")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="these alone")
    parser.add_argument("--detectors", nargs="+", metavar="NAME", help="these alone, as the bundles' names have them")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="of lists (default: all)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--store", metavar="DIR", help="keep results here, and take from here what is known")
    parser.add_argument("--fill", action="store_true", help="put the tables into the fast model's card")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print both tables."""
    if options.fill and options.candidate:
        raise ValueError("--fill: the card is that of the fast model, not of --candidate")
    scenes = open_detector_scenes(
        options.bundles, options.detectors, options.scenes, options.per_scene, options.seed, None
    )
    kinds = [KINDS[name] for name in dict.fromkeys(options.kinds)]
    compare = partial(comparisons, scenes, kinds, ResultStore(options.store), options.workers)
    deep = model_path(DEEP)
    candidate, reference = (options.candidate, deep) if options.candidate else (model_path(FAST), None)
    found = compare(candidate, reference)
    if not found:
        raise DatasetError(f"{', '.join(map(str, options.bundles))}: no list of the kinds {', '.join(options.kinds)}")
    tables = format_comparisons(found, f"{candidate.stem} alone", "default" if reference is None else deep.stem)
    if reference is None:
        alone = render_table(
            ["", *STATISTICS_AND_DIFFERENCES], [[f"{deep.stem} alone", *mean_cells(compare(deep, None))]]
        )
        tables = f"{tables}\n\n{alone}\n\n{format_times()}"
    print(tables)
    if options.fill:
        fill_file(model_path(FAST).with_suffix(".md"), {PLACE: f"{tables}\n\n{provenance()}"})
    return 0


if __name__ == "__main__":
    sys.exit(main())
