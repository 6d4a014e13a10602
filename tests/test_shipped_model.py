"""The shipped model files: present, small, of the contract, and the same in ONNX Runtime and torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mgca_filter
from mgca_filter.export import parity
from mgca_filter.inference import Backend, shared_backend
from mgca_filter.network import PRESETS, NetworkConfig

MODELS = Path(mgca_filter.__file__).parent / "models"
ONNX, TORCH = MODELS / "mgca_small.onnx", MODELS / "mgca_small.safetensors"


@pytest.fixture(scope="module")
def backends() -> tuple[Backend, Backend]:
    return shared_backend(ONNX, "onnxruntime"), shared_backend(TORCH, "torch")


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 127, 2000])
def test_onnx_runtime_says_what_torch_says(backends, count):
    row = parity.compare(*backends, count)
    assert row.passed, parity.format_parity([row])


def test_both_files_are_one_model(backends):
    onnx_metadata, torch_metadata = (vars(backend.metadata).copy() for backend in backends)
    priors = [metadata.pop("prior") for metadata in (onnx_metadata, torch_metadata)]
    for metadata in (onnx_metadata, torch_metadata):
        metadata.pop("sha256")
    assert onnx_metadata == torch_metadata
    for name in ("weight1", "bias1", "weight2", "bias2"):
        np.testing.assert_array_equal(getattr(priors[0], name), getattr(priors[1], name))
    assert NetworkConfig.from_dict(onnx_metadata["config"]) == PRESETS["small"]


def test_right_matches_score_higher_than_wrong_ones(backends):
    inputs = parity.two_view_input(600)
    logits = backends[0].infer(*inputs)[0][0]
    bare = backends[0].infer(inputs[0], np.zeros_like(inputs[1]))[0][0]
    # The right matches of the synthetic pair are those that its generator did not draw at random.
    rng = np.random.default_rng([0, 600])
    rng.uniform(-2, 2, (600, 2))
    rng.uniform(4, 9, 600)
    right = rng.random(600) < 1 / 3
    for scores in (logits, bare):
        order = np.argsort(np.argsort(scores))
        auc = (order[right].mean() - (right.sum() - 1) / 2) / (~right).sum()
        assert auc > 0.9


def test_files_are_small_and_described():
    assert ONNX.stat().st_size < 20e6
    card = (MODELS / "mgca_small.md").read_text(encoding="utf-8")
    assert "licen" in card.lower()
