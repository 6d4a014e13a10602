"""Which of OpenCV's overloads a call means: the first whose parameters take the arguments, as OpenCV's bindings do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter, signature
from typing import Any

import cv2
import numpy as np


@np.errstate(all="ignore")  # data never raises, whatever the caller's numpy.seterr says
def call_overload(
    name: str, overloads: Sequence[Callable[..., Any]], args: Sequence[Any], kwargs: Mapping[str, Any]
) -> Any:
    """Call the first overload that the arguments fit, by number, name and kind.

    None stands for the default of a parameter that has one, as in OpenCV's bindings.

    Raises:
        TypeError: they fit none; the message lists the overloads.
    """
    for overload in overloads:
        parameters = signature(overload).parameters
        try:
            bound = signature(overload).bind(*args, **kwargs).arguments
        except TypeError:
            continue
        given = {n: v for n, v in bound.items() if v is not None or parameters[n].default is Parameter.empty}
        if all(_KINDS.get(parameter, _anything)(value) for parameter, value in given.items()):
            return overload(**given)
    forms = "; ".join(f"{name}({', '.join(signature(overload).parameters)})" for overload in overloads)
    types = ", ".join([type(value).__name__ for value in args] + [f"{k}={type(v).__name__}" for k, v in kwargs.items()])
    raise TypeError(f"{name}: ({types}) fits none of the overloads: {forms}")


def _anything(value: Any) -> bool:
    return True


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _is_matrix(value: Any) -> bool:
    return np.ndim(value) == 2


def _is_coefficients(value: Any) -> bool:
    return value is None or (not _is_number(value) and np.ndim(value) in (1, 2))


def _is_mask(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _is_point(value: Any) -> bool:
    return isinstance(value, (tuple, list, np.ndarray)) and len(value) == 2


_KINDS: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("cameraMatrix", "cameraMatrix1", "cameraMatrix2"), _is_matrix),
    **dict.fromkeys(("distCoeffs1", "distCoeffs2", "dist_coeff1", "dist_coeff2"), _is_coefficients),
    **dict.fromkeys(("focal", "prob", "threshold", "ransacReprojThreshold", "confidence"), _is_number),
    **dict.fromkeys(("method", "maxIters", "refineIters"), _is_integer),
    **dict.fromkeys(("mask", "inliers"), _is_mask),
    "params": lambda value: isinstance(value, cv2.UsacParams),
    "pp": _is_point,
}
