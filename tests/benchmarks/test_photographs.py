"""The study from photographs to poses, on a turning camera whose pose is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene
from scene_bundles import learned_fields, write_bundle

from benchmarks import photographs
from benchmarks.match_lists import open_detector_scenes
from benchmarks.photographs import (
    CAMERA_COLUMNS,
    Camera,
    FoundMatches,
    PhotoPair,
    Setting,
    places,
    read_scene,
    run_setting,
    scaled,
    setting,
)
from mgca_filter import MatchFilter, match_images
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.features import match_descriptors
from mgca_filter.inputs.matches import read_matches


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene of two pairs: a picture of a texture, and two of the camera turned to the same side."""
    scene = make_scene("rotation")
    noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    first = cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC)
    second = cv2.warpPerspective(first, K @ scene.R @ np.linalg.inv(K), SIZE)
    lines = [",".join(["image", "width", "height", *CAMERA_COLUMNS])]
    for name, image, R, t in (
        ("a.png", first, np.eye(3), [1, 2, 3]),
        ("b.png", second, scene.R, [0, 0, 1]),
        ("c.png", second, scene.R, [0, 1, 0]),
    ):
        cv2.imwrite(str(tmp_path / name), image)
        camera = (*SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2], -0.01, *np.ravel(R), *t)
        lines.append(",".join(map(str, (name, *camera))))
    (tmp_path / "cameras.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "pairs.csv").write_text("image1,image2,covisible\na.png,b.png,50\na.png,c.png,50\n")
    return tmp_path


def test_a_scene_is_its_pairs_with_their_cameras(folder: Path) -> None:
    one, two = read_scene(folder, None, seed=0)
    assert [[path.name for path in pair.paths] for pair in (one, two)] == [["a.png", "b.png"], ["a.png", "c.png"]]
    R, t = one.pose
    X1 = np.array([0.3, -0.2, 5.0])  # of the first camera, which lies at -(1, 2, 3)
    world = X1 - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(R @ X1 + t, make_scene("rotation").R @ world + [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(one.cameras[1].K, K)
    np.testing.assert_array_equal(one.cameras[0].dist, [-0.01, 0, 0, 0])


def test_pairs_are_drawn_by_the_seed(folder: Path) -> None:
    drawn = [read_scene(folder, 1, seed)[0].paths[1].name for seed in range(20)]
    assert drawn == [read_scene(folder, 1, seed)[0].paths[1].name for seed in range(20)]
    assert set(drawn) == {"b.png", "c.png"}
    assert len(read_scene(folder, 5, seed=0)) == 2


def test_every_pair_is_answered_as_by_match_images(folder: Path, model_file: Path) -> None:
    pairs = read_scene(folder, None, seed=0)
    answers = run_setting(pairs, Setting("rootsift", 300), MatchFilter(model=model_file))
    one, two = pairs[0].cameras
    images = [cv2.imread(str(path)) for path in pairs[0].paths]
    cameras = {"K1": one.K, "K2": two.K, "dist1": one.dist, "dist2": two.dist}
    alone = match_images(*images, detector="rootsift", max_keypoints=300, model=model_file, **cameras)
    assert answers[0].matches == len(alone.matches)
    # A camera that only turns has no direction of motion: no pose, which counts as the largest error.
    assert alone.result.t is None
    assert [answer.error_deg for answer in answers] == [180.0, 180.0]
    assert all(spent > 0 for answer in answers for spent in answer.milliseconds)


def test_the_command_prints_a_line_for_every_scene_and_setting(folder: Path, model_file: Path, capsys) -> None:
    words = [str(folder), str(folder), "--model", str(model_file), "--per-scene", "1"]
    assert photographs.main([*words, "--settings", "orb-200", "rootsift-100"]) == 0
    lines = [line.split(" | ") for line in capsys.readouterr().out.splitlines()]
    assert [line[1] for line in lines[2:]] == ["orb-200"] * 3 + ["rootsift-100"] * 3
    assert [line[2] for line in lines[2:]] == ["1", "1", "2"] * 2
    assert all(len(line) == len(photographs.HEADER) for line in lines[2:])


@pytest.mark.parametrize("text", ["rootsift-4000", "orb-20:model=fast", "sift-7:effort=full,rows=second"])
def test_a_setting_is_written_as_it_is_read(text: str) -> None:
    assert str(setting(text)) == text


def test_options_of_a_setting_are_those_of_the_filter(model_file: Path) -> None:
    chosen = setting("sift-7:effort=full,method=magsac")
    assert (chosen.detector, chosen.max_keypoints) == ("sift", 7)
    plain, full = (one.match_filter(str(model_file), 3) for one in (setting("sift-7"), chosen))
    assert (plain.options.effort, plain.options.method, plain.options.seed) == ("auto", "auto", 3)
    assert (full.options.effort, full.options.method, full.options.seed) == ("full", "magsac", 3)
    default, fast = (setting(f"sift-7:model={name}").match_filter(None, 0) for name in ("default", "fast"))
    assert default.metadata != fast.metadata


def test_rows_that_a_setting_adds_are_read_as_they_are_meant() -> None:
    one, two = (np.random.default_rng(seed).random((40, 8), dtype=np.float32) for seed in (0, 1))
    plain, second, backward = (
        setting(f"sift-40{rows}").match(one, two, cv2.NORM_L2) for rows in ("", ":rows=second", ":rows=backward")
    )
    back = match_descriptors(two, one)
    known = read_matches(plain, 40, 40)
    ratio = np.asarray(known.ratio)
    for longer in (second, backward):
        read = read_matches(longer, 40, 40)
        assert 40 < len(read) <= 80
        np.testing.assert_array_equal(read.index2[:40], known.index2)
        pairs = np.column_stack([read.index1, read.index2])
        assert len(np.unique(pairs, axis=0)) == len(pairs)
    read = read_matches(second, 40, 40)
    np.testing.assert_array_equal(read.index1[40:], np.flatnonzero(ratio >= 0.8))
    np.testing.assert_array_equal(read.index2[40:], [plain[i][1].trainIdx for i in read.index1[40:]])
    np.testing.assert_allclose(np.asarray(read.ratio)[40:], 0.94, rtol=1e-5)
    read = read_matches(backward, 40, 40)
    assert all(back[j][0].trainIdx == i for i, j in zip(read.index1[40:], read.index2[40:]))
    mutual = sum(back[row[0].trainIdx][0].trainIdx == row[0].queryIdx for row in plain)
    assert len(read) == 80 - mutual
    nearest, next_best = (back[read.index2[-1]][rank].distance for rank in (0, 1))
    assert np.asarray(read.ratio)[-1] == pytest.approx(nearest / next_best)


def test_smaller_photographs_keep_their_geometry(folder: Path, model_file: Path) -> None:
    pairs = read_scene(folder, 1, seed=0)
    whole, half = (
        run_setting(pairs, setting("sift-4000"), MatchFilter(model=model_file), share) for share in (1.0, 0.5)
    )
    assert 8 < half[0].matches < whole[0].matches
    pixel = np.array([321.0, 100.0])
    rays = [np.linalg.inv(each) @ [*at, 1.0] for each, at in ((K, pixel), (scaled(K, 0.5), pixel / 2 - 0.25))]
    np.testing.assert_allclose(*rays)
    assert photographs.main([str(folder), "--shrink", "1.5"]) == 2


@pytest.mark.parametrize(
    "text", ["sift", "surf-2000", "sift-0", "sift-many", "sift-20:seed=3", "sift-20:effort", "sift-20:rows=third"]
)
def test_a_setting_that_is_none_is_refused(text: str, capsys) -> None:
    with pytest.raises(SystemExit):
        photographs.main([".", "--settings", text])
    assert "DETECTOR-COUNT" in capsys.readouterr().err


def test_a_scene_whose_files_do_not_fit_is_named(folder: Path) -> None:
    (folder / "pairs.csv").write_text("image1,image2\na.png,z.png\n")
    with pytest.raises(DatasetError, match="do not fit: 'z.png'"):
        read_scene(folder, None, seed=0)
    assert photographs.main([str(folder / "absent")]) == 2


SCENES = [make_scene(seed=seed) for seed in range(3)]
NAMES = [("a.png", "b.png"), ("b.png", "a.png"), ("a.png", "c.png")]


@pytest.fixture
def bundles(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Path:
    """Two detectors' bundles of the scene, of a learned matcher and of nearest neighbours; the second lacks a pair."""
    at = tmp_path_factory.mktemp("bundles")
    everything = {"image_name": np.array([f"left/{name}" for names in NAMES for name in names])}
    learned = {**learned_fields(SCENES), **everything}
    write_bundle(at / f"{folder.name}.learned.npz", SCENES, **learned)
    mutual = np.packbits(np.arange(400) % 4 > 0)
    names = everything["image_name"][:4]
    write_bundle(at / f"{folder.name}.orb2k.npz", SCENES[:2], image_name=names, match_mutual=mutual)
    return at


def test_given_matches_are_judged_by_the_cameras_of_the_scene(bundles: Path) -> None:
    scene = SCENES[0]
    origin = Camera(K, np.zeros(4), np.eye(3), np.zeros(3))
    turned = cv2.Rodrigues(np.radians([0.0, 12.0, 0.0]))[0]
    product = parse_method("NN + PROSAC 0.5 px")
    found = [FoundMatches.of(one) for one in open_detector_scenes([bundles], ["learned", "orb2k"])]
    assert [one.name for one in found] == ["learned", "orb2k, cross-check"]
    assert [set(one.pairs) for one in found] == [set(NAMES), set(NAMES[:2])]
    for one, count in zip(found, (100, 150)):
        for R, expected in ((scene.R, 0.0), (turned @ scene.R, 12.0)):
            paths = (Path("a.png"), Path("b.png"))
            pair = PhotoPair("scene", paths, (origin, Camera(K, np.zeros(4), R, scene.t)))
            (answer,) = one.run([pair], product, seed=0)
            assert answer.error_deg == pytest.approx(expected, abs=1.0)
            assert answer.matches == count
            assert np.isnan(answer.milliseconds[:2]).all()
            assert answer.milliseconds[2] > 0


def test_rows_of_given_matches_stand_first_and_all_are_of_the_same_pairs(
    folder: Path, bundles: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("poselib")
    words = [str(folder), "--settings", "orb-200", "--model", str(model_file), "--bundles", str(bundles)]
    assert photographs.main([*words, "--detectors", "orb2k", "learned"]) == 0
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    methods = ("PoseLib 0.75 px", "PoseLib progressive 0.75 px", "filter")
    given = [f"{name} + {method}" for name in ("orb2k, cross-check", "learned") for method in methods]
    assert [line[1] for line in table[::2]] == [*given, "orb-200"]
    assert {line[2] for line in table} == {"1"}  # the scene has a to b and a to c, one bundle a to c and one not
    assert table[0][-1].startswith("– + – + ")
    assert photographs.main([*words, "--detectors", "learned"]) == 0
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert {line[2] for line in table} == {"2"}


def test_rendered_worlds_are_a_scene(folder: Path, model_file: Path, tmp_path: Path, capsys) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    texture = np.random.default_rng(5).integers(0, 256, (150, 200, 3), dtype=np.uint8)
    cv2.imwrite(str(photos / "texture.png"), cv2.resize(texture, (1200, 900), interpolation=cv2.INTER_CUBIC))
    words = ["--rendered", str(photos), "--pairs", "2", "--model", str(model_file), "--settings", "sift-800"]
    assert photographs.main(words) == 0
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [(line[0], line[2]) for line in table] == [("rendered", "2")]
    assert float(table[0][4]) > 0  # the cameras are those of the views
    for unusable in ([], ["--rendered", str(photos), "--bundles", str(folder)]):
        with pytest.raises(SystemExit):
            photographs.main(unusable)


def test_a_bundle_that_is_not_there_is_named(folder: Path, bundles: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bundles / "hall.orb2k.npz").write_bytes((bundles / f"{folder.name}.orb2k.npz").read_bytes())
    (bundles / f"{folder.name}.orb2k.npz").unlink()
    assert photographs.main([str(folder), "--bundles", str(bundles), "--detectors", "orb2k"]) == 2
    assert photographs.main([str(folder), "--bundles", str(bundles), "--detectors", "learned", "orb2k"]) == 2
    assert "orb2k" in capsys.readouterr().err


def test_scenes_stand_alone_by_place_and_together(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = [("hall", [0]), ("yard", [1]), ("attic", [2])]
    apart = [("outdoors", [1]), ("indoors", [0, 2])]
    assert places(["hall", "yard", "attic"], ["attic", "hall"]) == [*alone, *apart, ("all", [0, 1, 2])]
    worlds = places(["hall", "yard", "attic", "rendered"], ["attic", "hall"])
    assert worlds == [*alone, ("rendered", [3]), *apart, ("all", [0, 1, 2])]
    assert places(["hall", "attic"], ["attic", "hall"]) == [("hall", [0]), ("attic", [1]), ("all", [0, 1])]
    assert photographs.main([str(folder), "--indoors", "cellar"]) == 2
    assert "no scene cellar" in capsys.readouterr().err
