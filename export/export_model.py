"""Write the model files from trained weights and check them: ``python export/export_model.py WEIGHTS``.

``--calibrate BUNDLES`` first fits the calibration on the scenes that the training config kept for tuning.
``--half-weights`` writes a twin ``NAME_half.onnx`` as well, half the size, and prints how far its answers are.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from calibrate import calibrate
from parity import check_parity, format_parity

import mgca_filter
from mgca_filter.export.onnx_export import ModelDescription, export_model, halve_weights
from mgca_filter.inference.calibration import Calibration
from mgca_filter.inference.model_file import SUMS_NAME, record_checksums
from mgca_filter.network import MGCANet, load_network
from mgca_filter.training.config import load_config

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "mgca_filter" / "training" / "configs" / "small.toml"
WEIGHTS_LICENSE = (
    "Weights were trained on photographs of which some are licensed for non-commercial use only or carry no "
    "stated licence; see the model card. The code is MIT."
)


def main() -> int:
    """0 = written and checked; 1 = the files disagree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", type=Path, help="weights.safetensors of a training run")
    parser.add_argument("--name", default="mgca_small")
    parser.add_argument("--folder", type=Path, default=ROOT / "mgca_filter" / "models")
    calibration = parser.add_mutually_exclusive_group()
    calibration.add_argument("--calibration", type=float, nargs=2, default=(1.0, 0.0), metavar=("SCALE", "OFFSET"))
    calibration.add_argument("--calibrate", type=Path, metavar="BUNDLES", help="folder that holds the tuning scenes")
    parser.add_argument("--config", type=Path, default=CONFIG, help="training config, which names the tuning scenes")
    parser.add_argument("--training-data", default="67 scenes of real photographs (see the model card)")
    parser.add_argument("--half-weights", action="store_true", help="write a twin with weights in half precision")
    options = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    description = ModelDescription(
        name=options.name,
        version=mgca_filter.__version__,
        git_commit=commit.stdout.strip(),
        training_data=options.training_data,
        license=WEIGHTS_LICENSE,
        calibration=Calibration(*options.calibration),
    )
    network = load_network(options.weights)
    if options.calibrate is not None:
        description = replace(description, calibration=_calibration(network, description, options))
    onnx_path, torch_path = export_model(network, options.folder, description)
    _record_checksums(options.folder)
    rows = check_parity(onnx_path, torch_path)
    print(format_parity(rows))
    print(f"{onnx_path} ({onnx_path.stat().st_size / 2**20:.2f} MiB)")
    if options.half_weights:
        half_path = onnx_path.with_name(f"{options.name}_half.onnx")
        halve_weights(onnx_path, half_path)
        _record_checksums(options.folder)
        print(format_parity(check_parity(half_path, torch_path)))
        print(f"{half_path} ({half_path.stat().st_size / 2**20:.2f} MiB)")
    return 0 if all(row.passed for row in rows) else 1


def _calibration(network: MGCANet, description: ModelDescription, options: argparse.Namespace) -> Calibration:
    """Fitted on the tuning scenes, with a line that says how well."""
    scenes = load_config(options.config).tuning_scenes
    with tempfile.TemporaryDirectory() as folder:
        onnx_path, _ = export_model(network, Path(folder), description)
        calibration, error = calibrate(onnx_path, options.calibrate, scenes)
    scale, offset = round(calibration.scale, 4), round(calibration.offset, 4)
    print(f"calibration {scale} {offset}, expected error on other pairs of {len(scenes)} tuning scenes {error:.4f}")
    return Calibration(scale, offset)


def _record_checksums(folder: Path) -> None:
    """Renew the checksums where a folder keeps them, before the files are opened."""
    if (folder / SUMS_NAME).exists():
        record_checksums(folder)


if __name__ == "__main__":
    sys.exit(main())
