"""The published model files: present, small, of the contract, and the same in ONNX Runtime and torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import K, make_scene

import mgca_filter
from mgca_filter.errors import ModelError
from mgca_filter.export import parity
from mgca_filter.inference import Backend, shared_backend
from mgca_filter.match_filter import PUBLISHED_MODELS
from mgca_filter.network import PRESETS, NetworkConfig

CONFIGS = {"default": PRESETS["small"], "fast": replace(PRESETS["small"], stages=1, refined_feedback=False)}


@pytest.fixture(scope="module", params=PUBLISHED_MODELS)
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def backends(name) -> tuple[Backend, Backend]:
    path = mgca_filter.model_path(name)
    return shared_backend(path, "onnxruntime"), shared_backend(path.with_suffix(".safetensors"), "torch")


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 127, 2000])
def test_onnx_runtime_says_what_torch_says(backends, count):
    row = parity.compare(*backends, count)
    assert row.passed, parity.format_parity([row])


def test_both_files_are_one_model(name, backends):
    onnx_metadata, torch_metadata = (vars(backend.metadata).copy() for backend in backends)
    priors = [metadata.pop("prior") for metadata in (onnx_metadata, torch_metadata)]
    for metadata in (onnx_metadata, torch_metadata):
        metadata.pop("sha256")
    assert onnx_metadata == torch_metadata
    for layer in ("weight1", "bias1", "weight2", "bias2"):
        np.testing.assert_array_equal(getattr(priors[0], layer), getattr(priors[1], layer))
    assert NetworkConfig.from_dict(onnx_metadata["config"]) == CONFIGS[name]


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


def test_files_are_small_and_described(name):
    path = mgca_filter.model_path(name)
    assert path.stat().st_size < 16 * 2**20
    card = path.with_suffix(".md").read_text(encoding="utf-8")
    assert path.stem in card
    assert "licen" in card.lower()


def test_published_models_have_names():
    scene = make_scene(right=40, wrong=160, seed=3)
    rows = (scene.points1, scene.points2, None)
    told = [
        mgca_filter.filter_matches(*rows, K1=K, K2=K, model=model, effort="full")
        for model in (None, "default", mgca_filter.model_path(), "fast")
    ]
    both = "mgca_fast + mgca_small"
    assert [result.info["model"] for result in told] == [both, both, "mgca_small", "mgca_fast"]
    assert [" + ".join(result.info["networks"]) for result in told] == [result.info["model"] for result in told]
    for wrong, error in (("fastest", ModelError), (3, TypeError)):
        with pytest.raises(error):
            mgca_filter.MatchFilter(model=wrong)
    with pytest.raises(ValueError, match="default, fast"):
        mgca_filter.model_path("fastest")
