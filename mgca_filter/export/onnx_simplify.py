"""The same ONNX graph from fewer and faster nodes.

A traced graph computes at every call what could be known at export: weights from weights, targets of reshapes, the
number of matches over and over. OpenCV's runtime, besides, fails on some of these computations of sizes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from .onnx_graph import Graph, Size

_MAX_SIZES = 8  # elements of what may be the shape of a tensor


def simplify(model: onnx.ModelProto) -> onnx.ModelProto:
    """Simplify a traced model; inputs, outputs and metadata stay.

    1. constants are computed, sizes taken from the input's shape once
    2. casts to the same type go
    3. means become products, and sums escape slow fusions of ONNX Runtime
    4. equal nodes become one
    5. tensors are numbered
    """
    graph = Graph(model)
    share_sizes(graph, fold_constants(graph))
    drop_casts(graph)
    turn_means_into_products(graph)
    keep_sums_from_fusion(graph)
    merge_equal_nodes(graph)
    return number_tensors(graph.model())


def fold_constants(graph: Graph) -> set[str]:
    """Replace by constants what depends on constants alone, and integers that are the same at all sizes.

    Returns:
        Names of the tensors left that depend on B and N alone.
    """
    fixed, sized = {*graph.constants, ""}, set[str]()
    kept = []
    for node in graph.nodes:
        constant = all(name in fixed for name in node.input)
        if constant or node.op_type == "Shape" or all(name in fixed or name in sized for name in node.input):
            if constant or all(_same_integers(graph, name) for name in node.output):
                fixed.update(node.output)
                graph.constants.update({name: graph.trials[0][name] for name in node.output})
                continue
            sized.update(node.output)
        kept.append(node)
    graph.nodes = kept
    return sized


def _same_integers(graph: Graph, name: str) -> bool:
    first, *others = (trial[name] for trial in graph.trials)
    return first.dtype == np.int64 and all(np.array_equal(first, other) for other in others)


def share_sizes(graph: Graph, sized: set[str]) -> None:
    """Reshape by constants where at most one size is free; make other shapes of the input's B and N."""
    kept = []
    for node in graph.nodes:
        output = node.output[0]
        if node.op_type in ("Reshape", "Flatten"):
            target = _reshape_target(graph.shape(node.input[0]), graph.shape(output))
            if target.count(-1) <= 1:
                inputs = [node.input[0], graph.constant(np.array(target, np.int64))]
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


def _holds_sizes(graph: Graph, name: str) -> bool:
    """Whether an integer scalar or vector consists of constants, B and N."""
    values = [trial[name] for trial in graph.trials]
    first = values[0]
    if first.dtype != np.int64 or first.ndim > 1 or not 0 < first.size <= _MAX_SIZES:
        return False
    return all(value.shape == first.shape for value in values) and None not in graph.sizes_in(name)


def drop_casts(graph: Graph) -> None:
    """Leave out casts to the type that is there already."""
    same: dict[str, str] = {}
    kept = []
    types = graph.trials[0]
    for node in graph.nodes:
        node.input[:] = [same.get(name, name) for name in node.input]
        source, output = node.input[0], node.output[0]
        if (
            node.op_type == "Cast"
            and source in types
            and types[source].dtype == types[output].dtype
            and output not in graph.outputs
        ):
            same[output] = source
        else:
            kept.append(node)
    graph.nodes = kept


def turn_means_into_products(graph: Graph) -> None:
    """Means over the matches as products with a row of 1 / N: four to eight times faster in ONNX Runtime."""
    nodes = []
    for node in graph.nodes:
        options = {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
        if node.op_type == "ReduceMean" and options["keepdims"]:
            nodes.extend(_mean_as_product(graph, node, list(options["axes"])))
        else:
            nodes.append(node)
    graph.nodes = nodes


def _mean_as_product(graph: Graph, node: Any, axes: list[int]) -> list[Any]:
    """A mean over axis 1 of (B, N, C), or over axes 1 and 2 of (B, N, k, C), as a product; else the node itself."""
    source, output = node.input[0], node.output[0]
    shape = graph.shape(source)
    if axes == [1] and len(shape) == 3 and shape[1] is not None:
        return [helper.make_node("MatMul", [_row(graph, shape[1], 1), source], [output], node.name)]
    if axes == [1, 2] and len(shape) == 4 and shape[1] is not None and isinstance(shape[2], int):
        rows, mean, width = f"{output}_rows", f"{output}_mean", shape[3]
        flat, back = (graph.constant(np.array(target, np.int64)) for target in ([0, -1, width], [0, 1, 1, width]))
        return [
            helper.make_node("Reshape", [source, flat], [rows], rows),
            helper.make_node("MatMul", [_row(graph, shape[1], shape[2]), rows], [mean], mean),
            helper.make_node("Reshape", [mean, back], [output], node.name),
        ]
    return [node]


def _row(graph: Graph, length: int | str, factor: int) -> str:
    """Name of a row (1, 1, n) of 1 / n with n = ``length`` · ``factor``."""
    if isinstance(length, int):
        n = length * factor
        return graph.constant(np.full((1, 1, n), 1.0 / n, np.float32))
    row = f"mean_of_{factor}_{length}"
    one = graph.constant(np.array([1], np.int64))
    unit = numpy_helper.from_array(np.ones(1, np.float32))
    count = graph.share("Mul", [graph.size(length), graph.size(factor)], f"{row}_count")
    shape = graph.share("Concat", [one, one, count], f"{row}_shape", axis=0)
    ones = graph.share("ConstantOfShape", [shape], f"{row}_ones", value=unit)
    divisor = graph.share("Cast", [count], f"{row}_divisor", to=onnx.TensorProto.FLOAT)
    return graph.share("Div", [ones, divisor], row)


def keep_sums_from_fusion(graph: Graph) -> None:
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


def merge_equal_nodes(graph: Graph) -> None:
    """Nodes of equal operator, attributes and inputs become one."""
    same: dict[str, str] = {}
    seen: dict[tuple[Any, ...], Any] = {}
    kept = []
    for node in graph.nodes:
        node.input[:] = [same.get(name, name) for name in node.input]
        options = tuple(sorted(attribute.SerializeToString() for attribute in node.attribute))
        twin = seen.setdefault((node.op_type, tuple(node.input), options), node)
        if twin is not node and not graph.outputs & set(node.output):
            same.update(zip(node.output, twin.output))
        else:
            kept.append(node)
    graph.nodes = kept


def number_tensors(model: onnx.ModelProto) -> onnx.ModelProto:
    """Short names for all tensors but inputs and outputs; nodes keep theirs, which profiles show.

    While OpenCV opens a file it copies names so often that long ones take it twice the time.
    """
    kept = {"", *(value.name for value in [*model.graph.input, *model.graph.output])}
    numbers: dict[str, str] = {}

    def short(name: str) -> str:
        return name if name in kept else numbers.setdefault(name, f"t{len(numbers)}")

    for tensor in model.graph.initializer:
        tensor.name = short(tensor.name)
    for node in model.graph.node:
        node.input[:] = map(short, node.input)
        node.output[:] = map(short, node.output)
    return model
