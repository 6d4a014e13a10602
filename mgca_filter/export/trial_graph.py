"""An ONNX graph under work, with the values of its tensors in a few trial runs. Needs the ``[export]`` extra."""

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


class TrialGraph:
    """A model under work, with the values of all its tensors in a few trial runs.

    Sizes inside the graph are told from their values in runs of different (B, N), which also sees what shape
    inference loses.

    Attributes:
        nodes: in topological order; to be changed by the passes.
        constants: names of the tensors that the file holds. outputs: of what the model gives.
        trials: values of all tensors by name, for each of the trial sizes.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        self._model = model
        self.nodes: list[Any] = list(model.graph.node)
        self.constants = {tensor.name for tensor in model.graph.initializer}
        self.outputs = [value.name for value in model.graph.output]
        self.trials = _run_trials(model)
        self._front: list[Any] = []
        self._added: dict[str, Any] = {}

    def shape(self, name: str) -> list[Size]:
        """Sizes of a tensor that is no constant."""
        return [_size(values) for values in zip(*(trial[name].shape for trial in self.trials))]

    def multiple_of_count(self, name: str, axis: int) -> int | None:
        """How many times N a size is; None where it is no multiple."""
        sizes = [trial[name].shape[axis] for trial in self.trials]
        factors = {size / count for size, (_, count) in zip(sizes, TRIAL_SIZES)}
        return int(factors.pop()) if len(factors) == 1 and all(factor.is_integer() for factor in factors) else None

    def element_type(self, name: str) -> int:
        """ONNX's number of the type of a tensor that is no constant."""
        return helper.np_dtype_to_tensor_dtype(self.trials[0][name].dtype)

    def sizes_in(self, name: str) -> list[Size]:
        """Elements of a flattened integer tensor that holds equally many in each trial."""
        return [_size(values) for values in zip(*(trial[name].reshape(-1).tolist() for trial in self.trials))]

    def constant(self, name: str, value: Array) -> str:
        """Add a constant unless one of this name is there; returns the name."""
        if name not in self._added:
            self._added[name] = numpy_helper.from_array(value, name)
            self.constants.add(name)
        return name

    def size(self, size: Size) -> str:
        """Name of an integer tensor (1,) that holds B, N or a constant."""
        if isinstance(size, int):
            return self.constant(f"size_{size}", np.array([size], np.int64))
        source = self._model.graph.input[0].name
        axis = self.constant(f"axis_{size}", np.array([_SYMBOLS.index(str(size))], np.int64))
        shape = self.in_front("Shape", [source], f"{source}_shape")
        return self.in_front("Gather", [shape, axis], f"size_{size}", axis=0)

    def in_front(self, operator: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        """Add a node in front of all others, made of B and N alone, unless it is there; returns its output."""
        if not any(node.output[0] == output for node in self._front):
            self._front.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def model(self) -> onnx.ModelProto:
        """The model of all these nodes and constants, whether needed or not."""
        model = onnx.ModelProto()
        model.CopyFrom(self._model)
        model.graph.initializer.extend(self._added.values())
        del model.graph.node[:], model.graph.value_info[:]
        model.graph.node.extend([*self._front, *self.nodes])
        return model


def _size(values: Sequence[int]) -> Size:
    """What one size is, given its value in each trial."""
    if len(set(values)) == 1:
        return int(values[0])
    for symbol, trials in zip(_SYMBOLS, zip(*TRIAL_SIZES)):
        if tuple(values) == trials:
            return symbol
    return None


def _run_trials(model: onnx.ModelProto) -> list[Mapping[str, Array]]:
    """Values of all tensors that nodes give, for random input of each of the trial sizes."""
    everything = onnx.ModelProto()
    everything.CopyFrom(model)
    names = [name for node in model.graph.node for name in node.output if name]
    del everything.graph.output[:]
    everything.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(everything.SerializeToString(), options, providers=["CPUExecutionProvider"])
    widths = {value.name: value.type.tensor_type.shape.dim[2].dim_value for value in model.graph.input}
    trials: list[Mapping[str, Array]] = []
    for batch, count in TRIAL_SIZES:
        rng = np.random.default_rng(0)
        feed = {name: rng.random((batch, count, width), dtype=np.float32) for name, width in widths.items()}
        trials.append({**feed, **dict(zip(names, session.run(names, feed)))})
    return trials


def bodies(node: Any) -> list[Any]:
    """Graphs that a node runs: the body of a Loop."""
    return [attribute.g for attribute in node.attribute if attribute.type == onnx.AttributeProto.GRAPH]


def all_inputs(node: Any) -> set[str]:
    """What a node takes, its bodies included."""
    names = set(node.input)
    for body in bodies(node):
        for inner in body.node:
            names |= all_inputs(inner)
    return names


def signature(node: Any) -> tuple[Any, ...]:
    """What a node does: equal for nodes that differ in their inputs and names alone."""
    attributes = tuple(sorted(attribute.SerializeToString(deterministic=True) for attribute in node.attribute))
    return node.op_type, len(node.input), len(node.output), attributes


def count_nodes(graph: Any) -> int:
    """Nodes of a graph and of the bodies inside it."""
    return sum(1 + sum(map(count_nodes, bodies(node))) for node in graph.node)
