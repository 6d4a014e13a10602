"""The profile of the network: what a matrix product costs, by the shapes that ONNX Runtime names."""

from __future__ import annotations

import pytest

from benchmarks.profile_network import Cost, costs, product_flops


def event(operator: str, inputs: list[list[int]], output: list[int]) -> dict[str, object]:
    shapes = [{"float": shape} for shape in inputs]
    names = {"op_name": operator, "input_type_shape": shapes, "output_type_shape": [{"float": output}]}
    return {"name": "/graph/MatMul_kernel_time", "dur": 3000, "args": names}


@pytest.mark.parametrize(
    ("inputs", "output"),
    [
        ([[5, 4], [4, 6]], [5, 6]),
        ([[4, 5], [4, 6]], [5, 6]),
        ([[5, 4], [6, 4]], [5, 6]),
        ([[5, 4]], [5, 6]),  # packed weights are not listed
        ([[1, 4, 5]], [1, 5, 6]),
        ([[5, 4], [4, 6], [6]], [5, 6]),  # Gemm with a bias
        ([[4, 4], [4, 6]], [4, 6]),
    ],
)
def test_a_product_counts_two_operations_for_each_term(inputs: list[list[int]], output: list[int]) -> None:
    assert product_flops(event("FusedMatMul", inputs, output)) == 2 * output[-2] * output[-1] * 4


@pytest.mark.parametrize(
    "inputs",
    [
        [[3, 5, 4], [3, 4, 6]],
        [[3, 4, 5], [3, 4, 6]],
        [[3, 5, 4], [4, 6]],  # the same weights for the whole batch
        [[5, 4], [3, 4, 6]],
        [[5, 3, 4], [3, 4, 6]],  # the batch in the middle
    ],
)
def test_a_batch_counts_each_of_its_products_once(inputs: list[list[int]]) -> None:
    assert product_flops(event("MatMul", inputs, [3, 5, 6])) == 2 * 3 * 5 * 6 * 4


def test_other_kernels_have_no_floor() -> None:
    assert product_flops(event("Add", [[5, 4], [5, 4]], [5, 4])) == 0.0


def test_parts_are_summed_over_runs() -> None:
    table = costs([event("MatMul", [[5, 4], [4, 6]], [5, 6])] * 4, 2, by_part=True)
    assert table == {"nearest neighbours": Cost(6.0, 480.0, 2)}
