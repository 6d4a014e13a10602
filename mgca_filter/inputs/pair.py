"""One pair of images as the filter sees it: read, checked and normalised."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.cameras import Fisheye, Intrinsics, lens_doubt, mean_focal_length, resolve_intrinsics
from ..geometry.epipolar import sampson_distance
from ..types import MatchesLike, MatrixLike, PointsLike, SizeLike
from .attributes import MatchAttributes
from .keypoints import Keypoints, read_keypoints
from .matches import PutativeMatches, read_matches
from .options import check_number

# Coordinates are taken for pixels unless both the focal length and the extent of the keypoints are smaller than any
# camera's, as where the caller normalised the points or measures in millimetres on the sensor. Without a focal length
# the extent alone must be that of normalised points.
_LEAST_FOCAL_PX, _LEAST_EXTENT_PX, _LEAST_EXTENT_ALONE_PX = 100.0, 50.0, 10.0
# Then a pixel is this part of the focal length, or of the extent.
_USUAL_PIXELS = 1000.0
# A threshold above this part of the focal length or extent is meant in pixels all the same.
_LARGEST_THRESHOLD_SHARE = 0.01
# Images of one camera differ no more than this in size, unless one of them was resized, cropped or turned.
_SAME_SIZE_SHARE = 0.01
# Normalised coordinates beyond this (89.9 degrees off the axis) come from broken input, not from a lens.
_MAX_NORMALIZED = 1e3


@dataclass(frozen=True)
class MatchPair:
    """Everything that the caller knows of one pair of images; fields as the arguments of :func:`filter_matches`.

    ``resolution``: pixels of the original per pixel of the image in which the keypoints were found; larger than 1 where
    they were found in a smaller copy.

    ``stretch1``, ``stretch2``: of keypoints that were freed of distortion before, the derivatives (N, 2, 2) of the
    undistorted pixels by the pixels as they were found, NaN where unknown: the threshold is then in pixels of the
    distorted images. What ``dist1`` and ``dist2`` say has precedence.
    """

    kp1: PointsLike
    kp2: PointsLike
    matches: MatchesLike | None
    K1: MatrixLike | None = None
    K2: MatrixLike | None = None
    dist1: ArrayLike | Fisheye | None = None
    dist2: ArrayLike | Fisheye | None = None
    size1: SizeLike | None = None
    size2: SizeLike | None = None
    attributes: MatchAttributes | None = None
    resolution: float = 1.0
    stretch1: ArrayLike | None = None
    stretch2: ArrayLike | None = None


@dataclass(frozen=True)
class PairInput:
    """Matches of a pair, M rows in the order of the input.

    Attributes:
        matches: what the caller passed, read.
        points1, points2: (M, 2) float64 pixels as they came in, NaN where a row holds no match.
        correspondences: (M, 4) float64, normalised; NaN where a row has no usable coordinates.
        valid: (M,) bool, rows with usable coordinates.
        attributes: (M, 8) float32, encoded.
        order: (M,) float64, ascending = promising: the ratio where it is known, else the descriptor distance; NaN where
            neither is.
        noise: (M,) float64, of the position of each match, by the sizes of its keypoints; 1 = usual in this list.
        intrinsics1, intrinsics2: cameras, given or guessed, in pixels.
        unit_px: pixels to a unit of the caller's coordinates, pixels being those of the image in which the keypoints
            were found: 1; of a smaller copy 1 / ``resolution``; where the coordinates are normalised or millimetres,
            the number that makes pixels of them.
        largest_threshold: a threshold above this is in those pixels already, whatever the unit.
        assumptions: sentences on what was assumed.
        stretch1, stretch2: (M, 2, 2) derivatives of the undistorted pixels by the pixels that were found; None where
            lenses distort nothing.
    """

    matches: PutativeMatches
    points1: NDArray[np.float64]
    points2: NDArray[np.float64]
    correspondences: NDArray[np.float64]
    valid: NDArray[np.bool_]
    attributes: NDArray[np.float32]
    order: NDArray[np.float64]
    noise: NDArray[np.float64]
    intrinsics1: Intrinsics
    intrinsics2: Intrinsics
    unit_px: float = 1.0
    largest_threshold: float = 0.0
    assumptions: tuple[str, ...] = ()
    stretch1: NDArray[np.float64] | None = None
    stretch2: NDArray[np.float64] | None = None

    @property
    def calibrated(self) -> bool:
        """The caller gave the intrinsics."""
        return not self.intrinsics1.guessed

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return mean_focal_length(self.intrinsics1.K, self.intrinsics2.K)

    def with_focals(self, factor1: float, factor2: float) -> PairInput:
        """The pair under the guessed focal lengths times factors, one an image, taken for the truth from now on."""
        cameras = []
        for camera, factor in ((self.intrinsics1, factor1), (self.intrinsics2, factor2)):
            K = camera.K.copy()
            K[:2, :2] *= factor
            cameras.append(replace(camera, K=K, guessed=False))
        correspondences = self.correspondences / np.repeat([factor1, factor2], 2)
        return replace(self, correspondences=correspondences, intrinsics1=cameras[0], intrinsics2=cameras[1])

    def epipolar_distance_px(
        self, rows: NDArray[np.intp] | NDArray[np.bool_], E: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Sampson distance (K,) of a selection of matches to E (3, 3), in pixels as they were found.

        Through a lens the derivative of the lens counts: near the rim of a fisheye a pixel is a long way on the image
        plane.
        """
        stretch1, stretch2 = (None if s is None else s[rows] for s in (self.stretch1, self.stretch2))
        return sampson_distance(self.correspondences[rows], E, stretch1, stretch2) * self.focal_px

    def threshold_px(self, threshold: float) -> float:
        """The caller's threshold in pixels of the image in which the keypoints were found."""
        return threshold if threshold > self.largest_threshold else threshold * self.unit_px

    def fundamental_in_units(self, F: NDArray[np.float64]) -> NDArray[np.float64]:
        """F (3, 3) for pixels as one for the caller's coordinates, of unit Frobenius norm."""
        if self.unit_px == 1.0:
            return F
        unit = np.diag([self.unit_px, self.unit_px, 1.0])
        F = unit @ F @ unit
        return np.asarray(F / np.linalg.norm(F), dtype=np.float64)

    def homography_in_units(self, H: NDArray[np.float64]) -> NDArray[np.float64]:
        """H (3, 3) for pixels as one for the caller's coordinates, scaled to H[2, 2] = 1 where that is not zero."""
        unit = np.diag([self.unit_px, self.unit_px, 1.0])
        H = np.linalg.inv(unit) @ H @ unit
        return np.asarray(H / H[2, 2] if abs(H[2, 2]) > 1e-12 else H, dtype=np.float64)

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
    _check_shared_camera(pair)
    given1, given2 = resolve_intrinsics(keypoints1.points, keypoints2.points, **cameras)
    extent = max(_extent(keypoints1.points), _extent(keypoints2.points))
    resolution = check_number(pair.resolution, "resolution", 0.0, float("inf"))
    unit_px, yardstick = _pixels_per_unit(given1, given2, extent)
    in_pixels = unit_px == 1.0
    if in_pixels:
        unit_px = 1.0 / resolution
    points1, points2 = keypoints1.points * unit_px, keypoints2.points * unit_px
    if unit_px == 1.0:
        intrinsics1, intrinsics2 = given1, given2
    elif given1.guessed and not in_pixels:
        intrinsics1, intrinsics2 = resolve_intrinsics(points1, points2)
    else:
        zoom = np.diag([unit_px, unit_px, 1.0])
        intrinsics1, intrinsics2 = (replace(camera, K=zoom @ camera.K) for camera in (given1, given2))
    assumptions = [camera.assumption for camera in (intrinsics1, intrinsics2) if camera.assumption]
    if in_pixels and resolution != 1.0:
        assumptions.append(
            f"thresholds are in pixels of the image in which the keypoints were found, {resolution:.3g} of K's to one"
        )
    if not in_pixels:
        assumptions.append(
            f"coordinates are no pixels, they extend over {extent:.3g}: thresholds are those of an image in which "
            f"{yardstick:.3g} is {_USUAL_PIXELS:g} pixels"
        )
    assumptions += [
        f"the principal point of K{i} lies outside of image {i}: is it the K of another size?"
        for i, camera, size in ((1, given1, pair.size1), (2, given2, pair.size2))
        if not camera.guessed and size is not None and not _inside(camera.K[:2, 2], size)
    ]
    for i, camera, points in ((1, given1, keypoints1.points), (2, given2, keypoints2.points)):
        doubt = lens_doubt(camera, points, i)
        if doubt is not None:
            assumptions.append(doubt)
    present = (putative.index1 >= 0)[:, None]
    if present.any():
        ends = [
            points.take(index, axis=0) if present.all() else np.where(present, points[index], np.nan)
            for points, index in (
                (keypoints1.points, putative.index1),
                (keypoints2.points, putative.index2),
                (intrinsics1.normalize(points1), putative.index1),
                (intrinsics2.normalize(points2), putative.index2),
            )
        ]
    else:
        ends = [np.full((len(putative), 2), np.nan)] * 4
    correspondences = np.hstack(ends[2:])
    with np.errstate(invalid="ignore"):
        valid = (np.abs(correspondences) < _MAX_NORMALIZED).all(axis=1)
    known = _merge_attributes(putative, keypoints1, keypoints2, pair.attributes)
    return PairInput(
        putative,
        ends[0],
        ends[1],
        correspondences,
        valid,
        known.encode(len(putative)),
        _order(known, putative),
        known.relative_noise(valid),
        intrinsics1,
        intrinsics2,
        unit_px,
        0.0 if in_pixels else _LARGEST_THRESHOLD_SHARE * yardstick,
        tuple(assumptions),
        _stretch_of_matches(pair.stretch1, "stretch1", intrinsics1, points1, putative.index1),
        _stretch_of_matches(pair.stretch2, "stretch2", intrinsics2, points2, putative.index2),
    )


