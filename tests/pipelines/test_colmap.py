"""COLMAP databases: real pycolmap, real mapper."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import fisheye_views
import multi_view
import numpy as np
import pytest
from pipeline_command import ROOT, assert_one_line

from mgca_filter import cli
from mgca_filter.geometry.epipolar import pose_error_deg, sampson_distance

pycolmap = pytest.importorskip("pycolmap")
from mgca_filter.pipelines import colmap  # noqa: E402
from mgca_filter.pipelines.mapper_comparison import compare  # noqa: E402
from mgca_filter.pipelines.worker import MAPPING_THRESHOLD_PX, PairRow  # noqa: E402

CONFIGURATION = pycolmap.TwoViewGeometryConfiguration
# Distortion that bends the corners by several pixels, for models with one way to say it.
MODELS = {
    "SIMPLE_RADIAL": [512, 320, 240, -0.05],
    "OPENCV": [512, 515, 320, 240, -0.05, 0.01, 0.001, -0.001],
    "OPENCV_FISHEYE": [512, 515, 320, 240, 0.02, 0.0, 0.0, 0.0],
    "FOV": [512, 515, 320, 240, 0.3],
    "THIN_PRISM_FISHEYE": [512, 515, 320, 240, 0.02, 0, 0, 0, 0, 0, 0.001, 0],
}


@pytest.fixture
def database(tmp_path, views, raw_matches):
    return multi_view.write_database(tmp_path / "raw.db", views, raw_matches)


@pytest.fixture
def few_pairs(tmp_path, views, raw_matches):
    """A database of all views and two pairs."""
    return multi_view.write_database(tmp_path / "raw.db", views, {pair: raw_matches[pair] for pair in ((0, 1), (1, 2))})


def read_geometries(path) -> dict[tuple[int, int], object]:
    with closing(pycolmap.Database.open(path)) as opened:
        ids, geometries = opened.read_two_view_geometries()
    return {pycolmap.pair_id_to_image_pair(pair_id): geometry for pair_id, geometry in zip(ids, geometries)}


def assert_poses_are_true(geometries, views) -> None:
    """Poses as exact as the views allow: windows repeat, and hold one pair of views six degrees off the truth."""
    errors = []
    for (id1, id2), geometry in geometries.items():
        view1, view2 = views[id1 - 1], views[id2 - 1]
        R = view2.R @ view1.R.T
        pose = geometry.cam2_from_cam1
        errors.append(pose_error_deg(pose.rotation.matrix(), pose.translation, R, view2.t - R @ view1.t))
    assert np.median(errors) < 1.0
    assert max(errors) < 10.0


def test_geometry_of_every_pair_is_true(database, views, tmp_path, capsys):
    """Pose, E, F and inliers in COLMAP's conventions; the input stays as it was, byte for byte."""
    before = database.read_bytes()
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db")]) == 0
    assert "6 pairs" in capsys.readouterr().out
    assert database.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"raw.db", "out.db"}
    geometries = read_geometries(tmp_path / "out.db")
    assert len(geometries) == 6
    assert_poses_are_true(geometries, views)
    half = np.array([0.5, 0.5])
    for (id1, id2), geometry in geometries.items():
        view1, view2 = views[id1 - 1], views[id2 - 1]
        assert geometry.config == CONFIGURATION.CALIBRATED
        rows = geometry.inlier_matches
        assert len(rows) > 50
        pixels = np.hstack([view1.points[rows[:, 0]] + half, view2.points[rows[:, 1]] + half])
        distance_px = sampson_distance(pixels, geometry.F)
        assert 1.0 < distance_px.max() < MAPPING_THRESHOLD_PX + 0.01
        normalized = (pixels - np.tile(views[0].K[:2, 2] + half, 2)) / 512.0
        assert (512.0 * sampson_distance(normalized, geometry.E) < MAPPING_THRESHOLD_PX + 0.01).all()


