"""Intrinsics: checked where the caller gave them, guessed where not; pixels to the normalised plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .epipolar import homogeneous

GUESSED_FOCAL_FACTOR = 1.2
# Removing distortion moves points a little out of the image; further out than this share of their extent, and the
# origin is no corner of it.
_OUTSIDE_SHARE = 0.1
# A coordinate beyond this comes from broken input and says nothing of the size of an image.
_LARGEST_PX = 1e6
_DISTORTION_LENGTHS = (4, 5, 8, 12, 14)
# Points of a camera whose lens shows nothing at so many of them: the coefficients are those of another model.
_NOWHERE_SHARE = 0.2
# No rectilinear lens is wider than this from its axis into the corner of the image, save for a few.
_WIDEST_PINHOLE_DEG, _FARTHEST_PERCENTILE = 55.0, 98.0
# Half the width of the difference that stands for a derivative.
_STRETCH_STEP_PX = 0.25
# The five steps that OpenCV takes unasked leave errors of a pixel in the corners of a wide lens.
_UNDISTORT_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
_UNDISTORTED_WITHIN = 1e-4  # of the focal length


@dataclass(frozen=True)
class Fisheye:
    """Distortion of OpenCV's fisheye model (``cv2.fisheye``), COLMAP's OPENCV_FISHEYE.

    The angle off the axis, theta, is seen at f theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) from the
    principal point (Kannala & Brandt, 2006). Rays at 90 degrees and more have no place on the image plane.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


Distortion = NDArray[np.float64] | Fisheye


@dataclass(frozen=True)
class Intrinsics:
    """Camera of one image.

    Attributes:
        K: (3, 3) float64, pixels.
        distortion: OpenCV coefficients (4, 5, 8, 12 or 14) of the pinhole model, those of a fisheye, or None.
        guessed: the focal length is a guess, not the caller's.
        assumption: one sentence about what was assumed, or None.
    """

    K: NDArray[np.float64]
    distortion: Distortion | None
    guessed: bool
    assumption: str | None = None

    def normalize(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) to the normalised image plane (N, 2), distortion removed; NaN where that fails."""
        if self.distortion is None and np.isfinite(points).all():
            return normalize_points(points, self.K)
        normalized = np.full(points.shape, np.nan)
        finite = np.isfinite(points).all(axis=1)
        if self.distortion is None:
            normalized[finite] = normalize_points(points[finite], self.K)
        elif not finite.any():
            return normalized
        elif isinstance(self.distortion, Fisheye):
            normalized[finite] = _undistort_fisheye(points[finite], self.K, self.distortion)
        else:
            normalized[finite] = _undistort(points[finite], self.K, self.distortion)
        return normalized

    def stretch(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Derivative (N, 2, 2) of the undistorted pixels by the pixels (N, 2); None without distortion.

        The identity in the middle of the image; NaN where a point has no place on the image plane.
        """
        if self.distortion is None:
            return None
        focal = self.K[[0, 1], [0, 1]]
        columns = []
        for step in _STRETCH_STEP_PX * np.eye(2):
            difference = self.normalize(points + step) - self.normalize(points - step)
            columns.append(difference * focal / (2.0 * _STRETCH_STEP_PX))
        return np.stack(columns, axis=2)

    def project(self, normalized: NDArray[np.float64]) -> NDArray[np.float64]:
        """Normalised points (N, 2) to pixels (N, 2) free of distortion."""
        x, y = normalized[:, 0], normalized[:, 1]
        K = self.K
        return np.stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]], axis=1)


