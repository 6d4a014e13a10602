"""Folders of images: pair lists, outputs, resume after a kill, broken images, full disks."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
from dataclasses import fields
from inspect import signature

import cv2
import h5py
import numpy as np
import pytest
from conftest import METADATA, build_model
from exif_files import FOCAL_35MM, with_exif
from image_files import turned
from pipeline_command import K_WORDS, ROOT, assert_one_line, start_command

from mgca_filter import cli, match_images
from mgca_filter.features import create_detector, describe
from mgca_filter.geometry.epipolar import pose_error_deg, sampson_distance
from mgca_filter.html_report import write_folder_report
from mgca_filter.images import intrinsics_as_shown
from mgca_filter.pipelines.folder import FolderJob, camera_size, exhaustive_pairs, read_pairs, sequential_pairs
from mgca_filter.pipelines.journal import PipelineError
from mgca_filter.pipelines.stored_pixels import stored_row
from mgca_filter.pipelines.worker import MAPPING_THRESHOLD_PX, PairRow

# A quarter of the default: the laws are about the run, not about the matches.
KEYPOINTS = 1000
FEATURES = ["--max-keypoints", str(KEYPOINTS)]
OPTIONS = ["--K", K_WORDS, *FEATURES, "-q"]


def run(folder, output, *words) -> int:
    return cli.main(["folder", str(folder), "-o", str(output), *OPTIONS, *map(str, words)])


def read_rows(path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def expected(tmp_path_factory, views):
    """Rows of one uninterrupted run in one process."""
    folder = tmp_path_factory.mktemp("expected")
    (folder / "images").mkdir()
    for view in views:
        cv2.imwrite(str(folder / "images" / view.name), view.image)
    assert run(folder / "images", folder / "out.jsonl") == 0
    return (folder / "out.jsonl").read_text()


def test_rows_equal_match_images(image_folder, views, expected):
    """The pipeline is ``match_images``, pair by pair."""
    rows = [json.loads(line) for line in expected.splitlines()]
    assert [(row["image1"], row["image2"]) for row in rows] == exhaustive_pairs([view.name for view in views])
    for row in rows:
        view1, view2 = (next(v for v in views if v.name == row[key]) for key in ("image1", "image2"))
        alone = match_images(
            view1.image, view2.image, K1=view1.K, max_keypoints=KEYPOINTS, threshold=MAPPING_THRESHOLD_PX
        )
        assert row["status"] == alone.result.status.value
        assert row["confidence"] == alone.result.confidence
        assert row["num_inliers"] == alone.result.num_inliers == len(row["points1"]) == len(row["scores"])
        np.testing.assert_allclose(row["R"], alone.result.R, atol=1e-9)


@pytest.mark.slow
def test_poses_are_true_with_the_default_features(image_folder, views, tmp_path):
    assert cli.main(["folder", str(image_folder), "-o", str(tmp_path / "out.jsonl"), "--K", K_WORDS, "-q"]) == 0
    rows = read_rows(tmp_path / "out.jsonl")
    assert len(rows) == 6
    for row in rows:
        view1, view2 = (next(v for v in views if v.name == row[key]) for key in ("image1", "image2"))
        R = view2.R @ view1.R.T
        assert row["num_matches"] > KEYPOINTS
        assert pose_error_deg(row["R"], row["t"], R, view2.t - R @ view1.t) < 2.0


@pytest.mark.slow
def test_large_images_are_judged_in_the_copy_that_was_searched(tmp_path, views):
    factor = 2.5
    large = [cv2.resize(view.image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC) for view in views[:2]]
    (tmp_path / "images").mkdir()
    for view, image in zip(views, large):
        cv2.imwrite(str(tmp_path / "images" / view.name), image)
    fx, fy, cx, cy = (views[0].K[[0, 1, 0, 1], [0, 1, 2, 2]] * factor).tolist()
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    words = ["--K", f"{fx},{fy},{cx},{cy}", *FEATURES, "-q"]
    assert cli.main(["folder", str(tmp_path / "images"), "-o", str(tmp_path / "out.jsonl"), *words]) == 0
    (row,) = read_rows(tmp_path / "out.jsonl")
    alone, strict = (
        match_images(*large, K1=K, max_keypoints=KEYPOINTS, threshold=MAPPING_THRESHOLD_PX, **options)
        for options in ({}, {"resolution": 1.0})
    )
    assert row["num_inliers"] == alone.result.num_inliers > strict.result.num_inliers


@pytest.mark.slow
def test_processes_give_the_same_rows(image_folder, tmp_path, expected):
    assert run(image_folder, tmp_path / "out.jsonl", "-j", 2) == 0
    assert (tmp_path / "out.jsonl").read_text() == expected


def test_pair_choices(image_folder, tmp_path):
    names = [f"view{k:02d}.png" for k in range(4)]
    assert sequential_pairs(names, 2) == [p for p in exhaustive_pairs(names) if int(p[1][5]) - int(p[0][5]) <= 2]
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("# a comment\n\nview02.png view00.png\nview00.png\tview02.png\nview01.png  view03.png\n")
    assert run(image_folder, tmp_path / "listed.jsonl", "--pairs", pairs) == 0
    listed = [(row["image1"], row["image2"]) for row in read_rows(tmp_path / "listed.jsonl")]
    assert listed == [("view01.png", "view03.png"), ("view02.png", "view00.png")]
    assert run(image_folder, tmp_path / "s.jsonl", "--pairs", "sequential", "--overlap", 1) == 0
    assert len(read_rows(tmp_path / "s.jsonl")) == 3


def test_options_are_obeyed(image_folder, tmp_path, expected):
    few = ["--pairs", "sequential", "--overlap", 1]
    assert run(image_folder, tmp_path / "few.jsonl", *few, "--max-keypoints", 500) == 0
    assert max(row["num_matches"] for row in read_rows(tmp_path / "few.jsonl")) <= 501
    assert run(image_folder, tmp_path / "orb.jsonl", *few, "--detector", "orb") in (0, 1)
    assert read_rows(tmp_path / "orb.jsonl")[0]["points1"] != json.loads(expected.splitlines()[0])["points1"]
    words = ["folder", str(image_folder), "-o", str(tmp_path / "no_K.jsonl"), "-q", *FEATURES, *map(str, few)]
    assert cli.main(words) == 0
    assert not any(row["calibrated"] for row in read_rows(tmp_path / "no_K.jsonl"))


def test_cache_is_used_and_follows_the_images(image_folder, tmp_path):
    few = ["--pairs", "sequential", "--overlap", 1, "--cache", tmp_path / "cache"]
    assert run(image_folder, tmp_path / "a.jsonl", *few) == 0
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()}
    assert len(stamps) == 4
    assert run(image_folder, tmp_path / "b.jsonl", *few) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()} == stamps
    changed = image_folder / "view00.png"
    changed.write_bytes((image_folder / "view03.png").read_bytes())
    assert run(image_folder, tmp_path / "c.jsonl", *few) == 0
    assert len(list((tmp_path / "cache").iterdir())) == 5


def test_corrupt_image_costs_its_own_pairs_only(image_folder, tmp_path, capsys, expected):
    (image_folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no image")
    (image_folder / "empty.png").touch()
    assert run(image_folder, tmp_path / "out.jsonl") == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "broken.jpg: no features" in captured.err
    assert "empty.png: no features" in captured.err
    rows = read_rows(tmp_path / "out.jsonl")
    healthy = [row for row in rows if row["status"] != "failed"]
    assert healthy == [json.loads(line) for line in expected.splitlines()]
    assert len(rows) - len(healthy) == 9


def test_exit_status_without_any_geometry(tmp_path):
    folder = tmp_path / "noise"
    folder.mkdir()
    for seed in range(2):
        noise = np.random.default_rng(seed).integers(0, 255, (120, 160), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{seed}.png"), noise)
    assert run(folder, tmp_path / "out.jsonl") == 1
    (row,) = read_rows(tmp_path / "out.jsonl")
    assert row["points1"] == []
    assert row["E"] is None


def test_misuse_is_one_line(image_folder, tmp_path, capsys):
    pairs = tmp_path / "pairs.txt"
    for text, words in (
        ("view00.png view01.png\nview00.png missing.png\n", ["pairs.txt:2", "missing.png is not in"]),
        ("view00.png\n", ["pairs.txt:1", "two names"]),
        ("view00.png view00.png\n", ["pairs.txt:1"]),
        ("", ["no pairs"]),
    ):
        pairs.write_text(text)
        assert run(image_folder, tmp_path / "out.jsonl", "--pairs", pairs) == 2
        assert_one_line(capsys.readouterr(), *words)
    for words, message in (
        (["folder", str(image_folder), "-o", str(tmp_path / "out.txt")], ".jsonl"),
        (["folder", str(tmp_path / "missing"), "-o", str(tmp_path / "out.jsonl")], "no such folder"),
        (["folder", str(image_folder), "-o", str(tmp_path / "o.h5"), "--address", "auto"], "--engine ray"),
        (["folder", str(image_folder), "-o", str(tmp_path / "o.h5"), "-j", "0"], "--jobs"),
        (["folder", str(image_folder), "-o", str(tmp_path / "o.h5"), "--pairs", "none.txt"], "none.txt"),
        (["folder", str(image_folder), "-o", str(tmp_path / "o.h5"), "-j", "2", "--model", "no.onnx"], "no.onnx"),
    ):
        assert cli.main(words) == 2
        assert_one_line(capsys.readouterr(), message)


def test_a_file_of_the_subcommands_name_is_an_image(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").write_bytes(b"no image")
    assert cli.main(["folder", "folder"]) == 2
    assert_one_line(capsys.readouterr(), "folder: not an image")
    (tmp_path / "folder").unlink()
    (tmp_path / "folder").mkdir()
    assert cli.main(["folder", "folder", "-o", "out.jsonl"]) == 2
    assert_one_line(capsys.readouterr(), "folder: no images")


KILLED_AFTER_TWO_ROWS = """
import os, signal, sys
from mgca_filter import cli
from mgca_filter.pipelines.journal import Journal
add, rows = Journal.add, []
def add_and_die(journal, row):
    add(journal, row)
    rows.append(row)
    if len(rows) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.add = add_and_die
