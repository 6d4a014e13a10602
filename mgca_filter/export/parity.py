"""Do all runtimes say the same? ``python -m mgca_filter.export.parity [MODEL.onnx] [--bundles FOLDER]``.

PyTorch is the reference; ONNX Runtime, OpenCV's DNN module and OpenVINO (``pip install openvino``) are compared with
it, each where it is installed. With ``--reference OTHER.onnx`` it is another file in ONNX Runtime: an export before
this one, say.
Neighbours and the better half of the matches are chosen by comparison, so the network is not continuous: where two
distances agree to seven digits, two runtimes choose differently, and the logits of some matches differ in the second
digit. The last rows show what that means: PyTorch against itself, with every coordinate moved by one unit in the last
place.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data.scene_bundle import SceneBundle
from ..errors import BackendError
from ..inference import Backend, open_backend
from ..inference.backend import Float32Array
from ..inference.scoring import select_network_input
from ..inputs.pair import MatchPair, prepare_pair
from ..match_filter import model_path

COUNTS = (1, 2, 7, 8, 9, 127, 512, 2000)
MORE_COUNTS = (*COUNTS, 8000)
SEEDS = (0, 1, 2)
DIFFERENT = 1e-3  # a logit further away than this counts as different
QUANTILE_TOLERANCE = 0.15  # nine matches of ten agree better than this; torch moved by an ulp is no better
ESSENTIAL_TOLERANCE = 1e-2
ESSENTIAL_FROM = 16  # below this many matches the essential matrix is arbitrary
PAIRS_PER_SCENE = 3

Inputs = tuple[Float32Array, Float32Array]


@dataclass(frozen=True)
class ParityRow:
    """Differences of a runtime from another on inputs of one size.

    Attributes:
        runtime: the one that is compared.
        count: matches of an input; matches: of all inputs.
        logit_difference: largest; quantile_90: what nine of ten matches stay below.
        different: matches whose logits differ by more than 1e-3. flipped: whose logits differ in sign.
        essential_difference: largest of E, up to sign (NaN below 16 matches).
    """

    runtime: str
    count: int
    matches: int
    logit_difference: float
    quantile_90: float
    different: int
    flipped: int
    essential_difference: float

    @property
    def masks_equal(self) -> bool:
        return self.flipped == 0

    @property
    def passed(self) -> bool:
        essential = np.isnan(self.essential_difference) or self.essential_difference < ESSENTIAL_TOLERANCE
        return self.quantile_90 < QUANTILE_TOLERANCE and self.flipped <= self.matches // 1000 and bool(essential)


def two_view_input(count: int, seed: int = 0) -> Inputs:
    """A pair (1, count, 4), (1, count, 8) with a third of its matches right, as a detector would give it."""
    rng = np.random.default_rng([seed, count])
    angle = 0.15
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    X = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 9, count)])
    X2 = X @ R.T + np.array([-1.0, 0.1, 0.2])
    x1, x2 = X[:, :2] / X[:, 2:], X2[:, :2] / X2[:, 2:]
    right = rng.random(count) < 1 / 3
    x2[~right] = rng.uniform(-0.5, 0.5, (int((~right).sum()), 2))
    noise = rng.normal(0, 5e-4, (count, 4))
    attributes = np.zeros((count, 8))
    attributes[:, 0] = np.where(right, rng.uniform(0.4, 0.9, count), rng.uniform(0.7, 0.95, count))
    attributes[:, 1] = 1.0
    attributes[:, 2] = rng.normal(0, np.where(right, 0.1, 1.0))
    turn = np.where(right, rng.normal(0, 0.1, count), rng.uniform(-np.pi, np.pi, count))
    attributes[:, 3], attributes[:, 4] = np.cos(turn), np.sin(turn)
    attributes[:, 5:] = 1.0
    correspondences = np.hstack([x1, x2]) + noise
    return correspondences[None].astype(np.float32), attributes[None].astype(np.float32)


def compare_on(a: Backend, b: Backend, inputs: Sequence[Inputs]) -> ParityRow:
    """Run both backends on the same inputs."""
    differences, flipped, essentials = [], 0, [np.nan]
    for pair in inputs:
        (logits_a, E_a), (logits_b, E_b) = a.infer(*pair), b.infer(*pair)
        differences.append(np.abs(logits_a - logits_b).ravel())
        flipped += int(np.count_nonzero((logits_a > 0) != (logits_b > 0)))
        if pair[0].shape[1] >= ESSENTIAL_FROM:
            essentials.append(min(np.abs(E_a - E_b).max(), np.abs(E_a + E_b).max()))
    difference = np.concatenate(differences)
    return ParityRow(
        runtime=a.name,
        count=inputs[0][0].shape[1],
        matches=len(difference),
        logit_difference=float(difference.max()),
        quantile_90=float(np.quantile(difference, 0.9)),
        different=int(np.count_nonzero(difference > DIFFERENT)),
        flipped=flipped,
        essential_difference=float(np.fmax.reduce(essentials)),
    )


def compare(a: Backend, b: Backend, count: int, seeds: Sequence[int] = (0,)) -> ParityRow:
    """Run both backends on synthetic pairs of ``count`` matches."""
    return compare_on(a, b, [two_view_input(count, seed) for seed in seeds])


def check_parity(onnx_path: Path, torch_path: Path, counts: Sequence[int] = COUNTS) -> list[ParityRow]:
    """ONNX Runtime against torch, one row per number of matches."""
    onnx_backend, torch_backend = open_backend(onnx_path, "onnxruntime"), open_backend(torch_path, "torch")
    return [compare(onnx_backend, torch_backend, count) for count in counts]


def format_parity(rows: Sequence[ParityRow]) -> str:
    """Markdown table."""
    lines = [
        "| runtime | N | max \\|Δlogit\\| | 90 % below | above 1e-3 | other sign | max \\|ΔE\\| | |",
        "|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in rows:
        essential = "–" if np.isnan(row.essential_difference) else f"{row.essential_difference:.1e}"
        verdict = "ok" if row.passed else "FAILED"
        lines.append(f"| {row.runtime} | {row.count} | {_figures(row)} | {essential} | {verdict} |")
    return "\n".join(lines)


def format_real_pairs(rows: Sequence[ParityRow]) -> str:
    """Markdown table without a verdict: how far the last digits reach depends on the pairs."""
    lines = ["| runtime | max \\|Δlogit\\| | 90 % below | above 1e-3 | other sign |", "|---|---:|---:|---:|---:|"]
    return "\n".join([*lines, *(f"| {row.runtime} | {_figures(row)} |" for row in rows)])


def _figures(row: ParityRow) -> str:
    different = f"{row.different} of {row.matches}"
    return f"{row.logit_difference:.1e} | {row.quantile_90:.1e} | {different} | {row.flipped}"


class OpenVinoRuntime:
    """The ONNX file in OpenVINO, one pair at a time in full precision on the CPU; ImportError where it is missing.

    Why one pair, and why told the precision: ``docs/how_to/runtimes.md``.
    """

    name = "openvino"

    def __init__(self, path: Path) -> None:
        import openvino

        self.metadata = open_backend(path, "onnxruntime").metadata
        model = openvino.Core().read_model(path)
        model.reshape({"correspondences": [1, -1, 4], "attributes": [1, -1, 8]})
        self._model = openvino.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> Inputs:
        """One forward pass, as of the package's backends."""
        outputs = self._model({"correspondences": correspondences, "attributes": attributes})
        return np.array(outputs["logits"]), np.array(outputs["essential"])


