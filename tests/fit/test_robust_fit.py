"""Robust fit: right pose from the right order, valid matrices, same seed same bits, None instead of exceptions."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import K, Scene, make_scene
from mgca_filter.fit.ranking import MIN_FIT_MATCHES, RankedMatches, match_order

from mgca_filter.fit import robust_fit
from mgca_filter.fit.estimators import fit_epipolar, fit_homography, usac_params
from mgca_filter.fit.robust_fit import (
    SINGLE_START,
    RobustFitOptions,
    Start,
    estimate_model,
    estimate_pose,
    pose_from_essential,
)
from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import cross_matrix, essential_from_pose, pose_error_deg
from mgca_filter.geometry.homography import homography_distance, poses_from_homography
from mgca_filter.geometry.pose_refinement import refine_pose, rotation_from_vector, truncated_cost
from mgca_filter.inputs.options import METHODS

FOCAL = K[0, 0]
ESTIMATORS = [method for method in METHODS if method != "none"]


def normalized(scene: Scene) -> np.ndarray:
    return np.hstack([normalize_points(scene.points1, K), normalize_points(scene.points2, K)])


def ratio_order(scene: Scene) -> np.ndarray:
    return np.argsort(scene.attributes.ratio, kind="stable")


def by_ratio(scene: Scene) -> RankedMatches:
    return RankedMatches.of(normalized(scene), ratio_order(scene))


def options_of(method: str, **changes: object) -> RobustFitOptions:
    if method == "poselib":
        pytest.importorskip("poselib")
    return RobustFitOptions(method=method, **changes)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_every_method_finds_the_pose(method: str, scene: Scene) -> None:
    model = estimate_model(by_ratio(scene), FOCAL, options_of(method))
    assert model is not None
    assert pose_error_deg(model.R, model.t, scene.R, scene.t) < 1.0
    assert float(model.t @ scene.t) > 0
    np.testing.assert_allclose(np.linalg.svd(model.E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
    np.testing.assert_allclose(model.R @ model.R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(model.R) == pytest.approx(1.0)
    assert np.linalg.norm(model.t) == pytest.approx(1.0)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_without_intrinsics_the_fundamental_matrix_fits(method: str, scene: Scene) -> None:
    model = estimate_model(by_ratio(scene), FOCAL, options_of(method), calibrated=False)
    assert model is not None
    assert np.linalg.norm(model.M) == pytest.approx(1.0)
    assert pose_error_deg(model.R, model.t, scene.R, scene.t) < 5.0


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_same_seed_gives_the_same_bits(method: str, calibrated: bool, scene: Scene) -> None:
    fits = [estimate_model(by_ratio(scene), FOCAL, options_of(method, seed=3), calibrated) for _ in range(2)]
    assert fits[0] is not None
    assert fits[1] is not None
    np.testing.assert_array_equal(fits[0].M, fits[1].M)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_another_seed_draws_other_samples(method: str) -> None:
    hard = make_scene(right=40, wrong=160, noise_px=1.0)
    options = [options_of(method, seed=seed, refine=False, max_iterations=50) for seed in range(6)]
    fits = [estimate_model(by_ratio(hard), FOCAL, option) for option in options]
    found = {fit.M.tobytes() for fit in fits if fit is not None}
    assert len(found) > 1


def test_seed_zero_is_the_preset_of_opencv(scene: Scene) -> None:
    rows = normalized(scene)[ratio_order(scene)]
    x1, x2 = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    threshold = 0.75 / FOCAL
    flags = {"prob": 0.999, "threshold": threshold, "maxIters": 5000}
    for preset, sampler, score in (
        (cv2.USAC_PROSAC, cv2.SAMPLING_PROSAC, cv2.SCORE_METHOD_MSAC),
        (cv2.USAC_MAGSAC, cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MAGSAC),
    ):
        expected, _ = cv2.findEssentialMat(x1, x2, np.eye(3), method=preset, **flags)
        params = usac_params(sampler, score, threshold, 0.999, 5000, seed=0)
        E, _ = cv2.findEssentialMat(x1, x2, np.eye(3), np.eye(3), None, None, params)
        np.testing.assert_array_equal(E, expected)


def test_every_option_counts() -> None:
    hard = make_scene(right=40, wrong=160, noise_px=1.0)
    base = RobustFitOptions(confidence=0.9, max_iterations=40, starts=SINGLE_START)
    reference = estimate_model(by_ratio(hard), FOCAL, base)
    assert reference is not None
    changes = {
        "threshold_px": 2.5,
        "max_iterations": 5000,
        "refine": False,
        "refine_threshold_px": 3.0,
        "method": "ransac",
        "starts": (Start(0.0, 3.0),),
    }
    for name, value in changes.items():
        other = estimate_model(by_ratio(hard), FOCAL, replace(base, **{name: value}))
        assert other is None or not np.array_equal(other.E, reference.E), name


def test_prosac_uses_the_order(scene: Scene) -> None:
    hard = make_scene(right=40, wrong=400)
    good_first = np.argsort(~hard.inlier, kind="stable")
    few = RobustFitOptions(max_iterations=20, starts=SINGLE_START)
    pose = estimate_pose(RankedMatches.of(normalized(hard), good_first), FOCAL, few)
    assert pose is not None
    assert pose_error_deg(*pose, hard.R, hard.t) < 2.0
    worst = estimate_pose(RankedMatches.of(normalized(hard), good_first[::-1]), FOCAL, few)
    assert worst is None or pose_error_deg(*worst, hard.R, hard.t) > 5.0


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("count", range(8))
def test_too_few_matches_give_none(method: str, count: int, scene: Scene) -> None:
    order = ratio_order(scene)[:count]
    assert estimate_model(RankedMatches.of(normalized(scene), order), FOCAL, options_of(method)) is None
    repeated = np.repeat(order, 20)
    assert estimate_model(RankedMatches.of(normalized(scene), repeated), FOCAL, options_of(method)) is None


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_degenerate_points_do_not_raise(method: str, calibrated: bool) -> None:
    rng = np.random.default_rng(0)
    line = np.linspace(-1, 1, 30)[:, None] * [[0.5, 0.25, 0.5, 0.25]]
    for rows in (line, line + [[0, 0, 0.1, 0]], rng.uniform(-1, 1, (30, 4)), np.eye(30, 4)):
        model = estimate_model(RankedMatches.of(rows, np.arange(30)), FOCAL, options_of(method), calibrated)
        assert model is None or np.isfinite(model.E).all()


def test_poselib_missing_names_the_extra(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    monkeypatch.setitem(__import__("sys").modules, "poselib", None)
    with pytest.raises(ImportError, match=r"mgca_filter\[poselib\]"):
        estimate_model(by_ratio(scene), FOCAL, RobustFitOptions(method="poselib"))


def test_order_mixes_score_and_ratio() -> None:
    margins = np.array([2.0, 4.0, 4.0, -2.0], dtype=np.float32)
    ratio = np.array([0.3, 0.9, 0.5, 0.1], dtype=np.float32)
    known = np.ones(4, dtype=bool)
    assert match_order(margins, ratio, known).tolist() == [0, 2, 1, 3]
    assert match_order(margins, ratio, ~known).tolist() == [1, 2, 0, 3]


def test_ranked_matches_hold_each_match_once_and_keep_their_order() -> None:
    rows = np.arange(12.0).reshape(3, 4)[[0, 1, 0, 2]]
    ranked = RankedMatches.of(rows, np.array([3, 2, 0, 1]), np.array([0.1, 0.2, 0.3, 0.4]), np.arange(4.0))
    assert ranked.rows.tolist() == [3, 2, 1]
    np.testing.assert_array_equal(ranked.correspondences, rows[[3, 2, 1]])
    np.testing.assert_array_equal(ranked.weights, [0.4, 0.3, 0.2])
    np.testing.assert_array_equal(ranked.margins, [3.0, 2.0, 1.0])


def test_above_a_margin_or_the_best_of_all() -> None:
    count = 3 * MIN_FIT_MATCHES
    rows = np.random.default_rng(0).uniform(-1, 1, (count, 4))
    margins = np.linspace(-1, 1, count)
    ranked = RankedMatches.of(rows, np.random.default_rng(1).permutation(count), margins=margins)
    for margin, expected in ((0.0, margins > 0), (0.9, margins >= margins[-MIN_FIT_MATCHES])):
        chosen = ranked.above(margin)
        assert chosen.rows.tolist() == [row for row in ranked.rows if expected[row]]
        np.testing.assert_array_equal(chosen.correspondences, rows[chosen.rows])


def test_support_counts_weights_agreement_and_depth(scene: Scene) -> None:
    exact = make_scene(noise_px=0.0, wrong=0)
    weights = np.linspace(0.1, 1.0, len(exact.points1))
    ranked = RankedMatches.of(normalized(exact), np.arange(len(weights)), weights)
    E = cross_matrix(exact.t) @ exact.R
    assert ranked.support(E, 0.01) == pytest.approx(weights.sum())
    assert ranked.pose_support(exact.R, exact.t, 0.01) == pytest.approx(weights.sum())
    assert ranked.support(cross_matrix(-exact.t) @ exact.R, 0.01) == pytest.approx(weights.sum())
    assert ranked.pose_support(exact.R, -exact.t, 0.01) == pytest.approx(0.0)


def test_every_method_has_its_starts_unless_told_otherwise() -> None:
    assert len(RobustFitOptions().runs) > len(RobustFitOptions(method="poselib").runs) == 1
    assert RobustFitOptions(method="poselib", starts=SINGLE_START).runs == SINGLE_START
    assert [RobustFitOptions(seed=5).estimator(index).seed for index in (0, 2)] == [5, 7]


@pytest.mark.parametrize("calibrated", [True, False])
def test_the_best_supported_start_wins(calibrated: bool) -> None:
    hard = make_scene(right=60, wrong=600)
    margins = np.where(hard.inlier, 1.0, -1.0)
    hopeless = np.random.default_rng(0).permutation(np.flatnonzero(~hard.inlier))
    order = np.concatenate([hopeless, np.flatnonzero(hard.inlier)])
    ranked = RankedMatches.of(normalized(hard), order, np.where(hard.inlier, 0.9, 0.1), margins)
    blind, seeing = Start(-2.0, 1.0), Start(0.0, 1.0)
    few = RobustFitOptions(max_iterations=20, starts=(blind, seeing), refine=False)
    model = estimate_model(ranked, FOCAL, few, calibrated)
    assert model is not None
    assert model.origin == "start 2"
    alone = estimate_model(ranked, FOCAL, replace(few, starts=(blind,)), calibrated)
    assert alone is None or pose_error_deg(alone.R, alone.t, hard.R, hard.t) > 5.0


def test_what_the_network_proposes_can_win() -> None:
    hard = make_scene(right=40, wrong=400)
    hopeless_first = RankedMatches.of(normalized(hard), np.argsort(hard.inlier, kind="stable"))
    few = RobustFitOptions(max_iterations=20, starts=SINGLE_START)
    nearby = essential_from_pose(rotation_from_vector(np.array([0.001, -0.001, 0.001])) @ hard.R, hard.t)
    model = estimate_model(hopeless_first, FOCAL, few, network_essential=(-3.0 * nearby).astype(np.float32))
    assert model is not None
    assert model.origin == "network"
    assert pose_error_deg(model.R, model.t, hard.R, hard.t) < 1.0
    assert model.M.dtype == np.float64
    alone = estimate_model(hopeless_first, FOCAL, few)
    assert alone is None or pose_error_deg(alone.R, alone.t, hard.R, hard.t) > 5.0


@pytest.mark.parametrize("proposal", [np.full((3, 3), np.nan), np.eye(3), np.zeros((3, 3))])
def test_a_bad_proposal_does_no_harm(proposal: np.ndarray, scene: Scene) -> None:
    model = estimate_model(by_ratio(scene), FOCAL, network_essential=proposal)
    expected = estimate_model(by_ratio(scene), FOCAL)
    assert model is not None
    assert expected is not None
    np.testing.assert_array_equal(model.E, expected.E)


def test_guessed_intrinsics_have_no_use_for_the_networks_answer(scene: Scene) -> None:
    truth = essential_from_pose(scene.R, scene.t)
    models = [estimate_model(by_ratio(scene), FOCAL, calibrated=False, network_essential=E) for E in (truth, None)]
    assert models[0] is not None
    assert models[1] is not None
    np.testing.assert_array_equal(models[0].M, models[1].M)


def test_one_start_that_agrees_with_the_network_is_enough(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    def fit_and_count(*arguments: object) -> np.ndarray | None:
        runs.append(arguments)
        return fit_epipolar(*arguments)

    monkeypatch.setattr(robust_fit, "fit_epipolar", fit_and_count)
    truth = essential_from_pose(scene.R, scene.t)
    for proposal, expected in ((None, 2), (truth, 1), (np.eye(3), 2)):
        runs.clear()
        estimate_model(by_ratio(scene), FOCAL, network_essential=proposal)
        assert len(runs) == expected


def test_pose_puts_points_in_front_however_far(scene: Scene) -> None:
    far = make_scene(noise_px=0.0, wrong=0)
    rows = normalized(far)
    E = cross_matrix(far.t * 1e-3) @ far.R
    pose = pose_from_essential(E, rows)
    assert pose is not None
    assert pose_error_deg(*pose, far.R, far.t) < 1e-3
    assert float(pose[1] @ far.t) > 0
    assert pose_from_essential(E, np.zeros((0, 4))) is None


def test_refinement_lowers_the_cost_and_the_error(scene: Scene) -> None:
    rows, threshold = normalized(scene), 3.0 / FOCAL
    R = rotation_from_vector(np.array([0.002, -0.002, 0.001])) @ scene.R
    t = scene.t + [0.0, 0.03, -0.02]
    t = t / np.linalg.norm(t)
    refined = refine_pose(rows, R, t, threshold, rounds=30)
    assert truncated_cost(rows, *refined, threshold) < truncated_cost(rows, R, t, threshold)
    assert pose_error_deg(*refined, scene.R, scene.t) < 0.5 * pose_error_deg(R, t, scene.R, scene.t)


def test_homography_of_a_plane_holds_its_pose() -> None:
    plane = make_scene("planar", wrong=0, noise_px=0.0)
    rows = normalized(plane)
    H = fit_homography(rows[:, :2], rows[:, 2:], 1.0 / FOCAL)
    assert H is not None
    np.testing.assert_allclose(homography_distance(rows[:, :2], rows[:, 2:], H), 0, atol=1e-6)
    assert min(pose_error_deg(*pose, plane.R, plane.t) for pose in poses_from_homography(H)) < 0.1
    assert poses_from_homography(np.eye(3)) == []
    assert fit_homography(rows[:3, :2], rows[:3, 2:], 1.0) is None
