"""Importing the package is light: no deep-learning framework, no ONNX, no plotting."""

from __future__ import annotations

import subprocess
import sys

import pytest

import mgca_filter


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("module", ["torch", "onnx", "matplotlib", "onnxruntime", "poselib"])
def test_import_leaves_module_alone(module: str) -> None:
    assert run_python(f"import sys, mgca_filter; print({module!r} in sys.modules)").strip() == "False"


def test_import_works_where_optional_packages_are_missing() -> None:
    blocked = "import sys; sys.modules.update(dict.fromkeys(['torch', 'onnx', 'matplotlib', 'onnxruntime', 'poselib']))"
    assert run_python(f"{blocked}; import mgca_filter; print(mgca_filter.__version__)").strip() == "0.1.0"


def failure(code: str) -> str:
    """The last line that a program which does not end well leaves on stderr."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    return done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "cv2",
    [
        "sys.modules['cv2'] = None",  # none
        "sys.modules['cv2'] = types.ModuleType('cv2')",  # the folder that a removed wheel left
    ],
)
def test_without_opencv_one_line_says_what_to_install(cv2: str) -> None:
    line = failure(f"import sys, types; {cv2}; import mgca_filter")
    assert line.startswith("ImportError: mgca_filter needs OpenCV")
    assert "pip install opencv-contrib-python " in line
    assert "pip install opencv-contrib-python-headless" in line


@pytest.mark.parametrize(
    ("found", "fails"), [("4.9.0", True), ("3.4.18", True), ("4.10.0-dev", False), ("5.0.0", False)]
)
def test_an_opencv_that_is_too_old_is_told(found: str, fails: bool) -> None:
    code = f"import cv2; cv2.__version__ = {found!r}; import mgca_filter"
    if fails:
        assert (
            failure(code) == f"ImportError: mgca_filter needs OpenCV 4.10 or newer, this is {found}: upgrade its wheel"
        )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == int(fails)


def test_an_opencv_that_does_not_load_says_so_itself() -> None:
    """As ``opencv-python`` does on a machine without libGL."""
    finder = "class F:\n  def find_spec(s, n, p=None, t=None):\n    if n == 'cv2': raise ImportError('libGL.so.1')\n"
    assert failure(f"{finder}import sys; sys.meta_path.insert(0, F()); import mgca_filter") == "ImportError: libGL.so.1"


def test_public_names_exist() -> None:
    assert all(hasattr(mgca_filter, name) for name in mgca_filter.__all__)
    assert mgca_filter.model_path().name == "mgca_small.onnx"
