"""Other detectors than SIFT: ``python -m benchmarks.detectors --scene IMAGES BUNDLE --rendered PHOTOS``.

Images with known poses are detected and matched anew. What the filter makes of the matches stands beside the best of
the estimators that get as much: tests of the matches need the distance ratio, which arrays do not have.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.data.source import Image, check_folder, match_views, read_image
from mgca_filter.evaluation.metrics import POSE_STATISTICS, FloatArray
from mgca_filter.evaluation.predict import evaluate_pair
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.features import Detector, create_detector, describe
from mgca_filter.tables import markdown_head, markdown_row
from mgca_filter.training.worlds.photographs import PhotoFolder
from mgca_filter.training.worlds.view_pairs import match_views as match_rendered
from mgca_filter.training.worlds.views import draw_views

from .study import paired_cells, run_study, study_parser

Array = NDArray[np.float64]

DETECTORS = ("sift", "orb", "akaze", "brisk")
STATISTIC = POSE_STATISTICS["mAP@20"]


@dataclass(frozen=True)
class KnownPair:
    """Two images by name, and the pose from the first to the second."""

    image1: str
    image2: str
    R: Array
    t: Array


@dataclass(frozen=True)
class ImageSet:
    """Images (H, W) or (H, W, 3) uint8 and intrinsics (3, 3) by name, and the pairs among them."""

    name: str
    images: dict[str, Image]
    intrinsics: dict[str, Array]
    pairs: tuple[KnownPair, ...]

    def matched(self, detector: Detector) -> list[ScenePair]:
        """All pairs with what a detector finds and nearest neighbours make of it, no test applied."""
        views = {
            name: replace(describe(image, detector, name), K=self.intrinsics[name])
            for name, image in self.images.items()
        }
        return [
            match_views(
                self.name, i, (pair.image1, pair.image2), (views[pair.image1], views[pair.image2]), pair.R, pair.t
            )
            for i, pair in enumerate(self.pairs)
        ]


def photographed(folder: Path, bundle: SceneBundle) -> ImageSet:
    """The pairs of a bundle whose photographs are both in the folder, at whatever size they are there.

    Raises:
        DatasetError: none is there, or one is no image.
    """
    known = [bundle[i] for i in range(len(bundle))]
    check_folder(folder, [name for pair in known for name in (pair.image1, pair.image2)], str(bundle.path))
    there = [pair for pair in known if all((folder / name).is_file() for name in (pair.image1, pair.image2))]
    cameras = {name: (K, size) for p in there for name, K, size in _cameras(p)}
    images = {name: read_image(folder / name) for name in cameras}
    intrinsics = {name: _rescaled(K, size, images[name].shape[1::-1]) for name, (K, size) in cameras.items()}
    return ImageSet(bundle.scene, images, intrinsics, tuple(KnownPair(p.image1, p.image2, p.R, p.t) for p in there))


def rendered(photos: Path, count: int, seed: int) -> ImageSet:
    """``count`` pairs of views, each of a world of its own, that show the same thing (twenty right SIFT matches).

    Raises:
        PhotoError: the folder holds no photograph, or one that cannot be used.
    """
    folder = PhotoFolder.open(photos)
    images: dict[str, Image] = {}
    intrinsics: dict[str, Array] = {}
    pairs: list[KnownPair] = []
    number = 0
    while len(pairs) < count:
        views = draw_views(np.random.default_rng([seed, number]), folder, 2)
        number += 1
        pair = match_rendered(*views)
        if not pair.usable:
            continue
        names = [f"{number:06d}_{i}" for i in range(2)]
        images |= {name: view.image for name, view in zip(names, views)}
        intrinsics |= {name: view.camera.K for name, view in zip(names, views)}
        pairs.append(KnownPair(names[0], names[1], pair.R, pair.t))
    return ImageSet("rendered", images, intrinsics, tuple(pairs))


def _cameras(pair: ScenePair) -> Sequence[tuple[str, Array, tuple[int, int]]]:
    return ((pair.image1, pair.K1, pair.image_size1), (pair.image2, pair.K2, pair.image_size2))


def _rescaled(K: Array, size: tuple[int, int], now: tuple[int, ...]) -> Array:
    """Intrinsics of a picture that was ``size`` and is ``now``: pixels are areas, their centres shift by halves."""
    sx, sy = now[0] / size[0], now[1] / size[1]
    scaled: Array = np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]]) @ K
    return scaled


@dataclass(frozen=True)
class InputKind:
    """How matches are handed over, the filter's row for it and the baselines that can use as much."""

    name: str
    ours: str
    baselines: tuple[str, ...]


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


def make_detector(name: str) -> Detector:
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


def compare_detectors(images: ImageSet, detectors: Sequence[str], model: str | None) -> Iterator[list[str]]:
    """A row for each detector and each kind of input: the filter, the best baseline, and the paired difference."""
    for name in detectors:
        pairs = images.matched(make_detector(name))
        for kind in KINDS:
            ours = pose_errors(pairs, kind.ours, model)
            baselines = {baseline: pose_errors(pairs, baseline, model) for baseline in kind.baselines}
            best = max(baselines, key=lambda baseline: STATISTIC(baselines[baseline]))
            cells = paired_cells(ours, baselines[best], STATISTIC)
            yield [images.name, name, kind.name, str(len(pairs)), *cells, best]


HEADER = ["images", "detector", "matches as", "pairs", "filter mAP@20", "best baseline mAP@20", "difference"] + [
    "best baseline"
]
ALIGN = "lllrrrrl"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("detectors", __doc__, per_scene=False)
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
    options = parser.parse_args(arguments)
    if not options.scene and options.rendered is None:
        parser.error("nothing to measure: give --scene, --rendered or both")
    return run_study(run, options)


def run(options: argparse.Namespace) -> int:
    """Print a row for each set of images, detector and kind of input as it is measured."""
    sets = [photographed(images, SceneBundle(bundle)) for images, bundle in options.scene]
    if options.rendered is not None:
        sets.append(rendered(options.rendered, options.pairs, options.seed))
    print(markdown_head(HEADER, ALIGN))
    for images in sets:
        for cells in compare_detectors(images, options.detectors, options.model):
            print(markdown_row(cells), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
