"""The release script: tables between the markers, figures in docs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from export_tools import load_export_module

ROWS = {"mAP@5": 50.0, "mAP@20": 61.3, "AUC@5": 30.0, "AUC@10": 40.0, "AUC@20": 50.0, "P": 12.0, "R": 90.0, "F": 20.0}
SUMMARY = {
    "rows": [
        {"method": method, "scene": scene, "pairs": 3, **ROWS, "median_ms": 7.0, "timed_pairs": 2}
        for method in ("NN + MAGSAC 0.5 px", "product")
        for scene in ("hall", "all", "pairs")
    ],
    "versions": {"opencv-contrib-python-headless": "5.0.0"},
    "machine": {"processor": "Abacus"},
    "time_matched": [],
    "settings": {"seeds": 3},
    "timing": {"machine": "Abacus", "others_load": 0.0},
}


def test_rows_of_equal_time_are_explained():
    script = load_export_module("write_tables")
    assert "as much time as the filter" not in script.section(SUMMARY)
    matched = script.section({**SUMMARY, "time_matched": [{"method": "x"}]})
    assert "as much time as the filter" in matched
    assert "`python -m mgca_filter.evaluation BUNDLES --seeds 3 --times 2 --time-matched product`" in matched


def test_seeds_are_told():
    script = load_export_module("write_tables")
    assert "averaged over 3 seeds" in script.section(SUMMARY)
    once = script.section({**SUMMARY, "settings": {"seeds": 1}})
    assert "run once" in once
    assert "--seeds 1 " in once


def test_tables_and_figures_are_written(tmp_path: Path):
    pytest.importorskip("matplotlib")
    script = load_export_module("write_tables")
    (tmp_path / "mgca_filter" / "models").mkdir(parents=True)
    for name in script.FILES:
        (tmp_path / name).write_text("above\n<!-- scoreboard -->\nstale table\n<!-- /scoreboard -->\nbelow\n")
    (tmp_path / "board.json").write_text(json.dumps(SUMMARY))
    script.main([str(tmp_path / "board.json"), "--root", str(tmp_path)])
    for name in script.FILES:
        text = (tmp_path / name).read_text()
        assert text.startswith("above\n")
        assert text.endswith("below\n")
        assert "stale table" not in text
        assert "| **mgca_filter**, default options | 50.0 | 61.3 |" in text
        assert "all 3 pairs of 1 scenes" in text
        assert "median over 2 pairs" in text
        assert "times are rough" not in text
    assert (tmp_path / script.FIGURES / "time_accuracy.svg").exists()
    assert (tmp_path / script.FIGURES / "courtyard_0.jpg").exists()
    (tmp_path / "README.md").write_text("no markers")
    with pytest.raises(SystemExit, match=r"README\.md: no scoreboard markers"):
        script.main([str(tmp_path / "board.json"), "--root", str(tmp_path)])
