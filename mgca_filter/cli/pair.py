"""``mgca-match``: two images in; a summary, a picture, JSON and NPZ out."""

from __future__ import annotations

import argparse
import logging
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import MgcaFilterError
from ..exif import exif_intrinsics
from ..features import detector_resolution
from ..geometry.cameras import Distortion
from ..images import (
    MAX_FILE_BYTES,
    decode_photo,
    intrinsics_as_shown,
    intrinsics_unit_doubt,
    principal_point_doubt,
    size_of_intrinsics,
)
from ..input_file import read_bytes
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
    doubtful_options,
    filter_options,
    one_line,
    quiet_codecs,
    warnings_in_one_line,
)
from .cameras import camera as camera_argument
from .cameras import camera_as_shown, distortion
from .compare import BaselineFit, comparison_table, fit_baselines
from .report import MatchReport, overlay, picture, summary, to_json, write_html, write_npz
from .truth import existing, read_truth

_USAGE = """\
%(prog)s [options] img1 img2
       %(prog)s colmap DATABASE ...             many pairs: matches of a COLMAP database
       %(prog)s hloc FEATURES.h5 MATCHES.h5 ... many pairs: matches in hloc's files
       %(prog)s folder IMAGES ...               many pairs: a folder of images
       %(prog)s run SCRIPT.py ...               a Python script, with the filter in place of cv2's functions
       %(prog)s train ...                       train the network on your own scenes
       %(prog)s evaluate PATH ...               the filter and its baselines on pairs with known pose"""
_CAMERAS = """\
K is fx,fy,cx,cy in pixels or a file: K.txt (9 numbers), COLMAP's cameras.txt, OpenCV's or ROS's YAML, XML or JSON,
  .npy, .npz, with FILE:NAME for one of several cameras. DIST is k1,k2,p1,p2[,...], fisheye:k1,k2,k3,k4 or a file, by
  default what the file of K holds. Without K the focal length is that of the EXIF data, or guessed."""
_EPILOG = """\
"mgca-match colmap --help", and so on, tells of the other commands.

Pixels are those of the image as it is shown: a photo that its EXIF says to turn is turned first. --K is for the photo
as it is shown or as it is stored, whichever its principal point is the middle of.

exit status: 0 = geometry found (status ok, planar, pure_rotation or suspicious_intrinsics: read which),
1 = none (too_few_matches, no_geometry, unrelated, and low_support unless estimated focal lengths alone make the pose
doubtful), 2 = wrong usage or unreadable file."""

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
    out.add_argument(
        "--overlay",
        metavar="OUT.png",
        type=Path,
        help="picture of img1 warped onto img2, where there is a homography (--geometry homography asks for one)",
    )
    out.add_argument("--json", metavar="FILE", help='pose, status and kept matches; "-" = alone on stdout')
    out.add_argument("--npz", metavar="FILE", type=Path, help="points, scores, mask and models as numpy arrays")
    out.add_argument("--html", metavar="FILE", type=Path, help="report to look at in a browser, one file")
    out.add_argument("--compare", action="store_true", help="run RANSAC and MAGSAC on the same matches as well")
    out.add_argument(
        "--truth",
        metavar="FILE",
        type=existing,
        help="true pose, to tell who is right: JSON with R and t, 12 or 16 numbers [R | t], COLMAP's images.txt, or a "
        "list of pairs in SuperGlue's format",
    )
    out.add_argument("-q", "--quiet", action="store_true", help="no summary, errors only")
    out.add_argument("-v", "--verbose", action="store_true", help="log what is done, on stderr")
    camera = parser.add_argument_group(
        "cameras",
        _CAMERAS,
    )
    for name, of in (("", "both images"), ("1", "the first image, with --K2"), ("2", "the second image, with --K1")):
        camera.add_argument(f"--K{name}", metavar="K", type=camera_argument, help=f"intrinsics of {of}")
    for name, of in (("", "both images"), ("1", "the first image"), ("2", "the second image")):
        camera.add_argument(f"--dist{name}", metavar="DIST", type=distortion, help=f"lens distortion of {of}")
    camera.add_argument("--no-exif", action="store_true", help="do not read the focal length from EXIF data")
    matching = parser.add_argument_group("matching")
    add_detector_options(matching)
    add_filter_options(parser)
    parser.add_argument("--version", action="version", version=f"mgca-match {__version__}")
    return parser


