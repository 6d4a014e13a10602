"""Kinds of motion, on pairs that were made to move so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from benchmarks import motion
from benchmarks.motion import Motion
from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.geometry.pose_refinement import rotation_from_vector


def pair_of(kind: str = "general", **changes: np.ndarray) -> ScenePair:
    scene = make_scene(kind, noise_px=0.1)
    everything = np.ones(len(scene.points1), dtype=bool)
    pair = ScenePair(
        *("hall", 0, "a", "b", scene.points1, scene.points2, K, K, SIZE, SIZE, scene.R, scene.t, scene.attributes),
        mutual=everything,
    )
    return replace(pair, **changes)


def test_a_step_to_the_side_is_sideways() -> None:
    found = Motion.of(pair_of())
    assert found.kinds == (motion.SIDEWAYS,)
    assert found.rotation_deg == pytest.approx(np.degrees(np.linalg.norm([0.05, -0.12, 0.03])))
    assert found.baseline_deg is not None
    assert 3.0 < found.baseline_deg < 15.0
    assert found.planar_share is not None
    assert found.planar_share < 0.8


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_forward_and_backward_are_along_both_axes(sign: float) -> None:
    ahead = np.array([0.1, 0.0, sign])
    assert motion.FORWARD in Motion.of(pair_of(R=np.eye(3), t=ahead)).kinds
    # The second camera looks to the side: what is ahead of one is not ahead of the other.
    turned = Motion.of(pair_of(R=rotation_from_vector(np.array([0.0, 1.2, 0.0])), t=ahead))
    assert not {motion.FORWARD, motion.SIDEWAYS} & set(turned.kinds)
    assert motion.ROTATED in turned.kinds


def test_motion_is_that_of_the_swapped_pair() -> None:
    pair = pair_of("wide")
    turned = replace(pair, points1=pair.points2, points2=pair.points1, R=pair.R.T, t=-pair.R.T @ pair.t)
    one, other = Motion.of(pair), Motion.of(turned)
    assert one.kinds == other.kinds
    assert one.axes_deg == pytest.approx(other.axes_deg[::-1])
    assert one.rotation_deg == pytest.approx(other.rotation_deg)
    assert one.baseline_deg == pytest.approx(other.baseline_deg)


def test_a_plane_and_a_camera_that_only_turns_are_told() -> None:
    assert motion.PLANAR in Motion.of(pair_of("planar")).kinds
    turning = Motion.of(pair_of("rotation", t=np.array([1.0, 0.0, 0.0])))
    assert {motion.PLANAR, motion.SMALL_BASELINE} <= set(turning.kinds)
    assert turning.baseline_deg == pytest.approx(0.0, abs=0.5)


def test_without_right_matches_only_the_pose_is_known() -> None:
    found = Motion.of(pair_of().take(np.zeros(0, dtype=np.intp)))
    assert (found.baseline_deg, found.planar_share) == (None, None)
    assert found.kinds == (motion.SIDEWAYS,)
