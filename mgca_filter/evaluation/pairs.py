"""Which pairs of which scene bundles are evaluated."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import BundleError
from ..scene_bundle import SceneBundle, ScenePair


@dataclass(frozen=True)
class SceneSelection:
    """The chosen pairs of one bundle file: ascending ``indices`` and the SHA-256 of the file they come from."""

    path: Path
    scene: str
    sha256: str
    indices: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.indices)


def draw_indices(count: int, scene: str, per_scene: int | None, seed: int) -> tuple[int, ...]:
    """Ascending indices of at most ``per_scene`` of ``count`` pairs, drawn without replacement (None = all).

    The draw depends on the scene's name and the seed alone, so that a scene keeps its pairs whatever other scenes
    stand beside it.
    """
    if per_scene is None or per_scene >= count:
        return tuple(range(count))
    generator = np.random.default_rng([seed, zlib.crc32(scene.encode())])
    return tuple(sorted(int(i) for i in generator.choice(count, size=per_scene, replace=False)))


def select_pairs(
    path: str | Path, scenes: Collection[str] | None = None, per_scene: int | None = None, seed: int = 0
) -> list[SceneSelection]:
    """Choose pairs from every bundle of a folder (or from the one file that ``path`` names), in order of the names.

    Each file is read once here, so that a broken bundle stops a run before it starts.

    Args:
        path: folder of ``.npz`` scene bundles, or one bundle.
        scenes: keep these scenes only; None keeps all.
        per_scene: cap on the pairs of a scene, at least 1; None takes all of them.
        seed: of the draw that the cap makes.

    Raises:
        BundleError: there is no bundle, a wanted scene is not there, or a file is broken or holds no pair.
        ValueError: ``per_scene`` is below 1.
    """
    if per_scene is not None and per_scene < 1:
        raise ValueError(f"per_scene must be at least 1 or None, got {per_scene}")
    path = Path(path)
    files = [path] if path.is_file() else sorted(path.glob("*.npz"))
    if not files:
        raise BundleError(f"{path}: no scene bundle (.npz) found")
    if scenes is not None:
        absent = sorted(set(scenes) - {file.stem for file in files})
        if absent:
            raise BundleError(f"{path}: no scene bundle named {', '.join(absent)}")
        files = [file for file in files if file.stem in set(scenes)]
    chosen = []
    for file in files:
        bundle = SceneBundle(file)
        if len(bundle) == 0:
            raise BundleError(f"{file}: holds no pair")
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        chosen.append(
            SceneSelection(file, bundle.scene, digest, draw_indices(len(bundle), bundle.scene, per_scene, seed))
        )
    return chosen


def iterate_pairs(selections: Sequence[SceneSelection]) -> Iterator[ScenePair]:
    """The chosen pairs, scene by scene, with one bundle in memory at a time."""
    for selection in selections:
        bundle = SceneBundle(selection.path)
        for index in selection.indices:
            yield bundle[index]