cli.main(sys.argv[1:])
"""


@pytest.mark.slow
def test_kill_in_the_middle_loses_nothing(image_folder, tmp_path, expected, capsys):
    """kill -9 after two rows: the second run does the others only, and gives the same file."""
    output = tmp_path / "out.jsonl"
    command = [sys.executable, "-c", KILLED_AFTER_TWO_ROWS, "folder", str(image_folder), "-o", str(output), *OPTIONS]
    killed = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert not output.exists()
    assert cli.main(["folder", str(image_folder), "-o", str(output), *OPTIONS[:-1]]) == 0
    assert "(2 were done before)" in capsys.readouterr().out
    assert output.read_text() == expected
    assert not (tmp_path / "out.jsonl.work").exists()


def test_resume_with_other_options_is_refused(image_folder, tmp_path, capsys):
    from mgca_filter.pipelines.journal import Journal

    (tmp_path / "out.jsonl.work").mkdir()
    journal = Journal(tmp_path / "out.jsonl.work" / "journal.log")
    journal.begin({"threshold": 3.0})
    assert run(image_folder, tmp_path / "out.jsonl") == 2
    assert_one_line(capsys.readouterr(), "journal.log", "locked by another process")
    journal.close()
    assert run(image_folder, tmp_path / "out.jsonl") == 2
    assert_one_line(capsys.readouterr(), "out.jsonl.work", "threshold 3.0 instead of 2.0")


def test_resume_with_another_model_of_the_same_name_is_refused(image_folder, tmp_path, monkeypatch, capsys):
    """A killed run leaves its rows; the same command with other weights in the same file must not add to them."""
    model, output = tmp_path / "m.onnx", tmp_path / "out.jsonl"
    few = ["--model", model, "--pairs", "sequential", "--overlap", 1]
    build_model(model)
    first = model.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(FolderJob, "_write", lambda *arguments: pytest.fail("killed"))
        with pytest.raises(pytest.fail.Exception):
            run(image_folder, output, *few)
    build_model(model, {**METADATA, "version": "1"})
    assert run(image_folder, output, *few) == 2
    assert_one_line(capsys.readouterr(), "out.jsonl.work", "model_sha256", "delete it or resume that run")
    model.write_bytes(first)
    words = ["folder", str(image_folder), "-o", str(output), "--K", K_WORDS, *FEATURES, *map(str, few)]
    assert cli.main(words) == 0
    assert "(3 were done before)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "package", "extra"),
    [
        (["folder", "images", "-o", "o.h5"], "h5py", "hloc"),
        (["folder", "images", "-o", "o.db"], "pycolmap", "colmap"),
        (["folder", "images", "-o", "o.jsonl"], "tqdm", "folder"),
        (["folder", "images", "-o", "o.jsonl", "-j", "2"], "joblib", "folder"),
        (["folder", "images", "-o", "o.jsonl", "--engine", "ray"], "ray", "ray"),
        (["hloc", "f.h5", "m.h5", "-o", "o.h5"], "h5py", "hloc"),
        (["hloc", "f.h5", "m.h5", "-o", "o.h5"], "tqdm", "hloc"),
        (["colmap", "i.db", "-o", "o.db"], "pycolmap", "colmap"),
        (["colmap", "i.db", "-o", "o.db"], "joblib", "colmap"),
        (["colmap", "i.db", "--in-place"], "tqdm", "colmap"),
    ],
)
def test_a_missing_package_is_told_before_the_work(
    image_folder, tmp_path, monkeypatch, capsys, command, package, extra
):
    monkeypatch.chdir(tmp_path)
    for name in ("f.h5", "m.h5", "i.db"):
        (tmp_path / name).touch()
    for module in [name for name in sys.modules if name.startswith("mgca_filter.pipelines.")]:
        if module.endswith((".colmap", ".hloc")):
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(command) == 2
    assert_one_line(capsys.readouterr(), package, f"mgca_filter[{extra}]")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_full_disk_is_one_line_and_the_run_goes_on_later(image_folder, tmp_path, expected):
    """A limit on the size of files stands for the full disk: the output does not fit, the rows are kept."""
    output = tmp_path / "out.jsonl"
    limit = 3 * len(expected) // 4

    def little_disk() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    cache = ["--cache", tmp_path / "cache"]
    assert run(image_folder, tmp_path / "first.jsonl", *cache, "--pairs", "sequential", "--overlap", 1) == 0
    process = start_command("folder", image_folder, "-o", output, *OPTIONS, *cache, preexec_fn=little_disk)
    out, err = process.communicate()
    assert process.returncode == 2
    assert err.count("\n") == 1, err
    assert "out.jsonl" in err
    assert not output.exists()
    assert not list(output.parent.glob("out.jsonl*.partial"))
    assert run(image_folder, output, *cache) == 0
    assert output.read_text() == expected


def test_hloc_output_is_read_by_the_hloc_command(image_folder, tmp_path, expected):
    (image_folder / "broken.jpg").write_bytes(b"no image")
    assert run(image_folder, tmp_path / "m.h5") == 0
    rows = [json.loads(line) for line in expected.splitlines()]
    with h5py.File(tmp_path / "m.h5") as matches, h5py.File(tmp_path / "m.features.h5") as features:
        for row in rows:
            group = matches[row["image1"]][row["image2"]]
            first = np.flatnonzero(group["matches0"][()] > -1)
            np.testing.assert_array_equal(features[row["image1"]]["keypoints"][()][first], np.float32(row["points1"]))
            second = group["matches0"][()][first]
            np.testing.assert_array_equal(features[row["image2"]]["keypoints"][()][second], np.float32(row["points2"]))
            np.testing.assert_allclose(group["matching_scores0"][()][first], row["scores"], atol=1e-3)
    words = [tmp_path / "m.features.h5", tmp_path / "m.h5", "-o", tmp_path / "f.h5", "-q"]
    assert cli.main(["hloc", *map(str, words)]) == 0


@pytest.mark.slow
def test_colmap_output_goes_through_the_mapper(image_folder, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    assert run(image_folder, tmp_path / "out.db") == 0
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors, options.min_model_size = False, 3
    (tmp_path / "model").mkdir()
    models = pycolmap.incremental_mapping(tmp_path / "out.db", image_folder, tmp_path / "model", options)
    assert max(model.num_reg_images() for model in models.values()) == 4


@pytest.mark.slow
def test_images_of_another_size_are_named_and_matched_without_K(image_folder, tmp_path, capsys):
    image = cv2.imread(str(image_folder / "view00.png"))
    cv2.imwrite(str(image_folder / "view00.png"), cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE))
    (image_folder / "view03.png").unlink()
    few = [str(image_folder), "--K", K_WORDS, "--max-keypoints", "500"]
    cli.main(["folder", *few, "-o", str(tmp_path / "a.jsonl")])
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mgca-match:")]
    assert told == ["mgca-match: one K is that of one size, here 640 x 480: matched without it: view00.png (480 x 640)"]
    rows = read_rows(tmp_path / "a.jsonl")
    assert {row["calibrated"] for row in rows if "view00.png" in (row["image1"], row["image2"])} == {False}
    assert {row["calibrated"] for row in rows if "view00.png" not in (row["image1"], row["image2"])} == {True}
    cli.main(["folder", *few, "-q", "-o", str(tmp_path / "b.jsonl")])
    assert "one K" not in capsys.readouterr().err
    cli.main(["folder", str(image_folder), "--max-keypoints", "300", "-o", str(tmp_path / "c.jsonl")])
    assert "one K" not in capsys.readouterr().err


def test_cameras_of_the_database_are_those_that_the_images_were_matched_with(image_folder, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    cv2.imwrite(str(image_folder / "view00.png"), np.zeros((640, 480), np.uint8))
    assert run(image_folder, tmp_path / "out.db", "--max-keypoints", 300) == 0
    with contextlib.closing(pycolmap.Database.open(tmp_path / "out.db")) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        of = {image.name: cameras[image.camera_id] for image in database.read_all_images()}
    assert len(cameras) == 2
    assert not of["view00.png"].has_prior_focal_length
    assert of["view01.png"].has_prior_focal_length
    np.testing.assert_allclose(of["view02.png"].params, [512, 512, 320, 240])


@pytest.fixture
def photographs(tmp_path, views):
    """Two views as JPEG whose EXIF knows a focal length, 512 px, and one whose EXIF does not."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for number, view in enumerate(views[:3]):
        jpeg = cv2.imencode(".jpg", view.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        (folder / f"{number}.jpg").write_bytes(with_exif(jpeg, {FOCAL_35MM: 28} if number < 2 else {}))
    return folder


@pytest.mark.slow
def test_the_focal_length_is_that_of_the_exif_data(photographs, tmp_path):
    words = ["folder", str(photographs), *FEATURES, "-q", "-o"]
    assert cli.main([*words, str(tmp_path / "out.jsonl")]) == 0
    calibrated = {(row["image1"], row["image2"]): row["calibrated"] for row in read_rows(tmp_path / "out.jsonl")}
    assert calibrated == {("0.jpg", "1.jpg"): True, ("0.jpg", "2.jpg"): False, ("1.jpg", "2.jpg"): False}
    assert cli.main([*words, str(tmp_path / "guess.jsonl"), "--no-exif"]) == 0
    assert not any(row["calibrated"] for row in read_rows(tmp_path / "guess.jsonl"))


def test_cameras_of_the_exif_data_have_a_prior_focal_length(photographs, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    assert cli.main(["folder", str(photographs), *FEATURES, "-q", "-o", str(tmp_path / "out.db")]) == 0
    with contextlib.closing(pycolmap.Database.open(tmp_path / "out.db")) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        of = {image.name: cameras[image.camera_id] for image in database.read_all_images()}
    assert [of[f"{number}.jpg"].has_prior_focal_length for number in range(3)] == [True, True, False]
    assert len(cameras) == 2
    np.testing.assert_allclose(of["0.jpg"].params, [512, 320, 240, 0])


def test_the_filter_options_are_those_of_the_pair_command(image_folder, tmp_path, expected):
    few = ["--pairs", "sequential", "--overlap", 1]
    assert run(image_folder, tmp_path / "sure.jsonl", *few, "--keep-precision", 0.5) == 0
    first, sure = json.loads(expected.splitlines()[0]), read_rows(tmp_path / "sure.jsonl")[0]
    assert 0 < sure["num_inliers"] != first["num_inliers"]
    assert run(image_folder, tmp_path / "cpu.jsonl", *few, "--providers", "CPUExecutionProvider") == 0
    assert read_rows(tmp_path / "cpu.jsonl")[0] == first


def test_the_report_is_about_the_rows(image_folder, tmp_path, monkeypatch):
    from mgca_filter.pipelines import run as run_module

    written = []

    def write_and_note(path, lines, **words):
        lines = list(lines)
        written.append((lines, words))
        return write_folder_report(path, lines, **words)

    monkeypatch.setattr(run_module, "write_folder_report", write_and_note)
    (image_folder / "broken.jpg").write_bytes(b"no image")
    output, page = tmp_path / "out.jsonl", tmp_path / "report.html"
    assert run(image_folder, output, "--html", page) == 0
    ((lines, words),) = written
    keys = ("image1", "image2", "status", "num_matches", "num_inliers", "confidence")
    assert [tuple(line) for line in lines] == [tuple(row[key] for key in keys) for row in read_rows(output)]
    assert {line.status for line in lines} >= {"ok", "failed"}
    assert words["title"] == "images"
    assert words["command"].startswith("mgca-match folder ")
    assert page.read_text(encoding="utf-8").startswith("<!")
    assert not list(tmp_path.glob("*.partial"))


def test_a_report_that_cannot_be_written_is_told_before_the_work(image_folder, tmp_path, capsys):
    output = tmp_path / "out.jsonl"
    for page, words in ((tmp_path, "is a folder"), (tmp_path / "no" / "r.html", "does not exist"), (output, "output")):
        assert run(image_folder, output, "--html", page) == 2
        assert_one_line(capsys.readouterr(), str(page), words)
    assert not (tmp_path / "out.jsonl.work").exists()


@pytest.mark.parametrize("name", ["sift", "rootsift"])
def test_written_descriptors_are_of_the_kind_that_colmap_and_hloc_have(image_folder, views, tmp_path, name):
    pycolmap = pytest.importorskip("pycolmap")
    found = describe(views[0].image, create_detector(name, 300)).descriptors
    for view in views[2:]:
        (image_folder / view.name).unlink()
    words = ["--max-keypoints", 300, "--detector", name]
    assert run(image_folder, tmp_path / "out.db", *words) == 0
    with contextlib.closing(pycolmap.Database.open(tmp_path / "out.db")) as database:
        (image,) = (image for image in database.read_all_images() if image.name == views[0].name)
        stored = np.asarray(database.read_descriptors(image.image_id).data)
    assert stored.dtype == np.uint8
    # COLMAP's own are of norm 512, whichever their normalisation.
    np.testing.assert_allclose(np.linalg.norm(stored.astype(float), axis=1), 512, rtol=0.05)
    np.testing.assert_allclose(stored, np.minimum(found * (512 if name == "rootsift" else 1), 255), atol=0.5001)
    assert run(image_folder, tmp_path / "out.h5", *words) == 0
    with h5py.File(tmp_path / "out.features.h5") as features:
        np.testing.assert_array_equal(features[views[0].name]["descriptors"][()].T, found)


def test_a_folder_is_matched_with_the_defaults_of_match_images():
    job = {field.name: field.default for field in fields(FolderJob)}
    alone = signature(match_images).parameters
    assert [job[name] for name in ("detector", "max_keypoints")] == ["rootsift", 4000]
    assert [alone[name].default for name in ("detector", "max_keypoints")] == ["rootsift", 4000]


@pytest.fixture
def held_sideways(tmp_path, views):
    """Two views as files, upright, and as a camera stores them that was held sideways for the second."""
    folders = tmp_path / "upright", tmp_path / "sideways"
    for folder, orientations in zip(folders, ((1, 1), (1, 6))):
        folder.mkdir()
        for number, (view, orientation) in enumerate(zip(views, orientations)):
            stored = view.image if orientation == 1 else cv2.rotate(view.image, cv2.ROTATE_90_COUNTERCLOCKWISE)
            (folder / f"{number}.png").write_bytes(turned(".png", stored, orientation))
    return folders


def test_photos_are_matched_as_they_are_shown(held_sideways, tmp_path):
    """As by ``mgca-match img1 img2``, with the same K for the two."""
    rows = []
    for folder in held_sideways:
        assert run(folder, tmp_path / f"{folder.name}.jsonl", "--max-keypoints", 1000) == 0
        rows += read_rows(tmp_path / f"{folder.name}.jsonl")
    assert rows[0]["status"] == "ok"
    assert rows[0]["calibrated"]
    assert rows[0] == rows[1]


def test_what_colmap_and_hloc_get_is_in_the_pixels_of_the_files(held_sideways, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    for folder in held_sideways:
        assert run(folder, tmp_path / f"{folder.name}.db", "--max-keypoints", 1000) == 0
        assert run(folder, tmp_path / f"{folder.name}.h5", "--max-keypoints", 1000) == 0
    answers = []
    for folder in held_sideways:
        with contextlib.closing(pycolmap.Database.open(tmp_path / f"{folder.name}.db")) as database:
            tables = [database.read_keypoints(number) for number in (1, 2)]
            answers.append((tables, database.read_two_view_geometry(1, 2), database.read_camera(2)))
            read_by_colmap = pycolmap.Bitmap.read(folder / "1.png", False)
            camera = database.read_camera(database.read_image(2).camera_id)
            assert (camera.width, camera.height) == (read_by_colmap.width, read_by_colmap.height)
    (upright, geometry, _), (sideways, turned_geometry, camera) = answers
    np.testing.assert_allclose(sideways[0], upright[0], atol=1e-3)
    # A quarter turn clockwise shows the stored pixel (x, y) at (height - y, x), in COLMAP's pixels.
    np.testing.assert_allclose(
        sideways[1][:, :2], np.column_stack([upright[1][:, 1], 640 - upright[1][:, 0]]), atol=1e-3
    )
    np.testing.assert_allclose(camera.params, [512, 512, 240, 320], atol=1e-9)
    np.testing.assert_array_equal(turned_geometry.inlier_matches, geometry.inlier_matches)
    kept = geometry.inlier_matches
    points1, points2 = sideways[0][kept[:, 0], :2], sideways[1][kept[:, 1], :2]
    assert sampson_distance(np.hstack([points1, points2]), turned_geometry.F).max() < MAPPING_THRESHOLD_PX + 0.1
    # The turned camera sees every point turned with it, about its own axis.
    S = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    R = turned_geometry.cam2_from_cam1.rotation.matrix()
    np.testing.assert_allclose(S @ R, geometry.cam2_from_cam1.rotation.matrix(), atol=1e-9)
    with h5py.File(tmp_path / "sideways.features.h5") as file:
        np.testing.assert_allclose(file["1.png/keypoints"][()] + 0.5, sideways[1][:, :2], atol=1e-3)
        assert file["1.png/image_size"][()].tolist() == [480, 640]


def test_one_K_is_for_photos_as_they_are_shown_or_as_they_are_stored():
    landscape, portrait = camera(319.5, 239.5), camera(239.5, 319.5)
    upright, sideways = ((640, 480), 1), ((480, 640), 6)
    for K, photos, size in (
        (landscape, [upright, sideways], (640, 480)),
        (landscape, [sideways], (640, 480)),
        (portrait, [sideways], (480, 640)),
        (landscape, [upright], (640, 480)),
    ):
        assert camera_size(K, dict(enumerate(photos))) == (size, [])
    np.testing.assert_allclose(intrinsics_as_shown(landscape, (640, 480), *sideways), portrait)
    np.testing.assert_array_equal(intrinsics_as_shown(portrait, (480, 640), *sideways), portrait)
    assert intrinsics_as_shown(landscape, (640, 480), (480, 640), 1) is None
    assert intrinsics_as_shown(landscape, (640, 480), (480, 640), 3) is None


def camera(cx, cy):
    return np.array([[512, 0, cx], [0, 512, cy], [0, 0, 1.0]])


def test_a_mirrored_file_has_no_rotation_to_its_neighbour():
    row = PairRow("a", "b", "ok", 9, np.zeros((0, 2), np.uint32), np.zeros(0, np.float32), R=np.eye(3), t=np.eye(3)[0])
    upright, mirrored = ((640, 480), 1), ((640, 480), 2)
    assert stored_row(row, upright, upright) is row
    for shapes in ((upright, mirrored), (mirrored, upright)):
        assert stored_row(row, *shapes).R is None
        assert stored_row(row, *shapes).t is None
    np.testing.assert_array_equal(stored_row(row, mirrored, mirrored).R, np.eye(3))
    np.testing.assert_array_equal(stored_row(row, mirrored, mirrored).t, [-1, 0, 0])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_pair_lists_as_other_systems_write_them(tmp_path, encoding):
    """Encodings and line ends; separators; names from "./" on; accents apart, as macOS writes them."""
    names = ["b\u00fcro/a.png", "b.png", "c.png"]
    lines = ["bu\u0308ro\\a.png b.png", "./c.png ./b.png", "b.png c.png", ""]
    (tmp_path / "pairs.txt").write_bytes("\r\n".join(lines).encode(encoding))
    assert read_pairs(tmp_path / "pairs.txt", names, tmp_path) == [(names[0], "b.png"), ("c.png", "b.png")]
    (tmp_path / "pairs.txt").write_text("b.png ./b.png\n")
    with pytest.raises(PipelineError, match="expected two names"):
        read_pairs(tmp_path / "pairs.txt", names, tmp_path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1 OPENCV 640 480 512 512 320 240 0.1 0 0 0\n", "has lens distortion"),
        ("1 PINHOLE 640 480 512 512 320 240\n2 PINHOLE 640 480 500 500 320 240\n", "holds 2 cameras"),
    ],
)
def test_a_camera_that_the_command_cannot_use_is_told_before_the_work(image_folder, tmp_path, capsys, content, words):
    (tmp_path / "cameras.txt").write_text(content)
    arguments = ["folder", str(image_folder), "-o", str(tmp_path / "o.jsonl"), "--K", str(tmp_path / "cameras.txt")]
    assert cli.main(arguments) == 2
    assert_one_line(capsys.readouterr(), words)
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix == ".work") == []


def test_K_from_a_file_is_that_of_the_numbers(image_folder, tmp_path, monkeypatch):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 512 512 320 240\n")
    jobs = []
    monkeypatch.setattr(FolderJob, "run", lambda job, *arguments: jobs.append(job) or pytest.fail("seen enough"))
    for K in (K_WORDS, str(tmp_path / "cameras.txt")):
        with pytest.raises(pytest.fail.Exception, match="seen enough"):
            cli.main(["folder", str(image_folder), "-o", str(tmp_path / "o.jsonl"), "--K", K])
    np.testing.assert_array_equal(jobs[0].K, jobs[1].K)


def test_options_that_make_no_sense_are_told(image_folder, tmp_path, capsys):
    (tmp_path / "none.txt").touch()
    words = ["folder", str(image_folder), "-o", str(tmp_path / "o.jsonl"), "--pairs", str(tmp_path / "none.txt")]
    for quiet, count in (([], 3), (["-q"], 1)):
        assert cli.main([*words, "--K", K_WORDS, "--overlap", "3", "--no-exif", *quiet]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == count
        assert lines[-1].endswith("no pairs to match")
    assert cli.main(words) == 2
    assert_one_line(capsys.readouterr(), "no pairs")
