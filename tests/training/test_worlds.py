"""Rendered worlds: one geometry for depth, picture and labels, and the same draw for the same seed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from photographs import write_photographs

from mgca_filter.data.scene_bundle import LABEL_FIELD, SceneBundle
from mgca_filter.geometry.epipolar import essential_from_pose, symmetric_epipolar_distance_squared
from mgca_filter.training.pairs import NEGATIVE, POSITIVE
from mgca_filter.training.render import main
from mgca_filter.training.worlds.cameras import Camera
from mgca_filter.training.worlds.imaging import add_passers_by
from mgca_filter.training.worlds.photographs import PhotoError, PhotoFolder
from mgca_filter.training.worlds.rendering import paint
from mgca_filter.training.worlds.truth import transfer_error, visible_share
from mgca_filter.training.worlds.view_pairs import ViewPair, match_views
from mgca_filter.training.worlds.views import draw_scene, draw_views
from mgca_filter.training.worlds.visibility import NOTHING, VisibilityMap, see
from mgca_filter.training.worlds.world import KINDS, World


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> PhotoFolder:
    return PhotoFolder.open(write_photographs(tmp_path_factory.mktemp("photos")))


@pytest.fixture(scope="module")
def pair(photos: PhotoFolder) -> ViewPair:
    return match_views(*draw_views(np.random.default_rng(2), photos, 2))


def scene_of_kind(kind: str) -> tuple[World, list[Camera]]:
    """The first world of a kind, and two cameras in it a sixth of the usual size."""
    for seed in range(40):
        world, cameras = draw_scene(np.random.default_rng([5, seed]), 2)
        if world.kind == kind:
            return world, [camera.shrunk(1 / 3) for camera in cameras]
    raise AssertionError(f"no {kind} in 40 worlds")


def nearest_face_by_rays(world: World, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face and depth at pixels (N, 2), by cutting each ray with each parallelogram."""
    face, depth = np.full(len(pixels), NOTHING), np.full(len(pixels), np.inf)
    for number, item in enumerate(world.faces):
        o, u, v = camera.R @ item.origin + camera.t, camera.R @ item.u, camera.R @ item.v
        for row, ray in enumerate(camera.rays(pixels)):
            a, b, negative = np.linalg.solve(np.column_stack([u, v, -ray]), -o)  # o + a u + b v = depth · ray
            if 0 <= a <= 1 and 0 <= b <= 1 and 0 < negative < depth[row]:
                face[row], depth[row] = number, negative
    return face, depth


@pytest.mark.parametrize("kind", KINDS)
def test_the_nearest_face_wins(kind):
    world, cameras = scene_of_kind(kind)
    visible = see(world, cameras[0])
    rng = np.random.default_rng(0)
    width, height = cameras[0].size
    pixels = np.column_stack([rng.integers(width, size=40), rng.integers(height, size=40)]).astype(float)
    face, depth = nearest_face_by_rays(world, cameras[0], pixels)
    x, y = pixels.astype(int).T
    agree = visible.face[y, x] == face
    assert agree.mean() >= 0.9  # pixels at borders may fall on either side
    np.testing.assert_allclose(1.0 / visible.inverse_depth[y, x][agree], depth[agree], rtol=1e-3)
    assert (visible.face != NOTHING).all()


def all_pixels(visible: VisibilityMap) -> np.ndarray:
    height, width = visible.face.shape
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(float)


def project_from_first(cameras: list[Camera], visible: VisibilityMap) -> tuple[np.ndarray, np.ndarray]:
    """All pixels of image 1, and where their points lie in image 2."""
    pixels = all_pixels(visible)
    X = (cameras[0].rays(pixels) / visible.inverse_depth.reshape(-1, 1) - cameras[0].t) @ cameras[0].R
    return pixels, cameras[1].project(X)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_both_pictures_show_the_same_surface(kind, photos):
    world, cameras = scene_of_kind(kind)
    maps = [see(world, camera) for camera in cameras]
    light = np.ones(len(world.faces))
    first, second = (paint(world, c, m, photos, cameras[0].K[0, 0], light) for c, m in zip(cameras, maps))
    pixels, moved = project_from_first(cameras, maps[0])
    seen = transfer_error(pixels, moved, *cameras, *maps) < 1e-3
    assert seen.mean() > 0.05
    u, v = moved.astype(np.float32).reshape(*first.shape, 2).transpose(2, 0, 1)
    there = cv2.remap(second, u, v, cv2.INTER_LINEAR).ravel()[seen].astype(float)
    here = first.ravel()[seen].astype(float)
    shuffled = np.random.default_rng(0).permutation(there)
    assert np.median(np.abs(there - here)) < 0.3 * np.median(np.abs(shuffled - here))


