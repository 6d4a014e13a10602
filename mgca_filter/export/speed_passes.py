"""The same ONNX graph from fewer and faster nodes. Needs the ``[export]`` extra.

A traced graph computes at every call what could be known at export: weights from weights, targets of reshapes, the
number of matches over and over. OpenCV's runtime, besides, fails on some of these computations of sizes. The passes
here tell from trial runs which tensors are constants and which sizes are B or N, and know what is slow in a runtime.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from ..network.graph import BLOCK, MANY, WINDOW
from .rolled_loops import roll_loops
from .trial_graph import Size, TrialGraph, all_inputs, bodies, signature

_MAX_SIZES = 8  # elements of what may be the shape of a tensor


def simplify(model: onnx.ModelProto, windows: bool = False) -> onnx.ModelProto:
    """Simplify a traced model whose first input is (B, N, ...); inputs, outputs and metadata stay.

    ``windows`` says that neighbours lie near each other where they are looked for.

    1. sizes are taken from the input's shape once
    2. means become products, and sums escape slow fusions of ONNX Runtime
    3. constants are computed, and what does nothing or is of no use goes
    4. equal steps that follow each other become Loops
    5. equal nodes become one, and tensors are numbered
    """
    graph = TrialGraph(model)
    share_sizes(graph)
    turn_means_into_products(graph)
    keep_sums_from_fusion(graph)
    search_in_blocks(graph, windows)
    graph = TrialGraph(graph.model())
    compute_constants(graph)
    concatenate_transposed(graph)
    drop_idle_nodes(graph)
    join_sums(graph)
    return number_tensors(merge_equal_nodes(roll_loops(graph.model())))


def compute_constants(graph: TrialGraph) -> None:
    """What depends on no input as constants, taken from a trial."""
    kept = []
    for node in graph.nodes:
        if all(not name or name in graph.constants for name in all_inputs(node)):
            for name in node.output:
                graph.constant(name, graph.trials[0][name])
        else:
            kept.append(node)
    graph.nodes = kept


def drop_idle_nodes(graph: TrialGraph) -> None:
    """Without nodes that hand on their input, that undo the one before, or whose output nobody reads."""
    same: dict[str, str] = {}
    transposed: dict[str, str] = {}
    kept = []
    for node in graph.nodes:
        node.input[:] = [same.get(name, name) for name in node.input]
        source, output = (node.input[0] if node.input else ""), node.output[0]
        idle = node.op_type == "Identity" or (
            node.op_type == "Cast"
            and source in graph.trials[0]
            and graph.element_type(source) == graph.element_type(output)
        )
        swaps = _swaps(node)
        if output in graph.outputs:
            kept.append(node)
        elif idle:
            same[output] = source
        elif swaps and source in transposed:
            same[output] = transposed[source]
        else:
            kept.append(node)
        if swaps:
            transposed[output] = source
    read, useful = set(graph.outputs), []
    for node in reversed(kept):
        if read & set(node.output):
            read |= all_inputs(node)
            useful.append(node)
    graph.nodes = useful[::-1]


def concatenate_transposed(graph: TrialGraph) -> None:
    """The transpose of a concatenation, of which a part is transposed already, as a concatenation of transposes."""
    makers = {node.output[0]: node for node in graph.nodes}
    kept = []
    for node in graph.nodes:
        source = makers.get(node.input[0]) if _swaps(node) else None
        if source is not None and source.op_type == "Concat" and helper.get_node_attr_value(source, "axis") == -1:
            parts = [makers.get(name) for name in source.input]
            if any(part is not None and _swaps(part) for part in parts):
                turned = [f"{name}_turned" for name in source.input]
                kept += [
                    helper.make_node("Transpose", [name], [new], f"{node.name}_{number}", perm=[0, 2, 1])
                    for number, (name, new) in enumerate(zip(source.input, turned))
                ]
                node = helper.make_node("Concat", turned, list(node.output), node.name, axis=1)
        kept.append(node)
    graph.nodes = kept


def _swaps(node: Any) -> bool:
    return node.op_type == "Transpose" and list(node.attribute[0].ints) == [0, 2, 1]


def join_sums(graph: TrialGraph) -> None:
    """A sum of sums, where nobody else reads the inner one, as one ``Sum``: a product, its bias and what is added."""
    readers = Counter(name for node in graph.nodes for name in node.input)
    readers.update(graph.outputs)
    makers: dict[str, Any] = {}
    joined = set[str]()
    for node in graph.nodes:
        if node.op_type not in ("Add", "Sum"):
            continue
        terms: list[str] = []
        for name in node.input:
            if name in makers and readers[name] == 1:
                terms.extend(makers[name].input)
                joined.add(name)
            else:
                terms.append(name)
        if len(terms) > len(node.input):
            node.op_type, node.input[:] = "Sum", terms
        makers[node.output[0]] = node
    graph.nodes = [node for node in graph.nodes if node.output[0] not in joined]


def search_in_blocks(graph: TrialGraph, windows: bool = False) -> None:
    """The largest entries of a product's rows, a block of rows at a time: N x N entries at once are too many.

    What it does to ``MatMul`` → ``TopK`` where only the indices are read: a Loop over blocks of rows, each of which
    gives indices of the same shape. Every row sees the same numbers, so the indices stay the same. In ``windows`` a
    block of more than :data:`MANY` rows sees :data:`WINDOW` columns around it alone: the time, too, grows with N then.
    """
    readers = Counter(name for node in graph.nodes for name in node.input)
    makers = {node.output[0]: node for node in graph.nodes}
    kept, blocked = [], set[str]()
    for node in graph.nodes:
        product = makers.get(node.input[0]) if node.op_type == "TopK" and not readers[node.output[0]] else None
        if product is None or product.op_type != "MatMul" or readers[node.input[0]] > 1:
            kept.append(node)
        else:
            blocked.add(node.input[0])
            kept += _block_search(graph, product, node, makers.get(product.input[0]), windows)
    graph.nodes = [node for node in kept if node.output[0] not in blocked]


def _block_search(graph: TrialGraph, product: Any, largest: Any, maker: Any, windows: bool) -> list[Any]:
    """The nodes in the place of a product, whose rows ``maker`` made, and of the largest entries of its rows."""
    name, (_, indices) = largest.name, largest.output
    rows, columns = product.input
    *outer, _, k = graph.shape(indices)
    axis = len(outer)
    row_axis, block = graph.constant(f"axis_{axis}", np.array([axis], np.int64)), graph.size(BLOCK)
    count = graph.in_front("Squeeze", [graph.size("N")], "N_scalar")
    above = graph.in_front("Add", [count, graph.constant("more", np.array(BLOCK - 1, np.int64))], "N_above")
    turns = graph.in_front("Div", [above, graph.constant("block_scalar", np.array(BLOCK, np.int64))], "blocks")
    filled, parts, joined, flat = (f"{name}_{part}" for part in ("filled", "parts", "joined", "flat"))
    turn, on, stays = (f"{name}_{part}" for part in ("turn", "on", "stays"))
    start, end, part, nearness, found = (f"{name}_{item}" for item in ("start", "end", "part", "nearness", "found"))
    nodes = [
        helper.make_node("Mul", [turn, block], [start], start),
        helper.make_node("Add", [start, block], [end], end),
        helper.make_node("Slice", [filled, start, end, row_axis], [part], part),
        helper.make_node("MatMul", [part, columns], [nearness], product.name),
        _renamed(largest, [nearness, largest.input[1]], [f"{name}_values", found]),
        helper.make_node("Identity", [on], [stays], stays),  # OpenVINO wants an output of its own
    ]
    if windows:
        _see_a_window(graph, nodes, start, axis + 1)
    body = helper.make_graph(
        nodes,
        f"{name}_block",
        [
            helper.make_tensor_value_info(turn, onnx.TensorProto.INT64, []),
            helper.make_tensor_value_info(on, onnx.TensorProto.BOOL, []),
        ],
        [
            helper.make_tensor_value_info(stays, onnx.TensorProto.BOOL, []),
            helper.make_tensor_value_info(found, onnx.TensorProto.INT64, [*outer, BLOCK, k]),
        ],
    )
    target = graph.constant(f"{name}_target", np.array([*[0] * axis, -1, k], np.int64))
    return [
        *_filled(graph, rows, filled, axis, maker),
        helper.make_node("Loop", [turns, ""], [parts], f"{name}_blocks", body=body),
        helper.make_node("Transpose", [parts], [joined], joined, perm=[*range(1, axis + 1), 0, axis + 1, axis + 2]),
        helper.make_node("Reshape", [joined, target], [flat], flat),
        helper.make_node("Slice", [flat, graph.size(0), graph.size("N"), row_axis], [indices], f"{name}_all"),
    ]


def _see_a_window(graph: TrialGraph, nodes: list[Any], start: str, axis: int) -> None:
    """Let a block of rows from ``start`` on see a window of the columns, which are the last ``axis``."""
    *_, product, largest, _ = nodes
    found, count, zero = largest.output[1], graph.size("N"), graph.size(0)
    many = graph.in_front("Greater", [count, graph.size(MANY)], "many")
    window = graph.in_front("Where", [many, graph.size(WINDOW), graph.size(MANY)], "window")
    last = graph.in_front("Max", [graph.in_front("Sub", [count, window], "N_beyond_window"), zero], "last_window")
    around = graph.in_front("Sub", [window, graph.size(BLOCK)], "around_block")
    margin = graph.in_front("Div", [around, graph.size(2)], "margin")
    before, inside, first, end, seen, here = (
        f"{found}_{part}" for part in ("before", "inside", "first", "end", "seen", "here")
    )
    column_axis = graph.constant(f"axis_{axis}", np.array([axis], np.int64))
    columns, product.input[1], largest.output[1] = product.input[1], seen, here
    nodes[nodes.index(product) : nodes.index(product)] = [
        helper.make_node("Sub", [start, margin], [before], before),
        helper.make_node("Max", [before, zero], [inside], inside),
        helper.make_node("Min", [inside, last], [first], first),
        helper.make_node("Add", [first, window], [end], end),
        helper.make_node("Slice", [columns, first, end, column_axis], [seen], seen),
    ]
    nodes.append(helper.make_node("Add", [here, first], [found], found))


def _filled(graph: TrialGraph, rows: str, filled: str, axis: int, maker: Any) -> list[Any]:
    """The node that makes whole blocks of rows: a ``Pad``, in the place of the one that made the rows, if any."""
    more = np.zeros((2, axis + 2), np.int64)
    more[1, axis] = BLOCK - 1
    value: list[str] = []
    if maker is not None and maker.op_type == "Pad" and maker.input[1] in graph.trials[0]:
        more += graph.trials[0][maker.input[1]].reshape(2, -1)
        rows, value = maker.input[0], list(maker.input[2:])
    pads = graph.constant(f"{filled}_pads", more.ravel())
    return [helper.make_node("Pad", [rows, pads, *value], [filled], filled)]


def _renamed(node: Any, inputs: list[str], outputs: list[str]) -> Any:
    copy = onnx.NodeProto()
    copy.CopyFrom(node)
    copy.input[:], copy.output[:] = inputs, outputs
    return copy


def merge_equal_nodes(model: onnx.ModelProto) -> onnx.ModelProto:
    """One constant for equal ones, one node for nodes that do the same to the same, in bodies as well."""
    values: dict[Any, str] = {}
    names: dict[str, str] = {}
    for tensor in model.graph.initializer:
        array = numpy_helper.to_array(tensor)
        names[tensor.name] = values.setdefault((array.dtype.str, array.shape, array.tobytes()), tensor.name)
    _merge(model.graph, names)
    read = {name for node in model.graph.node for name in all_inputs(node)}
    constants = [tensor for tensor in model.graph.initializer if tensor.name in read]
    del model.graph.initializer[:]
    model.graph.initializer.extend(constants)
    return model


def _merge(graph: Any, names: Mapping[str, str]) -> None:
    """Merge the nodes of a graph; ``names`` tell what tensors from outside are called now."""
    names, known, kept = dict(names), dict[tuple[Any, ...], Any](), []
    outputs = {value.name for value in graph.output}
    # OpenCV writes over what a Loop starts with: each has its own.
    starts = {name for node in graph.node if node.op_type == "Loop" for name in node.input[2:]}
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        for body in bodies(node):
            _merge(body, names)
        key = (signature(node), tuple(node.input), node.output[0] if node.output[0] in starts else "")
        first = known.setdefault(key, node)
        if first is node or outputs & set(node.output):
            kept.append(node)
        else:
            names.update(zip(node.output, first.output))
    copies = []
    for node in kept:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        copies.append(copy)
    del graph.node[:]
    graph.node.extend(copies)


def share_sizes(graph: TrialGraph) -> None:
    """Reshape by constants where at most one size is free; make other shapes of the input's B and N."""
    fixed, sized = {*graph.constants, ""}, set[str]()
    reshaped: dict[str, str] = {}  # what a reshape gives, and what it or the reshapes in front of it took
    kept = []
    for node in graph.nodes:
        output = node.output[0]
        if node.op_type == "Shape" or (node.input and all(name in fixed or name in sized for name in node.input)):
            sized.update(node.output)  # depends on B and N alone
        elif not node.input:
            fixed.update(node.output)
        if node.op_type in ("Reshape", "Flatten"):
            source = reshaped.get(node.input[0], node.input[0])
            before, after = graph.shape(source), graph.shape(output)
            target = _reshape_target(before, after)
            if before == after and None not in before:
                node = helper.make_node("Identity", [source], [output], node.name)
            elif target.count(-1) <= 1:
                inputs = [source, graph.constant(f"{output}_target", np.array(target, np.int64))]
                node = helper.make_node("Reshape", inputs, [output], node.name)
                reshaped[output] = source
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
    axes, axis = [number % len(shape) for number in axes], len(shape) - 2
    if axes == [axis] and len(shape) in (3, 4):
        length = shape[axis]
        if length is not None:
            return [helper.make_node("MatMul", [_row(graph, length, 1), source], [output], node.name)]
        if (factor := graph.multiple_of_count(source, axis)) is not None:
            return [helper.make_node("MatMul", [_row(graph, "N", factor), source], [output], node.name)]
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
    count = graph.size(length)
    if factor > 1:
        count = graph.in_front("Mul", [count, graph.size(factor)], f"{row}_count")
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
    _rename(model.graph, short)
    return model


def _rename(graph: Any, short: Callable[[str], str]) -> None:
    for node in graph.node:
        node.input[:] = map(short, node.input)
        node.output[:] = map(short, node.output)
        for body in bodies(node):
            for value in [*body.input, *body.output]:
                value.name = short(value.name)
            _rename(body, short)
