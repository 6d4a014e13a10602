"""Image-free pairs: random points under two cameras, attributes drawn as real matches have them.

Cheap enough to be drawn by the thousand a second, and endless. Geometry is free of photographs; how the ratio, size,
angle and flags of right and wrong matches are distributed was measured on scene bundles:
``python -m mgca_filter.training.synthetic BUNDLES OUT.json`` wrote ``match_statistics.json``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair, load_scene_bundles
from ..geometry.cameras import normalize_points
from ..geometry.epipolar import essential_from_pose, symmetric_epipolar_distance_squared
from ..inputs.attributes import MatchAttributes
from .pairs import IGNORED, NEGATIVE, NEGATIVE_DISTANCE, POSITIVE, POSITIVE_DISTANCE, TrainingPair, clean_labels
from .worlds.cameras import Camera, draw_camera
from .worlds.world import World

FloatArray = NDArray[np.float64]

MATCHES = 2000
CANDIDATE_POINTS = 3000
MINIMUM_RIGHT = 20
LOCATION_ERROR_PX = (0.3, 1.2)
COPIES = (0, 3)  # structures seen twice: their matches agree on a wrong displacement
COPY_SHARE = 0.15
NEAR_MISS_SHARE, NEAR_MISS_PX = 0.05, 30.0
MEDIAN_SIZE_PX, SIZE_SPREAD = 3.5, 0.6

SHIPPED = Path(__file__).with_name("match_statistics.json")
QUANTILES = 21
DIFFICULTIES = 4  # groups of pairs, by their share of right matches
PAIRS_PER_SCENE = 12
STATES = ("neither", "best", "mutual")  # best of the list implied by mutual


@dataclass(frozen=True)
class Points:
    """Points seen by both cameras: pixels (V, 2) in each, and log2 of the true ratio of sizes (V,)."""

    pixels1: FloatArray
    pixels2: FloatArray
    log_scale: FloatArray


class SyntheticSource:
    """Random pairs of 2000 matches."""

    def __init__(self, statistics: MatchStatistics | None = None) -> None:
        self.statistics = MatchStatistics.load() if statistics is None else statistics

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """Difficulty first, then cameras and points, then matches."""
        difficulty = self.statistics.draw(rng)
        world = World("points", (), np.array([0.0, 0.0, 1.0]), 1.0, enclosed=False)
        while True:
            first = draw_camera(rng, world)
            second = draw_camera(rng, world, first)
            points = _draw_points(rng, first, second)
            if len(points.pixels1) >= MINIMUM_RIGHT:
                break
        count = int(np.clip(difficulty.draw_right_share(rng) * MATCHES, MINIMUM_RIGHT, len(points.pixels1)))
        return _match(rng, difficulty, (first, second), points, count)


def _draw_points(rng: np.random.Generator, first: Camera, second: Camera) -> Points:
    """Points on a few planes, one for each region of image 1, more or less rough, that image 2 sees as well."""
    pixels = _draw_pixels(rng, first.size, CANDIDATE_POINTS)
    regions = int(rng.integers(1, 9))
    centres = rng.uniform([0, 0], first.size, (regions, 2))
    region = np.linalg.norm(pixels[:, None] - centres, axis=2).argmin(1)
    x = normalize_points(pixels, first.K)
    slope, inverse = rng.normal(0.0, 0.5, (regions, 2)), np.exp(rng.normal(0.0, 0.4, regions))
    inverse_depth = np.maximum(inverse[region] * (1.0 + np.sum(slope[region] * x, axis=1)), 0.05)
    depth = np.exp(rng.normal(0.0, rng.choice([0.0, 0.02, 0.3]), len(x))) / inverse_depth
    X = (first.rays(pixels) * depth[:, None] - first.t) @ first.R
    moved, depth2 = second.project(X)
    seen = (depth2 > 0) & (moved > 0).all(1) & (moved < second.size).all(1)
    scale = second.K[0, 0] * depth[seen] / (first.K[0, 0] * depth2[seen])
    return Points(pixels[seen], moved[seen], np.log2(scale))


def _draw_pixels(rng: np.random.Generator, size: tuple[int, int], count: int) -> FloatArray:
    """Keypoints (count, 2): half of them in clusters."""
    centres = rng.uniform([0, 0], size, (12, 2))
    clustered = centres[rng.integers(12, size=count)] + rng.normal(0.0, 0.06 * max(size), (count, 2))
    inside = (clustered > 0).all(1) & (clustered < size).all(1) & (rng.random(count) < 0.5)
    return np.where(inside[:, None], clustered, rng.uniform([0, 0], size, (count, 2)))


def _match(
    rng: np.random.Generator, difficulty: Difficulty, cameras: tuple[Camera, Camera], points: Points, count: int
) -> TrainingPair:
    """``count`` right matches among 2000."""
    first, second = cameras
    rows = rng.permutation(len(points.pixels1))
    right, rest = rows[:count], rows[count:]
    wrong_count = MATCHES - count
    location_error = rng.uniform(*LOCATION_ERROR_PX)
    wrong1, wrong2 = _wrong_matches(rng, cameras, points, rest, wrong_count)
    pixels1 = np.vstack([points.pixels1[right], wrong1])
    pixels2 = np.vstack([points.pixels2[right] + rng.normal(0.0, location_error, (count, 2)), wrong2])
    is_right = np.arange(MATCHES) < count
    drawn = difficulty.draw_matches(rng, is_right)
    pixels2 = _share_keypoints(rng, pixels2, drawn.best, is_right)
    size1 = MEDIAN_SIZE_PX * np.exp(rng.normal(0.0, SIZE_SPREAD, MATCHES))
    log_size = drawn.log_size
    log_size[:count] += points.log_scale[right]
    R = second.R @ first.R.T
    turn_deg = np.where(is_right, np.degrees(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])), 0.0) + drawn.turn_deg
    angle1 = rng.uniform(0.0, 360.0, MATCHES)
    attributes = MatchAttributes(
        ratio=drawn.ratio.astype(np.float32),
        best=drawn.best,
        size1=size1.astype(np.float32),
        size2=(size1 * 2.0**log_size).astype(np.float32),
        angle1=angle1.astype(np.float32),
        angle2=((angle1 + turn_deg) % 360.0).astype(np.float32),
    )
    x = np.hstack([normalize_points(pixels1, first.K), normalize_points(pixels2, second.K)])
    t = second.t - R @ first.t
    order = rng.permutation(MATCHES)
    labels = _labels(x, essential_from_pose(R, t), is_right)
    return TrainingPair("synthetic", x[order], R, t, attributes.take(order), drawn.mutual[order], labels[order])


def _wrong_matches(
    rng: np.random.Generator, cameras: tuple[Camera, Camera], points: Points, rest: NDArray[np.intp], count: int
) -> tuple[FloatArray, FloatArray]:
    """Wrong matches (count, 2), (count, 2): anywhere, near the right place, or on the copy of a structure."""
    pixels1 = _draw_pixels(rng, cameras[0].size, count)
    pixels2 = _draw_pixels(rng, cameras[1].size, count)
    if len(rest) == 0:
        return pixels1, pixels2
    origin = rng.choice(rest, count)
    kind = rng.random(count)
    near = kind < NEAR_MISS_SHARE
    pixels1[near] = points.pixels1[origin[near]]
    pixels2[near] = points.pixels2[origin[near]] + rng.normal(0.0, NEAR_MISS_PX, (np.count_nonzero(near), 2))
    copies = int(rng.integers(COPIES[0], COPIES[1] + 1))
    for number in range(copies):
        low = NEAR_MISS_SHARE + number * COPY_SHARE / COPIES[1]
        copied = (kind >= low) & (kind < low + COPY_SHARE / COPIES[1])
        offset = rng.normal(0.0, 0.2 * max(cameras[1].size), 2)
        pixels1[copied] = points.pixels1[origin[copied]]
        pixels2[copied] = points.pixels2[origin[copied]] + offset + rng.normal(0, 1, (np.count_nonzero(copied), 2))
    return pixels1, pixels2


def _share_keypoints(
    rng: np.random.Generator, pixels2: FloatArray, best: NDArray[np.bool_], is_right: NDArray[np.bool_]
) -> FloatArray:
    """A wrong match that is not best of the list reaches a keypoint that some better match reaches too."""
    out = pixels2.copy()
    losers, winners = np.flatnonzero(~best & ~is_right), np.flatnonzero(best)
    if len(losers) and len(winners):
        out[losers] = pixels2[rng.choice(winners, len(losers))]
    return out


def _labels(x: FloatArray, E: FloatArray, is_right: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Right matches within 1.5e-5 count as right, wrong ones as wrong unless they pass for right at 1e-4."""
    distance = symmetric_epipolar_distance_squared(x, E)
    labels = np.full(len(x), IGNORED, dtype=np.int8)
    labels[~is_right & (distance > NEGATIVE_DISTANCE)] = NEGATIVE
    labels[is_right & (distance < POSITIVE_DISTANCE)] = POSITIVE
    return labels


