"""Measure speed, memory and parity anew for ``docs/runtime.md``: ``python -m benchmarks.fill_docs.runtime``.

Each place of the page holds what one command prints. The machine has to be idle. With ``--bundles``
parity is shown on candidates of real pairs as well; the places of the lists want ``--lists``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from .pages import fill_file, provenance

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "runtime.md"
COMMANDS = {
    "one_thread": ("-m", "benchmarks.speed", "--threads", "1"),
    "two_threads": ("-m", "benchmarks.speed", "--threads", "2"),
    "lists": ("-m", "benchmarks.speed", "--per-scene", "1"),
    "lists_fast": ("-m", "benchmarks.speed", "--per-scene", "1", "--model", "fast"),
    "opening": ("-m", "benchmarks.opening"),
    "scaling": ("-m", "benchmarks.profile_network", "--scaling", "--threads", "1"),
    "scaling_fast": (
        *("-m", "benchmarks.profile_network", "mgca_filter/models/mgca_fast.onnx"),
        *("--scaling", "--threads", "1"),
    ),
    "profile_500": ("-m", "benchmarks.profile_network", "--count", "500", "--threads", "1"),
    "profile_2000": ("-m", "benchmarks.profile_network", "--count", "2000", "--threads", "1"),
    "parity": ("export/parity.py",),
}

LISTS = {"lists", "lists_fast"}
"""Those that hold the times on the lists of scene bundles."""


def run(command: Sequence[str]) -> str:
    """What a command of Python's prints, run at the root of the repository.

    Raises:
        SystemExit: it failed; what it printed goes to standard error, where it has said why.
    """
    done = subprocess.run([sys.executable, *command], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    if done.returncode:
        print(done.stdout, file=sys.stderr)
        raise SystemExit(done.returncode)
    return done.stdout.strip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the commands that were asked for, all by default, and fill their places one by one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundles", type=Path, help="scene bundles for the parity on real pairs")
    parser.add_argument(
        "--lists", nargs="+", metavar="FOLDER", help="scene bundles of several detectors, for the lists"
    )
    parser.add_argument("--only", nargs="+", choices=tuple(COMMANDS), metavar="PLACE", help="these places alone")
    options = parser.parse_args(arguments)
    names = options.only or tuple(COMMANDS)
    if options.lists is None and not LISTS.isdisjoint(names):
        parser.error("--lists: the places of the lists need them; --only leaves them out")
    for name in names:
        command = COMMANDS[name]
        if name in LISTS:
            command = (*command, "--bundles", *options.lists)
        if name == "parity" and options.bundles:
            command = (*command, "--bundles", str(options.bundles))
        print(name, file=sys.stderr, flush=True)
        fill_file(PAGE, {name: f"{run(command)}\n\n{provenance()}"})


if __name__ == "__main__":
    main()
