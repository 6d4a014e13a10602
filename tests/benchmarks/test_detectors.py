"""The study of other detectors, on small data whose answers are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene
from scene_bundles import bundle_fields, write_bundle

from benchmarks import detectors
from benchmarks.detectors import ImageSet, photographed, rendered
from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import SceneBundle
from mgca_filter.errors import DatasetError
from mgca_filter.geometry.epipolar import rotation_error_deg, symmetric_epipolar_distance_squared


@pytest.fixture
def photographs(tmp_path: Path) -> tuple[Path, Path]:
    """Two pictures of a texture under a rotating camera, at half the size that the bundle gives them."""
    scene = make_scene("rotation")
    noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    first = cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC)
    second = cv2.warpPerspective(first, K @ scene.R @ np.linalg.inv(K), SIZE)
    for name, image in (("000.jpg", first), ("001.jpg", second)):
        cv2.imwrite(str(tmp_path / name), image)
    fields = bundle_fields([scene])
    double = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]]) @ K
    changes = {"K": np.tile(double, (2, 1, 1)), "image_size": 2 * fields["image_size"]}
    return tmp_path, write_bundle(tmp_path / "turn.npz", [scene], **changes)


@pytest.fixture(scope="module")
def textures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures for the faces of rendered worlds: blots of every size."""
    folder = tmp_path_factory.mktemp("textures")
    for number in range(3):
        noise = np.random.default_rng(number).normal(size=(3, 240, 320))
        layers = [cv2.GaussianBlur(one, (0, 0), sigma) for one, sigma in zip(noise, (1.0, 3.0, 9.0))]
        image = 128 + 35 * sum(layer / layer.std() for layer in layers)
        cv2.imwrite(str(folder / f"{number}.png"), np.clip(image, 0, 255).astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def world(textures: Path) -> ImageSet:
    """A pair of rendered views."""
    return rendered(textures, 1, seed=0)


@pytest.mark.parametrize("name", detectors.DETECTORS)
def test_every_detector_finds_the_rotation_at_another_size(
    photographs: tuple[Path, Path], name: str, model_file: Path
) -> None:
    folder, path = photographs
    images = photographed(folder, SceneBundle(path))
    assert list(images.images) == ["000.jpg", "001.jpg"]
    (pair,) = images.matched(detectors.make_detector(name))
    assert pair.image_size1 == SIZE
    np.testing.assert_allclose(pair.K1, K)
    result = MatchFilter(model=model_file).filter(
        pair.points1, pair.points2, None, K1=pair.K1, K2=pair.K2, attributes=pair.attributes
    )
    assert rotation_error_deg(result.R, SceneBundle(path)[0].R) < 1.0


def test_pairs_without_their_photographs_are_left_out(photographs: tuple[Path, Path]) -> None:
    folder, path = photographs
    bundle = write_bundle(folder / "more.npz", [make_scene("rotation"), make_scene()])
    images = photographed(folder, SceneBundle(bundle))
    assert [(pair.image1, pair.image2) for pair in images.pairs] == [("000.jpg", "001.jpg")]
    (folder / "000.jpg").unlink()
    (folder / "001.jpg").unlink()
    with pytest.raises(DatasetError, match="none of its"):
        photographed(folder, SceneBundle(path))


@pytest.mark.slow
def test_rendered_views_know_their_pose(world: ImageSet, textures: Path) -> None:
    (pair,) = world.matched(detectors.make_detector("sift"))
    right = symmetric_epipolar_distance_squared(pair.correspondences, pair.E) < 1e-4
    assert np.count_nonzero(right) >= 20
    (again,) = rendered(textures, 1, seed=0).pairs
    np.testing.assert_array_equal(again.t, pair.t)
    assert not np.array_equal(rendered(textures, 1, seed=1).pairs[0].t, pair.t)


@pytest.mark.slow
def test_detector_command_has_a_row_for_every_kind_of_input(
    photographs: tuple[Path, Path],
    world: ImageSet,
    model_file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, path = photographs
    asked = []
    monkeypatch.setattr(detectors, "rendered", lambda *arguments: asked.append(arguments) or world)
    arguments = ["--scene", str(folder), str(path), "--rendered", "P", "--pairs", "7", "--seed", "3"]
    assert detectors.main([*arguments, "--detectors", "orb", "--model", str(model_file)]) == 0
    assert asked == [(Path("P"), 7, 3)]
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[:4] for row in rows] == [
        [f"| {name}", "orb", kind.name, "1"] for name in ("turn", "rendered") for kind in detectors.KINDS
    ]
    assert all(row[-1].rstrip(" |") in kind.baselines for row, kind in zip(rows, 2 * detectors.KINDS))
    assert detectors.main(["--scene", str(folder), str(folder / "none.npz")]) == 2
    with pytest.raises(SystemExit, match="2"):
        detectors.main([])