def _stretch_of_matches(
    given: ArrayLike | None,
    name: str,
    camera: Intrinsics,
    points: NDArray[np.float64],
    index: NDArray[np.intp],
) -> NDArray[np.float64] | None:
    """Derivatives (M, 2, 2) of the undistorted pixels of each match by those that were found; None without distortion.

    Where the derivative is not known, that of no distortion stands.
    """
    stretch = camera.stretch(points)
    if stretch is None:
        if given is None:
            return None
        stretch = np.asarray(given, dtype=np.float64)
        if stretch.shape != (len(points), 2, 2):
            raise ValueError(f"{name}: expected shape ({len(points)}, 2, 2) like the keypoints, got {stretch.shape}")
    if len(points) == 0:
        return np.tile(np.eye(2), (len(index), 1, 1))
    of_matches = stretch[index]
    known = np.isfinite(of_matches).all(axis=(1, 2), keepdims=True)
    return np.where(known, of_matches, np.eye(2))


def _order(known: MatchAttributes, matches: PutativeMatches) -> NDArray[np.float64]:
    """What tells promising matches (M,) from others without a network, ascending; NaN where nothing does."""
    if known.ratio is not None and np.isfinite(known.ratio).any():
        return np.asarray(known.ratio, dtype=np.float64)
    return np.full(len(matches), np.nan) if matches.distance is None else matches.distance


