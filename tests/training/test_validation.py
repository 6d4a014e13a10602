"""Validation while training looks at what users run: the same order, weights and margins enter the robust fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from networks import tiny_network
from scene_bundles import write_bundle

from mgca_filter import MatchFilter, match_filter
from mgca_filter.data.scene_bundle import SceneBundle
from mgca_filter.evaluation.metrics import precision_recall_f
from mgca_filter.export.onnx_export import ModelDescription, model_metadata
from mgca_filter.inputs.attributes import candidate_mask
from mgca_filter.network import save_network
from mgca_filter.training import validation


def test_matches_are_ranked_as_the_filter_ranks_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network, weights = tiny_network(seed=2), tmp_path / "tiny.safetensors"
    save_network(network, weights, model_metadata(network, ModelDescription("tiny", "0", "none", "none", "none")))
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", [make_scene()]))[0]
    ranked = []
    for module, name in ((match_filter, "estimate_model"), (validation, "estimate_pose")):
        monkeypatch.setattr(module, name, lambda matches, *others, **options: ranked.append(matches))
    MatchFilter(model=weights).filter(
        pair.points1, pair.points2, None, K1=pair.K1, K2=pair.K2, attributes=pair.attributes
    )
    validation.evaluate_pair(network, pair)
    filtered, validated = ranked
    np.testing.assert_array_equal(validated.correspondences, filtered.correspondences)
    np.testing.assert_allclose(validated.margins, filtered.margins, atol=1e-6)
    np.testing.assert_allclose(validated.weights, filtered.weights, atol=1e-6)


def test_matches_that_never_enter_the_network_are_rejected(tmp_path: Path) -> None:
    network = tiny_network(seed=2)
    assert network.prior is not None
    network.prior.output.bias.data.fill_(5.0)  # a prior that would accept everything
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", [make_scene(right=100, wrong=400)]))[0]
    entered = candidate_mask(pair.attributes.encode(len(pair.points1)))
    assert 0 < np.count_nonzero(~entered) < len(entered)
    figures = validation.evaluate_pair(network, pair)
    assert (figures.logits[~entered] <= 0).all()
    assert figures.at(0.0) == precision_recall_f(entered & (figures.logits > 0), figures.truth)
