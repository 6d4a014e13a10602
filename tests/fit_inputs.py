"""Scenes as the robust fit gets them: matches on the normalised image planes, with what is known of each."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from conftest import K, Scene, make_scene

from mgca_filter.fit.choice import fitted_coefficients
from mgca_filter.fit.evidence import Evidence, gather_before, gather_scored
from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg
from mgca_filter.geometry.homography import poses_from_homography
from mgca_filter.inputs.attributes import MatchAttributes
from mgca_filter.inputs.pair import MatchPair, PairInput, prepare_pair

FOCAL = float(K[0, 0])
COEFFICIENTS = fitted_coefficients()


def normalized(scene: Scene) -> np.ndarray:
    """Matches (M, 4) on the normalised image planes."""
    return np.hstack([normalize_points(scene.points1, K), normalize_points(scene.points2, K)])


def prepared(scene: Scene, calibrated: bool = True) -> PairInput:
    cameras = (K, None) if calibrated else (None, None)
    return prepare_pair(MatchPair(scene.points1, scene.points2, None, *cameras, attributes=scene.attributes))


def before(scene: Scene, calibrated: bool = True) -> Evidence:
    """What is known before the network."""
    return gather_before(prepared(scene, calibrated))


def scored(
    scene: Scene,
    margins: np.ndarray | None = None,
    network_essential: np.ndarray | None = None,
    calibrated: bool = True,
) -> Evidence:
    """What is known after a network whose logits are ``margins``; by default 8 (0.8 − ratio)."""
    if margins is None:
        margins = 8.0 * (0.8 - scene.attributes.ratio)
    margins = np.asarray(margins, dtype=np.float32)
    scores = (1.0 / (1.0 + np.exp(-margins))).astype(np.float32)
    rows = np.arange(len(margins))
    return gather_scored(prepared(scene, calibrated), rows, scores, margins, network_essential)


def permuted(scene: Scene, order: np.ndarray) -> Scene:
    """The scene with its matches in another order, or some of them."""
    return replace(
        scene,
        points1=scene.points1[order],
        points2=scene.points2[order],
        inlier=scene.inlier[order],
        attributes=scene.attributes.take(order),
    )


def joined(*scenes: Scene) -> Scene:
    """The matches of several scenes that share a pose."""
    count = sum(len(scene.inlier) for scene in scenes)
    ratio = np.concatenate([scene.attributes.ratio for scene in scenes])
    return replace(
        scenes[0],
        points1=np.vstack([scene.points1 for scene in scenes]),
        points2=np.vstack([scene.points2 for scene in scenes]),
        inlier=np.concatenate([scene.inlier for scene in scenes]),
        attributes=MatchAttributes(ratio=ratio, best=np.ones(count, dtype=bool)),
    )


def plane_with_twin(off_plane: int = 12, wrong: int = 40, seed: int = 0) -> tuple[Scene, np.ndarray]:
    """150 matches of a plane, a few off it, some wrong; and the wrong E that the plane alone allows as well."""
    plane = make_scene("planar", right=150, wrong=0, noise_px=0.2, seed=seed)
    off = make_scene(right=off_plane, wrong=wrong, noise_px=0.2, seed=seed + 100)
    exact = normalized(make_scene("planar", right=60, wrong=0, noise_px=0.0, seed=seed))
    H, _ = cv2.findHomography(exact[:, :2], exact[:, 2:])
    poses = poses_from_homography(H)

    def error(pose: tuple[np.ndarray, np.ndarray]) -> float:
        return min(pose_error_deg(pose[0], sign * pose[1], plane.R, plane.t) for sign in (1.0, -1.0))

    assert min(map(error, poses)) < 0.1
    return joined(plane, off), essential_from_pose(*max(poses, key=error))
