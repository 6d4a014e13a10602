"""Thresholds follow the image in which the keypoints were found: enlarging the images changes no answer."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import K, make_scene

from mgca_filter import MatchFilter, Status, filter_matches, match_images
from mgca_filter.features import create_detector, describe
from mgca_filter.geometry.epipolar import pose_error_deg

EXAMPLE = Path(__file__).parents[2] / "examples" / "images"
SCENE = make_scene()


def enlarged(factor: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the scene as of images that are ``factor`` times larger, and their K."""
    return SCENE.points1 * factor, SCENE.points2 * factor, np.diag([factor, factor, 1.0]) @ K


@pytest.mark.parametrize("factor", [0.5, 2.0, 8.0])  # exact in floating point
@pytest.mark.parametrize("calibrated", [True, False])
def test_the_answer_is_that_of_the_copy(match_filter: MatchFilter, factor: float, calibrated: bool) -> None:
    x1, x2, K_large = enlarged(factor)
    size = np.array([640, 480])
    known = {"attributes": SCENE.attributes}
    copy = match_filter.filter(
        SCENE.points1, SCENE.points2, None, size1=size, size2=size, **known, K1=K if calibrated else None
    )
    large = match_filter.filter(
        x1,
        x2,
        None,
        size1=size * factor,
        size2=size * factor,
        **known,
        K1=K_large if calibrated else None,
        resolution=factor,
    )
    assert copy.status is large.status is Status.OK
    # Without intrinsics the guessed principal point moves by a part of a pixel: (w - 1) / 2 is not w / 2.
    assert np.count_nonzero(copy.mask != large.mask) <= (0 if calibrated else 0.02 * len(copy.mask))
    if calibrated:
        np.testing.assert_array_equal(copy.E, large.E)
    # F is for the coordinates that came in.
    unit = np.diag([factor, factor, 1.0])
    F = unit @ large.F @ unit
    np.testing.assert_allclose(F / np.linalg.norm(F), copy.F, atol=1e-12 if calibrated else 1e-3)
    np.testing.assert_array_equal(large.points1, x1)


def test_the_resolution_counts_and_is_told() -> None:
    x1, x2, K_large = enlarged(8.0)
    kept = {r: filter_matches(x1, x2, None, K1=K_large, attributes=SCENE.attributes, resolution=r) for r in (1.0, 8.0)}
    assert kept[1.0].num_inliers < 0.6 * kept[8.0].num_inliers
    assert any("image in which the keypoints were found" in sentence for sentence in kept[8.0].info["assumptions"])
    assert not any("keypoints were found" in sentence for sentence in kept[1.0].info["assumptions"])


def test_the_threshold_is_in_pixels_of_the_copy() -> None:
    x1, x2, K_large = enlarged(8.0)
    few = filter_matches(x1, x2, None, K1=K_large, attributes=SCENE.attributes, resolution=8.0, threshold=0.2)
    same = filter_matches(SCENE.points1, SCENE.points2, None, K1=K, attributes=SCENE.attributes, threshold=0.2)
    np.testing.assert_array_equal(few.mask, same.mask)


@pytest.mark.parametrize(("value", "error"), [(0.0, ValueError), (float("nan"), ValueError), ("2", TypeError)])
def test_another_resolution_is_refused_by_name(value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="resolution: expected"):
        filter_matches(SCENE.points1, SCENE.points2, None, K1=K, resolution=value)


@pytest.mark.slow
def test_enlarged_photographs_keep_their_matches() -> None:
    images = [cv2.imread(str(EXAMPLE / name)) for name in ("left.jpg", "right.jpg")]
    truth = json.loads((EXAMPLE / "pair.json").read_text())
    counts = {}
    for factor in (1, 2, 8):
        large = [cv2.resize(i, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC) for i in images]
        K_large = np.array(
            [[820.0 * factor, 0, 512 * factor - 0.5], [0, 820.0 * factor, 384 * factor - 0.5], [0, 0, 1]]
        )
        result = match_images(*large, K1=K_large, max_keypoints=2000).result
        counts[factor] = result.num_inliers
        assert result.status is Status.OK
        assert pose_error_deg(result.R, result.t, np.array(truth["R"]), np.array(truth["t"])) < 1.0
    assert min(counts.values()) > 0.9 * counts[1]
    assert max(counts.values()) < 1.1 * counts[1]


def test_features_know_the_copy_that_they_come_from() -> None:
    image = np.zeros((1600, 2400), dtype=np.uint8)
    assert describe(image, create_detector()).resolution == 2.0
    assert describe(image[:600, :900], create_detector()).resolution == 1.0
