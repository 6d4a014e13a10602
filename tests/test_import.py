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


def test_public_names_exist() -> None:
    assert all(hasattr(mgca_filter, name) for name in mgca_filter.__all__)
    assert mgca_filter.model_path().name == "mgca_small.onnx"
