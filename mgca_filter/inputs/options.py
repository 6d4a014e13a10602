"""Options of the filter, checked once: TypeError for another type, ValueError for another value, both by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..types import Providers

METHODS = ("auto", "poselib", "prosac", "magsac", "ransac", "none")
EFFORTS = ("auto", "full")
GEOMETRIES = ("auto", "essential", "fundamental", "homography")
# OpenCV's flags of the estimators that have the same names here.
_FLAGS = {cv2.USAC_MAGSAC: "magsac", cv2.USAC_PROSAC: "prosac", cv2.RANSAC: "ransac"}


@dataclass(frozen=True)
class FilterOptions:
    """What the filter is asked to do with a pair, whatever runtime scores it.

    Attributes:
        threshold: inlier threshold of the mask, pixels (Sampson distance).
        keep_precision: expected precision of the mask that takes the threshold's place, or None.
        confidence: of the robust fit, between 0 and 1.
        method: one of :data:`METHODS`.
        effort: one of :data:`EFFORTS`.
        geometry: one of :data:`GEOMETRIES`.
        max_iterations: largest number of samples that one run of a robust estimator draws.
        seed: of every random choice.

    Raises:
        TypeError, ValueError: a value is of another type or range.
    """

    threshold: float = 1.0
    keep_precision: float | None = None
    confidence: float = 0.999
    method: str = "auto"
    effort: str = "auto"
    geometry: str = "auto"
    max_iterations: int = 5000
    seed: int = 0

    def __post_init__(self) -> None:
        check_number(self.threshold, "threshold", 0.0, float("inf"))
        if self.keep_precision is not None:
            check_number(self.keep_precision, "keep_precision", 0.0, 1.0)
        check_number(self.confidence, "confidence", 0.0, 1.0)
        check_choice(self.method, METHODS, "method")
        check_choice(self.effort, EFFORTS, "effort")
        check_choice(self.geometry, GEOMETRIES, "geometry")
        check_integer(self.max_iterations, "max_iterations", 1)
        check_integer(self.seed, "seed", 0)


def method_name(method: str | int) -> str:
    """The name of a robust fit, from itself or from OpenCV's flag.

    Raises:
        ValueError: a flag that means no method of the filter.
    """
    if isinstance(method, (int, np.integer)):
        if int(method) not in _FLAGS:
            raise ValueError(
                f"method: OpenCV's flag {method} has no counterpart here, expected cv2.USAC_MAGSAC, cv2.USAC_PROSAC, "
                f"cv2.RANSAC or one of {', '.join(METHODS)}"
            )
        return _FLAGS[int(method)]
    return method


def check_choice(value: Any, choices: tuple[str, ...], name: str) -> None:
    """Raise unless ``value`` is one of the words ``choices``."""
    if not isinstance(value, str):
        raise TypeError(f"{name}: expected one of {', '.join(choices)}, got {type(value).__name__}")
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def check_number(value: Any, name: str, low: float, high: float) -> float:
    """The number, as float, that lies strictly between ``low`` and ``high``."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name}: expected a number, got {type(value).__name__}")
    if not low < value < high:
        raise ValueError(f"{name}: expected a number above {low:g} and below {high:g}, got {value}")
    return float(value)


def check_integer(value: Any, name: str, least: int) -> int:
    """The integer of ``least`` or more."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name}: expected an integer, got {type(value).__name__}")
    if value < least:
        raise ValueError(f"{name}: expected {least} or more, got {value}")
    return int(value)


def check_providers(value: Any) -> Providers | None:
    """Names of execution providers, or pairs of name and options."""
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, (list, tuple)):
        raise TypeError(f"providers: expected a list of provider names, got {type(value).__name__}")
    for item in value:
        if not (isinstance(item, str) or (isinstance(item, tuple) and len(item) == 2 and isinstance(item[0], str))):
            raise TypeError(f"providers: expected names or (name, options), got {item!r}")
    return value
