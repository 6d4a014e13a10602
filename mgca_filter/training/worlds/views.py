"""Views of one world as a photographer would bring them home: images, keypoints, cameras that are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...features import ImageFeatures, create_detector, describe
from .cameras import Camera, draw_camera
from .imaging import add_passers_by, draw_light, photograph
from .photographs import PhotoFolder
from .rendering import paint
from .truth import visible_share
from .visibility import VisibilityMap, see
from .world import World, draw_world

OVERLAP = (0.06, 0.5)  # a drawn value between them is the least that a view shares with the first
TRIES = 24
THUMBNAIL = 1 / 16
NEAREST_ALLOWED = 0.08  # of the world's distance: nothing may stand right before the lens


@dataclass(frozen=True)
class View:
    """One rendered photograph: uint8 (H, W), its camera, its keypoints (SIFT) and what each pixel shows."""

    image: NDArray[np.uint8]
    camera: Camera
    features: ImageFeatures
    visible: VisibilityMap


def draw_views(rng: np.random.Generator, photos: PhotoFolder, count: int) -> list[View]:
    """``count`` views of one random world, each overlapping the first."""
    world, cameras = draw_scene(rng, count)
    focal_px = float(cameras[0].K[0, 0])
    return [_take(rng, world, camera, photos, focal_px) for camera in cameras]


def draw_scene(rng: np.random.Generator, count: int) -> tuple[World, list[Camera]]:
    """A world, and cameras whose views overlap the first one's and are not blocked."""
    while True:
        world = draw_world(rng)
        first = draw_camera(rng, world)
        thumbnail = first.shrunk(THUMBNAIL)
        seen = see(world, thumbnail)
        if is_free(seen, world):
            break
    cameras = [first]
    for _ in range(count - 1):
        wanted = rng.uniform(*OVERLAP)
        best, best_share = first, -1.0
        for _ in range(TRIES):
            camera = draw_camera(rng, world, first)
            other = camera.shrunk(THUMBNAIL)
            other_seen = see(world, other)
            if not is_free(other_seen, world):
                continue
            share = min(
                visible_share(thumbnail, other, seen, other_seen), visible_share(other, thumbnail, other_seen, seen)
            )
            if share > best_share:
                best, best_share = camera, share
            if share > wanted:
                break
        cameras.append(best)
    return world, cameras


def is_free(visible: VisibilityMap, world: World) -> bool:
    """Whether nothing stands right before the lens."""
    return float(np.percentile(visible.inverse_depth, 90)) * NEAREST_ALLOWED * world.distance < 1.0


def _take(rng: np.random.Generator, world: World, camera: Camera, photos: PhotoFolder, focal_px: float) -> View:
    visible = see(world, camera)
    image = paint(world, camera, visible, photos, focal_px, draw_light(rng, len(world.faces)))
    add_passers_by(rng, image, visible, photos)
    image = photograph(rng, image)
    return View(image, camera, replace(describe(image, create_detector()), K=camera.K), visible)
