"""What the answer can do: compare, print, travel, draw."""

from __future__ import annotations

import copy
import json
import multiprocessing
import pickle

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from mgca_filter import FilterResult, MatchFilter, MatchPair, Status, match_images

SCENE = make_scene(seed=3, right=80, wrong=40)


@pytest.fixture(scope="module")
def match_filter(model_file) -> MatchFilter:
    return MatchFilter(model=model_file)


@pytest.fixture(scope="module")
def result(match_filter) -> FilterResult:
    return match_filter.filter(*SCENE.keypoints(), SCENE.knn_matches(), K1=K)


@pytest.mark.parametrize("status", Status)
def test_a_status_is_its_word(status):
    assert status == status.value
    assert status in (status.value, "other")
    assert f"{status}" == str(status) == f"{status:s}" == status.value
    assert f"{status:>25}" == f"{status.value:>25}"
    assert json.loads(json.dumps({"status": status})) == {"status": status.value}
    assert Status(status.value) is status
    assert {status: 1}[status.value] == 1
    assert pickle.loads(pickle.dumps(status)) is status


def test_a_result_is_true_where_its_geometry_may_be_used(match_filter, result):
    assert result.status == "ok"
    assert result.ok
    assert bool(result)
    few = match_filter.filter(SCENE.points1[:5], SCENE.points2[:5], None, K1=K)
    assert few.status == "too_few_matches"
    assert not few.ok
    assert not few


@pytest.mark.parametrize("status", Status)
@pytest.mark.parametrize("info", [{}, {"focal_doubt": True}])
def test_matches_are_verified_where_a_model_explains_them(status, info):
    """That of a pose which focal lengths alone make doubtful is such a model."""
    nothing = dict.fromkeys(("E", "F", "R", "t", "H"))
    answer = FilterResult(
        np.ones(9, bool), np.ones(9, np.float32), [], **nothing, status=status, num_inliers=9, info=info
    )
    explained = {Status.OK, Status.PLANAR, Status.PURE_ROTATION}
    assert answer.verified == (status in explained or bool(info))
    assert answer.ok <= answer.verified


def test_repr_fits_a_line(match_filter, result):
    image = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    matched = match_images(image, image, max_keypoints=50, model=match_filter._backends[0]._path)
    for answer in (result, matched):
        assert len(repr(answer)) < 120
        assert "\n" not in repr(answer)


def same(a: FilterResult, b: FilterResult) -> bool:
    return (
        np.array_equal(a.mask, b.mask)
        and np.array_equal(a.E, b.E)
        and [m.trainIdx for m in a.dmatches] == [m.trainIdx for m in b.dmatches]
        and [m.distance for m in a.dmatches] == [m.distance for m in b.dmatches]
    )


def test_results_and_pairs_travel(match_filter, result):
    assert same(pickle.loads(pickle.dumps(result)), result)
    assert same(copy.deepcopy(result), result)
    keypoints1, keypoints2 = SCENE.keypoints()
    pair = pickle.loads(pickle.dumps(MatchPair(keypoints1, keypoints2, SCENE.knn_matches(), K1=K)))
    assert same(match_filter.filter_many([pair])[0], result)
    keypoint = cv2.KeyPoint(1.5, 2.5, 3.0, 40.0, 0.5, 2, 7)
    again = pickle.loads(pickle.dumps(keypoint))
    fields = ("pt", "size", "angle", "response", "octave", "class_id")
    assert [getattr(again, f) for f in fields] == [getattr(keypoint, f) for f in fields]


def filter_in_a_child(job) -> FilterResult:
    match_filter, pair = job
    return match_filter.filter_many([pair])[0]


def test_results_leave_a_worker_process(match_filter, result):
    pair = MatchPair(*SCENE.keypoints(), SCENE.knn_matches(), K1=K)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (answer,) = pool.map(filter_in_a_child, [(match_filter, pair)])
    assert same(answer, result)


@pytest.mark.parametrize("form", ["knn", "flat", "array", "none"])
def test_the_kept_matches_can_be_drawn_by_opencv(match_filter, form):
    keypoints1, keypoints2 = SCENE.keypoints()
    rows = SCENE.knn_matches()
    matches = {"knn": rows, "flat": [row[0] for row in rows], "array": np.tile(np.arange(len(rows))[:, None], 2)}
    result = match_filter.filter(keypoints1, keypoints2, matches.get(form), K1=K)
    image = np.zeros(SIZE[::-1], np.uint8)
    drawn = cv2.drawMatches(image, keypoints1, image, keypoints2, result.dmatches, None)
    assert drawn.shape[1] == 2 * SIZE[0]
    assert [m.queryIdx for m in result.dmatches] == list(np.flatnonzero(result.mask))


def test_draw_shows_both_images(result):
    image = np.full((*SIZE[::-1], 3), 90, np.uint8)
    picture = result.draw(image, image)
    assert picture.dtype == np.uint8
    assert picture.shape[1] > picture.shape[0]
    green = (picture[..., 1].astype(int) - picture[..., 2]) > 60
    assert green.any()


def test_points_are_those_that_came_in(result):
    keypoints1, _ = SCENE.keypoints()
    np.testing.assert_allclose(result.points1, [k.pt for k in keypoints1])
    np.testing.assert_array_equal(result.indices[:, 0], np.arange(len(result.mask)))


def test_relative_pose_moves_points(match_filter, result):
    T = result.relative_pose(baseline=2.5)
    X1 = np.array([0.3, -0.2, 4.0])
    np.testing.assert_allclose((T @ [*X1, 1.0])[:3], result.R @ X1 + 2.5 * result.t)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert match_filter.filter(SCENE.points1[:5], SCENE.points2[:5], None).relative_pose() is None


@pytest.mark.parametrize(
    ("flag", "name"), [(cv2.USAC_MAGSAC, "magsac"), (cv2.USAC_PROSAC, "prosac"), (cv2.RANSAC, "ransac")]
)
def test_flags_of_opencv_name_a_method(flag, name, model_file):
    assert MatchFilter(method=flag, model=model_file).options.method == name


@pytest.mark.parametrize("flag", [cv2.LMEDS, cv2.USAC_FAST, 9999])
def test_other_flags_get_a_hint(flag, model_file):
    with pytest.raises(ValueError, match="method: OpenCV's flag .* cv2.USAC_MAGSAC"):
        MatchFilter(method=flag, model=model_file)


def test_K_is_shared(match_filter, result):
    shared = match_filter.filter(*SCENE.keypoints(), SCENE.knn_matches(), K=K)
    np.testing.assert_array_equal(shared.E, result.E)
    with pytest.raises(ValueError, match="K: both images share it"):
        match_filter.filter(*SCENE.keypoints(), SCENE.knn_matches(), K=K, K1=K)


@pytest.mark.parametrize("spoil", [np.nan, np.inf, 1e300])
def test_data_never_raises_where_numpy_is_told_to(match_filter, spoil):
    points = SCENE.points1.copy()
    points[0] = spoil
    with np.errstate(all="raise"):
        result = match_filter.filter(points, SCENE.points2, None, K1=K)
        empty_row = match_filter.filter(*SCENE.keypoints(), [(), *SCENE.knn_matches()[1:]], K1=K)
        assert np.geterr()["under"] == "raise"
    assert not result.mask[0]
    assert not empty_row.mask[0]
