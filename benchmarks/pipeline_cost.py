"""Measures `mgca-match folder` with one and two workers, on processes and on Ray, and works out a million pairs.

    python -m benchmarks.pipeline_cost [--views 14] [--price 0.04] [--engines local,ray]

Prints the tables of docs/pipelines/cost.md. Views are rendered by examples/render_views.py; features are extracted
once before, so that the pairs' time is measured alone. Processor seconds, start included, count on a machine that is
busy with other work too; pairs per second do not.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from mgca_filter.tables import render_table

ROOT = Path(__file__).parent.parent
MILLION = 1_000_000


@dataclass(frozen=True)
class Measurement:
    """One run: what the command printed and what the clock and the kernel say."""

    name: str
    pairs: int
    pairs_per_s: float
    wall_s: float
    processor_s: float
    output: bytes


def run_folder(images: Path, name: str, *words: str) -> Measurement:
    """Run the command on all pairs of the folder."""
    output = images.parent / f"{len(list(images.parent.glob('*.jsonl')))}.jsonl"
    cache = images.parent / "cache"
    features = ["--detector", "sift", "--max-keypoints", "2000", "--cache", str(cache)]
    options = ["--K", "512,512,319.5,239.5", *features, *words]
    command = [sys.executable, "-m", "mgca_filter", "folder", str(images), "-o", str(output), *options]
    # Ray's workers give way to everything else (niceness 15) unless told otherwise: no fair race on a busy machine.
    ray = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **ray}
    before, started = processor_seconds(), time.perf_counter()
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    wall_s, processor_s = time.perf_counter() - started, processor_seconds() - before
    told = re.search(r"(\d+) pairs in .* s, (\S+) pairs/s", done.stdout)
    if told is None:
        raise SystemExit(f"{' '.join(command)}: no count of pairs in {done.stdout!r}")
    pairs, rate = told.groups()
    return Measurement(name, int(pairs), float(rate), wall_s, processor_s, output.read_bytes())


def processor_seconds() -> float:
    """Processor time of all finished children, seconds."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure many pairs and work out the cost of a million.")
    parser.add_argument("--views", type=int, default=14)
    parser.add_argument("--price", type=float, default=0.04, help="of one processor for one hour")
    parser.add_argument("--engines", default="local,ray")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        render = [sys.executable, str(ROOT / "examples" / "render_views.py"), "--count", str(options.views)]
        subprocess.run([*render, "--out", folder, "--supersampling", "1"], check=True, capture_output=True)
        images = Path(folder) / "images"
        run_folder(images, "features")
        runs = [
            run_folder(images, f"{engine}, {workers}", "--engine", engine, "-j", str(workers))
            for engine in options.engines.split(",")
            for workers in (1, 2)
        ]
    print(f"Same output of all runs: {'yes' if len({run.output for run in runs}) == 1 else 'NO'}.\n")
    body = []
    for run in runs:
        # Ray's workers are no children of the command, and the kernel does not add them up.
        processor_s = "" if run.name.startswith("ray") else f"{run.processor_s / run.pairs:.3f}"
        body.append([run.name, str(run.pairs), f"{run.pairs_per_s:.1f}", f"{run.wall_s:.1f}", processor_s])
    print(render_table(["engine, workers", "pairs", "pairs/s", "whole command, s", "processor s per pair"], body))
    per_pair = runs[0].processor_s / runs[0].pairs
    hours = MILLION * per_pair / 3600.0
    print(f"\nA million pairs at {per_pair:.3f} processor seconds each: {hours:.0f} processor hours.\n")
    body = [[str(n), f"{hours / n:.1f}", f"{hours * options.price:.2f}"] for n in (1, 2, 16, 64, 256)]
    print(render_table(["processors", "hours", "cost"], body, align="r"))


if __name__ == "__main__":
    main()
