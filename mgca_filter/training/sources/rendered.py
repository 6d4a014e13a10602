"""Pairs of worlds that are rendered when they are asked for: endless, and as slow as SIFT.

A pair costs about half a second of one core. Where training is faster than that, render beforehand
(``python -m mgca_filter.training.render``) and read the bundle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..pairs import TrainingPair
from ..sift import match_attributes
from ..worlds.photographs import PhotoFolder
from ..worlds.view_pairs import match_views
from ..worlds.views import draw_views


class RenderedSource:
    """Worlds made of the photographs of a folder.

    Raises:
        PhotoError: the folder holds no photograph, or one of them cannot be read.
    """

    def __init__(self, folder: str | Path) -> None:
        self.photos = PhotoFolder.open(folder)
        for index in range(len(self.photos)):
            self.photos.check(index)

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """Two views of a random world; another world where too little of it matches."""
        while True:
            pair = match_views(*draw_views(rng, self.photos, 2))
            if pair.usable:
                break
        attributes = match_attributes(pair.view1.features, pair.view2.features, pair.matches)
        return TrainingPair(
            "rendered", pair.correspondences, pair.R, pair.t, attributes, pair.matches.mutual, pair.labels
        )
