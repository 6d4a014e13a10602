"""Where do the milliseconds of the network go, and how near is each part to its floor?

``python -m benchmarks.profile_network [MODEL.onnx] [--count 2000] [--threads 2]`` profiles ONNX Runtime node by node.
The floor of a part is what its matrix products alone would take at the rate of a large product, measured in the same
run. ``--scaling`` prints how time and memory grow with the number of matches instead.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

import mgca_filter
from mgca_filter.inference.backend import OUTPUT_NAMES
from mgca_filter.tables import MISSING, render_table

from .speed import network_input, run_alone

# Parts by the names of their nodes, first match first; what ONNX Runtime fused carries its own name.
PARTS = (
    ("nearest neighbours", r"(/graph|consensus/consensus|final/consensus)/[A-Z]"),
    ("annular convolution", r"/annular/"),
    ("edge maximum", r"/maximum/"),
    ("consensus, other", r"/consensus/|/final/"),
    ("attentional fusion", r"/fusion/"),
    ("context graph attention", r"/attention\d/"),
    ("order-aware block", r"/order_aware/"),
    ("PointCN", r"/(point_cn\d|order_fuse|consensus_fuse)/"),
    ("heads, eight-point", r"head|/network/[A-Z]"),
    ("GELU (fused)", r"^Gelu"),
)
GEMM_SHAPE = (2000, 512, 512)
SCALING_COUNTS, REFERENCE_COUNT = (500, 1000, 2000, 4000, 8000), 2000
# Growth by a pass over few matches is left out: it is the same for all.
MEMORY = """
import re, sys
import numpy as np, onnxruntime
def peak_mib():
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1]) / 1024
options = onnxruntime.SessionOptions()
options.log_severity_level, options.intra_op_num_threads = 3, int(sys.argv[3])
session, rng = onnxruntime.InferenceSession(sys.argv[1], options), np.random.default_rng(0)
def run(count):
    inputs = {"correspondences": 4, "attributes": 8}
    session.run(None, {name: rng.random((1, count, width), dtype=np.float32) for name, width in inputs.items()})
run(20)
before = peak_mib()
run(int(sys.argv[2]))
print(peak_mib() - before)
"""


@dataclass
class Cost:
    """Of one part, over all runs: milliseconds, floating-point operations of matrix products, kernels that ran."""

    ms: float = 0.0
    flops: float = 0.0
    kernels: int = 0


def gemm_rate(threads: int, repeats: int = 15) -> float:
    """Floating-point operations per millisecond of a large matrix product."""
    rows, inner, columns = GEMM_SHAPE
    weight = numpy_helper.from_array(np.ones((inner, columns), np.float32), "w")
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"])],
        "product",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [rows, inner])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [rows, columns])],
        [weight],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    session = onnxruntime.InferenceSession(model.SerializeToString(), session_options(threads))
    feed, times = {"x": np.ones((rows, inner), np.float32)}, []
    for _ in range(repeats):
        started = time.perf_counter()
        session.run(None, feed)
        times.append(1e3 * (time.perf_counter() - started))
    return 2.0 * rows * inner * columns / float(np.median(times))


def session_options(threads: int) -> Any:
    """Options of a session on so many threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    return options


def profile(model: Path, count: int, threads: int, repeats: int) -> tuple[list[dict[str, Any]], float]:
    """Kernel events of ``repeats`` runs, and the median milliseconds of a run without profiling."""
    inputs = dict(zip(("correspondences", "attributes"), network_input(count)))
    plain = onnxruntime.InferenceSession(str(model), session_options(threads))
    times = []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        plain.run(OUTPUT_NAMES, inputs)
        times.append(1e3 * (time.perf_counter() - started))
    with tempfile.TemporaryDirectory() as folder:
        options = session_options(threads)
        options.enable_profiling, options.profile_file_prefix = True, f"{folder}/profile"
        session = onnxruntime.InferenceSession(str(model), options)
        for _ in range(repeats):
            session.run(OUTPUT_NAMES, inputs)
        events = json.loads(Path(session.end_profiling()).read_text())
    kernels = [event for event in events if event.get("cat") == "Node" and event["name"].endswith("_kernel_time")]
    # What a Loop takes is what its body takes, which is listed as well.
    return [event for event in kernels if event["args"]["op_name"] != "Loop"], float(np.median(times[1:]))


