"""Equal steps become a Loop that says the same; what only looks alike stays."""

from __future__ import annotations

from collections import Counter

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from mgca_filter.export.rolled_loops import roll_loops
from mgca_filter.export.trial_graph import bodies, count_nodes

WIDTH = 4


def build(nodes: list[onnx.NodeProto], constants: dict[str, np.ndarray]) -> onnx.ModelProto:
    """A model from x (B, N, 4) to y (B, N, 4)."""
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", "N", WIDTH]) for name in ("x", "y")]
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "test", values[:1], values[1:], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def run(model: onnx.ModelProto, x: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(["y"], {"x": x})[0]


def steps(count: int, inner: int = 3) -> tuple[list[onnx.NodeProto], dict[str, np.ndarray]]:
    """y ← tanh(a_i y + b_i) + x, ``inner`` sines, and a product with W_i: ``count`` times, all constants different."""
    rng = np.random.default_rng(0)
    nodes, constants, state = [], {}, "x"
    for i in range(count):
        constants |= {
            f"a{i}": rng.normal(size=WIDTH).astype(np.float32),
            f"b{i}": np.float32(rng.normal()),
            f"W{i}": rng.normal(size=(WIDTH, WIDTH)).astype(np.float32),
        }
        nodes += [
            helper.make_node("Mul", [state, f"a{i}"], [f"m{i}"]),
            helper.make_node("Add", [f"m{i}", f"b{i}"], [f"s{i}"]),
            helper.make_node("Tanh", [f"s{i}"], [f"t{i}"]),
            helper.make_node("Add", [f"t{i}", "x"], [f"u{i}_0"]),
            *(helper.make_node("Sin", [f"u{i}_{j}"], [f"u{i}_{j + 1}"]) for j in range(inner)),
            helper.make_node("MatMul", [f"u{i}_{inner}", f"W{i}"], [f"y{i}"]),
        ]
        state = f"y{i}"
    nodes[-1].output[0] = "y"
    return nodes, constants


@pytest.mark.parametrize("batch", [1, 3])
def test_steps_with_constants_of_their_own_become_a_loop(batch: int) -> None:
    nodes, constants = steps(6)
    model = build(nodes, constants)
    x = np.random.default_rng(1).normal(size=(batch, 9, WIDTH)).astype(np.float32)
    expected = run(model, x)
    rolled = roll_loops(model)
    onnx.checker.check_model(rolled, full_check=True)
    assert [node.op_type for node in rolled.graph.node] == ["Loop"]
    assert count_nodes(rolled.graph) < len(nodes) / 2
    np.testing.assert_allclose(run(rolled, x), expected, atol=1e-6)


def test_loops_inside_a_step_are_rolled_as_well() -> None:
    nodes, constants = steps(3, inner=20)
    model = build(nodes, constants)
    x = np.random.default_rng(1).normal(size=(2, 5, WIDTH)).astype(np.float32)
    expected = run(model, x)
    rolled = roll_loops(model)
    (outer,) = (node for node in rolled.graph.node if node.op_type == "Loop")
    assert Counter(node.op_type for node in bodies(outer)[0].node)["Loop"] == 1
    np.testing.assert_allclose(run(rolled, x), expected, atol=1e-6)


def test_steps_whose_values_are_read_later_stay() -> None:
    nodes, constants = steps(6)
    nodes[-1].output[0] = "last"
    nodes.append(helper.make_node("Add", ["last", "t2"], ["y"]))
    rolled = roll_loops(build(nodes, constants))
    x = np.random.default_rng(1).normal(size=(1, 5, WIDTH)).astype(np.float32)
    np.testing.assert_allclose(run(rolled, x), run(build(nodes, constants), x), atol=1e-6)
    assert "t2" in {name for node in rolled.graph.node for name in node.output}


def test_few_nodes_and_unequal_steps_stay() -> None:
    nodes = [helper.make_node("Sin", [name], [f"{name}s"]) for name in ("x", "xs", "xss")]
    nodes[-1].output[0] = "y"
    assert not any(node.op_type == "Loop" for node in roll_loops(build(nodes, {})).graph.node)
    nodes, constants = steps(4)
    for number, node in enumerate(node for node in nodes if node.op_type == "Tanh"):
        node.op_type = ("Tanh", "Sin", "Cos", "Atan")[number]
    assert not any(node.op_type == "Loop" for node in roll_loops(build(nodes, constants)).graph.node)
