"""From photographs to poses, by detector and number of keypoints: ``python -m benchmarks.photographs SCENE ...``.

A scene is a folder of photographs with ``cameras.csv`` (image, fx, fy, cx, cy, k1, r11 … r33, tx, ty, tz: COLMAP's
SIMPLE_RADIAL, world to camera) and ``pairs.csv`` (image1, image2). Every setting runs what ``match_images``
runs, on the same pairs and on one thread; times are CPU time.

``--bundles`` and ``--detectors`` add what others have found in the same photographs, a learned matcher's own matches
(``scene.aliked_lightglue.npz``) or a learned detector's mutual nearest neighbours, before PoseLib and before the
filter. Every row then stands on the pairs that all of these bundles hold, and differences are to the first of these
rows. The time that it took to find these matches is not known here.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence, Set
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.data.source import Image, read_image
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.methods import Method
from mgca_filter.evaluation.metrics import FAILURE_DEG, POSE_STATISTICS
from mgca_filter.evaluation.predict import answer_pair
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.features import (
    DEFAULT_DETECTOR,
    DEFAULT_FEATURE_COUNT,
    DETECTORS,
    Detector,
    create_detector,
    detect_keypoints,
    detector_resolution,
    match_descriptors,
)
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.tables import MISSING, markdown_head, markdown_row

from .match_lists import KINDS, DetectorScene, open_detector_scenes
from .study import paired_cells, run_study, study_parser

Array = NDArray[np.float64]
T = TypeVar("T")

STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
SETTING = "DETECTOR-COUNT[:OPTION=VALUE,...]"
FILTER_OPTIONS = ("effort", "geometry", "method", "model")
"""Options of the filter that a setting may name."""
MATCHED_METHODS = ("NN + PoseLib 0.75 px", "NN + PoseLib progressive 0.75 px", "product")
"""What gets matches that others have found: rows of the scoreboard."""
DEFAULT_SETTINGS = ("sift-2000", "rootsift-2000", "rootsift-4000", "rootsift-8000")


class Setting(NamedTuple):
    """What is varied: a detector by name, keypoints per image, and options of the filter by name."""

    detector: str
    max_keypoints: int
    options: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        """As on the command line."""
        options = ",".join(f"{name}={value}" for name, value in self.options)
        return f"{self.detector}-{self.max_keypoints}" + (f":{options}" if options else "")

    def create_detector(self) -> Detector:
        """The detector that finds so many keypoints."""
        return create_detector(self.detector, self.max_keypoints)

    def match_filter(self, model: str | None, seed: int) -> MatchFilter:
        """The filter with these options.

        Raises:
            TypeError, ValueError, MgcaFilterError: as :class:`mgca_filter.MatchFilter`.
        """
        options: dict[str, Any] = {"model": model, **dict(self.options)}
        return MatchFilter(seed=seed, **options)


def setting(text: str) -> Setting:
    """Read ``DETECTOR-COUNT`` or ``DETECTOR-COUNT:OPTION=VALUE,...``.

    Raises:
        argparse.ArgumentTypeError: an unknown detector or option, or no number.
    """
    features, _, listed = text.partition(":")
    detector, _, count = features.rpartition("-")
    options = [option.partition("=") for option in listed.split(",") if option]
    if (
        detector not in DETECTORS
        or not (count.isdigit() and int(count))
        or any(name not in FILTER_OPTIONS or not value for name, _, value in options)
    ):
        raise argparse.ArgumentTypeError(
            f"expected {SETTING}, DETECTOR of {', '.join(DETECTORS)}, OPTION of {', '.join(FILTER_OPTIONS)}, "
            f"got {text!r}"
        )
    return Setting(detector, int(count), tuple((name, value) for name, _, value in options))


def add_settings(parser: argparse.ArgumentParser, default: Sequence[str]) -> None:
    """Give a command the option ``--settings``, a list of :class:`Setting`."""
    parser.add_argument(
        "--settings",
        nargs="+",
        type=setting,
        default=[setting(text) for text in default],
        metavar=SETTING,
        help=f"default {' '.join(default)}; match_images uses {DEFAULT_DETECTOR}-{DEFAULT_FEATURE_COUNT}",
    )


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
    def names(self) -> PairNames:
        """The names of the two files."""
        return self.paths[0].name, self.paths[1].name

    @property
    def pose(self) -> tuple[Array, Array]:
        """R and t of ``X2 = R X1 + t``."""
        one, two = self.cameras
        R = two.R @ one.R.T
        return R, two.t - R @ one.t

    def error_deg(self, R: Array | None, t: Array | None) -> float:
        """Pose error of an answer, degrees; 180 without a pose."""
        return FAILURE_DEG if R is None or t is None else pose_error_deg(R, t, *self.pose)


PairNames = tuple[str, str]


def read_scene(folder: Path, count: int | None, seed: int, among: Set[PairNames] | None = None) -> list[PhotoPair]:
    """The pairs of a scene's folder, at most ``count`` of them, drawn by the seed; ``among`` are all that is wanted.

    Raises:
        DatasetError: a file is missing, or not what it should be.
    """
    try:
        with (folder / "cameras.csv").open(newline="") as file:
            cameras = {row["image"]: _camera(row) for row in csv.DictReader(file)}
        with (folder / "pairs.csv").open(newline="") as file:
            names = [(row["image1"], row["image2"]) for row in csv.DictReader(file)]
        names = [pair for pair in names if among is None or pair in among]
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
    """Pose error of a pair, degrees, its matches, and CPU ms of extraction, matching and filter; NaN = not known."""

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
    detector = chosen.create_detector()

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
        spent = one.milliseconds + two.milliseconds, matching, filtering
        return Answer(pair.error_deg(result.R, result.t), len(matches), spent)

    return [answer(pair) for pair in pairs]


@dataclass(frozen=True)
class FoundMatches:
    """A list of matches of pairs of photographs by the names of their images; ``name`` says whose."""

    name: str
    pairs: dict[PairNames, ScenePair]

    @classmethod
    def of(cls, bundle: DetectorScene) -> FoundMatches:
        """A learned matcher's own matches, or the mutual nearest neighbours."""
        kind = KINDS["learned" if bundle.learned else "cross"]
        found = (kind.of(bundle.source[index]) for index in bundle.indices)
        name = bundle.detector if bundle.learned else f"{bundle.detector}, {kind.name}"
        return cls(name, {(Path(pair.image1).name, Path(pair.image2).name): pair for pair in found})

    def run(self, pairs: Sequence[PhotoPair], method: Method, seed: int) -> list[Answer]:
        """What a method makes of the matches of these pairs, as the scene's own cameras judge it."""
        answers = []
        for pair in pairs:
            matches = self.pairs[pair.names]
            found, spent = timed(lambda: answer_pair(method, matches, seed))  # noqa: B023
            answers.append(Answer(pair.error_deg(found.R, found.t), len(matches.points1), (np.nan, np.nan, spent)))
        return answers


