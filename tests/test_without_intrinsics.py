"""Without K: one focal length or two from the matches, a pose under them, or none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import SIZE, K, Scene, make_scene

import mgca_filter.match_filter as match_filter_module
from mgca_filter import FilterResult, MatchFilter, Status
from mgca_filter.fit.focal_estimate import FocalEstimate
from mgca_filter.geometry.epipolar import pose_error_deg


def zoomed(scene: Scene, zoom: float) -> Scene:
    """The scene with its second image taken at ``zoom`` times the focal length."""
    return replace(scene, points2=(scene.points2 - K[:2, 2]) * zoom + K[:2, 2])


def run(match_filter: MatchFilter, scene: Scene, **options: object) -> FilterResult:
    return match_filter.filter(
        scene.points1, scene.points2, None, attributes=scene.attributes, size1=SIZE, size2=SIZE, **options
    )


@pytest.mark.parametrize("zoom", [0.6, 1.6])
def test_two_cameras_have_two_focal_lengths(match_filter: MatchFilter, zoom: float) -> None:
    scene = zoomed(make_scene("skew", right=300, wrong=60), zoom)
    result = run(match_filter, scene)
    assert result.status is Status.OK
    assert result.info["intrinsics"] == "estimated"
    focal_px, sigma = np.array(result.info["focal_px"]), np.array(result.info["focal_sigma"])
    assert np.log(focal_px[1] / focal_px[0]) == pytest.approx(np.log(zoom), abs=0.1)
    assert (np.abs(np.log(focal_px / (K[0, 0] * np.array([1.0, zoom])))) < 3.0 * sigma).all()
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 3.0
    assert [text.split(" px of ")[1][:7] for text in result.info["assumptions"][2:]] == ["image 1", "image 2"]


def test_one_camera_has_one(match_filter: MatchFilter) -> None:
    result = run(match_filter, make_scene("skew", right=300, wrong=60))
    focal1, focal2 = result.info["focal_px"]
    assert focal1 == focal2 == pytest.approx(K[0, 0], rel=0.15)
    assert result.info["assumptions"][-1].startswith(f"focal length {focal1:.0f} px of both images")


def test_images_of_two_sizes_share_the_lens_and_not_the_focal_length(match_filter: MatchFilter) -> None:
    """The same camera, of whose second photograph the copy is half as large."""
    scene = make_scene("skew", right=300, wrong=60)
    halved = (scene.points2 + 0.5) / 2 - 0.5
    result = match_filter.filter(
        scene.points1, halved, None, attributes=scene.attributes, size1=SIZE, size2=(SIZE[0] / 2, SIZE[1] / 2)
    )
    focal1, focal2 = result.info["focal_px"]
    assert focal1 / focal2 == pytest.approx(2.0, rel=0.1)
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 3.0


def test_a_guess_that_nothing_bears_out_gives_no_pose(
    match_filter: MatchFilter, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene("skew", right=300, wrong=60)
    monkeypatch.setattr(match_filter_module, "estimate_focals", lambda *arguments: [])
    result = run(match_filter, scene)
    assert result.info["intrinsics"] == "guessed"
    assert all(value is None for value in (result.E, result.R, result.t, result.confidence))
    assert result.F is not None
    assert result.mask[scene.inlier].mean() > 0.9
    assert run(match_filter, scene, K1=K).E is not None


def test_where_two_focal_lengths_fail_one_is_tried(match_filter: MatchFilter, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene("skew", right=300, wrong=60)
    right = K[0, 0] / (1.2 * SIZE[0])
    estimates = [FocalEstimate((4.0, 0.25), (0.1, 0.1)), FocalEstimate((right, right), (0.1, 0.1))]
    monkeypatch.setattr(match_filter_module, "estimate_focals", lambda *arguments: estimates)
    result = run(match_filter, scene)
    assert result.info["focal_px"] == pytest.approx((K[0, 0], K[0, 0]))
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 1.0


def test_a_pose_is_no_surer_than_its_focal_lengths(match_filter: MatchFilter, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they leave the pose open it is doubtful; mask, F and the pose itself are what they were."""
    scene = make_scene("skew", right=300, wrong=60)
    sure = run(match_filter, scene)
    assert (sure.status, sure.ok, sure.verified) == (Status.OK, True, True)
    assert 0.0 < sure.info["focal_sigma_deg"] < 5.0
    assert sure.confidence < sure.info["fitted_confidence"]
    assert "focal_doubt" not in sure.info
    monkeypatch.setattr(match_filter_module, "pose_sigma_deg", lambda *arguments: 40.0)
    unsure = run(match_filter, scene)
    assert (unsure.status, unsure.ok, unsure.verified) == (Status.LOW_SUPPORT, False, True)
    assert unsure.info["focal_sigma_deg"] == 40.0
    assert unsure.info["focal_doubt"] is True
    assert unsure.confidence <= 0.5
    assert unsure.info["fitted_confidence"] == sure.info["fitted_confidence"]
    for name in ("mask", "F", "E", "R", "t"):
        np.testing.assert_array_equal(getattr(unsure, name), getattr(sure, name))


def test_known_focal_lengths_leave_nothing_open(match_filter: MatchFilter) -> None:
    result = run(match_filter, make_scene("skew", right=300, wrong=60), K1=K)
    assert result.ok
    assert not {"focal_sigma_deg", "fitted_confidence", "focal_doubt"} & set(result.info)


def test_the_noisier_the_matches_the_more_open_is_the_pose(match_filter: MatchFilter) -> None:
    quiet, noisy = (run(match_filter, make_scene("general", right=300, wrong=0, noise_px=px)) for px in (0.1, 0.8))
    assert quiet.info["focal_sigma_deg"] < noisy.info["focal_sigma_deg"]
