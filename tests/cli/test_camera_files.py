"""Cameras on the command line: every file that holds K gives the same camera, and what is wrong with one is told."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from mgca_filter.cli.cameras import camera, camera_as_shown, distortion, match_name, rotation_of_quaternion
from mgca_filter.geometry.cameras import Fisheye

K = np.array([[820.0, 0, 511.5], [0, 810, 383.5], [0, 0, 1]])
D = np.array([0.1, -0.2, 0.001, 0.002, 0.03])
NUMBERS = "820 0 511.5\n0 810 383.5\n0 0 1\n"


def opencv_file(path: Path, **values: object) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def ros_file(path: Path, model: str = "plumb_bob", coefficients: str = "0.1, -0.2, 0.001, 0.002, 0.03") -> Path:
    count = coefficients.count(",") + 1
    path.write_text(
        "image_width: 1024\nimage_height: 768\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [820.0, 0.0, 511.5, 0.0, 810.0, 383.5, 0.0, 0.0, 1.0]\n"
        f"distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: {count}\n  data: [{coefficients}]\n"
    )
    return path


@pytest.mark.parametrize(
    "content",
    [
        NUMBERS,
        NUMBERS.replace("\n", "\r\n"),
        "\ufeff" + NUMBERS,
        "# K of the left camera\n" + NUMBERS,
        "[[820, 0, 511.5],\n [0, 810, 383.5],\n [0, 0, 1]]",
        "8.2e+02,0,511.5,0,810,383.5,0,0,1",
        "820 810 511.5 383.5",
        "820 0 511.5 0\n0 810 383.5 0\n0 0 1 0\n0 0 0 1",
        "P0: 820 0 511.5 0 0 810 383.5 0 0 0 1 0",
        "# Camera list with one line of data per camera:\n\n7 PINHOLE 1024 768 820 810 512 384\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_text_files_of_any_kind_are_one_camera(tmp_path: Path, content: str, encoding: str) -> None:
    path = tmp_path / "intrinsics of mine.txt"
    path.write_bytes(content.encode(encoding))
    np.testing.assert_allclose(camera(str(path)).only().K, K)
    assert camera(str(path)).only().distortion is None


def test_numbers_are_a_camera() -> None:
    np.testing.assert_array_equal(camera("820,810,511.5,383.5").only().K, K)


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml", ".json"])
@pytest.mark.parametrize(
    ("matrix", "lens"), [("camera_matrix", "distortion_coefficients"), ("K", "D"), ("mtx", "dist")]
)
def test_files_of_opencv(tmp_path: Path, suffix: str, matrix: str, lens: str) -> None:
    values = {"image_width": 1024, "image_height": 768, matrix: K, lens: D[None]}
    one = camera(str(opencv_file(tmp_path / f"calibration{suffix}", **values))).only()
    np.testing.assert_array_equal(one.K, K)
    np.testing.assert_array_equal(one.distortion, D)
    assert one.size == (1024, 768)


def test_files_of_ros_and_numpy(tmp_path: Path) -> None:
    one = camera(str(ros_file(tmp_path / "left.yaml"))).only()
    np.testing.assert_array_equal(one.K, K)
    np.testing.assert_array_equal(one.distortion, D)
    lens = camera(str(ros_file(tmp_path / "fish.yaml", "equidistant", "0.1, 0.2, 0.3, 0.4"))).only().distortion
    assert lens == Fisheye(0.1, 0.2, 0.3, 0.4)
    np.savez(tmp_path / "B.npz", mtx=K, dist=D, rvecs=np.array([{}], dtype=object))
    np.testing.assert_array_equal(camera(str(tmp_path / "B.npz")).only().distortion, D)
    np.save(tmp_path / "K.npy", K)
    np.testing.assert_array_equal(camera(str(tmp_path / "K.npy")).only().K, K)


@pytest.mark.parametrize(
    ("line", "lens"),
    [
        ("SIMPLE_PINHOLE 1024 768 820 512 384", None),
        ("SIMPLE_RADIAL 1024 768 820 512 384 0.1", [0.1, 0, 0, 0]),
        ("RADIAL 1024 768 820 512 384 0.1 0.2", [0.1, 0.2, 0, 0]),
        ("OPENCV 1024 768 820 820 512 384 1 2 3 4", [1, 2, 3, 4]),
        ("FULL_OPENCV 1024 768 820 820 512 384 1 2 3 4 5 6 7 8", [1, 2, 3, 4, 5, 6, 7, 8]),
        ("OPENCV_FISHEYE 1024 768 820 820 512 384 1 2 3 4", Fisheye(1, 2, 3, 4)),
        ("SIMPLE_RADIAL_FISHEYE 1024 768 820 512 384 1", Fisheye(1)),
        ("RADIAL_FISHEYE 1024 768 820 512 384 1 2", Fisheye(1, 2)),
    ],
)
def test_models_of_colmap_project_as_colmap_does(tmp_path: Path, line: str, lens: object) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
    one = camera(str(tmp_path / "cameras.txt")).only()
    np.testing.assert_allclose(one.K, [[820, 0, 511.5], [0, 820, 383.5], [0, 0, 1]])
    assert one.size == (1024, 768)
    if isinstance(lens, list):
        np.testing.assert_array_equal(one.distortion, lens)
    else:
        assert one.distortion == lens
    pycolmap = pytest.importorskip("pycolmap")
    words = line.split()
    width, height, *parameters = (float(word) for word in words[1:])
    colmaps = pycolmap.Camera(model=words[0], width=int(width), height=int(height), params=parameters)
    X = np.array([[0.02, -0.03, 1.0]])
    shapes = (X, np.zeros(3), np.zeros(3), one.K)
    if isinstance(one.distortion, Fisheye):
        seen = cv2.fisheye.projectPoints(X[:, None], *shapes[1:], np.array(list(vars(one.distortion).values())))[0]
    else:
        seen = cv2.projectPoints(*shapes, one.distortion)[0]
    np.testing.assert_allclose(np.ravel(seen) + 0.5, np.ravel(colmaps.img_from_cam(X)), atol=1e-4)


def test_one_of_several_cameras_is_named_or_found_by_the_image(tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 1024 768 820 810 512 384\n")
    np.testing.assert_allclose(camera(f"{cameras}:2").only().K, K)
    with pytest.raises(ValueError, match=r"holds 2 cameras; .*cameras\.txt:NAME says which of 1, 2"):
        camera(str(cameras)).of(Path("a/two.jpg"))
    (tmp_path / "images.txt").write_text("9 1 0 0 0 0 0 0 1 one.jpg\n\n8 1 0 0 0 0 0 0 2 a/two.jpg\n1 2 -1\n")
    for text in (str(cameras), str(tmp_path)):
        np.testing.assert_allclose(camera(text).of(Path("photos/a/two.jpg")).K, K)
        assert camera(text).of(Path("one.jpg")).K[0, 0] == 500
    stereo = opencv_file(tmp_path / "stereo.yml", M1=np.diag([500.0, 500, 1]), D1=D[None], M2=K, D2=2 * D[None])
    np.testing.assert_array_equal(camera(f"{stereo}:M2").only().distortion, 2 * D)
    with pytest.raises(argparse.ArgumentTypeError, match="no camera 7, but 1, 2"):
        camera(f"{cameras}:7")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("K.txt", b"", "the file is empty"),
        ("K.txt", b"1 2 3", "expected K as 9 numbers"),
        ("K.txt", b"820 0 511.5 0 810 383.5 0 0 2", "expected [[fx, s, cx]"),
        ("K.txt", b"-820 810 511.5 383.5", "positive focal lengths"),
        ("K.txt", b"nan 810 511.5 383.5", "positive focal lengths"),
        ("K.txt", b"left camera", "expected numbers"),
        ("cameras.bin", b"\x01\0\0\0\xff\xfe\0\0", "model_converter"),
        ("cameras.txt", b"1 PINHOLE 640 480 500 500 320", "PINHOLE has 4 parameters, got 3"),
        ("cameras.txt", b"1 FOV 640 480 500 500 320 240 1", "camera model FOV is not known here"),
        ("cameras.txt", b"1 PINHOLE 640", "line 1: expected CAMERA_ID MODEL"),
        ("c.yml", b"%YAML:1.0\n---\nx: 1\n", "no camera matrix in it"),
        ("c.yml", b"%YAML:1.0\n---\nK: [1, 2\n", "cannot be read as OpenCV's YAML"),
        ("c.xml", b"<?xml version='1.0'?><opencv_storage><K", "cannot be read as OpenCV's YAML"),
        ("c.json", b"[]", "c.json"),
        ("c.npz", b"PK\x03\x04", "c.npz"),
        ("c.npy", b"no array", "c.npy"),
    ],
)
def test_what_is_no_camera_is_told_with_its_file(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(argparse.ArgumentTypeError) as told:
        camera(str(tmp_path / name))
    assert name in str(told.value)
    assert words in str(told.value)


def test_files_that_are_not_there() -> None:
    for text in ("none.txt", "no/such/cameras.txt:1", "none.yml"):
        with pytest.raises(argparse.ArgumentTypeError, match="no such file, and not fx,fy,cx,cy"):
            camera(text)


def test_lens_distortion_as_numbers_or_file(tmp_path: Path) -> None:
    np.testing.assert_array_equal(distortion("0.1,-0.2,0.001,0.002,0.03"), D)
    assert distortion("fisheye:0.1,0.2,0.3,0.4") == Fisheye(0.1, 0.2, 0.3, 0.4)
    assert distortion("0,0,0,0") is None
    (tmp_path / "dist.txt").write_text("0.1 -0.2\n0.001 0.002 0.03\n")
    for path in (tmp_path / "dist.txt", opencv_file(tmp_path / "c.yml", K=K, D=D[None])):
        np.testing.assert_array_equal(distortion(str(path)), D)
    for text, words in (
        ("0.1,0.2", "expected 4, 5"),
        ("none.txt", "or a file: none.txt"),
        ("fisheye:1,2,3,4,5", "fisheye"),
    ):
        with pytest.raises(argparse.ArgumentTypeError, match=words):
            distortion(text)


def test_a_camera_of_images_of_another_size_is_refused_with_the_one_that_fits(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 2048 1536 1640 1620 1024 768\n")
    one = camera(str(tmp_path / "cameras.txt")).only()
    with pytest.raises(ValueError, match=r"2048 x 1536 pixels, left.jpg has 1024 x 768; .*K is 820,810,511.5,383.5"):
        camera_as_shown(one, Path("left.jpg"), (1024, 768), 1)
    with pytest.raises(ValueError, match="has 1000 x 768$"):
        camera_as_shown(one, Path("left.jpg"), (1000, 768), 1)
    assert camera_as_shown(one, Path("left.jpg"), (2048, 1536), 1) is one


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_the_lens_turns_with_the_photo(tmp_path: Path, orientation: int) -> None:
    """A point that the stored camera sees at a pixel is seen by the turned one where the pixel is shown."""
    from mgca_filter.geometry.orientation import shown_camera, shown_pixels

    path = opencv_file(tmp_path / "c.yml", image_width=1024, image_height=768, K=K, D=D[None])
    one = camera(str(path)).only()
    turned = camera_as_shown(one, Path("x"), (768, 1024), orientation)
    X = np.array([[0.3, -0.2, 1.0], [-0.1, 0.25, 1.0]])
    nowhere = np.zeros(3)
    stored = cv2.projectPoints(X, nowhere, nowhere, one.K, one.distortion)[0][:, 0]
    shown = cv2.projectPoints(X @ shown_camera(orientation).T, nowhere, nowhere, turned.K, turned.distortion)[0][:, 0]
    T = shown_pixels(orientation, (1024, 768))
    np.testing.assert_allclose(shown, stored @ T[:2, :2].T + T[:2, 2], atol=1e-9)


def test_names_of_images() -> None:
    names = ["a/x.jpg", "x.jpg", "b\\y.jpg", "c/z.jpg", "d/z.jpg"]
    assert match_name(Path("photos/a/x.jpg"), names) == "a/x.jpg"
    assert match_name(Path("photos/x.jpg"), names) == "x.jpg"
    assert match_name(Path("elsewhere/y.jpg"), names) == "b\\y.jpg"
    assert match_name(Path("elsewhere/z.jpg"), names) is None
    assert match_name(Path("xx.jpg"), names) is None


def test_quaternions_are_rotations() -> None:
    rotation = rotation_of_quaternion(np.array([np.cos(0.3), 0, 0, np.sin(0.3)]) * 5)
    np.testing.assert_allclose(rotation, cv2.Rodrigues(np.array([0, 0, 0.6]))[0], atol=1e-12)
    with pytest.raises(ValueError, match="length zero"):
        rotation_of_quaternion(np.zeros(4))


def test_a_document_of_the_command_s_own_is_no_camera(tmp_path: Path) -> None:
    (tmp_path / "out.json").write_text(json.dumps({"K1": K.tolist()}))
    np.testing.assert_array_equal(camera(str(tmp_path / "out.json")).only().K, K)