def found_matches(options: argparse.Namespace) -> list[list[FoundMatches]]:
    """By scene: the matches of each detector that was asked for.

    Raises:
        DatasetError: as :func:`benchmarks.match_lists.open_detector_scenes`, or a detector lacks a scene.
    """
    names = [folder.name for folder in options.scenes]
    if not options.bundles:
        return [[] for _ in names]
    bundles = open_detector_scenes(options.bundles, options.detectors, names)
    known = {(bundle.scene, bundle.detector): bundle for bundle in bundles}
    wanted = [(scene, detector) for scene in names for detector in options.detectors]
    absent = [".".join(each) for each in wanted if each not in known]
    if absent:
        raise DatasetError(f"{', '.join(map(str, options.bundles))}: no bundle {', '.join(absent)}")
    return [[FoundMatches.of(known[scene, detector]) for detector in options.detectors] for scene in names]


DIFFERENCES = [f"{name} against the first" for name in STATISTICS]
HEADER = ["scene", "setting", "pairs", "matches", *STATISTICS, *DIFFERENCES, "CPU ms"]
ALIGN = "llrrrrrrrrr"


def row(scene: str, label: str, answers: Sequence[Answer], first: Sequence[Answer]) -> list[str]:
    """Cells of one line of the table; ``first`` are the answers of the first row to the same pairs."""
    errors, baseline = (np.array([[answer.error_deg for answer in each]]) for each in (answers, first))
    figures = [paired_cells(errors, baseline, POSE_STATISTICS[name]) for name in STATISTICS]
    spent = np.mean([answer.milliseconds for answer in answers], axis=0)
    return [
        *(scene, label, str(len(answers)), f"{np.mean([answer.matches for answer in answers]):.0f}"),
        *(figure for figure, _, _ in figures),
        *(difference for _, _, difference in figures),
        " + ".join(MISSING if np.isnan(part) else f"{part:.0f}" for part in spent),
    ]


