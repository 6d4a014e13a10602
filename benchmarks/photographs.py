"""From photographs to poses, by detector and number of keypoints: ``python -m benchmarks.photographs SCENE ...``.

A scene is a folder of photographs with ``cameras.csv`` (image, fx, fy, cx, cy, k1, r11 … r33, tx, ty, tz: COLMAP's
SIMPLE_RADIAL, world to camera) and ``pairs.csv`` (image1, image2). Every setting runs what ``match_images``
runs, on the same pairs and on one thread; times are CPU time.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mgca_filter import MatchFilter
from mgca_filter.data.source import Image, read_image
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.metrics import FAILURE_DEG, POSE_STATISTICS
from mgca_filter.features import (
    DEFAULT_DETECTOR,
    DEFAULT_FEATURE_COUNT,
    DETECTORS,
    create_detector,
    detect_keypoints,
    detector_resolution,
    match_descriptors,
)
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.tables import markdown_head, markdown_row

from .study import paired_cells, run_study, study_parser

Array = NDArray[np.float64]
T = TypeVar("T")

STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
COMPARED = "mAP@20"
DEFAULT_SETTINGS = ("sift-2000", "rootsift-2000", "rootsift-4000", "rootsift-8000")


class Setting(NamedTuple):
    """What is varied: a detector by name and keypoints per image."""

    detector: str
    max_keypoints: int

    def __str__(self) -> str:
        """As on the command line."""
        return f"{self.detector}-{self.max_keypoints}"


def setting(text: str) -> Setting:
    """Read ``DETECTOR-COUNT``.

    Raises:
        argparse.ArgumentTypeError: an unknown detector, or no number.
    """
    detector, _, count = text.rpartition("-")
    if detector not in DETECTORS or not count.isdigit() or int(count) < 1:
        raise argparse.ArgumentTypeError(f"expected DETECTOR-COUNT, DETECTOR of {', '.join(DETECTORS)}, got {text!r}")
    return Setting(detector, int(count))


@dataclass(frozen=True)
class Camera:
    """Intrinsics (3, 3), distortion (k1, 0, 0, 0), and the pose from world to camera."""

    K: Array
    dist: Array
    R: Array
    t: Array


@dataclass(frozen=True)
class PhotoPair:
    """Two photographs of a scene by path, and their cameras."""

    scene: str
    paths: tuple[Path, Path]
    cameras: tuple[Camera, Camera]

    @property
    def pose(self) -> tuple[Array, Array]:
        """R and t of ``X2 = R X1 + t``."""
        one, two = self.cameras
        R = two.R @ one.R.T
        return R, two.t - R @ one.t


def read_scene(folder: Path, count: int | None, seed: int) -> list[PhotoPair]:
    """The pairs of a scene's folder, at most ``count`` of them, drawn by the seed.

    Raises:
        DatasetError: a file is missing, or not what it should be.
    """
    try:
        with (folder / "cameras.csv").open(newline="") as file:
            cameras = {row["image"]: _camera(row) for row in csv.DictReader(file)}
        with (folder / "pairs.csv").open(newline="") as file:
            names = [(row["image1"], row["image2"]) for row in csv.DictReader(file)]
        pairs = [PhotoPair(folder.name, (folder / a, folder / b), (cameras[a], cameras[b])) for a, b in names]
    except (KeyError, ValueError) as error:
        raise DatasetError(f"{folder}: cameras.csv and pairs.csv do not fit: {error}") from error
    if count is None or count >= len(pairs):
        return pairs
    rows = np.random.default_rng(seed).choice(len(pairs), count, replace=False)
    return [pairs[row] for row in np.sort(rows)]


def _camera(row: dict[str, str]) -> Camera:
    fx, fy, cx, cy, k1 = (float(row[name]) for name in ("fx", "fy", "cx", "cy", "k1"))
    R = np.array([[float(row[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(K, np.array([k1, 0.0, 0.0, 0.0]), R, np.array([float(row[name]) for name in ("tx", "ty", "tz")]))


@dataclass(frozen=True)
class Found:
    """Keypoints and descriptors (N, D) of a photograph of ``size`` (width, height), and the CPU time that they took."""

    keypoints: list[cv2.KeyPoint]
    descriptors: NDArray[Any]
    size: tuple[int, int]
    milliseconds: float


class Answer(NamedTuple):
    """Pose error of a pair, degrees (180 without a pose), matches, and CPU ms of extraction, matching and filter."""

    error_deg: float
    matches: int
    milliseconds: tuple[float, float, float]


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What a call returns, and its CPU milliseconds."""
    start = time.process_time()
    result = work()
    return result, 1e3 * (time.process_time() - start)


