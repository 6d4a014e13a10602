"""Keypoints in, from every type that OpenCV pipelines hold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mgca_filter.inputs.keypoints import read_keypoints


def test_keypoint_sequence_keeps_position_size_and_angle() -> None:
    keypoints = read_keypoints((cv2.KeyPoint(1.5, 2.5, 7.0, 45.0), cv2.KeyPoint(3.0, 4.0, 2.0)))
    np.testing.assert_array_equal(keypoints.points, [[1.5, 2.5], [3.0, 4.0]])
    np.testing.assert_array_equal(keypoints.size, [7.0, 2.0])
    np.testing.assert_array_equal(keypoints.angle, [45.0, -1.0])


@given(arrays(np.float64, st.tuples(st.integers(0, 20), st.just(2)), elements=st.floats(-1e6, 1e6)))
def test_both_array_shapes_read_the_same(points: np.ndarray) -> None:
    np.testing.assert_array_equal(read_keypoints(points).points, points)
    np.testing.assert_array_equal(read_keypoints(points[:, None]).points, points)


@pytest.mark.parametrize("empty", [[], (), np.zeros((0, 2)), np.zeros((0, 1, 2)), np.array([])])
def test_empty_input_gives_no_keypoints(empty: object) -> None:
    assert read_keypoints(empty).points.shape == (0, 2)


def test_integer_pixels_and_lists_of_pairs_are_accepted() -> None:
    np.testing.assert_array_equal(read_keypoints(np.array([[1, 2]], dtype=np.int32)).points, [[1.0, 2.0]])
    np.testing.assert_array_equal(read_keypoints([(1.0, 2.0), (3.0, 4.0)]).points, [[1.0, 2.0], [3.0, 4.0]])


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (None, TypeError),
        ("points", TypeError),
        (cv2.KeyPoint(1, 2, 3), TypeError),
        ([cv2.KeyPoint(1, 2, 3), (1, 2)], TypeError),
        (np.zeros((3, 2), dtype=complex), TypeError),
        (np.zeros((3, 2), dtype=bool), TypeError),
        (np.zeros((3, 3)), ValueError),
        (np.zeros(4), ValueError),
        (np.zeros((0, 3)), ValueError),
        ([[1, 2], [3]], ValueError),
    ],
)
def test_misuse_names_the_argument(value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="kp1"):
        read_keypoints(value, "kp1")
