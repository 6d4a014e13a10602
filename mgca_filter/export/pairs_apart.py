"""Two images of one place that show nothing in common: every pose that is found for them is wrong, certainly.

Repeated windows, arches and columns make matches agree where no point of the scene is seen twice. The poses that come
of them ruin maps (*doppelgangers*: Cai et al., ICCV 2023); photographs of different places hold nothing of the kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.source import read_image
from ..features import Detector, describe, match_features
from ..inputs.pair import MatchPair
from ..training.augmentation import rotation_matrix
from ..training.worlds.cameras import Camera, draw_camera
from ..training.worlds.imaging import draw_light, photograph
from ..training.worlds.photographs import PhotoFolder
from ..training.worlds.rendering import paint
from ..training.worlds.truth import visible_share
from ..training.worlds.views import is_free
from ..training.worlds.visibility import VisibilityMap, see
from ..training.worlds.world import World, draw_world

Array = NDArray[np.float64]
Rectangle = tuple[int, int, int, int]

CROSS_RATIO = 0.8
PLAUSIBLE_FOCAL_FACTOR = 0.9
_LEAST_MATCHES = 8
# Between the two parts of a photograph lies this share of its longer side: what a keypoint sees of its surroundings.
_GAP = 0.04
# Every second photograph is turned between its parts, by such angles (standard deviation), as another view would be.
_TURN_DEG = (4.0, 12.0, 6.0)
# In rendered worlds the second camera looks elsewhere by this much; how many are tried, on how small an image.
_ELSEWHERE_DEG, _TRIES, _THUMBNAIL = (30.0, 120.0), 24, 1 / 8


@dataclass(frozen=True)
class PairApart:
    """Two images without common surface.

    Attributes:
        place: what they show; pairs of one place belong together when samples are split.
        images: uint8 (H, W) or (H, W, 3).
        K: intrinsics (3, 3) of each. dist: its distortion coefficients, or None.
    """

    place: str
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    K: tuple[Array, Array]
    dist: tuple[Array | None, Array | None] = (None, None)


def plausible_camera(size: tuple[int, int]) -> Array:
    """Intrinsics (3, 3) that a photograph of this (width, height) may have."""
    focal = PLAUSIBLE_FOCAL_FACTOR * max(size)
    return np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])


def crop(image: NDArray[np.uint8], K: Array, rectangle: Rectangle) -> tuple[NDArray[np.uint8], Array]:
    """The part of an image from (x0, y0) to, and without, (x1, y1), and its intrinsics."""
    x0, y0, x1, y1 = rectangle
    shift = np.array([[0.0, 0.0, x0], [0.0, 0.0, y0], [0.0, 0.0, 0.0]])
    return np.ascontiguousarray(image[y0:y1, x0:x1]), K - shift


def parts_of_photographs(folder: Path, count: int, seed: int) -> Iterator[PairApart]:
    """Photographs of a folder, at most ``count``, each cut in two across its longer side; every second one turned.

    Raises:
        PhotoError: there is none. DatasetError: a file is no image.
    """
    rng = np.random.default_rng([seed, 0])
    paths = PhotoFolder.open(folder).paths
    for number, chosen in enumerate(rng.permutation(len(paths))[:count]):
        image = read_image(paths[chosen])
        height, width = image.shape[:2]
        K, gap = plausible_camera((width, height)), round(_GAP * max(width, height) / 2)
        if width >= height:
            parts = (0, 0, width // 2 - gap, height), (width // 2 + gap, 0, width, height)
        else:
            parts = (0, 0, width, height // 2 - gap), (0, height // 2 + gap, width, height)
        (one, K1), (two, K2) = (crop(image, K, part) for part in parts)
        if number % 2 == 1:
            two, K2 = _turned(two, K2, np.radians(rng.normal(0.0, _TURN_DEG)))
        yield PairApart(paths[chosen].stem, (one, two), (K1, K2))


def _turned(image: NDArray[np.uint8], K: Array, angles: Array) -> tuple[NDArray[np.uint8], Array]:
    """The image as a camera that first looks at its middle and then turns by angles (3,) about x, y, z would take it.

    What lies beyond its edges is mirrored: a plain edge would look alike in every image.
    """
    height, width = image.shape[:2]
    middle = np.linalg.inv(K) @ [(width - 1) / 2, (height - 1) / 2, 1.0]
    pitch, yaw = np.arctan2(middle[1], np.hypot(middle[0], 1.0)), np.arctan2(middle[0], 1.0)
    R = rotation_matrix(0, pitch) @ rotation_matrix(1, -yaw)
    for axis, angle in enumerate(angles):
        R = rotation_matrix(axis, angle) @ R
    K2 = K.copy()
    K2[:2, 2] = (width - 1) / 2, (height - 1) / 2
    H = K2 @ R @ np.linalg.inv(K)
    turned: Any = cv2.warpPerspective(image, H, (width, height), borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(turned, dtype=np.uint8), K2


def rendered_apart(folder: Path, count: int, seed: int) -> Iterator[PairApart]:
    """``count`` pairs of views of random worlds with the photographs of a folder on them, by depth without overlap.

    Raises:
        PhotoError: the folder holds no picture.
    """
    photos = PhotoFolder.open(folder)
    for number in range(count):
        rng = np.random.default_rng([seed, 1, number])
        world, cameras = _draw_scene_apart(rng)
        light = draw_light(rng, len(world.faces))
        focal_px = float(cameras[0].K[0, 0])
        one, two = (photograph(rng, paint(world, c, see(world, c), photos, focal_px, light)) for c in cameras)
        yield PairApart(f"world {number}", (one, two), (cameras[0].K, cameras[1].K))


def _draw_scene_apart(rng: np.random.Generator) -> tuple[World, tuple[Camera, Camera]]:
    """A world and two cameras, of which neither sees a point that the other one sees."""
    while True:
        world = draw_world(rng)
        first = draw_camera(rng, world)
        seen = _see_small(world, first)
        if not is_free(seen[1], world):
            continue
        for _ in range(_TRIES):
            camera = draw_camera(rng, world, first)
            turn = rotation_matrix(1, np.radians(rng.choice([-1.0, 1.0]) * rng.uniform(*_ELSEWHERE_DEG)))
            second = replace(camera, R=turn @ camera.R, t=turn @ camera.t)
            other = _see_small(world, second)
            if is_free(other[1], world) and not _share(seen, other) and not _share(other, seen):
                return world, (first, second)


def _see_small(world: World, camera: Camera) -> tuple[Camera, VisibilityMap]:
    small = camera.shrunk(_THUMBNAIL)
    return small, see(world, small)


def _share(one: tuple[Camera, VisibilityMap], two: tuple[Camera, VisibilityMap]) -> float:
    return visible_share(one[0], two[0], one[1], two[1])


def lists_of(pair: PairApart, detector: Detector) -> Iterator[tuple[str, MatchPair]]:
    """The raw one-way matches of a pair, and those that pass a cross-check and a ratio test; of eight and more."""
    one, two = (describe(image, detector) for image in pair.images)
    matches = match_features(one, two)
    ratio = matches.attributes.ratio
    if ratio is None or one.image_size is None or two.image_size is None:
        return
    for kind, kept in (
        ("raw", np.ones(len(matches.index1), dtype=bool)),
        ("cross and ratio", matches.mutual & (ratio < CROSS_RATIO)),
    ):
        count = np.count_nonzero(kept)
        if count < _LEAST_MATCHES:
            continue
        attributes = matches.attributes.take(kept)
        if kind != "raw":  # whoever filters tells of no lost alternatives
            attributes = replace(attributes, best=np.ones(count, dtype=bool))
        points = one.points[matches.index1[kept]], two.points[matches.index2[kept]]
        resolution = max(one.resolution, two.resolution)
        yield (
            kind,
            MatchPair(*points, None, *pair.K, *pair.dist, one.image_size, two.image_size, attributes, resolution),
        )
