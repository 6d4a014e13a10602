"""Measure the answers of the pages on two views anew: ``python -m benchmarks.fill_docs.two_views --bundles BUNDLES``.

No calibration, planes, video, fisheye: each place holds what one command prints.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .pages import fill_file, provenance
from .runtime import ROOT, run

PAGES = ROOT / "docs" / "how_to"
# Of the planes' table: what scripts do, what the filter does, and what others make of the matches that it keeps.
ROWS = (
    "raw, cv2 RANSAC 3",
    "ratio 0.75, cv2 RANSAC 5",
    "ratio 0.8, cv2 MAGSAC 3",
    "answer",
    "kept, cv2 RANSAC 3",
    "kept, PoseLib 3",
    "raw, ours",
    "twin",
)
# By place: the page, and the command.
COMMANDS = {
    "without_intrinsics": ("no_calibration.md", ("-m", "benchmarks.without_intrinsics")),
    "homographies": ("planes.md", ("-m", "benchmarks.homographies", "--pairs", "60", "--rows", *ROWS)),
    "homography_decision": ("planes.md", ("-m", "benchmarks.homographies", "--pairs", "60", "--decision")),
    "small_motion": ("video.md", ("-m", "benchmarks.small_motion")),
    "fisheye": ("fisheye.md", ("-m", "benchmarks.fisheye")),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the commands that were asked for, all by default, and fill their places one by one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundles", type=Path, help="scene bundles that training has not seen, for the first place")
    parser.add_argument("--per-scene", type=int, default=24, help="at most so many pairs of each (default 24)")
    parser.add_argument("--only", nargs="+", choices=tuple(COMMANDS), metavar="PLACE", help="these places alone")
    options = parser.parse_args(arguments)
    names = options.only or tuple(COMMANDS)
    if options.bundles is None and "without_intrinsics" in names:
        parser.error("--bundles: without_intrinsics needs them; --only leaves it out")
    for name in names:
        page, command = COMMANDS[name]
        if name == "without_intrinsics":
            command = (*command, str(options.bundles), "--per-scene", str(options.per_scene))
        print(name, file=sys.stderr, flush=True)
        fill_file(PAGES / page, {name: f"{run(command)}\n\n{provenance()}"})


if __name__ == "__main__":
    main()
