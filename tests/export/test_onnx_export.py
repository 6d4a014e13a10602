"""The ONNX file keeps its contract and says what the torch network says."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from networks import settled_network, two_view_batch

from mgca_filter.export import parity
from mgca_filter.export.onnx_export import ModelDescription, export_model, model_metadata
from mgca_filter.export.trial_graph import bodies, count_nodes
from mgca_filter.inference import METADATA_KEYS, Backend, open_backend
from mgca_filter.inference.calibration import Calibration
from mgca_filter.network import MGCANet, NetworkConfig, save_network

CONFIG = NetworkConfig(channels=16, clusters=8, stages=2)
DESCRIPTION = ModelDescription(
    name="tiny",
    version="1.2",
    git_commit="abc",
    training_data="random weights",
    license="none",
    calibration=Calibration(0.7, -0.3),
    decision_threshold=0.25,
)


@dataclasses.dataclass(frozen=True)
class Exported:
    network: MGCANet
    onnx_path: Path
    torch_path: Path
    onnx: Backend
    torch: Backend


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    network = settled_network(CONFIG)
    paths = export_model(network, tmp_path_factory.mktemp("export"), DESCRIPTION)
    return Exported(network, *paths, open_backend(paths[0], "onnxruntime"), open_backend(paths[1], "torch"))


@pytest.fixture(scope="module")
def model(exported: Exported) -> onnx.ModelProto:
    return onnx.load(str(exported.onnx_path))


def test_the_graph_is_opset_17_without_what_opencv_lacks(model):
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 17)]
    nodes = all_nodes(model.graph)
    assert not {node.op_type for node in nodes} & {"If", "Scan", "Einsum", "Conv", "SequenceConstruct", "SequenceAt"}
    assert all(node.domain == "" for node in nodes)
    assert {"MatMul", "Loop"} <= {node.op_type for node in nodes}


def all_nodes(graph: onnx.GraphProto) -> list[onnx.NodeProto]:
    """Nodes of a graph and of the bodies inside it."""
    inner = [body for node in graph.node for body in bodies(node)]
    return [*graph.node, *(node for body in inner for node in all_nodes(body))]


def test_what_a_loop_starts_with_is_read_by_it_alone(model):
    """OpenCV writes over it."""
    graphs = [model.graph, *(body for node in all_nodes(model.graph) for body in bodies(node))]
    read = Counter(name for node in all_nodes(model.graph) for name in node.input)
    starts = [name for graph in graphs for node in graph.node if node.op_type == "Loop" for name in node.input[2:]]
    assert starts
    assert {read[name] for name in starts} == {1}


def test_no_sizes_are_left_to_compute(model):
    operators = Counter(node.op_type for node in model.graph.node)
    assert operators["Shape"] == 1
    assert not {"Constant", "ReduceMean", "Identity"} & set(operators)


def test_no_tensor_is_float64(model):
    double = onnx.TensorProto.DOUBLE
    assert not [tensor.name for tensor in model.graph.initializer if tensor.data_type == double]
    constants = [a.t for node in model.graph.node for a in node.attribute if a.type == onnx.AttributeProto.TENSOR]
    assert constants
    assert not [tensor.name for tensor in constants if tensor.data_type == double]
    casts = [a.i for node in model.graph.node if node.op_type == "Cast" for a in node.attribute if a.name == "to"]
    assert double not in casts
    inferred = onnx.shape_inference.infer_shapes(model).graph.value_info
    assert not [value.name for value in inferred if value.type.tensor_type.elem_type == double]


def test_inputs_and_outputs_declare_their_shapes(model):
    def shapes(values: list[onnx.ValueInfoProto]) -> dict[str, list[str | int]]:
        assert all(value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT for value in values)
        return {v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim] for v in values}

    assert shapes(model.graph.input) == {"correspondences": ["B", "N", 4], "attributes": ["B", "N", 8]}
    assert shapes(model.graph.output) == {"logits": ["B", "N"], "essential": ["B", 3, 3]}


def test_metadata_say_what_was_described(exported, model):
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert set(properties) == set(METADATA_KEYS)
    assert NetworkConfig.from_json(properties["config"]) == CONFIG
    for backend in (exported.onnx, exported.torch):
        metadata = backend.metadata
        for field in ("name", "version", "git_commit", "training_data", "license", "detector", "calibration"):
            assert getattr(metadata, field) == getattr(DESCRIPTION, field)
        assert metadata.decision_threshold == 0.25
        assert (metadata.candidate_max_ratio, metadata.candidate_min_count) == (0.95, 32)
        assert json.loads(properties["config"]) == metadata.config


def test_the_prior_in_the_metadata_is_the_networks(exported):
    _, attributes = two_view_batch(50)
    expected = exported.network.prior(attributes)[0].numpy()
    np.testing.assert_allclose(exported.onnx.metadata.prior.logits(attributes[0].numpy()), expected, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 127])
def test_onnx_runtime_says_what_torch_says(exported, count):
    row = parity.compare(exported.onnx, exported.torch, count)
    assert row.logit_difference < 1e-3
    assert row.masks_equal
    assert row.passed


def rounding_sensitivity(network: MGCANet, count: int) -> float:
    """Largest change of torch's own logits when the input moves by one unit in the last place."""
    correspondences, attributes = parity.two_view_input(count)
    reference = network(torch.from_numpy(correspondences), torch.from_numpy(attributes)).logits
    rng = np.random.default_rng(0)
    changes = []
    for _ in range(3):
        toward = np.where(rng.random(correspondences.shape) < 0.5, np.inf, -np.inf).astype(np.float32)
        moved = torch.from_numpy(np.nextafter(correspondences, toward))
        changes.append(float((network(moved, torch.from_numpy(attributes)).logits - reference).abs().max()))
    return max(changes)


