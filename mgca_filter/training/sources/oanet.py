"""Pairs of dumps in OANet's HDF5 format: YFCC100M and SUN3D as the field trains on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...data.oanet_hdf5 import OanetFile
from ...errors import DatasetError
from ...geometry.epipolar import essential_from_pose
from ..labels import epipolar_labels
from ..pairs import TrainingPair
from .bundles import MINIMUM_MATCHES


class OanetSource:
    """Draws every pair of a dump that has 32 matches or more with the same probability.

    Args:
        path: HDF5 file.
        labels: "clean", or "epipolar" as the papers of the family have them.

    Raises:
        DatasetError: the file cannot be read as a dump, or holds no pair with enough matches.
        ImportError: h5py is not installed.
    """

    def __init__(self, path: str | Path, labels: str = "clean") -> None:
        self.file = OanetFile(path)
        self.labels = labels
        counts = np.array([self.file.match_count(index) for index in range(len(self.file))])
        self.pairs = np.flatnonzero(counts >= MINIMUM_MATCHES)
        if len(self.pairs) == 0:
            raise DatasetError(f"{path}: xs: no pair with {MINIMUM_MATCHES} matches or more to train on")
        self.file.close()  # worker processes open it for themselves

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """A pair with its ratios and, as "best of the list", what its mutual neighbours tell."""
        pair = self.file[int(rng.choice(self.pairs))]
        known = None
        if self.labels == "epipolar":
            known = epipolar_labels(pair.correspondences, essential_from_pose(pair.R, pair.t))
        name = f"{self.file.path.stem}/{pair.index}"
        return TrainingPair(name, pair.correspondences, pair.R, pair.t, pair.attributes(), pair.mutual, known)
