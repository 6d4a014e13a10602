"""Measure the robust fit anew for ``docs/robust_fit.md``: ``python -m benchmarks.fill_docs.robust_fit BUNDLES …``.

Each place of the page holds what one command prints. ``--printed PLACE=FILE`` takes what it printed before instead.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from .pages import fill_file, provenance
from .runtime import ROOT, run

PAGE = ROOT / "docs" / "robust_fit.md"
PLACES = ("fit_ablation", "input_kinds", "gaps")
GAPS = ("1", "2", "3", "5", "10", "20")
OF_GAPS = "By frames between the images"
"""The table of ``input_kinds --gaps`` that the place of the gaps shows."""


def section(text: str, title: str) -> str:
    """What stands below a heading, up to the next one."""
    _, _, below = text.partition(f"## {title}\n")
    return below.partition("\n## ")[0].strip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both studies, or take what they printed, and fill their places."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", nargs="*", type=Path, help="folders of scene bundles, SIFT's first")
    parser.add_argument("--per-scene", type=int, default=8, metavar="N", help="pairs of a scene (default 8)")
    parser.add_argument("--printed", nargs="+", default=[], metavar="PLACE=FILE", help="what a study printed")
    options = parser.parse_args(arguments)
    printed = dict(item.split("=", 1) for item in options.printed)
    per_scene = ("--per-scene", str(options.per_scene))
    folders = [str(folder) for folder in options.bundles]
    for place in PLACES:
        if place in printed:
            text = Path(printed[place]).read_text(encoding="utf-8").strip()
        elif folders and place == "gaps":
            kinds = ("--kinds", "raw", "cross", "cross-ratio", "learned")
            text = run(("-m", "benchmarks.input_kinds", *folders, *kinds, "--gaps", *GAPS))
        elif folders:
            seen = folders[:1] if place == "fit_ablation" else folders
            text = run(("-m", f"benchmarks.{place}", *seen, *per_scene))
        else:
            continue
        text = section(text, OF_GAPS) if place == "gaps" else text
        fill_file(PAGE, {place: f"{text.replace(chr(10) + '## ', chr(10) + '### ')}\n\n{provenance()}"})


if __name__ == "__main__":
    main()
