"""The study of pairs without overlap: what geometry says of parts and frusta, and a scene whose cameras are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from benchmarks import no_overlap
from benchmarks.no_overlap import Depths, Photograph, are_apart, parts_apart, scene_photographs, triangulated_depths
from benchmarks.photographs import Camera
from mgca_filter.geometry.cameras import normalize_points


def view(yaw_deg: float = 0.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), k1: float = 0.0) -> Photograph:
    """A photograph taken from ``centre``, turned to the right."""
    R = cv2.Rodrigues(np.array([0.0, -np.radians(yaw_deg), 0.0]))[0]
    camera = Camera(K, np.array([k1, 0.0, 0.0, 0.0]), R, -R @ np.array(centre))
    return Photograph(Path("a.png"), camera, SIZE, Depths(4.0, 30.0))


def pixels_in(photograph: Photograph, X: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points of the world by OpenCV; NaN behind the camera and where a lens folds."""
    camera = photograph.camera
    x = X @ camera.R.T + camera.t
    pixels = cv2.projectPoints(X, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, camera.dist)[0][:, 0]
    pixels[(x[:, 2] <= 0) | (np.linalg.norm(x[:, :2], axis=1) > x[:, 2])] = np.nan
    return pixels


def inside(pixels: np.ndarray, rectangle: tuple[int, int, int, int]) -> np.ndarray:
    low, high = np.array(rectangle).reshape(2, 2)
    return ((pixels >= low) & (pixels <= high)).all(axis=1)


@pytest.mark.parametrize("k1", [0.0, -0.15, 0.05])
@pytest.mark.parametrize(("yaw", "centre"), [(0.0, (0.0, 0.0, 0.0)), (12.0, (1.0, 0.2, 0.0)), (-20.0, (0.3, 0.0, 2.0))])
def test_no_point_at_any_depth_is_in_both_parts(k1: float, yaw: float, centre: tuple[float, float, float]) -> None:
    one, two = view(k1=k1), view(yaw, centre, k1)
    parts = parts_apart(one, two)
    assert parts is not None
    for part in parts:
        width, height = part[2] - part[0], part[3] - part[1]
        assert width * height >= 0.34 * SIZE[0] * SIZE[1]
    rng = np.random.default_rng(0)
    depth = 1.0 / rng.uniform(1e-6, 1.0 / one.depths.near, 40_000)
    X = (np.column_stack([rng.uniform([-0.6, -0.5], [0.6, 0.5], (40_000, 2)), np.ones(40_000)])) * depth[:, None]
    first, second = inside(pixels_in(one, X), parts[0]), inside(pixels_in(two, X), parts[1])
    assert first.sum() > 5000
    assert not (first & second).any()


def test_views_far_from_each_other_leave_the_whole_of_both() -> None:
    one, two = view(), view(yaw_deg=120.0)
    parts = parts_apart(one, two)
    assert parts is not None
    assert parts[1] == two.whole  # the first is cut all the same


def test_a_near_thing_leaves_no_parts() -> None:
    one, two = view(), view(centre=(3.0, 3.0, 0.0))
    assert parts_apart(one, two) is not None
    near = Depths(0.05, 30.0)
    assert parts_apart(replace(one, depths=near), replace(two, depths=near)) is None


def test_frusta_that_do_not_meet_are_apart() -> None:
    assert are_apart(view(), view(yaw_deg=180.0))
    assert are_apart(view(), view(yaw_deg=50.0))  # the images span 44 degrees
    assert not are_apart(view(), view(yaw_deg=42.0))
    assert not are_apart(view(), view())
    assert not are_apart(view(), view(yaw_deg=60.0, centre=(-20.0, 0.0, 0.0)))
    # Beyond the depths of either nothing is seen.
    far = replace(view(centre=(0.0, 0.0, 30.0)), depths=Depths(20.0, 60.0))
    assert are_apart(replace(view(), depths=Depths(20.0, 25.0)), far)
    assert not are_apart(replace(view(), depths=Depths(20.0, 90.0)), far)
    # What is nearer than the motion between the views is everywhere: nothing is certain.
    assert not are_apart(replace(view(yaw_deg=50.0, centre=(1.0, 0.0, 0.0)), depths=Depths(0.05, 30.0)), view())


def test_depths_are_those_of_the_points() -> None:
    scene = make_scene(right=60, wrong=60, noise_px=0.0)
    x1, x2 = (normalize_points(points, K) for points in (scene.points1, scene.points2))
    depth1, depth2 = triangulated_depths(x1, x2, scene.R, 0.5 * scene.t, K[0, 0])
    again1, _ = triangulated_depths(x1, x2, scene.R, scene.t, K[0, 0])
    np.testing.assert_allclose(2.0 * depth1, again1)  # in the units of the translation
    assert 50 <= len(depth1) <= 70
    back, _ = triangulated_depths(x2, x1, scene.R.T, -0.5 * scene.R.T @ scene.t, K[0, 0])
    np.testing.assert_allclose(back, depth2)


@pytest.fixture
def folder(tmp_path: Path, views) -> Path:
    """Rendered views with their cameras, as a scene's folder."""
    lines = ["image,width,height,fx,fy,cx,cy,k1," + ",".join(f"r{i}{j}" for i in "123" for j in "123") + ",tx,ty,tz"]
    for each in views:
        cv2.imwrite(str(tmp_path / each.name), each.image)
        camera = (*SIZE, *np.diag(each.K)[:2], *each.K[:2, 2], 0.0, *np.ravel(each.R), *each.t)
        lines.append(",".join(map(str, (each.name, *camera))))
    (tmp_path / "cameras.csv").write_text("\n".join(lines) + "\n")
    names = [each.name for each in views]
    (tmp_path / "pairs.csv").write_text("image1,image2\n" + "".join(f"{a},{b}\n" for a, b in zip(names, names[1:])))
    return tmp_path


def test_depths_of_a_scene_hold_what_its_photographs_show(folder: Path) -> None:
    photographs = scene_photographs(folder, seed=0)
    assert len(photographs) >= 3
    for each in photographs:  # the courtyard's walls are some 4 to 14 metres away
        assert each.depths.near < 6.0 < each.depths.far
        assert each.size == SIZE


def test_the_command_prints_a_line_for_every_kind_and_list(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path_factory.mktemp("photos")
    for name in ("view00.png", "view01.png"):
        (photos / name).write_bytes((folder / name).read_bytes())
    words = ["--scenes", str(folder), "--photos", str(photos), "--pairs", "1", "--model", str(model_file)]
    assert no_overlap.main([*words, "--settings", "sift-200"]) == 0
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()]
    kinds = {line[0] for line in table[2:]}
    assert {"one place, parts of photographs", "one photograph, two parts", "rendered, one world"} <= kinds
    assert {line[1] for line in table[2:]} <= {"sift-200, raw", "sift-200, cross and ratio"}
    assert all(line[2] == "1" and len(line) == len(no_overlap.HEADER) for line in table[2:])
    assert no_overlap.main(["--scenes", str(folder / "absent")]) == 2
    assert "cameras.csv" in capsys.readouterr().err
