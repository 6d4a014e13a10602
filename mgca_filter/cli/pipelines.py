"""``mgca-match colmap | hloc | folder``: the subcommands' arguments."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MgcaFilterError
from ..pipelines.run import Report, Summary, Workers
from ..pipelines.worker import MAPPING_THRESHOLD_PX
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
    positive,
    quiet_codecs,
    warnings_in_one_line,
)
from .cameras import CameraArgument, camera

DEFAULT_OVERLAP = 10
_EPILOG = """\
exit status: 0 = geometry found for one pair at least, 1 = for none, 2 = wrong usage, or a file that cannot be read or
written. A killed run goes on where it stopped when the same command is given again."""
_FOLDER_EPILOG = """\
Photos are matched as their EXIF says that they are to be shown, as by "mgca-match img1 img2". OUT.jsonl is in those
pixels. COLMAP and hloc read files as they are stored: in OUT.db and OUT.h5 keypoints, cameras and geometry are turned
back to the pixels of the files. --K is for the photos as they are shown or as they are stored: of one camera held
upright and sideways, one K fits all photos.

"""
# What every command needs, and its own extra brings; and the extras that bring other packages.
_PACKAGES = ["joblib", "tqdm"]
_EXTRAS = {"pycolmap": "colmap", "h5py": "hloc", "ray": "ray"}


def build_parser() -> argparse.ArgumentParser:
    """The subcommands' arguments."""
    parser = OneLineParser(prog="mgca-match", epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True, parser_class=OneLineParser)
    for add in (_add_colmap, _add_hloc, _add_folder):
        command = add(commands)
        command.epilog = _FOLDER_EPILOG + _EPILOG if add is _add_folder else _EPILOG
        command.formatter_class = argparse.RawDescriptionHelpFormatter
        _add_common(command)
    return parser


def _add_colmap(commands: Any) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        "colmap", description="Filter the matches of a COLMAP database and write its two_view_geometries."
    )
    command.add_argument("database", metavar="DATABASE", type=Path)
    target = command.add_mutually_exclusive_group(required=True)
    target.add_argument("-o", "--output", metavar="OUT.db", type=Path, help="a copy of DATABASE with our geometries")
    target.add_argument("--in-place", action="store_true", help="write them into DATABASE itself")
    command.add_argument("--no-descriptors", action="store_true", help="do not compute distance ratios")
    command.add_argument("--compare", action="store_true", help="run COLMAP's mapper on its verification and on ours")
    command.add_argument("--truth", metavar="MODEL", type=Path, help="folder of a COLMAP model, for --compare")
    command.set_defaults(run=_run_colmap)
    return command


def _add_hloc(commands: Any) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        "hloc", description="Filter hloc's matches: what the filter drops becomes -1 in a copy of MATCHES.h5."
    )
    command.add_argument("features", metavar="FEATURES.h5", type=Path)
    command.add_argument("matches", metavar="MATCHES.h5", type=Path)
    command.add_argument("-o", "--output", metavar="FILTERED.h5", type=Path, required=True)
    command.add_argument("--no-descriptors", action="store_true", help="do not compute distance ratios")
    command.set_defaults(run=_run_hloc)
    return command


def _add_folder(commands: Any) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        "folder", description="Match the images of a folder and filter the matches."
    )
    command.add_argument("images", metavar="IMAGES", type=Path)
    command.add_argument(
        "-o", "--output", metavar="OUT", type=Path, required=True, help="OUT.db (COLMAP), OUT.h5 (hloc) or OUT.jsonl"
    )
    command.add_argument(
        "--pairs", metavar="FILE|exhaustive|sequential", default="exhaustive", help="which to match, default exhaustive"
    )
    command.add_argument("--overlap", metavar="N", type=positive(int), help="sequential: N next images, default 10")
    command.add_argument(
        "--K",
        metavar="K",
        type=camera,
        help='intrinsics of all images: fx,fy,cx,cy in pixels or a file, as of "mgca-match img1 img2"',
    )
    command.add_argument("--no-exif", action="store_true", help="without --K: guess the focal length, do not read EXIF")
    add_detector_options(command)
    command.add_argument("--cache", metavar="DIR", type=Path, help="keep the features there for other runs")
    command.set_defaults(run=_run_folder)
    return command


def _add_common(command: argparse.ArgumentParser) -> None:
    add_filter_options(command, fit_required=True, threshold=MAPPING_THRESHOLD_PX)
    workers = command.add_argument_group("workers")
    workers.add_argument("-j", "--jobs", metavar="N", type=positive(int), default=1, help="workers, default 1")
    workers.add_argument("--engine", choices=("local", "ray"), default="local", help="processes here (default), or Ray")
    workers.add_argument("--address", metavar="HOST", help='of a Ray cluster ("auto" = this machine\'s)')
    command.add_argument("--html", metavar="REPORT.html", type=Path, help="report of all pairs for a browser, one file")
    command.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary, errors only")
    command.add_argument("--overwrite", action="store_true", help="replace an output that exists")


def _check_output(options: argparse.Namespace, output: Path, inputs: Sequence[Path]) -> None:
    if not output.parent.is_dir() or output.is_dir():
        raise UsageError(f"{output}: {'is a folder' if output.is_dir() else 'its folder does not exist'}")
    for path in inputs:
        if output.exists() and path.exists() and output.samefile(path):
            raise UsageError(f"{output}: is the input")
    if output.exists() and not options.overwrite:
        raise UsageError(f"{output}: exists; --overwrite replaces it")


