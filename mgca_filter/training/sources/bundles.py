"""Pairs of scene bundles: real photographs with poses, or worlds rendered beforehand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...data.bundle_writer import LABEL_FIELD
from ...data.scene_bundle import SceneBundle, ScenePair
from ...errors import BundleError
from ..labels import epipolar_labels
from ..pairs import TrainingPair

MINIMUM_MATCHES = 32  # pairs with fewer would cut their whole batch down
HOLDOUT_REMAINDER = 7


def is_held_out(pair_index: int, holdout_every: int) -> bool:
    """Whether a pair of a training scene is kept for known-scene validation."""
    return holdout_every > 0 and pair_index % holdout_every == HOLDOUT_REMAINDER % holdout_every


def check_pairs(bundle: SceneBundle) -> None:
    """Refuse a bundle with pairs that have no epipolar geometry or share nothing.

    Raises:
        BundleError: two images of a pair have the same centre, or ``covisible`` says that they do not overlap.
    """
    with np.load(bundle.path, allow_pickle=False) as data:
        pair, R, t, covisible = (data[field] for field in ("pair", "R", "t", "covisible"))
    centres = -np.einsum("nji,nj->ni", R, t)
    baseline = np.linalg.norm(centres[pair[:, 0]] - centres[pair[:, 1]], axis=1)
    for field, wrong, meaning in (
        (
            "t",
            baseline <= 1e-9 * (1.0 + np.linalg.norm(centres, axis=1).max(initial=0.0)),
            "both images have one centre",
        ),
        ("covisible", covisible == 0, "the images share nothing"),
    ):
        if wrong.any():
            raise BundleError(f"{bundle.path}: {field}: pair {int(np.flatnonzero(wrong)[0])}: {meaning}")


class BundleSource:
    """Draws a scene with weight pairs ** ``scene_exponent``, then a pair of it that is not held out.

    Args:
        bundles: at least one.
        scene_exponent, holdout_every: as in :class:`mgca_filter.training.sampling.SamplingConfig`.
        labels: "clean" or "epipolar"; a bundle that holds its own labels keeps them.

    Raises:
        BundleError: no pair has 32 matches or more.
    """

    def __init__(
        self,
        bundles: Sequence[SceneBundle],
        scene_exponent: float = 0.5,
        holdout_every: int = 0,
        labels: str = "clean",
    ) -> None:
        self.bundles = list(bundles)
        self.labels = labels
        self.known_labels = [_known_labels(bundle) for bundle in self.bundles]
        self.pairs = [
            [
                index
                for index, count in enumerate(bundle.match_counts())
                if count >= MINIMUM_MATCHES and not is_held_out(index, holdout_every)
            ]
            for bundle in self.bundles
        ]
        sizes = np.array([len(pairs) for pairs in self.pairs], dtype=np.float64)
        if not sizes.any():
            raise BundleError(f"no pair with {MINIMUM_MATCHES} matches or more to train on")
        weights = np.where(sizes > 0, np.maximum(sizes, 1.0) ** scene_exponent, 0.0)
        self.scene_probability = weights / weights.sum()

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        """Scene first, then a pair of it."""
        scene = int(rng.choice(len(self.bundles), p=self.scene_probability))
        return self.pair(scene, int(rng.choice(self.pairs[scene])))

    def pair(self, scene: int, index: int) -> TrainingPair:
        """Pair ``index`` of bundle ``scene``."""
        found = self.bundles[scene][index]
        known = self.known_labels[scene]
        return _training_pair(found, self.labels, None if known is None else known[index])


def _training_pair(pair: ScenePair, labels: str, known: NDArray[np.int8] | None) -> TrainingPair:
    if known is None and labels == "epipolar":
        known = epipolar_labels(pair.correspondences, pair.E)
    return TrainingPair(pair.name, pair.correspondences, pair.R, pair.t, pair.attributes, pair.mutual, known)


def _known_labels(bundle: SceneBundle) -> list[NDArray[np.int8]] | None:
    """Labels of each pair that the bundle itself holds, or None."""
    with np.load(bundle.path, allow_pickle=False) as data:
        if LABEL_FIELD not in data.files:
            return None
        labels = np.asarray(data[LABEL_FIELD], dtype=np.int8)
    counts = bundle.match_counts()
    if labels.shape != (counts.sum(),):
        raise BundleError(f"{bundle.path}: {LABEL_FIELD} has the shape {labels.shape} instead of {(counts.sum(),)}")
    return np.split(labels, np.cumsum(counts)[:-1])
