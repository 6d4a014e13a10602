"""Detect, match, attributes: from two images to their putative matches and all that is known of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from .inputs.attributes import MatchAttributes, best_of_list, distance_ratio
from .inputs.matches import read_matches

DETECTORS = ("sift", "rootsift", "orb", "akaze", "brisk")
DEFAULT_DETECTOR = "rootsift"
DEFAULT_FEATURE_COUNT = 4000
"""What images are matched with unless the caller says otherwise; data sets with truth keep plain SIFT."""

DETECTOR_MAX_SIDE_PX = 1200
SIFT_FEATURE_COUNT = 2000
SIFT_CONTRAST_THRESHOLD = 1e-5
FEATURE_SETTINGS = f"sift {SIFT_FEATURE_COUNT}, revision 1, opencv {cv2.__version__}"
"""Part of the digest of whatever is kept that was detected and matched here with the default detector."""

# In a narrower strip OpenCV's detectors find nothing, and some of them fail.
_NARROWEST_PX = 6

# Descriptors of image 1 at a time: a block of distances to 8000 others is 8 MB.
_BLOCK = 256


class Detector(Protocol):
    """What is used of a ``cv2.Feature2D``."""

    def detectAndCompute(
        self, image: NDArray[Any], mask: NDArray[Any] | None
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[Any]]:
        """Keypoints and their descriptors (N, D), None where there are no keypoints."""

    def defaultNorm(self) -> int:
        """``cv2.NORM_*`` of the distance between descriptors."""


@dataclass(frozen=True)
class ImageFeatures:
    """What is known of one image with N keypoints.

    Attributes:
        points: (N, 2) pixels, OpenCV's convention; free of distortion where ``K`` is known. A point is NaN where the
            camera model gives none.
        size, angle: (N,) diameters in pixels and orientations in degrees, or None.
        descriptors: (N, D), or None.
        K: (3, 3) intrinsics, or None.
        image_size: (width, height) in pixels, or None.
        resolution: pixels of the image per pixel of the copy in which the keypoints were found.
        stretch: (N, 2, 2) derivatives of ``points`` by the distorted pixels that they were found at, or None.
    """

    points: NDArray[Any]
    size: NDArray[Any] | None = None
    angle: NDArray[Any] | None = None
    descriptors: NDArray[Any] | None = None
    K: NDArray[np.float64] | None = None
    image_size: tuple[int, int] | None = None
    resolution: float = 1.0
    stretch: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: NDArray[np.intp]) -> ImageFeatures:
        """The keypoints of the given rows (n,) alone."""
        size, angle, descriptors, stretch = (
            None if field is None else field[rows] for field in (self.size, self.angle, self.descriptors, self.stretch)
        )
        points = self.points[rows]
        return replace(self, points=points, size=size, angle=angle, descriptors=descriptors, stretch=stretch)


@dataclass(frozen=True)
class OneWayMatches:
    """Nearest neighbour in image 2 of each of M keypoints of image 1, no test applied.

    Attributes:
        index1, index2: (M,) rows of the two images' features; ``index1`` is 0, 1, 2, ….
        attributes: what the matcher and the keypoints know of each match.
        mutual: bool (M,), nearest both ways.
    """

    index1: NDArray[np.intp]
    index2: NDArray[np.intp]
    attributes: MatchAttributes
    mutual: NDArray[np.bool_]


@dataclass(frozen=True)
class RootSift:
    """SIFT with descriptors of which the Euclidean distance is the Hellinger distance of SIFT's.

    Relja Arandjelović and Andrew Zisserman, "Three things everyone should know to improve object retrieval",
    CVPR 2012.
    """

    sift: cv2.Feature2D

    def detectAndCompute(
        self, image: NDArray[Any], mask: NDArray[Any] | None
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[Any]]:
        """SIFT's keypoints, and descriptors (N, 128) float32 of unit norm; None where there are no keypoints."""
        keypoints, descriptors = self.sift.detectAndCompute(image, mask)
        return keypoints, descriptors if descriptors is None else root_sift(descriptors)

    def defaultNorm(self) -> int:
        """``cv2.NORM_L2``."""
        return cv2.NORM_L2