def test_everything_else_is_copied(few_pairs, tmp_path):
    database = few_pairs
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"]) == 0
    tables = ("cameras", "images", "keypoints", "descriptors", "matches")
    with closing(sqlite3.connect(database)) as before, closing(sqlite3.connect(tmp_path / "out.db")) as after:
        for table in tables:
            query = f"SELECT * FROM {table} ORDER BY 1"
            assert before.execute(query).fetchall() == after.execute(query).fetchall()


def test_a_report_lies_beside_the_output(few_pairs, tmp_path):
    assert cli.main(["colmap", str(few_pairs), "-o", str(tmp_path / "out.db"), "--html", str(tmp_path / "r.html")]) == 0
    assert "view01.png" in (tmp_path / "r.html").read_text(encoding="utf-8")
    assert len(read_geometries(tmp_path / "out.db")) == 2


def test_in_place_equals_a_copy(few_pairs, tmp_path):
    database = few_pairs
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"]) == 0
    assert cli.main(["colmap", str(database), "--in-place", "-q"]) == 0
    copied, in_place = read_geometries(tmp_path / "out.db"), read_geometries(database)
    assert list(copied) == list(in_place)
    for pair, geometry in copied.items():
        assert np.array_equal(geometry.inlier_matches, in_place[pair].inlier_matches)
        assert np.array_equal(geometry.E, in_place[pair].E)


def test_threshold_and_descriptors_count(few_pairs, tmp_path):
    """Options that change the answer when they are obeyed."""
    kept = {}
    one_px = ["--threshold", "1"]
    variants = {"default": [], "one": one_px, "tight": ["--threshold", "0.2"], "points": [*one_px, "--no-descriptors"]}
    for name, words in variants.items():
        assert cli.main(["colmap", str(few_pairs), "-o", str(tmp_path / f"{name}.db"), "-q", *words]) == 0
        kept[name] = [len(g.inlier_matches) for g in read_geometries(tmp_path / f"{name}.db").values()]
    assert sum(kept["tight"]) < 0.6 * sum(kept["one"])
    assert sum(kept["one"]) < sum(kept["default"])
    assert kept["points"] != kept["one"]


@pytest.mark.parametrize("model", MODELS)
def test_distorted_keypoints_come_back_to_the_pinhole(model):
    """Project with COLMAP's camera, undistort with ours: the pinhole's pixel, shifted by half a pixel."""
    camera = pycolmap.Camera(model=model, width=640, height=480, params=MODELS[model])
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    distorted = np.array([camera.img_from_cam(ray) for ray in rays])
    K = camera.calibration_matrix()
    pinhole = rays[:, :2] * K[[0, 1], [0, 1]] + K[:2, 2]
    assert np.abs(distorted - pinhole).max() > 1.0
    np.testing.assert_allclose(colmap.undistorted(camera, distorted), pinhole - 0.5, atol=1e-3)


@pytest.mark.parametrize("model", MODELS)
def test_the_stretch_is_the_derivative_of_undistorting(model):
    camera = pycolmap.Camera(model=model, width=640, height=480, params=MODELS[model])
    rng = np.random.default_rng(0)
    points, step = rng.uniform((150, 100), (500, 380), (50, 2)), 0.1 * rng.normal(size=(50, 2))
    stretch = colmap.stretch(camera, points)
    moved = colmap.undistorted(camera, points + step) - colmap.undistorted(camera, points)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", stretch, step), moved, atol=2e-3)
    assert np.abs(stretch - np.eye(2)).max() > 1e-3


def test_a_pinhole_has_no_stretch():
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[512, 515, 320, 240])
    assert colmap.stretch(camera, np.zeros((3, 2))) is None