def product_flops(event: dict[str, Any]) -> float:
    """Floating-point operations of a matrix product (one pair), from the shapes that the profile names."""
    if event["args"]["op_name"] not in ("MatMul", "FusedMatMul", "Gemm"):
        return 0.0
    inputs = [next(iter(shape.values())) for shape in event["args"]["input_type_shape"]]
    output = next(iter(event["args"]["output_type_shape"][0].values()))
    *batch, rows, _ = (1, 1, *output)[-max(2, len(output)) :]
    shape1 = inputs[0]
    if len(inputs) == 1:  # packed weights are not listed
        inner = shape1[-2] if shape1[-1] == rows and len(shape1) > 1 else shape1[-1]
        return 2.0 * float(np.prod(output)) * float(inner)
    # Either side may be transposed, or the same for the whole batch.
    candidates = (np.prod(shape1) // (np.prod(batch, dtype=int) * rows), np.prod(shape1) // rows)
    inner = next(size for size in candidates if size in shape1 and size in inputs[1])
    return 2.0 * float(np.prod(output)) * float(inner)


def costs(events: list[dict[str, Any]], repeats: int, by_part: bool) -> dict[str, Cost]:
    """Cost per run of each part, or of each operator."""
    total: dict[str, Cost] = defaultdict(Cost)
    for event in events:
        name = event["name"].removesuffix("_kernel_time")
        part = next((part for part, pattern in PARTS if re.search(pattern, name)), "input, sizes, rest")
        cost = total[part if by_part else event["args"]["op_name"]]
        cost.ms += event["dur"] / 1e3 / repeats
        cost.flops += product_flops(event) / repeats
        cost.kernels += 1
    for cost in total.values():
        cost.kernels //= repeats
    return dict(sorted(total.items(), key=lambda item: -item[1].ms))


def print_costs(title: str, table: dict[str, Cost], rate: float) -> None:
    """Markdown: milliseconds, share, floor of the products, and how many times that floor."""
    total = sum(cost.ms for cost in table.values())
    whole = Cost(total, sum(cost.flops for cost in table.values()), sum(cost.kernels for cost in table.values()))
    body = []
    for name, cost in [*table.items(), ("all", whole)]:
        floor = cost.flops / rate
        times = f"{cost.ms / floor:.1f}" if floor > 0.01 * cost.ms else MISSING
        share = f"{100 * cost.ms / total:.0f} %"
        body.append([name, str(cost.kernels), f"{cost.ms:.2f}", share, f"{floor:.2f}", times])
    print("\n" + render_table([title, "kernels", "ms", "share", "floor, ms", "times the floor"], body))


def print_scaling(model: Path, threads: int, repeats: int) -> None:
    """Markdown: least milliseconds of a pass, all counts in turn, and the growth of a process of its own."""
    session = onnxruntime.InferenceSession(str(model), session_options(threads))
    inputs = {count: dict(zip(("correspondences", "attributes"), network_input(count))) for count in SCALING_COUNTS}
    times: dict[int, list[float]] = {count: [] for count in SCALING_COUNTS}
    for _ in range(repeats):
        for count in SCALING_COUNTS:
            started = time.perf_counter()
            session.run(OUTPUT_NAMES, inputs[count])
            times[count].append(1e3 * (time.perf_counter() - started))
    memory = {count: run_alone(MEMORY, model, count, threads)[0] for count in SCALING_COUNTS}
    least = {count: min(values) for count, values in times.items()}
    base = REFERENCE_COUNT
    body = [
        [
            str(n),
            f"{least[n]:.1f}",
            f"{least[n] / least[base]:.2f}",
            f"{memory[n]:.0f}",
            f"{memory[n] / memory[base]:.2f}",
        ]
        for n in SCALING_COUNTS
    ]
    print(f"Threads: {threads}; multiples of N = {base}.\n")
    print(render_table(["N", "ms", "times", "MiB", "times"], body))


def main() -> None:
    """Print the cost of each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?", default=mgca_filter.model_path())
    parser.add_argument("--count", type=int, default=2000, help="matches")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--operators", action="store_true", help="the most expensive operators as well")
    parser.add_argument("--scaling", action="store_true", help="time and memory over the number of matches")
    options = parser.parse_args()
    if options.scaling:
        print_scaling(options.model, options.threads, options.repeats)
        return
    rate = gemm_rate(options.threads)
    events, run_ms = profile(options.model, options.count, options.threads, options.repeats)
    print(
        f"N = {options.count}, threads: {options.threads}. {run_ms:.1f} ms a pass; "
        f"a large matrix product runs at {rate / 1e6:.0f} GFLOP/s."
    )
    print_costs("part (times with profiling on)", costs(events, options.repeats, by_part=True), rate)
    if options.operators:
        operators = costs(events, options.repeats, by_part=False)
        print_costs("operator", dict(list(operators.items())[:14]), rate)


if __name__ == "__main__":
    main()