def test_many_matches_agree_but_for_a_few(exported):
    # Neighbours and the better half are chosen by comparison: rounding swaps a few of 2000 matches, and random
    # weights carry that on to the matches around them. All others agree.
    inputs = parity.two_view_input(2000)
    difference = np.abs(exported.onnx.infer(*inputs)[0] - exported.torch.infer(*inputs)[0])
    assert np.median(difference) < 2e-2
    assert np.mean(difference > 0.1) < 0.01


def test_batches_are_dynamic(exported):
    correspondences, attributes = (tensor.numpy() for tensor in two_view_batch(33, batch=3))
    logits, essential = exported.onnx.infer(correspondences, attributes)
    assert essential.shape == (3, 3, 3)
    for pair in range(3):
        alone, _ = exported.onnx.infer(correspondences[pair : pair + 1], attributes[pair : pair + 1])
        np.testing.assert_allclose(alone[0], logits[pair], atol=1e-2)


@pytest.mark.slow  # tracing and simplifying take ten seconds a network; the default form is exported above and below
@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({"stages": 1, "graph_expansion": 2}, (1, 8, 127, 2000)),  # no feedback that would carry a swap on
        ({"stages": 1, "attention": "point"}, (1, 8, 127)),
    ],
)
def test_variants_export_as_well(tmp_path, changes, counts):
    network = settled_network(dataclasses.replace(CONFIG, **changes))
    rows = parity.check_parity(*export_model(network, tmp_path, DESCRIPTION), counts)
    assert [row.count for row in rows] == list(counts)
    assert all(row.logit_difference < 1e-3 for row in rows), parity.format_parity(rows)


@pytest.mark.parametrize(("stages", "most"), [(1, 520), (3, 1500)])
def test_nodes_of_exports_are_few(tmp_path, stages, most):
    network = settled_network(dataclasses.replace(CONFIG, stages=stages, channels=8, refined_feedback=True))
    paths = export_model(network, tmp_path, DESCRIPTION)
    assert count_nodes(onnx.load(str(paths[0])).graph) <= most
    assert parity.compare(open_backend(paths[0], "onnxruntime"), open_backend(paths[1], "torch"), 9).passed
    batch = [tensor.numpy() for tensor in two_view_batch(600, batch=2)]  # several blocks of the neighbour search
    logits = open_backend(paths[0], "onnxruntime").infer(*batch)[0]
    assert np.median(np.abs(logits - open_backend(paths[1], "torch").infer(*batch)[0])) < 2e-2


@pytest.mark.slow
def test_three_stages_export_as_well(tmp_path):
    network = settled_network(dataclasses.replace(CONFIG, stages=3, channels=8))
    for row in parity.check_parity(*export_model(network, tmp_path, DESCRIPTION), (1, 7, 60)):
        assert row.logit_difference < 1e-3 + 5 * rounding_sensitivity(network, row.count)


def test_a_network_without_prior_does_not_fit_the_contract():
    with pytest.raises(ValueError, match="no prior"):
        model_metadata(MGCANet(dataclasses.replace(CONFIG, attributes=False)), DESCRIPTION)


def test_parity_tells_a_difference(exported, tmp_path):
    other = settled_network(CONFIG)
    other.heads[0].logit.bias += 1.0
    other.final_head.logit.bias += 0.01
    changed = tmp_path / "changed.safetensors"
    save_network(other, changed, model_metadata(other, DESCRIPTION))
    (row,) = parity.check_parity(exported.onnx_path, changed, counts=(40,))
    assert not row.passed
    assert row.logit_difference > 1e-3
    assert "FAILED" in parity.format_parity([row])
    assert "| 40 |" in parity.format_parity([row])
