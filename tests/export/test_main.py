"""``python -m mgca_filter.export``: both model files, their checksums, and the check of one against the other."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import pytest
from conftest import make_scene
from networks import settled_network
from scene_bundles import write_bundle

from mgca_filter import model_path
from mgca_filter.export import __main__ as export_main
from mgca_filter.export import parity
from mgca_filter.export.onnx_export import ModelDescription
from mgca_filter.inference.calibration import Calibration
from mgca_filter.inference.model_file import SUMS_NAME, ModelFile, read_checksums
from mgca_filter.network import MGCANet, NetworkConfig, save_network

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    save_network(settled_network(NetworkConfig(channels=8, clusters=4, stages=1)), path)
    return path


@pytest.mark.slow
def test_files_are_written_listed_and_compared(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / SUMS_NAME).write_text("")
    bundles = tmp_path / "bundles"
    bundles.mkdir()
    for seed, name in enumerate(("hall", "yard")):
        write_bundle(bundles / f"{name}.npz", [make_scene(seed=10 * seed + i) for i in range(4)])
    config = tmp_path / "config.toml"
    config.write_text('name = "tiny"\ntuning_scenes = ["hall", "yard"]\n')
    arguments = [str(weights), "--name", "tiny", "--folder", str(tmp_path), "--training-data", "none"]
    assert export_main.main([*arguments, "--calibrate", str(bundles), "--config", str(config)]) == 0
    shown = capsys.readouterr().out
    assert "of 2 tuning scenes" in shown
    assert shown.count("| ok |") == len(parity.COUNTS)
    assert set(read_checksums(tmp_path)) == {"tiny.onnx", "tiny.safetensors"}
    one, other = (ModelFile.read(tmp_path / f"tiny.{suffix}").properties for suffix in ("onnx", "safetensors"))
    assert one == other
    assert (one["name"], one["training_data"]) == ("tiny", "none")
    calibration = json.loads(one["calibration"])
    assert f"calibration {calibration['scale']} {calibration['offset']}, " in shown
    assert calibration != {"scale": 1.0, "offset": 0.0}


@pytest.mark.slow
def test_files_that_disagree_end_in_failure(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    described = []

    def shipped_files(network: MGCANet, folder: Path, description: ModelDescription) -> tuple[Path, Path]:
        described.append(description)
        return model_path(), model_path().with_suffix(".safetensors")

    monkeypatch.setattr(export_main, "export_model", shipped_files)
    monkeypatch.setattr(parity, "QUANTILE_TOLERANCE", -1.0)
    assert export_main.main([str(weights), "--folder", str(tmp_path), "--calibration", "2", "-1"]) == 1
    assert "FAILED" in capsys.readouterr().out
    assert [description.calibration for description in described] == [Calibration(2.0, -1.0)]
    assert not (tmp_path / SUMS_NAME).exists()


@pytest.mark.parametrize(
    ("script", "option"),
    [("export_model.py", "--calibrate"), ("calibrate.py", "--per-scene"), ("parity.py", "--bundles")],
)
def test_the_scripts_of_the_repository_run_the_same_commands(
    script: str, option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "export" / script), run_name="__main__")
    assert stopped.value.code == 0
    assert option in capsys.readouterr().out
