"""One pair of images through the filter: features and matches in, one row out; and the processes that do it."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..exif import exif_intrinsics
from ..features import (
    ImageFeatures,
    attributes_of_matches,
    create_detector,
    describe,
    descriptors_of,
    keypoint_attributes,
    match_descriptors,
)
from ..geometry.orientation import UPRIGHT
from ..images import decode_photo
from ..inputs.attributes import MatchAttributes
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter
from ..result import EXPLAINED, FilterResult, Status

FAILED = "failed"
# Half of what COLMAP's own verification lets pass: nearly as many points, and the most accurate poses.
MAPPING_THRESHOLD_PX = 2.0
# Of a list that explains itself without intrinsics, as much as COLMAP's own verification lets pass: lenses bend the
# epipolar lines, and on fewer matches its mapper may start from a pair that it had better not start from.
UNCALIBRATED_FACTOR = 2.0


@dataclass(frozen=True)
class Unusable:
    """In the place of what cannot be read: why; the words name the image or the pair."""

    reason: str


@dataclass(frozen=True)
class PairRow:
    """The answer for one pair; conventions and pixels as in :class:`mgca_filter.FilterResult`.

    Attributes:
        name1, name2: the images, in the order in which the source names them.
        status: a :class:`mgca_filter.Status` value, or ``"failed"`` for a pair that could not be read.
        num_matches: M, the number of putative matches.
        kept: (K, 2) uint32 keypoint indices of the matches that are kept; empty where nothing explains the pair.
        scores: (K,) float32, their probabilities.
        calibrated: the geometry was fitted with known intrinsics.
        E, F, H, R, t: matrices, or None; ``H`` is a homography that explains the pair.
        confidence: probability that the fitted pose is within 10 degrees, kept or not; None where there is none.
        message: why the pair failed, or "".
    """

    name1: str
    name2: str
    status: str
    num_matches: int
    kept: NDArray[np.uint32]
    scores: NDArray[np.float32]
    calibrated: bool = False
    E: NDArray[np.float64] | None = None
    F: NDArray[np.float64] | None = None
    H: NDArray[np.float64] | None = None
    R: NDArray[np.float64] | None = None
    t: NDArray[np.float64] | None = None
    confidence: float | None = None
    message: str = ""

    @property
    def verified(self) -> bool:
        """A model explains the pair, and with it the matches that are kept, whatever the pose is worth."""
        return self.status in EXPLAINED or len(self.kept) > 0


class PairWorker:
    """The filter and its session, kept for many pairs.

    Args:
        filter_options: of :class:`mgca_filter.MatchFilter`.
    """

    def __init__(self, filter_options: dict[str, Any]) -> None:
        self._filter = MatchFilter(**filter_options)
        threshold = UNCALIBRATED_FACTOR * self._filter.options.threshold
        self._uncalibrated = MatchFilter(**{**filter_options, "threshold": threshold})

    def filter(
        self,
        name1: str,
        name2: str,
        image1: ImageFeatures | Unusable,
        image2: ImageFeatures | Unusable,
        matches: NDArray[Any] | Unusable | None,
    ) -> PairRow:
        """Filter the matches (M, 2) of a pair, or nearest neighbours of the descriptors where there are none.

        What cannot be used, or matches that point nowhere, give a row ``"failed"``, whose message names what it is.
        """
        if isinstance(image1, Unusable) or isinstance(image2, Unusable) or isinstance(matches, Unusable):
            reasons = [part.reason for part in (image1, image2, matches) if isinstance(part, Unusable)]
            return _failed(name1, name2, reasons[0])
        try:
            result, pairs = self._run(image1, image2, matches)
        except ValueError as error:
            return _failed(name1, name2, f"{name1} with {name2}: {' '.join(str(error).split())}")
        mask = result.mask & result.verified
        return PairRow(
            name1,
            name2,
            result.status.value,
            len(mask),
            pairs[mask].astype(np.uint32),
            result.scores[mask],
            result.info["intrinsics"] == "given",
            **({name: getattr(result, name) for name in ("E", "F", "R", "t")} if result.verified else {}),
            H=result.info.get("homography") if result.verified else None,
            confidence=result.confidence,
        )

    def _run(
        self, image1: ImageFeatures, image2: ImageFeatures, matches: NDArray[Any] | None
    ) -> tuple[FilterResult, NDArray[Any]]:
        """Result and the matches (M, 2) that it is about."""
        if matches is None:
            candidates: Any = match_descriptors(descriptors_of(image1), descriptors_of(image2))
            pairs = np.array([(c[0].queryIdx, c[0].trainIdx) for c in candidates], dtype=np.intp).reshape(-1, 2)
        else:
            candidates, pairs = matches, np.asarray(matches)
        there = _are_there(image1, image2, pairs)  # else it is for the filter to say what is wrong
        pair = MatchPair(
            image1.points,
            image2.points,
            candidates,
            size1=image1.image_size,
            size2=image2.image_size,
            attributes=keypoint_attributes(image1, image2, pairs[:, 0], pairs[:, 1]) if there else None,
            resolution=max(image1.resolution, image2.resolution),
        )
        filtered = there and matches is not None and _one_to_one(pairs)

        @cache
        def told_by_descriptors() -> MatchAttributes:  # only the network asks
            return attributes_of_matches(image1, image2, pairs)

        def answer(pair: MatchPair) -> FilterResult:
            quick = self._filter if pair.K1 is not None else self._uncalibrated
            result = quick.filter_list(pair) if filtered else None
            if result is not None:
                return result
            if there and matches is not None:
                pair = replace(pair, attributes=told_by_descriptors())
            return self._filter.filter_many([pair])[0]

        if image1.K is not None and image2.K is not None:
            result = answer(replace(pair, K1=image1.K, K2=image2.K, stretch1=image1.stretch, stretch2=image2.stretch))
            if result.status is not Status.SUSPICIOUS_INTRINSICS:
                return result, pairs
        # Without intrinsics, or with such as the matches contradict, F tells the matches apart.
        return answer(pair), pairs

    def extract(
        self, name: str, encoded: bytes, detector: str, max_keypoints: int
    ) -> tuple[str, ImageFeatures | None, int]:
        """Features of an image file's bytes, in pixels of the image as it is shown, K where its EXIF knows the focal
        length, and the EXIF orientation that leads back to the pixels as they are stored.

        None in place of the features of a file that cannot be decoded.
        """
        try:
            image, orientation = decode_photo(encoded)
        except ValueError:
            return name, None, UPRIGHT
        features = describe(image, create_detector(detector, max_keypoints))
        K = exif_intrinsics(encoded, (image.shape[1], image.shape[0]))
        return name, replace(features, K=K), orientation


def call_worker(filter_options: str, method: str, task: tuple[Any, ...]) -> Any:
    """A method of this process's own :class:`PairWorker`, which is made at the first call.

    Args:
        filter_options: of :class:`mgca_filter.MatchFilter`, as JSON.
    """
    return getattr(_worker(filter_options), method)(*task)


def end_worker() -> None:
    """Let this process's worker go, so that the next call opens the model again."""
    _worker.cache_clear()


