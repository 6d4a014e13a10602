"""``mgca-match``: two images, or what the first word says: ``colmap``, ``hloc``, ``folder``, ``run``, ``train``, …"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

PIPELINES = ("colmap", "hloc", "folder")
# Commands that are modules of their own as well (``python -m mgca_filter.training``), and the extra that they need.
SIBLINGS = {"train": ("training", "train"), "evaluate": ("evaluation", "eval")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status (0 = geometry found, 1 = none, 2 = usage)."""
    # ONNX Runtime reports its use to its makers, and complains where it cannot; a filter has no business to.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files need not fit its encoding
            stream.reconfigure(errors="backslashreplace")
    words = sys.argv[1:] if arguments is None else list(arguments)
    first = words[0] if words else ""
    if first in PIPELINES and not Path(first).is_file():
        from .pipelines import main as run_pipeline

        return run_pipeline(words)
    if first == "run" and not Path(first).is_file():
        from .run_script import main as run_script

        return run_script(words[1:])
    if first in SIBLINGS and not Path(first).is_file():
        return _run_sibling(*SIBLINGS[first], words[1:])
    from .pair import main as match_pair

    return match_pair(words)


def _run_sibling(package: str, extra: str, words: Sequence[str]) -> int:
    try:
        command = import_module(f"mgca_filter.{package}.__main__")
    except ModuleNotFoundError as error:
        print(f"mgca-match: {error}; pip install 'mgca_filter[{extra}]' brings it", file=sys.stderr)
        return 2
    return int(command.main(words))
