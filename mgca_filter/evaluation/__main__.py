"""The scoreboard command: ``python -m mgca_filter.evaluation PATH…``."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import MgcaFilterError
from .environment import library_versions, machine_description, source_commit
from .pairs import select_pairs
from .predict import predict
from .registry import PRODUCT_ROWS, RIVAL_ROWS, parse_method
from .report import format_report, summarize
from .sources import FORMATS
from .store import ResultStore

logger = logging.getLogger(__name__)


def build_parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    parser = argparse.ArgumentParser(
        prog="python -m mgca_filter.evaluation",
        description="Relative pose from putative matches: the filter and its rivals on the same pairs.",
        epilog=f"Methods by default: {'; '.join([*RIVAL_ROWS, *PRODUCT_ROWS])}.",
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
        help="rows such as 'mutual + ratio 0.9 + PROSAC 0.5 px' or 'product'; 'rivals' and 'product-rows' stand for "
        "the default rows of either kind",
    )
    parser.add_argument("--model", metavar="FILE", help="model of the product rows (default: the one in the package)")
    parser.add_argument(
        "--workers", type=_positive, default=1, metavar="N", help="processes (default 1; more disturb the times)"
    )
    parser.add_argument(
        "--seeds", type=_positive, default=3, metavar="N", help="runs of randomised estimators (default 3)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the draw of pairs and of the bootstrap (default 0)")
    parser.add_argument("--store", metavar="DIR", help="keep results here, and take from here what is known")
    parser.add_argument("--reference", metavar="NAME", help="row that the others are compared with (default: product)")
    parser.add_argument("--bootstrap", type=int, default=1000, metavar="N", help="replicates; 0 = no intervals")
    parser.add_argument(
        "--json", metavar="FILE", help="write the figures here ('-' = standard output, tables left out)"
    )
    parser.add_argument("--markdown", metavar="FILE", help="write the tables here as Markdown")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress on standard error")
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _expand(names: Sequence[str] | None) -> list[str]:
    groups = {"rivals": RIVAL_ROWS, "product-rows": PRODUCT_ROWS}
    chosen = [row for name in names or groups for row in groups.get(name, (name,))]
    return list(dict.fromkeys(chosen))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a bundle, model, package or argument that cannot be used."""
    options = build_parser().parse_args(arguments)
    logging.basicConfig(
        level=logging.WARNING if options.quiet else logging.INFO, format="%(message)s", stream=sys.stderr
    )
    try:
        summary = run(options)
    except (MgcaFilterError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if options.json == "-":
        json.dump(summary, sys.stdout, indent=1)
        print()
    else:
        print(format_report(summary, markdown=False))
    if options.json not in (None, "-"):
        Path(options.json).write_text(json.dumps(summary, indent=1) + "\n")
    if options.markdown:
        Path(options.markdown).write_text(format_report(summary, markdown=True))
    return 0


def run(options: argparse.Namespace) -> dict[str, object]:
    """Draw the pairs, run the methods, and sum up."""
    methods = [parse_method(name, options.model) for name in _expand(options.methods)]
    selections = select_pairs(
        options.path,
        options.scenes,
        options.per_scene,
        options.seed,
        data_format=options.format,
        images=options.images,
    )
    store = ResultStore(options.store)
    results = predict(
        methods,
        selections,
        seeds=options.seeds,
        workers=options.workers,
        store=store,
        progress=not options.quiet,
    )
    context = {
        "seed": options.seed,
        "versions": library_versions(),
        "commit": source_commit(),
        "machine": machine_description(),
        "settings": {
            "format": options.format,
            "per_scene": options.per_scene,
            "seeds": options.seeds,
            "workers": options.workers,
            "data_sha256": {selection.scene: selection.sha256 for selection in selections},
            "methods": {method.name: method.settings() for method in methods},
        },
    }
    return summarize(results, context, reference=options.reference, replicates=options.bootstrap, seed=options.seed)


if __name__ == "__main__":
    sys.exit(main())
