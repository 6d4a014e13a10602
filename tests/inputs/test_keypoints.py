"""Keypoints in, from every type that OpenCV pipelines hold; detection in pixels of the original."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mgca_filter.features import create_detector, detect_keypoints
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


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    """Structured noise, 1800 x 1350."""
    noise = np.random.default_rng(0).integers(0, 256, (90, 120)).astype(np.uint8)
    return cv2.resize(noise, (1800, 1350), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("name", ["sift", "orb", "akaze"])
def test_detectors_find_described_keypoints_inside_the_image(name: str, photograph: np.ndarray) -> None:
    keypoints, descriptors = detect_keypoints(photograph, create_detector(name, 300))
    points = read_keypoints(keypoints).points
    assert len(keypoints) == len(descriptors) > 50
    assert points.max(axis=0)[0] > 1500
    assert (points >= 0).all()
    assert (points < [1800, 1350]).all()


def test_detection_in_a_shrunk_copy_returns_pixels_of_the_original(photograph: np.ndarray) -> None:
    # A keypoint of the detector's image lies where its pixel's area lies in the original: corners stay corners.
    small = cv2.resize(photograph, (1200, 900), interpolation=cv2.INTER_AREA)
    detector = create_detector("sift", 200)
    seen = read_keypoints(detector.detectAndCompute(small, None)[0])
    returned = read_keypoints(detect_keypoints(photograph, detector)[0])
    np.testing.assert_allclose(returned.points, (seen.points + 0.5) * 1.5 - 0.5, atol=1e-3)
    np.testing.assert_allclose(returned.size, seen.size * 1.5, rtol=1e-5)


def test_colour_and_grey_images_agree(photograph: np.ndarray) -> None:
    detector = create_detector("sift", 100)
    grey = detect_keypoints(photograph[:400, :400], detector)[1]
    colour = detect_keypoints(cv2.cvtColor(photograph[:400, :400], cv2.COLOR_GRAY2BGR), detector)[1]
    np.testing.assert_array_equal(grey, colour)


def test_blank_image_has_no_keypoints() -> None:
    keypoints, descriptors = detect_keypoints(np.zeros((50, 50), dtype=np.uint8), create_detector())
    assert keypoints == []
    assert len(descriptors) == 0


@pytest.mark.parametrize(
    ("image", "error"),
    [(np.zeros((5, 5)), TypeError), ("file.png", TypeError), (None, TypeError)]
    + [(np.zeros(shape, dtype=np.uint8), ValueError) for shape in [(5,), (0, 5), (5, 5, 2)]],
)
def test_what_is_no_image_is_named(image: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="image1"):
        detect_keypoints(image, create_detector(), "image1")


def test_unknown_detector_and_count_are_refused() -> None:
    with pytest.raises(ValueError, match="detector"):
        create_detector("surf")
    with pytest.raises(ValueError, match="feature_count"):
        create_detector("sift", 0)


@pytest.mark.parametrize("name", ["sift", "orb", "akaze"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (500, 2), (1, 3000), (6, 6), (7, 2500)])
def test_images_of_a_few_pixels_are_data(name: str, shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    keypoints, descriptors = detect_keypoints(noise, create_detector(name))
    assert len(keypoints) == len(descriptors)


def test_a_detector_that_does_not_describe_is_refused(photograph: np.ndarray) -> None:
    with pytest.raises(TypeError, match="detector: expected one that describes, got FastFeatureDetector"):
        detect_keypoints(photograph[:200, :200], cv2.FastFeatureDetector.create())
