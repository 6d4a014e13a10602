"""Poses that unlike detectors contradict: ``python -m benchmarks.doubted_labels FOLDER [FOLDER ...]``.

The true poses of real scenes are those of a reconstruction, and now and then one is wrong: a repeated facade, an image
that slipped. Then every good answer counts as a bad one. A pair's label is in doubt where the filtered matches of at
least three detectors agree on another pose, each by PoseLib alone, and each explains twice as many of its matches by it
as by the label. The filter has no part in that.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.baselines import PoseLibEstimator
from mgca_filter.evaluation.methods import MIN_MATCHES
from mgca_filter.geometry.cameras import mean_focal_length
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg, sampson_distance
from mgca_filter.tables import render_table

from .match_lists import KINDS, DetectorScene, open_detector_scenes
from .study import run_study, study_parser

ESTIMATOR = PoseLibEstimator(1.0, max_iterations=10_000)
OFF_DEG, AGREE_DEG, DETECTORS = 10.0, 5.0, 3
"""A vote is this far from the label; so many detectors vote alike, within so many degrees."""
EXPLAINED_PX, LEAST_EXPLAINED, FACTOR = 1.0, 15, 2.0
"""A vote explains so many matches within so many pixels, and so many times as many as the label does."""

PairName = tuple[str, str, str]
"""Scene and both images."""


@dataclass(frozen=True)
class Vote:
    """What one detector's matches say of a pair.

    Attributes:
        detector: whose. R: (3, 3). t: (3,) unit norm.
        off_deg: from the label, degrees.
        explained, by_label: how many matches agree with this pose, and with the label.
    """

    detector: str
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    off_deg: float
    explained: int
    by_label: int

    @classmethod
    def of(cls, detector: str, pair: ScenePair) -> Vote | None:
        """PoseLib's on a list; None where it finds no pose."""
        if len(pair.points1) < MIN_MATCHES:
            return None
        estimate = ESTIMATOR.estimate(pair, np.arange(len(pair.points1)), seed=0)
        if estimate.R is None or estimate.t is None:
            return None
        reach = EXPLAINED_PX / mean_focal_length(pair.K1, pair.K2)
        explained, by_label = (
            int(np.count_nonzero(sampson_distance(pair.correspondences, essential_from_pose(R, t)) < reach))
            for R, t in ((estimate.R, estimate.t), (pair.R, pair.t))
        )
        off_deg = pose_error_deg(estimate.R, estimate.t, pair.R, pair.t)
        return cls(detector, estimate.R, estimate.t, off_deg, explained, by_label)

    @property
    def contradicts(self) -> bool:
        """Whether it speaks against the label."""
        enough = self.explained >= max(LEAST_EXPLAINED, FACTOR * self.by_label)
        return enough and self.off_deg > OFF_DEG


def against(votes: Sequence[Vote]) -> list[Vote]:
    """The largest set of votes against a label that agree with one of them; empty where they are too few."""
    speaking = [vote for vote in votes if vote.contradicts]
    sets = [[two for two in speaking if pose_error_deg(one.R, one.t, two.R, two.t) < AGREE_DEG] for one in speaking]
    largest = max(sets, key=len, default=[])
    return largest if len(largest) >= DETECTORS else []


def doubted_labels(scenes: Iterable[DetectorScene]) -> dict[PairName, list[Vote]]:
    """The votes against each label that is in doubt, by scene and images."""
    votes: dict[PairName, list[Vote]] = {}
    for scene in scenes:
        for name, pair in _filtered(scene):
            vote = Vote.of(scene.detector, pair)
            if vote is not None:
                votes.setdefault(name, []).append(vote)
    return {name: doubts for name, all_of_pair in votes.items() if (doubts := against(all_of_pair))}


def _filtered(scene: DetectorScene) -> Iterator[tuple[PairName, ScenePair]]:
    """The pairs with cross-checked and ratio-tested matches, or a learned matcher's own."""
    selection = scene.lists(KINDS["learned" if scene.learned else "cross-ratio"])
    if selection is None:
        return
    for index in selection.indices:
        with suppress(DatasetError):  # what cannot be read has no label
            pair = selection.source[index]
            yield (scene.scene, pair.image1, pair.image2), pair


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("doubted_labels", __doc__)
    parser.add_argument("bundles", metavar="FOLDER", nargs="+", type=Path, help="folders of scene bundles, or bundles")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print a row for each vote against a label."""
    scenes = open_detector_scenes(options.bundles, per_scene=options.per_scene, seed=options.seed)
    rows = [
        [*name, vote.detector, f"{vote.off_deg:.1f}°", str(vote.explained), str(vote.by_label)]
        for name, votes in doubted_labels(scenes).items()
        for vote in votes
    ]
    header = ["scene", "image 1", "image 2", "detector", "from the label", "explained", "by the label"]
    print(render_table(header, rows) if rows else "No label is in doubt.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
