"""Detect, match, attributes: in pixels of the original, and the same whoever asks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mgca_filter.features import (
    ImageFeatures,
    attributes_of_matches,
    create_detector,
    describe,
    descriptor_distances,
    detect_keypoints,
    match_descriptors,
    match_features,
)
from mgca_filter.inputs.keypoints import read_keypoints
from mgca_filter.inputs.matches import read_matches


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


def test_nearest_neighbours_by_both_norms() -> None:
    descriptors = np.eye(4, dtype=np.float32)
    rows = match_descriptors(descriptors, descriptors[::-1].copy())
    assert [row[0].trainIdx for row in rows] == [3, 2, 1, 0]
    assert all(len(row) == 2 for row in rows)
    binary = np.array([[0], [255]], dtype=np.uint8)
    assert [row[0].distance for row in match_descriptors(binary, binary[:1])] == [0.0, 8.0]


def test_no_descriptors_no_matches_and_unequal_ones_are_refused() -> None:
    floats = np.zeros((2, 4), dtype=np.float32)
    assert match_descriptors(floats, np.zeros((0, 0), dtype=np.float32)) == ()
    with pytest.raises(ValueError, match="descriptors2"):
        match_descriptors(floats, np.zeros((2, 8), dtype=np.float32))


@pytest.fixture(scope="module")
def both(photograph: np.ndarray) -> tuple[ImageFeatures, ImageFeatures]:
    """Features of the image, and of its middle moved and enlarged."""
    detector = create_detector("sift", 300)
    moved = cv2.resize(photograph[300:900, 400:1200], (1200, 900), interpolation=cv2.INTER_AREA)
    return describe(photograph, detector), describe(moved, detector)


def test_features_are_what_the_detector_found(photograph: np.ndarray, both: tuple[ImageFeatures, ImageFeatures]):
    found, descriptors = detect_keypoints(photograph, create_detector("sift", 300))
    keypoints = read_keypoints(found)
    np.testing.assert_array_equal(both[0].points, keypoints.points)
    np.testing.assert_array_equal(both[0].size, keypoints.size)
    np.testing.assert_array_equal(both[0].angle, keypoints.angle)
    np.testing.assert_array_equal(both[0].descriptors, descriptors)
    assert both[0].image_size == (1800, 1350)
    assert both[0].K is None
    blank = describe(np.zeros((50, 60), dtype=np.uint8), create_detector())
    assert (len(blank), blank.image_size) == (0, (60, 50))


def test_features_of_some_rows(both: tuple[ImageFeatures, ImageFeatures]):
    rows = np.array([7, 2])
    some = replace(both[0], K=np.eye(3), descriptors=None).take(rows)
    np.testing.assert_array_equal(some.points, both[0].points[rows])
    np.testing.assert_array_equal(some.angle, both[0].angle[rows])
    assert some.descriptors is None
    assert (some.image_size, some.K.tolist()) == ((1800, 1350), np.eye(3).tolist())


def test_one_way_matches_are_those_of_the_matcher(both: tuple[ImageFeatures, ImageFeatures]):
    one, two = both
    matches = match_features(one, two)
    read = read_matches(match_descriptors(one.descriptors, two.descriptors), len(one), len(two))
    np.testing.assert_array_equal(matches.index1, np.arange(len(one)))
    np.testing.assert_array_equal(matches.index2, read.index2)
    np.testing.assert_array_equal(matches.attributes.ratio, read.ratio)
    np.testing.assert_array_equal(matches.attributes.best, read.best)
    np.testing.assert_array_equal(matches.attributes.size1, one.size)
    np.testing.assert_array_equal(matches.attributes.angle2, two.angle[read.index2])


def test_mutual_matches_are_so_from_either_side(both: tuple[ImageFeatures, ImageFeatures]):
    forth, back = match_features(*both), match_features(*both[::-1])
    pairs = {(i, int(j)) for i, j in enumerate(forth.index2) if forth.mutual[i]}
    assert pairs == {(int(j), i) for i, j in enumerate(back.index2) if back.mutual[i]}
    assert 0 < len(pairs) < len(forth.index2)
    assert forth.attributes.best[forth.mutual].all()


def test_images_with_hardly_any_keypoints_are_data(both: tuple[ImageFeatures, ImageFeatures]):
    one, two = both
    nothing = describe(np.zeros((50, 50), dtype=np.uint8), create_detector())
    for pair in ((one, nothing), (nothing, one), (nothing, nothing)):
        matches = match_features(*pair)
        assert len(matches.index1) == len(matches.index2) == len(matches.mutual) == 0
        assert matches.attributes.encode(0).shape == (0, 8)
    single = match_features(one, two.take(np.array([0])))
    assert np.isnan(single.attributes.ratio).all()
    assert single.mutual.sum() == 1


def test_given_matches_know_what_found_ones_know(both: tuple[ImageFeatures, ImageFeatures]):
    one, two = both
    found = match_features(one, two)
    pairs = np.stack([found.index1, found.index2], axis=1)
    given = attributes_of_matches(one, two, pairs)
    np.testing.assert_allclose(given.encode(len(pairs)), found.attributes.encode(len(pairs)), atol=1e-5)
    distance, other = descriptor_distances(one.descriptors, two.descriptors, pairs, block=64)
    np.testing.assert_allclose(distance, np.linalg.norm(one.descriptors - two.descriptors[pairs[:, 1]], axis=1))
    assert (distance <= other).all()


def test_what_features_do_not_know_matches_do_not_know(both: tuple[ImageFeatures, ImageFeatures]):
    one, two = both
    pairs = np.zeros((1, 2), dtype=np.intp)
    undescribed = attributes_of_matches(one, replace(two, descriptors=None), pairs)
    assert (undescribed.ratio, undescribed.best) == (None, None)
    assert undescribed.size2[0] == two.size[0]
    assert attributes_of_matches(one, two.take(np.array([0])), pairs).ratio is None
    points_alone = attributes_of_matches(ImageFeatures(one.points), two, pairs)
    assert all(value is None for value in vars(points_alone).values())
    assert attributes_of_matches(replace(one, angle=None), two, pairs).size2 is None
    with pytest.raises(ValueError, match="no descriptors"):
        match_features(ImageFeatures(one.points), two)
