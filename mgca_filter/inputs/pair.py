"""One pair of images as the filter sees it: read, checked and normalised."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.cameras import Intrinsics, mean_focal_length, resolve_intrinsics
from ..types import MatchesLike, MatrixLike, PointsLike, SizeLike
from .attributes import MatchAttributes
from .keypoints import Keypoints, read_keypoints
from .matches import PutativeMatches, read_matches

# Normalised coordinates beyond this (89.9 degrees off the axis) come from broken input, not from a lens.
_MAX_NORMALIZED = 1e3


@dataclass(frozen=True)
class MatchPair:
    """Everything that the caller knows of one pair of images; fields as the arguments of :func:`filter_matches`."""

    kp1: PointsLike
    kp2: PointsLike
    matches: MatchesLike | None
    K1: MatrixLike | None = None
    K2: MatrixLike | None = None
    dist1: ArrayLike | None = None
    dist2: ArrayLike | None = None
    size1: SizeLike | None = None
    size2: SizeLike | None = None
    attributes: MatchAttributes | None = None


@dataclass(frozen=True)
class PairInput:
    """Matches of a pair, M rows in the order of the input.

    Attributes:
        matches: what the caller passed, read.
        points1, points2: (M, 2) float64 pixels as they came in, NaN where a row holds no match.
        correspondences: (M, 4) float64, normalised; NaN where a row has no usable coordinates.
        valid: (M,) bool, rows with usable coordinates.
        attributes: (M, 8) float32, encoded.
        intrinsics1, intrinsics2: cameras, given or guessed.
    """

    matches: PutativeMatches
    points1: NDArray[np.float64]
    points2: NDArray[np.float64]
    correspondences: NDArray[np.float64]
    valid: NDArray[np.bool_]
    attributes: NDArray[np.float32]
    intrinsics1: Intrinsics
    intrinsics2: Intrinsics

    @property
    def calibrated(self) -> bool:
        """The caller gave the intrinsics."""
        return not self.intrinsics1.guessed

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return mean_focal_length(self.intrinsics1.K, self.intrinsics2.K)

    def pixels(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Undistorted pixels (K, 2), (K, 2) of a selection of matches."""
        selected = self.correspondences[rows]
        return self.intrinsics1.project(selected[:, :2]), self.intrinsics2.project(selected[:, 2:])


def prepare_pair(pair: MatchPair) -> PairInput:
    """Read everything that the caller knows of a pair.

    Raises:
        TypeError, ValueError: a field is of another type, shape, length or range.
    """
    keypoints1, keypoints2 = read_keypoints(pair.kp1, "kp1"), read_keypoints(pair.kp2, "kp2")
    putative = read_matches(pair.matches, len(keypoints1), len(keypoints2))
    cameras = {name: getattr(pair, name) for name in ("K1", "K2", "dist1", "dist2", "size1", "size2")}
    intrinsics1, intrinsics2 = resolve_intrinsics(keypoints1.points, keypoints2.points, **cameras)
    present = (putative.index1 >= 0)[:, None]
    if present.any():
        ends = [
            np.where(present, points[index], np.nan)
            for points, index in (
                (keypoints1.points, putative.index1),
                (keypoints2.points, putative.index2),
                (intrinsics1.normalize(keypoints1.points), putative.index1),
                (intrinsics2.normalize(keypoints2.points), putative.index2),
            )
        ]
    else:
        ends = [np.full((len(putative), 2), np.nan)] * 4
    correspondences = np.hstack(ends[2:])
    with np.errstate(invalid="ignore"):
        valid = (np.abs(correspondences) < _MAX_NORMALIZED).all(axis=1)
    known = _merge_attributes(putative, keypoints1, keypoints2, pair.attributes)
    return PairInput(
        putative, ends[0], ends[1], correspondences, valid, known.encode(len(putative)), intrinsics1, intrinsics2
    )


def _merge_attributes(
    matches: PutativeMatches, keypoints1: Keypoints, keypoints2: Keypoints, given: MatchAttributes | None
) -> MatchAttributes:
    """What matches and keypoints know, overridden by what the caller gave field by field."""
    values: dict[str, Any] = {"ratio": matches.ratio, "best": matches.best}
    present = matches.index1 >= 0
    for name, keypoints, index in (("1", keypoints1, matches.index1), ("2", keypoints2, matches.index2)):
        if keypoints.size is not None and keypoints.angle is not None and len(keypoints):
            values["size" + name] = np.where(present, keypoints.size[index], np.float32(np.nan))
            values["angle" + name] = np.where(present, keypoints.angle[index], np.float32(np.nan))
    if given is not None:
        if not isinstance(given, MatchAttributes):
            raise TypeError(f"attributes: expected MatchAttributes, got {type(given).__name__}")
        for field in fields(given):
            value = getattr(given, field.name)
            if value is not None:
                values[field.name] = _read_attribute(value, field.name, len(matches))
    return MatchAttributes(**values)


def _read_attribute(value: Any, name: str, count: int) -> NDArray[Any]:
    array = np.asarray(value)
    allowed = "b" if name == "best" else "iuf"
    if array.dtype.kind not in allowed:
        expected = "bool" if name == "best" else "real numbers"
        raise TypeError(f"attributes.{name}: expected {expected}, got dtype {array.dtype}")
    if array.shape != (count,):
        raise ValueError(f"attributes.{name}: expected shape ({count},) like the matches, got {array.shape}")
    return array if name == "best" else array.astype(np.float32)
