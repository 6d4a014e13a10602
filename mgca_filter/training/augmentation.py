"""Changes of a training sample under which its labels stay exact.

Every change of a camera — a virtual rotation, a mirror, a wrong focal length — is a homography of its image
plane: x → H x, F → H2^-T F H1^-1. Keypoint sizes and angles follow the homography's local Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..inputs.attributes import Column

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class AugmentationConfig:
    """How far and how often cameras are changed; angles in degrees, probabilities per pair.

    Attributes:
        tilt_deg: largest virtual rotation about the x and y axes of each camera.
        roll_deg: largest common roll error of each camera; a full turn of one camera with ``turn``.
        turn: probability that one camera is rolled by any angle.
        mirror: probability that both images are mirrored.
        focal_error: probability that the intrinsics of the pair are wrong.
        focal_factor: largest factor by which a wrong focal length is off.
    """

    tilt_deg: float = 12.0
    roll_deg: float = 15.0
    turn: float = 0.2
    mirror: float = 0.5
    focal_error: float = 0.15
    focal_factor: float = 1.5


def rotation_matrix(axis: int, angle: float) -> FloatArray:
    """Rotation (3, 3) about a coordinate axis (0, 1, 2) by ``angle`` radians."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


def draw_homographies(rng: np.random.Generator, config: AugmentationConfig) -> tuple[FloatArray, FloatArray]:
    """Homographies (3, 3) of the two image planes."""
    mirror = np.diag([-1.0, 1.0, 1.0]) if rng.random() < config.mirror else np.eye(3)
    wrong = rng.random() < config.focal_error
    common = rng.uniform(-1.0, 1.0) * np.log(config.focal_factor) if wrong else 0.0
    turned = int(rng.integers(2)) if rng.random() < config.turn else -1
    homographies = []
    for camera in range(2):
        tilt_x, tilt_y = np.radians(rng.uniform(-config.tilt_deg, config.tilt_deg, 2))
        roll_deg = 180.0 if camera == turned else config.roll_deg
        roll = np.radians(rng.uniform(-roll_deg, roll_deg))
        Q = rotation_matrix(2, roll) @ rotation_matrix(1, tilt_y) @ rotation_matrix(0, tilt_x)
        scale = np.exp(common + (rng.normal(0.0, 0.03) if wrong else 0.0))
        homographies.append(np.diag([scale, scale, 1.0]) @ Q @ mirror)
    return homographies[0], homographies[1]


def transform_points(H: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) moved by H, and the Jacobian (N, 2, 2) of the map at each."""
    y = x @ H[:2, :2].T + H[:2, 2]
    w = x @ H[2, :2] + H[2, 2]
    moved = y / w[:, None]
    jacobian = (H[None, :2, :2] - moved[:, :, None] * H[None, 2:, :2]) / w[:, None, None]
    return moved, jacobian


def sees_all(H: FloatArray, x: FloatArray, margin: float = 0.3) -> bool:
    """Whether all points (N, 2) stay well in front of the camera changed by H."""
    return bool((x @ H[2, :2] + H[2, 2] > margin).all())


def transform_attributes(
    attributes: NDArray[np.float32], angle1: FloatArray, J1: FloatArray, J2: FloatArray
) -> NDArray[np.float32]:
    """Encoded attributes (N, 8) after both images moved with Jacobians (N, 2, 2); angle1 (N,) in radians."""
    out = attributes.copy()
    known = attributes[:, Column.SHAPE_KNOWN] > 0
    angle2 = angle1 + np.arctan2(attributes[:, Column.SIN_TURN], attributes[:, Column.COS_TURN])
    new1, new2 = (_turned(J, angle) for J, angle in ((J1, angle1), (J2, angle2)))
    area1, area2 = (np.abs(np.linalg.det(J)) for J in (J1, J2))
    log2_size = attributes[:, Column.LOG2_SIZE] + 0.5 * np.log2(area2 / area1)
    out[:, Column.LOG2_SIZE] = np.where(known, log2_size, 0.0)
    out[:, Column.COS_TURN] = np.where(known, np.cos(new2 - new1), 0.0)
    out[:, Column.SIN_TURN] = np.where(known, np.sin(new2 - new1), 0.0)
    return out


def _turned(jacobian: FloatArray, angle: FloatArray) -> FloatArray:
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, :, None]
    moved = (jacobian @ direction)[:, :, 0]
    return np.arctan2(moved[:, 1], moved[:, 0])


def transform_epipolar(F: FloatArray, H1: FloatArray, H2: FloatArray) -> FloatArray:
    """Epipolar matrix (3, 3) between the changed image planes, of unit Frobenius norm."""
    F = np.linalg.inv(H2).T @ F @ np.linalg.inv(H1)
    return F / np.linalg.norm(F)