def test_light_changes_faces_and_nothing_else(photos):
    world, cameras = scene_of_kind("objects")
    visible = see(world, cameras[0])
    light = np.ones(len(world.faces))
    plain = paint(world, cameras[0], visible, photos, 500.0, light)
    chosen = int(np.bincount(visible.face.ravel()).argmax())
    light[chosen] = 0.5
    darker = paint(world, cameras[0], visible, photos, 500.0, light)
    changed = visible.face == chosen
    np.testing.assert_array_equal(darker[~changed], plain[~changed])
    np.testing.assert_allclose(darker[changed], 0.5 * plain[changed], atol=1.0)


def test_transfer_error_is_the_distance_in_pixels_and_infinite_where_hidden():
    world, cameras = scene_of_kind("objects")
    maps = [see(world, camera) for camera in cameras]
    pixels, moved = project_from_first(cameras, maps[0])
    exact = transfer_error(pixels, moved, *cameras, *maps)
    seen = exact < 1e-3  # the map keeps inverse depth in float32
    off = transfer_error(pixels[seen], moved[seen] + [0.3, 0.4], *cameras, *maps)
    assert off.max() < 0.5 + 1e-2  # a face nearby may fit better by chance
    assert np.median(off) == pytest.approx(0.5, abs=1e-4)
    width, height = cameras[1].size
    outside = ((moved < -1) | (moved > [width, height])).any(1)
    hidden = ~seen & ~outside
    assert hidden.any()
    assert np.isinf(np.median(exact[hidden]))  # beside an edge, the other face may lie there
    assert np.isclose(visible_share(*cameras, *maps), seen.mean(), atol=0.05)


def test_labels_agree_with_the_pose(pair):
    distance = symmetric_epipolar_distance_squared(pair.correspondences, essential_from_pose(pair.R, pair.t))
    right = pair.labels == POSITIVE
    assert pair.usable
    assert distance[right].max() < 1.5e-5
    assert ((pair.labels == NEGATIVE) & (distance < 1e-5)).any()  # accidents near the line are told by depth
    assert (
        pair.matches.attributes.ratio[right].mean()
        < pair.matches.attributes.ratio[pair.labels == NEGATIVE].mean() - 0.1
    )


def test_passers_by_hide_what_is_behind_them(photos):
    world, cameras = scene_of_kind("facade")
    visible = see(world, cameras[0])
    image = paint(world, cameras[0], visible, photos, 500.0, np.ones(len(world.faces)))
    before = image.copy()
    for seed in range(20):
        add_passers_by(np.random.default_rng(seed), image, visible, photos)
    hidden = visible.face == NOTHING
    assert 0.01 < hidden.mean() < 1.0
    np.testing.assert_array_equal(image[~hidden], before[~hidden])
    points = all_pixels(visible)[hidden.ravel()]
    assert np.isinf(transfer_error(points, points, cameras[0], cameras[0], visible, visible)).mean() > 0.8


def test_views_follow_from_the_seed(photos):
    one, same, other = (draw_views(np.random.default_rng(seed), photos, 1)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(one.image, same.image)
    np.testing.assert_array_equal(one.features.points, same.features.points)
    assert one.image.shape != other.image.shape or (one.image != other.image).any()


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as data:
        return dict(data)


@pytest.mark.slow
def test_the_command_writes_a_bundle_that_workers_do_not_change(photos, tmp_path):
    command = [str(photos.folder), str(tmp_path / "out.npz"), "--pairs", "2", "--views", "2", "--seed", "1"]
    assert main([*command, "--workers", "0"]) == 0
    alone = load(tmp_path / "out.npz")
    assert main([*command, "--workers", "2"]) == 0
    together = load(tmp_path / "out.npz")
    assert list(alone) == list(together)
    for name, values in alone.items():
        np.testing.assert_array_equal(together[name], values, err_msg=name)
    bundle = SceneBundle(tmp_path / "out.npz")
    assert len(bundle) == 2
    assert len(alone[LABEL_FIELD]) == bundle.match_counts().sum()
    for index in range(2):
        labels = alone[LABEL_FIELD][slice(*alone["match_offset"][index : index + 2])]
        right = bundle[index].correspondences[labels == POSITIVE]
        assert len(right) >= 20
        assert symmetric_epipolar_distance_squared(right, bundle[index].E).max() < 1.6e-5
    assert main([*command[:-1], "7", "--workers", "0", "--pairs", "1"]) == 0
    other = load(tmp_path / "out.npz")
    assert (other["K"] != alone["K"][:2]).all(axis=0).any()


def test_photographs_that_cannot_be_used_are_named(tmp_path, capsys):
    with pytest.raises(PhotoError, match=str(tmp_path)):
        PhotoFolder.open(tmp_path)
    assert main([str(tmp_path), str(tmp_path / "out.npz"), "--workers", "0"]) == 2
    assert "no photograph" in capsys.readouterr().err
    (tmp_path / "broken.jpg").write_bytes(b"torn")
    assert main([str(tmp_path), str(tmp_path / "out.npz"), "--pairs", "1", "--workers", "0"]) == 2
    assert "broken.jpg" in capsys.readouterr().err
