"""The same ONNX graph from fewer and faster nodes. Needs the ``[export]`` extra.

A traced graph computes at every call what could be known at export: weights from weights, targets of reshapes, the
number of matches over and over. OpenCV's runtime, besides, fails on some of these computations of sizes. onnxslim
computes constants and merges equal nodes; the passes here do what it does not: they tell from trial runs which sizes
are B, N or constants, and know what is slow in a runtime.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
import onnxslim
from numpy.typing import NDArray
from onnx import helper, numpy_helper

Array = NDArray[Any]
Size = int | str | None  # a constant, "B", "N", or something else

# (B, N) of the trial runs: distinct from each other and from the widths of a network, and few matches among them.
TRIAL_SIZES = ((3, 7), (5, 97), (2, 151))
_SYMBOLS = ("B", "N")
_MAX_SIZES = 8  # elements of what may be the shape of a tensor


def simplify(model: onnx.ModelProto) -> onnx.ModelProto:
    """Simplify a traced model whose first input is (B, N, ...); inputs, outputs and metadata stay.

    1. sizes are taken from the input's shape once
    2. means become products, and sums escape slow fusions of ONNX Runtime
    3. onnxslim computes constants, merges equal nodes and drops those that nothing depends on
    4. tensors are numbered
    """
    graph = TrialGraph(model)
    share_sizes(graph)
    turn_means_into_products(graph)
    keep_sums_from_fusion(graph)
    return number_tensors(onnxslim.slim(graph.model()))


class TrialGraph:
    """A model under work, with the values of all its tensors in a few trial runs.

    Sizes inside the graph are told from their values in runs of different (B, N), which also sees what shape
    inference loses.

    Attributes:
        nodes: in topological order; to be changed by the passes.
        constants: names of the tensors that the file holds.
        trials: values of all tensors by name, for each of the trial sizes.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        self._model = model
        self.nodes: list[Any] = list(model.graph.node)
        self.constants = {tensor.name for tensor in model.graph.initializer}
        self.trials = _run_trials(model)
        self._front: list[Any] = []
        self._added: dict[str, Any] = {}

    def shape(self, name: str) -> list[Size]:
        """Sizes of a tensor that is no constant."""
        return [_size(values) for values in zip(*(trial[name].shape for trial in self.trials))]

    def sizes_in(self, name: str) -> list[Size]:
        """Elements of a flattened integer tensor that holds equally many in each trial."""
        return [_size(values) for values in zip(*(trial[name].reshape(-1).tolist() for trial in self.trials))]

    def constant(self, name: str, value: Array) -> str:
        """Add a constant unless one of this name is there; returns the name."""
        if name not in self._added:
            self._added[name] = numpy_helper.from_array(value, name)
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
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(everything.SerializeToString(), options, providers=["CPUExecutionProvider"])
    widths = {value.name: value.type.tensor_type.shape.dim[2].dim_value for value in model.graph.input}
    trials: list[Mapping[str, Array]] = []
    for batch, count in TRIAL_SIZES:
        rng = np.random.default_rng(0)
        feed = {name: rng.random((batch, count, width), dtype=np.float32) for name, width in widths.items()}
        trials.append({**feed, **dict(zip(names, session.run(names, feed)))})
    return trials


def share_sizes(graph: TrialGraph) -> None:
    """Reshape by constants where at most one size is free; make other shapes of the input's B and N."""
    fixed, sized = {*graph.constants, ""}, set[str]()
    kept = []
    for node in graph.nodes:
        output = node.output[0]
        if node.op_type == "Shape" or (node.input and all(name in fixed or name in sized for name in node.input)):
            sized.update(node.output)  # depends on B and N alone
        elif not node.input:
            fixed.update(node.output)
        if node.op_type in ("Reshape", "Flatten"):
            target = _reshape_target(graph.shape(node.input[0]), graph.shape(output))
            if target.count(-1) <= 1:
                inputs = [node.input[0], graph.constant(f"{output}_target", np.array(target, np.int64))]
                node = helper.make_node("Reshape", inputs, [output], node.name)
        elif output in sized and _holds_sizes(graph, output):
            parts = [graph.size(size) for size in graph.sizes_in(output)]
            if graph.trials[0][output].ndim:
                node = helper.make_node("Concat", parts, [output], node.name, axis=0)
            else:
                node = helper.make_node("Squeeze", parts, [output], node.name)
        kept.append(node)
    graph.nodes = kept


