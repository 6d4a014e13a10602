"""Platt scaling: what it recovers, what it refuses, and how its error is measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from mgca_filter.export import calibration_fit
from mgca_filter.export.calibration_fit import calibrate, expected_calibration_error, fit_calibration
from mgca_filter.inference.calibration import sigmoid


def test_scale_and_offset_are_found_again() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, 200_000)
    truth = rng.random(len(logits)) < sigmoid(0.6 * logits - 0.8)
    calibration = fit_calibration(logits, truth)
    assert calibration.scale == pytest.approx(0.6, abs=0.02)
    assert calibration.offset == pytest.approx(-0.8, abs=0.02)
    probabilities = calibration.probabilities(logits).astype(float)
    assert expected_calibration_error(probabilities, truth) < 0.01
    assert expected_calibration_error(sigmoid(logits), truth) > 0.05


@pytest.mark.parametrize("truth", [np.ones(9, dtype=bool), np.zeros(9, dtype=bool)])
def test_matches_of_one_kind_say_nothing(truth: np.ndarray) -> None:
    with pytest.raises(ValueError, match="inliers and outliers"):
        fit_calibration(np.linspace(-1, 1, 9), truth)


def test_the_error_is_the_gap_between_probability_and_frequency() -> None:
    truth = np.arange(100) < 30
    assert expected_calibration_error(np.full(100, 0.3), truth) == pytest.approx(0.0)
    assert expected_calibration_error(np.full(100, 0.8), truth) == pytest.approx(0.5)
    assert expected_calibration_error(np.zeros(0), np.zeros(0, dtype=bool)) == 0.0


def test_the_command_fits_on_even_pairs_and_checks_on_odd_ones(
    model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed, name in enumerate(("hall", "yard")):
        write_bundle(tmp_path / f"{name}.npz", [make_scene(seed=10 * seed + i) for i in range(6)])
    seen = []
    collect = calibration_fit.collect_logits
    monkeypatch.setattr(
        calibration_fit, "collect_logits", lambda model, pairs: seen.append(len(pairs)) or collect(model, pairs)
    )
    calibration_fit.main([str(model_file), str(tmp_path), "hall", "yard", "--per-scene", "3"])
    shown = capsys.readouterr().out.splitlines()
    assert seen == [3, 3]
    calibration, error = calibrate(model_file, tmp_path, ["hall", "yard"], 3)
    assert shown[0] == f"{calibration.scale:.4f} {calibration.offset:.4f}"
    assert shown[1].endswith(f"{error:.4f}")
    assert calibration.scale > 0
    assert 0 < error < 0.3
