"""Measure C++ against Python anew for ``docs/cpp.md``: ``python -m benchmarks.fill_docs.cpp --build FOLDER``.

FOLDER is a build of ``cpp/`` with its tests. Only with the same OpenCV on both sides do the times compare the two
languages: run it in an environment with the OpenCV of the build.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from .pages import fill_file, provenance
from .runtime import ROOT, run

PAGE = ROOT / "docs" / "cpp.md"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and fill its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", type=Path, required=True, metavar="FOLDER", help="where cpp/ was built")
    parser.add_argument("--bundles", nargs="+", default=[], metavar="FOLDER", help="scene bundles, for real pairs")
    options = parser.parse_args(arguments)
    bundles = ("--bundles", *options.bundles) if options.bundles else ()
    table = run(("-m", "benchmarks.cpp_speed", "--build", str(options.build), *bundles))
    fill_file(PAGE, {"speed": f"{table}\n\n{provenance()}"})


if __name__ == "__main__":
    main()
