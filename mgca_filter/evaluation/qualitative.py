"""Pictures of what methods keep: right matches green, wrong ones red, one strip for each method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..data.scene_bundle import ScenePair
from ..data.source import Image
from ..drawing import MatchPanel, draw_matches
from ..errors import DatasetError
from ..geometry.epipolar import pose_error_deg, symmetric_epipolar_distance_squared
from .methods import Method
from .metrics import FAILURE_DEG, TRUE_INLIER_DISTANCE_SQUARED
from .pairs import SceneSelection
from .predict import answer_pair

JPEG_QUALITY = 85
SOLVED_DEG = 5.0
"""Pose error below which a strip's mark is green."""


def draw_pairs(
    methods: Sequence[Method], selections: Sequence[SceneSelection], folder: str | Path, per_scene: int
) -> list[Path]:
    """Write ``SCENE_INDEX.jpg`` for ``per_scene`` pairs of each scene that has images; returns the files.

    Pairs lie evenly over a scene's selection. Drawn are the matches of each method's final mask.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for selection in selections:
        places = np.unique(np.linspace(0, len(selection) - 1, per_scene + 2)[1:-1].round().astype(int))
        for index in (selection.indices[place] for place in places):
            try:
                pair = selection.source[index]
                images = selection.source.images(pair)
            except DatasetError:
                continue  # listed with the figures
            if images is None:
                continue
            files.append(folder / f"{pair.scene}_{index}.jpg")
            picture = np.vstack([_strip(method, pair, images) for method in methods])
            cv2.imwrite(str(files[-1]), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return files


def _strip(method: Method, pair: ScenePair, images: tuple[Image, Image]) -> Image:
    answer = answer_pair(method, pair, 0)
    mask, error_deg = answer.mask, FAILURE_DEG
    if answer.R is not None and answer.t is not None:
        error_deg = pose_error_deg(answer.R, answer.t, pair.R, pair.t)
    distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
    right = distance[mask] < TRUE_INLIER_DISTANCE_SQUARED
    facts = [f"{np.count_nonzero(right)} right", f"{np.count_nonzero(~right)} wrong", f"pose error {error_deg:.1f} deg"]
    panel = MatchPanel(right, method.name, facts, success=error_deg < SOLVED_DEG, words=("right", "wrong"))
    return draw_matches(*images, pair.points1[mask], pair.points2[mask], panel)
