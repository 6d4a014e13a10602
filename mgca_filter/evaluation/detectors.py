"""Other detectors than SIFT: ``python -m mgca_filter.evaluation.detectors --scene IMAGES BUNDLE --rendered PHOTOS``.

Images with known poses are detected and matched anew. What the filter makes of the matches stands beside the best of
the estimators that get as much: tests of the matches need the distance ratio, which arrays do not have.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..data.scene_bundle import SceneBundle, ScenePair
from ..errors import MgcaFilterError
from ..features import create_detector
from .image_sets import ImageSet, photographed, rendered
from .metrics import POSE_STATISTICS, FloatArray
from .paired_difference import paired_cells
from .predict import evaluate_pair
from .registry import parse_method

DETECTORS = ("sift", "orb", "akaze", "brisk")
STATISTIC = POSE_STATISTICS["mAP@20"]


@dataclass(frozen=True)
class InputKind:
    """How matches are handed over, the filter's row for it and the rivals that can use as much."""

    name: str
    ours: str
    rivals: tuple[str, ...]


KINDS = (
    InputKind(
        "KeyPoints, two neighbours",
        "product",
        (
            "ratio 0.8 + RANSAC 0.75 px",
            "mutual + ratio 0.8 + MAGSAC 0.5 px",
            "mutual + ratio 0.9 + PROSAC 0.5 px",
        ),
    ),
    InputKind("arrays, nearest neighbours", "product bare", ("NN + RANSAC 0.75 px", "NN + MAGSAC 0.5 px")),
    InputKind(
        "arrays, mutual neighbours", "mutual + product bare", ("mutual + RANSAC 0.75 px", "mutual + MAGSAC 0.5 px")
    ),
)


def make_detector(name: str) -> cv2.Feature2D:
    """SIFT, ORB or AKAZE as the package makes them, or BRISK with OpenCV's defaults."""
    if name != "brisk":
        return create_detector(name)
    # OpenCV 5 moved BRISK to the contrib module.
    brisk: Any = getattr(cv2, "BRISK", None) or cv2.xfeatures2d.BRISK
    detector: cv2.Feature2D = brisk.create()
    return detector


def pose_errors(pairs: Sequence[ScenePair], method: str, model: str | None) -> FloatArray:
    """Pose errors (1, P) of a row of the scoreboard, degrees; 180 where there is no pose."""
    run = parse_method(method, model)
    return np.array([[evaluate_pair(run, pair, seed=0).error_deg for pair in pairs]])


def compare_detectors(images: ImageSet, detectors: Sequence[str], model: str | None) -> Iterator[str]:
    """A row for each detector and each kind of input: the filter, the best rival, and the paired difference."""
    for name in detectors:
        pairs = images.matched(make_detector(name))
        for kind in KINDS:
            ours = pose_errors(pairs, kind.ours, model)
            rivals = {rival: pose_errors(pairs, rival, model) for rival in kind.rivals}
            best = max(rivals, key=lambda rival: STATISTIC(rivals[rival]))
            cells = paired_cells(ours, rivals[best], STATISTIC)
            yield f"| {images.name} | {name} | {kind.name} | {len(pairs)} | {cells} | {best} |"


HEADER = (
    "| images | detector | matches as | pairs | filter mAP@20 | best rival mAP@20 | difference | best rival |\n"
    "|---|---|---|---:|---:|---:|---:|---|"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.evaluation.detectors", description=__doc__)
    parser.add_argument(
        "--scene",
        nargs=2,
        action="append",
        default=[],
        metavar=("IMAGES", "BUNDLE"),
        type=Path,
        help="folder of photographs, and the scene bundle that knows their poses; may be repeated",
    )
    parser.add_argument("--rendered", metavar="PHOTOS", type=Path, help="also render worlds from these photographs")
    parser.add_argument("--pairs", type=int, default=60, metavar="N", help="of rendered views (default 60)")
    parser.add_argument("--detectors", nargs="+", choices=DETECTORS, default=DETECTORS)
    parser.add_argument("--model", metavar="FILE")
    parser.add_argument("--seed", type=int, default=0, help="of the rendered worlds (default 0)")
    options = parser.parse_args(arguments)
    if not options.scene and options.rendered is None:
        parser.error("nothing to measure: give --scene, --rendered or both")
    cv2.setNumThreads(1)
    try:
        sets = [photographed(images, SceneBundle(bundle)) for images, bundle in options.scene]
        if options.rendered is not None:
            sets.append(rendered(options.rendered, options.pairs, options.seed))
        print(HEADER)
        for images in sets:
            for row in compare_detectors(images, options.detectors, options.model):
                print(row, flush=True)
    except (MgcaFilterError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