@dataclass(frozen=True)
class ClassStatistics:
    """Right or wrong matches: shares and ratio quantiles of the three states, quantiles of size and angle.

    ``log_size`` = log2 of the ratio of sizes and ``turn_deg`` = difference of angles; of right matches what is
    left when the pair's median is taken away.
    """

    state_share: tuple[float, ...]
    ratio: tuple[tuple[float, ...], ...]
    log_size: tuple[float, ...]
    turn_deg: tuple[float, ...]


@dataclass(frozen=True)
class DrawnMatches:
    """Attributes of matches, (M,) each."""

    ratio: FloatArray
    best: NDArray[np.bool_]
    mutual: NDArray[np.bool_]
    log_size: FloatArray
    turn_deg: FloatArray


@dataclass(frozen=True)
class Difficulty:
    """Pairs with about the same share of right matches."""

    right_share: tuple[float, ...]
    right: ClassStatistics
    wrong: ClassStatistics

    def draw_right_share(self, rng: np.random.Generator) -> float:
        """Share of right matches of a pair."""
        return float(_from_quantiles(rng, self.right_share, 1)[0])

    def draw_matches(self, rng: np.random.Generator, is_right: NDArray[np.bool_]) -> DrawnMatches:
        """Attributes of matches of which ``is_right`` (M,) are right."""
        parts = [
            _draw_class(rng, statistics, int(np.count_nonzero(rows)))
            for statistics, rows in ((self.right, is_right), (self.wrong, ~is_right))
        ]
        merged = np.zeros((4, len(is_right)))
        merged[:, is_right], merged[:, ~is_right] = parts
        ratio, state, log_size, turn_deg = merged
        return DrawnMatches(ratio, state >= STATES.index("best"), state == STATES.index("mutual"), log_size, turn_deg)


