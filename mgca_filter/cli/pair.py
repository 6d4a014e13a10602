"""``mgca-match``: two images in; a summary, a picture, JSON and NPZ out."""

from __future__ import annotations

import argparse
import logging
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import MgcaFilterError
from ..exif import exif_intrinsics
from ..features import detector_resolution
from ..images import decode_image, principal_point_doubt
from ..match_images import match_images
from ..result import Status
from .arguments import (
    EXIT_FOUND,
    EXIT_NO_GEOMETRY,
    EXIT_USAGE,
    OneLineParser,
    UsageError,
    add_detector_options,
    add_filter_options,
    filter_options,
    intrinsics,
    one_line,
    quiet_codecs,
)
from .compare import BaselineFit, comparison_table, fit_baselines
from .report import MatchReport, picture, summary, to_json, write_html, write_npz

_USAGE = """\
%(prog)s [options] img1 img2
       %(prog)s colmap DATABASE ...             many pairs: matches of a COLMAP database
       %(prog)s hloc FEATURES.h5 MATCHES.h5 ... many pairs: matches in hloc's files
       %(prog)s folder IMAGES ...               many pairs: a folder of images
       %(prog)s run SCRIPT.py ...               a Python script, with the filter in place of cv2's functions"""
_EPILOG = """\
"mgca-match colmap --help", and so on, tells of the other commands.

Pixels are those of the image as it is shown: a photo that its EXIF says to turn is turned first. --K is for the photo
as it is shown or as it is stored, whichever its principal point is the middle of.

exit status: 0 = geometry found (status ok, planar, pure_rotation or suspicious_intrinsics: read which),
1 = none (too_few_matches, no_geometry, low_support, unrelated), 2 = wrong usage or unreadable file."""

_log = logging.getLogger("mgca_filter")


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = OneLineParser(
        prog="mgca-match",
        usage=_USAGE,
        description="Match two images and keep the matches that agree with one camera motion.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("image1", metavar="img1", type=Path, help="image file; the pose is that of img2's camera")
    parser.add_argument("image2", metavar="img2", type=Path, help="relative to img1's: X2 = R X1 + t")
    out = parser.add_argument_group("output")
    out.add_argument("-o", "--output", metavar="OUT.png", type=Path, help="picture of kept and rejected matches")
    out.add_argument("--json", metavar="FILE", help='pose, status and kept matches; "-" = alone on stdout')
    out.add_argument("--npz", metavar="FILE", type=Path, help="points, scores, mask and models as numpy arrays")
    out.add_argument("--html", metavar="FILE", type=Path, help="report to look at in a browser, one file")
    out.add_argument("--compare", action="store_true", help="run RANSAC and MAGSAC on the same matches as well")
    out.add_argument("-q", "--quiet", action="store_true", help="no summary, errors only")
    out.add_argument("-v", "--verbose", action="store_true", help="log what is done, on stderr")
    camera = parser.add_argument_group(
        "cameras", "fx,fy,cx,cy in pixels; without them the focal length is that of the EXIF data, or guessed"
    )
    camera.add_argument("--K", metavar="fx,fy,cx,cy", type=intrinsics, help="intrinsics of both images, of one size")
    camera.add_argument("--K1", metavar="fx,fy,cx,cy", type=intrinsics, help="of the first image, with --K2")
    camera.add_argument("--K2", metavar="fx,fy,cx,cy", type=intrinsics, help="of the second image, with --K1")
    camera.add_argument("--no-exif", action="store_true", help="do not read the focal length from EXIF data")
    matching = parser.add_argument_group("matching")
    add_detector_options(matching)
    add_filter_options(parser)
    parser.add_argument("--version", action="version", version=f"mgca-match {__version__}")
    return parser


def read_photo(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.float64] | None]:
    """Colour image (h, w, 3) BGR uint8, upright as its EXIF says, and K (3, 3) where its EXIF knows the focal length.

    Raises:
        UsageError: the file cannot be read or decoded; the message names it.
    """
    try:
        data = path.read_bytes()
        image = decode_image(data)
        return image, exif_intrinsics(data, (image.shape[1], image.shape[0]))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _check_outputs(options: argparse.Namespace) -> None:
    """Complain about output paths before the work rather than after it."""
    json_path = None if options.json in (None, "-") else Path(options.json)
    for path in (options.output, json_path, options.npz, options.html):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            raise UsageError(f"{path}: {'is a folder' if path.is_dir() else 'its folder does not exist'}")
        if path is not None and path.resolve() in (options.image1.resolve(), options.image2.resolve()):
            raise UsageError(f"{path}: is one of the images")
    if options.output is not None and not (options.output.suffix and cv2.haveImageWriter(str(options.output))):
        raise UsageError(f"{options.output}: OpenCV cannot write pictures of this type, use .png or .jpg")


