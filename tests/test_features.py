"""Detect, match, attributes: in pixels of the original, and the same whoever asks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mgca_filter.features import (
    DETECTORS,
    ImageFeatures,
    RootSift,
    attributes_of_matches,
    create_detector,
    describe,
    descriptor_distances,
    detect_keypoints,
    match_descriptors,
    match_features,
    match_with,
    root_sift,
)
from mgca_filter.inputs.keypoints import read_keypoints
from mgca_filter.inputs.matches import read_matches


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    """Structured noise, 1800 x 1350."""
    noise = np.random.default_rng(0).integers(0, 256, (90, 120)).astype(np.uint8)
    return cv2.resize(noise, (1800, 1350), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("name", DETECTORS)
def test_detectors_find_described_keypoints_inside_the_image(name: str, photograph: np.ndarray) -> None:
    keypoints, descriptors = detect_keypoints(photograph, create_detector(name, 300))
    points = read_keypoints(keypoints).points
    assert 300 >= len(keypoints) == len(descriptors) > 50
    assert points.max(axis=0)[0] > 1500
    assert (points >= 0).all()
    assert (points < [1800, 1350]).all()


def test_a_limit_keeps_the_strongest_in_the_detectors_order(photograph: np.ndarray) -> None:
    few, many = (detect_keypoints(photograph, create_detector("brisk", count)) for count in (40, 20_000))
    response = np.array([keypoint.response for keypoint in many[0]])
    rows = np.sort(np.argsort(-response, kind="stable")[:40])
    assert len(many[0]) > 300
    assert [keypoint.pt for keypoint in few[0]] == [many[0][row].pt for row in rows]
    np.testing.assert_array_equal(few[1], many[1][rows])


def test_root_sift_has_the_keypoints_of_sift_and_hellingers_distance(photograph: np.ndarray) -> None:
    plain, root = (detect_keypoints(photograph, create_detector(name, 100)) for name in ("sift", "rootsift"))
    assert [keypoint.pt for keypoint in plain[0]] == [keypoint.pt for keypoint in root[0]]
    assert root[1].dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(root[1], axis=1), 1.0, rtol=1e-6)
    share = plain[1].astype(np.float64) / plain[1].sum(axis=1, keepdims=True)
    affinity = np.sqrt(share[0] * share[1]).sum()
    np.testing.assert_allclose(np.sum((root[1][0] - root[1][1]) ** 2.0), 2.0 - 2.0 * affinity, rtol=1e-5)


def test_root_sift_knows_no_scale_and_no_zero_divisor() -> None:
    descriptors = np.random.default_rng(0).integers(0, 256, (5, 128)).astype(np.float32)
    np.testing.assert_allclose(root_sift(3.0 * descriptors), root_sift(descriptors), rtol=1e-6)
    np.testing.assert_array_equal(root_sift(np.zeros((2, 128), dtype=np.float32)), 0.0)
    assert isinstance(create_detector("rootsift"), RootSift)


def test_the_training_datas_detector_stays_plain_sift() -> None:
    detector = create_detector()
    assert isinstance(detector, cv2.SIFT)
    assert (detector.getNFeatures(), detector.getContrastThreshold()) == (2000, 1e-5)


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


@pytest.mark.parametrize("name", DETECTORS)
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


def neighbours(rows: tuple[tuple[cv2.DMatch, ...], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Indices and distances (N, 2), after a look at the rows' own numbers."""
    assert [match.queryIdx for row in rows for match in row] == [i for i, row in enumerate(rows) for _ in row]
    index = np.array([[match.trainIdx for match in row] for row in rows])
    return index, np.array([[match.distance for match in row] for row in rows], dtype=np.float32)


@pytest.mark.parametrize("largest", [3, 255])
def test_descriptors_of_integers_give_the_answer_of_the_brute_force_matcher(largest: int) -> None:
    # Small numbers make many neighbours equally near: the first one wins in both.
    rng = np.random.default_rng(0)
    one, two = (rng.integers(0, largest + 1, (count, 128)).astype(np.float32) for count in (700, 300))
    two[100:200] = two[:100]
    ours = neighbours(match_descriptors(one, two))
    theirs = neighbours(cv2.BFMatcher(cv2.NORM_L2).knnMatch(one, two, k=2))
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1], theirs[1])
    as_bytes = neighbours(match_descriptors(one.astype(np.uint8), two.astype(np.uint8), cv2.NORM_L2))
    np.testing.assert_array_equal(as_bytes[0], theirs[0])


def test_other_descriptors_differ_by_rounding_alone() -> None:
    rng = np.random.default_rng(0)
    one, two = (root_sift(rng.integers(0, 256, (count, 128)).astype(np.float32)) for count in (700, 300))
    two[:50] = one[:50] + rng.normal(0, 1e-6, (50, 128)).astype(np.float32)  # next to nothing between them
    ours = neighbours(match_descriptors(one, two))
    theirs = neighbours(cv2.BFMatcher(cv2.NORM_L2).knnMatch(one, two, k=2))
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-5)


def test_a_single_descriptor_is_the_only_neighbour() -> None:
    rows = match_descriptors(np.eye(3, dtype=np.float32), np.ones((1, 3), dtype=np.float32))
    assert [[(m.queryIdx, m.trainIdx) for m in row] for row in rows] == [[(0, 0)], [(1, 0)], [(2, 0)]]
    np.testing.assert_allclose(neighbours(rows)[1], np.sqrt(2.0), rtol=1e-6)


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


def test_a_matcher_of_opencv_answers_in_rows(both: tuple[ImageFeatures, ImageFeatures]) -> None:
    one, two = both
    ours = neighbours(match_descriptors(one.descriptors, two.descriptors))
    theirs = neighbours(match_with(cv2.BFMatcher(cv2.NORM_L2), one, two))
    np.testing.assert_array_equal(ours[0], theirs[0])
    crossed = match_with(cv2.BFMatcher(cv2.NORM_L2, crossCheck=True), one, two)
    mutual = match_features(one, two).mutual
    assert {len(row) for row in crossed} == {1}
    assert [row[0].queryIdx for row in crossed] == np.flatnonzero(mutual).tolist()
    assert match_with(cv2.BFMatcher(), one, describe(np.zeros((50, 50), dtype=np.uint8), create_detector())) == ()
    with pytest.raises(ValueError, match="matcher: BFMatcher cannot match float32"):
        match_with(cv2.BFMatcher(cv2.NORM_HAMMING), one, two)


class Attentive:
    """Stands for cv2.LightGlueMatcher, whose model file is not at hand: matches what it was shown, once."""

    def setPairInfo(self, points1: np.ndarray, points2: np.ndarray, size1: object, size2: object) -> None:
        self.shown = (points1, points2, size1, size2)

    def match(self, descriptors1: np.ndarray, descriptors2: np.ndarray) -> list[cv2.DMatch]:
        assert (len(self.shown[0]), len(self.shown[1])) == (len(descriptors1), len(descriptors2))
        return [cv2.DMatch(4, 2, 0.25)]


def test_a_matcher_that_looks_at_keypoints_is_shown_them(both: tuple[ImageFeatures, ImageFeatures]) -> None:
    matcher = Attentive()
    ((match,),) = match_with(matcher, *both)
    assert (match.queryIdx, match.trainIdx, match.distance) == (4, 2, 0.25)
    np.testing.assert_allclose(matcher.shown[0], both[0].points, rtol=1e-6)
    assert matcher.shown[0].dtype == np.float32
    assert matcher.shown[2:] == ((1800, 1350), (1200, 900))
