"""The lists that callers arrive with: all matches, or what a filter of their own left of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import ScenePair
from ..inputs.attributes import MatchAttributes

InputList = tuple[NDArray[np.intp], MatchAttributes]
RATIO_TEST = 0.75


def raw(pair: ScenePair) -> InputList:
    """``knnMatch`` output: every match, with all that is known of it."""
    return np.arange(len(pair.mutual)), pair.attributes


def ratio_tested(pair: ScenePair) -> InputList:
    """The usual loop over ``knnMatch`` with 0.75: what it leaves is a flat list, and the ratio is gone."""
    assert pair.attributes.ratio is not None
    rows = np.flatnonzero(pair.attributes.ratio < RATIO_TEST)
    return rows, replace(pair.attributes.take(rows), ratio=None)


def cross_checked(pair: ScenePair) -> InputList:
    """``BFMatcher(crossCheck=True)``: two-way nearest neighbours without ratios."""
    rows = np.flatnonzero(pair.mutual)
    return rows, replace(pair.attributes.take(rows), ratio=None)


def bare_points(pair: ScenePair) -> InputList:
    """Two arrays of points and nothing else."""
    return np.arange(len(pair.mutual)), MatchAttributes()


INPUT_KINDS: dict[str, Callable[[ScenePair], InputList]] = {
    "raw": raw,
    "ratio 0.75": ratio_tested,
    "cross-check": cross_checked,
    "bare points": bare_points,
}
