"""Weights files: what is saved comes back; what is broken is named."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from networks import TINY, tiny_network, two_view_batch
from safetensors.torch import save_file

from mgca_filter.errors import ModelError
from mgca_filter.network import MGCANet, load_network, save_network, transfer_weights
from mgca_filter.network.weights import count_parameters, read_metadata


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.safetensors"
    save_network(tiny_network(), path, {"name": "tiny"})
    return path


def test_saved_networks_come_back(weights):
    saved, loaded = tiny_network(), load_network(weights)
    assert loaded.config == saved.config
    for mine, given in zip(loaded.state_dict().values(), saved.state_dict().values(), strict=True):
        assert torch.equal(mine, given)
    batch = two_view_batch(30)
    torch.testing.assert_close(loaded(*batch).logits, saved(*batch).logits, atol=0, rtol=0)


def test_loaded_networks_are_for_inference(weights):
    loaded = load_network(weights)
    assert not any(module.training for module in loaded.modules())
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_metadata_hold_name_and_config(weights):
    assert read_metadata(weights) == {"name": "tiny", "config": TINY.to_json()}


@pytest.mark.parametrize("size", [0, 5, 100, -1])
def test_truncated_files_are_named(weights, size):
    weights.write_bytes(weights.read_bytes()[:size])
    with pytest.raises(ModelError, match=r"tiny\.safetensors"):
        load_network(weights)


@pytest.mark.parametrize("content", [b"not weights at all", b"PK\x03\x04" + bytes(100), bytes(64)])
def test_other_files_are_named(tmp_path, content):
    path = tmp_path / "picture.safetensors"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"picture\.safetensors"):
        load_network(path)


def test_missing_files_and_folders_are_named(tmp_path):
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(ModelError, match=path.name):
            load_network(path)


@pytest.mark.parametrize(
    "config",
    [
        dataclasses.replace(TINY, channels=16).to_json(),
        dataclasses.replace(TINY, stages=1).to_json(),
        json.dumps({"chanels": 8}),
        json.dumps({"channels": "8"}),
        json.dumps({"channels": 8.0}),
        json.dumps({"preset": "huge"}),
        json.dumps([1, 2]),
        "8",
        "null",
        "{",
    ],
)
def test_weights_of_another_network_are_refused(tmp_path, config):
    path = tmp_path / "other.safetensors"
    save_file(dict(tiny_network().state_dict()), str(path), {"config": config})
    with pytest.raises(ModelError, match=r"other\.safetensors"):
        load_network(path)


def test_weights_without_config_are_refused(tmp_path):
    path = tmp_path / "bare.safetensors"
    save_file({"w": torch.zeros(1)}, str(path))
    with pytest.raises(ModelError, match=r"bare\.safetensors.*config"):
        load_network(path)


def test_parameters_are_counted_without_statistics():
    network = tiny_network()
    total = sum(tensor.numel() for tensor in network.state_dict().values())
    statistics = sum(buffer.numel() for buffer in network.buffers())
    assert count_parameters(network) == total - statistics > 0


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_equal_networks_end_up_equal(stages):
    config = dataclasses.replace(TINY, stages=stages)
    source, target = tiny_network(config), MGCANet(config)
    transfer_weights(source, target)
    for mine, given in zip(target.state_dict().values(), source.state_dict().values(), strict=True):
        assert torch.equal(mine, given)


def test_a_further_stage_starts_as_a_copy_and_leaves_the_others_alone():
    source, target = tiny_network(), MGCANet(dataclasses.replace(TINY, stages=3)).eval()
    transfer_weights(source, target)
    batch = two_view_batch(40)
    with torch.inference_mode():
        before, after = source(*batch), target(*batch)
    for head in range(2):
        torch.testing.assert_close(after.heads[head].logits, before.heads[head].logits)
    copied = target.stages[2].point_cn3.state_dict()
    for name, tensor in source.stages[1].point_cn3.state_dict().items():
        assert torch.equal(copied[name], tensor)
    wider, narrow = (network.state_dict()["final.consensus.reduce.0.weight"] for network in (target, source))
    assert torch.equal(wider, narrow)


@pytest.mark.parametrize("stages", [1, 2])
def test_the_first_stages_of_a_longer_network_are_a_start(stages):
    source = tiny_network(dataclasses.replace(TINY, stages=3))
    target = MGCANet(dataclasses.replace(TINY, stages=stages)).eval()
    transfer_weights(source, target)
    batch = two_view_batch(40)
    with torch.inference_mode():
        before, after = source(*batch), target(*batch)
    for head in range(stages):
        torch.testing.assert_close(after.heads[head].logits, before.heads[head].logits)


def test_weights_may_go_on_with_other_feedback():
    source = tiny_network(dataclasses.replace(TINY, stages=3))
    target = MGCANet(dataclasses.replace(source.config, refined_feedback=True))
    transfer_weights(source, target)
    for mine, given in zip(target.state_dict().values(), source.state_dict().values(), strict=True):
        assert torch.equal(mine, given)


@pytest.mark.parametrize("change", [{"channels": 12}, {"neighbours": 9}])
def test_weights_of_another_network_are_no_start(change):
    with pytest.raises(ValueError, match="no start"):
        transfer_weights(tiny_network(), MGCANet(dataclasses.replace(TINY, **change)))
