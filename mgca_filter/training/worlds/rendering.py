"""Painting what a camera sees: each face is warped from the level of its photograph that fits its size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .cameras import Camera
from .photographs import LEVELS, PhotoFolder, Pyramid
from .visibility import SeenFace, VisibilityMap, inverse_depth
from .world import Face, World

FloatArray = NDArray[np.float64]

TEXELS_PER_PIXEL = (0.7, 2.5)  # at the target's distance
PLAIN_LEVEL, PLAIN_SPREAD = 3, 12.0  # a crop whose grey levels spread less, at this level, is sky or bare wall
CROP_TRIES = 3
HALF = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])  # one level up, centres of pixels at integers


@dataclass(frozen=True)
class Texture:
    """A crop of a photograph on a face: ``to_texture`` (3, 3) maps (a, b, 1) to pixels of the finest level."""

    pyramid: Pyramid
    to_texture: FloatArray


def face_texture(face: Face, world: World, photos: PhotoFolder, focal_px: float) -> Texture:
    """The picture of a face: which photograph, which crop, turned or mirrored, follows from the face's seed.

    Plain crops get a second and a third chance: photographs are half sky, what they are put on seldom is.
    """
    rng = np.random.default_rng(face.texture)
    texels_per_metre = focal_px / world.distance * np.exp(rng.uniform(*np.log(TEXELS_PER_PIXEL)))
    sides = texels_per_metre * np.array([np.linalg.norm(face.u), np.linalg.norm(face.v)])
    for _ in range(CROP_TRIES):
        texture = _draw_crop(rng, photos.pyramid(int(rng.integers(len(photos)))), sides)
        if _spread(texture) > PLAIN_SPREAD:
            break
    return texture


def _draw_crop(rng: np.random.Generator, pyramid: Pyramid, sides: FloatArray) -> Texture:
    """A crop of ``sides`` texels; a face larger than the photograph shows it enlarged rather than twice."""
    height, width = pyramid[0].shape
    swap = rng.random() < 0.15
    available = np.array([height, width] if swap else [width, height])
    crop = sides * min(1.0, float((available / sides).min()))
    start = rng.uniform(0.0, 1.0, 2) * (available - crop)
    A = np.array([[crop[0], 0, start[0] - 0.5], [0, crop[1], start[1] - 0.5], [0, 0, 1]])
    if rng.random() < 0.5:
        A = np.array([[-1, 0, available[0] - 1], [0, 1, 0], [0, 0, 1]]) @ A
    return Texture(pyramid, A[[1, 0, 2]] if swap else A)


def _spread(texture: Texture) -> float:
    """Standard deviation of the grey levels of a crop, on a small copy."""
    small = texture.pyramid[PLAIN_LEVEL]
    corners = texture.to_texture @ np.array([[0.0, 1.0], [0.0, 1.0], [1.0, 1.0]]) / 2**PLAIN_LEVEL
    (x0, x1), (y0, y1) = (np.sort(c).astype(int) for c in corners[:2])
    part = small[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1]
    return float(part.std()) if part.size else 0.0


def paint(
    world: World, camera: Camera, visible: VisibilityMap, photos: PhotoFolder, focal_px: float, light: FloatArray
) -> NDArray[np.uint8]:
    """Grey image (H, W) of a world.

    Args:
        world, camera, visible: the scene and ``see(world, camera)``.
        photos: pictures for the faces.
        focal_px: that of the world's first camera, so that a face wears the same crop in every view.
        light: factor (number of faces,) on the grey levels of each face.
    """
    image = np.zeros(visible.face.shape, dtype=np.uint8)
    for seen in visible.seen.values():
        mask = visible.face[seen.window] == seen.number
        if mask.any():
            tight = _tight(mask)
            window = tuple(slice(w.start + t.start, w.start + t.stop) for w, t in zip(seen.window, tight))
            texture = face_texture(world.faces[seen.number], world, photos, focal_px)
            part = SeenFace(seen.number, seen.to_face, (window[0], window[1]))
            _paint_face(image[window], mask[tight], part, texture, float(light[seen.number]))
    return image


def _tight(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(y, y + height), slice(x, x + width)


def _paint_face(
    target: NDArray[np.uint8], mask: NDArray[np.bool_], seen: SeenFace, texture: Texture, light: float
) -> None:
    """Warp the levels that the face needs, from near to far, into ``target`` (h, w) where ``mask`` is set."""
    to_texture = texture.to_texture @ seen.to_face
    # |d texture / d pixel| of this homography is |det| / w³ with w the inverse depth.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.maximum(inverse_depth(seen.to_face, seen.window), np.float32(1e-12))
        log_scale = np.float32(0.5 * np.log2(abs(np.linalg.det(to_texture)) + 1e-30)) - 1.5 * np.log2(inverse)
    level_map = np.clip(np.floor(log_scale + 0.5), 0, LEVELS - 1).astype(np.int8)
    shift = np.array([[1.0, 0, seen.window[1].start], [0, 1.0, seen.window[0].start], [0, 0, 1.0]])
    size = (target.shape[1], target.shape[0])
    used = np.bincount(level_map[mask], minlength=LEVELS)
    to_level = to_texture @ shift
    for level in range(LEVELS):
        if used[level]:
            warped = cv2.warpPerspective(
                texture.pyramid[level],
                to_level,
                size,
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REFLECT_101,
            )
            if light != 1.0:
                warped = cv2.convertScaleAbs(warped, alpha=light)
            np.copyto(target, warped, where=mask & (level_map == level))
        to_level = HALF @ to_level
