"""Image pairs with true poses in SuperGlue's text format, one pair a line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..features import FEATURE_SETTINGS
from .scene_bundle import ScenePair
from .source import (
    Image,
    check_folder,
    check_intrinsics,
    check_pose,
    detect,
    digest_files,
    find_files,
    match_views,
    read_image,
)

VALUES_PER_LINE = 38
"""Two names, two rotation flags, K0 (9), K1 (9), T_0to1 (16)."""


@dataclass(frozen=True)
class _Entry:
    """One line: what it holds refers to the images as stored, before the turns that the flags ask for."""

    names: tuple[str, str]
    quarter_turns: tuple[int, int]
    intrinsics: tuple[NDArray[np.float64], NDArray[np.float64]]
    R: NDArray[np.float64]
    t: NDArray[np.float64]


@dataclass(frozen=True)
class PairListSource:
    """The pairs of one list; the scene is the file's name.

    The flags 0 … 3 say by how many quarter turns, counter-clockwise, an image is turned upright before detection
    (Sarlin et al., CVPR 2020, ``match_pairs.py``); intrinsics and pose are turned with it.
    """

    path: Path
    image_folder: Path
    lines: tuple[tuple[int, str], ...]
    sha256: str

    @property
    def scene(self) -> str:
        return self.path.stem

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, index: int) -> ScenePair:
        entry = self._entry(index)
        views, turns = [], []
        for name, count, K in zip(entry.names, entry.quarter_turns, entry.intrinsics):
            features = detect(self.image_folder / name, count)
            assert features.image_size is not None
            K, turn = turn_camera(K, features.image_size, count)
            views.append(replace(features, K=K))
            turns.append(turn)
        R, t = turns[1] @ entry.R @ turns[0].T, turns[1] @ entry.t
        return match_views(self.scene, index, entry.names, (views[0], views[1]), R, t)

    def images(self, pair: ScenePair) -> tuple[Image, Image] | None:
        """Both photographs, turned as the flags say."""
        entry = self._entry(pair.index)
        turned = [
            np.ascontiguousarray(np.rot90(read_image(self.image_folder / name), count))
            for name, count in zip(entry.names, entry.quarter_turns)
        ]
        return turned[0], turned[1]

    def _entry(self, index: int) -> _Entry:
        number, text = self.lines[index]
        return _parse_line(text, f"{self.path}: line {number}")


def turn_camera(
    K: NDArray[np.float64], turned_size: tuple[int, int], quarter_turns: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intrinsics (3, 3) after quarter turns of the image, counter-clockwise, and the camera's own turn (3, 3).

    ``turned_size`` is (width, height) after the turns. One turn takes pixel (x, y) of an image of width w to
    (y, w − 1 − x), and a point X of the camera's frame to Q X.
    """
    Q = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    width, height = turned_size if quarter_turns % 2 == 0 else turned_size[::-1]
    turn = np.eye(3)
    for _ in range(quarter_turns % 4):
        K = np.array([[K[1, 1], 0.0, K[1, 2]], [0.0, K[0, 0], width - 1.0 - K[0, 2]], [0.0, 0.0, 1.0]])
        width, height = height, width
        turn = Q @ turn
    return K, turn


def _parse_line(text: str, where: str) -> _Entry:
    words = text.split()
    if len(words) != VALUES_PER_LINE:
        raise DatasetError(
            f"{where}: {len(words)} values instead of {VALUES_PER_LINE} (two names, two rotations, K0, K1, T_0to1)"
        )
    try:
        turns = (int(words[2]), int(words[3]))
        values = np.array([float(word) for word in words[4:]])
    except ValueError as error:
        raise DatasetError(f"{where}: {error}") from error
    if not all(0 <= turn <= 3 for turn in turns):
        raise DatasetError(f"{where}: rotation flags must be 0 … 3, got {turns[0]} and {turns[1]}")
    K0, K1, T = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:].reshape(4, 4)
    check_intrinsics(K0, f"{where}: K0")
    check_intrinsics(K1, f"{where}: K1")
    if not np.array_equal(T[3], [0, 0, 0, 1]):
        raise DatasetError(f"{where}: the last row of T_0to1 is {T[3].tolist()} instead of 0 0 0 1")
    check_pose(T[:3, :3], T[:3, 3], f"{where}: T_0to1")
    return _Entry((words[0], words[1]), turns, (K0, K1), T[:3, :3], T[:3, 3])


def open_pair_lists(path: Path, images: Path | None = None) -> list[PairListSource]:
    """One source for each ``.txt`` of a folder, or for the file that ``path`` names; images beside the list by default.

    Raises:
        DatasetError: there is none, it is no text, or none of its lines is a pair with its pose.
    """
    return [_open_list(file, images) for file in find_files(path, (".txt",), "list of pairs")]


def _open_list(file: Path, images: Path | None) -> PairListSource:
    try:
        content = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file}: cannot be read as text ({error})") from error
    lines = tuple((number, line) for number, line in enumerate(content.splitlines(), 1) if line.strip())
    folder = file.parent if images is None else images
    names = sorted({word for _, line in lines for word in line.split()[:2]})
    if lines and all(len(line.split()) != VALUES_PER_LINE for _, line in lines):
        _parse_line(lines[0][1], f"{file}: line {lines[0][0]}")  # raises: another format altogether
    check_folder(folder, names, str(file))
    digest = digest_files([file, *(folder / name for name in names)], FEATURE_SETTINGS)
    return PairListSource(file, folder, lines, digest)
