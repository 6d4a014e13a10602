"""Checks of the filter's scalar options: TypeError for another type, ValueError for another value, both by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..types import Providers


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


def check_path(value: Any, default: Path) -> Path:
    """The path, or ``default`` for None."""
    if value is None:
        return default
    if not isinstance(value, (str, Path)):
        raise TypeError(f"model: expected a path, got {type(value).__name__}")
    return Path(value)


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