def _report(options: argparse.Namespace, source: Path, inputs: Sequence[Path]) -> Report | None:
    """What ``--html`` asks for; a report is replaced like one of ``mgca-match img1 img2``."""
    if options.html is None:
        return None
    path: Path = options.html
    if not path.parent.is_dir() or path.is_dir():
        raise UsageError(f"{path}: {'is a folder' if path.is_dir() else 'its folder does not exist'}")
    if path.resolve() in {other.resolve() for other in inputs}:
        raise UsageError(f"{path}: is the input or the output")
    return Report(path, source.resolve().name, options.command_line)


def _run_colmap(options: argparse.Namespace) -> Summary:
    from ..pipelines.colmap import ColmapJob

    if options.in_place:
        output = options.database
    else:
        output = options.output
        _check_output(options, output, [options.database])
    if options.truth is not None and not options.compare:
        raise UsageError("--truth goes with --compare")
    report = _report(options, options.database, [options.database, output])
    job = ColmapJob(options.database, output, use_descriptors=not options.no_descriptors, report=report)
    summary = _with_workers(job, options)
    if options.compare:
        from ..pipelines.mapper_comparison import compare, comparison_table

        print(comparison_table(compare(output, summary.seconds, options.truth, options.jobs)))
    return summary


def _run_hloc(options: argparse.Namespace) -> Summary:
    from ..pipelines.hloc import HlocJob

    _check_output(options, options.output, [options.features, options.matches])
    report = _report(options, options.matches, [options.features, options.matches, options.output])
    job = HlocJob(
        options.features,
        options.matches,
        options.output,
        use_descriptors=not options.no_descriptors,
        report=report,
    )
    return _with_workers(job, options)


def _run_folder(options: argparse.Namespace) -> Summary:
    from ..pipelines.folder import OUTPUTS, FolderJob, exhaustive_pairs, list_images, read_pairs, sequential_pairs

    if options.output.suffix not in OUTPUTS:
        raise UsageError(f"{options.output}: expected a name that ends in {', '.join(OUTPUTS)}")
    _check_output(options, options.output, [])
    import_module(OUTPUTS[options.output.suffix])
    if options.overlap is not None and options.pairs != "sequential":
        _say(options, "warning: --overlap goes with --pairs sequential")
    if options.no_exif and options.K is not None:
        _say(options, "warning: --no-exif has no say where K is given")
    names = list_images(options.images)
    if options.pairs == "exhaustive":
        pairs = exhaustive_pairs(names)
    elif options.pairs == "sequential":
        pairs = sequential_pairs(names, options.overlap or DEFAULT_OVERLAP)
    else:
        pairs = read_pairs(Path(options.pairs), names, options.images)
    if not pairs:
        raise UsageError(f"{options.images}: no pairs to match")
    job = FolderJob(
        options.images,
        pairs,
        options.output,
        None if options.K is None else _pinhole(options.K),
        options.detector,
        options.max_keypoints,
        options.cache,
        _report(options, options.images, [options.output]),
        exif=not options.no_exif,
    )
    return _with_workers(job, options)


def _pinhole(argument: CameraArgument) -> NDArray[np.float64]:
    """The one K of all images."""
    one = argument.only()
    if one.distortion is not None:
        raise UsageError(
            f"--K {one.source}: has lens distortion, which this command does not remove: undistort the images"
        )
    return one.K


def _say(options: argparse.Namespace, message: str) -> None:
    if not options.quiet:
        print(f"mgca-match: {message}", file=sys.stderr)


def _with_workers(job: Any, options: argparse.Namespace) -> Summary:
    if options.address is not None and options.engine != "ray":
        raise UsageError("--address goes with --engine ray")
    settings = filter_options(options)
    for doubt in doubtful_options(options):
        _say(options, f"warning: {doubt}")
    with Workers(settings, options.jobs, options.engine, options.address) as workers:
        summary: Summary = job.run(workers, settings, options.quiet)
    for message in [*summary.failures, *([] if options.quiet else summary.doubts)]:
        print(f"mgca-match: {message}", file=sys.stderr)
    if not options.quiet:
        print(summary)
    return summary


def main(arguments: Sequence[str]) -> int:
    """Run a subcommand; returns the exit status (0 = geometry found, 1 = for no pair, 2 = usage or files)."""
    try:
        quiet_codecs()
        options = build_parser().parse_args(arguments)
        options.command_line = shlex.join(["mgca-match", *arguments])
        warnings_in_one_line(partial(_say, options))
        for package in _PACKAGES + (["ray"] if options.engine == "ray" else []):
            import_module(package)  # better missed now than when all pairs are done
        summary = options.run(options)
    except ImportError as error:
        extra = options.command if error.name in _PACKAGES else _EXTRAS.get(error.name or "")
        hint = f"; pip install 'mgca_filter[{extra}]' brings it" if extra else ""
        print(f"mgca-match: {one_line(error)}{hint}", file=sys.stderr)
        return EXIT_USAGE
    except (UsageError, MgcaFilterError, OSError, ValueError, TypeError, RuntimeError) as error:
        # RuntimeError: of pycolmap and HDF5
        print(f"mgca-match: {one_line(error)}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        print("mgca-match: interrupted; the same command goes on where it stopped", file=sys.stderr)
        return EXIT_USAGE
    return EXIT_FOUND if summary.found_geometry else EXIT_NO_GEOMETRY
