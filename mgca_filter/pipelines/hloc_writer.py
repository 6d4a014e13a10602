"""New hloc files from features and rows; the layout is described in ``hloc``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import h5py
import numpy as np

from .worker import FAILED, ImageFeatures, PairRow


def write_features(path: Path, names: Sequence[str], read: Callable[[str], ImageFeatures | None]) -> None:
    """Keypoints, scales, orientations (degrees), descriptors and image size of each image that has features."""
    with h5py.File(path, "w") as file:
        for name in names:
            image = read(name)
            if image is None or image.size is None or image.angle is None or image.descriptors is None:
                continue
            group = file.create_group(name)
            group["keypoints"] = image.points.astype(np.float32)
            group["scales"], group["oris"] = image.size / 2, image.angle
            group["descriptors"] = np.ascontiguousarray(image.descriptors.T)
            group["image_size"] = np.array(image.image_size)


def write_matches(path: Path, read: Callable[[str], ImageFeatures | None], rows: Iterable[PairRow]) -> None:
    """Kept matches and their scores of each pair, in the new layout; failed pairs are left out."""
    with h5py.File(path, "w") as file:
        for row in rows:
            image = None if row.status == FAILED else read(row.name1)
            if image is None:
                continue
            count = len(image.points)
            partner, scores = np.full(count, -1, np.int32), np.zeros(count, np.float16)
            partner[row.kept[:, 0]] = row.kept[:, 1]
            scores[row.kept[:, 0]] = row.scores
            group = file.create_group("/".join(name.replace("/", "-") for name in (row.name1, row.name2)))
            group["matches0"], group["matching_scores0"] = partner, scores
