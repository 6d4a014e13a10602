"""OpenCV's and PoseLib's estimators: their presets bit for bit, valid matrices, None instead of exceptions."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import Scene, make_scene
from fit_inputs import FOCAL, normalized

from mgca_filter.fit.estimators import EstimatorOptions, fit_epipolar, fit_homography, usac_params
from mgca_filter.fit.robust_fit import pose_from_essential
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg, sampson_distance
from mgca_filter.geometry.homography import homography_distance, poses_from_homography

ESTIMATORS = ["prosac", "magsac", "ransac", "poselib"]
HARD = {"right": 40, "wrong": 160, "noise_px": 1.0}


def by_ratio(scene: Scene) -> np.ndarray:
    return normalized(scene)[np.argsort(scene.attributes.ratio, kind="stable")]


def options_of(method: str, **changes: object) -> EstimatorOptions:
    if method == "poselib":
        pytest.importorskip("poselib")
    return EstimatorOptions(method, **changes)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_every_method_finds_the_pose(method: str, scene: Scene) -> None:
    E = fit_epipolar(by_ratio(scene), FOCAL, options_of(method), calibrated=True)
    assert E is not None
    np.testing.assert_allclose(np.linalg.svd(E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-6)
    R, t = pose_from_essential(E, normalized(scene), FOCAL)
    assert pose_error_deg(R, t, scene.R, scene.t) < 1.5


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_exact_points_give_the_exact_model(method: str, calibrated: bool) -> None:
    exact = make_scene(wrong=0, noise_px=0.0)
    M = fit_epipolar(by_ratio(exact), FOCAL, options_of(method), calibrated)
    assert M is not None
    assert np.linalg.norm(M) == pytest.approx(1.0)
    assert np.linalg.svd(M, compute_uv=False)[2] < 1e-8
    assert sampson_distance(normalized(exact), M).max() * FOCAL < 1e-3
    assert min(np.abs(M - exact.E).max(), np.abs(M + exact.E).max()) < 1e-4


@pytest.mark.parametrize("method", ESTIMATORS)
def test_without_intrinsics_the_fundamental_matrix_fits(method: str, scene: Scene) -> None:
    F = fit_epipolar(by_ratio(scene), FOCAL, options_of(method), calibrated=False)
    assert F is not None
    assert np.median(sampson_distance(normalized(scene)[scene.inlier], F)) * FOCAL < 0.5
    # Bound to no intrinsics: the singular values are free.
    values = np.linalg.svd(F, compute_uv=False)
    assert values[2] < 1e-8
    assert values[0] - values[1] > 1e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("method", "flag"), [("prosac", cv2.USAC_PROSAC), ("magsac", cv2.USAC_MAGSAC)])
def test_seed_zero_is_the_preset_of_opencv(method: str, flag: int, seed: int) -> None:
    """Bit for bit, on lists that a run does not exhaust."""
    rows = by_ratio(make_scene(right=200, wrong=300, noise_px=1.0, seed=seed))
    options = EstimatorOptions(method, 0.75, 0.999, 300)
    x1, x2 = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    flags = {"prob": 0.999, "threshold": 0.75 / FOCAL, "maxIters": 300}
    expected, _ = cv2.findEssentialMat(x1, x2, np.eye(3), method=flag, **flags)
    found = fit_epipolar(rows, FOCAL, options, calibrated=True)
    np.testing.assert_array_equal(found, expected / np.linalg.norm(expected))
    expected, _ = cv2.findFundamentalMat(x1 * FOCAL, x2 * FOCAL, flag, 0.75, 0.999, 300)
    found = fit_epipolar(rows, FOCAL, options, calibrated=False)
    expected = np.diag([FOCAL, FOCAL, 1.0]) @ expected @ np.diag([FOCAL, FOCAL, 1.0])
    np.testing.assert_array_equal(found, expected / np.linalg.norm(expected))


def test_classic_ransac_is_opencvs() -> None:
    rows = by_ratio(make_scene(**HARD))
    x1, x2 = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 2:])
    expected, _ = cv2.findEssentialMat(x1, x2, np.eye(3), cv2.RANSAC, 0.999, 0.75 / FOCAL, 300)
    found = fit_epipolar(rows, FOCAL, EstimatorOptions("ransac", 0.75, 0.999, 300), calibrated=True)
    np.testing.assert_array_equal(found, expected / np.linalg.norm(expected))


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_same_seed_gives_the_same_bits(method: str, calibrated: bool, scene: Scene) -> None:
    found = [fit_epipolar(by_ratio(scene), FOCAL, options_of(method, seed=3), calibrated) for _ in range(2)]
    assert found[0] is not None
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_another_seed_draws_other_samples(method: str, calibrated: bool) -> None:
    rows = by_ratio(make_scene(**HARD))
    options = [options_of(method, seed=seed, max_iterations=50) for seed in range(6)]
    fits = [fit_epipolar(rows, FOCAL, option, calibrated) for option in options]
    assert len({fit.tobytes() for fit in fits if fit is not None}) > 1


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("method", ["prosac", "magsac", "ransac"])
def test_every_option_counts(method: str, calibrated: bool) -> None:
    """On one list or another: a run may meet the same best sample under other options."""
    lists = [by_ratio(make_scene(right=160, wrong=90, noise_px=0.5, seed=seed)) for seed in range(4)]

    def answers(options: EstimatorOptions) -> list[bytes]:
        found = [fit_epipolar(rows, FOCAL, options, calibrated) for rows in lists]
        return [b"" if M is None else M.tobytes() for M in found]

    base = EstimatorOptions(method, 0.5, 0.9999, 400)
    reference = answers(base)
    assert all(reference)
    other_method = "ransac" if method != "ransac" else "magsac"
    changes = {"method": other_method, "threshold_px": 6.0, "confidence": 1e-6, "max_iterations": 1, "seed": 1}
    for name, value in changes.items():
        assert answers(replace(base, **{name: value})) != reference, name


def test_prosac_uses_the_order() -> None:
    hard = make_scene(right=40, wrong=400)
    good_first = normalized(hard)[np.argsort(~hard.inlier, kind="stable")]
    few = EstimatorOptions("prosac", max_iterations=20)
    error = []
    for rows in (good_first, good_first[::-1]):
        E = fit_epipolar(rows, FOCAL, few, calibrated=True)
        pose = None if E is None else pose_from_essential(E, rows, FOCAL)
        error.append(180.0 if pose is None else pose_error_deg(*pose, hard.R, hard.t))
    assert error[0] < 2.0
    assert error[1] > 5.0


def test_of_stacked_models_the_best_is_taken() -> None:
    """Five points allow up to ten essential matrices, and OpenCV returns them all."""
    exact = make_scene(right=5, wrong=0, noise_px=0.0, seed=3)
    rows = normalized(exact)
    stacked, _ = cv2.findEssentialMat(rows[:, :2], rows[:, 2:], np.eye(3), cv2.RANSAC, 0.999, 1e-3)
    assert len(stacked) > 3
    E = fit_epipolar(rows, FOCAL, EstimatorOptions("ransac"), calibrated=True)
    assert E.shape == (3, 3)
    assert sampson_distance(rows, E).max() * FOCAL < 1e-3


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("count", range(5))
def test_too_few_matches_give_none(method: str, calibrated: bool, count: int, scene: Scene) -> None:
    assert fit_epipolar(by_ratio(scene)[:count], FOCAL, options_of(method), calibrated) is None


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_degenerate_points_do_not_raise(method: str, calibrated: bool) -> None:
    rng = np.random.default_rng(0)
    line = np.linspace(-1, 1, 30)[:, None] * [[0.5, 0.25, 0.5, 0.25]]
    for rows in (line, line + [[0, 0, 0.1, 0]], rng.uniform(-1, 1, (30, 4)), np.eye(30, 4), np.zeros((30, 4))):
        M = fit_epipolar(np.ascontiguousarray(rows), FOCAL, options_of(method), calibrated)
        assert M is None or (np.isfinite(M).all() and np.linalg.norm(M) == pytest.approx(1.0))


def test_poselib_missing_names_the_extra(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    monkeypatch.setitem(__import__("sys").modules, "poselib", None)
    with pytest.raises(ImportError, match=r"mgca_filter\[poselib\]"):
        fit_epipolar(by_ratio(scene), FOCAL, EstimatorOptions("poselib"), calibrated=True)


def test_seeds_beyond_opencvs_integers_are_folded() -> None:
    assert usac_params("magsac", 1.0, 0.9, 10, 2**31 + 5).randomGeneratorState == 5


def test_homography_of_a_plane_holds_its_pose() -> None:
    plane = make_scene("planar", wrong=0, noise_px=0.0)
    rows = normalized(plane)
    H = fit_homography(rows[:, :2], rows[:, 2:], 1.0 / FOCAL)
    assert H is not None
    np.testing.assert_allclose(homography_distance(rows[:, :2], rows[:, 2:], H), 0, atol=1e-6)
    assert min(pose_error_deg(*pose, plane.R, plane.t) for pose in poses_from_homography(H)) < 0.1
    assert poses_from_homography(np.eye(3)) == []


def test_homography_without_enough_points_is_none() -> None:
    rows = normalized(make_scene("planar", wrong=0))
    assert fit_homography(rows[:3, :2], rows[:3, 2:], 1.0) is None
    assert fit_homography(np.zeros((9, 2)), np.zeros((9, 2)), 1.0) is None


def test_homography_is_the_same_in_any_unit() -> None:
    """OpenCV holds some constants in pixels: the threshold is the unit that counts."""
    plane = make_scene("planar", right=100, wrong=60)
    H = fit_homography(plane.points1, plane.points2, 2.0)
    small = fit_homography(plane.points1 / 500.0, plane.points2 / 500.0, 2.0 / 500.0)
    unit = np.diag([1 / 500.0, 1 / 500.0, 1.0])
    np.testing.assert_allclose(np.linalg.inv(unit) @ small @ unit, H, rtol=1e-6, atol=1e-9)
    right = plane.inlier
    assert np.median(homography_distance(plane.points1[right], plane.points2[right], H)) < 0.6


def test_homography_seed_draws_other_samples() -> None:
    plane = make_scene("planar", right=30, wrong=270, noise_px=1.0)
    found = [fit_homography(plane.points1, plane.points2, 2.0, seed) for seed in (0, 0, 1, 2, 3)]
    np.testing.assert_array_equal(found[0], found[1])
    assert len({H.tobytes() for H in found if H is not None}) > 1


def test_essential_matrix_of_the_truth_fits_exact_points() -> None:
    exact = make_scene(wrong=0, noise_px=0.0)
    assert sampson_distance(normalized(exact), essential_from_pose(exact.R, exact.t)).max() < 1e-12


def test_homography_in_order_draws_the_promising_points_first() -> None:
    """A dozen right matches among hundreds: too few to be met by chance in a thousand samples."""
    met = {True: 0, False: 0}
    for seed in range(4):
        plane = make_scene("planar", right=15, wrong=400, seed=seed)
        good_first = np.argsort(plane.attributes.ratio, kind="stable")
        for ordered in met:
            H = fit_homography(plane.points1[good_first], plane.points2[good_first], 2.0, seed, ordered)
            right = plane.inlier
            distance = np.inf if H is None else homography_distance(plane.points1[right], plane.points2[right], H)
            met[ordered] += bool(np.median(distance) < 2.0)
    assert met == {True: 4, False: 0}
