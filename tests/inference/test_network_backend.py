"""A network in memory says what the torch backend says of its weights in a file."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from conftest import make_scene
from networks import TINY, tiny_network, two_view_batch

from mgca_filter import MatchFilter
from mgca_filter.errors import BackendError
from mgca_filter.export.onnx_export import ModelDescription, model_metadata
from mgca_filter.inference import Backend, TorchBackend
from mgca_filter.inference.calibration import Calibration
from mgca_filter.inference.network_backend import NetworkBackend, network_metadata
from mgca_filter.inputs.options import FilterOptions
from mgca_filter.network import save_network

FROM_A_FILE = {"name", "version", "git_commit", "training_data", "detector", "normalization", "license"} | {
    "minimum_onnxruntime",
    "sha256",
}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Backend, Backend]:
    """One network in memory and in a file."""
    network, path = tiny_network(seed=3), tmp_path_factory.mktemp("model") / "tiny.safetensors"
    save_network(network, path, model_metadata(network, ModelDescription("tiny", "0", "none", "none", "none")))
    return NetworkBackend(network), TorchBackend(path)


@pytest.mark.parametrize("count", [1, 7, 9, 127])
def test_answers_are_those_of_the_file(both: tuple[Backend, Backend], count: int) -> None:
    batch = [tensor.numpy() for tensor in two_view_batch(count, 2)]
    for mine, other in zip(both[0].infer(*batch), both[1].infer(*batch), strict=True):
        np.testing.assert_array_equal(mine, other)
        assert mine.dtype == other.dtype == np.float32
    copy = pickle.loads(pickle.dumps(both[0]))
    np.testing.assert_array_equal(copy.infer(*batch)[0], both[0].infer(*batch)[0])


def test_metadata_are_those_of_the_file(both: tuple[Backend, Backend]) -> None:
    mine, other = (backend.metadata for backend in both)
    for field in dataclasses.fields(mine):
        one, two = getattr(mine, field.name), getattr(other, field.name)
        if field.name == "prior":
            for part in ("weight1", "bias1", "weight2", "bias2"):
                np.testing.assert_array_equal(getattr(one, part), getattr(two, part))
        else:
            assert one == two or field.name in FROM_A_FILE, field.name


def test_a_network_without_prior_rejects_what_does_not_enter() -> None:
    network = tiny_network(dataclasses.replace(TINY, attributes=False))
    prior = network_metadata(network).prior
    assert (prior.logits(np.ones((3, 8), np.float32)) == -100.0).all()
    scene = make_scene(right=100, wrong=400)
    result = MatchFilter.over(NetworkBackend(network)).filter(
        scene.points1, scene.points2, None, attributes=scene.attributes
    )
    assert (result.info["logits"] == -100.0).sum() == 500 - result.info["num_network_matches"] > 0


def test_a_filter_over_a_backend_takes_options(both: tuple[Backend, Backend]) -> None:
    scene = make_scene()
    arguments = (scene.points1, scene.points2, None)
    result = MatchFilter.over(both[0], options=FilterOptions(method="none")).filter(
        *arguments, attributes=scene.attributes
    )
    assert result.E is None
    assert result.info["backend"] == "network"
    metadata = dataclasses.replace(both[0].metadata, calibration=Calibration(0.5, 1.0))
    fitted = MatchFilter.over(NetworkBackend(tiny_network(seed=3), metadata), options=FilterOptions(method="none"))
    scores = fitted.filter(*arguments, attributes=scene.attributes).scores
    np.testing.assert_array_equal(scores, metadata.calibration.probabilities(result.info["logits"]))


def test_input_that_is_none_is_refused(both: tuple[Backend, Backend]) -> None:
    with pytest.raises(BackendError, match="finite"):
        both[0].infer(np.full((1, 9, 4), np.nan, np.float32), np.zeros((1, 9, 8), np.float32))


def test_what_pytorch_refuses_is_an_error_of_the_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    network = tiny_network()

    def refuse(*inputs: object) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(network, "forward", refuse)
    with pytest.raises(BackendError, match="out of memory"):
        NetworkBackend(network).infer(np.zeros((1, 9, 4), np.float32), np.zeros((1, 9, 8), np.float32))
