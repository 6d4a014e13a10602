"""Synthetic scene bundles, for the tests of training and evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from conftest import SIZE, K, Scene


def bundle_fields(scenes: Sequence[Scene]) -> dict[str, np.ndarray]:
    """The arrays of a bundle with one pair of images for each scene."""
    count = [len(scene.points1) for scene in scenes]
    matches, images = int(np.sum(count)), 2 * len(scenes)
    ratio = np.concatenate([scene.attributes.ratio for scene in scenes])
    return {
        "image_name": np.array([f"{i:03d}.jpg" for i in range(images)]),
        "image_size": np.tile(np.array(SIZE), (images, 1)),
        "K": np.tile(K, (images, 1, 1)),
        "R": np.concatenate([[np.eye(3), scene.R] for scene in scenes]),
        "t": np.concatenate([[np.zeros(3), scene.t] for scene in scenes]),
        "keypoint_offset": np.concatenate([[0], np.cumsum(np.repeat(count, 2))]),
        "keypoint_xy": np.concatenate([p for s in scenes for p in (s.points1, s.points2)]).astype(np.float32),
        "keypoint_size": np.full(2 * matches, 4.0, dtype=np.float16),
        "keypoint_angle": np.full(2 * matches, 20, dtype=np.uint8),
        "pair": np.arange(images).reshape(-1, 2).astype(np.uint16),
        "match_offset": np.concatenate([[0], np.cumsum(count)]),
        "match_index": np.concatenate([np.arange(n) for n in count]).astype(np.uint16),
        "match_ratio": np.round(255 * ratio).astype(np.uint8),
        "match_mutual": np.packbits(np.ones(matches, dtype=bool)),
        "match_best": np.packbits(np.ones(matches, dtype=bool)),
        "covisible": np.full(len(scenes), -1),
    }


def write_bundle(path: Path, scenes: Sequence[Scene], **changes: np.ndarray | None) -> Path:
    """A bundle with one pair of images for each scene; ``changes`` replace fields, None leaves one out."""
    fields = {**bundle_fields(scenes), **changes}
    np.savez_compressed(path, **{name: value for name, value in fields.items() if value is not None})
    return path


def learned_fields(scenes: Sequence[Scene], seed: int = 0) -> dict[str, np.ndarray | None]:
    """Changes that turn a bundle into that of a learned matcher: every other keypoint is left out, the rest scored.

    Right matches score high; keypoints have neither size nor angle.
    """
    kept = [np.arange(len(scene.points1))[::2] for scene in scenes]
    right = np.concatenate([scene.inlier[rows] for scene, rows in zip(scenes, kept)])
    noise = np.random.default_rng(seed).uniform(0.0, 0.3, len(right))
    index = np.concatenate(kept).astype(np.uint16)
    return {
        **dict.fromkeys(("match_ratio", "match_mutual", "match_best")),
        "match_offset": np.concatenate([[0], np.cumsum([len(rows) for rows in kept])]),
        "match_query": index,
        "match_index": index,
        "match_score": np.round(255 * (0.7 * right + noise)).astype(np.uint8),
        "has_size_angle": np.bool_(False),
    }
