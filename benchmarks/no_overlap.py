"""Pairs that show nothing in common: ``python -m benchmarks.no_overlap --scenes SCENE … --photos FOLDER``.

Whatever pose comes out of such a pair is wrong, and one with ``ok`` ruins a map. Geometry decides what has no overlap,
never the matches. Of a scene's photographs with cameras (``benchmarks.photographs``) it is pairs whose frusta do not
meet within the depths of the scene, and parts of two photographs: what the one part shows lies outside the other at any
depth from half the least one of the scene to infinity. Further: photographs cut in two, views of rendered worlds, and
photographs of two scenes. A plane that was matched to its likeness comes out as ``planar``, with E or without.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from mgca_filter import MatchFilter
from mgca_filter.data.source import detect, read_image
from mgca_filter.export.pairs_apart import PairApart, Rectangle, crop, lists_of, parts_of_photographs, rendered_apart
from mgca_filter.features import match_features
from mgca_filter.geometry.epipolar import essential_from_pose, homogeneous, sampson_distance
from mgca_filter.result import FilterResult, Status
from mgca_filter.tables import markdown_head, markdown_row

from .photographs import Camera, PhotoPair, Setting, add_settings, read_scene
from .study import CONFIDENCE_LIMITS, run_study, study_parser

Array = NDArray[np.float64]

DEFAULT_SETTINGS = ("rootsift-4000", "orb-4000")
# Depths come from matches of the known pairs that agree with their pose, of rays at this angle and more.
_RATIO, _RIGHT_PX, _LEAST_PARALLAX_DEG, _LEAST_POINTS = 0.8, 1.0, 1.0, 20
# Between these percentiles of the depths, and by this factor beyond, lies whatever an image shows.
_PERCENTILES, _FACTOR = (1.0, 99.0), 2.0
# An image is cut at one of these shares of its side; either part is at least the least of them.
_CUTS = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65)
# Points this near to an image, as a share of its longer side, may be in it.
_MARGIN = 0.03
# Farther from the axis than the image's corner by this factor the polynomial of a lens means nothing.
_BEYOND_CORNER = 1.5
# What an image shows is sampled at so many pixels, and at depths that lie no farther apart in the other than the
# margin.
_COLUMNS, _ROWS, _DEPTHS = 25, 17, (25, 200)


class Depths(NamedTuple):
    """Between what depths an image shows anything."""

    near: float
    far: float


@dataclass(frozen=True)
class Photograph:
    """A photograph of a scene with its camera, its size (width, height), and its depths."""

    path: Path
    camera: Camera
    size: tuple[int, int]
    depths: Depths

    @property
    def whole(self) -> Rectangle:
        """All of it."""
        return (0, 0, *self.size)


def measured_depths(pairs: Sequence[PhotoPair]) -> dict[Path, Depths]:
    """Depths of the photographs of a scene's pairs, in the units of its poses, with a margin; where they are known."""
    found: dict[Path, list[float]] = {path: [] for pair in pairs for path in pair.paths}
    for pair in pairs:
        one, two = (detect(path) for path in pair.paths)
        matches = match_features(one, two)
        if matches.attributes.ratio is None:
            continue
        kept = matches.mutual & (matches.attributes.ratio < _RATIO)
        if not kept.any():
            continue
        points = one.points[matches.index1[kept]], two.points[matches.index2[kept]]
        x1, x2 = (_normalized(p, camera) for p, camera in zip(points, pair.cameras))
        for path, depths in zip(pair.paths, triangulated_depths(x1, x2, *pair.pose, pair.cameras[0].K[0, 0])):
            found[path] += depths.tolist()
    limits = {
        path: np.percentile(depths, _PERCENTILES) for path, depths in found.items() if len(depths) > _LEAST_POINTS
    }
    return {path: Depths(float(low) / _FACTOR, float(high) * _FACTOR) for path, (low, high) in limits.items()}


