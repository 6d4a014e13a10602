"""Pairs of photographs that show different places, matched as ``match_images`` matches them, and kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic_file import replaced_when_done
from ..data.source import detect, digest_files
from ..features import FEATURE_SETTINGS, match_features
from ..inputs.attributes import MatchAttributes
from ..inputs.pair import MatchPair

_SUFFIXES = (".jpg", ".jpeg", ".png")


def read_places(path: str | Path) -> list[set[str]]:
    """Groups of photographs of the same place: one group a line, names without suffix between blanks."""
    return [set(line.split()) for line in Path(path).read_text(encoding="utf-8").splitlines() if line.strip()]


def draw_unrelated(names: Sequence[str], places: Sequence[set[str]], count: int, seed: int) -> list[tuple[str, str]]:
    """At most ``count`` pairs of names, none from the same place, drawn without replacement and sorted."""
    pairs = [pair for pair in combinations(sorted(names), 2) if not any(set(pair) <= place for place in places)]
    chosen = np.random.default_rng(seed).permutation(len(pairs))[:count]
    return [pairs[i] for i in sorted(chosen)]


class PhotoFolder:
    """Photographs of a folder; the matches of each pair are computed once and kept under ``store``.

    Raises:
        ValueError: the folder holds fewer than two photographs (.jpg, .png).
    """

    def __init__(self, folder: str | Path, store: str | Path) -> None:
        self._paths = {path.stem: path for path in sorted(Path(folder).iterdir()) if path.suffix.lower() in _SUFFIXES}
        self._store = Path(store) / "matches"
        if len(self._paths) < 2:
            raise ValueError(f"{folder}: expected at least two photographs ({', '.join(_SUFFIXES)})")

    @property
    def names(self) -> list[str]:
        """File names without suffix, sorted."""
        return sorted(self._paths)

    def pair(self, name1: str, name2: str) -> MatchPair:
        """Raw matches of two photographs: pixels row by row, sizes, and what the matcher knew; no intrinsics.

        Raises:
            DatasetError: a file is no image.
        """
        paths = (self._paths[name1], self._paths[name2])
        file = self._store / f"{name1}.{name2}.{digest_files(paths, FEATURE_SETTINGS)[:16]}.npz"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            with replaced_when_done(file) as partial, partial.open("wb") as out:
                np.savez(out, **_matched_arrays(*paths))  # type: ignore[arg-type]  # its stub takes names for options
        with np.load(file, allow_pickle=False) as loaded:
            arrays = dict(loaded)
        points1, points2, size1, size2 = (arrays.pop(name) for name in ("points1", "points2", "image1", "image2"))
        return MatchPair(points1, points2, None, size1=size1, size2=size2, attributes=MatchAttributes(**arrays))


def _matched_arrays(path1: Path, path2: Path) -> dict[str, NDArray[Any]]:
    """Pixels (M, 2), the images' sizes, and the attributes that are known (M,), by name."""
    one, two = detect(path1), detect(path2)
    matches = match_features(one, two)
    return {
        "points1": one.points[matches.index1],
        "points2": two.points[matches.index2],
        "image1": np.array(one.image_size),
        "image2": np.array(two.image_size),
        **{name: values for name, values in asdict(matches.attributes).items() if values is not None},
    }
