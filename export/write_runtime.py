"""Measure speed, memory and parity anew and put them into ``docs/runtime.md``: ``python export/write_runtime.py``.

Each place of the page holds what one command of this folder prints. The machine has to be idle. With ``--bundles``
parity is shown on candidates of real pairs as well.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from pages import fill_file, provenance

FOLDER = Path(__file__).resolve().parent
PAGE = FOLDER.parent / "docs" / "runtime.md"
COMMANDS = {
    "one_thread": ("benchmark.py", "--threads", "1"),
    "two_threads": ("benchmark.py", "--threads", "2"),
    "floor_500": ("floor.py", "--count", "500", "--threads", "1"),
    "floor_2000": ("floor.py", "--count", "2000", "--threads", "1"),
    "parity": ("parity.py",),
}


def run(command: Sequence[str]) -> str:
    """What a command of this folder prints.

    Raises:
        SystemExit: it failed; what it printed goes to standard error, where it has said why.
    """
    script, *arguments = command
    done = subprocess.run([sys.executable, str(FOLDER / script), *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        print(done.stdout, file=sys.stderr)
        raise SystemExit(done.returncode)
    return done.stdout.strip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the commands that were asked for, all by default, and fill their places one by one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundles", type=Path, help="scene bundles for the parity on real pairs")
    parser.add_argument("--only", nargs="+", choices=tuple(COMMANDS), metavar="PLACE", help="these places alone")
    options = parser.parse_args(arguments)
    for name in options.only or COMMANDS:
        command = COMMANDS[name]
        if name == "parity" and options.bundles:
            command = (*command, "--bundles", str(options.bundles))
        print(name, file=sys.stderr, flush=True)
        fill_file(PAGE, {name: f"{run(command)}\n\n{provenance()}"})


if __name__ == "__main__":
    main()
