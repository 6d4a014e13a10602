"""Validation is the product: a network in memory does as the evaluation says of a model file with its weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from networks import tiny_network
from scene_bundles import write_bundle

from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.evaluation.metrics import precision_recall_f
from mgca_filter.evaluation.predict import evaluate_pair as evaluate_row
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.export.onnx_export import ModelDescription, model_metadata
from mgca_filter.inference.network_backend import NetworkBackend
from mgca_filter.inputs.attributes import MatchAttributes, candidate_mask
from mgca_filter.network import MGCANet, load_network, save_network
from mgca_filter.training.validation import evaluate_pair, quick_validation


@pytest.fixture(scope="module")
def shipped() -> MGCANet:
    """The shipped network: an untrained one would have no pose to compare."""
    return load_network(Path(__file__).parents[2] / "mgca_filter" / "models" / "mgca_small.safetensors")


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[ScenePair]:
    """Two pairs with more wrong matches than right ones, and one of a camera that did not move."""
    scenes = [make_scene(seed=0, right=100, wrong=400), make_scene(seed=1, right=80, wrong=100), make_scene("rotation")]
    bundle = SceneBundle(write_bundle(tmp_path_factory.mktemp("pairs") / "hall.npz", scenes))
    return [bundle[index] for index in range(3)]


def test_figures_are_those_of_the_evaluation(shipped: MGCANet, pairs: list[ScenePair], tmp_path: Path) -> None:
    weights = tmp_path / "shipped.safetensors"
    save_network(shipped, weights, model_metadata(shipped, ModelDescription("shipped", "0", "none", "none", "none")))
    rows = [parse_method(name, str(weights)) for name in ("product", "network E")]
    match_filter = MatchFilter.over(NetworkBackend(shipped))
    errors = []
    for pair in pairs:
        figures = evaluate_pair(match_filter, pair)
        errors.append(figures.fit_deg)
        product, alone = (evaluate_row(row, pair, 0) for row in rows)
        assert figures.fit_deg == product.error_deg
        assert figures.essential_deg == alone.error_deg
        assert figures.at(0.0) == product.kept
    assert max(errors[:2]) < 5.0 < errors[2] == 180.0  # no pose counts as one that is all wrong
    assert quick_validation(shipped, pairs)["fit_mAP@5"] == pytest.approx(200.0 / 3.0)


def test_matches_that_never_enter_the_network_are_rejected(pairs: list[ScenePair]) -> None:
    network, pair = tiny_network(seed=2), pairs[0]
    assert network.prior is not None
    network.prior.output.bias.data.fill_(5.0)  # a prior that would accept everything
    entered = candidate_mask(pair.attributes.encode(len(pair.points1)))
    assert 0 < np.count_nonzero(~entered) < len(entered)
    figures = evaluate_pair(MatchFilter.over(NetworkBackend(network)), pair)
    assert (figures.logits[~entered] < 0).all()
    assert figures.at(0.0) == precision_recall_f(entered & (figures.logits > 0), figures.truth)


def test_a_pair_without_matches_is_a_failure(pairs: list[ScenePair]) -> None:
    match_filter = MatchFilter.over(NetworkBackend(tiny_network()))
    figures = evaluate_pair(match_filter, pairs[0], (np.zeros(0, dtype=np.intp), MatchAttributes()))
    assert figures.fit_deg == figures.essential_deg == 180.0
    assert figures.at(0.0) == (0.0, 0.0, 0.0)
