"""What every data source hands over: one pair of images as matches, true pose and labels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import essential_from_pose
from ..inputs.attributes import MatchAttributes
from .labels import clean_labels

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingPair:
    """One-way matches of a pair of images.

    Attributes:
        name: source, scene and number, for messages.
        correspondences: (M, 4) on the normalised image planes.
        R, t: relative pose, X2 = R X1 + t; the scale of ``t`` (3,) may be unknown.
        attributes: what the matcher knew.
        mutual: (M,) two-way nearest neighbours.
        known_labels: (M,) int8 where the source knows them; None = they are told from pose and depth.
    """

    name: str
    correspondences: FloatArray
    R: FloatArray
    t: FloatArray
    attributes: MatchAttributes
    mutual: NDArray[np.bool_]
    known_labels: NDArray[np.int8] | None = None

    def __len__(self) -> int:
        return len(self.correspondences)

    @cached_property
    def E(self) -> FloatArray:
        """True essential matrix (3, 3) of unit Frobenius norm."""
        return essential_from_pose(self.R, self.t)

    @cached_property
    def labels(self) -> NDArray[np.int8]:
        """1 = right, 0 = wrong, −1 = left out of the loss, (M,)."""
        return clean_labels(self) if self.known_labels is None else self.known_labels
