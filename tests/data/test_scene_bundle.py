"""Scene bundles: what is written is read, relative poses are exact, what is broken is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Scene, make_scene
from scene_bundles import bundle_fields, learned_fields, write_bundle

from mgca_filter.data.scene_bundle import (
    BundleImage,
    BundlePair,
    SceneBundle,
    ScenePair,
    load_scene_bundles,
    scene_and_detector,
)
from mgca_filter.data.scene_bundle import (
    write_bundle as write,
)
from mgca_filter.errors import BundleError
from mgca_filter.features import ImageFeatures, OneWayMatches
from mgca_filter.geometry.epipolar import pose_error_deg, symmetric_epipolar_distance_squared
from mgca_filter.geometry.pose_refinement import rotation_from_vector


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [make_scene(seed=0, noise_px=0.0), make_scene(seed=1, right=50, wrong=13, noise_px=0.0)]


def test_pairs_come_back_as_written(tmp_path, scenes):
    size = np.linspace(2, 40, 526).astype(np.float16)
    angle = np.arange(526).astype(np.uint8)
    mutual = np.arange(263) % 3 == 0
    best = np.arange(263) % 5 != 0
    path = write_bundle(
        tmp_path / "hall.npz",
        scenes,
        keypoint_size=size,
        keypoint_angle=angle,
        match_mutual=np.packbits(mutual),
        match_best=np.packbits(best),
    )
    bundle = SceneBundle(path)
    assert len(bundle) == 2
    assert bundle.match_counts().tolist() == [200, 63]
    pair, scene = bundle[1], scenes[1]
    assert pair.name == "hall/1"
    assert (pair.image1, pair.image2) == ("002.jpg", "003.jpg")
    assert pair.image_size1 == pair.image_size2 == (640, 480)
    np.testing.assert_allclose(pair.points1, scene.points1, atol=1e-4)
    np.testing.assert_allclose(pair.points2, scene.points2, atol=1e-4)
    np.testing.assert_array_equal(pair.mutual, mutual[200:])
    np.testing.assert_array_equal(pair.attributes.best, best[200:])
    np.testing.assert_allclose(pair.attributes.ratio, scene.attributes.ratio, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(pair.attributes.size2, size[463:].astype(np.float32))
    np.testing.assert_allclose(pair.attributes.angle1, angle[400:463] * 360.0 / 256.0)


def test_relative_pose_explains_the_right_matches(tmp_path, scenes):
    # World frames are arbitrary: move both cameras of each pair.
    fields = bundle_fields(scenes)
    W, shift = rotation_from_vector(np.array([0.4, -1.0, 0.3])), np.array([3.0, -2.0, 5.0])
    moved = {"R": fields["R"] @ W, "t": fields["t"] + fields["R"] @ shift}
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, **moved))
    for index, scene in enumerate(scenes):
        pair = bundle[index]
        assert pose_error_deg(pair.R, pair.t, scene.R, scene.t) < 1e-5
        distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
        assert distance[scene.inlier].max() < 1e-12
        assert np.median(distance[~scene.inlier]) > 1e-4


def test_match_index_names_keypoints_of_the_second_image(tmp_path, scenes):
    order = np.random.default_rng(0).permutation(63).astype(np.uint16)
    index = np.concatenate([np.arange(200, dtype=np.uint16), order])
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, match_index=index))
    np.testing.assert_allclose(bundle[1].points2, scenes[1].points2[order], atol=1e-4)
    np.testing.assert_allclose(bundle[1].points1, scenes[1].points1, atol=1e-4)


def test_matches_of_a_learned_matcher_come_back_as_written(tmp_path, scenes):
    changes = learned_fields(scenes)
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, **changes))
    assert bundle.match_counts().tolist() == [100, 32]
    pair, scene = bundle[1], scenes[1]
    np.testing.assert_allclose(pair.points1, scene.points1[::2], atol=1e-4)
    np.testing.assert_allclose(pair.points2, scene.points2[::2], atol=1e-4)
    assert pair.match_scores.dtype == np.float32
    np.testing.assert_allclose(pair.match_scores, changes["match_score"][100:] / 255.0, rtol=1e-6)
    np.testing.assert_array_equal(pair.order, 1 - pair.match_scores)
    assert pair.mutual.all()
    assert set(vars(pair.attributes).values()) == {None}
    assert not pair.attributes.encode(32).any()


def test_size_and_angle_are_unknown_where_the_detector_gives_none(tmp_path, scenes):
    for known in (True, False):
        path = write_bundle(tmp_path / "hall.npz", scenes, has_size_angle=np.bool_(known))
        attributes = SceneBundle(path)[0].attributes
        for name in ("size1", "size2", "angle1", "angle2"):
            assert (getattr(attributes, name) is not None) == known
        assert attributes.ratio is not None
        assert attributes.best is not None


def test_nearest_neighbours_are_ordered_by_ratio(tmp_path, scenes):
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes))[0]
    assert pair.match_scores is None
    np.testing.assert_array_equal(pair.order, pair.attributes.ratio)
    assert replace(pair, attributes=replace(pair.attributes, ratio=None)).order is None


@pytest.mark.parametrize("field", ["match_query", "match_score"])
def test_missing_fields_of_a_learned_matcher_are_named(tmp_path, scenes, field):
    path = write_bundle(tmp_path / "hall.npz", scenes, **{**learned_fields(scenes), field: None})
    with pytest.raises(BundleError, match=rf"hall\.npz.*{field}"):
        SceneBundle(path)


@pytest.mark.parametrize("field", ["match_query", "match_index"])
def test_keypoints_that_a_learned_matcher_cannot_have_seen_are_named(tmp_path, scenes, field):
    changes = learned_fields(scenes)
    changes[field] = np.concatenate([changes[field][:-1], [63]]).astype(np.uint16)
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, **changes))
    with pytest.raises(BundleError, match=rf"{field} of pair 1"):
        bundle[1]


@pytest.mark.parametrize("learned", [False, True])
def test_a_selection_takes_all_that_is_known_along(tmp_path, scenes, learned):
    changes = {"match_label": np.arange(263).astype(np.int8) % 3} if not learned else learned_fields(scenes)
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, **changes))[0]
    rows = np.array([7, 2, 5])
    taken = pair.take(rows)
    for name in ("points1", "points2", "mutual", "order"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(pair, name)[rows])
    for name in ("labels", "match_scores"):
        whole, part = getattr(pair, name), getattr(taken, name)
        np.testing.assert_array_equal(part, None if whole is None else whole[rows])
    np.testing.assert_array_equal(taken.attributes.encode(3), pair.attributes.take(rows).encode(3))
    np.testing.assert_array_equal(taken.correspondences, pair.correspondences[rows])


def test_a_pair_may_have_no_matches(tmp_path, scenes):
    changes = {
        "match_offset": np.array([0, 200, 200]),
        "match_index": np.arange(200, dtype=np.uint16),
        "match_ratio": np.zeros(200, dtype=np.uint8),
        "match_mutual": np.zeros(25, dtype=np.uint8),
        "match_best": np.zeros(25, dtype=np.uint8),
    }
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, **changes))[1]
    assert pair.correspondences.shape == (0, 4)
    assert pair.attributes.encode(0).shape == (0, 8)


@pytest.mark.parametrize("field", list(bundle_fields([make_scene(right=1, wrong=1)])))
def test_missing_fields_are_named(tmp_path, scenes, field):
    path = write_bundle(tmp_path / "hall.npz", scenes, **{field: None})
    with pytest.raises(BundleError, match=rf"hall\.npz.*{field}"):
        SceneBundle(path)


def with_value(field: str, value: float) -> dict[str, np.ndarray]:
    """A change that puts one value into a field of the two scenes' bundle."""
    array = bundle_fields([make_scene(seed=0), make_scene(seed=1, right=50, wrong=13)])[field].copy()
    array.flat[-1] = value
    return {field: array}


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("K", with_value("K", np.nan)),
        ("R", with_value("R", np.nan)),
        ("t", with_value("t", np.inf)),
        ("keypoint_xy", with_value("keypoint_xy", np.nan)),
        ("R", with_value("R", 2.0)),
        ("R", {"R": np.tile(np.diag([1.0, 1.0, -1.0]), (4, 1, 1))}),
        ("R", {"R": np.zeros((4, 9))}),
        ("K", {"K": np.tile(np.eye(3), (3, 1, 1))}),
        ("t", {"t": np.float64(0.0)}),
        ("image_name", {"image_name": np.array(["a.jpg"])}),
        ("image_size", {"image_size": np.zeros((4, 3))}),
        ("pair", with_value("pair", 4)),
        ("pair", {"pair": np.array([[0, 1], [2, -1]])}),
        ("pair", {"pair": np.array([0, 1, 2, 3])}),
        ("match_offset", {"match_offset": np.array([0, 200])}),
        ("match_offset", {"match_offset": np.array([], dtype=np.int64)}),
        ("match_offset", {"match_offset": np.array([0, 264, 263])}),
        ("match_index", {"match_index": np.zeros(200, dtype=np.uint16)}),
        ("match_ratio", {"match_ratio": np.zeros(200, dtype=np.uint8)}),
        ("match_mutual", {"match_mutual": np.zeros(3, dtype=np.uint8)}),
        ("match_best", {"match_best": np.ones(33)}),
        ("keypoint_offset", {"keypoint_offset": np.array([0, 200, 400])}),
        ("keypoint_offset", {"keypoint_offset": np.array([-1, 200, 400, 463, 526])}),
        ("has_size_angle", {"has_size_angle": np.ones(4, dtype=bool)}),
        ("keypoint_size", {"keypoint_size": np.zeros(10, dtype=np.float16)}),
        ("keypoint_angle", {"keypoint_angle": np.zeros(10, dtype=np.uint8)}),
        (
            "match_query",
            {**learned_fields([make_scene(seed=0), make_scene(right=50, wrong=13)]), "match_query": np.zeros(5)},
        ),
        (
            "match_score",
            {**learned_fields([make_scene(seed=0), make_scene(right=50, wrong=13)]), "match_score": np.zeros(5)},
        ),
    ],
)
def test_values_that_cannot_be_are_named(tmp_path, scenes, field, changes):
    path = write_bundle(tmp_path / "hall.npz", scenes, **changes)
    with pytest.raises(BundleError, match=rf"hall\.npz: {field}"):
        SceneBundle(path)


