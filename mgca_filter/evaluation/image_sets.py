"""Images with known cameras, to be detected on anew: photographs of a scene bundle, and rendered worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import SceneBundle, ScenePair
from ..data.source import Image, check_folder, match_views, read_image
from ..features import describe
from ..training.worlds.photographs import PhotoFolder
from ..training.worlds.view_pairs import match_views as match_rendered
from ..training.worlds.views import draw_views

Array = NDArray[np.float64]


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

    def matched(self, detector: cv2.Feature2D) -> list[ScenePair]:
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
