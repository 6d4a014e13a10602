"""Which pairs of which scenes are evaluated."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data import PairSource, open_sources
from ..data.scene_bundle import ScenePair
from ..errors import DatasetError

ALL_SCENES, ALL_PAIRS = "all", "pairs"
"""What rows of figures are called that are means over scenes and over pairs; no scene may have these names."""


@dataclass(frozen=True)
class SceneSelection:
    """The chosen pairs of one scene: ascending ``indices`` into its source."""

    source: PairSource
    indices: tuple[int, ...]

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return self.source.scene

    @property
    def sha256(self) -> str:
        """Digest of the data that the pairs come from."""
        return self.source.sha256

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
    paths: str | Path | Sequence[str | Path],
    scenes: Collection[str] | None = None,
    per_scene: int | None = None,
    seed: int = 0,
    *,
    data_format: str = "bundle",
    images: str | Path | None = None,
) -> list[SceneSelection]:
    """Choose pairs from every scene that the paths hold.

    What can be checked without reading every pair is checked here, so that a file that is broken stops a run before it
    starts. A pair that turns out broken later counts as a failure of every method.

    Args:
        paths: files or folders, as :func:`sources.open_sources` takes them; one or several.
        scenes: keep these scenes only; None keeps all.
        per_scene: cap on the pairs of a scene, at least 1; None takes all of them.
        seed: of the draw that the cap makes.
        data_format, images: as in :func:`sources.open_sources`.

    Raises:
        DatasetError: there is no scene, a wanted one is not there, one has the name of a mean, or a file is broken or
            holds no pair.
        ValueError: ``per_scene`` is below 1, or the format is unknown.
        ImportError: the package that reads the format is not installed.
    """
    if per_scene is not None and per_scene < 1:
        raise ValueError(f"per_scene must be at least 1 or None, got {per_scene}")
    listed = [paths] if isinstance(paths, (str, Path)) else list(paths)
    sources = open_sources(listed, data_format, images)
    for source in sources:
        if source.scene in (ALL_SCENES, ALL_PAIRS):
            raise DatasetError(f"{source.path}: a scene cannot be called {source.scene!r}, as a mean is; rename it")
    if scenes is not None:
        absent = sorted(set(scenes) - {source.scene for source in sources})
        if absent:
            raise DatasetError(f"{', '.join(map(str, listed))}: no scene named {', '.join(absent)}")
        sources = [source for source in sources if source.scene in set(scenes)]
    return [SceneSelection(s, draw_indices(len(s), s.scene, per_scene, seed)) for s in sources]


def iterate_pairs(selections: Sequence[SceneSelection]) -> Iterator[ScenePair]:
    """The chosen pairs, scene by scene."""
    for selection in selections:
        for index in selection.indices:
            yield selection.source[index]


def sample_pairs(selections: Sequence[SceneSelection], per_scene: int) -> list[ScenePair]:
    """At most ``per_scene`` pairs of each scene, evenly over its selection; what cannot be read is passed over."""
    pairs: list[ScenePair] = []
    for selection in selections:
        places = np.linspace(0, len(selection) - 1, min(per_scene, len(selection))).round().astype(int)
        for place in places:
            with suppress(DatasetError):  # listed among the failures
                pairs.append(selection.source[selection.indices[place]])
    return pairs