@dataclass(frozen=True)
class MatchStatistics:
    """Groups of pairs by difficulty, as frequent as each other."""

    difficulties: tuple[Difficulty, ...]

    def draw(self, rng: np.random.Generator) -> Difficulty:
        """One of the difficulties."""
        return self.difficulties[int(rng.integers(len(self.difficulties)))]

    @classmethod
    def load(cls, path: Path = SHIPPED) -> MatchStatistics:
        """Read a file that the command wrote; the package's own unless told otherwise."""
        groups = json.loads(path.read_text(encoding="utf-8"))["difficulties"]
        return cls(
            tuple(Difficulty(tuple(g["right_share"]), _read_class(g["right"]), _read_class(g["wrong"])) for g in groups)
        )

    def save(self, path: Path) -> None:
        """Write all tables as JSON."""
        path.write_text(json.dumps(asdict(self)) + "\n", encoding="utf-8")


def _read_class(values: dict[str, list[Any]]) -> ClassStatistics:
    ratio = tuple(tuple(quantiles) for quantiles in values["ratio"])
    return ClassStatistics(tuple(values["state_share"]), ratio, tuple(values["log_size"]), tuple(values["turn_deg"]))


def _from_quantiles(rng: np.random.Generator, quantiles: Sequence[float], count: int) -> FloatArray:
    """Numbers (count,) whose distribution has equally spaced ``quantiles``."""
    return np.interp(rng.random(count), np.linspace(0.0, 1.0, len(quantiles)), quantiles)


