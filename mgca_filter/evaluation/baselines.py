"""The rivals: a classical test of the matches, then a robust estimator of a public library.

Each runs at the threshold that is best for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..data.scene_bundle import ScenePair
from .estimators import Estimator
from .methods import MIN_MATCHES, Answer
from .selection import Selection

REVISION = 1
"""Part of every stored result's key: raise it when a change in this package alters what a rival gives."""


@dataclass(frozen=True)
class Rival:
    """A selection of matches followed by a robust estimator."""

    selection: Selection
    estimator: Estimator

    @property
    def name(self) -> str:
        return " + ".join([*(self.selection.parts or ["NN"]), self.estimator.name])

    @property
    def seeded(self) -> bool:
        return self.estimator.seeded

    def settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = {
            "revision": REVISION,
            "selection": self.selection.settings(),
            "estimator": self.estimator.settings(),
        }
        if self.selection.gms:
            settings |= {"opencv": cv2.__version__, "gms_points": "inside the image"}
        return settings

    def run(self, pair: ScenePair, seed: int) -> Answer:
        kept = self.selection.apply(pair)
        rows = np.flatnonzero(kept)
        mask = np.zeros(len(kept), dtype=bool)
        if len(rows) < MIN_MATCHES:
            return Answer(None, None, kept, mask, "fewer than 5 matches")
        if self.estimator.ordered:
            ratio = pair.attributes.ratio
            if ratio is None:
                raise ValueError(f"{self.estimator.name} needs the distance ratios of the matches")
            rows = rows[np.argsort(ratio[rows], kind="stable")]
        estimate = self.estimator.estimate(pair, rows, seed)
        mask[rows] = estimate.inliers
        return Answer(estimate.R, estimate.t, kept, mask, estimate.failure)
