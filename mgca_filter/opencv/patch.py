"""``patch_cv2``: the filter in place of OpenCV's estimators, for code that cannot be edited."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import cv2

from .twins import (
    estimateAffine2D,
    estimateAffinePartial2D,
    findEssentialMat,
    findFundamentalMat,
    findHomography,
    matchMGCA,
)

TWINS: dict[str, Callable[..., Any]] = {
    "findEssentialMat": findEssentialMat,
    "findFundamentalMat": findFundamentalMat,
    "findHomography": findHomography,
    "estimateAffine2D": estimateAffine2D,
    "estimateAffinePartial2D": estimateAffinePartial2D,
    "xfeatures2d.matchGMS": matchMGCA,
}
"""What replaces which function of cv2, by its name below ``cv2``."""

_lock = threading.Lock()
_originals: dict[str, Callable[..., Any]] = {}
_depth = 0


@contextmanager
def patch_cv2() -> Iterator[None]:
    """Swap OpenCV's robust two-view estimators and ``cv2.xfeatures2d.matchGMS``, see :data:`TWINS`, for our twins.

    The swap is seen by the whole process, all threads included, from the first of several overlapping or nested uses
    until the last one ends, by an exception or without. A name that other code has taken over by ``from cv2 import``
    before the swap stays OpenCV's. Where the cv2 at hand has no ``xfeatures2d``, there is nothing to swap.

    What the twins make of their arguments, and what they cannot know, is told in :mod:`mgca_filter.opencv.twins`.
    """
    with swapped(TWINS):
        yield


@contextmanager
def swapped(replacements: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Put functions in the place of cv2's; only the outermost use decides which, and restores OpenCV's own."""
    global _depth
    with _lock:
        if _depth == 0:
            for name, function in replacements.items():
                module, attribute = locate(name)
                if hasattr(module, attribute):
                    _originals[name] = getattr(module, attribute)
                    setattr(module, attribute, function)
        _depth += 1
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                for name in list(_originals):
                    module, attribute = locate(name)
                    setattr(module, attribute, _originals.pop(name))


def locate(name: str) -> tuple[ModuleType | None, str]:
    """Module and attribute of a function named below ``cv2``; None where this cv2 has no such module."""
    *folder, attribute = name.split(".")
    return (getattr(cv2, folder[0], None) if folder else cv2), attribute