def test_a_fisheye_keeps_its_rim(tmp_path):
    path = tmp_path / "fisheye.db"
    lens = [fisheye_views.LENS.k1, fisheye_views.LENS.k2, fisheye_views.LENS.k3, fisheye_views.LENS.k4]
    with closing(pycolmap.Database.open(path)) as opened:
        params = [300, 300, 512, 512, *lens]
        camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=1024, height=1024, params=params)
        camera.has_prior_focal_length = True
        camera_id = opened.write_camera(camera)
        ids = [opened.write_image(pycolmap.Image(name=name, camera_id=camera_id)) for name in ("a.png", "b.png")]
        for image_id, points in zip(ids, (fisheye_views.P, fisheye_views.Q)):
            opened.write_keypoints(image_id, (points + 0.5).astype(np.float32))
        rows = np.arange(len(fisheye_views.P), dtype=np.uint32)
        opened.write_matches(*ids, np.stack([rows, rows], axis=1))
    assert cli.main(["colmap", str(path), "--in-place", "-q"]) == 0
    (geometry,) = read_geometries(path).values()
    mask = np.isin(np.arange(len(fisheye_views.P)), geometry.inlier_matches[:, 0])
    assert min(fisheye_views.recalls(mask)) > 0.97
    assert mask[~fisheye_views.RIGHT].mean() < 0.05


def test_pairs_of_a_distorted_camera_are_found(tmp_path, views, raw_matches):
    """Keypoints moved to where a lens would put them, the lens in the database: the poses stay."""
    path = multi_view.write_database(tmp_path / "raw.db", views, raw_matches)
    with closing(pycolmap.Database.open(path)) as opened:
        camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[512, 512, 320, 240, -0.2, 0.05, 0, 0])
        camera.camera_id, camera.has_prior_focal_length = 1, True
        opened.update_camera(camera)
        for image_id, view in enumerate(views, 1):
            table = opened.read_keypoints(image_id)
            rays = np.column_stack([(view.points - view.K[:2, 2]) / 512.0, np.ones(len(view.points))])
            table[:, :2] = [camera.img_from_cam(ray) for ray in rays]
            opened.update_keypoints(image_id, table)
    assert cli.main(["colmap", str(path), "--in-place", "-q"]) == 0
    assert_poses_are_true(read_geometries(path), views)


def test_without_focal_length_the_pair_is_uncalibrated(few_pairs, tmp_path):
    database = few_pairs
    with closing(pycolmap.Database.open(database)) as opened:
        camera = opened.read_camera(1)
        camera.has_prior_focal_length = False
        opened.update_camera(camera)
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"]) == 0
    geometries = read_geometries(tmp_path / "out.db").values()
    assert CONFIGURATION.UNCALIBRATED in {geometry.config for geometry in geometries}
    for geometry in geometries:
        assert geometry.E is None
        assert geometry.cam2_from_cam1 is None


def test_ids_in_the_other_order(tmp_path, views, raw_matches):
    """Matches written from the larger id to the smaller: COLMAP turns them round, and so do pose and columns."""
    turned = {(j, i): pairs[:, ::-1] for (i, j), pairs in raw_matches.items()}
    path = multi_view.write_database(tmp_path / "turned.db", views, turned)
    assert cli.main(["colmap", str(path), "--in-place", "-q"]) == 0
    geometries = read_geometries(path)
    assert all(id1 < id2 for id1, id2 in geometries)
    assert_poses_are_true(geometries, views)


def test_configuration_follows_status():
    def row(status, calibrated=True, **matrices):
        return PairRow(
            "a", "b", status, 9, np.zeros((0, 2), np.uint32), np.zeros(0, np.float32), calibrated, **matrices
        )

    H = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, -2.0], [1e-3, 0.0, 1.0]])
    rotation = colmap.two_view_geometry(row("pure_rotation", R=np.eye(3), H=H))
    assert rotation.config == CONFIGURATION.PANORAMIC
    assert (rotation.cam2_from_cam1.translation == 0).all()
    planar = colmap.two_view_geometry(row("planar", H=H))
    assert planar.config == CONFIGURATION.PLANAR
    assert colmap.two_view_geometry(row("planar", calibrated=False)).config == CONFIGURATION.PLANAR_OR_PANORAMIC
    for status in ("unrelated", "low_support", "no_geometry", "too_few_matches", "failed"):
        assert colmap.two_view_geometry(row(status)).config == CONFIGURATION.DEGENERATE
    # Focal lengths alone make the pose doubtful: the matches are kept, and there is nothing else to write.
    kept = replace(row("low_support", calibrated=False, F=np.eye(3)), kept=np.zeros((9, 2), np.uint32))
    verified = colmap.two_view_geometry(kept)
    assert verified.config == CONFIGURATION.UNCALIBRATED
    assert len(verified.inlier_matches) == 9
    assert colmap.two_view_geometry(replace(kept, calibrated=True)).config == CONFIGURATION.DEGENERATE
    point = np.array([10.0, 20.0, 1.0])  # COLMAP's pixel; half a pixel less in OpenCV's
    there, expected = planar.H @ point, H @ (point - [0.5, 0.5, 0.0])
    np.testing.assert_allclose(there[:2] / there[2], expected[:2] / expected[2] + 0.5)


