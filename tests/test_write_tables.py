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
        for method in ("NN + MAGSAC 0.5 px", "mutual + PoseLib 0.75 px", "product")
        for scene in ("hall", "all", "pairs")
    ],
    "difficulty": [
        {
            "property": "baseline angle",
            "groups": [
                {
                    "group": "below 5°",
                    "pairs": 2,
                    "methods": {
                        "NN + MAGSAC 0.5 px": {"mAP@5": 10.0, "mAP@20": 20.0},
                        "mutual + PoseLib 0.75 px": {"mAP@5": 30.0, "mAP@20": 40.0},
                        "product": {"mAP@5": 50.0, "mAP@20": 60.0},
                    },
                }
            ],
        }
    ],
    "versions": {"opencv-contrib-python-headless": "5.0.0"},
    "machine": {"processor": "Abacus"},
    "time_matched": [],
    "settings": {"seeds": 3},
    "timing": {"machine": "Abacus", "others_load": 0.0},
}


def test_rows_of_equal_time_are_explained():
    script = load_export_module("write_tables")
    assert "as much time as the filter" not in script.scoreboard(SUMMARY)
    matched = script.scoreboard({**SUMMARY, "time_matched": [{"method": "x"}]})
    assert "as much time as the filter" in matched
    assert "`python -m mgca_filter.evaluation BUNDLES --seeds 3 --times 2 --time-matched product`" in matched


def test_seeds_are_told():
    script = load_export_module("write_tables")
    assert "averaged over 3 seeds" in script.scoreboard(SUMMARY)
    once = script.scoreboard({**SUMMARY, "settings": {"seeds": 1}})
    assert "run once" in once
    assert "--seeds 1 " in once


def test_the_filter_stands_beside_the_strongest_rivals_by_scene_and_difficulty():
    script = load_export_module("write_tables")
    rows = [dict(row, **{"mAP@20": 62.0}) if "PoseLib" in row["method"] else row for row in SUMMARY["rows"]]
    header, _, *lines = script.difficulty({**SUMMARY, "rows": rows}).splitlines()
    assert header.endswith("| mAP@20, NN + MAGSAC 0.5 px | mAP@20, mutual + PoseLib 0.75 px |")
    assert lines == [
        "| scene `hall` | 3 | 50.0 | 61.3 | 61.3 | 62.0 |",
        "| baseline angle below 5° | 2 | 50.0 | 60.0 | 20.0 | 40.0 |",
    ]


def test_tables_and_figures_are_written(tmp_path: Path):
    pytest.importorskip("matplotlib")
    script = load_export_module("write_tables")
    (tmp_path / "mgca_filter" / "models").mkdir(parents=True)
    board = "above\n<!-- scoreboard -->\nstale table\n<!-- /scoreboard -->\nbelow\n"
    (tmp_path / script.README).write_text(board)
    (tmp_path / script.MODEL_CARD).write_text(f"<!-- difficulty -->\nstale figures\n<!-- /difficulty -->\n{board}")
    (tmp_path / "board.json").write_text(json.dumps(SUMMARY))
    script.main([str(tmp_path / "board.json"), "--root", str(tmp_path)])
    card = (tmp_path / script.MODEL_CARD).read_text()
    assert "| baseline angle below 5° | 2 | 50.0 | 60.0 | 20.0 |\n<!-- /difficulty -->" in card
    assert "stale figures" not in card
    for text in ((tmp_path / script.README).read_text(), card):
        assert "above\n<!-- scoreboard -->\n" in text
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
