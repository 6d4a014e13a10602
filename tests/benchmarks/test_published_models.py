"""The study of the published models, on a tiny bundle."""

from __future__ import annotations

from conftest import make_scene
from scene_bundles import write_bundle

import mgca_filter
from benchmarks import published_models


def test_a_candidate_that_is_the_default_differs_in_nothing(tmp_path, capsys):
    write_bundle(tmp_path / "facade.npz", [make_scene(right=60, wrong=240, seed=seed) for seed in range(3)])
    words = [str(tmp_path), "--kinds", "raw", "--scenes", "facade"]
    assert published_models.main([*words, "--candidate", str(mgca_filter.model_path())]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert [line.split("|")[3].strip() for line in shown] == ["lists", "---:", "3", "3"]
    assert all(line.count("+0.0 [+0.0, +0.0]") == 2 for line in shown[2:])
    assert published_models.main([*words, "--candidate", "other.onnx", "--fill"]) == 2
    assert "--fill" in capsys.readouterr().err


def test_either_network_alone_is_compared_with_both(tmp_path, capsys):
    write_bundle(tmp_path / "facade.npz", [make_scene(right=60, wrong=240, seed=seed) for seed in range(2)])
    assert published_models.main([str(tmp_path), "--kinds", "raw"]) == 0
    lists, alone, times = capsys.readouterr().out.split("\n\n")
    assert "| default | mgca_fast alone |" in lists
    assert alone.splitlines()[2].startswith("| mgca_small alone | ")
    assert "| mgca_small, ms | mgca_fast, ms |" in times