def test_matches_of_keypoints_that_are_not_there_are_named(tmp_path, scenes):
    path = write_bundle(tmp_path / "hall.npz", scenes, **with_value("match_index", 63))
    bundle = SceneBundle(path)
    assert len(bundle[0].points1) == 200
    with pytest.raises(BundleError, match=r"hall\.npz: match_index of pair 1"):
        bundle[1]


def test_pairs_beyond_the_last_are_an_index_error(tmp_path, scenes):
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes))
    for index in (2, -1):
        with pytest.raises(IndexError, match=f"pair {index} of 2"):
            bundle[index]


@pytest.mark.parametrize("size", [0, 10, 1000, -1])
def test_truncated_files_are_named(tmp_path, scenes, size):
    path = write_bundle(tmp_path / "torn.npz", scenes)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(BundleError, match=r"torn\.npz"):
        SceneBundle(path)


def test_damaged_content_is_named(tmp_path, scenes):
    path = write_bundle(tmp_path / "torn.npz", scenes)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 200] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(BundleError, match=r"torn\.npz"):
        SceneBundle(path)


def test_pickled_objects_are_not_read(tmp_path, scenes):
    path = write_bundle(tmp_path / "evil.npz", scenes, image_name=np.array([{"a": 1}] * 4, dtype=object))
    with pytest.raises(BundleError, match=r"evil\.npz"):
        SceneBundle(path)


