"""What ``mgca-match`` and its subcommands share: exit status, one-line errors, argument types."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

EXIT_FOUND, EXIT_NO_GEOMETRY, EXIT_USAGE = 0, 1, 2


class UsageError(Exception):
    """One line for the user; the command exits with 2."""


class OneLineParser(argparse.ArgumentParser):
    """argparse without the usage block in front of each error."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError."""
        raise UsageError(f"{message} (see {self.prog} --help)")


def intrinsics(text: str) -> NDArray[np.float64]:
    """K (3, 3) from ``fx,fy,cx,cy``."""
    try:
        fx, fy, cx, cy = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected fx,fy,cx,cy in pixels, got {text!r}") from None
    if not all(math.isfinite(value) for value in (fx, fy, cx, cy)) or fx <= 0 or fy <= 0:
        raise argparse.ArgumentTypeError(f"expected finite numbers and positive focal lengths, got {text!r}")
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def positive(kind: type[int] | type[float]) -> Callable[[str], float]:
    """Reader of a finite number above zero."""

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected a number, got {text!r}") from None
        if not math.isfinite(value) or value <= 0:
            raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
        return value

    return parse


def one_line(error: BaseException) -> str:
    """What an exception says, on one line; an error of the system names its file."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())
