"""What ``mgca-match`` and its subcommands share: exit status, one-line errors, argument types, the filter's options."""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import cv2

from ..features import DEFAULT_DETECTOR, DEFAULT_FEATURE_COUNT, DETECTORS
from ..inference.onnxruntime_ import available_providers
from ..inputs.options import EFFORTS, GEOMETRIES, METHODS, FilterOptions

EXIT_FOUND, EXIT_NO_GEOMETRY, EXIT_USAGE = 0, 1, 2
# Thresholds, pixels, that are hardly meant as such.
_TINY_PX, _HUGE_PX = 0.05, 30.0
_FEW_KEYPOINTS = 100


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


def add_filter_options(
    parser: argparse.ArgumentParser, *, fit_required: bool = False, threshold: float = FilterOptions.threshold
) -> None:
    """The options that :func:`filter_options` reads.

    Args:
        fit_required: scores alone are no method.
        threshold: the default.
    """
    group = parser.add_argument_group("filter")
    group.add_argument(
        "--threshold",
        metavar="PX",
        type=positive(float),
        default=threshold,
        help=f"pixels of the copy of at most 1200 searched for keypoints (or of a database), default {threshold:g}",
    )
    parser.set_defaults(usual_threshold=threshold)
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
        "--model",
        metavar="FILE",
        type=Path,
        help="default (two networks), fast (one), or a model file (.onnx, .safetensors)",
    )
    add_providers_option(group)
    group.add_argument("--seed", type=int, default=0, help="of every random choice, default 0")


def add_providers_option(parser: Any) -> None:
    """``--providers``, for a parser or a group of its options."""
    parser.add_argument(
        "--providers",
        metavar="A,B",
        type=providers,
        help='ONNX Runtime\'s execution providers, in order, such as "cuda,cpu"; "list" prints those that are there',
    )


def providers(text: str) -> list[str]:
    """Names of execution providers, in ONNX Runtime's spelling; ``list`` prints them all and ends the program."""
    known = available_providers()
    if text == "list":
        print("\n".join(known))
        sys.exit(EXIT_FOUND)
    short = {name.removesuffix("ExecutionProvider").lower(): name for name in known}
    words = [word.strip() for word in text.split(",") if word.strip()]
    names = [short.get(word.removesuffix("ExecutionProvider").lower(), word) for word in words]
    if not any(name in known for name in names):
        raise argparse.ArgumentTypeError(f"this ONNX Runtime has {', '.join(known)}, and not {text!r}")
    return names


def doubtful_options(options: argparse.Namespace) -> list[str]:
    """Sentences on options that hardly do what they are given for."""
    doubts = []
    if options.threshold < _TINY_PX:
        doubts.append(
            f"--threshold {options.threshold:g} is in pixels, and keypoints are not that exact: next to nothing is "
            "kept. One of the normalised plane, times the focal length, is one in pixels"
        )
    if options.threshold > _HUGE_PX:
        doubts.append(f"--threshold {options.threshold:g} is in pixels: matches that far off count as right")
    if options.keep_precision is not None and options.threshold != options.usual_threshold:
        doubts.append("--keep-precision decides what is kept: --threshold has no say")
    if getattr(options, "max_keypoints", DEFAULT_FEATURE_COUNT) < _FEW_KEYPOINTS:
        doubts.append(f"--max-keypoints {options.max_keypoints} of an image: too few to tell right matches from chance")
    return doubts


def warnings_in_one_line(say: Callable[[str], None]) -> None:
    """Hand what Python's ``warnings`` would print, with a place in the source, to ``say`` as it stands."""

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        say(f"warning: {' '.join(str(message).split())}")

    warnings.showwarning = show


def filter_options(options: argparse.Namespace) -> dict[str, Any]:
    """Options of :class:`mgca_filter.MatchFilter`, as JSON values."""
    return {
        "threshold": options.threshold,
        "keep_precision": options.keep_precision,
        "method": options.method,
        "effort": options.effort,
        "geometry": options.geometry,
        "model": None if options.model is None else str(options.model),
        "providers": options.providers,
        "seed": options.seed,
    }


def quiet_codecs() -> None:
    """Keep OpenCV's log of what is wrong with an image off stderr: the command says so itself, in one line."""
    logging = getattr(cv2.utils, "logging", None)
    if logging is not None:
        logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    else:  # OpenCV 4.10 has it elsewhere
        getattr(cv2, "setLogLevel")(0)  # noqa: B009  # which newer stubs do not know


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
