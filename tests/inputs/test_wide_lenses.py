"""Fisheye lenses: right matches near the rim are kept about as well as in the middle."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import K as scene_K
from conftest import make_scene
from fisheye_views import LENS, RIGHT, K, P, Q, R, T, recalls

from mgca_filter import MatchFilter, MatchPair, filter_matches
from mgca_filter.geometry.epipolar import pose_error_deg


def test_a_fisheye_keeps_its_rim() -> None:
    result = filter_matches(P, Q, None, K1=K, dist1=LENS)
    assert result.status == "ok"
    assert pose_error_deg(result.R, result.t, R, T) < 0.5
    assert min(recalls(result.mask)) > 0.97
    assert result.mask[~RIGHT].mean() < 0.05


def test_points_that_were_undistorted_before_say_so_by_their_stretch(match_filter: MatchFilter) -> None:
    """As a COLMAP database gives them: the answer is that of the lens."""
    from mgca_filter.geometry.cameras import resolve_intrinsics

    camera, _ = resolve_intrinsics(P, Q, K1=K, dist1=LENS)
    flat1, flat2 = (camera.project(camera.normalize(points)) for points in (P, Q))
    plain = MatchPair(flat1, flat2, None, K1=K)
    stretched = MatchPair(flat1, flat2, None, K1=K, stretch1=camera.stretch(P), stretch2=camera.stretch(Q))
    by_lens = MatchPair(P, Q, None, K1=K, dist1=LENS)
    first, second, third = match_filter.filter_many([plain, stretched, by_lens])
    np.testing.assert_array_equal(second.mask, third.mask)
    assert recalls(first.mask)[-1] < 0.6 * recalls(second.mask)[-1]
    with pytest.raises(ValueError, match="stretch2: expected shape"):
        match_filter.filter_many([MatchPair(flat1, flat2, None, K1=K, stretch2=np.zeros((3, 2, 2)))])


def test_four_plain_coefficients_are_those_of_a_pinhole() -> None:
    lens = [LENS.k1, LENS.k2, LENS.k3, LENS.k4]
    plain, fisheye = (filter_matches(P, Q, None, K1=K, dist1=d) for d in (lens, LENS))
    assert plain.num_inliers < 0.6 * fisheye.num_inliers
    told = [[text for text in result.info["assumptions"] if "Fisheye(k1" in text] for result in (plain, fisheye)]
    assert [len(texts) for texts in told] == [2, 0]
    assert "read as a pinhole's" in told[0][0]


def test_an_ordinary_lens_is_not_doubted() -> None:
    scene = make_scene()
    result = filter_matches(scene.points1, scene.points2, None, K1=scene_K, dist1=[-0.2, 0.05, 0.001, 0.0])
    assert not any("Fisheye" in text for text in result.info["assumptions"])


def test_a_lens_that_shows_nothing_at_the_keypoints_is_told() -> None:
    result = filter_matches(P, Q, None, K1=K, dist1=[-0.3, 0.01, 0.0, 0.0])
    told = [sentence for sentence in result.info["assumptions"] if "shows nothing at" in sentence]
    assert len(told) == 2
    assert "Fisheye(k1, k2, k3, k4)" in told[0]
