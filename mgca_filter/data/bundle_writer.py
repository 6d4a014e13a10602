"""Writing scene bundles: what :class:`mgca_filter.data.scene_bundle.SceneBundle` reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..atomic_file import replaced_when_done
from ..training.sift import OneWayMatches

ANGLE_UNITS = 256  # of a full turn, to fit a byte
LABEL_FIELD = "match_label"
"""Optional field: labels (ΣM,) int8 of all matches, for bundles that know them better than poses tell."""


@dataclass(frozen=True)
class BundleImage:
    """A photograph with its camera (world → camera) and its keypoints in undistorted pixels under K."""

    name: str
    image_size: tuple[int, int]
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    points: NDArray[np.float64]
    size: NDArray[np.float32]
    angle: NDArray[np.float32]


@dataclass(frozen=True)
class BundlePair:
    """Matches from image ``first`` to image ``second``; ``covisible`` = shared 3-D points, −1 = not known."""

    first: int
    second: int
    matches: OneWayMatches
    covisible: int
    labels: NDArray[np.int8] | None = None


def write_bundle(path: Path, images: Sequence[BundleImage], pairs: Sequence[BundlePair]) -> None:
    """Write a bundle; a crash in the middle leaves no broken file behind.

    Raises:
        ValueError: there is no pair, or an image holds more keypoints than 16 bits count.
    """
    if not pairs:
        raise ValueError(f"{path}: no pair to write")
    if max(len(image.points) for image in images) > np.iinfo(np.uint16).max:
        raise ValueError(f"{path}: more than {np.iinfo(np.uint16).max} keypoints in an image")
    angle = np.concatenate([image.angle for image in images]).astype(np.float64)
    fields: dict[str, NDArray[np.generic]] = {
        "image_name": np.array([image.name for image in images]),
        "image_size": np.array([image.image_size for image in images], dtype=np.int32),
        "K": np.array([image.K for image in images], dtype=np.float64),
        "R": np.array([image.R for image in images], dtype=np.float64),
        "t": np.array([image.t for image in images], dtype=np.float64),
        "keypoint_offset": _offsets([len(image.points) for image in images]),
        "keypoint_xy": np.concatenate([image.points for image in images]).astype(np.float32),
        "keypoint_size": np.concatenate([image.size for image in images]).astype(np.float16),
        "keypoint_angle": (np.round(angle * (ANGLE_UNITS / 360.0)).astype(np.int64) % ANGLE_UNITS).astype(np.uint8),
        "pair": np.array([(pair.first, pair.second) for pair in pairs], dtype=np.int32),
        "match_offset": _offsets([len(pair.matches.index2) for pair in pairs]),
        "match_index": np.concatenate([pair.matches.index2 for pair in pairs]).astype(np.uint16),
        "match_ratio": np.round(255.0 * np.concatenate([p.matches.ratio for p in pairs])).astype(np.uint8),
        "match_mutual": np.packbits(np.concatenate([pair.matches.mutual for pair in pairs])),
        "match_best": np.packbits(np.concatenate([pair.matches.best for pair in pairs])),
        "covisible": np.array([pair.covisible for pair in pairs], dtype=np.int32),
    }
    labels = [pair.labels for pair in pairs if pair.labels is not None]
    if len(labels) == len(pairs):
        fields[LABEL_FIELD] = np.concatenate(labels)
    with replaced_when_done(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **fields)  # type: ignore[arg-type]


def _offsets(counts: Sequence[int]) -> NDArray[np.generic]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