def test_folders_are_read_in_the_order_of_names(tmp_path: Path, scenes):
    for name in ("yard", "hall"):
        write_bundle(tmp_path / f"{name}.npz", scenes)
    (tmp_path / "notes.txt").write_text("no bundle")
    assert [bundle.scene for bundle in load_scene_bundles(tmp_path)] == ["hall", "yard"]
    assert [bundle.scene for bundle in load_scene_bundles(tmp_path / "yard.npz")] == ["yard"]
    for path in (tmp_path / "none", tmp_path / "none.npz"):
        with pytest.raises(BundleError, match="none"):
            load_scene_bundles(path)


def content(pair: ScenePair, labels: np.ndarray | None = None) -> tuple[list[BundleImage], list[BundlePair]]:
    """What a bundle of this pair alone is written from."""
    known = pair.attributes
    images = [
        BundleImage(name, ImageFeatures(points, size, angle, None, K, image_size), R, t)
        for name, points, size, angle, K, image_size, R, t in (
            (pair.image1, pair.points1, known.size1, known.angle1, pair.K1, pair.image_size1, np.eye(3), np.zeros(3)),
            (pair.image2, pair.points2, known.size2, known.angle2, pair.K2, pair.image_size2, pair.R, pair.t),
        )
    ]
    rows = np.arange(len(pair.points1))
    return images, [BundlePair(0, 1, OneWayMatches(rows, rows, known, pair.mutual), 9, labels)]