def _draw_class(rng: np.random.Generator, statistics: ClassStatistics, count: int) -> FloatArray:
    """Ratio, state, log size and turn (4, count)."""
    share = np.array(statistics.state_share)
    state = rng.choice(len(STATES), count, p=share / share.sum())
    ratio = np.zeros(count)
    for number, quantiles in enumerate(statistics.ratio):
        ratio[state == number] = _from_quantiles(rng, quantiles, int(np.count_nonzero(state == number)))
    log_size, turn = (_from_quantiles(rng, q, count) for q in (statistics.log_size, statistics.turn_deg))
    return np.stack([ratio, state, log_size, turn])


def measure(pairs: Sequence[ScenePair]) -> MatchStatistics:
    """Statistics of real pairs."""
    labels = [clean_labels(pair) for pair in pairs]
    share = np.array([np.mean(l == POSITIVE) for l in labels])
    usable = np.flatnonzero([np.count_nonzero(l == POSITIVE) >= 16 for l in labels])
    groups = np.array_split(usable[np.argsort(share[usable])], DIFFICULTIES)
    return MatchStatistics(
        tuple(
            Difficulty(
                _quantiles(share[group]),
                *(
                    _measure_class([(pairs[i], labels[i] == kind) for i in group], kind)
                    for kind in (POSITIVE, NEGATIVE)
                ),
            )
            for group in groups
        )
    )


def _measure_class(members: Sequence[tuple[ScenePair, NDArray[np.bool_]]], kind: int) -> ClassStatistics:
    ratio, state, log_size, turn = (
        np.concatenate(column) for column in zip(*(_attributes(pair, rows, kind) for pair, rows in members))
    )
    return ClassStatistics(
        tuple(float(np.mean(state == number)) for number in range(len(STATES))),
        tuple(_quantiles(ratio[state == number]) for number in range(len(STATES))),
        _quantiles(log_size),
        _quantiles(turn),
    )


def _attributes(pair: ScenePair, rows: NDArray[np.bool_], kind: int) -> tuple[FloatArray, ...]:
    """Ratio, state, log size and turn of some matches of a pair."""
    attributes = pair.attributes.take(rows)
    ratio, best, size1, size2, angle1, angle2 = (
        np.asarray(getattr(attributes, name), dtype=np.float64)
        for name in ("ratio", "best", "size1", "size2", "angle1", "angle2")
    )
    log_size, turn = np.log2(size2 / size1), angle2 - angle1
    if kind == POSITIVE:
        log_size = log_size - np.median(log_size)
        turn = turn - np.degrees(np.angle(np.mean(np.exp(1j * np.radians(turn)))))
    state = np.where(pair.mutual[rows], STATES.index("mutual"), best)
    return ratio, state, log_size, (turn + 180.0) % 360.0 - 180.0


def _quantiles(values: FloatArray) -> tuple[float, ...]:
    if len(values) == 0:  # a state that no match is in: never drawn
        return (0.0,) * QUANTILES
    return tuple(round(float(q), 4) for q in np.quantile(values, np.linspace(0.0, 1.0, QUANTILES)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all bundles of a folder, a dozen pairs of each."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.training.synthetic", description=__doc__)
    parser.add_argument("bundles", type=Path, help="folder of scene bundles")
    parser.add_argument("out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    pairs = []
    for bundle in load_scene_bundles(options.bundles):
        chosen = np.unique(np.linspace(0, len(bundle) - 1, PAIRS_PER_SCENE).astype(int))
        pairs += [bundle[int(index)] for index in chosen]
    measure(pairs).save(options.out)


if __name__ == "__main__":
    main()
