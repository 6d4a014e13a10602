"""Clean labels: right, wrong, and left out, on pairs whose every match is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.geometry.epipolar import symmetric_epipolar_distance_squared
from mgca_filter.inputs.attributes import MatchAttributes
from mgca_filter.training.pairs import IGNORED, NEGATIVE, POSITIVE, clean_labels

R, T = np.eye(3), np.array([1.0, 0.0, 0.0])  # epipolar lines are rows, disparity is 1 / depth


def pair_of(x1: np.ndarray, x2: np.ndarray, mutual: bool = True, ratio: float = 0.5) -> ScenePair:
    """A pair with a camera that moved to the side, from points on the normalised planes."""
    return ScenePair(
        scene="plane",
        index=0,
        image1="a",
        image2="b",
        points1=x1,
        points2=x2,
        K1=np.eye(3),
        K2=np.eye(3),
        image_size1=SIZE,
        image_size2=SIZE,
        R=R,
        t=T,
        attributes=MatchAttributes(ratio=np.full(len(x1), ratio, np.float32), best=np.ones(len(x1), bool)),
        mutual=np.full(len(x1), mutual),
    )


def at_depths(depths: np.ndarray, off: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points at given depths, moved off their epipolar lines by ``off`` (one line in each image)."""
    x1 = np.column_stack([np.linspace(-0.4, 0.4, len(depths)), np.linspace(-0.3, 0.3, len(depths))])
    return x1, x1 + np.column_stack([1.0 / depths, np.full(len(depths), off)])


@pytest.mark.parametrize(
    ("distance", "label"),
    [(0.0, POSITIVE), (1.4e-5, POSITIVE), (1.6e-5, IGNORED), (0.9e-4, IGNORED), (1.1e-4, NEGATIVE), (1.0, NEGATIVE)],
)
def test_distance_decides(distance, label):
    pair = pair_of(*at_depths(np.full(5, 4.0), off=np.sqrt(distance / 2)))
    measured = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
    np.testing.assert_allclose(measured, distance, rtol=1e-6, atol=1e-12)
    assert (clean_labels(pair) == label).all()


def test_matches_behind_the_cameras_are_left_out():
    depths = np.array([4.0, -4.0, 5.0, -3.0])
    assert clean_labels(pair_of(*at_depths(depths))).tolist() == [POSITIVE, IGNORED, POSITIVE, IGNORED]


def test_accidents_on_the_epipolar_line_are_told_by_depth():
    depths = np.concatenate([np.linspace(4.0, 8.0, 60), [1.0, 30.0, 3.0, 12.0]])
    labels = clean_labels(pair_of(*at_depths(depths)))
    assert (labels[:60] == POSITIVE).all()
    assert labels[60:].tolist() == [IGNORED, IGNORED, POSITIVE, POSITIVE]


@pytest.mark.parametrize("unsure", [{"mutual": False}, {"ratio": 0.86}])
def test_depth_is_tested_only_where_the_pair_has_sure_matches(unsure):
    depths = np.concatenate([np.linspace(4.0, 8.0, 60), [1.0, 30.0]])
    assert (clean_labels(pair_of(*at_depths(depths), **unsure)) == POSITIVE).all()
    few = np.concatenate([np.full(6, 5.0), [0.5]])
    assert (clean_labels(pair_of(*at_depths(few))) == POSITIVE).all()


def test_mutual_matches_are_sure_where_no_ratio_is_known():
    depths = np.concatenate([np.linspace(4.0, 8.0, 60), [1.0, 30.0]])
    pair = dataclasses.replace(pair_of(*at_depths(depths)), attributes=MatchAttributes())
    assert clean_labels(pair)[60:].tolist() == [IGNORED, IGNORED]


def test_right_and_wrong_matches_of_a_scene():
    scene = make_scene(noise_px=0.1, right=200, wrong=200)
    base = pair_of(scene.points1, scene.points2, ratio=0.6)
    pair = dataclasses.replace(base, K1=K, K2=K, R=scene.R, t=scene.t)
    labels = clean_labels(pair)
    assert labels.dtype == np.int8
    assert (labels[scene.inlier] == POSITIVE).mean() > 0.95
    assert (labels[~scene.inlier] == NEGATIVE).mean() > 0.85
    assert not (labels[scene.inlier] == NEGATIVE).any()


def test_labels_do_not_depend_on_the_scale_of_the_scene():
    scene = make_scene(noise_px=0.3)
    base = dataclasses.replace(pair_of(scene.points1, scene.points2), K1=K, K2=K, R=scene.R, t=scene.t)
    larger = dataclasses.replace(base, t=100.0 * scene.t)
    np.testing.assert_array_equal(clean_labels(larger), clean_labels(base))


def test_a_pair_without_matches_has_no_labels():
    assert clean_labels(pair_of(np.zeros((0, 2)), np.zeros((0, 2)))).shape == (0,)
