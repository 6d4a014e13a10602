"""One pair through the worker of all pipelines."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import SIZE, make_scene

import mgca_filter.match_filter as match_filter_module
from mgca_filter.features import ImageFeatures
from mgca_filter.pipelines.run import Summary
from mgca_filter.pipelines.worker import PairRow, PairWorker


def test_matches_stay_where_focal_lengths_alone_make_the_pose_doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    """What COLMAP, hloc and folders write hangs on the matches, not on what the pose is worth."""
    scene = make_scene("skew", right=300, wrong=60)
    images = [ImageFeatures(points, image_size=SIZE) for points in (scene.points1, scene.points2)]
    matches = np.stack([np.arange(360), np.arange(360)], axis=1)

    def answer() -> PairRow:
        return PairWorker({}).filter("a", "b", *images, matches)

    sure = answer()
    assert (sure.status, sure.verified, sure.calibrated) == ("ok", True, False)
    monkeypatch.setattr(match_filter_module, "pose_sigma_deg", lambda *arguments: 60.0)
    unsure = answer()
    assert (unsure.status, unsure.verified) == ("low_support", True)
    assert len(unsure.kept) > 250
    for name in ("kept", "scores", "F", "E", "R", "t"):
        np.testing.assert_array_equal(getattr(unsure, name), getattr(sure, name))


@pytest.mark.parametrize(
    ("by_status", "found"),
    [({"low_support": (2, 99, 0)}, False), ({"low_support": (2, 99, 40)}, True), ({"planar": (1, 9, 0)}, True)],
)
def test_kept_matches_are_geometry_whatever_the_status(by_status: dict[str, tuple[int, int, int]], found: bool) -> None:
    assert Summary(by_status, 1, 1.0).found_geometry == found
