#!/usr/bin/env python3
"""Install the package against the oldest and the newest numpy, OpenCV and ONNX Runtime, and run ``.ci/smoke.py``.

``.ci/try_versions.py [WHEEL]``: a virtual environment for each row, made of the bounds that setup.cfg has for them
and of what the package index holds today; and one that had ``opencv-python`` before, of which nothing may change.
Without WHEEL the checkout is installed. Exit status 1 where a row fails.
"""

from __future__ import annotations

import configparser
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WINDOWS = """
import cv2
print(cv2.__version__, callable(cv2.imshow), any(kit in cv2.getBuildInformation() for kit in ("GTK+: ", "QT: ")))
"""


def bounds() -> dict[str, str]:
    """Oldest version of each requirement, by package."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    lines = setup["options"]["install_requires"].split() + setup["options.extras_require"]["opencv"].split()
    return dict(line.split(">=") for line in lines)


def rows() -> dict[str, list[str]]:
    """What is installed beside the package, by name of the row."""
    oldest = bounds()
    opencv = "opencv-contrib-python-headless"
    # The oldest OpenCV that setup.cfg names has wheels that were built before numpy 2: old goes with old.
    return {
        "oldest": [f"{name}=={version}.*" for name, version in oldest.items()],
        "oldest OpenCV, newest others": [f"{opencv}=={oldest[opencv]}.*", "numpy", "onnxruntime"],
        "oldest ONNX Runtime, newest others": [opencv, "numpy<2", f"onnxruntime=={oldest['onnxruntime']}.*"],
        "newest": list(oldest),
        "beside opencv-python": ["opencv-python"],
    }


def try_row(packages: list[str], wheel: str, folder: Path) -> str:
    """What the smoke test printed.

    Raises:
        subprocess.CalledProcessError: something failed; its output tells what.
    """
    venv.create(folder, with_pip=True)
    python = str(folder / "bin" / "python")

    def run(*words: str) -> str:
        return subprocess.run([python, *words], check=True, capture_output=True, text=True, cwd=folder).stdout

    run("-m", "pip", "install", "-q", *packages)
    before = run("-c", WINDOWS), sorted(line for line in run("-m", "pip", "freeze").splitlines() if "opencv" in line)
    run("-m", "pip", "install", "-q", wheel, *(p for p in packages if not p.startswith("opencv-python")))
    after = run("-c", WINDOWS), sorted(line for line in run("-m", "pip", "freeze").splitlines() if "opencv" in line)
    if before != after:
        raise subprocess.CalledProcessError(1, "pip install", f"OpenCV was {before} and is {after}")
    return run(str(ROOT / ".ci" / "smoke.py")).strip() + f" [{', '.join(after[1])}]"


def main() -> int:
    """Try every row and print one line for each."""
    wheel = str(Path(sys.argv[1]).resolve()) if len(sys.argv) > 1 else str(ROOT)
    failed = 0
    for name, packages in rows().items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                print(f"{name}: {try_row(packages, wheel, Path(folder))}", flush=True)
            except subprocess.CalledProcessError as error:
                failed += 1
                print(f"{name}: FAILED {error.cmd}\n{error.stdout or ''}{error.stderr or ''}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
