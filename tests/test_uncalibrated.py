"""The studies of guessed focal lengths and of other detectors, on small data whose answers are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, make_scene
from scene_bundles import bundle_fields, write_bundle

from mgca_filter import MatchFilter
from mgca_filter.epipolar import rotation_error_deg
from mgca_filter.evaluation import detectors, focal_error
from mgca_filter.scene_bundle import SceneBundle


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_bundle(tmp_path / "scene.npz", [make_scene(seed=0, noise_px=0.1), make_scene(seed=1, noise_px=0.1)])


def test_right_focal_length_is_best_and_none_gives_a_good_f(bundle: Path, match_filter: MatchFilter) -> None:
    pair = SceneBundle(bundle)[0]
    right, wrong, none = (focal_error.run_pair(pair, factor, match_filter) for factor in (1.0, 0.7, None))
    assert right.error_deg < 1.0
    assert wrong.error_deg > 2.0 * right.error_deg
    assert right.close > 0.95
    assert none.close > 0.9
    assert right.precision > 0.9


def test_focal_command_has_a_row_for_every_factor(
    bundle: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert focal_error.main([str(bundle), "--model", str(model_file), "--per-scene", "1"]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == [
        *(f"× {factor:g}" for factor in focal_error.FACTORS),
        "not given",
    ]
    assert all(row.split(" | ")[1] == "1" for row in rows)
    assert focal_error.main([str(bundle.parent / "none")]) == 2


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


@pytest.mark.parametrize("name", detectors.DETECTORS)
def test_every_detector_finds_the_rotation_at_another_size(
    photographs: tuple[Path, Path], name: str, model_file: Path
) -> None:
    folder, path = photographs
    pair = SceneBundle(path)[0]
    detector = detectors.make_detector(name)
    one, two = (detectors.read_features(folder / image, detector) for image in (pair.image1, pair.image2))
    assert one.size == SIZE
    intrinsics = detectors._rescaled(pair.K1, pair.image_size1, one.size)
    np.testing.assert_allclose(intrinsics, K)
    errors = detectors.errors_of_pair(one, two, detector.defaultNorm(), pair, MatchFilter(model=model_file))
    assert list(errors) == ["mgca_filter", "ratio 0.8 + RANSAC", "ratio 0.8 + MAGSAC"]
    knn = detectors.match_descriptors(one.descriptors, two.descriptors, detector.defaultNorm())
    result = MatchFilter(model=model_file).filter(one.keypoints, two.keypoints, knn, K1=K)
    assert rotation_error_deg(result.R, pair.R) < 1.0


def test_detector_command_counts_the_pairs(
    photographs: tuple[Path, Path], model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, path = photographs
    assert detectors.main([str(folder), str(path), "--detectors", "orb", "--model", str(model_file)]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[:3] for row in rows] == [
        ["| orb", method, "1"] for method in ("mgca_filter", "ratio 0.8 + RANSAC", "ratio 0.8 + MAGSAC")
    ]
    assert detectors.main([str(folder), str(folder / "none.npz")]) == 2
