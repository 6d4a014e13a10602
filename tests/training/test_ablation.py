"""The ablation: equal budgets, rows that differ in what their names say, and no row done twice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from conftest import make_scene
from networks import TINY
from scene_bundles import write_bundle
from tiny_config import CONFIG_TOML

from mgca_filter.network import NetworkConfig
from mgca_filter.training import ablation, run_directory
from mgca_filter.training.ablation import ROWS, Row, row_phases
from mgca_filter.training.config import ScheduleConfig, SourceConfig, TrainingConfig, load_config

BASE = TrainingConfig(name="x", schedule=ScheduleConfig(steps=7000, warmup_steps=200))


def network(name: str) -> NetworkConfig:
    (row,) = (row for row in ROWS if row.name == name)
    return row_phases(row, BASE, 100, 0, "r.npz")[-1].network


def test_every_row_has_the_same_budget():
    for row in ROWS:
        phases = row_phases(row, BASE, 100, 4, "r.npz")
        assert sum(phase.schedule.steps for phase in phases) == 100
        assert all(phase.schedule.warmup_steps <= phase.schedule.steps // 10 for phase in phases)
        assert {phase.seed for phase in phases} == {4}
    assert len({row.slug for row in ROWS}) == len(ROWS)


def test_rows_are_what_their_names_say():
    full = BASE.network
    assert network("full") == full
    baseline = network("baseline")
    assert (baseline.stages, baseline.cga, baseline.csmgc, baseline.final_consensus) == (1, False, False, False)
    assert (network("CGA").stages, network("CGA").cga) == (1, True)
    assert (network("iterations").stages, network("iterations").cga, network("iterations").csmgc) == (
        full.stages,
        False,
        False,
    )
    assert (network("iterations + CGA").cga, network("iterations + CGA").csmgc) == (True, False)
    assert (network("iterations + CSMGC").cga, network("iterations + CSMGC").csmgc) == (False, True)
    changed = {row.name: [k for k, v in vars(network(row.name)).items() if v != vars(full)[k]] for row in ROWS[6:]}
    assert all(len(keys) == 1 for name, keys in changed.items() if "rendered" not in name and "synthetic" not in name)
    assert len({tuple(keys) + (network(name).neighbours,) for name, keys in changed.items()}) == len(changed) - 1


def test_other_data_comes_in_by_its_share():
    (rendered,) = row_phases(Row("r", rendered=True), BASE, 100, 0, "r.npz")
    assert rendered.sources[-1].path == "r.npz"
    assert rendered.sources[-1].weight / sum(source.weight for source in rendered.sources) == pytest.approx(0.25)
    first, second = row_phases(Row("p", pretrained=True), BASE, 100, 0, "")
    assert first.sources == (SourceConfig("synthetic"),)
    assert (first.schedule.steps, second.schedule.steps) == (25, 75)
    assert second.sources == BASE.sources


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(run_directory, "draw_curves", lambda *arguments: None)
    data = tmp_path / "data"
    data.mkdir()
    for seed, name in enumerate(("hall", "yard")):
        write_bundle(data / f"{name}.npz", [make_scene(seed=seed, right=60, wrong=40)])
    (tmp_path / "run.toml").write_text(CONFIG_TOML)
    places = [("--config", "run.toml"), ("--data", "data"), ("--out", "out")]
    paths = [item for name, place in places for item in (name, str(tmp_path / place))]
    return [*paths, "--steps", "2", "--workers", "0", "--device", "cpu"]


@pytest.mark.slow
def test_the_command_writes_a_table_and_does_no_row_twice(command, tmp_path, monkeypatch):
    rows = ["--rows", "baseline", "synthetic pre-training"]
    assert load_config(tmp_path / "run.toml").network == TINY
    assert ablation.main([*command, *rows[:2], "--seeds", "1", "2"]) == 0
    assert ablation.main([*command, *rows, "--seeds", "1", "2"]) == 0
    table = json.loads((tmp_path / "out" / "ablation.json").read_text())
    assert [row["row"] for row in table["rows"]] == rows[1:]
    assert table["budget"] == {"steps": 2, "samples": 4, "seeds": [1, 2], "validation_pairs": 1}
    assert "| baseline | " in (tmp_path / "out" / "ablation.md").read_text()
    first = tmp_path / "out" / "synthetic_pre_training" / "1"
    start = torch.load(first / "0" / "checkpoint.pt", weights_only=True)["average"]
    end = torch.load(first / "1" / "checkpoint.pt", weights_only=True)["network"]
    assert list(start) == list(end)
    monkeypatch.setattr(ablation, "Trainer", None)  # whoever trains now fails
    assert ablation.main([*command, *rows, "--seeds", "1", "2"]) == 0
    assert ablation.main([*command, *rows, "--seeds", "1", "2", "--steps", "3"]) == 2


def test_what_is_missing_is_named_before_anything_trains(command, tmp_path, capsys):
    assert ablation.main([*command, "--rows", "full", "rendered worlds"]) == 2
    assert "--rendered" in capsys.readouterr().err
    assert ablation.main([*command, "--rows", "rendered worlds", "--rendered", "none.npz"]) == 2
    assert "none.npz" in capsys.readouterr().err
    text = CONFIG_TOML.replace('tuning_scenes = ["yard"]', "")
    (tmp_path / "run.toml").write_text(text)
    assert ablation.main([*command, "--rows", "full"]) == 2
    assert "--validation" in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*/*"))
