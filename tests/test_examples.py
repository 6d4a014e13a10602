"""Every example runs as a user would run it, and the rendered pair is geometrically exact."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import essential_from_pose, sampson_distance

EXAMPLES = Path(__file__).parent.parent / "examples"


def run_example(name: str, *arguments: str) -> str:
    """Output of an example run in a process of its own."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def scene():
    """The module examples/render_pair.py."""
    spec = importlib.util.spec_from_file_location("render_pair", EXAMPLES / "render_pair.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["render_pair"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["render_pair"]


@pytest.fixture(scope="module")
def pair() -> dict:
    return json.loads((EXAMPLES / "images" / "pair.json").read_text())


@pytest.mark.slow  # ten seconds of rays
def test_render_pair_gives_the_committed_images_again(tmp_path, pair):
    run_example("render_pair.py", "--out", str(tmp_path), "--supersampling", "3")
    again = json.loads((tmp_path / "pair.json").read_text())
    for name in ("K1", "K2", "R", "t"):
        np.testing.assert_allclose(again[name], pair[name], atol=1e-12)
    lists = [(folder / "courtyard.txt").read_text().split() for folder in (tmp_path, EXAMPLES / "images")]
    assert lists[0][:4] == lists[1][:4]
    np.testing.assert_allclose(*(np.array(words[4:], dtype=float) for words in lists), atol=1e-12)
    for name in ("left.jpg", "right.jpg"):
        rendered, committed = (cv2.imread(str(folder / name)) for folder in (tmp_path, EXAMPLES / "images"))
        assert np.abs(rendered.astype(float) - committed).mean() < 1.0  # JPEG codecs differ a little


def test_pair_json_holds_the_pose_of_the_cameras(scene, pair):
    camera1, camera2 = scene.cameras()
    points = np.random.default_rng(0).uniform((-3, -2, 5), (3, 1, 9), (50, 3))
    p1, p2 = camera1.project(points), camera2.project(points)
    x = np.hstack([normalize_points(p1, pair["K1"]), normalize_points(p2, pair["K2"])])
    assert sampson_distance(x, essential_from_pose(pair["R"], pair["t"])).max() < 1e-12


def test_rendered_points_lie_where_they_project(scene):
    """A white dot painted on a face is found at the projection of its world point, in both views."""
    texture = np.zeros((256, 256, 3), np.uint8)
    cv2.circle(texture, (160, 96), 3, (255, 255, 255), cv2.FILLED, cv2.LINE_AA)
    face = scene.wall((-2.0, 8.0), (2.5, 7.0), -2.0, 1.0, texture)
    centre = face.point(np.array([160.5 / 256]), np.array([96.5 / 256]))
    # The sky is bright, hence a black wall behind.
    behind = scene.wall((-40, 20), (40, 20), -40, 40, np.zeros((2, 2, 3), np.uint8))
    for camera in scene.cameras():
        image = scene.render([behind, face], camera, supersampling=2)[:, :, 0].astype(float)
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        found = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
        assert np.abs(found - camera.project(centre)[0]).max() < 0.05


def test_nearest_face_wins(scene):
    near = scene.wall((-1, 4), (1, 4), -1, 1, np.zeros((2, 2, 3), np.uint8))
    far = scene.wall((-3, 8), (3, 8), -3, 3, np.zeros((2, 2, 3), np.uint8))
    camera = scene.look_at((0, 0, 0), (0, 0, 1), 0.0, 500.0, (640, 480))
    x, y = np.array([319.5, 500.0, 0.0]), np.array([239.5, 239.5, 0.0])
    for faces, expected in (([near, far], [0, 1, -1]), ([far, near], [1, 0, -1])):
        assert scene.visible_surface(faces, camera, x, y)[0].tolist() == expected


@pytest.mark.slow
def test_the_pair_is_hard(scene):
    """Between 8 and 20 % of the raw matches join images of the same surface point."""
    images = [cv2.imread(str(EXAMPLES / "images" / name), cv2.IMREAD_GRAYSCALE) for name in ("left.jpg", "right.jpg")]
    sift = cv2.SIFT_create(nfeatures=2000, contrastThreshold=1e-5)
    (kp1, descriptors1), (kp2, descriptors2) = (sift.detectAndCompute(image, None) for image in images)
    matches = cv2.BFMatcher().match(descriptors1, descriptors2)
    points1 = np.array([kp1[match.queryIdx].pt for match in matches])
    points2 = np.array([kp2[match.trainIdx].pt for match in matches])
    faces, (camera1, camera2) = scene.courtyard(), scene.cameras()
    nearest, u, v = scene.visible_surface(faces, camera1, points1[:, 0], points1[:, 1])
    right = np.zeros(len(matches), bool)
    for index in np.unique(nearest[nearest >= 0]):
        hit = nearest == index
        projected = camera2.project(faces[index].point(u[hit], v[hit]))
        right[hit] = np.linalg.norm(projected - points2[hit], axis=1) < 3.0
    assert 0.08 <= right.mean() <= 0.20


def test_replacing_find_essential_mat_finds_the_pose():
    lines = run_example("replace_find_essential_mat.py").splitlines()
    assert [line.split()[0] for line in lines] == ["cv2.findEssentialMat", "mgca_filter"]
    error = re.search(r"pose error +([\d.]+) deg", lines[1])
    assert error is not None, lines
    assert float(error.group(1)) < 2.0


@pytest.mark.slow
def test_before_after_draws_a_picture(tmp_path):
    path = tmp_path / "new folder" / "picture.png"
    told = run_example("before_after.py", "--out", str(path)).splitlines()
    assert "true pose: rotation 37.3 deg" in told[0]
    right, wrong = ([int(line.split(f" {word}")[0].split()[-1]) for line in told[1:]] for word in ("right", "wrong"))
    assert right[1] > 2 * right[0]
    assert wrong[1] < wrong[0]
    picture = cv2.imread(str(path))
    assert picture.shape[1] >= 1000
    assert picture.shape[0] > picture.shape[1] * 0.6
