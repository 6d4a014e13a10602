"""Sources of pairs: dumps, lists of image pairs and reconstructions give the pair they were written from."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene
from oanet_files import write_oanet
from scene_bundles import write_bundle

from mgca_filter.data import open_sources
from mgca_filter.data.colmap import covisible_pairs
from mgca_filter.data.pair_lists import turn_camera
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.baselines import Baseline, OpenCvEstimator
from mgca_filter.evaluation.pairs import select_pairs
from mgca_filter.evaluation.predict import predict
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.evaluation.selection import Selection
from mgca_filter.geometry.epipolar import essential_from_pose, symmetric_epipolar_distance_squared
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.match_images import match_images

PROSAC = "mutual + ratio 0.9 + PROSAC 0.5 px"
R_TRUE = rotation_from_vector(np.array([0.02, -0.08, 0.03]))
T_TRUE = np.array([1.0, 0.1, 0.05])
PLANES = ((5.0, 0), (8.0, 240))
"""Depth of the wall and the column of pixels from which it is seen."""


def textured_views() -> tuple[np.ndarray, np.ndarray]:
    """Two views under ``K`` of two frontal walls side by side, by the homography of each."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (SIZE[1], SIZE[0])).astype(np.float32)
    first = cv2.normalize(cv2.GaussianBlur(noise, None, 2.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    second = np.full_like(first, 128)
    for depth, column in PLANES:
        H = K @ (R_TRUE + np.outer(T_TRUE / depth, [0.0, 0.0, 1.0])) @ np.linalg.inv(K)
        part = np.zeros_like(first)
        part[:, column : 240 if column == 0 else None] = 1
        warped = cv2.warpPerspective(first, H, SIZE)
        second = np.where(cv2.warpPerspective(part, H, SIZE) > 0, warped, second)
    return first, second


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with ``a.png`` and ``b.png``, the two views."""
    folder = tmp_path_factory.mktemp("photos")
    for name, image in zip(("a.png", "b.png"), textured_views()):
        cv2.imwrite(str(folder / name), image)
    return folder


def pair_line(name1: str = "a.png", name2: str = "b.png", turns: str = "0 0", T: np.ndarray | None = None) -> str:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R_TRUE, T_TRUE
    numbers = np.concatenate([K.ravel(), K.ravel(), (pose if T is None else T).ravel()])
    return " ".join([name1, name2, turns, *(f"{number:.12g}" for number in numbers)])


def write_list(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


# OANet's dumps


def test_a_dump_gives_pixels_attributes_and_pose(tmp_path: Path):
    scene = make_scene(seed=3)
    (source,) = open_sources([write_oanet(tmp_path / "yfcc.hdf5", [scene])], "oanet")
    pair = source[0]
    assert (source.scene, len(source), source.images(pair)) == ("yfcc", 1, None)
    np.testing.assert_allclose(pair.points1, scene.points1, atol=1e-3)
    np.testing.assert_allclose(pair.points2, scene.points2, atol=1e-3)
    np.testing.assert_array_equal(pair.R, scene.R)
    np.testing.assert_array_equal(pair.attributes.ratio, scene.attributes.ratio)
    np.testing.assert_array_equal(pair.mutual, np.arange(len(scene.points1)) % 2 == 0)
    assert pair.image_size1[0] >= SIZE[0] - 1
    assert pair.image_size1[1] >= SIZE[1] - 1


def test_a_dump_and_a_bundle_of_the_same_scene_score_alike(tmp_path: Path):
    scenes = [make_scene(seed=seed) for seed in range(3)]
    everything = {f"mutuals/{i}": np.ones(200) for i in range(3)}
    dump = select_pairs(write_oanet(tmp_path / "hall.hdf5", scenes, everything), data_format="oanet")
    bundle = select_pairs(write_bundle(tmp_path / "hall.npz", scenes))
    method = parse_method("NN + MAGSAC 0.5 px")
    of_dump, of_bundle = (predict([method], s)[method.name]["hall"][0] for s in (dump, bundle))
    for one, other in zip(of_dump, of_bundle):
        assert one.error_deg == pytest.approx(other.error_deg, abs=0.2)
        assert one.kept == pytest.approx(other.kept, abs=0.02)


def test_a_broken_pair_counts_as_a_failure_of_every_method(tmp_path: Path):
    scenes = [make_scene(seed=seed) for seed in range(3)]
    path = write_oanet(tmp_path / "hall.hdf5", scenes, {"Rs/1": np.zeros((3, 3))})
    methods = [parse_method("mutual + RANSAC 1 px"), parse_method("NN + MAGSAC 0.5 px")]
    for outcomes in predict(methods, select_pairs(path, data_format="oanet")).values():
        broken = outcomes["hall"][0][1]
        assert (broken.pair, broken.error_deg, broken.unreadable) == (1, 180.0, True)
        assert "Rs/1 is not a rotation" in broken.failure
        assert broken.kept == broken.mask == (0.0, 0.0, 0.0)
        assert [o.unreadable for o in outcomes["hall"][0]] == [False, True, False]


def test_workers_do_not_change_the_numbers_of_a_dump(tmp_path: Path):
    scenes = [make_scene(seed=seed) for seed in range(4)]
    path = write_oanet(tmp_path / "hall.hdf5", scenes, {"ts/0": np.zeros(3), "ts/3": np.zeros(3)})
    methods = [parse_method("mutual + RANSAC 1 px"), parse_method("NN + MAGSAC 0.5 px")]
    selections = select_pairs(path, data_format="oanet")
    alone, parallel = (predict(methods, selections, workers=workers) for workers in (1, 2))
    for method in methods:
        one, other = (results[method.name]["hall"][0] for results in (alone, parallel))
        assert [o.error_deg for o in one] == [o.error_deg for o in other]
        assert [o.unreadable for o in other] == [True, False, False, True]


def test_a_bundle_pair_without_translation_cannot_be_judged(tmp_path: Path):
    path = write_bundle(tmp_path / "hall.npz", [make_scene("rotation"), make_scene()])
    (source,) = open_sources([path])
    with pytest.raises(DatasetError, match=r"hall\.npz: pair 0: the translation is zero"):
        source[0]
    assert source[1].index == 1


# Lists of image pairs


def test_a_list_matches_images_as_match_images_does_with_the_training_detector(photos: Path, tmp_path: Path):
    (source,) = open_sources([write_list(tmp_path / "walls.txt", pair_line())], "pairs", photos)
    pair = pickle.loads(pickle.dumps(source))[0]
    assert (pair.scene, pair.image1, pair.image2, pair.image_size1) == ("walls", "a.png", "b.png", SIZE)
    distance = symmetric_epipolar_distance_squared(pair.correspondences, essential_from_pose(R_TRUE, T_TRUE))
    assert (distance[pair.mutual] < 1e-4).mean() > 0.7
    images = [cv2.imread(str(photos / name)) for name in ("a.png", "b.png")]
    expected = match_images(*images, K1=K, detector="sift", max_keypoints=2000)
    rows = np.array([(m[0].queryIdx, m[0].trainIdx) for m in expected.matches])
    np.testing.assert_allclose(pair.points1, np.array([k.pt for k in expected.keypoints1])[rows[:, 0]])
    np.testing.assert_allclose(pair.points2, np.array([k.pt for k in expected.keypoints2])[rows[:, 1]])
    ratio = [m[0].distance / m[1].distance for m in expected.matches]
    np.testing.assert_allclose(pair.attributes.ratio, ratio, rtol=1e-5)
    for given, read in zip(images, source.images(pair)):
        np.testing.assert_array_equal(given, read)


def test_mutual_matches_are_nearest_both_ways(photos: Path, tmp_path: Path):
    (source,) = open_sources([write_list(tmp_path / "walls.txt", pair_line())], "pairs", photos)
    pair = source[0]
    back = open_sources([write_list(tmp_path / "back.txt", pair_line("b.png", "a.png"))], "pairs", photos)[0][0]
    forth = {(tuple(a), tuple(b)) for a, b in zip(pair.points1[pair.mutual], pair.points2[pair.mutual])}
    assert forth == {(tuple(b), tuple(a)) for a, b in zip(back.points1[back.mutual], back.points2[back.mutual])}
    assert 0 < len(forth) < len(pair.points1)


@pytest.mark.parametrize("turns", ["1 0", "0 2", "3 1"])
def test_rotation_flags_turn_image_intrinsics_and_pose(turns: str, photos: Path, tmp_path: Path):
    (source,) = open_sources([write_list(tmp_path / "walls.txt", pair_line(turns=turns))], "pairs", photos)
    pair = source[0]
    count1, count2 = (int(turn) for turn in turns.split())
    assert pair.image_size1 == (SIZE if count1 % 2 == 0 else SIZE[::-1])
    assert pair.image_size2 == (SIZE if count2 % 2 == 0 else SIZE[::-1])
    distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
    assert (distance[pair.mutual] < 1e-4).mean() > 0.7
    image1, _ = source.images(pair)
    np.testing.assert_array_equal(image1, np.rot90(cv2.imread(str(photos / "a.png")), count1))


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_turned_camera_sees_the_turned_point(count: int):
    X = np.array([0.3, -0.2, 2.0])
    x, y, _ = K @ X / X[2]
    turned, turn = turn_camera(K, SIZE if count % 2 == 0 else SIZE[::-1], count)
    image = np.zeros(SIZE[::-1])
    image[round(y), round(x)] = 1.0
    row, column = np.unravel_index(np.argmax(np.rot90(image, count)), np.rot90(image, count).shape)
    projected = turned @ (turn @ X) / X[2]
    np.testing.assert_allclose(projected[:2], [column, row], atol=0.51)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (pair_line("absent.png"), r"absent\.png: image missing"),
        (pair_line("torn.png"), r"torn\.png: not an image"),
        (pair_line(T=np.diag([1.0, 1.0, -1.0, 1.0])), "line 2: T_0to1: the pose's matrix is not a rotation"),
        (pair_line(T=np.eye(4)), "line 2: T_0to1: the translation is zero"),
        (pair_line(T=2 * np.eye(4)), "line 2: the last row of T_0to1"),
        (pair_line(turns="0 4"), "line 2: rotation flags must be 0 … 3"),
        (pair_line() + " 1", "line 2: 39 values instead of 38"),
        (pair_line().replace("800", "eight"), "line 2: could not convert"),
        (pair_line().replace("800", "-800"), "line 2: K0: not a matrix of intrinsics"),
    ],
)
def test_a_bad_line_is_named_and_fails_alone(line: str, message: str, photos: Path, tmp_path: Path):
    (photos / "torn.png").write_bytes(b"no image")
    path = write_list(tmp_path / "walls.txt", pair_line(), line)
    method = parse_method("NN + MAGSAC 0.5 px")
    results = predict([method], select_pairs(path, data_format="pairs", images=photos))
    good, bad = results[method.name]["walls"][0]
    assert good.failure == ""
    assert (bad.error_deg, bad.unreadable) == (180.0, True)
    with pytest.raises(DatasetError, match=message):
        open_sources([path], "pairs", photos)[0][1]


def test_a_list_without_any_pair_is_refused(photos: Path, tmp_path: Path):
    with pytest.raises(DatasetError, match="holds no pair"):
        open_sources([write_list(tmp_path / "empty.txt", "")], "pairs", photos)
    with pytest.raises(DatasetError, match=r"names\.txt: line 1: 2 values instead of 38"):
        open_sources([write_list(tmp_path / "names.txt", "a.png b.png")], "pairs", photos)
    with pytest.raises(DatasetError, match="none of its 2 images is in"):
        open_sources([write_list(tmp_path / "walls.txt", pair_line())], "pairs", tmp_path)
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match=r"binary\.txt: cannot be read as text"):
        open_sources([tmp_path / "binary.txt"], "pairs", photos)


def test_a_changed_image_changes_the_digest(photos: Path, tmp_path: Path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes((photos / name).read_bytes())
    path = write_list(tmp_path / "walls.txt", pair_line())
    before = open_sources([path], "pairs")[0].sha256
    assert open_sources([path], "pairs")[0].sha256 == before
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((480, 640), np.uint8))
    assert open_sources([path], "pairs")[0].sha256 != before


# COLMAP reconstructions


def write_reconstruction(folder: Path, photos: Path, camera: str = "1 PINHOLE 640 480 800 800 320 240") -> Path:
    """A text model of the two views and a third that shares nothing, with the images beside it."""
    quaternion = np.array([np.sqrt(1 + np.trace(R_TRUE)) / 2] * 4)
    quaternion[1:] = np.array([R_TRUE[2, 1] - R_TRUE[1, 2], R_TRUE[0, 2] - R_TRUE[2, 0], R_TRUE[1, 0] - R_TRUE[0, 1]])
    quaternion[1:] /= 4 * quaternion[0]
    poses = {"a.png": "1 0 0 0 0 0 0", "b.png": " ".join(map(str, [*quaternion, *T_TRUE])), "c.png": "1 0 0 0 5 0 0"}
    shared = " ".join(f"{10.0 * i} {5.0 * i} {i + 1}" for i in range(20))
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(camera + "\n")
    lines = []
    for i, (name, pose) in enumerate(poses.items(), 1):
        lines += [f"{i} {pose} 1 {name}", shared if name != "c.png" else ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    points = [f"{i + 1} {i} 0 5 0 0 0 0.1 1 {i} 2 {i}" for i in range(20)]
    (model / "points3D.txt").write_text("\n".join(points) + "\n")
    (folder / "images").mkdir()
    for name in ("a.png", "b.png"):
        (folder / "images" / name).write_bytes((photos / name).read_bytes())
    return folder


def test_a_reconstruction_gives_its_covisible_pairs(photos: Path, tmp_path: Path):
    pytest.importorskip("pycolmap")
    (source,) = open_sources([write_reconstruction(tmp_path / "walls", photos)], "colmap")
    assert (source.scene, len(source)) == ("walls", 1)
    pair = pickle.loads(pickle.dumps(source))[0]
    assert (pair.image1, pair.image2) == ("a.png", "b.png")
    np.testing.assert_allclose(pair.R, R_TRUE, atol=1e-9)
    np.testing.assert_allclose(pair.t, T_TRUE, atol=1e-9)
    np.testing.assert_allclose(pair.K1, K)  # COLMAP's 320, 240 are 319.5, 239.5 from the first pixel's centre
    method = Baseline(Selection(mutual=True), OpenCvEstimator("MAGSAC", 0.5))
    (outcome,) = predict([method], select_pairs(tmp_path / "walls", data_format="colmap"))[method.name]["walls"][0]
    assert outcome.error_deg < 3.0


def test_distortion_is_taken_out_of_the_points(photos: Path, tmp_path: Path):
    pytest.importorskip("pycolmap")
    plain = open_sources([write_reconstruction(tmp_path / "plain", photos)], "colmap")[0][0]
    camera = "1 OPENCV 640 480 800 800 320 240 -0.2 0.05 0.001 -0.002"
    (source,) = open_sources([write_reconstruction(tmp_path / "bent", photos, camera)], "colmap")
    bent = source[0]
    np.testing.assert_allclose(bent.K1, K)
    distortion = np.array([-0.2, 0.05, 0.001, -0.002])
    expected = cv2.undistortPoints(plain.points1[:, None], K, distortion, P=K)[:, 0]
    np.testing.assert_allclose(bent.points1, expected, atol=0.02)
    assert np.abs(bent.points1 - plain.points1).max() > 5.0
    image1, _ = source.images(bent)
    expected_image = cv2.undistort(cv2.imread(str(photos / "a.png")), K, distortion)
    assert np.abs(image1.astype(float) - expected_image)[20:-20, 20:-20].mean() < 2.0


def test_reconstructions_that_cannot_be_used_are_named(photos: Path, tmp_path: Path):
    pytest.importorskip("pycolmap")
    with pytest.raises(DatasetError, match="no COLMAP reconstruction"):
        open_sources([tmp_path], "colmap")
    folder = write_reconstruction(tmp_path / "walls", photos, "1 PINHOLE 1280 960 1600 1600 640 480")
    with pytest.raises(DatasetError, match="640 x 480 px, but its camera has 1280 x 960 px"):
        open_sources([folder], "colmap")[0][0]
    with pytest.raises(DatasetError, match="none of its 3 images is in"):
        open_sources([folder], "colmap", tmp_path)
    (folder / "sparse" / "0" / "images.txt").write_text("nonsense\n")
    with pytest.raises(DatasetError, match="cannot be read as a COLMAP reconstruction"):
        open_sources([folder], "colmap")


def test_covisible_pairs_share_enough_points():
    observed = [np.arange(20), np.arange(10, 30), np.arange(19, 40)]
    assert covisible_pairs(observed, 10) == ((0, 1), (1, 2))
    assert covisible_pairs(observed, 1) == ((0, 1), (0, 2), (1, 2))
    assert covisible_pairs(observed, 12) == ()


# All formats


def test_scenes_of_one_name_and_unknown_formats_are_refused(tmp_path: Path):
    (tmp_path / "other").mkdir()
    files = [write_bundle(folder / "hall.npz", [make_scene()]) for folder in (tmp_path, tmp_path / "other")]
    with pytest.raises(DatasetError, match="same name: hall"):
        open_sources(files)
    with pytest.raises(ValueError, match="format: expected one of bundle, oanet, pairs, colmap"):
        open_sources(files, "video")
    with pytest.raises(DatasetError, match="no HDF5 dump"):
        open_sources([tmp_path], "oanet")
    assert [s.scene for s in open_sources([files[0]])] == ["hall"]


def test_a_bundle_finds_its_photographs(tmp_path: Path):
    path = write_bundle(tmp_path / "hall.npz", [make_scene()])
    (tmp_path / "photos" / "hall").mkdir(parents=True)
    (source,) = open_sources([path], "bundle", tmp_path / "photos")
    assert source.images(source[0]) is None
    for i, name in enumerate(("000.jpg", "001.jpg")):
        cv2.imwrite(str(tmp_path / "photos" / "hall" / name), np.full((SIZE[1], SIZE[0], 3), 100 * i, np.uint8))
    image1, image2 = source.images(source[0])
    assert (image1.mean(), image2.mean()) == (0.0, 100.0)
    cv2.imwrite(str(tmp_path / "photos" / "hall" / "001.jpg"), np.zeros((10, 10, 3), np.uint8))
    assert source.images(source[0]) is None
