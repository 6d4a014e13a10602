"""Image-free pairs: random points under two cameras, attributes drawn as real matches have them.

Cheap enough to be drawn by the thousand a second, and endless. Geometry is free of photographs; how the ratio,
size, angle and flags of right and wrong matches are distributed comes from
:mod:`mgca_filter.training.match_statistics`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.cameras import normalize_points
from ...geometry.epipolar import essential_from_pose, symmetric_epipolar_distance_squared
from ...inputs.attributes import MatchAttributes
from ..labels import IGNORED, NEGATIVE, NEGATIVE_DISTANCE, POSITIVE, POSITIVE_DISTANCE
from ..match_statistics import Difficulty, MatchStatistics
from ..pairs import TrainingPair
from ..worlds.cameras import Camera, draw_camera
from ..worlds.world import World

FloatArray = NDArray[np.float64]

MATCHES = 2000
CANDIDATE_POINTS = 3000
MINIMUM_RIGHT = 20
LOCATION_ERROR_PX = (0.3, 1.2)
COPIES = (0, 3)  # structures seen twice: their matches agree on a wrong displacement
COPY_SHARE = 0.15
NEAR_MISS_SHARE, NEAR_MISS_PX = 0.05, 30.0
MEDIAN_SIZE_PX, SIZE_SPREAD = 3.5, 0.6


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
