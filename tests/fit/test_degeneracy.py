"""Verdicts on synthetic pairs of every kind: what deserves trust stays OK, what does not is named."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import SIZE, K, Scene, make_scene

from mgca_filter import FilterResult, MatchFilter, Status
from mgca_filter.fit.degeneracy import (
    Support,
    chance_rate,
    explains,
    fit_rotation,
    line_distance,
    log10_false_alarms,
    may_explain,
    may_lie_on_line,
    may_only_turn,
    measure_support,
)
from mgca_filter.fit.focal_check import FOCAL_STEP, better_focal_factor
from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import pose_error_deg, rotation_error_deg, translation_error_deg
from mgca_filter.geometry.homography import homography_distance
from mgca_filter.geometry.pose_refinement import refine_pose


def run(match_filter: MatchFilter, scene: Scene, **options: object) -> FilterResult:
    options = {"K1": K, **options}
    return match_filter.filter(scene.points1, scene.points2, None, attributes=scene.attributes, **options)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("right", "wrong"), [(120, 80), (100, 500), (300, 30)])
def test_general_scene_is_ok(match_filter: MatchFilter, right: int, wrong: int, seed: int) -> None:
    scene = make_scene(right=right, wrong=wrong, seed=seed)
    result = run(match_filter, scene)
    assert result.status is Status.OK
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 2.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("right", "wrong"), [(120, 80), (200, 300)])
def test_plane_keeps_the_pose_and_adds_the_homography(
    match_filter: MatchFilter, right: int, wrong: int, seed: int
) -> None:
    result = run(match_filter, make_scene("planar", right, wrong, seed=seed))
    assert result.status is Status.PLANAR
    assert result.info["homography"].shape == (3, 3)
    assert result.E is not None
    assert result.R is not None
    assert result.t is not None


def test_plane_without_intrinsics_has_no_pose(match_filter: MatchFilter) -> None:
    result = run(match_filter, make_scene("planar"), K1=None, size1=SIZE, size2=SIZE)
    assert result.status is Status.PLANAR
    assert result.E is None
    assert result.R is None
    assert result.F is not None
    assert result.num_inliers > 100


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("right", "wrong"), [(120, 80), (60, 500)])
def test_rotation_has_no_translation(match_filter: MatchFilter, right: int, wrong: int, seed: int) -> None:
    scene = make_scene("rotation", right, wrong, seed=seed)
    result = run(match_filter, scene)
    assert result.status is Status.PURE_ROTATION
    assert rotation_error_deg(result.R, scene.R) < 0.1
    assert result.t is None
    assert result.E is None
    assert result.info["homography"][2, 2] == 1.0
    assert np.count_nonzero(result.mask & scene.inlier) > 0.8 * right


def test_collinear_points_have_no_geometry(match_filter: MatchFilter) -> None:
    result = run(match_filter, make_scene("collinear"))
    assert result.status is Status.NO_GEOMETRY
    assert result.E is None
    assert not result.mask.any()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("intrinsics", [K, None])
def test_only_wrong_matches_have_no_model(match_filter: MatchFilter, seed: int, intrinsics: np.ndarray | None) -> None:
    result = run(match_filter, make_scene(right=0, wrong=300, seed=seed), K1=intrinsics)
    assert result.status in (Status.UNRELATED, Status.NO_GEOMETRY)
    assert result.E is None
    assert result.R is None
    assert not result.mask.any()


def test_weak_support_is_named(match_filter: MatchFilter) -> None:
    """Twelve right matches among sixty wrong ones: mostly the pose is right, and nothing vouches for it."""
    results = [run(match_filter, make_scene(right=12, wrong=60, seed=seed)) for seed in range(5)]
    statuses = [result.status for result in results]
    assert Status.LOW_SUPPORT in statuses
    assert Status.OK not in statuses
    assert all(result.confidence is None or result.confidence <= 0.5 for result in results)


@pytest.mark.parametrize("seed", range(8))
def test_few_right_matches_are_ok_where_the_pose_is_right(match_filter: MatchFilter, seed: int) -> None:
    """Twelve of twenty-two: far more than chance, and near the truth."""
    scene = make_scene(right=12, wrong=10, seed=seed)
    result = run(match_filter, scene)
    assert result.status is Status.OK
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 5.0
    assert result.confidence < 0.97
    assert result.mask[scene.inlier].mean() > 0.8


@pytest.mark.parametrize("seed", range(3))
def test_wrong_intrinsics_are_suspected(match_filter: MatchFilter, seed: int) -> None:
    scene = make_scene("wide", right=200, wrong=40, seed=seed)
    wrong_K = K.copy()
    wrong_K[0, 0], wrong_K[:2, 2] = 2400.0, (1279.5, 959.5)
    assert run(match_filter, scene, K1=wrong_K).status is Status.SUSPICIOUS_INTRINSICS
    assert run(match_filter, scene).status is Status.OK


def test_false_alarms_fall_with_support_and_rise_with_chance() -> None:
    values = [log10_false_alarms(100, inliers, 0.05) for inliers in range(10, 100, 10)]
    assert values == sorted(values, reverse=True)
    assert log10_false_alarms(100, 40, 0.2) > log10_false_alarms(100, 40, 0.02)
    assert log10_false_alarms(100, 5, 0.01) == float("inf")


def test_chance_rate_is_that_of_random_pairings() -> None:
    rng = np.random.default_rng(0)
    E = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # sideways motion: the distance is |y2 - y1| / sqrt(2)
    rows = rng.uniform(-1, 1, (600, 4))
    # |y2 - y1| < d for uniform y in [-1, 1]: 1 - (1 - d / 2)^2
    d = 0.1 * np.sqrt(2)
    assert chance_rate(rows, E, 0.1) == pytest.approx(1 - (1 - d / 2) ** 2, abs=0.02)
    support = measure_support(np.vstack([rows, rows]), E, 0.1)
    assert support.count == np.count_nonzero(np.abs(rows[:, 3] - rows[:, 1]) < d)
    assert support.chance_count == pytest.approx(support.count, abs=25)


def test_line_and_rotation_fits_set_outliers_aside() -> None:
    rng = np.random.default_rng(0)
    line = np.column_stack([np.linspace(0, 10, 80), np.linspace(0, 5, 80)])
    points = np.vstack([line, rng.uniform(0, 10, (8, 2))])
    assert np.all(line_distance(points, 0.05)[:80] < 0.05)
    scene = make_scene("rotation", right=100, wrong=10, noise_px=0.0)
    rows = np.hstack([(p - K[:2, 2]) / K[0, 0] for p in (scene.points1, scene.points2)])
    assert rotation_error_deg(fit_rotation(rows, 1 / K[0, 0]), scene.R) < 1e-3


@pytest.mark.parametrize("wrong", [0, 6, 40, 150])
@pytest.mark.parametrize("seed", range(5))
def test_no_line_and_no_rotation_that_explains_is_ruled_out_beforehand(seed: int, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    along = np.column_stack([rng.uniform(0, 10, 80), rng.normal(0, 0.03, 80)])
    points = rng.permutation(np.vstack([along, rng.uniform(0, 10, (wrong, 2))]))
    scene = make_scene("rotation", right=100, wrong=wrong, noise_px=0.4, seed=seed)
    rows = rng.permutation(np.hstack([normalize_points(p, K) for p in (scene.points1, scene.points2)]))
    R = fit_rotation(rows, 1 / K[0, 0])
    distance_px = homography_distance(*(rows[:, i : i + 2] * K[0, 0] for i in (0, 2)), homography_in_focals(R))
    lines, turns = [], []
    for chance_count in (0.0, 10.0, 50.0):
        support = Support(80 + wrong, -9.0, chance_count)
        lines.append((explains(line_distance(points, 0.05), 0.05, support), may_lie_on_line(points, 0.05, support)))
        support = Support(100 + wrong, -9.0, chance_count)
        turns.append((explains(distance_px, 1.0, support), may_only_turn(rows, 1 / K[0, 0], support)))
    assert all(possible >= found for found, possible in [*lines, *turns])
    assert all(found for found, _ in [*lines, *turns]) == (wrong == 0)


def homography_in_focals(R: np.ndarray) -> np.ndarray:
    """A rotation as a homography of points on the image planes times the focal length."""
    zoom = np.diag([K[0, 0], K[0, 0], 1.0])
    return zoom @ R @ np.linalg.inv(zoom)


def test_a_general_scene_is_neither_line_nor_rotation_before_either_is_fitted() -> None:
    scene = make_scene(right=200, wrong=10)
    rows = np.hstack([normalize_points(p, K) for p in (scene.points1, scene.points2)])
    support = Support(200, -9.0, 5.0)
    assert not may_lie_on_line(rows[:, :2], 1 / K[0, 0], support)
    assert not may_only_turn(rows, 1 / K[0, 0], support)
    few = np.where(np.arange(210) < 100, 0.5, 50.0)
    assert not may_explain(few, 1.0, support)
    assert may_explain(np.where(np.arange(210) < 170, 0.5, 50.0), 1.0, support)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("factor", [0.7, 1.5])
def test_wrong_focal_length_is_suspected_and_told(match_filter: MatchFilter, factor: float, seed: int) -> None:
    scene = make_scene("skew", right=200, wrong=40, seed=seed)
    wrong_K = K * np.array([[factor, factor, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    result = run(match_filter, scene, K1=wrong_K)
    assert result.status is Status.SUSPICIOUS_INTRINSICS
    assert abs(np.log(result.info["focal_factor"] * factor)) < 1.5 * np.log(FOCAL_STEP)
    assert result.E is not None
    assert "focal_factor" not in run(match_filter, scene).info


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["general", "wide", "skew", "planar"])
def test_right_focal_length_will_do(kind: str, seed: int) -> None:
    scene = make_scene(kind, right=300, wrong=0, noise_px=0.5, seed=seed)
    x = np.hstack([normalize_points(scene.points1, K), normalize_points(scene.points2, K)])
    assert better_focal_factor(x, scene.R, scene.t, 1.0 / K[0, 0]) is None


@pytest.mark.parametrize("scale", [0.7, 1.5])
def test_better_focal_factor_undoes_a_scale(scale: float) -> None:
    scene = make_scene("skew", right=300, wrong=30, seed=1)
    x = np.hstack([normalize_points(scene.points1, K), normalize_points(scene.points2, K)]) * scale
    threshold = scale / K[0, 0]
    pose = refine_pose(x, scene.R, scene.t, 20.0 * threshold)
    factor = better_focal_factor(x, *refine_pose(x, *pose, threshold), threshold)
    assert factor is not None
    assert abs(np.log(factor / scale)) < 1.5 * np.log(FOCAL_STEP)


@pytest.mark.parametrize("count", [0, 3, 20])
def test_hopeless_matches_ask_for_no_other_focal_length(count: int) -> None:
    scene = make_scene()
    assert better_focal_factor(np.zeros((count, 4)), scene.R, scene.t, 1.0 / K[0, 0]) is None


@pytest.mark.parametrize("relief", [0.02, 0.2])
@pytest.mark.parametrize("wrong", [0, 150])
def test_a_long_lens_on_a_shallow_relief(relief: float, wrong: int) -> None:
    """Focal length 11365 px, an object 1 m away, translation alone: OpenCV's directions are off by up to 12 degrees."""
    rng = np.random.default_rng(0)
    lens = np.array([[11365.0, 0.0, 1023.5], [0.0, 11365.0, 767.5], [0.0, 0.0, 1.0]])
    pixels = rng.uniform((0, 0), (2048, 1536), (300, 2))
    X = np.column_stack([(pixels - lens[:2, 2]) / 11365.0, np.ones(300)]) * (1.0 + rng.uniform(0, relief, (300, 1)))
    t = np.array([0.03, 0.01, 0.005])
    Y = (X + t) @ lens.T
    second = Y[:, :2] / Y[:, 2:]
    first, second = (points + rng.normal(0, 0.2, points.shape) for points in (pixels, second))
    second[:wrong] = second[rng.permutation(wrong)]
    result = MatchFilter().filter(first, second, None, K1=lens)
    assert result.status in (Status.OK, Status.PLANAR)
    assert result.mask[wrong:].mean() > 0.95
    assert translation_error_deg(result.t, t) < 5.0
