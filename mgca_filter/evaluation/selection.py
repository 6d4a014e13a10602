"""Classical tests of putative matches: what stands in front of a robust estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..data.scene_bundle import ScenePair
from .methods import BoolArray, FloatArray


@dataclass(frozen=True)
class Selection:
    """Classical test of putative matches.

    Attributes:
        mutual: keep two-way nearest neighbours only.
        max_ratio: keep matches whose distance ratio is below this (Lowe, IJCV 2004); None = no ratio test.
        gms: keep what grid-based motion statistics keep (Bian et al., CVPR 2017; ``cv2.xfeatures2d.matchGMS``).
        adalam: keep what AdaLAM keeps (Cavalli et al., ECCV 2020; kornia).
    """

    mutual: bool = False
    max_ratio: float | None = None
    gms: bool = False
    adalam: bool = False

    @property
    def parts(self) -> list[str]:
        """Words of the row's name; empty where every nearest neighbour is kept."""
        ratio = [] if self.max_ratio is None else [f"ratio {self.max_ratio:g}"]
        return ["mutual"] * self.mutual + ratio + ["GMS"] * self.gms + ["AdaLAM"] * self.adalam

    def settings(self) -> dict[str, Any]:
        """Options and versions of the libraries used, for the key of stored results.

        Raises:
            ImportError: a package that a test needs is not installed.
        """
        settings: dict[str, Any] = {"mutual": self.mutual, "max_ratio": self.max_ratio, "gms": self.gms}
        if self.adalam:
            settings["adalam"] = adalam_versions()
        return settings

    def apply(self, pair: ScenePair) -> BoolArray:
        """Bool (M,), True for the matches kept. A match of unknown ratio does not pass a ratio test."""
        kept = np.ones(len(pair.points1), dtype=bool)
        if self.mutual:
            kept &= pair.mutual
        if self.max_ratio is not None:
            ratio = pair.attributes.ratio
            if ratio is None:
                raise ValueError("a ratio test needs the distance ratios of the matches")
            kept &= ratio < self.max_ratio
        if self.gms:
            kept &= _motion_statistics(pair)
        if self.adalam:
            kept &= locally_affine_matches(pair)
        return kept


def _motion_statistics(pair: ScenePair) -> BoolArray:
    """Matches (M,) that OpenCV's GMS keeps, at its defaults (no rotation, no scale, threshold factor 6).

    Matches with a point outside its image are rejected: removing the distortion moves points there, and GMS would
    write past the end of its grid.
    """
    rows = np.flatnonzero(_inside_image(pair.points1, pair.image_size1) & _inside_image(pair.points2, pair.image_size2))
    convert: Any = cv2.KeyPoint.convert  # takes arrays, which its annotation does not know
    keypoints1, keypoints2 = (convert(points[rows].astype(np.float32)) for points in (pair.points1, pair.points2))
    matches = [cv2.DMatch(i, i, 0.0) for i in range(len(rows))]
    found = cv2.xfeatures2d.matchGMS(pair.image_size1, pair.image_size2, keypoints1, keypoints2, matches)
    kept = np.zeros(len(pair.points1), dtype=bool)
    kept[rows[[match.queryIdx for match in found]]] = True
    return kept


def _inside_image(points: FloatArray, size: tuple[int, int]) -> BoolArray:
    """Bool (N,), True for pixels (N, 2) between the centres of the first and the last pixel."""
    return np.asarray(np.all((points >= 0) & (points <= np.array(size) - 1.0), axis=1))


def adalam_versions() -> dict[str, str]:
    """Versions of the packages that AdaLAM needs.

    Raises:
        ImportError: kornia or torch is not installed.
    """
    import kornia
    import torch

    return {"kornia": kornia.__version__, "torch": torch.__version__}


def locally_affine_matches(pair: ScenePair) -> BoolArray:
    """Matches (M,) that AdaLAM (Cavalli et al., ECCV 2020) keeps, by kornia at its defaults and on one thread.

    It wants unfiltered nearest neighbours with their ratio. Seeds are mutual matches, scored by the squared ratio as
    in kornia's own matcher. Where a keypoint's size or angle is unknown, that consistency is not asked for.

    Raises:
        ValueError: the pair has no ratios.
    """
    import torch
    from kornia.feature.adalam.adalam import AdalamFilter, get_adalam_default_config

    attributes, count = pair.attributes, len(pair.points1)
    if attributes.ratio is None:
        raise ValueError("AdaLAM needs the distance ratios of the matches")
    if count == 0:
        return np.zeros(0, dtype=bool)

    def tensor(values: Any) -> Any:
        return None if values is None else torch.as_tensor(np.asarray(values, dtype=np.float32))

    config: Any = get_adalam_default_config()
    if attributes.size1 is None or attributes.size2 is None:
        config["scale_rate_threshold"] = None
    if attributes.angle1 is None or attributes.angle2 is None:
        config["orientation_difference_threshold"] = None
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        found = AdalamFilter(config).filter_matches(
            tensor(pair.points1),
            tensor(pair.points2),
            torch.arange(count),
            tensor(np.square(np.where(np.isfinite(attributes.ratio), attributes.ratio, 1.0))),
            torch.as_tensor(pair.mutual),
            pair.image_size1,
            pair.image_size2,
            tensor(attributes.angle1),
            tensor(attributes.angle2),
            tensor(attributes.size1),
            tensor(attributes.size2),
        )
    finally:
        torch.set_num_threads(threads)
    kept = np.zeros(count, dtype=bool)
    kept[np.asarray(found)[:, 0]] = True
    return kept
