"""The true pose from every file that holds it, and how far off an answer is."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from mgca_filter.cli.truth import TruePose, read_truth
from mgca_filter.geometry.orientation import shown_camera

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "examples" / "images"
PAIR = (IMAGES / "left.jpg", IMAGES / "right.jpg")
TRUTH = json.loads((IMAGES / "pair.json").read_text())
R, t = np.array(TRUTH["R"]), np.array(TRUTH["t"])
UPRIGHT = (1, 1)


def quaternion(rotation: np.ndarray) -> str:
    vector = cv2.Rodrigues(rotation)[0].ravel()
    angle = np.linalg.norm(vector)
    axis = vector / max(angle, 1e-12)
    return " ".join(f"{value:.15g}" for value in (np.cos(angle / 2), *(np.sin(angle / 2) * axis)))


def colmap_files(folder: Path) -> Path:
    """Poses of both images, the first anywhere in the world."""
    R1, t1 = cv2.Rodrigues(np.array([0.2, -0.4, 0.1]))[0], np.array([1.0, 2, 3])
    R2, t2 = R @ R1, R @ t1 + t
    lines = ["# Image list", ""]
    for number, (name, rotation, shift) in enumerate((("left.jpg", R1, t1), ("right.jpg", R2, t2)), 1):
        lines += [f"{number} {quaternion(rotation)} {shift[0]} {shift[1]} {shift[2]} 1 {name}", "10 20 -1"]
    (folder / "images.txt").write_text("\n".join(lines[:1] + lines[2:]) + "\n")
    return folder


def same(truth: TruePose) -> None:
    np.testing.assert_allclose(truth.R, R, atol=1e-9)
    np.testing.assert_allclose(truth.t / np.linalg.norm(truth.t), t / np.linalg.norm(t), atol=1e-9)


def test_every_file_gives_the_same_pose(tmp_path: Path) -> None:
    (tmp_path / "pose.txt").write_text(
        "\n".join(" ".join(map(repr, (*row, s))) for row, s in zip(R.tolist(), t.tolist()))
    )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    np.savetxt(tmp_path / "matrix.txt", matrix)
    folder = colmap_files(tmp_path)
    for path in ("pose.txt", "matrix.txt", "images.txt"):
        same(read_truth(tmp_path / path, PAIR, UPRIGHT))
    for path in (folder, IMAGES / "pair.json", IMAGES / "courtyard.txt"):
        same(read_truth(path, PAIR, UPRIGHT))


@pytest.mark.parametrize("name", ["images.txt", "courtyard.txt"])
def test_the_pair_may_be_given_the_other_way_round(tmp_path: Path, name: str) -> None:
    path = (colmap_files(tmp_path) if name == "images.txt" else IMAGES) / name
    truth = read_truth(path, PAIR[::-1], UPRIGHT)
    np.testing.assert_allclose(truth.R, R.T, atol=1e-9)
    np.testing.assert_allclose(truth.t, -R.T @ t, atol=1e-9)


def test_poses_of_files_as_they_are_stored_turn_with_the_photos(tmp_path: Path) -> None:
    S = shown_camera(6)
    truth = read_truth(colmap_files(tmp_path), PAIR, (1, 6))
    np.testing.assert_allclose(truth.R, S @ R, atol=1e-9)
    np.testing.assert_allclose(truth.t, S @ t, atol=1e-9)
    same(read_truth(IMAGES / "pair.json", PAIR, (1, 6)))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.json", '{"R": 1}', '"R" (3 x 3) and "t" (3)'),
        ("a.json", '{"R": [[1,0,0],[0,1,0],[0,0,2]], "t": [1,0,0]}', "R is no rotation"),
        ("a.json", '{"R": [[1,0,0],[0,1,0],[0,0,1]], "t": [1,0]}', "expected R (3 x 3)"),
        ("a.json", '{"R": null, "t": null}', "expected R (3 x 3)"),
        ("a.json", "{", '"R" (3 x 3)'),
        ("a.txt", "1 2 3", "expected 12 or 16 numbers, [R | t] row by row, got 3"),
        ("a.txt", "", "the file is empty"),
        ("a.txt", "some words", "IMAGE_ID QW QX"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 left.jpg\n\n", "holds no pose of right.jpg"),
        ("images.txt", "1 0 0 0 0 0 0 0 1 left.jpg\n\n", "length zero"),
    ],
)
def test_what_is_no_pose_of_the_pair_is_told_with_its_file(tmp_path: Path, name: str, content: str, words: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=name) as told:
        read_truth(tmp_path / name, PAIR, UPRIGHT)
    assert words in str(told.value)


def test_a_list_without_the_pair(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text((IMAGES / "courtyard.txt").read_text().replace("left", "other"))
    with pytest.raises(ValueError, match=r"list\.txt: no line for left\.jpg and right\.jpg"):
        read_truth(tmp_path / "list.txt", PAIR, UPRIGHT)


def test_errors_are_angles() -> None:
    truth = TruePose(R, t)
    turn = cv2.Rodrigues(np.radians([0.0, 0, 7]))[0]
    rotation, direction = truth.errors_deg(turn @ R, 3 * t)
    np.testing.assert_allclose([rotation, direction], [7, 0], atol=1e-4)
    assert truth.errors_deg(None, None) == (None, None)
    assert TruePose(R, np.zeros(3)).errors_deg(R, t)[1] is None