def triangulated_depths(x1: Array, x2: Array, R: Array, t: Array, focal_px: float) -> tuple[Array, Array]:
    """Depths (M,) in either camera of those normalised matches (N, 2) that agree with the pose ``X2 = R X1 + t``."""
    right = sampson_distance(np.hstack([x1, x2]), essential_from_pose(R, t)) * focal_px < _RIGHT_PX
    ray1, ray2 = homogeneous(x1[right]) @ R.T, homogeneous(x2[right])
    normal, other = np.cross(ray2, ray1), np.cross(ray2, t)  # z1 ray1 + t = z2 ray2, times ray2
    sine = np.linalg.norm(normal, axis=1) / (np.linalg.norm(ray1, axis=1) * np.linalg.norm(ray2, axis=1))
    wide = sine > np.sin(np.radians(_LEAST_PARALLAX_DEG))
    depth1 = -np.sum(normal[wide] * other[wide], axis=1) / np.sum(normal[wide] ** 2, axis=1)
    depth2 = depth1 * ray1[wide, 2] + t[2]
    front = (depth1 > 0) & (depth2 > 0)
    return depth1[front], depth2[front]


def _normalized(points: Array, camera: Camera) -> Array:
    pixels = np.asarray(points, dtype=np.float64).reshape(-1, 1, 2)
    return np.asarray(cv2.undistortPoints(pixels, camera.K, camera.dist)[:, 0], dtype=np.float64)


def _project(X: Array, photograph: Photograph) -> tuple[Array, Array]:
    """Pixels (N, 2) and depths (N,) of points of the world (N, 3); NaN behind the camera and far off its axis."""
    camera = photograph.camera
    X = X @ camera.R.T + camera.t
    depth = X[:, 2]
    x = X[:, :2] / np.where(depth > 0, depth, np.nan)[:, None]
    corners = _normalized(np.array([[0, 0], photograph.size], dtype=np.float64), camera)
    radius = np.sum(x**2, axis=1)
    x[radius > _BEYOND_CORNER**2 * np.sum(corners**2, axis=1).max()] = np.nan
    x = x * (1.0 + camera.dist[0] * np.sum(x**2, axis=1))[:, None]
    return x @ np.diag(np.diag(camera.K)[:2]) + camera.K[:2, 2], depth


def _shown(one: Photograph, part: Rectangle, depths: Depths, two: Photograph) -> Array | None:
    """Points (N, 3) of the world all over what a part of a photograph may show; None where that takes too many."""
    inverse = max(1.0 / depths.far, 1e-6 / depths.near), 1.0 / depths.near
    baseline = np.linalg.norm(one.camera.R.T @ one.camera.t - two.camera.R.T @ two.camera.t)
    parallax_px = 2.0 * baseline * (inverse[1] - inverse[0]) * two.camera.K[0, 0]
    count = max(_DEPTHS[0], int(parallax_px / (_MARGIN * max(two.size))))
    if count > _DEPTHS[1]:
        return None
    x0, y0, x1, y1 = part
    pixels = np.stack(np.meshgrid(np.linspace(x0, x1, _COLUMNS), np.linspace(y0, y1, _ROWS)), -1).reshape(-1, 2)
    rays = homogeneous(_normalized(pixels, one.camera))
    X = (rays / np.linspace(*inverse, count)[:, None, None]).reshape(-1, 3)
    return np.asarray((X - one.camera.t) @ one.camera.R)


def _inside(pixels: Array, photograph: Photograph) -> NDArray[np.bool_]:
    """Which pixels (N, 2) may be in a photograph; NaN are not."""
    margin = _MARGIN * max(photograph.size)
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixels > -margin) & (pixels < np.array(photograph.size) + margin)).all(axis=1))