class MovedByAnUlp:
    """A backend whose input is moved by one unit in the last place, each coordinate up or down at random."""

    def __init__(self, backend: Backend) -> None:
        self.name, self.metadata = f"{backend.name}, input moved by an ulp", backend.metadata
        self._backend, self._rng = backend, np.random.default_rng(0)

    def infer(self, correspondences: Float32Array, attributes: Float32Array) -> Inputs:
        """One forward pass of the backend on the moved input."""
        toward = np.where(self._rng.random(correspondences.shape) < 0.5, np.inf, -np.inf).astype(np.float32)
        return self._backend.infer(np.nextafter(correspondences, toward), attributes)


def open_runtimes(path: Path) -> list[Backend]:
    """All runtimes of an ONNX file that can be started here; the others are named on stderr."""
    runtimes: list[Backend] = []
    for name in ("onnxruntime", "opencv"):
        try:
            runtimes.append(open_backend(path, name))
        except BackendError as error:
            print(f"without {name}: {error}", file=sys.stderr)
    try:
        runtimes.append(OpenVinoRuntime(path))
    except ImportError as error:
        print(f"without openvino: {error}", file=sys.stderr)
    return runtimes


def real_inputs(model: Path, folder: Path) -> list[Inputs]:
    """What the filter sends through the network for pairs of scene bundles, evenly chosen."""
    backend, inputs = open_backend(model), []
    for bundle in map(SceneBundle, sorted(folder.glob("*.npz"))):
        for index in np.unique(np.linspace(0, len(bundle) - 1, PAIRS_PER_SCENE).astype(int)):
            pair = bundle[int(index)]
            arrays = MatchPair(pair.points1, pair.points2, None, pair.K1, pair.K2, attributes=pair.attributes)
            prepared = prepare_pair(arrays)
            sent = select_network_input(prepared.correspondences, prepared.attributes, prepared.valid, backend, seed=0)
            inputs.append((sent.correspondences[None], sent.attributes[None]))
    return inputs


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the matrix; 0 = the runtimes agree on the synthetic pairs, 1 = they do not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?", default=model_path())
    parser.add_argument("--counts", type=int, nargs="+", default=MORE_COUNTS, help="matches per synthetic pair")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, help="one synthetic pair each")
    parser.add_argument("--bundles", type=Path, help="folder of scene bundles: candidates of real pairs as well")
    parser.add_argument("--reference", type=Path, metavar="ONNX", help="compare with this file instead of PyTorch")
    options = parser.parse_args(arguments)
    reference = open_backend(options.reference or options.model, "onnxruntime" if options.reference else "torch")
    runtimes = [*open_runtimes(options.model), MovedByAnUlp(reference)]
    rows = [compare(runtime, reference, n, options.seeds) for runtime in runtimes for n in options.counts]
    print(format_parity(rows))
    if options.bundles:
        inputs = real_inputs(options.model, options.bundles)
        print(f"\nCandidates of {len(inputs)} real pairs:\n")
        print(format_real_pairs([compare_on(runtime, reference, inputs) for runtime in runtimes]))
    return 0 if all(row.passed for row in rows if not row.runtime.startswith(reference.name + ",")) else 1


if __name__ == "__main__":
    sys.exit(main())
