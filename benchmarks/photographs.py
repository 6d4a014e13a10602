"""From photographs to poses, by detector and number of keypoints: ``python -m benchmarks.photographs SCENE ...``.

A scene is a folder of photographs with ``cameras.csv`` (image, fx, fy, cx, cy, k1, r11 … r33, tx, ty, tz: COLMAP's
SIMPLE_RADIAL, world to camera) and ``pairs.csv`` (image1, image2). Every setting runs what ``match_images``
runs, on the same pairs and on one thread; times are CPU time.

``--bundles`` and ``--detectors`` add what others have found in the same photographs, a learned matcher's own matches
(``scene.aliked_lightglue.npz``) or a learned detector's mutual nearest neighbours, before PoseLib and before the
filter. Every row then stands on the pairs that all of these bundles hold, and differences are to the first of these
rows. The time that it took to find these matches is not known here.

``rows=second`` and ``rows=backward`` in a setting hand over more than ``match_images`` does: the second neighbours of
ambiguous matches, or what the keypoints of image 2 find in image 1. ``--shrink`` makes the photographs smaller, so that
fewer keypoints are found and right.
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
from tempfile import TemporaryDirectory
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

from .detectors import rendered
from .match_lists import KINDS, DetectorScene, open_detector_scenes
from .study import paired_cells, run_study, study_parser

Array = NDArray[np.float64]
Matches = tuple[tuple[cv2.DMatch, ...], ...]
T = TypeVar("T")

STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
SETTING = "DETECTOR-COUNT[:OPTION=VALUE,...]"
FILTER_OPTIONS = ("effort", "geometry", "method", "model")
"""Options of the filter that a setting may name."""
CAMERA_COLUMNS = ("fx", "fy", "cx", "cy", "k1", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "tx", "ty", "tz")
ROWS = ("second", "backward")
"""Matches that a setting may add to those of ``match_images``, by ``rows=``."""
RENDERED = "rendered"
"""The scene of rendered worlds."""
AMBIGUOUS_RATIO, SECOND_RATIO = 0.8, 0.94
"""From which ratio on a second neighbour stands in a row of its own, and the ratio that this row claims."""
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
        options.pop("rows", None)
        return MatchFilter(seed=seed, **options)

    def match(self, one: NDArray[Any], two: NDArray[Any], norm: int) -> Matches:
        """The matches of two images' descriptors (N, D) as ``match_images`` finds them, and those that are added."""
        rows, matches = dict(self.options).get("rows"), match_descriptors(one, two, norm)
        if rows == "second":
            return matches + second_rows(matches)
        return matches if rows is None else matches + backward_rows(matches, match_descriptors(two, one, norm))


def second_rows(matches: Matches) -> Matches:
    """Second neighbours of ambiguous matches, as rows whose ratio is :data:`SECOND_RATIO`."""
    ambiguous = (row[1] for row in matches if len(row) > 1 and row[0].distance >= AMBIGUOUS_RATIO * row[1].distance)
    return tuple((m, cv2.DMatch(m.queryIdx, m.trainIdx, m.distance / SECOND_RATIO)) for m in ambiguous)


def backward_rows(matches: Matches, back: Matches) -> Matches:
    """Matches from image 2 to image 1 that are not among those the other way, turned round."""
    known = {(row[0].queryIdx, row[0].trainIdx) for row in matches}
    turned = (tuple(cv2.DMatch(m.trainIdx, m.queryIdx, m.distance) for m in row) for row in back)
    return tuple(row for row in turned if (row[0].queryIdx, row[0].trainIdx) not in known)


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
        or any(
            value not in ROWS if name == "rows" else name not in FILTER_OPTIONS or not value
            for name, _, value in options
        )
    ):
        raise argparse.ArgumentTypeError(
            f"expected {SETTING}, DETECTOR of {', '.join(DETECTORS)}, OPTION of {', '.join(FILTER_OPTIONS)} or rows "
            f"({', '.join(ROWS)}), got {text!r}"
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


def write_rendered(folder: Path, photos: Path, count: int, seed: int) -> None:
    """Views of ``count`` worlds that are rendered from photographs, two of each, as a scene's folder.

    Raises:
        PhotoError: as :func:`benchmarks.detectors.rendered`.
    """
    worlds = rendered(photos, count, seed)
    with (folder / "cameras.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image", *CAMERA_COLUMNS])
        for pair in worlds.pairs:
            for name, R, t in ((pair.image1, np.eye(3), np.zeros(3)), (pair.image2, pair.R, pair.t)):
                cv2.imwrite(str(folder / f"{name}.png"), worlds.images[name])
                K = worlds.intrinsics[name]
                writer.writerow([f"{name}.png", K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0.0, *R.ravel(), *t])
    lines = [f"{pair.image1}.png,{pair.image2}.png" for pair in worlds.pairs]
    (folder / "pairs.csv").write_text("\n".join(["image1,image2", *lines]) + "\n")


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