def call_worker_process(filter_options: str, method: str, task: tuple[Any, ...], parent: int) -> Any:
    """:func:`call_worker` in a process that serves the process ``parent``: one thread, and no life after it."""
    _serve(parent)
    return call_worker(filter_options, method, task)


@lru_cache(maxsize=1)
def _worker(filter_options: str) -> PairWorker:
    return PairWorker(json.loads(filter_options))


@lru_cache(maxsize=1)
def _serve(parent: int) -> None:
    use_one_thread()
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent has the say
    threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()


def _exit_with_parent(parent: int) -> None:
    """A killed parent cannot stop its workers: they look whether it is still there."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def use_one_thread() -> None:
    """One thread for ONNX Runtime: with small graphs as fast as many, and the same bits on every engine."""
    os.environ.setdefault("MGCA_FILTER_NUM_THREADS", "1")


def _failed(name1: str, name2: str, message: str) -> PairRow:
    return PairRow(name1, name2, FAILED, 0, np.zeros((0, 2), np.uint32), np.zeros(0, np.float32), message=message)


def _are_there(image1: ImageFeatures, image2: ImageFeatures, pairs: NDArray[Any]) -> bool:
    """Whether given matches are pairs (M, 2) of indices of the features, M of 1 or more."""
    counts = (len(image1), len(image2))
    return pairs.ndim == 2 and len(pairs) > 0 and pairs.min() >= 0 and bool((pairs.max(axis=0) < counts).all())


def _one_to_one(pairs: NDArray[Any]) -> bool:
    """Whether no keypoint stands in two of the matches (M, 2): somebody has filtered them."""
    return all(len(np.unique(column)) == len(column) for column in pairs.T)
