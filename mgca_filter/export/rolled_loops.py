"""Equal steps that follow each other as the body of one ``Loop``. Needs the ``[export]`` extra.

Tracing unrolls every iteration of Python's: twenty squarings of a matrix, eight steps of a refinement, the pivots of a
solver. Runtimes open a node of a body once, and some take the square of the number of nodes for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from .trial_graph import TrialGraph, all_inputs, signature

LEAST_SAVED = 8  # nodes; a Loop is one itself, and takes what differs from step to step out of a stack
LONGEST_STEP = 200

Array = NDArray[Any]


@dataclass
class _Roll:
    """Steps of a Loop: ``count`` times ``period`` nodes from ``start`` on, and what differs from step to step.

    Attributes:
        carried: (what the first step takes, what each step hands on, by the name of the first step's).
        stacked: names of the constants of all steps.
        replaced: which of these an input of the first step is, by node and place among its inputs.
    """

    start: int
    period: int
    count: int
    carried: list[tuple[str, str]] = field(default_factory=list)
    stacked: list[tuple[str, ...]] = field(default_factory=list)
    replaced: dict[tuple[int, int], tuple[str, ...]] = field(default_factory=dict)


class LoopRoller:
    """Rolls the steps of one graph and, inside their bodies, of the bodies themselves."""

    def __init__(self, model: onnx.ModelProto) -> None:
        self._model, self._graph = model, TrialGraph(model)
        self._constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}

    def run(self) -> onnx.ModelProto:
        """The model with Loops."""
        outputs = {value.name for value in self._model.graph.output}
        nodes = self._rolled(list(self._model.graph.node), outputs)
        del self._model.graph.node[:], self._model.graph.value_info[:]
        self._model.graph.node.extend(nodes)
        return self._model

    def _rolled(self, nodes: list[Any], wanted: set[str]) -> list[Any]:
        """The nodes with Loops in the place of equal steps; ``wanted`` are the names that must stay."""
        refused = set[tuple[int, int]]()
        while True:
            for start, period, count in _repetitions(nodes):
                if (start, period) in refused:
                    continue
                roll = self._check(nodes, start, period, count, wanted)
                if roll is not None:
                    nodes = self._replace(nodes, roll)
                    refused = set()
                    break
                refused.add((start, period))
            else:
                return nodes

    def _check(self, nodes: list[Any], start: int, period: int, count: int, wanted: set[str]) -> _Roll | None:
        """How the steps depend on each other, or None where they are not the steps of a Loop."""
        steps = [nodes[start + step * period : start + (step + 1) * period] for step in range(count)]
        origins = {
            name: (step, index, which)
            for step, block in enumerate(steps)
            for index, node in enumerate(block)
            for which, name in enumerate(node.output)
        }
        roll = _Roll(start, period, count)
        for index in range(period):
            for slot, names in enumerate(zip(*(step[index].input for step in steps))):
                if not self._trace(names, origins, steps, roll, (index, slot)):
                    return None
        if (count - 1) * period - len(roll.stacked) - 4 < LEAST_SAVED:
            return None
        handed_on = {state for _, state in roll.carried}
        outside = {name for node in nodes[start + period * count :] for name in all_inputs(node)} | wanted
        for name in outside & set(origins):
            step, index, which = origins[name]
            if step != count - 1 or steps[0][index].output[which] not in handed_on:
                return None
        return roll

    def _trace(
        self,
        names: tuple[str, ...],
        origins: dict[str, tuple[int, int, int]],
        steps: list[Any],
        roll: _Roll,
        place: tuple[int, int],
    ) -> bool:
        """Note where an input of all steps comes from; False where the steps disagree."""
        found = [origins.get(name) for name in names]
        if found[0] is not None:  # made in the same step
            return all(origin == (step, *found[0][1:]) for step, origin in enumerate(found))
        if all(name == names[0] for name in names):  # made before the Loop
            return True
        if all(name in self._constants for name in names):
            values = [self._constants[name] for name in names]
            if all(np.array_equal(value, values[0]) for value in values):
                return True
            if {(value.shape, value.dtype) for value in values} != {(values[0].shape, np.dtype(np.float32))}:
                return False
            if names not in roll.stacked:
                roll.stacked.append(names)
            roll.replaced[place] = names
            return True
        if found[1] is None or any(origin != (step, *found[1][1:]) for step, origin in enumerate(found[1:])):
            return False
        _, index, which = found[1]
        carried = (names[0], steps[0][index].output[which])
        if carried not in roll.carried:
            roll.carried.append(carried)
        roll.replaced[place] = carried
        return True

    def _replace(self, nodes: list[Any], roll: _Roll) -> list[Any]:
        """The nodes with the steps of ``roll`` in a Loop."""
        end = roll.start + roll.period * roll.count
        first, last = nodes[roll.start : roll.start + roll.period], nodes[end - roll.period : end]
        name = first[0].output[0]
        turn, on, stays = f"{name}_turn", f"{name}_on", f"{name}_stays"
        inside = dict[tuple[str, ...], str]()
        body = self._constants_of_turn(roll, name, turn, inside)
        for number, carried in enumerate(roll.carried):
            inside[carried] = f"{name}_state_{number}"
        for index, node in enumerate(first):
            copy = onnx.NodeProto()
            copy.CopyFrom(node)
            for slot in range(len(node.input)):
                if (index, slot) in roll.replaced:
                    copy.input[slot] = inside[roll.replaced[index, slot]]
            body.append(copy)
        states = [state for _, state in roll.carried]
        body.append(helper.make_node("Identity", [on], [stays], stays))  # OpenVINO wants an output of its own
        made = {
            output: final for node, end_node in zip(first, last) for output, final in zip(node.output, end_node.output)
        }
        graph = helper.make_graph(
            self._rolled(body, {stays, *states}),
            f"{name}_step",
            [
                helper.make_tensor_value_info(turn, TensorProto.INT64, []),
                helper.make_tensor_value_info(on, TensorProto.BOOL, []),
                *(self._value(inside[carried], carried[1]) for carried in roll.carried),
            ],
            [
                helper.make_tensor_value_info(stays, TensorProto.BOOL, []),
                *(self._value(state, state) for state in states),
            ],
        )
        count = self._constant(f"turns_{roll.count}", np.array(roll.count, np.int64))
        starts, finals = [start for start, _ in roll.carried], [made[state] for state in states]
        loop = helper.make_node("Loop", [count, "", *starts], finals, f"{first[0].name}_loop", body=graph)
        return [*nodes[: roll.start], loop, *nodes[end:]]

    def _constants_of_turn(self, roll: _Roll, name: str, turn: str, inside: dict[tuple[str, ...], str]) -> list[Any]:
        """Nodes that give a step its constants, and in ``inside`` their names.

        Each is taken out of a stack of its own, or all are slices of one row for each step: whichever is fewer nodes.
        """
        stacks = dict[Any, Array]()
        for constants in roll.stacked:
            stack = np.stack([self._constants[item] for item in constants])
            key = stack.shape, stack.tobytes()
            stacks.setdefault(key, stack)
            inside[constants] = f"{name}_of_turn_{list(stacks).index(key)}"
        sliced = 3 + sum(stack.ndim != 2 for stack in stacks.values())
        nodes, splits = list[Any](), list[str]()
        if 2 * len(stacks) <= sliced:
            for number, stack in enumerate(stacks.values()):
                taken = f"{name}_taken_{number}"
                nodes.append(self._taken(stack, turn, taken))
                nodes.append(self._reshaped(taken, stack.shape[1:], f"{name}_of_turn_{number}"))
            return nodes
        taken, row = f"{name}_taken", f"{name}_row"
        rows = np.concatenate([stack.reshape(roll.count, -1) for stack in stacks.values()], 1)
        for number, stack in enumerate(stacks.values()):
            value = f"{name}_of_turn_{number}"
            splits.append(value if stack.ndim == 2 else f"{value}_flat")
            if stack.ndim != 2:
                nodes.append(self._reshaped(splits[-1], stack.shape[1:], value))
        sizes = self._constant(f"{name}_widths", np.array([stack[0].size for stack in stacks.values()], np.int64))
        split = helper.make_node("Split", [row, sizes], splits, f"{name}_split", axis=0)
        return [self._taken(rows, turn, taken), self._reshaped(taken, (-1,), row), split, *nodes]

    def _taken(self, stack: Array, turn: str, output: str) -> Any:
        """The node that takes what belongs to a turn out of what belongs to all."""
        return helper.make_node("Gather", [self._constant(f"{output}_of_all", stack), turn], [output], output, axis=0)

    def _reshaped(self, source: str, shape: tuple[int, ...], output: str) -> Any:
        """A reshape. What was taken needs one: the turn is a scalar, but in OpenCV it has an axis."""
        target = self._constant(f"shape_{shape}", np.array(shape, np.int64))
        return helper.make_node("Reshape", [source, target], [output], output)

    def _constant(self, name: str, value: Array) -> str:
        if name not in self._constants:
            self._constants[name] = value
            self._model.graph.initializer.append(numpy_helper.from_array(value, name))
        return name

    def _value(self, name: str, like: str) -> onnx.ValueInfoProto:
        """A tensor that goes into a body or comes out of it: OpenCV wants to know how many axes it has."""
        return helper.make_tensor_value_info(name, self._graph.element_type(like), self._graph.shape(like))


def _repetitions(nodes: Sequence[Any]) -> list[tuple[int, int, int]]:
    """Start, period and count of nodes that repeat themselves by operator, those that save most first."""
    kinds: dict[Any, int] = {}
    numbers = np.array([kinds.setdefault(signature(node), len(kinds)) for node in nodes])
    found = []
    for period in range(1, min(LONGEST_STEP, len(nodes) // 2) + 1):
        equal = np.concatenate([[False], numbers[:-period] == numbers[period:], [False]])
        edges = np.flatnonzero(np.diff(equal.astype(int)))
        for first, last in zip(edges[::2], edges[1::2]):
            count = int(last - first) // period + 1
            saved = (count - 1) * period
            if count > 1 and saved >= LEAST_SAVED:
                slack = int(last - first) + period - count * period
                found += [(saved, count, int(first) + shift, period) for shift in range(slack + 1)]
    found.sort(key=lambda item: (-item[0], -item[1], item[2]))
    return [(start, period, count) for _, count, start, period in found]


def roll_loops(model: onnx.ModelProto) -> onnx.ModelProto:
    """Equal steps that follow each other as Loops."""
    return LoopRoller(model).run()
