"""OANet-format dumps: what is read, and what is refused by name."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from conftest import K, Scene, make_scene
from oanet_files import write_oanet

from mgca_filter.data.oanet_hdf5 import GROUPS, OanetFile, best_by_mutual
from mgca_filter.errors import DatasetError
from mgca_filter.geometry.cameras import normalize_points


@pytest.fixture
def scenes() -> list[Scene]:
    return [make_scene(seed=0), make_scene(seed=1, right=50, wrong=21)]


def test_a_dump_gives_back_what_was_written(tmp_path: Path, scenes: list[Scene]):
    dump = OanetFile(write_oanet(tmp_path / "dump.hdf5", scenes))
    assert len(dump) == 2
    assert [dump.match_count(i) for i in range(2)] == [200, 71]
    for scene, pair in zip(scenes, dump):
        expected = np.hstack([normalize_points(points, K) for points in (scene.points1, scene.points2)])
        np.testing.assert_allclose(pair.correspondences, expected, atol=1e-6)
        np.testing.assert_array_equal(pair.R, scene.R)
        np.testing.assert_array_equal(pair.t, scene.t)
        np.testing.assert_array_equal(pair.K1, K)
        np.testing.assert_array_equal(pair.K2, K)
        np.testing.assert_array_equal(pair.ratio, scene.attributes.ratio)
        np.testing.assert_array_equal(pair.mutual, np.arange(len(expected)) % 2 == 0)


def test_a_dump_travels_to_other_processes(tmp_path: Path, scenes: list[Scene]):
    dump = OanetFile(write_oanet(tmp_path / "dump.hdf5", scenes))
    first = dump[0].correspondences
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(dump))[0].correspondences, first)
    dump.close()
    np.testing.assert_array_equal(dump[0].correspondences, first)
    with pytest.raises(IndexError, match="pair 2 of 2"):
        dump[2]


def test_best_of_list_follows_from_mutual_matches():
    points2 = np.array([[0.0, 0], [0, 0], [1, 0], [2, 0], [2, 0], [3, 0]])
    mutual = np.array([False, True, False, False, False, True])
    np.testing.assert_array_equal(best_by_mutual(points2, mutual), [False, True, True, True, True, True])
    assert best_by_mutual(np.zeros((0, 2)), np.zeros(0, dtype=bool)).shape == (0,)


@pytest.mark.parametrize("group", GROUPS)
def test_a_missing_group_is_named(group: str, tmp_path: Path, scenes: list[Scene]):
    path = write_oanet(tmp_path / "dump.hdf5", scenes, {f"{group}/{i}": None for i in range(2)})
    with pytest.raises(DatasetError, match=rf"dump\.hdf5: not a dump .* missing: {group} "):
        OanetFile(path)


def test_groups_of_different_length_are_named(tmp_path: Path, scenes: list[Scene]):
    with pytest.raises(DatasetError, match="differ in their number of pairs: xs 2, .* ratios 1"):
        OanetFile(write_oanet(tmp_path / "dump.hdf5", scenes, {"ratios/1": None}))
    gap = {f"{group}/1": None for group in GROUPS} | {f"{group}/7": np.zeros(3) for group in GROUPS}
    with pytest.raises(DatasetError, match='xs does not hold the datasets "0" … "1"'):
        OanetFile(write_oanet(tmp_path / "gap.hdf5", scenes, gap))


def test_a_file_that_is_no_hdf5_is_named(tmp_path: Path):
    (tmp_path / "text.hdf5").write_text("no data")
    for name in ("text.hdf5", "absent.hdf5"):
        with pytest.raises(DatasetError, match=rf"{name}: cannot be read as HDF5"):
            OanetFile(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("xs/1", np.zeros((71, 4)), r"xs/1 has the shape \(71, 4\) instead of \(1, N, 4\)"),
        ("xs/1", np.full((1, 71, 4), np.nan), "xs/1 holds NaN"),
        ("xs/1", np.array(["text"], dtype="S4"), "xs/1 cannot be read as numbers"),
        ("Rs/1", np.diag([1.0, 1.0, -1.0]), "Rs/1 is not a rotation"),
        ("Rs/1", 1.01 * np.eye(3), "Rs/1 is not a rotation"),
        ("ts/1", np.zeros((3, 1)), "ts/1 is zero"),
        ("ratios/1", np.zeros(3), "ratios/1 has the shape"),
        ("mutuals/1", np.zeros(3), "mutuals/1 has the shape"),
        ("f2s/1", np.array([0.0, 800.0]), "f2s/1 is .* expected one or two focal lengths"),
        ("cy1s/1", np.array([1.0, 2.0]), "cy1s/1 has the shape"),
    ],
)
def test_a_broken_pair_is_named_and_leaves_the_others_readable(
    name: str, values: np.ndarray, message: str, tmp_path: Path, scenes: list[Scene]
):
    dump = OanetFile(write_oanet(tmp_path / "dump.hdf5", scenes, {name: values}))
    with pytest.raises(DatasetError, match=message):
        dump[1]
    assert len(dump[0].correspondences) == 200


def test_what_is_not_read_breaks_no_pair(tmp_path: Path, scenes: list[Scene]):
    """Distances to the true geometry follow from the pose: those of the dump are of no use."""
    dump = OanetFile(write_oanet(tmp_path / "dump.hdf5", scenes, {"ys/1": np.full(7, np.nan)}))
    assert len(dump[1].correspondences) == 71
