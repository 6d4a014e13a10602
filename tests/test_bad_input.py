"""Data never raises, misuse always does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mgca_filter import FilterResult, MatchAttributes, MatchFilter, ModelError, Status, filter_matches

INTRINSICS = [None, K]


def assert_consistent(result: FilterResult, count: int) -> None:
    """What holds whatever the data."""
    assert isinstance(result.status, Status)
    assert result.mask.shape == result.scores.shape == (count,)
    assert np.isfinite(result.scores).all()
    assert ((result.scores >= 0) & (result.scores <= 1)).all()
    assert result.num_inliers == np.count_nonzero(result.mask) == len(result.matches)
    assert (result.R is None) or (result.E is not None) or result.status is Status.PURE_ROTATION
    for name, shape in (("E", (3, 3)), ("F", (3, 3)), ("R", (3, 3)), ("t", (3,))):
        value = getattr(result, name)
        assert value is None or (value.shape == shape and np.isfinite(value).all())
    if result.R is not None:
        np.testing.assert_allclose(result.R @ result.R.T, np.eye(3), atol=1e-6)
    if result.t is not None:
        assert np.linalg.norm(result.t) == pytest.approx(1.0)


def assert_no_model(result: FilterResult) -> None:
    assert result.E is None
    assert result.R is None
    assert result.t is None
    assert result.F is None
    assert not result.mask.any()


@pytest.mark.parametrize("intrinsics", INTRINSICS)
@pytest.mark.parametrize("method", ["prosac", "magsac", "ransac", "none"])
@pytest.mark.parametrize("count", range(6))
def test_too_few_matches(model_file: Path, count: int, method: str, intrinsics: Any) -> None:
    scene = make_scene(right=count, wrong=0)
    result = filter_matches(scene.points1, scene.points2, None, K1=intrinsics, method=method, model=model_file)
    assert_consistent(result, count)
    assert_no_model(result)
    assert result.status is Status.TOO_FEW_MATCHES


@pytest.mark.parametrize("matches", [[], (), np.zeros((0, 2), dtype=int), [()], [[], []]])
def test_empty_matches(match_filter: MatchFilter, matches: Any) -> None:
    result = match_filter.filter([cv2.KeyPoint(1, 2, 3)], [cv2.KeyPoint(1, 2, 3)], matches)
    assert_consistent(result, len(matches))
    assert result.status is Status.TOO_FEW_MATCHES


@pytest.mark.parametrize("empty", [[], (), np.zeros((0, 2)), np.zeros((0, 1, 2), dtype=np.float32)])
def test_no_keypoints_at_all(match_filter: MatchFilter, empty: Any) -> None:
    for matches in (None, []):
        result = match_filter.filter(empty, empty, matches)
        assert_consistent(result, 0)
        assert result.status is Status.TOO_FEW_MATCHES


@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_all_points_equal(match_filter: MatchFilter, intrinsics: Any) -> None:
    points = np.full((200, 2), 17.0)
    result = match_filter.filter(points, points, None, K1=intrinsics)
    assert_consistent(result, 200)
    assert_no_model(result)


@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_identical_images_give_no_translation(match_filter: MatchFilter, intrinsics: Any) -> None:
    points = np.random.default_rng(0).uniform(0, 480, (200, 2))
    result = match_filter.filter(points, points, None, K1=intrinsics, size1=SIZE, size2=SIZE)
    assert_consistent(result, 200)
    assert result.status is Status.PURE_ROTATION
    assert result.t is None
    np.testing.assert_allclose(result.R, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("intrinsics", INTRINSICS)
@pytest.mark.parametrize("kind", ["collinear", "planar", "rotation"])
def test_degenerate_scenes(match_filter: MatchFilter, kind: str, intrinsics: Any) -> None:
    for noise in (0.0, 0.3):
        scene = make_scene(kind, noise_px=noise)
        result = match_filter.filter(scene.points1, scene.points2, None, K1=intrinsics, attributes=scene.attributes)
        assert_consistent(result, 200)
        assert result.status is not Status.OK


@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_points_on_one_line_in_both_images(match_filter: MatchFilter, intrinsics: Any) -> None:
    points = np.column_stack([np.arange(100.0), 2 * np.arange(100.0)])
    result = match_filter.filter(points, points + 5.0, None, K1=intrinsics)
    assert_consistent(result, 100)
    assert_no_model(result)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, -1e30])
@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_unusable_coordinates_are_set_aside(match_filter: MatchFilter, value: float, intrinsics: Any) -> None:
    scene = make_scene()
    points1, points2 = scene.points1.copy(), scene.points2.copy()
    points1[3, 0] = points2[5, 1] = value
    result = match_filter.filter(
        points1, points2, None, K1=intrinsics, size1=SIZE, size2=SIZE, attributes=scene.attributes
    )
    assert_consistent(result, 200)
    assert result.status is Status.OK
    assert not result.mask[[3, 5]].any()
    assert (result.scores[[3, 5]] == 0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nothing_but_unusable_coordinates(match_filter: MatchFilter, value: float) -> None:
    points = np.full((50, 2), value)
    for options in ({}, {"K1": K}, {"K1": K, "dist1": [0.1, 0, 0, 0]}):
        result = match_filter.filter(points, points, None, **options)
        assert_consistent(result, 50)
        assert_no_model(result)


@pytest.mark.parametrize("intrinsics", INTRINSICS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("known", [True, False])
def test_only_outliers(match_filter: MatchFilter, intrinsics: Any, seed: int, known: bool) -> None:
    scene = make_scene(right=0, wrong=300, seed=seed)
    attributes = scene.attributes if known else None
    result = match_filter.filter(scene.points1, scene.points2, None, K1=intrinsics, attributes=attributes)
    assert_consistent(result, 300)
    assert_no_model(result)


@pytest.mark.slow
@pytest.mark.parametrize("intrinsics", INTRINSICS)
@pytest.mark.parametrize("method", ["prosac", "magsac", "ransac"])
def test_of_only_outliers_one_estimator_alone_makes_nothing_to_use(
    model_file: Path, method: str, intrinsics: Any
) -> None:
    """What several would have disagreed on, one may call doubtful, and no more."""
    for seed in range(3):
        scene = make_scene(right=0, wrong=300, seed=seed)
        result = filter_matches(scene.points1, scene.points2, None, K1=intrinsics, method=method, model=model_file)
        assert_consistent(result, 300)
        assert not result.ok
        assert result.status in (Status.UNRELATED, Status.NO_GEOMETRY, Status.LOW_SUPPORT)
        assert (result.confidence or 0.0) < 0.3


def test_duplicated_matches_do_not_add_support(match_filter: MatchFilter) -> None:
    scene = make_scene(right=5, wrong=0)
    rows = np.repeat(np.arange(5), 50)
    result = match_filter.filter(scene.points1, scene.points2, np.stack([rows, rows], axis=1), K1=K)
    assert_consistent(result, 250)
    assert result.status is Status.TOO_FEW_MATCHES
    whole = make_scene()
    rows = np.repeat(np.arange(200), 3)
    result = match_filter.filter(
        whole.points1,
        whole.points2,
        np.stack([rows, rows], axis=1),
        K1=K,
        attributes=whole.attributes.take(rows),
    )
    assert_consistent(result, 600)
    assert result.status is Status.OK
    assert result.info["support"] <= 200


def test_twenty_thousand_matches(match_filter: MatchFilter) -> None:
    points = np.random.default_rng(0).uniform(0, 640, (2, 20000, 2))
    result = match_filter.filter(points[0], points[1], None, K1=K)
    assert_consistent(result, 20000)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), count=st.integers(0, 24), known=st.booleans())
def test_any_coordinates_give_a_consistent_result(
    match_filter: MatchFilter, data: st.DataObject, count: int, known: bool
) -> None:
    points1, points2 = (data.draw(arrays(np.float64, (count, 2), elements=st.floats())) for _ in range(2))
    result = match_filter.filter(points1, points2, None, K1=K if known else None)
    assert_consistent(result, count)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), count=st.integers(8, 40), known=st.booleans())
def test_points_on_a_coarse_grid_give_a_consistent_result(
    match_filter: MatchFilter, data: st.DataObject, count: int, known: bool
) -> None:
    points1, points2 = (data.draw(arrays(np.int32, (count, 2), elements=st.integers(0, 5))) for _ in range(2))
    result = match_filter.filter(points1 * 100, points2 * 100, None, K1=K if known else None)
    assert_consistent(result, count)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=arrays(np.float32, (40,), elements=st.floats(width=32)))
def test_any_attributes_give_a_consistent_result(match_filter: MatchFilter, values: np.ndarray) -> None:
    scene = make_scene(right=30, wrong=10)
    attributes = MatchAttributes(values, values > 0, values, values[::-1], values, values[::-1])
    result = match_filter.filter(scene.points1, scene.points2, None, K1=K, attributes=attributes)
    assert_consistent(result, 40)


POINTS = np.random.default_rng(0).uniform(0, 100, (20, 2))
SINGULAR, HOMOGENEOUS = np.zeros((3, 3)), np.diag([1.0, 1.0, 2.0])


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("kp1", POINTS[:, :1], ValueError),
        ("kp2", "points", TypeError),
        ("matches", np.array([[0, 20]]), ValueError),
        ("matches", np.array([[-1, 0]]), ValueError),
        ("matches", np.zeros((4, 2)), TypeError),
        ("matches", [cv2.DMatch(0, 99, 1.0)], ValueError),
        ("K1", np.eye(4), ValueError),
        ("K1", SINGULAR, ValueError),
        ("K1", HOMOGENEOUS, ValueError),
        ("K1", np.full((3, 3), np.nan), ValueError),
        ("K1", "K", TypeError),
        ("K1", [[1, 2], [3]], ValueError),
        ("K2", np.eye(2), ValueError),
        ("dist1", [1.0, 2.0], ValueError),
        ("dist1", "none", TypeError),
        ("dist2", [np.nan] * 4, ValueError),
        ("size1", (640,), ValueError),
        ("size1", (0, 480), ValueError),
        ("size2", "large", TypeError),
        ("threshold", 0, ValueError),
        ("threshold", -1.0, ValueError),
        ("threshold", float("nan"), ValueError),
        ("threshold", float("inf"), ValueError),
        ("threshold", "1", TypeError),
        ("threshold", True, TypeError),
        ("keep_precision", 1.0, ValueError),
        ("keep_precision", 0, ValueError),
        ("keep_precision", "high", TypeError),
        ("confidence", 1.0, ValueError),
        ("confidence", 0.0, ValueError),
        ("confidence", None, TypeError),
        ("method", "lmeds", ValueError),
        ("method", 3.5, TypeError),
        ("backend", "tensorflow", ValueError),
        ("backend", None, TypeError),
        ("seed", -1, ValueError),
        ("seed", 1.5, TypeError),
        ("model", 3, TypeError),
        ("providers", "CPUExecutionProvider", TypeError),
        ("providers", [3], TypeError),
        ("attributes", {"ratio": [1]}, TypeError),
        ("attributes", MatchAttributes(ratio=np.zeros(19, dtype=np.float32)), ValueError),
        ("attributes", MatchAttributes(best=np.zeros(20, dtype=np.float32)), TypeError),
        ("attributes", MatchAttributes(size1=np.array(["a"] * 20)), TypeError),
    ],
)
def test_misuse_names_the_argument(name: str, value: Any, error: type[Exception], model_file: Path) -> None:
    arguments = {"kp1": POINTS, "kp2": POINTS, "matches": None, "K1": np.diag([9.0, 9.0, 1.0]), "model": model_file}
    arguments[name] = value
    with pytest.raises(error, match=name):
        filter_matches(**arguments)


@pytest.mark.parametrize("option", ["K2", "dist1", "dist2"])
def test_options_that_need_another_say_so(option: str, match_filter: MatchFilter) -> None:
    value = K if option == "K2" else [0.1, 0, 0, 0]
    with pytest.raises(ValueError, match="K1"):
        match_filter.filter(POINTS, POINTS, None, **{option: value})


def test_unknown_options_are_refused(match_filter: MatchFilter, model_file: Path) -> None:
    with pytest.raises(TypeError, match="treshold"):
        filter_matches(POINTS, POINTS, None, model=model_file, treshold=1.0)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"pairs\[0\]"):
        match_filter.filter_many([POINTS])  # type: ignore[list-item]


def test_unequal_keypoint_counts_need_matches(match_filter: MatchFilter) -> None:
    with pytest.raises(ValueError, match="matches"):
        match_filter.filter(POINTS, POINTS[:5], None)


def test_missing_model_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"absent\.onnx"):
        filter_matches(POINTS, POINTS, None, model=tmp_path / "absent.onnx")
