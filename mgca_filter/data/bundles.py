"""Pairs of scene bundles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from .scene_bundle import SceneBundle, ScenePair, bundle_files
from .source import Image, check_pose, digest_files, read_image


@dataclass(frozen=True)
class BundleSource:
    """The pairs of one bundle file; at most two bundles are in memory at a time."""

    path: Path
    sha256: str
    count: int
    image_folder: Path | None = None

    @property
    def scene(self) -> str:
        return self.path.stem

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> ScenePair:
        pair = _bundle(self.path, self.sha256)[index]
        check_pose(pair.R, pair.t, f"{self.path}: pair {index}")
        return pair

    def images(self, pair: ScenePair) -> tuple[Image, Image] | None:
        """The photographs of the folder, or of its subfolder named like the scene, where both have the right size.

        A bundle's points are free of distortion and the photographs are not: lines end beside their points by that.
        """
        if self.image_folder is None:
            return None
        images = []
        for name, size in ((pair.image1, pair.image_size1), (pair.image2, pair.image_size2)):
            candidates = [self.image_folder / name, self.image_folder / self.scene / name]
            path = next((candidate for candidate in candidates if candidate.is_file()), None)
            image = None if path is None else read_image(path)
            if image is None or (image.shape[1], image.shape[0]) != size:
                return None
            images.append(image)
        return images[0], images[1]


@lru_cache(maxsize=2)
def _bundle(path: Path, sha256: str) -> SceneBundle:
    return SceneBundle(path)


def open_bundles(path: Path, images: Path | None = None) -> list[BundleSource]:
    """One source for each ``.npz`` of a folder, or for the one that ``path`` names; each is read once to check it.

    Raises:
        BundleError: there is none, or one is broken.
    """
    sources = []
    for file in bundle_files(path):
        digest = digest_files([file])
        sources.append(BundleSource(file, digest, len(_bundle(file, digest)), images))
    return sources