def resolve_intrinsics(
    points1: NDArray[np.float64],
    points2: NDArray[np.float64],
    *,
    K1: Any = None,
    K2: Any = None,
    dist1: Any = None,
    dist2: Any = None,
    size1: Any = None,
    size2: Any = None,
) -> tuple[Intrinsics, Intrinsics]:
    """Intrinsics of both images from the options of the filter.

    Args:
        points1, points2: all keypoints (N, 2) of the images, pixels; their extent stands in for a missing size.
        K1, K2: (3, 3) or None; ``K1`` alone means that both images share it (and ``dist1``).
        dist1, dist2: OpenCV distortion coefficients of the pinhole model, :class:`Fisheye`, or None.
        size1, size2: (width, height) in pixels, or None; only a guess needs them.

    Raises:
        TypeError, ValueError: an option is of another type, shape or range, or one is missing that another needs.
    """
    if K1 is None and K2 is not None:
        raise ValueError("K1: expected a (3, 3) matrix, because K2 was given")
    for name, dist, needed, K in (("dist1", dist1, "K1", K1), ("dist2", dist2, "K1", K1)):
        if dist is not None and K is None:
            raise ValueError(f"{name}: distortion coefficients need {needed}")
    sizes = (_read_size(size1, "size1"), _read_size(size2, "size2"))
    if K1 is None:
        # Where no size is known, one camera is likelier than two, and the larger extent says more of it.
        shared = max(max(_box(points)[1]) for points in (points1, points2)) if sizes == (None, None) else None
        return _guess(points1, sizes[0], 1, shared), _guess(points2, sizes[1], 2, shared)
    first = Intrinsics(_read_K(K1, "K1"), _read_distortion(dist1, "dist1"), guessed=False)
    if K2 is None:
        distortion2 = first.distortion if dist2 is None else _read_distortion(dist2, "dist2")
        return first, Intrinsics(first.K, distortion2, False, "both images share K1")
    return first, Intrinsics(_read_K(K2, "K2"), _read_distortion(dist2, "dist2"), guessed=False)


def lens_doubt(camera: Intrinsics, points: NDArray[np.float64], image: int) -> str | None:
    """One sentence where the lens of a camera can hardly be meant so, or None: it shows nothing at many of the
    keypoints (N, 2) of its image, or four coefficients, legal for OpenCV's pinhole and fisheye model alike, are read as
    a pinhole's that sees further to the side than such lenses do."""
    if camera.distortion is None:
        return None
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        return None
    plain = not isinstance(camera.distortion, Fisheye) and len(camera.distortion) == 4
    advice = "if they are a fisheye's, pass Fisheye(k1, k2, k3, k4)"
    normalized = camera.normalize(finite)
    nowhere = np.isnan(normalized).any(axis=1)
    share = float(nowhere.mean())
    if share > _NOWHERE_SHARE:
        doubt = f"dist{image} shows nothing at {100.0 * share:.0f} % of the keypoints of image {image}"
        return f"{doubt}; {advice}" if plain else doubt
    farthest = float(np.percentile(np.linalg.norm(normalized[~nowhere], axis=1), _FARTHEST_PERCENTILE))
    angle_deg = float(np.degrees(np.arctan(farthest)))
    if plain and angle_deg > _WIDEST_PINHOLE_DEG:
        return (
            f"the four coefficients of dist{image} are read as a pinhole's, and keypoints of image {image} lie up to "
            f"{angle_deg:.0f}° off its axis; {advice}"
        )
    return None