def are_apart(one: Photograph, two: Photograph) -> bool:
    """Whether it is certain that no point within the depths of both photographs is in both."""
    for here, there in ((one, two), (two, one)):
        shown = _shown(here, here.whole, here.depths, there)
        if shown is None:
            return False
        pixels, depth = _project(shown, there)
        if (_inside(pixels, there) & (depth > there.depths.near) & (depth < there.depths.far)).any():
            return False
    return True


def parts_apart(one: Photograph, two: Photograph) -> tuple[Rectangle, Rectangle] | None:
    """The largest parts of two photographs that show nothing in common; None where they are small.

    The first is cut at one of a few places. Where the second may show anything of it, at any depth, is known then: the
    part of the second lies beyond.
    """
    largest, found = 0.0, None
    for axis in (0, 1):
        for cut in _CUTS:
            for below in (True, False):
                part = _side(one.size, axis, cut * one.size[axis], below)
                shown = _shown(one, part, Depths(one.depths.near, np.inf), two)
                if shown is None:
                    return None
                pixels, _ = _project(shown, two)
                margin = _MARGIN * max(two.size)
                place = pixels[_inside(pixels, two), axis]
                for low in (True, False):
                    length = two.size[axis]
                    edge = place.min(initial=length + margin) - margin if low else place.max(initial=-margin) + margin
                    share = min(cut if below else 1.0 - cut, edge / length if low else 1.0 - edge / length)
                    if share >= _CUTS[0] and share > largest:
                        largest, found = share, (part, _side(two.size, axis, edge, low))
    return found


def _side(size: tuple[int, int], axis: int, edge: float, below: bool) -> Rectangle:
    """What lies below ``edge`` along an axis (0 = x, 1 = y) of an image of this size, or beyond it."""
    rectangle = [0, 0, *size]
    rectangle[axis + 2 if below else axis] = round(edge)
    x0, y0, x1, y1 = rectangle
    return x0, y0, x1, y1


def scene_photographs(folder: Path, seed: int) -> list[Photograph]:
    """The photographs of a scene's folder whose depths are known.

    Raises:
        DatasetError: as :func:`benchmarks.photographs.read_scene`.
    """
    pairs = read_scene(folder, None, seed)
    cameras = {path: camera for pair in pairs for path, camera in zip(pair.paths, pair.cameras)}
    photographs = []
    for path, depths in sorted(measured_depths(pairs).items()):
        height, width = read_image(path).shape[:2]
        photographs.append(Photograph(path, cameras[path], (width, height), depths))
    return photographs


def _pair_of(place: str, photographs: tuple[Photograph, Photograph], parts: tuple[Rectangle, Rectangle]) -> PairApart:
    (image1, K1), (image2, K2) = (
        crop(read_image(photograph.path), photograph.camera.K, part) for photograph, part in zip(photographs, parts)
    )
    return PairApart(place, (image1, image2), (K1, K2), (photographs[0].camera.dist, photographs[1].camera.dist))


def scene_pairs(photographs: Sequence[Photograph], place: str, count: int, seed: int) -> dict[str, list[PairApart]]:
    """Of one scene, by kind, at most ``count`` pairs of whole photographs apart, and as many of parts of others."""
    whole: list[PairApart] = []
    parts: list[PairApart] = []
    pairs = list(combinations(photographs, 2))
    for row in np.random.default_rng(seed).permutation(len(pairs)):
        one, two = pairs[row]
        if are_apart(one, two):
            if len(whole) < count:
                whole.append(_pair_of(place, (one, two), (one.whole, two.whole)))
        elif len(parts) < count and (found := parts_apart(one, two)) is not None:
            parts.append(_pair_of(place, (one, two), found))
    return {"one place, whole photographs": whole, "one place, parts of photographs": parts}


def different_places(scenes: dict[str, list[Photograph]], count: int, seed: int) -> Iterator[PairApart]:
    """At most ``count`` pairs of photographs of two scenes."""
    pairs = [(a, b) for one, two in combinations(scenes, 2) for a in scenes[one] for b in scenes[two]]
    for row in np.random.default_rng(seed).permutation(len(pairs))[:count]:
        one, two = pairs[row]
        yield _pair_of("two", (one, two), (one.whole, two.whole))