def places(scenes: Sequence[str], indoors: Collection[str]) -> list[tuple[str, list[int]]]:
    """Which scenes a line of the table is over, and its name: each alone, those outdoors, those indoors, all."""
    inside = [i for i, name in enumerate(scenes) if name in indoors]
    outside = [i for i, name in enumerate(scenes) if name not in indoors]
    apart = [("outdoors", outside), ("indoors", inside)] if inside and outside else []
    return [*((name, [i]) for i, name in enumerate(scenes)), *apart, ("all", list(range(len(scenes))))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("photographs", __doc__)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help="folder of photographs with cameras")
    parser.add_argument("--indoors", nargs="+", default=[], metavar="NAME", help="these scenes also by themselves")
    parser.add_argument(
        "--bundles", nargs="+", default=[], type=Path, metavar="FOLDER", help="detectors' scene bundles"
    )
    parser.add_argument(
        "--detectors", nargs="+", default=["aliked_lightglue"], metavar="NAME", help="whose (default aliked_lightglue)"
    )
    add_settings(parser, DEFAULT_SETTINGS)
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print the lines of each setting as it is measured: every scene, and all their pairs together."""
    names = [folder.name for folder in options.scenes]
    unknown = sorted(set(options.indoors) - set(names))
    if unknown:
        raise ValueError(f"--indoors: no scene {', '.join(unknown)}")
    given = found_matches(options)
    scenes = []
    for folder, lists in zip(options.scenes, given):
        among = set.intersection(*(set(one.pairs) for one in lists)) if lists else None
        scenes.append(read_scene(folder, options.per_scene, options.seed, among))
    print(markdown_head(HEADER, ALIGN))
    first: list[list[Answer]] = []
    for label, answers in measured(scenes, given, options):
        first = first or answers
        for place, members in places(names, options.indoors):
            ours, theirs = (sum((each[i] for i in members), []) for each in (answers, first))
            print(markdown_row(row(place, label, ours, theirs)), flush=True)
    return 0


def measured(
    scenes: Sequence[Sequence[PhotoPair]], given: Sequence[Sequence[FoundMatches]], options: argparse.Namespace
) -> Iterator[tuple[str, list[list[Answer]]]]:
    """Answers by scene of every row of the table: those to matches that were given, then those of the settings."""
    for lists in zip(*given):
        for name in MATCHED_METHODS:
            method = parse_method(name, options.model)
            label = f"{lists[0].name} + {'filter' if name == 'product' else name.removeprefix('NN + ')}"
            yield label, [one.run(pairs, method, options.seed) for one, pairs in zip(lists, scenes)]
    for chosen in options.settings:
        match_filter = chosen.match_filter(options.model, options.seed)
        run_setting(scenes[0][:1], chosen, match_filter)  # the first call opens the model
        yield str(chosen), [run_setting(pairs, chosen, match_filter) for pairs in scenes]


if __name__ == "__main__":
    sys.exit(main())