def test_matches_that_point_nowhere_fail_alone(database, tmp_path, capsys):
    with closing(pycolmap.Database.open(database)) as opened:
        opened.delete_matches(1, 2)
        opened.write_matches(1, 2, np.full((30, 2), 99999, np.uint32))
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"]) == 0
    assert_one_line(capsys.readouterr(), "99999")
    with closing(pycolmap.Database.open(tmp_path / "out.db")) as opened:
        assert opened.read_two_view_geometry(1, 2).config == CONFIGURATION.DEGENERATE
    geometries = read_geometries(tmp_path / "out.db")  # COLMAP lists those with matches only
    assert [g.config for g in geometries.values()] == [CONFIGURATION.CALIBRATED] * 5


def test_database_locked_by_another_process(few_pairs, tmp_path, capsys):
    database = few_pairs
    with closing(sqlite3.connect(database, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert cli.main(["colmap", str(database), "--in-place", "-q"]) == 2
        assert_one_line(capsys.readouterr(), "raw.db", "locked by another process")
        other.execute("ROLLBACK")
    assert read_geometries(database) == {}
    assert cli.main(["colmap", str(database), "--in-place", "-q"]) == 0  # from the journal of the first try
    assert len(read_geometries(database)) == 2


def change(database, *statements: str) -> None:
    with closing(sqlite3.connect(database)) as plain:
        for statement in statements:
            plain.execute(statement)
        plain.commit()


UNUSABLE = {
    "no camera": (["INSERT INTO cameras SELECT 2, model, width, height, params, prior_focal_length FROM cameras",
                   "UPDATE images SET camera_id = 2 WHERE image_id = 2", "PRAGMA foreign_keys = OFF",
                   "DELETE FROM cameras WHERE camera_id = 2"], ["view01.png: its camera 2 is not in the database"]),
    "focal length 0": (["INSERT INTO cameras SELECT 2, model, width, height, zeroblob(32), 1 FROM cameras",
                        "UPDATE images SET camera_id = 2 WHERE image_id = 2"], ["view01.png: its camera 2", "0, 0"]),
    "short parameters": (["INSERT INTO cameras SELECT 2, model, width, height, zeroblob(16), 1 FROM cameras",
                          "UPDATE images SET camera_id = 2 WHERE image_id = 2"], ["view01.png: "]),
    "unknown model": (["INSERT INTO cameras SELECT 2, 99, width, height, params, 1 FROM cameras",
                       "UPDATE images SET camera_id = 2 WHERE image_id = 2"], ["view01.png: "]),
    "short keypoints": (["UPDATE keypoints SET data = zeroblob(10) WHERE image_id = 2"], ["view01.png: "]),
    "short descriptors": (["UPDATE descriptors SET data = zeroblob(10) WHERE image_id = 2"], ["view01.png: "]),
    "short matches": (["UPDATE matches SET data = zeroblob(3)"], [" with "]),
}  # fmt: skip


@pytest.mark.parametrize("defect", UNUSABLE)
def test_a_damaged_row_costs_its_own_pairs_only(database, tmp_path, capsys, defect):
    statements, words = UNUSABLE[defect]
    change(database, *statements)
    status = cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"])
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert captured.out == ""
    assert all(word in lines[0] for word in words), lines
    assert "Traceback" not in captured.err
    healthy = 0 if defect == "short matches" else 3
    assert status == (0 if healthy else 1)
    assert lines[-1] == f"mgca-match: {6 - healthy} pairs failed"
    assert len(read_geometries(tmp_path / "out.db")) == healthy


def test_a_name_that_is_not_utf8_is_a_name(few_pairs, tmp_path):
    database = few_pairs
    change(database, "UPDATE images SET name = CAST(x'66DF2E706E67' AS TEXT) WHERE image_id = 2")
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"]) == 0
    assert len(read_geometries(tmp_path / "out.db")) == 2


FOREIGN = {
    "DROP TABLE descriptors": ["not a COLMAP database", "descriptors"],
    "ALTER TABLE cameras RENAME COLUMN params TO p": [],
    "ALTER TABLE images RENAME COLUMN camera_id TO camera": [],
    "ALTER TABLE matches DROP COLUMN rows": [],
    "DROP TABLE two_view_geometries": None,  # what COLMAP makes anew
}
# Prints the exit status of each command behind its one line of words.
COMMANDS = """
import sys
from mgca_filter import cli
for path in sys.argv[1:]:
    print("->", cli.main(["colmap", path, "-o", path + ".out", "-q"]), file=sys.stderr)
"""


def test_databases_of_another_make_are_one_line_each(database, tmp_path):
    """In a process of its own: COLMAP's library must not take it down either."""
    paths = [tmp_path / f"{k}.db" for k in range(len(FOREIGN))]
    for path, statement in zip(paths, FOREIGN):
        shutil.copy(database, path)
        change(path, "PRAGMA foreign_keys = OFF", "DROP INDEX IF EXISTS index_name", statement)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", COMMANDS, *map(str, paths)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    lines = done.stderr.splitlines()
    for path, words in zip(paths, FOREIGN.values()):
        if words is not None:
            said = lines.pop(0)
            assert all(word in said for word in (path.name, *words)), said
        assert lines.pop(0) == ("-> 0" if words is None else "-> 2")
    assert lines == []


def test_a_truncated_database_is_one_line(database, tmp_path, capsys):
    database.write_bytes(database.read_bytes()[:-20_000])
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "out.db"), "-q"]) == 2
    assert_one_line(capsys.readouterr(), "raw.db")


