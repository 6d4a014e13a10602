"""Lists that users make of raw matches: what is kept, what is still known, and which bundles they come from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import bundle_fields, learned_fields, write_bundle

from benchmarks.match_lists import KINDS, PLAIN_DETECTOR, ListSource, frame_gap, open_detector_scenes
from mgca_filter.data import open_sources
from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.metrics import true_matches

SCENES = [make_scene(seed=0), make_scene(seed=1), make_scene(seed=2)]


@pytest.fixture
def pair(tmp_path: Path) -> ScenePair:
    mutual = np.packbits(np.random.default_rng(0).random(200) < 0.8)
    return SceneBundle(write_bundle(tmp_path / "hall.npz", SCENES[:1], match_mutual=mutual))[0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three pairs of SIFT, the same with two other detectors, one of them with a learned matcher, and another scene."""
    folder = tmp_path / "bundles"
    folder.mkdir()
    for name in ("hall", "hall.orb2k", "yard"):
        write_bundle(folder / f"{name}.npz", SCENES)
    write_bundle(folder / "hall.aliked_lightglue.npz", SCENES, **learned_fields(SCENES))
    return folder


def test_lists_keep_what_passes_their_test(pair: ScenePair) -> None:
    ratio = pair.attributes.ratio
    assert ratio is not None
    expected = {
        "raw": np.ones(200, dtype=bool),
        "cross": pair.mutual,
        "ratio": ratio < 0.75,
        "cross-ratio": pair.mutual & (ratio < 0.8),
        "learned": np.ones(200, dtype=bool),
    }
    assert set(expected) == set(KINDS) - {"clean"}
    for name, kept in expected.items():
        listed = KINDS[name].of(pair)
        np.testing.assert_array_equal(listed.correspondences, pair.correspondences[kept])
        np.testing.assert_array_equal(listed.attributes.ratio, ratio[kept])


def test_clean_lists_are_near_one_geometry_and_have_no_ratio(pair: ScenePair) -> None:
    pytest.importorskip("poselib")
    tested, clean = KINDS["cross-ratio"].of(pair), KINDS["clean"].of(pair)
    assert clean.attributes.ratio is None
    assert clean.attributes.best is not None
    assert clean.order is None
    inside = {tuple(row) for row in tested.correspondences}
    assert inside >= {tuple(row) for row in clean.correspondences}
    right = {tuple(row) for row in tested.correspondences[true_matches(tested.correspondences, pair.E)]}
    assert len(right - {tuple(row) for row in clean.correspondences}) <= 0.1 * len(right)
    assert len(clean.points1) < len(tested.points1)
    np.testing.assert_array_equal(KINDS["clean"].of(pair).correspondences, clean.correspondences)


@pytest.mark.parametrize("count", [0, 7])
def test_few_matches_leave_no_clean_list(pair: ScenePair, count: int) -> None:
    pytest.importorskip("poselib")
    few = replace(pair.take(np.arange(count)), mutual=np.ones(count, dtype=bool))
    assert KINDS["clean"].of(few).correspondences.shape == (0, 4)


def test_results_of_one_kind_are_never_taken_for_those_of_another(folder: Path) -> None:
    pytest.importorskip("poselib")
    (source,) = open_sources([folder / "hall.npz"])
    digests = {name: ListSource(source, "hall", kind).sha256 for name, kind in KINDS.items()}
    assert len(set(digests.values())) == len(KINDS)
    assert source.sha256 not in digests.values()
    assert digests == {name: ListSource(source, "hall", kind).sha256 for name, kind in KINDS.items()}


def test_names_tell_scene_and_detector(folder: Path) -> None:
    found = open_detector_scenes([folder])
    assert sorted((one.detector, one.scene) for one in found) == [
        (PLAIN_DETECTOR, "hall"),
        (PLAIN_DETECTOR, "yard"),
        ("aliked_lightglue", "hall"),
        ("orb2k", "hall"),
    ]
    chosen = open_detector_scenes([folder], detectors=["orb2k", PLAIN_DETECTOR], scenes=["hall"])
    assert [(one.scene, one.detector) for one in chosen] == [("hall", PLAIN_DETECTOR), ("hall", "orb2k")]


def test_a_learned_matcher_has_its_own_list_alone(folder: Path) -> None:
    for one in open_detector_scenes([folder]):
        kinds = {name for name, kind in KINDS.items() if one.lists(kind) is not None}
        learned = one.detector == "aliked_lightglue"
        assert one.learned == learned
        assert kinds == ({"learned"} if learned else set(KINDS) - {"learned"})


def test_lists_carry_the_scene_and_the_pairs_of_their_bundle(folder: Path) -> None:
    (one,) = open_detector_scenes([folder], detectors=["orb2k"], per_scene=2)
    lists = one.lists(KINDS["cross"])
    assert lists is not None
    assert (lists.scene, lists.indices) == ("hall", one.indices)
    assert len(lists) == 2
    np.testing.assert_array_equal(lists.source[one.indices[0]].R, one.source[one.indices[0]].R)


def test_bundles_of_one_scene_keep_the_same_pairs(folder: Path) -> None:
    found = open_detector_scenes([folder], scenes=["hall"], per_scene=1, seed=3)
    assert len({one.indices for one in found}) == 1
    drawn = {open_detector_scenes([folder], scenes=["hall"], per_scene=1, seed=s)[0].indices for s in range(20)}
    assert len(drawn) > 1


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        (("000103.png", "000108.png"), 5),
        (("frame_0010_left.jpg", "frame_0008_left.jpg"), 2),
        (("a/000103.png", "b/000103.png"), 0),
        (("left_1.png", "right_2.png"), None),
        (("1.png", "2.jpg"), None),
        (("1311868169.163498.jpg", "1311868170.163498.jpg"), None),
        (("door.png", "door.png"), None),
    ],
)
def test_names_tell_how_many_frames_images_are_apart(names: tuple[str, str], gap: int | None) -> None:
    assert frame_gap(*names) == gap
    assert frame_gap(*names[::-1]) == gap


def test_gaps_choose_pairs_before_they_are_counted(tmp_path: Path) -> None:
    names = np.array(["0000.png", "0001.png", "0010.png", "0012.png", "0020.png", "0021.png"])
    assert len(names) == len(bundle_fields(SCENES)["image_name"])
    write_bundle(tmp_path / "street.npz", SCENES, image_name=names)
    for gaps, indices in (([1], (0, 2)), ([2], (1,)), ([1, 2, 5], (0, 1, 2))):
        assert open_detector_scenes([tmp_path], gaps=gaps)[0].indices == indices
    assert open_detector_scenes([tmp_path], gaps=[2], per_scene=1)[0].indices == (1,)
    with pytest.raises(DatasetError, match="no pair left"):
        open_detector_scenes([tmp_path], gaps=[5])


def test_what_is_not_there_is_named(folder: Path) -> None:
    with pytest.raises(DatasetError, match="no detector named brisk"):
        open_detector_scenes([folder], detectors=["orb2k", "brisk"])
    with pytest.raises(DatasetError, match="no scene named cellar"):
        open_detector_scenes([folder], scenes=["cellar"])
