"""What a method of the scoreboard is: a pair of images in, a pose and two decisions per match out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene_bundle import ScenePair

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MIN_MATCHES = 5


@dataclass(frozen=True)
class PoseEstimate:
    """Answer of a robust estimator on N matches: ``R`` (3, 3) and unit ``t`` (3,) or None, bool ``inliers`` (N,).

    ``failure`` is empty, or says in a few words why there is no pose.
    """

    R: FloatArray | None
    t: FloatArray | None
    inliers: BoolArray
    failure: str = ""

    @classmethod
    def failed(cls, count: int, reason: str) -> PoseEstimate:
        """No pose and no inlier among ``count`` matches."""
        return cls(None, None, np.zeros(count, dtype=bool), reason)


@dataclass(frozen=True)
class Answer:
    """What a method says about one pair with M putative matches.

    Attributes:
        R, t: (3, 3) and (3,), ``X2 = R X1 + t``, or None where the method has no pose.
        kept: bool (M,), the decision before the robust fit: a rival's selection, the network's logit > 0.
        mask: bool (M,), the decision after it: what a user gets.
        failure: empty, or why there is no pose.
    """

    R: FloatArray | None
    t: FloatArray | None
    kept: BoolArray
    mask: BoolArray
    failure: str = ""


class Method(Protocol):
    """One row of the scoreboard; picklable, since worker processes run it."""

    @property
    def name(self) -> str:
        """The row's name, from which :func:`registry.parse_method` builds the method again."""

    @property
    def seeded(self) -> bool:
        """Whether the answer depends on ``seed``; the others are run once."""

    def settings(self) -> dict[str, Any]:
        """All that the answers depend on besides the data: options, library versions, hashes. JSON values only."""

    def run(self, pair: ScenePair, seed: int) -> Answer:
        """Answer for one pair; what it raises is counted as a failure of the pair."""


@dataclass(frozen=True)
class Selection:
    """Classical test of putative matches.

    Attributes:
        mutual: keep two-way nearest neighbours only.
        max_ratio: keep matches whose distance ratio is below this (Lowe, IJCV 2004); None = no ratio test.
        gms: keep what grid-based motion statistics keep (Bian et al., CVPR 2017; ``cv2.xfeatures2d.matchGMS``).
    """

    mutual: bool = False
    max_ratio: float | None = None
    gms: bool = False

    @property
    def parts(self) -> list[str]:
        """Words of the row's name; empty where every nearest neighbour is kept."""
        ratio = [] if self.max_ratio is None else [f"ratio {self.max_ratio:g}"]
        return ["mutual"] * self.mutual + ratio + ["GMS"] * self.gms

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


@dataclass(frozen=True)
class PairOutcome:
    """Result of one method on one pair, as it is stored.

    Attributes:
        pair: index of the pair in its bundle.
        error_deg: pose error; 180 where there is no pose.
        rotation_deg, translation_deg: its two parts; None where there is no pose.
        kept, mask: (precision, recall, F) of the decision before and after the robust fit, all matches counted.
        elapsed_ms, cpu_ms: wall-clock and processor time of filter and estimator.
        failure: empty, or why there is no pose; ``error: …`` where the method raised.
        busy: other programs were using the machine, so that ``elapsed_ms`` says little.
        machine: the processor's name.
    """

    pair: int
    error_deg: float
    rotation_deg: float | None
    translation_deg: float | None
    kept: tuple[float, float, float]
    mask: tuple[float, float, float]
    elapsed_ms: float
    cpu_ms: float
    failure: str = ""
    busy: bool = False
    machine: str = field(default="", compare=False)
