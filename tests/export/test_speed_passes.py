"""The simplified graph is the traced one: same answers, no computations of sizes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

import mgca_filter
from mgca_filter.export import parity, speed_passes, trial_graph
from mgca_filter.export.onnx_export import export_onnx
from mgca_filter.export.speed_passes import BLOCK, simplify
from mgca_filter.export.trial_graph import bodies, count_nodes
from mgca_filter.inference import open_backend
from mgca_filter.network import load_network

WIDTH = 4


def build(nodes: list[onnx.NodeProto], constants: dict[str, np.ndarray] | None = None) -> onnx.ModelProto:
    """A model from x (B, N, 4) to y, of whatever shape."""
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["B", "N", WIDTH])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def run(model: onnx.ModelProto, x: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(["y"], {"x": x})[0]


def check(model: onnx.ModelProto) -> tuple[onnx.ModelProto, Counter]:
    """The simplified model, equal in value at sizes other than those of its trial runs, and its operators."""
    simplified = simplify(model)
    rng = np.random.default_rng(1)
    for batch, count in ((1, 1), (1, 6), (4, 33), (1, 400)):
        x = rng.normal(size=(batch, count, WIDTH)).astype(np.float32)
        np.testing.assert_allclose(run(simplified, x), run(model, x), atol=1e-5)
    return simplified, Counter(node.op_type for node in simplified.graph.node)


def node(operator: str, inputs: list[str], output: str, **attributes: object) -> onnx.NodeProto:
    return helper.make_node(operator, inputs, [output], output, **attributes)


def test_constants_are_computed() -> None:
    weights = {"a": np.full((WIDTH,), 2.0, np.float32), "b": np.full((WIDTH,), 3.0, np.float32)}
    simplified, operators = check(build([node("Mul", ["a", "b"], "ab"), node("Mul", ["x", "ab"], "y")], weights))
    assert operators == {"Mul": 1}
    np.testing.assert_array_equal(numpy_helper.to_array(simplified.graph.initializer[0]), np.full(WIDTH, 6.0))


def test_reshapes_get_constant_targets() -> None:
    constants = {
        "zero": np.array(0, np.int64),
        "first": np.array([0], np.int64),
        "rest": np.array([-1, 2, 2], np.int64),
    }
    nodes = [
        node("Shape", ["x"], "shape"),
        node("Gather", ["shape", "zero"], "batch"),
        node("Unsqueeze", ["batch", "first"], "batch1"),
        node("Concat", ["batch1", "rest"], "target", axis=0),
        node("Reshape", ["x", "target"], "y"),
    ]
    simplified, operators = check(build(nodes, constants))
    assert operators == {"Reshape": 1}
    assert numpy_helper.to_array(simplified.graph.initializer[0]).tolist() == [0, 0, 2, 2]


def test_sizes_are_taken_from_the_input_once() -> None:
    constants = {"one": np.array(1, np.int64), "half": np.array(0.5, np.float32)}
    nodes = [
        node("Mul", ["x", "half"], "z"),
        node("Shape", ["x"], "shape_x"),
        node("Gather", ["shape_x", "one"], "count_x"),
        node("Shape", ["z"], "shape_z"),
        node("Gather", ["shape_z", "one"], "count_z"),
        node("Cast", ["count_x"], "n_x", to=TensorProto.FLOAT),
        node("Cast", ["count_z"], "n_z", to=TensorProto.FLOAT),
        node("Mul", ["z", "n_x"], "scaled"),
        node("Add", ["scaled", "n_z"], "y"),
    ]
    _, operators = check(build(nodes, constants))
    assert operators["Shape"] == operators["Gather"] == operators["Cast"] == 1


@pytest.mark.parametrize("axes", [[1], [-2], [1, 2]])
def test_means_over_matches_become_products(axes: list[int]) -> None:
    constants = {"target": np.array([0, 0, 2, 2], np.int64)}
    nodes = [node("ReduceMean", ["x"], "y", axes=[1], keepdims=1)]
    if len(axes) == 2:
        nodes = [node("Reshape", ["x", "target"], "z"), node("ReduceMean", ["z"], "y", axes=axes, keepdims=1)]
    _, operators = check(build(nodes, constants))
    assert operators["MatMul"] == 1
    assert "ReduceMean" not in operators


def test_other_means_stay() -> None:
    _, operators = check(build([node("ReduceMean", ["x"], "y", axes=[2], keepdims=1)]))
    assert operators == {"ReduceMean": 1}


def test_what_holds_only_for_many_matches_is_no_constant() -> None:
    # min(N, 90) is 90 in two of the three trial runs.
    constants = {"one": np.array([1], np.int64), "limit": np.array([90], np.int64)}
    nodes = [
        node("Shape", ["x"], "shape"),
        node("Gather", ["shape", "one"], "count"),
        node("Min", ["count", "limit"], "limited"),
        node("Cast", ["limited"], "n", to=TensorProto.FLOAT),
        node("Mul", ["x", "n"], "y"),
    ]
    check(build(nodes, constants))


def test_sums_before_layer_norm_and_gelu_escape_fusion() -> None:
    constants = {
        "bias": np.ones(WIDTH, np.float32),
        "root": np.array(np.sqrt(2.0), np.float32),
        "half": np.array(0.5, np.float32),
        "one": np.array(1.0, np.float32),
    }
    nodes = [
        node("Add", ["x", "x"], "doubled"),
        node("LayerNormalization", ["doubled", "bias", "bias"], "normal", axis=-1),
        node("Add", ["normal", "bias"], "shifted"),
        node("Div", ["shifted", "root"], "scaled"),
        node("Erf", ["scaled"], "erf"),
        node("Add", ["erf", "one"], "plus"),
        node("Mul", ["shifted", "plus"], "product"),
        node("Mul", ["product", "half"], "y"),
    ]
    _, operators = check(build(nodes, constants))
    assert (operators["Sum"], operators["Add"]) == (2, 1)


def test_tensors_are_numbered_and_nodes_keep_their_names() -> None:
    half = np.array(0.5, np.float32)
    nodes = [
        helper.make_node("Mul", ["x", "a factor"], ["a product"], "scale"),
        helper.make_node("Add", ["a product", "x"], ["y"], "sum"),
    ]
    simplified, _ = check(build(nodes, {"a factor": half}))
    assert [(item.name, list(item.input), list(item.output)) for item in simplified.graph.node] == [
        ("scale", ["x", "t0"], ["t1"]),
        ("sum", ["t1", "x"], ["y"]),
    ]


def test_sums_of_sums_are_one() -> None:
    constants = {"bias": np.ones(WIDTH, np.float32), "two": np.full(WIDTH, 2.0, np.float32)}
    nodes = [
        node("Mul", ["x", "two"], "doubled"),
        node("Add", ["doubled", "bias"], "shifted"),
        node("Add", ["x", "shifted"], "y"),
    ]
    _, operators = check(build(nodes, constants))
    assert operators == {"Mul": 1, "Sum": 1}


def test_sums_that_others_read_stay() -> None:
    constants = {"bias": np.ones(WIDTH, np.float32)}
    nodes = [node("Add", ["x", "bias"], "a"), node("Add", ["a", "x"], "b"), node("Mul", ["a", "b"], "y")]
    _, operators = check(build(nodes, constants))
    assert operators == {"Add": 2, "Mul": 1}


def test_transposes_that_undo_each_other_go() -> None:
    nodes = [
        node("Transpose", ["x"], "t", perm=[0, 2, 1]),
        node("Relu", ["t"], "r"),
        node("Transpose", ["r"], "s", perm=[0, 2, 1]),
        node("Concat", ["x", "s"], "c", axis=-1),
        node("Transpose", ["c"], "u", perm=[0, 2, 1]),
        node("Sin", ["u"], "y"),
    ]
    _, operators = check(build(nodes))
    assert operators == {"Transpose": 1, "Relu": 1, "Concat": 1, "Sin": 1}


def test_equal_nodes_are_one() -> None:
    nodes = [node("Sin", ["x"], "a"), node("Sin", ["x"], "b"), node("Mul", ["a", "b"], "y")]
    _, operators = check(build(nodes))
    assert operators == {"Sin": 1, "Mul": 1}


@pytest.mark.parametrize("count", [1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK])
def test_neighbours_are_searched_in_blocks(count: int) -> None:
    constants = {"k": np.array([1], np.int64)}
    nodes = [
        node("Transpose", ["x"], "t", perm=[0, 2, 1]),
        node("MatMul", ["x", "t"], "nearness"),
        helper.make_node("TopK", ["nearness", "k"], ["values", "indices"], "search"),
        node("Cast", ["indices"], "y", to=TensorProto.FLOAT),
    ]
    model = build(nodes, constants)
    simplified, operators = check(model)
    assert operators["Loop"] == 1
    (body,) = (body for item in simplified.graph.node for body in bodies(item))
    assert {item.op_type for item in body.node} >= {"MatMul", "TopK"}
    assert [item.name for item in body.output][0] not in [item.name for item in body.input]
    x = np.random.default_rng(2).normal(size=(2, count, WIDTH)).astype(np.float32)
    np.testing.assert_array_equal(run(simplified, x), run(model, x))


@pytest.mark.parametrize("count", [1, 399, 400, 401, 700, 3 * BLOCK])
def test_a_block_sees_the_window_around_it(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    many, k = 400, 2
    monkeypatch.setattr(speed_passes, "MANY", many)
    monkeypatch.setattr(speed_passes, "WINDOW", 300)
    window = 300 if count > many else many
    nodes = [
        node("Transpose", ["x"], "t", perm=[0, 2, 1]),
        node("Concat", ["t", "far"], "columns", axis=2),  # a search gives k indices of a single match as well
        node("MatMul", ["x", "columns"], "nearness"),
        helper.make_node("TopK", ["nearness", "k"], ["values", "indices"], "search"),
        node("Cast", ["indices"], "y", to=TensorProto.FLOAT),
    ]
    constants = {"k": np.array([k], np.int64), "far": np.zeros((1, WIDTH, k), np.float32)}
    model = build(nodes, constants)
    # The trial runs take more than one pair; constants of this test do not.
    monkeypatch.setattr(trial_graph, "TRIAL_SIZES", ((1, 7), (1, 97), (1, 151)))
    simplified = simplify(model, windows=True)
    x = np.random.default_rng(2).normal(size=(1, count, WIDTH)).astype(np.float32)
    columns = np.concatenate([x[0].T, constants["far"][0]], 1)
    expected = []
    for first in range(0, count, BLOCK):
        start = max(0, min(first - (window - BLOCK) // 2, count - window))
        nearness = x[0, first : first + BLOCK] @ columns[:, start : start + window]
        expected.append(np.argsort(-nearness, axis=1, kind="stable")[:, :k] + start)
    np.testing.assert_array_equal(run(simplified, x)[0], np.concatenate(expected))


def test_the_shipped_graph_is_small() -> None:
    """Some versions of ONNX Runtime take the square of it to open a file: ``benchmarks/opening.py``."""
    assert count_nodes(onnx.load(str(mgca_filter.model_path())).graph) <= 1500


def test_the_shipped_graph_has_no_sizes_left_to_compute() -> None:
    operators = Counter(node.op_type for node in onnx.load(str(mgca_filter.model_path())).graph.node)
    assert operators["Shape"] == 1
    assert not {"Constant", "ReduceMean", "Identity"} & set(operators)


@pytest.mark.slow  # tracing takes some fifteen seconds for the shipped network
@pytest.mark.timeout(600)
def test_the_shipped_network_exports_as_small_and_says_the_same(tmp_path: Path) -> None:
    shipped, exported = mgca_filter.model_path(), tmp_path / "m.onnx"
    before = onnx.load(str(shipped))
    metadata = {entry.key: entry.value for entry in before.metadata_props}
    export_onnx(load_network(shipped.with_suffix(".safetensors")), exported, metadata)
    after = onnx.load(str(exported))
    assert count_nodes(after.graph) <= count_nodes(before.graph)
    assert exported.stat().st_size <= 1.05 * shipped.stat().st_size
    assert {entry.key: entry.value for entry in after.metadata_props} == metadata
    reference = open_backend(shipped, "onnxruntime")
    for name in ["onnxruntime", "opencv"] if int(cv2.__version__.split(".")[0]) >= 5 else ["onnxruntime"]:
        backend = open_backend(exported, name)
        for count in parity.COUNTS:
            row = parity.compare(backend, reference, count)
            assert row.passed, parity.format_parity([row])


def test_the_fast_network_compares_many_matches_as_torch_does() -> None:
    path = mgca_filter.model_path("fast")
    row = parity.compare(open_backend(path, "onnxruntime"), open_backend(path, "torch"), 5000)
    assert row.passed, parity.format_parity([row])