def judge(pairs: Iterator[PairApart], settings: dict[Setting, MatchFilter]) -> dict[str, list[FilterResult]]:
    """What the filter of each setting says of the lists of pairs, by setting and kind of list."""
    detectors = {chosen: chosen.create_detector() for chosen in settings}
    answers: dict[str, list[FilterResult]] = {}
    for pair in tqdm(pairs, unit=" pairs", disable=None):
        for chosen, match_filter in settings.items():
            for kind, matches in lists_of(pair, detectors[chosen]):
                answers.setdefault(f"{chosen}, {kind}", []).append(match_filter.filter_many([matches])[0])
    return answers


SHOWN = (Status.OK, Status.PLANAR, Status.PURE_ROTATION, Status.LOW_SUPPORT)
HEADER = [
    "pairs",
    "matches",
    "lists",
    *(f"{status.value}, %" for status in SHOWN),
    "planar with E, %",
    f"confidence from {' · '.join(map(str, CONFIDENCE_LIMITS))}, %",
]
ALIGN = "ll" + "r" * (len(HEADER) - 2)


def row(kind: str, matches: str, results: Sequence[FilterResult]) -> list[str]:
    """Cells of a line: how often which status was given, and how often the filter was so sure of a pose."""
    counts = Counter(result.status for result in results)
    shares = [f"{100.0 * counts[status] / len(results):.1f}" for status in SHOWN]
    planar = sum(result.status is Status.PLANAR and result.E is not None for result in results)
    confidence = np.array([result.confidence or 0.0 for result in results])
    sure = " · ".join(f"{100.0 * np.mean(confidence >= limit):.1f}" for limit in CONFIDENCE_LIMITS)
    return [kind, matches, str(len(results)), *shares, f"{100.0 * planar / len(results):.1f}", sure]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("no_overlap", __doc__, per_scene=False)
    parser.add_argument("--scenes", nargs="+", default=[], type=Path, metavar="SCENE", help="photographs with cameras")
    parser.add_argument("--photos", type=Path, metavar="FOLDER", help="to be cut in two, and to render worlds of")
    parser.add_argument("--pairs", type=int, default=60, metavar="N", help="of each kind (default 60)")
    add_settings(parser, DEFAULT_SETTINGS)
    return run_study(run, parser.parse_args(arguments))


def sources(options: argparse.Namespace) -> Iterator[tuple[str, Iterator[PairApart]]]:
    """The pairs that the options ask for, by kind.

    Raises:
        DatasetError, PhotoError: a file or folder cannot be used.
    """
    scenes = {folder.name: scene_photographs(folder, options.seed) for folder in options.scenes}
    kinds: dict[str, list[PairApart]] = {}
    for name, photographs in scenes.items():
        for kind, pairs in scene_pairs(photographs, name, -(-options.pairs // len(scenes)), options.seed).items():
            kinds.setdefault(kind, []).extend(pairs)
    yield from ((kind, iter(pairs)) for kind, pairs in kinds.items())
    if len(scenes) > 1:
        yield "two places", different_places(scenes, options.pairs, options.seed)
    if options.photos is not None:
        yield "one photograph, two parts", parts_of_photographs(options.photos, options.pairs, options.seed)
        yield "rendered, one world", rendered_apart(options.photos, options.pairs, options.seed)


def run(options: argparse.Namespace) -> int:
    """Print the lines of each kind of pairs as it is measured."""
    settings = {chosen: chosen.match_filter(options.model, options.seed) for chosen in options.settings}
    print(markdown_head(HEADER, ALIGN))
    for kind, pairs in sources(options):
        for matches, results in sorted(judge(pairs, settings).items(), reverse=True):
            print(markdown_row(row(kind, matches, results)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