def _camera_matrices(options: argparse.Namespace) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """K1 and K2; the second is None where both images share the first, so that other sizes are refused."""
    if (options.K1 is None) != (options.K2 is None):
        raise UsageError("--K1 and --K2 go together; --K is for both images")
    if options.K is not None and options.K1 is not None:
        raise UsageError("--K excludes --K1 and --K2")
    return (options.K, None) if options.K is not None else (options.K1, options.K2)


def _match(options: argparse.Namespace) -> MatchReport:
    """Read, match, filter and, with ``--compare``, fit the baselines."""
    K1, K2 = _camera_matrices(options)
    _check_outputs(options)
    (image1, exif1), (image2, exif2) = read_photo(options.image1), read_photo(options.image2)
    by_exif = K1 is None and exif1 is not None and exif2 is not None and not options.no_exif
    if by_exif:
        K1, K2 = exif1, exif2
    _log.info("%s: %d x %d, %s: %d x %d", options.image1, *image1.shape[1::-1], options.image2, *image2.shape[1::-1])
    start = time.perf_counter()
    settings = {"detector": options.detector, "max_keypoints": options.max_keypoints, **filter_options(options)}
    matched = match_images(image1, image2, K1=K1, K2=K2, **settings)
    if by_exif and matched.result.status is Status.SUSPICIOUS_INTRINSICS:
        _log.warning("warning: the matches contradict the focal length of the EXIF data, matched without it")
        by_exif, K1, K2 = False, None, None
        matched = match_images(image1, image2, **settings)
    total_ms = 1e3 * (time.perf_counter() - start)
    for assumption in matched.result.info.get("assumptions", ()):
        _log.info("assumed: %s", assumption)
    K2 = K1 if K2 is None else K2
    for K, image in ((K1, image1), (K2, image2)):
        doubt = None if K is None else principal_point_doubt(K, (image.shape[1], image.shape[0]))
        if doubt is not None:
            _log.warning("warning: %s", doubt)
    report = MatchReport(options.image1, options.image2, image1, image2, K1, K2, matched, total_ms, by_exif=by_exif)
    if not options.compare:
        return report
    baselines: list[BaselineFit] = fit_baselines(
        report.points1,
        report.points2,
        K1,
        K2,
        size1=report.sizes[0],
        size2=report.sizes[1],
        threshold_px=options.threshold * max(map(detector_resolution, report.sizes)),
        seed=options.seed,
    )
    return report.with_baselines(baselines)


def _write(report: MatchReport, options: argparse.Namespace, command: str) -> None:
    json_alone = options.json == "-"
    if not options.quiet:
        words = summary(report)
        if report.baselines is not None:
            words += "\n\n" + comparison_table(report.result, report.filter_ms, report.baselines)
        print(words, file=sys.stderr if json_alone else sys.stdout)
    if json_alone:
        print(to_json(report))
    elif options.json:
        Path(options.json).write_text(to_json(report) + "\n", encoding="utf-8")
    if options.npz:
        write_npz(options.npz, report)
    if options.html:
        write_html(options.html, report, command)
    if options.output and not cv2.imwrite(str(options.output), picture(report)):
        raise UsageError(f"{options.output}: cannot be written")


def _log_to_stderr(level: int) -> None:
    """Send the package's log, and no other library's, to stderr; a second call replaces the first."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("mgca-match: %(message)s"))
    _log.handlers[:] = [handler]
    _log.setLevel(level)


def main(arguments: Sequence[str]) -> int:
    """Match two images; returns the exit status (0 = geometry found, 1 = none, 2 = usage)."""
    try:
        options = build_parser().parse_args(arguments)
        quiet_codecs()
        _log_to_stderr(logging.ERROR if options.quiet else logging.DEBUG if options.verbose else logging.WARNING)
        report = _match(options)
        _write(report, options, shlex.join(["mgca-match", *arguments]))
    except (UsageError, MgcaFilterError, ImportError, OSError, ValueError, TypeError) as error:
        print(f"mgca-match: {one_line(error)}", file=sys.stderr)
        return EXIT_USAGE
    return EXIT_FOUND if report.found_geometry else EXIT_NO_GEOMETRY