def _check_shared_camera(pair: MatchPair) -> None:
    """Raise ValueError where one K is to be right for images of different size."""
    if pair.K1 is None or pair.K2 is not None or pair.size1 is None or pair.size2 is None:
        return
    size1, size2 = np.ravel(pair.size1), np.ravel(pair.size2)
    if size1.shape != size2.shape or size1.dtype.kind not in "iuf" or size2.dtype.kind not in "iuf":
        return  # what is wrong with them is said when they are read
    if (np.abs(size1 - size2) > _SAME_SIZE_SHARE * np.maximum(size1, size2)).any():
        words = " and ".join("x".join(f"{side:g}" for side in size) for size in (size1, size2))
        raise ValueError(f"K2: one K cannot be right for images of {words} pixels; give K1 and K2, one for each")


def _extent(points: NDArray[np.float64]) -> float:
    """The longer side of the box around the finite points."""
    finite = points if np.isfinite(points).all() else points[np.isfinite(points).all(axis=1)]
    return max(float(np.ptp(column)) for column in finite.T) if len(finite) else 0.0


def _pixels_per_unit(intrinsics1: Intrinsics, intrinsics2: Intrinsics, extent: float) -> tuple[float, float]:
    """How many pixels a unit of the coordinates is, and the length, in units, that is taken for 1000 pixels."""
    if intrinsics1.guessed:
        if 0.0 < extent < _LEAST_EXTENT_ALONE_PX:
            return _USUAL_PIXELS / extent, extent
        return 1.0, _USUAL_PIXELS
    focal = mean_focal_length(intrinsics1.K, intrinsics2.K)
    if focal < _LEAST_FOCAL_PX and extent < _LEAST_EXTENT_PX:
        return _USUAL_PIXELS / focal, focal
    return 1.0, _USUAL_PIXELS


def _inside(point: NDArray[np.float64], size: SizeLike) -> bool:
    return bool((point > 0).all() and (point < np.ravel(np.asarray(size, dtype=np.float64)) - 1.0).all())


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
