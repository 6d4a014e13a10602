"""One pair through the worker of all pipelines."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import SIZE, K, make_scene

import mgca_filter.match_filter as match_filter_module
from mgca_filter import MatchFilter
from mgca_filter.features import ImageFeatures
from mgca_filter.pipelines.run import Summary
from mgca_filter.pipelines.worker import PairRow, PairWorker


def test_matches_stay_where_focal_lengths_alone_make_the_pose_doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    """What COLMAP, hloc and folders write hangs on the matches, not on what the pose is worth."""
    scene = make_scene("skew", right=300, wrong=200)
    images = [ImageFeatures(points, image_size=SIZE) for points in (scene.points1, scene.points2)]
    matches = np.stack([np.arange(500), np.arange(500)], axis=1)

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


@pytest.mark.parametrize("known", [True, False], ids=["K", "no K"])
def test_a_verified_list_needs_no_network(monkeypatch: pytest.MonkeyPatch, known: bool) -> None:
    scene = make_scene("skew", right=300, wrong=20)
    intrinsics = K if known else None
    images = [ImageFeatures(points, image_size=SIZE, K=intrinsics) for points in (scene.points1, scene.points2)]
    matches = np.stack([np.arange(320), np.arange(320)], axis=1)
    worker = PairWorker({"threshold": 2.0})
    monkeypatch.setattr(MatchFilter, "filter_many", lambda *_: pytest.fail("the network was asked"))
    row = worker.filter("a", "b", *images, matches)
    assert (row.status, row.calibrated, row.verified) == ("ok", known, True)
    assert np.isin(np.flatnonzero(scene.inlier), row.kept[:, 0]).mean() > 0.98
    assert (row.R is None) == (row.confidence is None) == (not known)
    # A raw list is another matter: a keypoint stands in several of its matches.
    with pytest.raises(pytest.fail.Exception, match="network"):
        worker.filter("a", "b", *images, np.vstack([matches, [[0, 5]]]))


@pytest.mark.parametrize(
    ("by_status", "found"),
    [({"low_support": (2, 99, 0)}, False), ({"low_support": (2, 99, 40)}, True), ({"planar": (1, 9, 0)}, True)],
)
def test_kept_matches_are_geometry_whatever_the_status(by_status: dict[str, tuple[int, int, int]], found: bool) -> None:
    assert Summary(by_status, 1, 1.0).found_geometry == found
