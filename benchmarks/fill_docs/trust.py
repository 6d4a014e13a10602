"""Run the studies behind ``docs/trust.md`` and put their tables there: ``python -m benchmarks.fill_docs.trust …``.

Each study is a command of its own, which the page names; this one gives them the data and the same model. Studies that
keep answers in the store go on where they stopped, so that an interrupted run is started again as it was.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from .. import detectors, focal_error, no_overlap, photographs, prefiltered_pairs, score_calibration, verdicts
from ..bad_input import __main__ as bad_input
from .pages import fill_file, provenance

PAGE = Path(__file__).resolve().parents[2] / "docs" / "trust.md"
PER_SCENE = 24
"""Pairs of a scene in the studies that draw from the bundles."""

Study = Callable[[Sequence[str]], int]


def studies(options: argparse.Namespace) -> dict[str, tuple[Study, list[str]]]:
    """By the name of their place in the page: the command and its arguments."""
    bundles, photos, store = str(options.bundles), str(options.photos), str(options.store)
    places = ["--same-place", str(options.same_place)]
    each = ["--per-scene", str(PER_SCENE)]
    scenes = [word for pair in options.scene for word in ("--scene", *pair)]
    return {
        "bad_input": (bad_input.main, []),
        "verdicts": (
            verdicts.main,
            [photos, "--pairs", "1000", *places, "--bundles", bundles, "--store", store],
        ),
        "no_overlap": (
            no_overlap.main,
            ["--scenes", *(images for images, _ in options.scene), "--photos", photos, "--pairs", "48"],
        ),
        "score_calibration": (score_calibration.main, [bundles, *each]),
        "prefiltered_pairs": (
            prefiltered_pairs.main,
            [bundles, str(options.rendered), *each, "--store", store],
        ),
        "focal_error": (focal_error.main, [bundles, *each]),
        "detectors": (detectors.main, [*scenes, "--rendered", photos]),
        "photographs": (
            photographs.main,
            [
                *map(str, options.photographs),
                *("--indoors", *options.indoors),
                *("--bundles", str(options.detector_bundles), "--detectors", "aliked_lightglue", "xfeat2k"),
                *("--settings", "rootsift-4000", "rootsift-8000"),
            ],
        ),
    }


def run(study: Study, arguments: Sequence[str]) -> str:
    """What a study prints.

    Raises:
        SystemExit: it could not be run; it has said why on standard error.
    """
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        status = study(arguments)
    if status == 2:
        raise SystemExit(status)
    return output.getvalue().strip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the studies that were asked for, all by default, and fill their places one by one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bundles", type=Path, required=True, help="scene bundles that training has not seen")
    parser.add_argument("--rendered", type=Path, required=True, help="bundle of mgca_filter.training.render")
    parser.add_argument("--photos", type=Path, required=True, help="photographs of different places")
    parser.add_argument("--same-place", type=Path, required=True, help="those that are not: a line for each place")
    parser.add_argument(
        "--scene", nargs=2, action="append", default=[], metavar=("IMAGES", "BUNDLE"), help="photographs of a bundle"
    )
    parser.add_argument(
        "--photographs", nargs="+", required=True, type=Path, metavar="SCENE", help="folders with cameras"
    )
    parser.add_argument("--indoors", nargs="+", required=True, metavar="NAME", help="those of them that are indoors")
    parser.add_argument(
        "--detector-bundles", type=Path, required=True, metavar="FOLDER", help="with ALIKED's and XFeat's"
    )
    parser.add_argument("--store", type=Path, required=True, help="keeps features, matches and answers")
    parser.add_argument("--only", nargs="+", metavar="PLACE", help="these places of the page alone")
    options = parser.parse_args(arguments)
    known = studies(options)
    unknown = sorted(set(options.only or ()) - set(known))
    if unknown:
        parser.error(f"--only: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    for name in options.only or known:
        print(name, file=sys.stderr, flush=True)
        fill_file(PAGE, {name: f"{run(*known[name])}\n\n{provenance()}"})


if __name__ == "__main__":
    main()
