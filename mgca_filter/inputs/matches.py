"""Matches in and out: ``cv2.DMatch``, ``knnMatch`` output, index arrays; and nearest-neighbour matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .attributes import best_of_list, distance_ratio
from .containers import unpacked

# OpenCV's default of DMatch.distance is the largest float: "no distance was set".
_NO_DISTANCE = 1e38


@dataclass(frozen=True)
class PutativeMatches:
    """Matches read from the caller's type; M rows in the order of the input.

    Attributes:
        index1, index2: (M,) rows of the keypoints; −1 in both where the caller's row holds no match at all
            (``knnMatch`` writes such rows).
        ratio: (M,) float32 ratio of the two best distances, NaN where a row has no second candidate, or None.
        distance: (M,) float64 descriptor distance, NaN where it was not set, or None.
        best: (M,) bool, no other row reaches the same keypoint of image 2 at a smaller distance, or None.
        source: what the caller passed, for :meth:`select`.
    """

    index1: NDArray[np.intp]
    index2: NDArray[np.intp]
    ratio: NDArray[np.float32] | None
    best: NDArray[np.bool_] | None
    source: Any
    distance: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.index1)

    def select(self, mask: NDArray[np.bool_]) -> Any:
        """The rows where ``mask`` (M,) is True, in the caller's type.

        A tuple stays a tuple, any other sequence or iterator becomes a list, an array stays an array of its dtype,
        and ``None`` (row i matches row i) becomes index pairs (K, 2).
        """
        if self.source is None:
            return np.stack([self.index1[mask], self.index2[mask]], axis=1)
        if isinstance(self.source, np.ndarray):
            return self.source[mask] if self.source.dtype == object else self.source.reshape(-1, 2)[mask]
        kept = [self.source[i] for i in np.flatnonzero(mask)]
        return tuple(kept) if isinstance(self.source, tuple) else kept


def read_matches(matches: Any, count1: int, count2: int, name: str = "matches") -> PutativeMatches:
    """Read matches between ``count1`` and ``count2`` keypoints.

    Args:
        matches: ``cv2.DMatch`` objects; ``knnMatch`` output (rows of candidates: the first is the match, the second
            gives the ratio), both in any container that keeps an order; an integer array (M, 2); or None = row i
            matches row i.
        name: name of the argument, for messages.

    Raises:
        TypeError: another type. ValueError: another shape, an index out of range, or None for keypoint lists
            of different length.
    """
    if matches is None:
        if count1 != count2:
            raise ValueError(
                f"{name}: None means that row i matches row i, but there are {count1} and {count2} keypoints"
            )
        rows = np.arange(count1, dtype=np.intp)
        return PutativeMatches(rows, rows, None, None, None)
    if isinstance(matches, (str, bytes, dict, cv2.DMatch)):
        raise TypeError(
            f"{name}: expected DMatch, knnMatch output, an array (M, 2) or None, got {type(matches).__name__}"
        )
    listed = unpacked(matches)
    if not isinstance(listed, np.ndarray) and isinstance(listed, Sequence):
        source = matches if isinstance(matches, (Sequence, np.ndarray)) else listed
        if len(listed) == 0:
            none = np.zeros(0, dtype=np.intp)
            return PutativeMatches(none, none, None, None, source)
        if isinstance(listed[0], cv2.DMatch):
            return _from_dmatch(source, [(m,) for m in listed], count1, count2, name)
        if any(_is_knn_row(row) for row in listed):
            return _from_dmatch(source, listed, count1, count2, name)
    return _from_array(listed, count1, count2, name)


def _is_knn_row(row: Any) -> bool:
    return isinstance(row, (list, tuple)) and (len(row) == 0 or isinstance(row[0], cv2.DMatch))


def _from_dmatch(source: Any, rows: Sequence[Any], count1: int, count2: int, name: str) -> PutativeMatches:
    """Matches from rows of candidates, best first; a row may be empty."""
    # Types first, each only once: asking every match for its own takes longer than reading it.
    if not all(issubclass(kind, Sequence) for kind in set(map(type, rows))) or not all(
        issubclass(kind, cv2.DMatch) for kind in {type(match) for row in rows for match in row}
    ):
        i, row = next((i, row) for i, row in enumerate(rows) if not _holds_matches(row))
        raise TypeError(f"{name}[{i}]: expected cv2.DMatch like its neighbours, got {_describe(row)}")
    lengths = np.fromiter(map(len, rows), dtype=np.intp, count=len(rows))
    present, contested = lengths > 0, lengths > 1
    first = [row[0] for row in rows if len(row) > 0]
    second = [row[1] for row in rows if len(row) > 1]
    index1, index2 = np.full(len(rows), -1, dtype=np.intp), np.full(len(rows), -1, dtype=np.intp)
    distance1, distance2 = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    index1[present], index2[present] = _field(first, "queryIdx"), _field(first, "trainIdx")
    distance1[present], distance2[contested] = _field(first, "distance"), _field(second, "distance")
    _check_range(index1[present], index2[present], count1, count2, name)
    distance1, distance2 = (np.where(np.abs(d) < _NO_DISTANCE, d, np.nan) for d in (distance1, distance2))
    ratio = None if np.isnan(distance2).all() else distance_ratio(distance1, distance2)
    return PutativeMatches(index1, index2, ratio, best_of_list(index2, distance1), source, distance1)


def _field(matches: Sequence[Any], name: str) -> NDArray[np.float64]:
    """One field of many ``cv2.DMatch``; indices fit a float exactly."""
    return np.fromiter(map(attrgetter(name), matches), dtype=np.float64, count=len(matches))


def _holds_matches(row: Any) -> bool:
    return isinstance(row, Sequence) and all(isinstance(match, cv2.DMatch) for match in row)


def _describe(row: Any) -> str:
    item = row[0] if isinstance(row, (list, tuple)) and len(row) else row
    return type(item).__name__


def _from_array(matches: Any, count1: int, count2: int, name: str) -> PutativeMatches:
    try:
        array = np.asarray(matches)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}: expected an array (M, 2) of indices ({error})") from error
    if array.size == 0 and array.shape in ((0,), (0, 2)):
        array = np.zeros((0, 2), dtype=array.dtype if array.dtype.kind in "iu" else np.intp)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name}: expected DMatch or an integer array (M, 2), got dtype {array.dtype}")
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name}: expected shape (M, 2), got {array.shape}")
    if array.size and array.max() > np.iinfo(np.intp).max:  # uint64 would wrap around
        raise ValueError(f"{name}: index {array.max()} is out of range")
    index1, index2 = array[:, 0].astype(np.intp), array[:, 1].astype(np.intp)
    _check_range(index1, index2, count1, count2, name)
    return PutativeMatches(index1, index2, None, None, array)


def _check_range(index1: NDArray[np.intp], index2: NDArray[np.intp], count1: int, count2: int, name: str) -> None:
    for index, count, image in ((index1, count1, 1), (index2, count2, 2)):
        wrong = (index < 0) | (index >= count)
        if wrong.any():
            raise ValueError(
                f"{name}: index {index[wrong][0]} is out of range for the {count} keypoints of image {image}"
            )
