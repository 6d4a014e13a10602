"""The command as users call it, in a process of its own, and what it says when it fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
K_WORDS = "512,512,319.5,239.5"


def start_command(*arguments: object, **options) -> subprocess.Popen:
    """``mgca-match`` in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "mgca_filter", *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **options
    )


def assert_one_line(captured, *words: str) -> None:
    """One line on stderr with all the words, nothing on stdout."""
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    for word in words:
        assert word in captured.err
