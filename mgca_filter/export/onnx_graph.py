"""An ONNX graph under work: its nodes, its constants, and the values of all tensors in a few trial runs.

Sizes inside the graph are told from their values in runs of different (B, N), which also sees what shape inference
loses. Needs the ``[export]`` extra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import helper, numpy_helper

Array = NDArray[Any]
Size = int | str | None  # a constant, "B", "N", or something else

# (B, N) of the trial runs: distinct from each other and from the widths of a network, and few matches among them.
TRIAL_SIZES = ((3, 7), (5, 97), (2, 151))
_SYMBOLS = ("B", "N")


class Graph:
    """A model whose first input is (B, N, ...) and whose other sizes all follow from B and N.

    Attributes:
        nodes: in topological order, without Constant nodes; to be changed by whoever simplifies.
        shared: nodes in front of all others, which give B, N and what is made of them alone.
        constants: values by name.
        trials: values of all tensors by name, for each of the trial sizes.
        outputs: names of the model's outputs.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        self._model = model
        self.nodes: list[Any] = [node for node in model.graph.node if node.op_type != "Constant"]
        self.shared: list[Any] = []
        self.constants: dict[str, Array] = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}
        for node in model.graph.node:
            if node.op_type == "Constant":
                self.constants[node.output[0]] = numpy_helper.to_array(node.attribute[0].t)
        self.trials = [_run(model, batch, count) for batch, count in TRIAL_SIZES]
        self.outputs = {value.name for value in model.graph.output}
        self._made: dict[tuple[Any, ...], str] = {}

    def shape(self, name: str) -> list[Size]:
        """Sizes of a tensor that is no constant."""
        return [_size(values) for values in zip(*(trial[name].shape for trial in self.trials))]

    def sizes_in(self, name: str) -> list[Size]:
        """Elements of a flattened integer tensor that holds equally many in each trial."""
        return [_size(values) for values in zip(*(trial[name].reshape(-1).tolist() for trial in self.trials))]

    def constant(self, value: Array) -> str:
        """Name of a constant of this value."""
        key = (value.dtype.str, value.shape, value.tobytes())
        if key not in self._made:
            self._made[key] = f"constant_{len(self._made)}"
            self.constants[self._made[key]] = value
        return self._made[key]

    def size(self, size: Size) -> str:
        """Name of an integer tensor (1,) that holds B, N or a constant."""
        if isinstance(size, int):
            return self.constant(np.array([size], np.int64))
        source = self._model.graph.input[0].name
        shape = self.share("Shape", [source], f"{source}_shape")
        axis = self.constant(np.array([_SYMBOLS.index(str(size))], np.int64))
        return self.share("Gather", [shape, axis], f"size_{size}", axis=0)

    def share(self, operator: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        """Add a node to the shared ones unless it is there; returns its output."""
        if not any(node.output[0] == output for node in self.shared):
            self.shared.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def model(self) -> onnx.ModelProto:
        """The model of all nodes that an output depends on."""
        needed = set(self.outputs)
        kept = []
        for node in reversed([*self.shared, *self.nodes]):
            if needed & set(node.output):
                kept.append(node)
                needed.update(node.input)
        tensors = [numpy_helper.from_array(value, name) for name, value in self.constants.items() if name in needed]
        old = self._model.graph
        graph = helper.make_graph(kept[::-1], old.name, list(old.input), list(old.output), tensors)
        model = onnx.ModelProto()
        model.CopyFrom(self._model)
        model.graph.CopyFrom(graph)
        return model


def _size(values: Sequence[int]) -> Size:
    """What one size is, given its value in each trial."""
    if len(set(values)) == 1:
        return int(values[0])
    for symbol, trials in zip(_SYMBOLS, zip(*TRIAL_SIZES)):
        if tuple(values) == trials:
            return symbol
    return None


def _run(model: onnx.ModelProto, batch: int, count: int) -> Mapping[str, Array]:
    """Values of all tensors that nodes give, for a random input."""
    everything = onnx.ModelProto()
    everything.CopyFrom(model)
    names = [name for node in model.graph.node for name in node.output if name]
    del everything.graph.output[:]
    everything.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(everything.SerializeToString(), options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    feed = {
        value.name: rng.random((batch, count, value.type.tensor_type.shape.dim[2].dim_value), dtype=np.float32)
        for value in model.graph.input
    }
    return {**feed, **dict(zip(names, session.run(names, feed)))}
