"""Write the model files from trained weights and check them: ``python -m mgca_filter.export WEIGHTS``.

``--calibrate BUNDLES`` first fits the calibration on the scenes that the training config kept for tuning.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from .. import __version__
from ..evaluation.environment import source_commit
from ..inference.calibration import Calibration
from ..inference.model_file import SUMS_NAME, record_checksums
from ..match_filter import model_path
from ..network import MGCANet, load_network, save_network
from ..training.config import load_config
from .calibration_fit import calibrate
from .onnx_export import ModelDescription, export_model, model_metadata
from .parity import check_parity, format_parity

CONFIG = Path(__file__).resolve().parent.parent / "training" / "configs" / "small.toml"
WEIGHTS_LICENSE = (
    "Weights were trained on photographs of which some are licensed for non-commercial use only or carry no "
    "stated licence; see the model card. The code is MIT."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """0 = written and checked; 1 = the files disagree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, help="weights.safetensors of a training run")
    parser.add_argument("--name", default="mgca_small")
    parser.add_argument("--folder", type=Path, default=model_path().parent)
    calibration = parser.add_mutually_exclusive_group()
    calibration.add_argument("--calibration", type=float, nargs=2, default=(1.0, 0.0), metavar=("SCALE", "OFFSET"))
    calibration.add_argument("--calibrate", type=Path, metavar="BUNDLES", help="folder that holds the tuning scenes")
    parser.add_argument("--config", type=Path, default=CONFIG, help="training config, which names the tuning scenes")
    parser.add_argument("--training-data", default="67 scenes of real photographs (see the model card)")
    options = parser.parse_args(arguments)
    description = ModelDescription(
        name=options.name,
        version=__version__,
        git_commit=source_commit() or "unknown",
        training_data=options.training_data,
        license=WEIGHTS_LICENSE,
        calibration=Calibration(*options.calibration),
    )
    network = load_network(options.weights)
    if options.calibrate is not None:
        description = replace(description, calibration=_calibration(network, description, options))
    onnx_path, torch_path = export_model(network, options.folder, description)
    if (options.folder / SUMS_NAME).exists():  # before the files are opened
        record_checksums(options.folder)
    rows = check_parity(onnx_path, torch_path)
    print(format_parity(rows))
    print(f"{onnx_path} ({onnx_path.stat().st_size / 2**20:.2f} MiB)")
    return 0 if all(row.passed for row in rows) else 1


def _calibration(network: MGCANet, description: ModelDescription, options: argparse.Namespace) -> Calibration:
    """Fitted on the tuning scenes, with a line that says how well."""
    scenes = load_config(options.config).tuning_scenes
    with tempfile.TemporaryDirectory() as folder:
        weights = Path(folder) / "uncalibrated.safetensors"
        save_network(network, weights, model_metadata(network, description))
        calibration, error = calibrate(weights, options.calibrate, scenes)
    scale, offset = round(calibration.scale, 4), round(calibration.offset, 4)
    print(f"calibration {scale} {offset}, expected error on other pairs of {len(scenes)} tuning scenes {error:.4f}")
    return Calibration(scale, offset)


if __name__ == "__main__":
    sys.exit(main())