@dataclass(frozen=True)
class Photo:
    """An image file.

    Attributes:
        image: (h, w, 3) BGR uint8, as its EXIF says that it is to be shown; orientation: that it was stored in.
        exif_K: (3, 3) where its EXIF knows the focal length, or None.
    """

    path: Path
    image: NDArray[np.uint8]
    orientation: int
    exif_K: NDArray[np.float64] | None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) as it is shown."""
        return self.image.shape[1], self.image.shape[0]


def read_photo(path: Path) -> Photo:
    """An image file, decoded.

    Raises:
        UsageError: the file cannot be read or decoded; the message names it.
    """
    try:
        data = read_bytes(path, MAX_FILE_BYTES)
        image, orientation = decode_photo(data)
        return Photo(path, image, orientation, exif_intrinsics(data, (image.shape[1], image.shape[0])))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error


def _check_outputs(options: argparse.Namespace) -> None:
    """Complain about output paths before the work rather than after it."""
    json_path = None if options.json in (None, "-") else Path(options.json)
    pictures = (options.output, options.overlay)
    outputs = [path for path in (*pictures, json_path, options.npz, options.html) if path is not None]
    for path in outputs:
        if sum(other.resolve() == path.resolve() for other in outputs) > 1:
            raise UsageError(f"{path}: is asked for twice")
        if path.is_dir() or not path.parent.is_dir():
            raise UsageError(f"{path}: {'is a folder' if path.is_dir() else 'its folder does not exist'}")
        if path.resolve() in (options.image1.resolve(), options.image2.resolve()):
            raise UsageError(f"{path}: is one of the images")
        if options.truth is not None and path.resolve() == options.truth.resolve():
            raise UsageError(f"{path}: is the truth")
    for path in pictures:
        if path is not None and not (path.suffix and cv2.haveImageWriter(str(path))):
            raise UsageError(f"{path}: OpenCV cannot write pictures of this type, use .png or .jpg")


@dataclass(frozen=True)
class _Cameras:
    """Options of the filter on cameras; ``K2`` is None where both share ``K1``, so that other sizes are refused."""

    K1: NDArray[np.float64] | None = None
    K2: NDArray[np.float64] | None = None
    dist1: Distortion | None = None
    dist2: Distortion | None = None


def _check_cameras(options: argparse.Namespace) -> None:
    if (options.K1 is None) != (options.K2 is None):
        raise UsageError("--K1 and --K2 go together; --K is for both images")
    if options.K is not None and options.K1 is not None:
        raise UsageError("--K excludes --K1 and --K2")
    lenses = [name for name in ("dist", "dist1", "dist2") if getattr(options, name) is not None]
    if lenses and options.K is None and options.K1 is None:
        raise UsageError(f"--{lenses[0]}: lens distortion needs --K, or --K1 and --K2")


def _cameras(options: argparse.Namespace, photos: tuple[Photo, Photo]) -> _Cameras:
    """What the command line says of the photos, for these as they are shown.

    Raises:
        ValueError: a camera is one of images of another size, or nothing says which of several it is.
    """
    if options.K is None and options.K1 is None:
        return _Cameras()
    given = [options.K if options.K1 is None else K for K in (options.K1, options.K2)]
    named = [argument.of(photo.path) for argument, photo in zip(given, photos)]
    if options.K is not None and named[0] is named[1] and named[0].size is None:
        # One K of no known size: that of most of the sizes that the two are shown or stored in.
        size = size_of_intrinsics(named[0].K, [(photo.size, photo.orientation) for photo in photos])
        named = [replace(camera, size=size) for camera in named]
        if any(
            intrinsics_as_shown(named[0].K, named[0].size, photo.size, photo.orientation) is None for photo in photos
        ):
            return _Cameras(named[0].K, None, named[0].distortion)  # for the filter to refuse
    shown = [camera_as_shown(camera, p.path, p.size, p.orientation) for camera, p in zip(named, photos)]
    lenses = [
        next((lens for lens in (own, options.dist) if lens is not None), camera.distortion)
        for own, camera in zip((options.dist1, options.dist2), shown)
    ]
    shared = options.K is not None and np.array_equal(shown[0].K, shown[1].K) and lenses[0] is lenses[1]
    return _Cameras(shown[0].K, None if shared else shown[1].K, lenses[0], None if shared else lenses[1])


def _match(options: argparse.Namespace) -> MatchReport:
    """Read, match, filter and, with ``--compare``, fit the baselines."""
    _check_cameras(options)
    _check_outputs(options)
    for doubt in doubtful_options(options):
        _log.warning("warning: %s", doubt)
    photos = one, two = read_photo(options.image1), read_photo(options.image2)
    cameras = _cameras(options, photos)
    truth = None
    if options.truth is not None:
        truth = read_truth(options.truth, (one.path, two.path), (one.orientation, two.orientation))
    by_exif = cameras.K1 is None and one.exif_K is not None and two.exif_K is not None and not options.no_exif
    if by_exif:
        cameras = _Cameras(one.exif_K, two.exif_K)
    if options.no_exif and cameras.K1 is not None:
        _log.warning("warning: --no-exif has no say where K is given")
    _log.info("%s: %d x %d, %s: %d x %d", one.path, *one.size, two.path, *two.size)
    start = time.perf_counter()
    settings = {"detector": options.detector, "max_keypoints": options.max_keypoints, **filter_options(options)}
    matched = match_images(one.image, two.image, **vars(cameras), **settings)
    if by_exif and matched.result.status is Status.SUSPICIOUS_INTRINSICS:
        _log.warning("warning: the matches contradict the focal length of the EXIF data, matched without it")
        by_exif, cameras = False, _Cameras()
        matched = match_images(one.image, two.image, **settings)
    total_ms = 1e3 * (time.perf_counter() - start)
    for assumption in matched.result.info.get("assumptions", ()):
        _log.info("assumed: %s", assumption)
    if cameras.K2 is None:
        cameras = replace(cameras, K2=cameras.K1, dist2=cameras.dist1)
    _warn_of_cameras(cameras, photos)
    if matched.result.verified and options.keep_precision is not None and matched.result.num_inliers == 0:
        best = float(matched.result.scores.max(initial=0.0))
        _log.warning(
            "warning: --keep-precision %g: no match is that sure, the surest has a score of %.2f",
            options.keep_precision,
            best,
        )
    report = MatchReport(
        one.path, two.path, one.image, two.image, cameras.K1, cameras.K2, matched, total_ms,
        by_exif=by_exif, dist1=cameras.dist1, dist2=cameras.dist2, truth=truth,
    )  # fmt: skip
    if not options.compare:
        return report
    baselines: list[BaselineFit] = fit_baselines(
        report.points1,
        report.points2,
        **vars(cameras),
        size1=report.sizes[0],
        size2=report.sizes[1],
        threshold_px=options.threshold * max(map(detector_resolution, report.sizes)),
        seed=options.seed,
    )
    return report.with_baselines(baselines)


def _warn_of_cameras(cameras: _Cameras, photos: tuple[Photo, Photo]) -> None:
    doubts = []
    for K, photo in zip((cameras.K1, cameras.K2), photos):
        if K is not None:
            doubts += [intrinsics_unit_doubt(K, photo.size) or principal_point_doubt(K, photo.size)]
    for doubt in dict.fromkeys(doubts):
        if doubt is not None:
            _log.warning("warning: %s", doubt)


def _write(report: MatchReport, options: argparse.Namespace, command: str) -> None:
    json_alone = options.json == "-"
    if not options.quiet:
        words = summary(report)
        if report.baselines is not None:
            words += "\n\n" + comparison_table(
                report.result, report.filter_ms, report.baselines, report.truth, report.right
            )
        print(words, file=sys.stderr if json_alone else sys.stdout)
    if json_alone:
        print(to_json(report))
    elif options.json:
        with _named(options.json):
            Path(options.json).write_text(to_json(report) + "\n", encoding="utf-8")
    if options.npz:
        with _named(options.npz):
            write_npz(options.npz, report)
    if options.html:
        with _named(options.html):
            write_html(options.html, report, command)
    if options.output and not cv2.imwrite(str(options.output), picture(report)):
        raise UsageError(f"{options.output}: cannot be written")
    if options.overlay:
        warped = overlay(report)
        if warped is None:
            _log.warning("warning: --overlay: no homography was found, %s is not written", options.overlay)
        elif not cv2.imwrite(str(options.overlay), warped):
            raise UsageError(f"{options.overlay}: cannot be written")


@contextmanager
def _named(path: Path | str) -> Iterator[None]:
    """What the system says of writing a file, with its name, which it leaves out where the disk is full."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


def _log_to_stderr(level: int) -> None:
    """Send the package's log, and no other library's, to stderr; a second call replaces the first."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("mgca-match: %(message)s"))
    _log.handlers[:] = [handler]
    _log.setLevel(level)


def main(arguments: Sequence[str]) -> int:
    """Match two images; returns the exit status (0 = geometry found, 1 = none, 2 = usage)."""
    try:
        quiet_codecs()
        options = build_parser().parse_args(arguments)
        warnings_in_one_line(_log.warning)
        _log_to_stderr(logging.ERROR if options.quiet else logging.DEBUG if options.verbose else logging.WARNING)
        report = _match(options)
        _write(report, options, shlex.join(["mgca-match", *arguments]))
    except (UsageError, MgcaFilterError, ImportError, OSError, ValueError, TypeError) as error:
        print(f"mgca-match: {one_line(error)}", file=sys.stderr)
        return EXIT_USAGE
    return EXIT_FOUND if report.found_geometry else EXIT_NO_GEOMETRY
