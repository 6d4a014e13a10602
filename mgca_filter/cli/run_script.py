"""``mgca-match run``: the command's arguments."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import MgcaFilterError
from ..inference.onnxruntime_ import PROVIDERS_VARIABLE
from ..match_filter import MatchFilter
from ..opencv.script import run_script
from .arguments import EXIT_FOUND, EXIT_USAGE, OneLineParser, UsageError, add_providers_option, one_line

_DESCRIPTION = """\
Run a Python script as "python SCRIPT ..." would, with the filter in the place of cv2.findEssentialMat,
findFundamentalMat, findHomography, estimateAffine2D, estimateAffinePartial2D and xfeatures2d.matchGMS. The script stays
as it is. At its end a table on stderr tells, for each call, how many matches OpenCV's own function and the filter keep,
how often there was no model, and what both took; below it stands what the filter did not see."""
_EPILOG = """\
Options of this command come before SCRIPT; what comes behind it is the script's.

exit status: what the script exits with; 2 = there is no such script, or the filter does not start."""


def build_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = OneLineParser(
        prog="mgca-match run",
        usage="%(prog)s [options] SCRIPT.py [ARGUMENTS ...]",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("script", metavar="SCRIPT.py", type=Path, help="Python script that calls cv2")
    parser.add_argument("arguments", metavar="ARGUMENTS", nargs=argparse.REMAINDER, help="what the script gets")
    add_providers_option(parser)
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command; 0 = the script ended, 2 = there is no script or no filter; else what the script exits with."""
    try:
        options = build_parser().parse_args(arguments)
        if options.providers:
            os.environ[PROVIDERS_VARIABLE] = ",".join(options.providers)
        if not options.script.is_file():
            raise UsageError(f"{options.script}: no such file")
        MatchFilter()  # opens the model, so that the first call's time is that of a call
    except (UsageError, MgcaFilterError) as error:
        print(f"mgca-match: {one_line(error)}", file=sys.stderr)
        return EXIT_USAGE
    run_script(options.script, options.arguments)
    return EXIT_FOUND
