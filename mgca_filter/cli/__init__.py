"""``mgca-match``: two images, or what the first word says: ``colmap``, ``hloc``, ``folder`` or ``run script.py``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

PIPELINES = ("colmap", "hloc", "folder")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status (0 = geometry found, 1 = none, 2 = usage)."""
    # ONNX Runtime reports its use to its makers, and complains where it cannot; a filter has no business to.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    words = sys.argv[1:] if arguments is None else list(arguments)
    first = words[0] if words else ""
    if first in PIPELINES and not Path(first).is_file():
        from .pipelines import main as run_pipeline

        return run_pipeline(words)
    if first == "run" and not Path(first).is_file():
        from ..opencv.script import main as run_script

        return run_script(words[1:])
    from .pair import main as match_pair

    return match_pair(words)
