"""Fit the calibration of a model on scene bundles: ``python export/calibrate.py MODEL.onnx BUNDLES SCENE …``.

Fits on the even pairs of the scenes named, checks on the odd ones, and prints what ``export_model.py
--calibration`` takes; ``export_model.py --calibrate`` does both at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.evaluation.methods import BoolArray, FloatArray
from mgca_filter.export.calibration_fit import collect_logits, expected_calibration_error, fit_calibration
from mgca_filter.inference.calibration import Calibration
from mgca_filter.training.validation import select_pairs

PAIRS_PER_SCENE = 24


def calibrate(
    model: Path, bundles: Path, scenes: Iterable[str], pairs_per_scene: int = PAIRS_PER_SCENE
) -> tuple[Calibration, float]:
    """Calibration of a model file on scenes of a folder, and its expected error on as many other pairs of them."""
    pairs = select_pairs([SceneBundle(bundles / f"{scene}.npz") for scene in scenes], pairs_per_scene)
    calibration = fit_calibration(*_gather(model, pairs[::2]))
    logits, truth = _gather(model, pairs[1::2])
    return calibration, expected_calibration_error(calibration.probabilities(logits).astype(float), truth)


def _gather(model: Path, pairs: list[ScenePair]) -> tuple[FloatArray, BoolArray]:
    """Logits and truth of all matches of all pairs."""
    logits, truth = collect_logits(model, pairs)
    return np.concatenate(logits), np.concatenate(truth)


def main() -> None:
    """Print scale, offset and the calibration error on pairs that the fit did not see."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("bundles", type=Path, help="folder of scene bundles")
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--per-scene", type=int, default=PAIRS_PER_SCENE)
    options = parser.parse_args()
    calibration, error = calibrate(options.model, options.bundles, options.scenes, options.per_scene)
    print(f"{calibration.scale:.4f} {calibration.offset:.4f}")
    print(f"expected calibration error on other pairs of these scenes: {error:.4f}")


if __name__ == "__main__":
    main()
