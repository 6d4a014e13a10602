"""Whatever container OpenCV and Python programs hold keypoints and matches in gives the same answer."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
import pytest
from conftest import K, make_scene

from mgca_filter import MatchFilter, matchMGCA
from mgca_filter.inputs.containers import unpacked

SCENE = make_scene(seed=3, right=80, wrong=40)
KEYPOINTS1, KEYPOINTS2 = SCENE.keypoints()
KNN = SCENE.knn_matches()
FLAT = [row[0] for row in KNN]


def objects(items: list) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


@pytest.fixture(scope="module")
def answer(model_file):
    match_filter = MatchFilter(model=model_file)
    return lambda kp1, kp2, matches: match_filter.filter(kp1, kp2, matches, K1=K)


@pytest.mark.parametrize("hold", [tuple, objects, deque, iter, lambda items: (item for item in items),
                                  lambda items: np.array(items)[:, None],
                                  lambda items: dict(enumerate(items)).values()])  # fmt: skip
def test_keypoints_in_any_container(answer, hold):
    expected = answer(KEYPOINTS1, KEYPOINTS2, FLAT)
    found = answer(hold(KEYPOINTS1), hold(KEYPOINTS2), FLAT)
    np.testing.assert_array_equal(found.scores, expected.scores)
    np.testing.assert_array_equal(found.mask, expected.mask)


@pytest.mark.parametrize("rows", [FLAT, KNN], ids=["DMatch", "knnMatch"])
@pytest.mark.parametrize("hold", [tuple, np.array, deque, iter, lambda items: filter(None, items)])
def test_matches_in_any_container(answer, rows, hold):
    expected = answer(KEYPOINTS1, KEYPOINTS2, rows)
    found = answer(KEYPOINTS1, KEYPOINTS2, hold(rows))
    np.testing.assert_array_equal(found.scores, expected.scores)
    assert len(found.matches) == expected.num_inliers
    kept = [match.queryIdx for match in expected.dmatches]
    assert [match.queryIdx for match in found.dmatches] == kept
    assert [(row if isinstance(row, cv2.DMatch) else row[0]).queryIdx for row in found.matches] == kept


def test_rows_that_are_object_arrays(answer):
    expected = answer(KEYPOINTS1, KEYPOINTS2, KNN)
    found = answer(KEYPOINTS1, KEYPOINTS2, [np.array(row) for row in KNN])
    np.testing.assert_array_equal(found.scores, expected.scores)


@pytest.mark.parametrize("shape", [(-1, 2), (-1, 1, 2), (1, -1, 2)])
@pytest.mark.parametrize("hold", [np.asarray, lambda p: p.astype(np.float32), cv2.UMat, lambda p: p.astype(object)])
def test_points_in_the_layouts_of_opencv(answer, shape, hold):
    points1, points2 = (np.round(points) for points in (SCENE.points1, SCENE.points2))
    expected = answer(points1, points2, None)
    found = answer(hold(points1.reshape(shape)), hold(points2.reshape(shape)), None)
    np.testing.assert_array_equal(found.mask, expected.mask)


def test_an_object_array_stays_an_object_array(answer):
    matches = np.array(FLAT)
    kept = answer(KEYPOINTS1, KEYPOINTS2, matches).matches
    assert isinstance(kept, np.ndarray)
    assert kept.dtype == object


def test_match_mgca_takes_object_arrays():
    kept = matchMGCA((640, 480), (640, 480), KEYPOINTS1, KEYPOINTS2, np.array(FLAT))
    assert [m.queryIdx for m in kept] == [
        m.queryIdx for m in matchMGCA((640, 480), (640, 480), KEYPOINTS1, KEYPOINTS2, FLAT)
    ]


@pytest.mark.parametrize("value", [{1, 2}, {"a": 1}, "words", cv2.KeyPoint(1, 2, 3), np.arange(3), 7, None])
def test_what_keeps_no_order_and_what_is_plain_is_left_alone(value):
    assert unpacked(value) is value


@pytest.mark.parametrize("wrong", [{1, 2}, "points", 3, [object()], (x for x in ("a", "b")), np.array([None, 1])])
def test_other_things_are_refused_by_name(answer, wrong):
    with pytest.raises((TypeError, ValueError), match="kp1"):
        answer(wrong, KEYPOINTS2, FLAT)