def run_setting(
    pairs: Sequence[PhotoPair], chosen: Setting, match_filter: MatchFilter, shrink: float = 1.0
) -> list[Answer]:
    """Every pair as ``match_images`` answers it, cameras known; each photograph is searched once.

    ``shrink`` is the share of their width and height that the photographs keep.
    """
    detector = chosen.create_detector()

    @cache
    def found(path: Path) -> Found:
        image: Image = read_image(path)
        if shrink < 1.0:
            size = tuple(max(1, round(shrink * side)) for side in image.shape[1::-1])
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        (keypoints, descriptors), milliseconds = timed(lambda: detect_keypoints(image, detector, str(path)))
        return Found(keypoints, descriptors, (image.shape[1], image.shape[0]), milliseconds)

    def answer(pair: PhotoPair) -> Answer:
        one, two = (found(path) for path in pair.paths)
        matches, matching = timed(lambda: chosen.match(one.descriptors, two.descriptors, detector.defaultNorm()))
        (first, second), resolution = pair.cameras, max(map(detector_resolution, (one.size, two.size)))
        K1, K2 = (scaled(camera.K, shrink) for camera in (first, second))
        result, filtering = timed(
            lambda: match_filter.filter(
                one.keypoints,
                two.keypoints,
                matches,
                K1=K1,
                K2=K2,
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


def scaled(K: Array, scale: float) -> Array:
    """Intrinsics (3, 3) of an image that is ``scale`` times as large: pixels are areas, their centres shift."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]]) @ K


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
    """Which scenes a line of the table is over, and its name: each alone, those outdoors, those indoors, all.

    Rendered worlds stand alone.
    """
    inside = [i for i, name in enumerate(scenes) if name in indoors]
    outside = [i for i, name in enumerate(scenes) if name not in (*indoors, RENDERED)]
    apart = [("outdoors", outside), ("indoors", inside)] if inside and outside else []
    everything = [("all", sorted(inside + outside))] if inside or outside else []
    return [*((name, [i]) for i, name in enumerate(scenes)), *apart, *everything]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("photographs", __doc__)
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE", help="folder of photographs with cameras")
    parser.add_argument("--indoors", nargs="+", default=[], metavar="NAME", help="these scenes also by themselves")
    parser.add_argument(
        "--bundles", nargs="+", default=[], type=Path, metavar="FOLDER", help="detectors' scene bundles"
    )
    parser.add_argument(
        "--detectors", nargs="+", default=["aliked_lightglue"], metavar="NAME", help="whose (default aliked_lightglue)"
    )
    parser.add_argument("--rendered", type=Path, metavar="PHOTOS", help="also two views each of worlds of these")
    parser.add_argument("--pairs", type=int, default=60, metavar="N", help="of rendered views (default 60)")
    parser.add_argument(
        "--shrink", type=float, default=1.0, metavar="SHARE", help="of width and height that are kept (default 1)"
    )
    add_settings(parser, DEFAULT_SETTINGS)
    options = parser.parse_args(arguments)
    if not options.scenes and options.rendered is None:
        parser.error("nothing to measure: give scenes, --rendered or both")
    if options.bundles and options.rendered is not None:
        parser.error("--bundles: nobody has bundles of views that are rendered anew")
    return run_study(run, options)


def run(options: argparse.Namespace) -> int:
    """Print the lines of each setting as it is measured: every scene, and all their pairs together."""
    if not 0.0 < options.shrink <= 1.0:
        raise ValueError(f"--shrink: expected a number above 0, at most 1, got {options.shrink:g}")
    unknown = sorted(set(options.indoors) - {folder.name for folder in options.scenes})
    if unknown:
        raise ValueError(f"--indoors: no scene {', '.join(unknown)}")
    given = found_matches(options)
    scenes = []
    for folder, lists in zip(options.scenes, given):
        among = set.intersection(*(set(one.pairs) for one in lists)) if lists else None
        scenes.append(read_scene(folder, options.per_scene, options.seed, among))
    with TemporaryDirectory() as worlds:
        if options.rendered is not None:
            folder = Path(worlds) / RENDERED
            folder.mkdir()
            write_rendered(folder, options.rendered, options.pairs, options.seed)
            scenes.append(read_scene(folder, None, options.seed))
        print_table(scenes, given, options)
    return 0


def print_table(
    scenes: Sequence[Sequence[PhotoPair]], given: Sequence[Sequence[FoundMatches]], options: argparse.Namespace
) -> None:
    """Print the lines of each row as it is measured."""
    print(markdown_head(HEADER, ALIGN))
    names = [*(folder.name for folder in options.scenes), *([RENDERED] if options.rendered is not None else [])]
    first: list[list[Answer]] = []
    for label, answers in measured(scenes, given, options):
        first = first or answers
        for place, members in places(names, options.indoors):
            ours, theirs = (sum((each[i] for i in members), []) for each in (answers, first))
            print(markdown_row(row(place, label, ours, theirs)), flush=True)


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
        yield str(chosen), [run_setting(pairs, chosen, match_filter, options.shrink) for pairs in scenes]


if __name__ == "__main__":
    sys.exit(main())