@dataclass(frozen=True)
class Strongest:
    """The ``count`` keypoints of largest response, of a detector that cannot be told how many are wanted."""

    detector: cv2.Feature2D
    count: int

    def detectAndCompute(
        self, image: NDArray[Any], mask: NDArray[Any] | None
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[Any]]:
        """The keypoints in the detector's order, and their descriptors (N, D); None where there are none."""
        keypoints, descriptors = self.detector.detectAndCompute(image, mask)
        if len(keypoints) <= self.count:
            return keypoints, descriptors
        response = np.array([keypoint.response for keypoint in keypoints])
        rows = np.sort(np.argsort(-response, kind="stable")[: self.count])
        return [keypoints[row] for row in rows], descriptors[rows]

    def defaultNorm(self) -> int:
        """The detector's own."""
        return self.detector.defaultNorm()


def root_sift(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    """Square roots of SIFT descriptors (N, D) that were divided by their sum: unit norm, and zero where all are."""
    total = np.sum(descriptors, axis=1, keepdims=True, dtype=np.float32)
    root: NDArray[np.float32] = np.sqrt(descriptors / np.maximum(total, np.finfo(np.float32).tiny), dtype=np.float32)
    return root


def create_detector(name: str = "sift", feature_count: int = SIFT_FEATURE_COUNT) -> Detector:
    """Make a detector by its name, one of :data:`DETECTORS`.

    SIFT comes with the settings that the training data used, a contrast threshold low enough to fill
    ``feature_count`` on plain walls as well; ``"rootsift"`` differs in the descriptors alone.

    Raises:
        ValueError: another name, or a feature count below 1.
    """
    if feature_count < 1:
        raise ValueError(f"feature_count: expected at least 1, got {feature_count}")
    if name in ("sift", "rootsift"):
        sift = cv2.SIFT.create(nfeatures=feature_count, contrastThreshold=SIFT_CONTRAST_THRESHOLD)
        return sift if name == "sift" else RootSift(sift)
    if name == "orb":
        return cv2.ORB.create(nfeatures=feature_count)
    # OpenCV 5 moved AKAZE and BRISK to the contrib module.
    if name == "akaze":
        akaze: type[cv2.xfeatures2d.AKAZE] = getattr(cv2, "AKAZE", None) or cv2.xfeatures2d.AKAZE
        return akaze.create(max_points=feature_count)
    if name == "brisk":
        brisk: type[cv2.xfeatures2d.BRISK] = getattr(cv2, "BRISK", None) or cv2.xfeatures2d.BRISK
        return Strongest(brisk.create(), feature_count)
    raise ValueError(f"detector: expected {', '.join(DETECTORS)} or a cv2.Feature2D, got {name!r}")


def detector_resolution(image_size: tuple[int, int], max_side_px: int = DETECTOR_MAX_SIDE_PX) -> float:
    """Pixels of an image (width, height) per pixel of the copy that :func:`detect_keypoints` looks at; 1 or more."""
    return max(1.0, max(image_size) / max_side_px)


def detect_keypoints(
    image: NDArray[Any], detector: Detector, name: str = "image", max_side_px: int = DETECTOR_MAX_SIDE_PX
) -> tuple[list[cv2.KeyPoint], NDArray[Any]]:
    """Detect and describe on a grey copy of at most ``max_side_px``, in pixels of the original.

    Args:
        image: uint8 (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA.
        detector: of :func:`create_detector`, or any ``cv2.Feature2D`` that describes.
        name: name of the argument, for messages.
        max_side_px: longer side of the image that the detector sees; larger ones shrink by area averages.

    Returns:
        Keypoints with positions and sizes in pixels of ``image``, and descriptors (N, D); no keypoints and
        an empty (0, 0) array when nothing is found.

    Raises:
        TypeError: ``image`` is not a uint8 array, or ``detector`` does not describe. ValueError: ``image`` has not the
            shape of an image.
    """
    grey = _grey(image, name)
    scale = min(1.0, max_side_px / max(grey.shape))
    if scale < 1.0:
        width, height = (max(1, round(side * scale)) for side in (grey.shape[1], grey.shape[0]))
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    else:
        small = grey
    nothing: tuple[list[cv2.KeyPoint], NDArray[Any]] = [], np.zeros((0, 0), dtype=np.float32)
    if min(small.shape) < _NARROWEST_PX:
        return nothing
    try:
        keypoints, descriptors = detector.detectAndCompute(small, None)
    except cv2.error as error:
        if error.code != cv2.Error.StsNotImplemented:
            raise
        raise TypeError(f"detector: expected one that describes, got {type(detector).__name__}") from error
    if descriptors is None or len(keypoints) == 0:
        return nothing
    scale_x, scale_y = small.shape[1] / grey.shape[1], small.shape[0] / grey.shape[0]
    return [_rescaled(k, scale_x, scale_y) for k in keypoints], descriptors


def _rescaled(keypoint: cv2.KeyPoint, scale_x: float, scale_y: float) -> cv2.KeyPoint:
    """The keypoint in the original: pixels are areas, so the half pixel at the border scales as well."""
    if scale_x == 1.0 and scale_y == 1.0:
        return keypoint
    x, y = keypoint.pt
    return cv2.KeyPoint(
        (x + 0.5) / scale_x - 0.5,
        (y + 0.5) / scale_y - 0.5,
        keypoint.size / (scale_x * scale_y) ** 0.5,
        keypoint.angle,
        keypoint.response,
        keypoint.octave,
        keypoint.class_id,
    )


def _grey(image: Any, name: str) -> NDArray[np.uint8]:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        got = f"dtype {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise TypeError(f"{name}: expected a uint8 image array, got {got}")
    if image.ndim not in (2, 3) or min(image.shape[:2]) == 0 or (image.ndim == 3 and image.shape[2] not in (1, 3, 4)):
        raise ValueError(f"{name}: expected shape (H, W), (H, W, 3) or (H, W, 4), got {image.shape}")
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
    grey: NDArray[np.uint8] = cv2.cvtColor(image, code)  # type: ignore[assignment]
    return grey


def match_descriptors(
    descriptors1: NDArray[Any], descriptors2: NDArray[Any], norm: int | None = None
) -> tuple[tuple[cv2.DMatch, ...], ...]:
    """Two nearest neighbours in image 2 of every descriptor of image 1, as ``knnMatch`` returns them.

    Args:
        descriptors1, descriptors2: (N, D), of the same dtype. Without descriptors on either side there are no
            matches.
        norm: ``cv2.NORM_*``; None = Hamming distance for uint8, Euclidean distance for all others.

    Euclidean neighbours come from matrix products, which takes a fraction of ``cv2.BFMatcher``'s time. Descriptors of
    small integers, as SIFT's are, give its very answer; others differ from it by rounding, where two neighbours are
    equally far.

    Raises:
        ValueError: the two descriptor arrays differ in dtype or length D.
    """
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return ()
    if descriptors1.dtype != descriptors2.dtype or descriptors1.shape[1:] != descriptors2.shape[1:]:
        raise ValueError(
            f"descriptors2: expected {descriptors1.dtype} of length {descriptors1.shape[1:]} like descriptors1, "
            f"got {descriptors2.dtype} of length {descriptors2.shape[1:]}"
        )
    if norm is None:
        norm = cv2.NORM_HAMMING if descriptors1.dtype == np.uint8 else cv2.NORM_L2
    if norm == cv2.NORM_L2:
        return _rows(*_euclidean_neighbours(descriptors1.astype(np.float32), descriptors2.astype(np.float32)))
    return tuple(tuple(row) for row in cv2.BFMatcher(norm).knnMatch(descriptors1, descriptors2, k=2))


def _euclidean_neighbours(
    queries: NDArray[np.float32], others: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Rows (N1, k) of the nearest two ``others`` (N2, D), or one where there are no more, and their distances.

    Of equally near ones the first comes first.
    """
    count = min(2, len(others))
    index = np.empty((len(queries), count), dtype=np.intp)
    distance = np.empty((len(queries), count), dtype=np.float32)
    # |a - b|² is |b|² - 2 a·b but for |a|², which is the same for all neighbours b of a.
    factors = np.vstack([-2.0 * others.T, np.sum(others * others, axis=1)])  # (D + 1, N2)
    for first in range(0, len(queries), _BLOCK):
        block = queries[first : first + _BLOCK]  # (B, D)
        rows = np.arange(len(block))
        squared = np.column_stack([block, np.ones(len(block), dtype=np.float32)]) @ factors  # (B, N2)
        nearest = np.empty((len(block), count), dtype=np.intp)
        for rank in range(count):
            nearest[:, rank] = squared.argmin(axis=1)
            squared[rows, nearest[:, rank]] = np.inf
        # The differences themselves, for squares of large numbers leave little of a small distance.
        exact = np.linalg.norm(block[:, None, :] - others[nearest], axis=2)  # (B, k)
        order = np.argsort(exact, axis=1, kind="stable")
        index[first : first + _BLOCK] = np.take_along_axis(nearest, order, axis=1)
        distance[first : first + _BLOCK] = np.take_along_axis(exact, order, axis=1)
    return index, distance


def _rows(index: NDArray[np.intp], distance: NDArray[np.float32]) -> tuple[tuple[cv2.DMatch, ...], ...]:
    """``knnMatch`` rows of neighbours (N1, k), best first."""
    listed = enumerate(zip(index.tolist(), distance.tolist()))
    return tuple(tuple(cv2.DMatch(i, j, d) for j, d in zip(near, far)) for i, (near, far) in listed)


def match_with(
    matcher: cv2.DescriptorMatcher, features1: ImageFeatures, features2: ImageFeatures
) -> tuple[tuple[cv2.DMatch, ...], ...]:
    """What a matcher of OpenCV finds, as rows of up to two candidates, best first.

    A matcher without second neighbours (``crossCheck=True``, ``cv2.LightGlueMatcher``) gives rows of one candidate
    for the keypoints that it matched. One that looks at keypoints as well is shown those of both images.

    Raises:
        ValueError: an image has no descriptors, or the matcher cannot match such descriptors.
    """
    descriptors1, descriptors2 = descriptors_of(features1), descriptors_of(features2)
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return ()
    try:
        if hasattr(matcher, "setPairInfo"):
            points = (np.asarray(features.points, dtype=np.float32) for features in (features1, features2))
            matcher.setPairInfo(*points, features1.image_size, features2.image_size)
            return tuple((match,) for match in matcher.match(descriptors1, descriptors2))
        try:
            return tuple(map(tuple, matcher.knnMatch(descriptors1, descriptors2, k=min(2, len(descriptors2)))))
        except cv2.error:  # crossCheck=True knows no second neighbours, and cannot be asked for
            return tuple((match,) for match in matcher.match(descriptors1, descriptors2))
    except cv2.error as error:
        what = f"{descriptors1.dtype} descriptors of length {descriptors1.shape[1]}"
        raise ValueError(f"matcher: {type(matcher).__name__} cannot match {what}: {error.err or error}") from error


def describe(image: NDArray[Any], detector: Detector, name: str = "image") -> ImageFeatures:
    """Features of an image, in its pixels; arguments and errors as :func:`detect_keypoints`."""
    keypoints, descriptors = detect_keypoints(image, detector, name)
    values = np.array([(*k.pt, k.size, k.angle) for k in keypoints], dtype=np.float64).reshape(-1, 4)
    return ImageFeatures(
        points=values[:, :2],
        size=values[:, 2].astype(np.float32),
        angle=values[:, 3].astype(np.float32),
        descriptors=descriptors,
        image_size=(image.shape[1], image.shape[0]),
        resolution=detector_resolution((image.shape[1], image.shape[0])),
    )


def match_features(features1: ImageFeatures, features2: ImageFeatures) -> OneWayMatches:
    """The matches of two images as :func:`mgca_filter.match_images` finds them, and which of them are mutual.

    Without keypoints on either side there are none. The ratio (M,) is NaN where image 2 has one keypoint only.

    Raises:
        ValueError: an image has no descriptors, or the two images' differ in dtype or length.
    """
    descriptors1, descriptors2 = descriptors_of(features1), descriptors_of(features2)
    count1, count2 = len(features1), len(features2)
    forth = read_matches(match_descriptors(descriptors1, descriptors2), count1, count2)
    back = read_matches(match_descriptors(descriptors2, descriptors1), count2, count1)
    ratio = np.full(len(forth), np.nan, dtype=np.float32) if forth.ratio is None else forth.ratio
    shapes = keypoint_attributes(features1, features2, forth.index1, forth.index2)
    mutual = np.zeros(0, dtype=bool) if len(forth) == 0 else back.index2[forth.index2] == forth.index1
    return OneWayMatches(forth.index1, forth.index2, replace(shapes, ratio=ratio, best=forth.best), mutual)


def keypoint_attributes(
    features1: ImageFeatures, features2: ImageFeatures, index1: NDArray[np.intp], index2: NDArray[np.intp]
) -> MatchAttributes:
    """Size and angle of each match (M,) of keypoints ``index1``, ``index2`` (M,), where both images know them."""
    known: dict[str, NDArray[Any]] = {}
    for side, features, index in (("1", features1, index1), ("2", features2, index2)):
        if features.size is None or features.angle is None:
            return MatchAttributes()
        known |= {f"size{side}": features.size[index], f"angle{side}": features.angle[index]}
    return MatchAttributes(**known)


def attributes_of_matches(
    features1: ImageFeatures, features2: ImageFeatures, pairs: NDArray[np.intp]
) -> MatchAttributes:
    """What two images' features tell of matches that someone else found.

    Args:
        features1, features2: descriptors tell ratio and best of the list where both images have two or more; sizes
            and angles stand where both images know them.
        pairs: (M, 2) rows of the two images' features, M of 1 or more.
    """
    shapes = keypoint_attributes(features1, features2, pairs[:, 0], pairs[:, 1])
    if features1.descriptors is None or features2.descriptors is None or min(len(features1), len(features2)) < 2:
        return shapes
    distance, nearest_other = descriptor_distances(features1.descriptors, features2.descriptors, pairs)
    ratio, best = distance_ratio(distance, nearest_other), best_of_list(pairs[:, 1].astype(np.intp), distance)
    return replace(shapes, ratio=ratio, best=best)


def descriptor_distances(
    descriptors1: NDArray[Any], descriptors2: NDArray[Any], pairs: NDArray[np.intp], block: int = 1024
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Euclidean distance (M,) of each match, and that (M,) to the nearest other descriptor of image 2.

    Args:
        descriptors1, descriptors2: (N1, D), (N2, D), N2 of 2 or more. pairs: (M, 2) indices.
        block: matches at a time, to bound the memory.
    """
    all2 = descriptors2.astype(np.float32)
    square2 = np.sum(all2 * all2, axis=1)
    matched, other = np.empty(len(pairs)), np.empty(len(pairs))
    for first in range(0, len(pairs), block):
        rows = pairs[first : first + block].astype(np.intp)
        query = descriptors1[rows[:, 0]].astype(np.float32)
        squared = np.sum(query * query, axis=1)[:, None] + square2 - 2.0 * (query @ all2.T)  # (block, N2)
        own = np.arange(len(rows)), rows[:, 1]
        matched[first : first + block] = squared[own]
        squared[own] = np.inf
        other[first : first + block] = squared.min(axis=1)
    return np.sqrt(np.maximum(matched, 0.0)), np.sqrt(np.maximum(other, 0.0))


def descriptors_of(features: ImageFeatures) -> NDArray[Any]:
    """Descriptors (N, D) of an image.

    Raises:
        ValueError: it has none.
    """
    if features.descriptors is None:
        raise ValueError("no matches, and no descriptors to find them with")
    return features.descriptors
