"""OpenVINO runs the model files by itself, as ``docs/how_to/runtimes.md`` says."""

from __future__ import annotations

import numpy as np
import pytest

import mgca_filter
from mgca_filter.export import parity
from mgca_filter.inference import open_backend

openvino = pytest.importorskip("openvino", reason="OpenVINO is not installed")


@pytest.mark.parametrize("name", ["default", "fast"])
def test_openvino_says_what_onnx_runtime_says(name: str) -> None:
    path = mgca_filter.model_path(name)
    reference = open_backend(path, "onnxruntime")
    model = openvino.Core().read_model(path)
    model.reshape({"correspondences": [1, -1, 4], "attributes": [1, -1, 8]})
    compiled = openvino.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    for count in (512, 300, 1, 300, 700, 2000, 128, 512):  # of changing shape: memory moves between the passes
        pair = parity.two_view_input(count)
        (logits, E), (expected, expected_E) = compiled(list(pair)).values(), reference.infer(*pair)
        assert np.quantile(np.abs(logits - expected), 0.9) < parity.QUANTILE_TOLERANCE
        if count >= parity.ESSENTIAL_FROM:
            difference = min(np.abs(E - expected_E).max(), np.abs(E + expected_E).max())
            assert difference < parity.ESSENTIAL_TOLERANCE
