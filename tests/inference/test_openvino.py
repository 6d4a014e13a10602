"""OpenVINO runs the model files by itself, as ``docs/how_to/runtimes.md`` says."""

from __future__ import annotations

import pytest

import mgca_filter
from mgca_filter.export import parity
from mgca_filter.inference import open_backend

pytest.importorskip("openvino", reason="OpenVINO is not installed")


@pytest.mark.parametrize("name", ["default", "fast"])
def test_openvino_says_what_onnx_runtime_says(name: str) -> None:
    path = mgca_filter.model_path(name)
    openvino, reference = parity.OpenVinoRuntime(path), open_backend(path, "onnxruntime")
    for count in (512, 300, 1, 300, 700, 2000, 128, 512):  # of changing shape: memory moves between the passes
        row = parity.compare(openvino, reference, count)
        assert row.passed, parity.format_parity([row])
