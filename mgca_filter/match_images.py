"""From two images to filtered matches: detect, match nearest neighbours, filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .features import (
    DEFAULT_DETECTOR,
    DEFAULT_FEATURE_COUNT,
    Detector,
    ImageFeatures,
    create_detector,
    detect_keypoints,
    detector_resolution,
    match_descriptors,
    match_with,
)
from .inputs.keypoints import read_keypoints
from .match_filter import filter_matches
from .result import FilterResult


@dataclass(frozen=True, eq=False)
class ImageMatchResult:
    """Answer of :func:`match_images`.

    Attributes:
        keypoints1, keypoints2: all keypoints, in pixels of the images that came in.
        matches: the putative matches, ``knnMatch`` rows of up to two candidates, best first; the rows of
            ``result.mask``.
        result: the filter's answer; ``result.matches`` are the kept rows.
    """

    keypoints1: list[cv2.KeyPoint]
    keypoints2: list[cv2.KeyPoint]
    matches: tuple[tuple[cv2.DMatch, ...], ...]
    result: FilterResult

    def __repr__(self) -> str:
        """The counts and the filter's verdict; the keypoints would fill the screen."""
        counts = f"{len(self.keypoints1)} and {len(self.keypoints2)} keypoints, {len(self.matches)} matches"
        return f"ImageMatchResult({counts}, {self.result!r})"


def match_images(
    image1: NDArray[Any],
    image2: NDArray[Any],
    *,
    detector: str | cv2.Feature2D = DEFAULT_DETECTOR,
    max_keypoints: int = DEFAULT_FEATURE_COUNT,
    matcher: cv2.DescriptorMatcher | None = None,
    **options: Any,
) -> ImageMatchResult:
    """Detect, match and filter two images.

    Keypoints come from a grey copy of at most 1200 px on its longer side and are given back in pixels of the
    original; ``threshold`` is in pixels of the copy, of the larger image where the two differ.

    Args:
        image1, image2: uint8 (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA.
        detector: ``"rootsift"``, ``"sift"``, ``"orb"``, ``"akaze"``, ``"brisk"``, or any ``cv2.Feature2D`` that
            describes.
        max_keypoints: per image, for a detector given by name. More find more pairs and take longer; 2000 and
            ``"sift"`` are what the training data used.
        matcher: any ``cv2.DescriptorMatcher``; None = the two nearest neighbours of every descriptor of ``image1``.
        options: keyword options of :func:`mgca_filter.filter_matches`; ``size1``, ``size2`` and
            ``resolution`` are the images' own unless given.

    Raises:
        TypeError, ValueError: an argument or option is of another type, shape or range.
        ModelError, BackendError, ImportError: as :func:`mgca_filter.filter_matches`.
    """
    finder = _finder(detector, max_keypoints)
    if not (matcher is None or isinstance(matcher, cv2.DescriptorMatcher)):
        raise TypeError(f"matcher: expected a cv2.DescriptorMatcher or None, got {type(matcher).__name__}")
    keypoints1, descriptors1 = detect_keypoints(image1, finder, "image1")
    keypoints2, descriptors2 = detect_keypoints(image2, finder, "image2")
    if matcher is None:
        matches = match_descriptors(descriptors1, descriptors2, finder.defaultNorm())
    else:
        matches = match_with(
            matcher, _features(image1, keypoints1, descriptors1), _features(image2, keypoints2, descriptors2)
        )
    for name, image in (("size1", image1), ("size2", image2)):
        if options.get(name) is None:
            options[name] = np.array([image.shape[1], image.shape[0]])
    options.setdefault("resolution", max(detector_resolution(image.shape[1::-1]) for image in (image1, image2)))
    result = filter_matches(keypoints1, keypoints2, matches, **options)
    return ImageMatchResult(keypoints1, keypoints2, matches, result)


def _finder(detector: str | cv2.Feature2D, max_keypoints: int) -> Detector:
    if isinstance(detector, str):
        return create_detector(detector, max_keypoints)
    if not isinstance(detector, cv2.Feature2D):
        raise TypeError(f"detector: expected a name or a cv2.Feature2D, got {type(detector).__name__}")
    return detector


def _features(image: NDArray[Any], keypoints: list[cv2.KeyPoint], descriptors: NDArray[Any]) -> ImageFeatures:
    height, width = image.shape[:2]
    return ImageFeatures(read_keypoints(keypoints).points, descriptors=descriptors, image_size=(width, height))