def _undistort(
    points: NDArray[np.float64], K: NDArray[np.float64], coefficients: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels (N, 2) to the normalised plane (N, 2); NaN where no point of the plane is distorted to the pixel."""
    arguments = (np.ascontiguousarray(points)[:, None], K, coefficients)
    until_converged = getattr(cv2, "undistortPointsIter", None)  # OpenCV 4
    if until_converged is not None:
        normalized = until_converged(*arguments, None, None, _UNDISTORT_STEPS)
    else:
        normalized = cv2.undistortPoints(*arguments, criteria=_UNDISTORT_STEPS)
    nowhere = np.zeros(3)
    distorted, _ = cv2.projectPoints(homogeneous(normalized[:, 0]), nowhere, nowhere, K, coefficients)
    reached = np.linalg.norm(distorted[:, 0] - points, axis=1) < _UNDISTORTED_WITHIN * K[0, 0]
    return np.where(reached[:, None], normalized[:, 0], np.nan)


def _undistort_fisheye(points: NDArray[np.float64], K: NDArray[np.float64], lens: Fisheye) -> NDArray[np.float64]:
    """As :func:`_undistort`, by the fisheye model; a skew of K, which OpenCV leaves out, is taken off before."""
    seen = np.ascontiguousarray(normalize_points(points, K))[:, None]
    coefficients = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
    normalized = cv2.fisheye.undistortPoints(seen, np.eye(3), coefficients, criteria=_UNDISTORT_STEPS)
    distorted = cv2.fisheye.distortPoints(normalized, np.eye(3), coefficients)
    reached = np.linalg.norm(distorted[:, 0] - seen[:, 0], axis=1) < _UNDISTORTED_WITHIN
    return np.where(reached[:, None], normalized[:, 0], np.nan)


def _box(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Corner (2,) and (width, height) of the image that keypoints (N, 2) seem to come from."""
    usable = points[(np.abs(points) < _LARGEST_PX).all(axis=1)]
    usable = usable if len(usable) else np.zeros((1, 2))
    # Points left of or above the image say that its corner is not the origin: the middle is that of the points.
    corner = np.where(usable.min(axis=0) < -_OUTSIDE_SHARE * np.ptp(usable, axis=0), usable.min(axis=0), 0.0)
    width, height = np.max(usable, axis=0) - corner + 1.0
    return corner, (max(float(width), 1.0), max(float(height), 1.0))


def _guess(
    points: NDArray[np.float64], size: tuple[float, float] | None, image: int, longer_side: float | None
) -> Intrinsics:
    """A usual lens on an image of ``size``, or of the keypoints' extent; ``longer_side`` where both images tell it."""
    source = "the image size"
    corner = np.zeros(2)
    if size is None:
        corner, size = _box(points)
        source = "the extent of the keypoints"
    focal = GUESSED_FOCAL_FACTOR * (max(size) if longer_side is None else longer_side)
    cx, cy = corner + (np.array(size) - 1.0) / 2.0
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Intrinsics(K, None, True, f"focal length {focal:.0f} px of image {image} guessed from {source}")


def _read_numbers(value: Any, name: str, expected: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}: expected {expected} ({error})") from error
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{name}: expected {expected}, got dtype {array.dtype}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected {expected}, got NaN or infinite values")
    return array.astype(np.float64)


def _read_K(value: Any, name: str) -> NDArray[np.float64]:
    K = _read_numbers(value, name, "a (3, 3) matrix of real numbers")
    if K.shape != (3, 3):
        raise ValueError(f"{name}: expected shape (3, 3), got {K.shape}")
    if not np.allclose(K[2], [0.0, 0.0, 1.0]) or K[1, 0] != 0 or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"{name}: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0, got {K.tolist()}")
    return K


def _read_distortion(value: Any, name: str) -> Distortion | None:
    if value is None:
        return None
    if isinstance(value, Fisheye):
        numbers = _read_numbers([value.k1, value.k2, value.k3, value.k4], name, "finite coefficients of a fisheye")
        return Fisheye(*numbers.tolist())
    coefficients = _read_numbers(value, name, "distortion coefficients").ravel()
    if len(coefficients) not in _DISTORTION_LENGTHS:
        raise ValueError(f"{name}: expected 4, 5, 8, 12 or 14 coefficients, got {len(coefficients)}")
    return coefficients if np.any(coefficients) else None


def _read_size(value: Any, name: str) -> tuple[float, float] | None:
    if value is None:
        return None
    size = _read_numbers(value, name, "(width, height) in pixels")
    if size.shape != (2,) or (size < 1).any():
        raise ValueError(f"{name}: expected (width, height) of at least one pixel each, got {value!r}")
    return float(size[0]), float(size[1])


def normalize_points(points: ArrayLike, K: ArrayLike) -> NDArray[np.float64]:
    """Pixels (N, 2), OpenCV's pixel centre, to the normalised image plane by K (3, 3); K may hold a skew."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    K = np.asarray(K, dtype=np.float64)
    y = (points[:, 1] - K[1, 2]) / K[1, 1]
    x = (points[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y], axis=1)


def mean_focal_length(K1: ArrayLike, K2: ArrayLike) -> float:
    """Mean of the four focal lengths, pixels: what converts pixel thresholds to the normalised plane."""
    K1, K2 = np.asarray(K1, float), np.asarray(K2, float)
    return float((K1[0, 0] + K1[1, 1] + K2[0, 0] + K2[1, 1]) / 4.0)
