"""An image and what was made of it by hand: every such pair gets an honest status."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from mgca_filter import MatchFilter, Status, match_images, patch_cv2
from mgca_filter.fit.mirror import share_of_turned_triangles
from mgca_filter.geometry.epipolar import rotation_error_deg
from mgca_filter.verdict_text import describe_verdict

IMAGE = cv2.imread(str(Path(__file__).parents[1] / "examples" / "images" / "left.jpg"), cv2.IMREAD_GRAYSCALE)
FOCAL = 820.0
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
QUARTER_TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def camera(image: np.ndarray, focal: float = FOCAL) -> np.ndarray:
    height, width = image.shape
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


def magnified(image: np.ndarray, zoom: float = 1.5) -> np.ndarray:
    """The middle of the image, enlarged to its size: what a longer lens would have seen."""
    height, width = image.shape
    H = np.array([[zoom, 0.0, (1 - zoom) * (width - 1) / 2], [0.0, zoom, (1 - zoom) * (height - 1) / 2], [0, 0, 1.0]])
    return cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_CUBIC)


def answer(image: np.ndarray, K2: np.ndarray | None, **options: object):
    K1 = None if K2 is None else camera(IMAGE)
    return match_images(IMAGE, image, K1=K1, K2=K2, **{"max_keypoints": 1500, **options}).result


MIRRORS = {"mirrored": np.fliplr, "upside down in a mirror": np.flipud, "transposed": np.transpose}
TURNS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]] = {
    "itself": (lambda image: image, np.eye(3)),
    "half a turn": (lambda image: image[::-1, ::-1], HALF_TURN),
    "a quarter turn": (np.rot90, QUARTER_TURN),
}


@pytest.mark.parametrize("name", MIRRORS)
@pytest.mark.parametrize("known", [True, False], ids=["K", "no K"])
def test_a_mirrored_image_has_a_map_and_no_pose(name: str, known: bool) -> None:
    image = np.ascontiguousarray(MIRRORS[name](IMAGE))
    result = answer(image, camera(image) if known else None)
    assert result.status is Status.PLANAR
    assert result.info["mirrored"]
    assert all(value is None for value in (result.E, result.F, result.R, result.t, result.confidence))
    assert "one of the images is mirrored" in result.info["assumptions"][-1]
    assert np.linalg.det(result.H) < 0
    mapped = cv2.perspectiveTransform(result.points1[result.mask][None], result.H)[0]
    assert np.linalg.norm(mapped - result.points2[result.mask], axis=1).max() < 3.0
    assert result.num_inliers > 100


def test_a_homography_that_is_asked_for_may_mirror() -> None:
    result = answer(np.ascontiguousarray(np.fliplr(IMAGE)), None, geometry="homography")
    assert result.status is Status.OK
    corners = np.array([[[0.0, 0.0], [1000.0, 0.0], [1000.0, 700.0], [0.0, 700.0]]])
    mirrored = corners * np.array([-1.0, 1.0]) + np.array([IMAGE.shape[1] - 1.0, 0.0])
    assert np.abs(cv2.perspectiveTransform(corners, result.H) - mirrored).max() < 2.0


@pytest.mark.parametrize("name", TURNS)
@pytest.mark.parametrize("known", [True, False], ids=["K", "no K"])
def test_a_turned_image_is_a_camera_that_turned(name: str, known: bool) -> None:
    turn, R = TURNS[name]
    image = np.ascontiguousarray(turn(IMAGE))
    result = answer(image, camera(image) if known else None)
    assert result.status is Status.PURE_ROTATION
    assert result.t is None
    assert result.R is None or rotation_error_deg(result.R, R) < 0.2
    assert (result.R is not None) >= known
    assert "mirrored" not in result.info


def test_a_zoom_whose_focal_length_is_known_is_no_motion() -> None:
    image = magnified(IMAGE)
    result = answer(image, camera(image, 1.5 * FOCAL), max_keypoints=4000)
    assert result.status is Status.PURE_ROTATION
    assert rotation_error_deg(result.R, np.eye(3)) < 0.2


def test_a_zoom_of_which_nobody_knows_is_a_map() -> None:
    result = answer(magnified(IMAGE), None)
    assert result.status in (Status.PLANAR, Status.PURE_ROTATION, Status.LOW_SUPPORT)
    np.testing.assert_allclose(result.H[:2, :2], 1.5 * np.eye(2), atol=0.02)


@pytest.mark.parametrize("image", [np.full_like(IMAGE, 127), IMAGE[:40, :40]], ids=["flat", "scrap"])
def test_what_shows_nothing_has_no_pose(image: np.ndarray) -> None:
    result = answer(np.ascontiguousarray(image), camera(image))
    assert not result.ok
    assert result.t is None or result.status is Status.LOW_SUPPORT


@pytest.mark.parametrize("kind", ["general", "wide", "skew", "planar", "rotation"])
def test_no_scene_is_taken_for_a_mirror(match_filter: MatchFilter, kind: str) -> None:
    scene = make_scene(kind)
    assert share_of_turned_triangles(np.hstack([scene.points1, scene.points2])[scene.inlier]) < 0.3
    result = match_filter.filter(scene.points1, scene.points2, None, K1=K, attributes=scene.attributes)
    assert "mirrored" not in result.info


def test_a_mirrored_scene_with_depth_has_no_usable_pose(match_filter: MatchFilter) -> None:
    scene = make_scene("wide")
    flipped = replace(scene, points2=scene.points2 * np.array([-1.0, 1.0]) + np.array([SIZE[0] - 1.0, 0.0]))
    result = match_filter.filter(flipped.points1, flipped.points2, None, K1=K, attributes=scene.attributes)
    assert not result.ok
    assert result.info["mirrored"]
    assert result.t is None
    assert result.mask[scene.inlier].mean() > 0.9


def test_the_words_for_a_mirrored_image() -> None:
    assert "mirrored" in describe_verdict("planar", mirrored=True).advice
    assert "mirrored" not in describe_verdict("planar").advice


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("count", "noise_px"), [(300, 0.0), (300, 0.2), (12, 0.3), (8, 0.1), (5, 0.1)])
def test_a_script_goes_on_where_nothing_moved(count: int, noise_px: float, seed: int) -> None:
    """Odometry over frames of a standing camera: a matrix comes back, and ``recoverPose`` finds no turn in it."""
    rng = np.random.default_rng(seed)
    points1 = rng.uniform((0, 0), SIZE, (count, 2))
    points2 = points1 + rng.normal(0, noise_px, points1.shape) if noise_px else points1.copy()
    with patch_cv2():
        E, mask = cv2.findEssentialMat(points1, points2, K, cv2.RANSAC, 0.999, 1.0)
        assert E.shape == (3, 3)
        assert mask.shape == (count, 1)
        _, R, t, _ = cv2.recoverPose(E, points1, points2, K, mask=mask)
    assert rotation_error_deg(R, np.eye(3)) < 0.5
    assert np.linalg.norm(t) == pytest.approx(1.0)
