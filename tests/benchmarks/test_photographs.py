"""The study from photographs to poses, on a turning camera whose pose is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from benchmarks import photographs
from benchmarks.photographs import Setting, read_scene, run_setting
from mgca_filter import MatchFilter, match_images
from mgca_filter.errors import DatasetError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene of two pairs: a picture of a texture, and two of the camera turned to the same side."""
    scene = make_scene("rotation")
    noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    first = cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC)
    second = cv2.warpPerspective(first, K @ scene.R @ np.linalg.inv(K), SIZE)
    lines = ["image,width,height,fx,fy,cx,cy,k1," + ",".join(f"r{i}{j}" for i in "123" for j in "123") + ",tx,ty,tz"]
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


@pytest.mark.parametrize("text", ["sift", "surf-2000", "sift-0", "sift-many"])
def test_a_setting_that_is_none_is_refused(text: str, capsys) -> None:
    with pytest.raises(SystemExit):
        photographs.main([".", "--settings", text])
    assert "DETECTOR-COUNT" in capsys.readouterr().err


def test_a_scene_whose_files_do_not_fit_is_named(folder: Path) -> None:
    (folder / "pairs.csv").write_text("image1,image2\na.png,z.png\n")
    with pytest.raises(DatasetError, match="do not fit: 'z.png'"):
        read_scene(folder, None, seed=0)
    assert photographs.main([str(folder / "absent")]) == 2
