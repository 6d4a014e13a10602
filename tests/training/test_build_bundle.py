"""A bundle built from a reconstruction: its geometry is that of the images, half pixels and distortion included."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from photographs import write_photographs

from mgca_filter.data.scene_bundle import SceneBundle
from mgca_filter.geometry.epipolar import symmetric_epipolar_distance_squared
from mgca_filter.training.build_bundle import choose_pairs, main
from mgca_filter.training.sources import BundleSource
from mgca_filter.training.worlds.photographs import PhotoFolder
from mgca_filter.training.worlds.views import View, draw_views

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    """Three views of a rendered world, the first two of which overlap well."""
    photos = PhotoFolder.open(write_photographs(tmp_path_factory.mktemp("photos")))
    return draw_views(np.random.default_rng(2), photos, 3)


def write_reconstruction(folder: Path, views: list[View], radial: float = 0.0, points: int = 60) -> Path:
    """Images and COLMAP's text files; all images see the same points. A distorted image is a warp of the exact one."""
    (folder / "images").mkdir(parents=True)
    cameras, images = [], []
    for number, view in enumerate(views, 1):
        K, (width, height) = view.camera.K, view.camera.size
        coefficients = np.array([radial, 0, 0, 0])
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float32)
        sources = cv2.undistortPoints(pixels, K, coefficients, P=K).reshape(height, width, 2)
        cv2.imwrite(str(folder / "images" / f"{number}.png"), cv2.remap(view.image, sources, None, cv2.INTER_CUBIC))
        cameras.append(f"{number} SIMPLE_RADIAL {width} {height} {K[0, 0]} {K[0, 2] + 0.5} {K[1, 2] + 0.5} {radial}")
        q = pycolmap.Rotation3d(view.camera.R).quat  # x y z w
        pose = (q[3], q[0], q[1], q[2], *view.camera.t)
        images.append(f"{number} {' '.join(map(str, pose))} {number} {number}.png")
        images.append(" ".join(f"{10 + i} {10 + i} {i + 1}" for i in range(points)))
    track = " ".join(f"{number} {{0}}" for number in range(1, len(views) + 1))
    points3d = [f"{i + 1} 0 0 5 0 0 0 0.5 {track.format(i)}" for i in range(points)]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points3d)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("radial", [0.0, 0.08])
def test_a_bundle_has_the_geometry_of_the_images(views, tmp_path, radial):
    folder = write_reconstruction(tmp_path / "scene", views[:2], radial)
    assert main([str(folder), str(folder / "images"), str(tmp_path / "hall.npz")]) == 0
    bundle = SceneBundle(tmp_path / "hall.npz")
    bundle.check_training_pairs()
    pair = bundle[0]
    forward = pair.image1 == "1.png"
    one, two = views[:2] if forward else views[1::-1]
    np.testing.assert_allclose(pair.K1, one.camera.K, atol=1e-9)
    np.testing.assert_allclose(pair.K2, two.camera.K, atol=1e-9)
    R = two.camera.R @ one.camera.R.T
    np.testing.assert_allclose(pair.R, R, atol=1e-9)
    np.testing.assert_allclose(pair.t, two.camera.t - R @ one.camera.t, atol=1e-9)
    sure = (pair.attributes.ratio < 0.8) & pair.mutual
    distance = symmetric_epipolar_distance_squared(pair.correspondences[sure], pair.E)
    assert sure.sum() > 50
    assert np.median(distance) * pair.K1[0, 0] ** 2 < 1.0  # pixels², both images together
    assert BundleSource([bundle]).draw(np.random.default_rng(0)).name == "hall/0"


def test_options_choose_pairs(views, tmp_path, capsys):
    folder = write_reconstruction(tmp_path / "scene", views)
    command = [str(folder), str(folder / "images"), str(tmp_path / "hall.npz")]
    assert main([*command, "--max-pairs", "2"]) == 0
    with np.load(tmp_path / "hall.npz") as data:
        assert data["covisible"].tolist() == [60, 60]
    assert main([*command, "--min-covisible", "61"]) == 2
    assert "points3D: no two images share 61 points" in capsys.readouterr().err


def test_pairs_are_drawn_by_covisibility_and_seed():
    observed = [np.arange(0, 40), np.arange(10, 50), np.arange(35, 80), np.arange(0, 80)]
    everything = choose_pairs(observed, 15, 100, 0)
    assert {(*sorted(pair[:2]), pair[2]) for pair in everything} == {
        (0, 1, 30),
        (0, 3, 40),
        (1, 2, 15),
        (1, 3, 40),
        (2, 3, 45),
    }
    draws = {tuple(choose_pairs(observed, 15, 2, seed)) for seed in range(10)}
    assert all(len(draw) == 2 for draw in draws)
    assert len(draws) > 3
    assert {i < j for draw in draws for i, j, _ in draw} == {True, False}


def test_broken_reconstructions_are_named(tmp_path, capsys):
    assert main([str(tmp_path), str(tmp_path), str(tmp_path / "hall.npz")]) == 2
    assert str(tmp_path) in capsys.readouterr().err