def test_misuse_is_one_line(few_pairs, tmp_path, capsys):
    database = few_pairs
    out = str(tmp_path / "out.db")
    (tmp_path / "text.db").write_text("hello " * 1000)
    (tmp_path / "exists.db").write_text("precious")
    with closing(sqlite3.connect(tmp_path / "other.db")) as other:
        other.execute("CREATE TABLE t (x)")
    for arguments, words in (
        ([str(tmp_path / "missing.db"), "-o", out], ["missing.db"]),
        ([str(tmp_path / "text.db"), "-o", out], ["text.db", "not a database"]),
        ([str(tmp_path / "other.db"), "-o", out], ["not a COLMAP database"]),
        ([str(database)], ["--output", "--in-place"]),
        ([str(database), "-o", str(database)], ["is the input"]),
        ([str(database), "-o", str(tmp_path / "exists.db")], ["exists.db", "--overwrite"]),
        ([str(database), "-o", str(tmp_path / "no" / "out.db")], ["folder does not exist"]),
        ([str(database), "-o", out, "--truth", str(tmp_path)], ["--compare"]),
    ):
        assert cli.main(["colmap", *arguments]) == 2
        assert_one_line(capsys.readouterr(), *words)
    assert (tmp_path / "exists.db").read_text() == "precious"
    assert cli.main(["colmap", str(database), "-o", str(tmp_path / "exists.db"), "--overwrite", "-q"]) == 0


@pytest.mark.slow
def test_mapper_on_our_geometries_beats_mapper_on_colmaps(database, views, tmp_path):
    """Four views, four matches of five wrong: as many images or more, at a lower pose error."""
    assert cli.main(["colmap", str(database), "--in-place", "-q"]) == 0
    truth = multi_view.write_truth(tmp_path / "truth", views)
    theirs, ours = compare(database, 1.0, truth, workers=1)
    assert ours.registered_images == len(views)
    assert ours.registered_images >= theirs.registered_images
    assert np.median(ours.pose_errors_deg) < np.median(theirs.pose_errors_deg)
    assert np.median(ours.pose_errors_deg) < 1.0
