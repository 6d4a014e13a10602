"""What ``mgca-match`` and its subcommands share: exit status, one-line errors, argument types, the filter's options."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
from numpy.typing import NDArray

from ..features import DEFAULT_DETECTOR, DEFAULT_FEATURE_COUNT, DETECTORS
from ..inputs.options import EFFORTS, GEOMETRIES, METHODS, FilterOptions

EXIT_FOUND, EXIT_NO_GEOMETRY, EXIT_USAGE = 0, 1, 2


class UsageError(Exception):
    """One line for the user; the command exits with 2."""


class OneLineParser(argparse.ArgumentParser):
    """argparse without the usage block in front of each error, and with options that are written out in full.

    Abbreviations would take ``--k`` for ``--keep-precision``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError."""
        raise UsageError(f"{message} (see {self.prog} --help)")


def add_detector_options(parser: Any) -> None:
    """``--detector`` and ``--max-keypoints``, for a parser or a group of its options."""
    parser.add_argument("--detector", choices=DETECTORS, default=DEFAULT_DETECTOR, help=f"default {DEFAULT_DETECTOR}")
    parser.add_argument(
        "--max-keypoints",
        metavar="N",
        type=positive(int),
        default=DEFAULT_FEATURE_COUNT,
        help=f"of an image, default {DEFAULT_FEATURE_COUNT}",
    )


def add_filter_options(parser: argparse.ArgumentParser, *, fit_required: bool = False) -> None:
    """The options that :func:`filter_options` reads; with ``fit_required`` scores alone are no method."""
    group = parser.add_argument_group("filter")
    group.add_argument(
        "--threshold",
        metavar="PX",
        type=positive(float),
        default=FilterOptions.threshold,
        help="pixels of the copy of at most 1200 that is searched for keypoints (or of a database), default 1.0",
    )
    group.add_argument(
        "--keep-precision",
        metavar="P",
        type=positive(float),
        help="instead of a threshold: expected share of right ones",
    )
    methods = [method for method in METHODS if method != "none" or not fit_required]
    scores_alone = "" if fit_required else "; none = scores alone"
    default = FilterOptions.method
    group.add_argument(
        "--method", choices=methods, default=default, help=f"robust fit, default {default}{scores_alone}"
    )
    group.add_argument(
        "--effort", choices=EFFORTS, default=FilterOptions.effort, help="full = the network even where it is not needed"
    )
    group.add_argument(
        "--geometry", choices=GEOMETRIES, default=FilterOptions.geometry, help="model that is fitted, default auto"
    )
    group.add_argument(
        "--model", metavar="FILE", type=Path, help="default, fast, or a model file (.onnx, .safetensors)"
    )
    group.add_argument("--providers", metavar="A,B", help="ONNX Runtime execution providers, in order")
    group.add_argument("--seed", type=int, default=0, help="of every random choice, default 0")


def filter_options(options: argparse.Namespace) -> dict[str, Any]:
    """Options of :class:`mgca_filter.MatchFilter`, as JSON values."""
    return {
        "threshold": options.threshold,
        "keep_precision": options.keep_precision,
        "method": options.method,
        "effort": options.effort,
        "geometry": options.geometry,
        "model": None if options.model is None else str(options.model),
        "providers": options.providers.split(",") if options.providers else None,
        "seed": options.seed,
    }


def quiet_codecs() -> None:
    """Keep OpenCV's log of what is wrong with an image off stderr: the command says so itself, in one line."""
    logging = getattr(cv2.utils, "logging", None)
    if logging is not None:
        logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    else:  # OpenCV 4.10 has it elsewhere
        getattr(cv2, "setLogLevel")(0)  # noqa: B009  # which newer stubs do not know


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
