"""How long do versions of ONNX Runtime take to open a model file? ``python -m benchmarks.opening [MODEL.onnx]``.

Versions 1.24 to 1.31 take the square of the number of nodes. Each version is installed into a virtual environment of
its own (``--environments FOLDER`` keeps them), opens the file in fresh processes, and says the logits of a synthetic
pair, which are compared with those of the ONNX Runtime that is installed here. Exit status 1: a version takes longer
than ``--limit`` seconds, or says something else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from mgca_filter import model_path
from mgca_filter.export.parity import QUANTILE_TOLERANCE, two_view_input
from mgca_filter.export.trial_graph import count_nodes
from mgca_filter.inference import open_backend
from mgca_filter.tables import render_table

# The oldest that setup.cfg admits, both sides of the slow ones, slow ones, the newest.
VERSIONS = ("1.15.1", "1.22.1", "1.24.4", "1.27.0", "1.31.1", "1.32.0")
LAST_BEFORE_NUMPY_2 = (1, 18)
LIMIT_S = 0.6
MATCHES = 500

PROBE = """
import json, sys, time
import numpy as np
import onnxruntime
model, inputs = sys.argv[1:]
options = onnxruntime.SessionOptions()
options.log_severity_level, options.intra_op_num_threads = 3, 1
wall, cpu = time.perf_counter(), time.process_time()
session = onnxruntime.InferenceSession(
    model, options, providers=["CPUExecutionProvider"], disabled_optimizers=["MatMulScaleFusion"]
)
wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
logits = session.run(["logits"], dict(np.load(inputs)))[0]
print(json.dumps({"wall": wall, "cpu": cpu, "logits": logits.ravel().tolist()}))
"""


@dataclass(frozen=True)
class Opening:
    """Of one version: least seconds of several processes, and how far its logits are from those said here.

    Attributes:
        wall_s, cpu_s: elapsed time and processor time. quantile_90: what nine of ten differences stay below.
        flipped: logits of another sign.
    """

    version: str
    wall_s: float
    cpu_s: float
    quantile_90: float
    flipped: int

    def passed(self, limit_s: float) -> bool:
        return self.cpu_s < limit_s and self.quantile_90 < QUANTILE_TOLERANCE and self.flipped == 0


def environment_python(folder: Path, version: str) -> Path:
    """Python of the version's environment, which is made unless it is there."""
    environment = folder / version
    python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    if not python.exists():
        venv.create(environment, with_pip=True)
        old = tuple(map(int, version.split(".")[:2])) <= LAST_BEFORE_NUMPY_2
        packages = [f"onnxruntime=={version}", "numpy<2" if old else "numpy"]
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return python


def probe(python: Path, model: Path, inputs: Path) -> dict[str, Any]:
    """Seconds and logits of one opening in a fresh process."""
    done = subprocess.run([python, "-c", PROBE, model, inputs], check=True, stdout=subprocess.PIPE, text=True)
    said: dict[str, Any] = json.loads(done.stdout)
    return said


def measure(model: Path, versions: Sequence[str], environments: Path, repeats: int) -> list[Opening]:
    """Open a model in each version."""
    correspondences, attributes = two_view_input(MATCHES)
    expected = open_backend(model, "onnxruntime").infer(correspondences, attributes)[0].ravel()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs.npz"
        np.savez(inputs, correspondences=correspondences, attributes=attributes)
        for version in versions:
            python = environment_python(environments, version)
            tries = [probe(python, model, inputs) for _ in range(repeats)]
            logits = np.array(tries[0]["logits"])
            wall, cpu = (min(said[clock] for said in tries) for clock in ("wall", "cpu"))
            difference = float(np.quantile(np.abs(logits - expected), 0.9))
            rows.append(Opening(version, wall, cpu, difference, int(np.sum((logits > 0) != (expected > 0)))))
    return rows


def format_openings(rows: Sequence[Opening], limit_s: float) -> str:
    """Markdown table."""
    header = ["ONNX Runtime", "CPU seconds", "seconds", "90 % of |Δlogit| below", "other sign", ""]
    body = [
        [
            row.version,
            f"{row.cpu_s:.2f}",
            f"{row.wall_s:.2f}",
            f"{row.quantile_90:.1e}",
            str(row.flipped),
            "ok" if row.passed(limit_s) else "FAILED",
        ]
        for row in rows
    ]
    return render_table(header, body)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 0 = all versions open the file in time and say the same."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?", default=model_path())
    parser.add_argument("--versions", nargs="+", default=VERSIONS)
    parser.add_argument("--environments", type=Path, help="folder of the environments; kept")
    parser.add_argument("--repeats", type=int, default=3, help="processes per version; the fastest counts")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="CPU seconds that an opening may take")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(options.model, options.versions, options.environments or Path(folder), options.repeats)
    print(f"`{options.model.name}` has {count_nodes(onnx.load(str(options.model)).graph)} nodes, bodies included.\n")
    print(format_openings(rows, options.limit))
    return 0 if all(row.passed(options.limit) for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
