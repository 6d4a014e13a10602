"""What ``match_images`` feeds the network is what the network was trained on.

Needs photographs and the scene bundles made of them: the environment variable MGCA_FILTER_DATA names a folder that
holds ``val/SCENE.npz`` and ``pairs/SCENE/`` with images under the bundle's names.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.features import create_detector, detect_keypoints, match_descriptors
from mgca_filter.inputs.attributes import MatchAttributes, candidate_mask
from mgca_filter.inputs.matches import read_matches

DATA = Path(os.environ.get("MGCA_FILTER_DATA", "absent"))
PAIRS_PER_SCENE = 2


def photographed_pairs(scene: str) -> list[ScenePair]:
    """The first pairs of a scene whose two photographs are there."""
    names = {path.name for path in (DATA / "pairs" / scene).iterdir()}
    bundle = SceneBundle(DATA / "val" / f"{scene}.npz")
    pairs = (bundle[index] for index in range(len(bundle)))
    return [pair for pair in pairs if {pair.image1, pair.image2} <= names][:PAIRS_PER_SCENE]


def matched(folder: Path, pair: ScenePair) -> MatchAttributes:
    """What the default detector and matcher know of the photographs' matches."""
    detector = create_detector()
    found = [detect_keypoints(cv2.imread(str(folder / name)), detector) for name in (pair.image1, pair.image2)]
    rows = match_descriptors(found[0][1], found[1][1], detector.defaultNorm())
    matches = read_matches(rows, len(found[0][0]), len(found[1][0]))
    return MatchAttributes(ratio=matches.ratio, best=matches.best)


@pytest.mark.skipif(not (DATA / "pairs").is_dir(), reason="MGCA_FILTER_DATA names no photographs")
def test_matches_of_photographs_are_like_those_of_the_bundle() -> None:
    scenes = [path.name for path in sorted((DATA / "pairs").iterdir()) if path.is_dir()]
    pairs = [(DATA / "pairs" / scene, pair) for scene in scenes for pair in photographed_pairs(scene)]
    assert pairs
    for folder, pair in pairs:
        now, then = matched(folder, pair), pair.attributes
        count = len(then.ratio)
        assert abs(len(now.ratio) - count) <= 0.01 * count
        for share in (0.25, 0.5, 0.75):
            assert abs(np.quantile(now.ratio, share) - np.quantile(then.ratio, share)) < 0.03
        assert abs(np.mean(now.best) - np.mean(then.best)) < 0.05
        candidates = [np.mean(candidate_mask(known.encode(len(known.ratio)))) for known in (now, then)]
        assert abs(candidates[0] - candidates[1]) < 0.05
