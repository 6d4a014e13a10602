"""The page command: tables between the markers, figures in docs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from benchmarks.fill_docs import readme_plot, scoreboard
from mgca_filter.evaluation.difficulty import DifficultyGroup, DifficultyTable
from mgca_filter.evaluation.pairs import ALL_PAIRS, ALL_SCENES
from mgca_filter.evaluation.summary import Context, Decision, Summary, SummaryRow, TimingConditions
from mgca_filter.evaluation.timing import TimeMatch

FIGURES = {"mAP@5": 50.0, "mAP@10": 55.0, "mAP@15": 58.0, "mAP@20": 61.3, "AUC@5": 30.0, "AUC@10": 40.0, "AUC@20": 50.0}
BASELINES = ("NN + MAGSAC 0.5 px", "mutual + PoseLib 0.75 px")
KEPT = Decision(12.0, 90.0, 20.0)
SUMMARY = Summary(
    rows=[
        SummaryRow(method, scene, 3, FIGURES, 5.0, KEPT, KEPT, 5.0, 5.0, 0.0, 0.0, median_ms=7.0, timed_pairs=2)
        for method in (*BASELINES, "product")
        for scene in ("hall", "all", "pairs")
    ],
    differences=[],
    failures={},
    unreadable=[],
    difficulty=[
        DifficultyTable(
            "baseline angle",
            [
                DifficultyGroup(
                    "below 5°",
                    2,
                    {
                        BASELINES[0]: {"mAP@5": 10.0, "mAP@20": 20.0},
                        BASELINES[1]: {"mAP@5": 30.0, "mAP@20": 40.0},
                        "product": {"mAP@5": 50.0, "mAP@20": 60.0},
                    },
                )
            ],
        )
    ],
    curves=None,
    timing=TimingConditions("Abacus", 0.0),
    context=Context(
        versions={"opencv-contrib-python-headless": "5.0.0"}, machine={"processor": "Abacus"}, settings={"seeds": 3}
    ),
)


def test_rows_of_equal_time_are_explained():
    assert "as much time as the filter" not in scoreboard.scoreboard(SUMMARY)
    context = replace(SUMMARY.context, time_matched=(TimeMatch("x", 700, "product", 1.0),))
    matched = scoreboard.scoreboard(replace(SUMMARY, context=context))
    assert "as much time as the filter" in matched
    assert "`python -m mgca_filter.evaluation BUNDLES --seeds 3 --times 2 --time-matched product`" in matched


def test_seeds_are_told():
    assert "averaged over 3 seeds" in scoreboard.scoreboard(SUMMARY)
    once = scoreboard.scoreboard(replace(SUMMARY, context=replace(SUMMARY.context, settings={"seeds": 1})))
    assert "run once" in once
    assert "--seeds 1 " in once


def test_what_the_page_needs_is_asked_for():
    with pytest.raises(ValueError, match="times"):
        scoreboard.scoreboard(replace(SUMMARY, timing=None))


def test_the_filter_stands_beside_the_strongest_baselines_by_scene_and_difficulty():
    rows = [replace(row, pose={**FIGURES, "mAP@20": 62.0}) if "PoseLib" in row.method else row for row in SUMMARY.rows]
    header, _, *lines = scoreboard.difficulty(replace(SUMMARY, rows=rows)).splitlines()
    assert header.endswith("| mAP@20, NN + MAGSAC 0.5 px | mAP@20, mutual + PoseLib 0.75 px |")
    assert lines == [
        "| scene `hall` | 3 | 50.0 | 61.3 | 61.3 | 62.0 |",
        "| baseline angle below 5° | 2 | 50.0 | 60.0 | 20.0 | 40.0 |",
    ]


@pytest.mark.slow
def test_tables_and_figures_are_written(tmp_path: Path):
    pytest.importorskip("matplotlib")
    (tmp_path / "mgca_filter" / "models").mkdir(parents=True)
    (tmp_path / "docs" / "reference").mkdir(parents=True)
    board = "above\n<!-- scoreboard -->\nstale table\n<!-- /scoreboard -->\nbelow\n"
    short = board.replace("scoreboard", "results")
    (tmp_path / scoreboard.PAGE).write_text(board)
    (tmp_path / scoreboard.README).write_text(short)
    (tmp_path / scoreboard.MODEL_CARD).write_text(f"<!-- difficulty -->\nstale figures\n<!-- /difficulty -->\n{short}")
    (tmp_path / "board.json").write_text(json.dumps(SUMMARY.to_json()))
    scoreboard.main([str(tmp_path / "board.json"), "--root", str(tmp_path)])
    card = (tmp_path / scoreboard.MODEL_CARD).read_text()
    assert "| baseline angle below 5° | 2 | 50.0 | 60.0 | 20.0 |\n<!-- /difficulty -->" in card
    assert "stale figures" not in card
    page = (tmp_path / scoreboard.PAGE).read_text()
    for text in ((tmp_path / scoreboard.README).read_text(), card, page):
        assert text.endswith("below\n")
        assert "stale table" not in text
        assert "| **mgca_filter**, default options | 50.0 |" in text
    assert "above\n<!-- scoreboard -->\n" in page
    assert "all 3 pairs of 1 scenes" in page
    assert "median over 2 pairs" in page
    assert "times are rough" not in page
    assert "3 pairs of 1 scenes" in card
    assert cv2.imread(str(tmp_path / readme_plot.PLOT)) is not None
    assert (tmp_path / scoreboard.FIGURES / "time_accuracy.svg").exists()
    assert (tmp_path / scoreboard.FIGURES / "courtyard_0.jpg").exists()
    (tmp_path / "other.json").write_text("[]")
    with pytest.raises(SystemExit, match=r"other\.json"):
        scoreboard.main([str(tmp_path / "other.json"), "--root", str(tmp_path)])
    (tmp_path / "README.md").write_text("no markers")
    with pytest.raises(SystemExit, match=r"README\.md: no results markers"):
        scoreboard.main([str(tmp_path / "board.json"), "--root", str(tmp_path)])


def test_the_best_of_each_kind_stands_for_it():
    methods = ("mutual + ratio 0.8 + MAGSAC 0.25 px", "mutual + ratio 0.9 + MAGSAC 0.5 px 16000 iterations", "product")
    figures = zip((*methods, "mutual + ratio 0.7 + MAGSAC 0.25 px"), (70.0, 99.0, 90.0, 60.0))
    rows = [
        replace(SUMMARY.rows[0], method=method, scene=scene, pose={**FIGURES, "mAP@20": figure}, median_ms=9.6)
        for method, figure in figures
        for scene in (ALL_SCENES, ALL_PAIRS)
    ]
    summary = replace(SUMMARY, rows=rows)
    chosen = readme_plot.chosen_rows(summary)
    assert {label: row.method for label, row in chosen.items()} == {
        "mutual + ratio test + MAGSAC": methods[0],
        "mgca_filter": "product",
    }
    assert "| **mgca_filter**, default options | 50.0 | 30.0 | 50.0 | 10 |" in readme_plot.results_table(summary)