def _reshape_target(before: list[Size], after: list[Size]) -> list[int]:
    """Sizes, 0 for one that stays in its place, −1 for one that does not."""
    target = []
    for axis, size in enumerate(after):
        stays = axis < len(before) and size is not None and size == before[axis]
        target.append(size if isinstance(size, int) else 0 if stays else -1)
    return target


def _holds_sizes(graph: TrialGraph, name: str) -> bool:
    """Whether an integer scalar or vector consists of constants, B and N."""
    values = [trial[name] for trial in graph.trials]
    first = values[0]
    if first.dtype != np.int64 or first.ndim > 1 or not 0 < first.size <= _MAX_SIZES:
        return False
    return all(value.shape == first.shape for value in values) and None not in graph.sizes_in(name)


def turn_means_into_products(graph: TrialGraph) -> None:
    """Means over the matches as products with a row of 1 / N: four to eight times faster in ONNX Runtime."""
    nodes = []
    for node in graph.nodes:
        options = {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
        if node.op_type == "ReduceMean" and options["keepdims"]:
            nodes.extend(_mean_as_product(graph, node, list(options["axes"])))
        else:
            nodes.append(node)
    graph.nodes = nodes


def _mean_as_product(graph: TrialGraph, node: Any, axes: list[int]) -> list[Any]:
    """A mean over axis 1 of (B, N, C), or over axes 1 and 2 of (B, N, k, C), as a product; else the node itself."""
    source, output = node.input[0], node.output[0]
    shape = graph.shape(source)
    if axes == [1] and len(shape) == 3 and shape[1] is not None:
        return [helper.make_node("MatMul", [_row(graph, shape[1], 1), source], [output], node.name)]
    if axes == [1, 2] and len(shape) == 4 and shape[1] is not None and isinstance(shape[2], int):
        rows, mean, width = f"{output}_rows", f"{output}_mean", shape[3]
        flat = graph.constant(f"{rows}_target", np.array([0, -1, width], np.int64))
        back = graph.constant(f"{mean}_target", np.array([0, 1, 1, width], np.int64))
        return [
            helper.make_node("Reshape", [source, flat], [rows], rows),
            helper.make_node("MatMul", [_row(graph, shape[1], shape[2]), rows], [mean], mean),
            helper.make_node("Reshape", [mean, back], [output], node.name),
        ]
    return [node]


def _row(graph: TrialGraph, length: int | str, factor: int) -> str:
    """Name of a row (1, 1, n) of 1 / n with n = ``length`` · ``factor``."""
    if isinstance(length, int):
        n = length * factor
        return graph.constant(f"mean_of_{n}", np.full((1, 1, n), 1.0 / n, np.float32))
    row = f"mean_of_{factor}_{length}"
    unit = numpy_helper.from_array(np.ones(1, np.float32))
    count = graph.in_front("Mul", [graph.size(length), graph.size(factor)], f"{row}_count")
    shape = graph.in_front("Concat", [graph.size(1), graph.size(1), count], f"{row}_shape", axis=0)
    ones = graph.in_front("ConstantOfShape", [shape], f"{row}_ones", value=unit)
    divisor = graph.in_front("Cast", [count], f"{row}_divisor", to=onnx.TensorProto.FLOAT)
    return graph.in_front("Div", [ones, divisor], row)


def keep_sums_from_fusion(graph: TrialGraph) -> None:
    """Sums in front of LayerNormalization and GELU as ``Sum``, which ONNX Runtime leaves alone.

    It would fuse an ``Add`` into SkipLayerNormalization or BiasGelu, which take three to five times as long as the
    nodes that they stand for.
    """
    erf = {node.input[0] for node in graph.nodes if node.op_type == "Erf"}
    readers = [node for node in graph.nodes if node.op_type == "LayerNormalization" or node.output[0] in erf]
    unfused = {node.input[0] for node in readers}
    for node in graph.nodes:
        if node.op_type == "Add" and node.output[0] in unfused:
            node.op_type = "Sum"


def number_tensors(model: onnx.ModelProto) -> onnx.ModelProto:
    """Short names for all tensors but inputs and outputs; nodes keep theirs, which profiles show.

    While OpenCV opens a file it copies names so often that long ones take it twice the time.
    """
    kept = {"", *(value.name for value in [*model.graph.input, *model.graph.output])}
    numbers: dict[str, str] = {}

    def short(name: str) -> str:
        return name if name in kept else numbers.setdefault(name, f"t{len(numbers)}")

    del model.graph.value_info[:]
    for tensor in model.graph.initializer:
        tensor.name = short(tensor.name)
    for node in model.graph.node:
        node.input[:] = map(short, node.input)
        node.output[:] = map(short, node.output)
    return model
