"""Pairs of photographs that show different places, matched as ``match_images`` matches them, and kept on disk."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..correspondences import MatchAttributes
from ..keypoints import create_detector, detect_keypoints
from ..matching import match_descriptors, read_matches
from ..pair_input import MatchPair

# Part of the names of the stored files: to be raised when detection or matching changes.
_REVISION = 1
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
    """Photographs of a folder, with features and matches computed once and kept under ``store``.

    Raises:
        ValueError: the folder holds fewer than two photographs (.jpg, .png).
    """

    def __init__(self, folder: str | Path, store: str | Path) -> None:
        self._paths = {path.stem: path for path in sorted(Path(folder).iterdir()) if path.suffix.lower() in _SUFFIXES}
        self._store = Path(store)
        self._known: dict[str, dict[str, NDArray[Any]]] = {}
        if len(self._paths) < 2:
            raise ValueError(f"{folder}: expected at least two photographs ({', '.join(_SUFFIXES)})")

    @property
    def names(self) -> list[str]:
        """File names without suffix, sorted."""
        return sorted(self._paths)

    def pair(self, name1: str, name2: str) -> MatchPair:
        """Raw matches of two photographs: pixels row by row, sizes, and what the matcher knew; no intrinsics."""
        one, two = self._features(name1), self._features(name2)
        matches = self._matches(name1, name2, one, two)
        rows1, rows2 = matches["index1"], matches["index2"]
        attributes = MatchAttributes(
            ratio=matches["ratio"],
            best=matches["best"],
            size1=one["size"][rows1],
            size2=two["size"][rows2],
            angle1=one["angle"][rows1],
            angle2=two["angle"][rows2],
        )
        return MatchPair(
            one["points"][rows1],
            two["points"][rows2],
            None,
            size1=one["image_size"],
            size2=two["image_size"],
            attributes=attributes,
        )

    def _features(self, name: str) -> dict[str, NDArray[Any]]:
        if name not in self._known:
            self._known[name] = self._load_features(name)
        return self._known[name]

    def _load_features(self, name: str) -> dict[str, NDArray[Any]]:
        data = self._paths[name].read_bytes()
        path = self._store / "features" / f"{name}.{hashlib.sha256(data).hexdigest()[:16]}.{_REVISION}.npz"
        if path.exists():
            return _read_arrays(path)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f"{self._paths[name]}: not an image that OpenCV can decode")
        keypoints, descriptors = detect_keypoints(image, create_detector(), name)
        arrays: dict[str, NDArray[Any]] = {
            "points": np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2),
            "size": np.array([k.size for k in keypoints], dtype=np.float32),
            "angle": np.array([k.angle for k in keypoints], dtype=np.float32),
            # OpenCV's SIFT descriptors are whole numbers from 0 to 255, kept as float32.
            "descriptors": descriptors.astype(np.uint8),
            "image_size": np.array(image.shape[::-1]),
            "digest": np.array(path.stem),
        }
        _write_arrays(path, arrays)
        return arrays

    def _matches(
        self, name1: str, name2: str, one: dict[str, NDArray[Any]], two: dict[str, NDArray[Any]]
    ) -> dict[str, NDArray[Any]]:
        digest = hashlib.sha256(f"{one['digest']} {two['digest']}".encode()).hexdigest()[:16]
        path = self._store / "matches" / f"{name1}.{name2}.{digest}.npz"
        if path.exists():
            return _read_arrays(path)
        rows = match_descriptors(one["descriptors"].astype(np.float32), two["descriptors"].astype(np.float32))
        putative = read_matches(rows, len(one["points"]), len(two["points"]))
        count = len(putative)
        arrays: dict[str, NDArray[Any]] = {
            "index1": putative.index1.astype(np.int32),
            "index2": putative.index2.astype(np.int32),
            "ratio": np.full(count, np.nan, np.float32) if putative.ratio is None else putative.ratio,
            "best": np.zeros(count, bool) if putative.best is None else putative.best,
        }
        _write_arrays(path, arrays)
        return arrays


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _write_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Never leaves a file half written: runs are interrupted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes the names for options
    os.replace(temporary, path)
