"""From outcomes to curves, tables and pictures; the paper's tables beside ours."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import SIZE, make_scene
from scene_bundles import write_bundle

from mgca_filter.evaluation.__main__ import main
from mgca_filter.evaluation.figures import draw_figures, draw_pairs
from mgca_filter.evaluation.methods import UNREADABLE, PairOutcome
from mgca_filter.evaluation.metrics import LOGIT_EDGES, count_scores, precision_recall_curve, reliability
from mgca_filter.evaluation.pairs import sample_pairs, select_pairs
from mgca_filter.evaluation.paper import format_paper, load_paper
from mgca_filter.evaluation.paper import main as paper_main
from mgca_filter.evaluation.predict import predict
from mgca_filter.evaluation.registry import BASELINE_ROWS, PRODUCT_ROWS, parse_method
from mgca_filter.evaluation.report import format_report
from mgca_filter.evaluation.store import ResultKey, ResultStore
from mgca_filter.evaluation.summarize import precision_recall_curves, recall_curves, reliability_tables, summarize
from mgca_filter.evaluation.summary import (
    Context,
    NotInstalled,
    Summary,
    UnreadablePair,
    best_baseline,
    is_ours,
)
from mgca_filter.evaluation.timing import TimeMatch, Timing

LOGITS = np.array([-11.0, -1.0, 0.0, 1.0, 2.0, 3.0])
TRUTH = np.array([False, False, True, True, False, True])
PROBABILITIES = np.array([0.0, 0.05, 0.5, 0.7, 0.9, 1.0])


def outcome(pair: int, error_deg: float, **fields: Any) -> PairOutcome:
    posed = error_deg < 180
    values = {"kept": (0.5, 0.5, 0.5), "mask": (0.25, 0.25, 0.25)}
    rotation = {"rotation_deg": error_deg / 2 if posed else None, "translation_deg": error_deg if posed else None}
    return PairOutcome(pair, error_deg, **{**rotation, **values, **fields})


def scored(pair: int, error_deg: float, paper: tuple[float, float, float]) -> PairOutcome:
    return outcome(pair, error_deg, paper=paper, counts=count_scores(LOGITS, PROBABILITIES, TRUTH))


def small_summary(**context: Any) -> Summary:
    ours = [scored(0, 1.0, (0.8, 0.4, 0.5)), scored(1, 7.0, (0.0, 0.0, 0.0))]
    broken = outcome(1, 180.0, kept=(0, 0, 0), mask=(0, 0, 0), failure=f"{UNREADABLE}x: image missing")
    results = {
        "product": {"hall": [[*ours, scored(2, 3.0, (0.6, 0.2, 0.3))]]},
        "baseline": {"hall": [[outcome(0, 2.0), broken, outcome(2, 30.0)]]},
    }
    timing = Timing({"product": {"hall": [10.0, 20.0]}, "baseline": {"hall": [5.0, 7.0]}}, "Abacus", 0.0)
    return summarize(results, Context(commit="abc", **context), timing, replicates=10)


# Counts and curves


def test_counts_stand_by_logit_and_by_probability():
    counts = count_scores(LOGITS, PROBABILITIES, TRUTH)
    assert sum(counts.right) == 3
    assert sum(counts.wrong) == 3
    assert counts.wrong[0] == 1  # below the first threshold
    assert sum(counts.bin_count) == 6
    assert (counts.bin_count[-1], counts.bin_right[-1], counts.bin_sum[-1]) == (1, 1, 1.0)
    assert (counts.bin_count[0], counts.bin_right[0], counts.bin_sum[0]) == (2, 0, 0.05)


def test_curve_by_hand():
    precision, recall = precision_recall_curve([count_scores(LOGITS, PROBABILITIES, TRUTH)] * 2)
    at = {edge: (precision[i], recall[i]) for i, edge in enumerate(LOGIT_EDGES)}
    assert at[0.0] == pytest.approx((2 / 3, 2 / 3))  # the match at 0 itself is not above it
    assert at[-0.5] == pytest.approx((3 / 4, 1.0))
    assert at[2.0] == pytest.approx((1.0, 1 / 3))
    assert at[-10.0] == pytest.approx((3 / 5, 1.0))
    assert np.isnan(at[3.0][0])
    assert at[3.0][1] == 0.0


def test_reliability_by_hand():
    bins = reliability([count_scores([0, 0, 0, 0], [0.1, 0.1, 0.9, 0.9], [False, True, True, True])])
    assert [(one.probability, one.share_right, one.matches) for one in bins] == [
        (pytest.approx(0.1), 0.5, 2),
        (pytest.approx(0.9), 1.0, 2),
    ]
    counts = count_scores([0, 0, 0, 0], [0.1, 0.1, 0.9, 0.9], [False, True, True, True])
    table = reliability_tables({"ours": {"hall": [[outcome(0, 1.0, counts=counts)]]}})["ours"]
    assert table.error == pytest.approx(0.25)


def test_recall_is_a_mean_over_scenes_and_curves_need_scores():
    curves = recall_curves({"ours": {"a": np.array([[1.0, 9.0]]), "b": np.array([[3.0]])}})
    at = dict(zip(curves.error_deg, curves.methods["ours"]))
    assert (at[1.0], at[1.5], at[3.5], at[9.5], at[20.0]) == (0.0, 0.25, 0.75, 1.0, 1.0)
    assert precision_recall_curves({"baseline": {"a": [[outcome(0, 1.0)]]}}).methods == {}
    assert reliability_tables({"baseline": {"a": [[outcome(0, 1.0)]]}}) == {}


# Summary and tables


def test_the_papers_variant_stands_under_its_own_name():
    rows = {(row.method, row.scene): row for row in small_summary().rows}
    ours = rows["product", "all"]
    assert pytest.approx((70.0, 30.0, 40.0)) == (ours.paper.P, ours.paper.R, ours.paper.F)
    assert ours.paper_dropped == 1
    assert pytest.approx((50.0, 25.0)) == (ours.kept.P, ours.mask.P)
    assert [ours.to_json()[name] for name in ("paper_P", "P", "mask_P")] == pytest.approx([70.0, 50.0, 25.0])
    assert rows["baseline", "all"].paper is None
    assert "paper_P" not in rows["baseline", "all"].to_json()


def test_unreadable_pairs_are_counted_and_listed():
    summary = small_summary()
    (baseline,) = [row for row in summary.rows_of("all") if row.method == "baseline"]
    assert (baseline.unreadable, baseline.failures, baseline.pairs) == (1, 1, 3)
    assert baseline.pose["mAP@5"] == pytest.approx(100 / 3)
    assert pytest.approx(100 / 3) == baseline.kept.P
    assert baseline.median_rotation_deg == pytest.approx(15.0)
    assert baseline.median_translation_deg == pytest.approx(30.0)
    assert summary.unreadable == [UnreadablePair("hall", 1, "x: image missing")]
    assert summary.to_json()["unreadable"] == [{"scene": "hall", "pair": 1, "reason": "x: image missing"}]
    assert "1 pairs could not be read" in format_report(summary, "text")
    assert "hall, pair 1: x: image missing" in format_report(summary, "text")


def test_a_scene_without_readable_pairs_still_counts():
    broken = outcome(0, 180.0, failure=f"{UNREADABLE}x", kept=(0, 0, 0), mask=(0, 0, 0))
    ours = {"a": [[scored(0, 1.0, (0.8, 0.4, 0.5))]], "b": [[broken]]}
    summary = summarize({"product": ours}, None, Timing({"product": {"a": [8.0]}}, "Abacus", 0.0), replicates=0)
    rows = summary.rows
    for row in rows[2:]:
        assert (row.pose["mAP@5"], row.kept.P, row.failures) == pytest.approx((50.0, 25.0, 1))
        assert (row.median_ms, row.timed_pairs) == (8.0, 1)
    assert rows[2].paper.P == rows[0].paper.P == pytest.approx(80.0)
    assert rows[1].median_ms is None
    assert "median_ms" not in rows[1].to_json()
    assert Summary.from_json(json.loads(json.dumps(summary.to_json(), allow_nan=False))) == summary


def test_a_summary_is_what_its_file_says(tmp_path: Path):
    matched, lacking = TimeMatch("x", 700, "product", 0.8), NotInstalled("NN + DEGENSAC 1 px", "no pydegensac")
    summary = small_summary(seed=3, settings={"seeds": 2}, time_matched=(matched,), not_installed=(lacking,))
    content = json.loads(json.dumps(summary.to_json()))
    (tmp_path / "board.json").write_text(json.dumps(content))
    assert Summary.read(tmp_path / "board.json") == summary
    assert (content["seed"], content["commit"], content["settings"]) == (3, "abc", {"seeds": 2})
    assert content["time_matched"] == [{"method": "x", "iterations": 700, "like": "product", "share": 0.8}]
    assert content["timing"] == {"machine": "Abacus", "others_load": 0.0}
    del content["rows"][0]["AUC@5"]
    (tmp_path / "board.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"board\.json.*AUC@5"):
        Summary.read(tmp_path / "board.json")


def test_the_published_scoreboard_can_be_read():
    path = Path(__file__).parents[2] / "docs" / "scoreboard.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    summary = Summary.read(path)
    assert json.loads(json.dumps(summary.to_json())) == content
    assert (len(summary.scenes), summary.timed_pairs) == (11, 33)


def test_outcomes_survive_the_store(tmp_path: Path):
    key = ResultKey("product", "hall", 0, "00", {})
    outcomes = [scored(0, 1.0, (0.5, 0.5, 0.5)), outcome(1, 180.0)]
    ResultStore(tmp_path).add(key, outcomes)
    assert list(ResultStore(tmp_path).load(key).values()) == outcomes
    (path,) = tmp_path.glob("hall/*.json")
    content = json.loads(path.read_text())
    for row in content["outcomes"]:
        del row["paper"], row["counts"]
        row["elapsed_ms"] = 5.0
    path.write_text(json.dumps(content))
    assert ResultStore(tmp_path).load(key)[1] == outcomes[1]
    assert ResultStore(tmp_path).load(key)[0].counts is None


def test_settings_are_printed_with_the_table():
    settings = {"methods": {"baseline": {"estimator": {"kind": "MAGSAC", "max_iterations": 5000}}}}
    matched = TimeMatch("x", 700, "product", 0.8)
    lacking = NotInstalled("NN + DEGENSAC 1 px", "No module named 'pydegensac'")
    text = format_report(small_summary(settings=settings, time_matched=(matched,), not_installed=(lacking,)), "text")
    assert "estimator: kind MAGSAC, max_iterations 5000" in text
    assert "x: takes 0.80 times as long as product in the median" in text
    assert "NN + DEGENSAC 1 px  not installed" in text


def test_latex_escapes_and_balances():
    text = format_report(small_summary(), "latex")
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 9
    assert r"median\_ms" in text
    assert r"95 \%" in text
    for line in text.splitlines():
        assert line.count("&") - line.count(r"\&") in (0, *range(1, 20))
        assert "_" not in line.replace(r"\_", "")
        assert "%" not in line.replace(r"\%", "")


# Pictures


def test_figures_are_written_from_the_summary_alone(tmp_path: Path):
    pytest.importorskip("matplotlib")
    summary = Summary.from_json(json.loads(json.dumps(small_summary().to_json())))
    files = draw_figures(summary, tmp_path / "new", prefix="val_")
    names = ["val_recall.svg", "val_precision_recall.svg", "val_reliability.svg", "val_time_accuracy.svg"]
    assert [file.name for file in files] == names
    for file in files:
        assert "product" in file.read_text()
    assert "baseline" in files[0].read_text()
    before = [file.read_bytes() for file in files]
    assert [file.read_bytes() for file in draw_figures(summary, tmp_path / "new", prefix="val_")] == before


def test_figures_need_what_they_show(tmp_path: Path):
    pytest.importorskip("matplotlib")
    content = small_summary().to_json()
    del content["curves"]
    assert [file.name for file in draw_figures(Summary.from_json(content), tmp_path)] == ["time_accuracy.svg"]
    for row in content["rows"]:
        row.pop("median_ms", None)
    assert draw_figures(Summary.from_json(content), tmp_path) == []


def test_our_rows_are_known_by_name():
    assert all(is_ours(name) for name in PRODUCT_ROWS)
    assert not any(is_ours(name) for name in BASELINE_ROWS)


def test_the_best_baseline_is_pictured_beside_the_reference():
    rows = small_summary().rows
    assert best_baseline(rows, "product") == "baseline"
    assert best_baseline(rows, "baseline") == "product"  # ours where there is nothing else
    assert best_baseline([row for row in rows if row.method == "product"], "product") == "product"


def test_pictures_of_pairs_show_right_and_wrong(tmp_path: Path):
    path = write_bundle(tmp_path / "hall.npz", [make_scene(seed=seed) for seed in range(3)])
    (tmp_path / "photos").mkdir()
    for i in range(6):
        cv2.imwrite(str(tmp_path / "photos" / f"{i:03d}.jpg"), np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    methods = [parse_method("NN + MAGSAC 1 px"), parse_method("ratio 0.5 + MAGSAC 1 px")]
    assert draw_pairs(methods, select_pairs(path), tmp_path / "none", 1) == []
    selections = select_pairs(path, images=tmp_path / "photos")
    (file,) = draw_pairs(methods, selections, tmp_path / "out", 1)
    assert file.name == "hall_1.jpg"
    picture = cv2.imread(str(file))
    both = cv2.imread(str(draw_pairs(methods[:1], selections, tmp_path / "one", 1)[0]))
    assert picture.shape[0] == 2 * both.shape[0]
    assert len(draw_pairs(methods[:1], selections, tmp_path / "all", 3)) == 3


def test_command_writes_latex_figures_and_pictures(tmp_path: Path, model_file: Path):
    pytest.importorskip("matplotlib")
    path = write_bundle(tmp_path / "hall.npz", [make_scene()])
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"{i:03d}.jpg"), np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    arguments = [str(path), "--methods", "NN + MAGSAC 1 px", "product", "--model", str(model_file), "-q"]
    arguments += ["--bootstrap", "0", "--images", str(tmp_path), "--pictures", "1"]
    outputs = ["--latex", str(tmp_path / "out.tex"), "--figures", str(tmp_path / "figures")]
    assert main(arguments + outputs) == 0
    assert r"\toprule" in (tmp_path / "out.tex").read_text()
    written = sorted(file.name for file in (tmp_path / "figures").iterdir())
    assert written == ["hall_0.jpg", "precision_recall.svg", "recall.svg", "reliability.svg", "time_accuracy.svg"]


def test_sampled_pairs_come_from_all_scenes(tmp_path: Path):
    for name, count in (("hall", 5), ("yard", 2)):
        write_bundle(tmp_path / f"{name}.npz", [make_scene(seed=seed, right=40, wrong=20) for seed in range(count)])
    selections = select_pairs(tmp_path)
    assert [pair.name for pair in sample_pairs(selections, 2)] == ["hall/0", "hall/4", "yard/0", "yard/1"]
    assert len(sample_pairs(selections, 100)) == 7


def test_predictions_hold_what_the_curves_need(tmp_path: Path, model_file: Path):
    path = write_bundle(tmp_path / "hall.npz", [make_scene()])
    method = parse_method("network RANSAC", str(model_file))  # which never ends before the network
    (one,) = predict([method], select_pairs(path))["network RANSAC"]["hall"][0]
    assert sum(one.counts.right) + sum(one.counts.wrong) == 200
    assert one.paper is not None
    # logit = 8 (0.8 - ratio) > 2 means a ratio below 0.55
    ratio = make_scene().attributes.ratio
    distance_right = np.array(one.counts.right)
    assert distance_right.sum() >= 110
    assert one.paper[1] == pytest.approx((ratio < 0.55).sum() / distance_right.sum(), abs=0.1)


# The paper's tables


def test_the_papers_tables_are_whole():
    paper = load_paper()
    for table in paper["tables"]:
        assert len(table["rows"]) == 22
        assert len({row["method"] for row in table["rows"]}) == 22
        for row in table["rows"]:
            assert all(len(row[split["name"]]) == len(table["metrics"]) for split in paper["splits"])
    pose = {row["method"]: row for row in paper["tables"][1]["rows"]}
    assert pose["MGCA-Net"]["YFCC100M unknown"] == [77.10, 44.62, 89.23, 79.36]
    assert pose["RANSAC"]["SUN3D known"] == [4.43, None, 15.38, None]


def test_ours_stand_beside_the_papers_where_the_data_is():
    text = format_paper(small_summary())
    assert "MGCA-Net" in text
    lines = [line for line in text.splitlines() if line.startswith("product")]
    assert [line.count("not measured") for line in lines] == [4, 4, 4]
    assert lines[0].startswith("product, all pairs")
    assert "50.00 / 50.00 / 50.00" in lines[0]
    assert lines[1].startswith("product, the papers' variant")
    assert "70.00 / 30.00 / 40.00" in lines[1]
    assert "– / " not in lines[2]
    assert "baseline, all pairs" in text
    assert "baseline, the papers' variant" not in text
    summary = small_summary()
    named = {"hall": "yfcc-sift-2000-test"}
    rows = [dataclasses.replace(row, scene=named.get(row.scene, row.scene)) for row in summary.rows]
    text = format_paper(dataclasses.replace(summary, rows=rows))
    pose = [line for line in text.splitlines() if line.startswith("product")][-1]
    cells = [cell.strip() for cell in pose.split("  ") if cell.strip()]
    assert [cell == "not measured" for cell in cells[1:]] == [True, False, True, True, True]


def test_paper_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert paper_main([]) == 0
    assert "CGR-Net" in capsys.readouterr().out
    (tmp_path / "ours.json").write_text(json.dumps(small_summary().to_json()))
    assert paper_main(["--json", str(tmp_path / "ours.json"), "--style", "markdown"]) == 0
    assert "| product" in capsys.readouterr().out
    (tmp_path / "other.json").write_text("[]")
    assert paper_main(["--json", str(tmp_path / "other.json")]) == 2
    assert "other.json" in capsys.readouterr().err