def run_setting(pairs: Sequence[PhotoPair], chosen: Setting, match_filter: MatchFilter) -> list[Answer]:
    """Every pair as ``match_images`` answers it, cameras known; each photograph is searched once."""
    detector = create_detector(*chosen)

    @cache
    def found(path: Path) -> Found:
        image: Image = read_image(path)
        (keypoints, descriptors), milliseconds = timed(lambda: detect_keypoints(image, detector, str(path)))
        return Found(keypoints, descriptors, (image.shape[1], image.shape[0]), milliseconds)

    def answer(pair: PhotoPair) -> Answer:
        one, two = (found(path) for path in pair.paths)
        matches, matching = timed(lambda: match_descriptors(one.descriptors, two.descriptors, detector.defaultNorm()))
        (first, second), resolution = pair.cameras, max(map(detector_resolution, (one.size, two.size)))
        result, filtering = timed(
            lambda: match_filter.filter(
                one.keypoints,
                two.keypoints,
                matches,
                K1=first.K,
                K2=second.K,
                dist1=first.dist,
                dist2=second.dist,
                size1=one.size,
                size2=two.size,
                resolution=resolution,
            )
        )
        if result.R is None or result.t is None:
            error = FAILURE_DEG
        else:
            error = pose_error_deg(result.R, result.t, *pair.pose)
        return Answer(error, len(matches), (one.milliseconds + two.milliseconds, matching, filtering))

    return [answer(pair) for pair in pairs]


HEADER = ["scene", "setting", "pairs", "matches", *STATISTICS, f"{COMPARED} against the first", "CPU ms"]
ALIGN = "llrrrrrrr"


def rows(scene: str, chosen: Setting, answers: Sequence[Answer], first: Sequence[Answer]) -> list[str]:
    """Cells of one line of the table; ``first`` are the answers of the first setting to the same pairs."""
    errors, baseline = (np.array([[answer.error_deg for answer in each]]) for each in (answers, first))
    figures = [f"{100.0 * float(POSE_STATISTICS[name](errors)):.1f}" for name in STATISTICS]
    difference = paired_cells(errors, baseline, POSE_STATISTICS[COMPARED])[2]
    extract, match, filtering = np.mean([answer.milliseconds for answer in answers], axis=0)
    matches = np.mean([answer.matches for answer in answers])
    spent = f"{extract:.0f} + {match:.0f} + {filtering:.0f}"
    return [scene, str(chosen), str(len(answers)), f"{matches:.0f}", *figures, difference, spent]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("photographs", __doc__)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help="folder of photographs with cameras")
    parser.add_argument(
        "--settings",
        nargs="+",
        type=setting,
        default=[setting(text) for text in DEFAULT_SETTINGS],
        metavar="DETECTOR-COUNT",
        help=f"default {' '.join(DEFAULT_SETTINGS)}; match_images uses {DEFAULT_DETECTOR}-{DEFAULT_FEATURE_COUNT}",
    )
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print the lines of each setting as it is measured: every scene, and all their pairs together."""
    scenes = [read_scene(folder, options.per_scene, options.seed) for folder in options.scenes]
    match_filter = MatchFilter(model=options.model, seed=options.seed)
    run_setting(scenes[0][:1], options.settings[0], match_filter)  # the first call opens the model
    print(markdown_head(HEADER, ALIGN))
    first: list[list[Answer]] = []
    for chosen in options.settings:
        answers = [run_setting(pairs, chosen, match_filter) for pairs in scenes]
        first = first or answers
        for pairs, ours, theirs in zip(scenes, answers, first):
            print(markdown_row(rows(pairs[0].scene, chosen, ours, theirs)))
        print(markdown_row(rows("all", chosen, sum(answers, []), sum(first, []))), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