@pytest.mark.parametrize("labelled", [False, True])
def test_what_is_written_is_read(tmp_path, scenes, labelled):
    changes = {
        "keypoint_size": np.linspace(2, 40, 526).astype(np.float16),
        "keypoint_angle": np.arange(526).astype(np.uint8),
        "match_mutual": np.packbits(np.arange(263) % 3 == 0),
        "match_best": np.packbits(np.arange(263) % 5 != 0),
    }
    pair = SceneBundle(write_bundle(tmp_path / "source.npz", scenes, **changes))[1]
    labels = np.arange(63).astype(np.int8) % 3 - 1 if labelled else None
    write(tmp_path / "source2.npz", *content(pair, labels))
    again = SceneBundle(tmp_path / "source2.npz")[0]
    for name in ("image1", "image2", "image_size1", "image_size2"):
        assert getattr(again, name) == getattr(pair, name)
    for name in ("points1", "points2", "K1", "K2", "R", "t", "mutual"):
        np.testing.assert_array_equal(getattr(again, name), getattr(pair, name))
    for name, values in vars(pair.attributes).items():
        np.testing.assert_array_equal(getattr(again.attributes, name), values)
    np.testing.assert_array_equal(again.labels, labels)


def test_what_cannot_be_written_leaves_no_file(tmp_path, scenes):
    images, pairs = content(SceneBundle(write_bundle(tmp_path / "source.npz", scenes))[0])
    unknown = replace(images[1], features=replace(images[1].features, K=None, angle=None))
    matches = pairs[0].matches
    alone = replace(matches, attributes=replace(matches.attributes, ratio=np.full(200, np.nan, np.float32)))
    for given, message in (
        ((images, []), "no pair to write"),
        (([images[0], unknown], pairs), "001.jpg: not known: K, angle"),
        ((images, [replace(pairs[0], matches=alone)]), "a match has no ratio"),
    ):
        with pytest.raises(ValueError, match=message):
            write(tmp_path / "hall.npz", *given)
    assert not list(tmp_path.glob("hall*"))
    equal = replace(matches, attributes=replace(matches.attributes, best=None))  # all distances are the same
    write(tmp_path / "hall.npz", images, [replace(pairs[0], matches=equal)])
    assert SceneBundle(tmp_path / "hall.npz")[0].attributes.best.all()


def test_a_bundles_name_tells_scene_and_detector() -> None:
    assert scene_and_detector("hall") == ("hall", "")
    assert scene_and_detector("hall.aliked_lightglue") == ("hall", "aliked_lightglue")
