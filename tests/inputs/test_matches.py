"""Matches in, from every type that OpenCV pipelines hold, and out again in the same type."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mgca_filter.inputs.attributes import best_of_list, distance_ratio
from mgca_filter.inputs.matches import read_matches

DMATCHES = [cv2.DMatch(0, 2, 5.0), cv2.DMatch(1, 2, 3.0), cv2.DMatch(2, 0, 4.0)]
KNN = [(cv2.DMatch(0, 1, 2.0), cv2.DMatch(0, 2, 4.0)), (cv2.DMatch(1, 1, 3.0),), ()]


def test_dmatch_gives_indices_and_best_of_list() -> None:
    read = read_matches(DMATCHES, 3, 3)
    assert read.index1.tolist() == [0, 1, 2]
    assert read.index2.tolist() == [2, 2, 0]
    assert read.ratio is None
    assert read.best is not None
    assert read.best.tolist() == [False, True, True]


def test_knn_rows_give_the_ratio_and_may_be_short_or_empty() -> None:
    read = read_matches(KNN, 3, 3)
    assert read.index1.tolist() == [0, 1, -1]
    assert read.ratio is not None
    np.testing.assert_array_equal(read.ratio, np.array([0.5, np.nan, np.nan], dtype=np.float32))
    assert read.best is not None
    assert read.best.tolist() == [True, False, False]


def test_equal_or_missing_distances_say_nothing_about_best() -> None:
    assert read_matches([cv2.DMatch(0, 0, 0.0), cv2.DMatch(1, 0, 0.0)], 2, 1).best is None
    assert read_matches([cv2.DMatch(), cv2.DMatch()][:0], 2, 1).best is None
    unset = cv2.DMatch()
    unset.queryIdx = unset.trainIdx = 0
    assert read_matches([unset, cv2.DMatch(1, 0, 1.0)], 2, 1).best is None


@pytest.mark.parametrize("container", [list, tuple])
@pytest.mark.parametrize("rows", [DMATCHES, KNN])
def test_selection_returns_the_callers_objects_and_container(container: type, rows: list) -> None:
    source = container(rows)
    kept = read_matches(source, 3, 3).select(np.array([True, False, True]))
    assert isinstance(kept, container)
    assert kept[0] is source[0]
    assert kept[1] is source[2]


def test_selection_of_arrays_and_of_row_by_row_matches() -> None:
    pairs = np.array([[0, 1], [1, 0]], dtype=np.int32)
    kept = read_matches(pairs, 2, 2).select(np.array([False, True]))
    assert kept.dtype == np.int32
    assert kept.tolist() == [[1, 0]]
    assert read_matches(None, 2, 2).select(np.array([False, True])).tolist() == [[1, 1]]


@pytest.mark.parametrize("empty", [[], (), np.zeros((0, 2), dtype=int), np.array([])])
def test_empty_matches(empty: object) -> None:
    read = read_matches(empty, 0, 0)
    assert len(read) == 0
    assert len(read.select(np.zeros(0, dtype=bool))) == 0


@pytest.mark.parametrize(
    ("value", "error"),
    [
        ([cv2.DMatch(0, 3, 1.0)], ValueError),
        ([cv2.DMatch(-1, 0, 1.0)], ValueError),
        (np.array([[0, 3]]), ValueError),
        (np.array([[2**63, 0]], dtype=np.uint64), ValueError),
        (np.zeros((2, 3), dtype=int), ValueError),
        (np.zeros((2, 2)), TypeError),
        (cv2.DMatch(0, 0, 1.0), TypeError),
        ("matches", TypeError),
        ([cv2.DMatch(0, 0, 1.0), (0, 0)], TypeError),
        ([(cv2.DMatch(0, 0, 1.0),), (0, 0)], TypeError),
        ([[0, 1], [0]], ValueError),
    ],
)
def test_misuse_names_the_argument(value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="matches"):
        read_matches(value, 3, 3)


def test_none_needs_equally_many_keypoints() -> None:
    with pytest.raises(ValueError, match="row i matches row i"):
        read_matches(None, 2, 3)


@given(st.lists(st.tuples(st.floats(0, 1e6), st.floats(0, 1e6)), max_size=20))
def test_ratio_stays_between_zero_and_one(distances: list[tuple[float, float]]) -> None:
    nearest, second = np.array(distances).reshape(-1, 2).T
    ratio = distance_ratio(nearest, second)
    assert ((ratio >= 0) & (ratio <= 1)).all()


def test_two_candidates_at_distance_zero_are_ambiguous() -> None:
    assert distance_ratio(np.zeros(1), np.zeros(1))[0] == 1.0


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 9)), min_size=1, max_size=30), st.randoms())
def test_best_of_list_does_not_depend_on_the_order(rows: list[tuple[int, int]], random) -> None:  # noqa: ANN001
    index, distance = np.array(rows).T
    best = best_of_list(index, distance.astype(float))
    shuffled = random.sample(range(len(rows)), len(rows))
    again = best_of_list(index[shuffled], distance[shuffled].astype(float))
    assert (best is None) == (again is None)
    np.testing.assert_array_equal(None if best is None else best[shuffled], again)
