"""The scoreboard command: ``python -m mgca_filter.evaluation PATH…``."""

from __future__ import annotations

import argparse
import json
import logging
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from ..data import FORMATS
from ..errors import MgcaFilterError
from .environment import library_versions, machine_description, one_thread, source_commit
from .figures import draw_figures, draw_pairs
from .methods import Method
from .pairs import SceneSelection, sample_pairs, select_pairs
from .predict import predict
from .registry import BASELINE_ROWS, GRID_ROWS, PRODUCT_ROWS, TIME_MATCHED_ROWS, parse_method
from .report import format_report
from .store import ResultStore
from .summarize import choose_reference, summarize
from .summary import Context, NotInstalled, Summary, best_baseline
from .timing import TimeMatch, match_times, time_methods

logger = logging.getLogger(__name__)

MATCHING_PAIRS = 60
"""Pairs, evenly from all scenes, on which iterations are looked for that take the time of a row of ours."""


def build_parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    parser = argparse.ArgumentParser(
        prog="python -m mgca_filter.evaluation",
        description="Relative pose from putative matches: the filter and its baselines on the same pairs.",
        epilog=f"Methods by default: {'; '.join([*BASELINE_ROWS, *PRODUCT_ROWS])}.",
    )
    parser.add_argument("path", nargs="+", metavar="PATH", help="files, folders of files, or COLMAP reconstructions")
    parser.add_argument(
        "--format",
        choices=tuple(FORMATS),
        default="bundle",
        help="scene bundles (.npz, the default), OANet's HDF5 dumps, SuperGlue's lists of image pairs with their pose, "
        "or COLMAP reconstructions with their images",
    )
    parser.add_argument("--images", metavar="DIR", help="where image names start (default: beside list or model)")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="these scenes only")
    parser.add_argument("--per-scene", type=_positive, metavar="N", help="at most N pairs of a scene, drawn by --seed")
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help="rows such as 'mutual + ratio 0.9 + PROSAC 0.5 px' or 'product'; 'baselines' and 'product-rows' stand for "
        "the default rows of either kind, 'grid' for every test of the matches before every estimator",
    )
    parser.add_argument(
        "--time-matched",
        metavar="NAME",
        help="also run robust estimators with the milliseconds that this row of ours takes, such as 'product'",
    )
    parser.add_argument("--model", metavar="FILE", help="model of the product rows (default: the one in the package)")
    parser.add_argument("--workers", type=_positive, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument(
        "--times",
        type=_count,
        default=10,
        metavar="N",
        help="pairs of each scene on which all rows are timed in turn, on one thread (default 10; 0 = no times)",
    )
    parser.add_argument(
        "--seeds", type=_positive, default=3, metavar="N", help="runs of randomised estimators (default 3)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the draw of pairs and of the bootstrap (default 0)")
    parser.add_argument("--store", metavar="DIR", help="keep results here, and take from here what is known")
    parser.add_argument("--reference", metavar="NAME", help="row that the others are compared with (default: product)")
    parser.add_argument("--bootstrap", type=_count, default=1000, metavar="N", help="replicates; 0 = no intervals")
    parser.add_argument(
        "--json", metavar="FILE", help="write the figures here ('-' = standard output, tables left out)"
    )
    parser.add_argument("--markdown", metavar="FILE", help="write the tables here as Markdown")
    parser.add_argument("--latex", metavar="FILE", help="write the tables here as LaTeX (booktabs)")
    parser.add_argument("--figures", metavar="DIR", help="write curves here as SVG, and pairs where there are images")
    parser.add_argument(
        "--pictures",
        type=_positive,
        default=2,
        metavar="N",
        help="pairs of each scene among the figures (default 2): reference and best baseline, right matches green, "
        "wrong ones red",
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress on standard error")
    return parser


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must be at least 0")
    return value


def _positive(text: str) -> int:
    if _count(text) == 0:
        raise argparse.ArgumentTypeError("must be at least 1")
    return int(text)


def _expand(names: Sequence[str] | None) -> list[str]:
    groups = {"baselines": BASELINE_ROWS, "product-rows": PRODUCT_ROWS, "grid": GRID_ROWS}
    chosen = [row for name in names or ("baselines", "product-rows") for row in groups.get(name, (name,))]
    return list(dict.fromkeys(chosen))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = data, a model, a package or an argument that cannot be used."""
    options = build_parser().parse_args(arguments)
    logging.basicConfig(
        level=logging.WARNING if options.quiet else logging.INFO, format="%(message)s", stream=sys.stderr
    )
    try:
        with one_thread():
            run(options)
    except (MgcaFilterError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run(options: argparse.Namespace) -> None:
    """Draw the pairs, run the methods, sum up, and write what was asked for."""
    _check_outputs(options)
    selections = select_pairs(
        options.path,
        options.scenes,
        options.per_scene,
        options.seed,
        data_format=options.format,
        images=options.images,
    )
    store = ResultStore(options.store)
    methods, not_installed = _installed([parse_method(name, options.model) for name in _expand(options.methods)])
    time_matched: list[TimeMatch] = []
    if options.time_matched is not None:
        baselines, lacking = _installed([parse_method(name) for name in TIME_MATCHED_ROWS])
        like = parse_method(options.time_matched, options.model)
        names = [baseline.name for baseline in baselines]
        sample = sample_pairs(selections, math.ceil(MATCHING_PAIRS / len(selections)))
        time_matched = match_times(names, like, sample, store)
        methods += [parse_method(match.method) for match in time_matched]
        not_installed += lacking
    reference = choose_reference([method.name for method in methods], options.reference)
    results = predict(
        methods, selections, seeds=options.seeds, workers=options.workers, store=store, progress=not options.quiet
    )
    timing = time_methods(methods, sample_pairs(selections, options.times), store) if options.times else None
    context = _context(options, selections, methods, not_installed, time_matched)
    settings = {"reference": reference, "replicates": options.bootstrap, "seed": options.seed}
    summary = summarize(results, context, timing, **settings)
    _write(options, summary)
    if options.figures:
        draw_figures(summary, options.figures)
        shown = dict.fromkeys([best_baseline(summary.rows, reference), reference])
        pictured = [method for name in shown for method in methods if method.name == name]
        draw_pairs(pictured, selections, options.figures, options.pictures)


def _check_outputs(options: argparse.Namespace) -> None:
    """Raise ValueError now rather than after a long run where a file cannot be written."""
    for name in ("json", "markdown", "latex"):
        path = getattr(options, name)
        if path not in (None, "-") and not Path(path).parent.is_dir():
            raise ValueError(f"--{name}: {path}: its folder is not there")


def _installed(methods: Sequence[Method]) -> tuple[list[Method], list[NotInstalled]]:
    """The methods that can run, and the others with the reason.

    Raises:
        ImportError: none can.
    """
    usable, lacking = [], []
    for method in methods:
        try:
            method.settings()
        except ImportError as error:
            lacking.append(NotInstalled(method.name, str(error)))
        else:
            usable.append(method)
    if not usable:
        raise ImportError("; ".join(f"{item.method}: {item.reason}" for item in lacking))
    return usable, lacking


def _context(
    options: argparse.Namespace,
    selections: Sequence[SceneSelection],
    methods: Sequence[Method],
    not_installed: Sequence[NotInstalled],
    time_matched: Sequence[TimeMatch],
) -> Context:
    """What the figures depend on besides the methods' answers."""
    settings = {
        "format": options.format,
        "per_scene": options.per_scene,
        "seeds": options.seeds,
        "workers": options.workers,
        "data_sha256": {selection.scene: selection.sha256 for selection in selections},
        "methods": {method.name: method.settings() for method in methods},
    }
    return Context(
        seed=options.seed,
        versions=library_versions(),
        commit=source_commit(),
        machine=machine_description(),
        settings=settings,
        not_installed=tuple(not_installed),
        time_matched=tuple(time_matched),
    )


def _write(options: argparse.Namespace, summary: Summary) -> None:
    if options.json == "-":
        json.dump(summary.to_json(), sys.stdout, indent=1)
        print()
    else:
        print(format_report(summary, "text"))
    if options.json not in (None, "-"):
        Path(options.json).write_text(json.dumps(summary.to_json(), indent=1) + "\n", encoding="utf-8")
    if options.markdown:
        Path(options.markdown).write_text(format_report(summary, "markdown"), encoding="utf-8")
    if options.latex:
        Path(options.latex).write_text(format_report(summary, "latex"), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
