"""Fit the calibration of a model on scene bundles: ``python export/calibrate.py MODEL.onnx BUNDLES SCENE …``.

Fits on the even pairs of the scenes named, checks on the odd ones, and prints what ``export_model.py
--calibration`` takes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mgca_filter.evaluation.calibration_fit import collect_logits, expected_calibration_error, fit_calibration
from mgca_filter.evaluation.methods import BoolArray, FloatArray
from mgca_filter.scene_bundle import SceneBundle, ScenePair
from mgca_filter.training.validation import select_pairs


def gather(model: Path, pairs: list[ScenePair]) -> tuple[FloatArray, BoolArray]:
    """Logits and truth of all matches of all pairs."""
    logits, truth = collect_logits(model, pairs)
    return np.concatenate(logits), np.concatenate(truth)


def main() -> None:
    """Print scale, offset and the calibration error on pairs that the fit did not see."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("bundles", type=Path, help="folder of scene bundles")
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--per-scene", type=int, default=24)
    options = parser.parse_args()
    bundles = [SceneBundle(options.bundles / f"{scene}.npz") for scene in options.scenes]
    pairs = select_pairs(bundles, options.per_scene)
    calibration = fit_calibration(*gather(options.model, pairs[::2]))
    logits, truth = gather(options.model, pairs[1::2])
    error = expected_calibration_error(calibration.probabilities(logits).astype(float), truth)
    print(f"{calibration.scale:.4f} {calibration.offset:.4f}")
    print(f"expected calibration error on {len(pairs[1::2])} other pairs: {error:.4f}")


if __name__ == "__main__":
    main()
