"""The report: every kind of input is what it says, and its tables hold what was measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from networks import tiny_network
from scene_bundles import bundle_fields, write_bundle

from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.inference.network_backend import NetworkBackend
from mgca_filter.network import save_network
from mgca_filter.training.report import THRESHOLDS, main, threshold_study
from mgca_filter.training.validation import INPUT_KINDS, PairFigures, evaluate_pair, held_out_pairs, summarize


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, half of whose matches are mutual; weights of an untrained network."""
    folder = tmp_path_factory.mktemp("report")
    for first, name in enumerate(("hall", "yard")):
        scenes = [make_scene(seed=20 * first + i) for i in range(9)]
        mutual = np.arange(len(bundle_fields(scenes)["match_ratio"])) % 2 == 0
        write_bundle(folder / f"{name}.npz", scenes, match_mutual=np.packbits(mutual))
    save_network(tiny_network(seed=1), folder / "weights.safetensors")
    return folder


@pytest.fixture
def pair(folder: Path) -> ScenePair:
    return SceneBundle(folder / "hall.npz")[0]


def test_kinds_of_input_are_what_callers_have(pair):
    known = {}
    for kind, choose in INPUT_KINDS.items():
        rows, attributes = choose(pair)
        encoded = attributes.encode(len(rows))
        known[kind] = (len(rows), *(bool(encoded[:, column].any()) for column in (5, 6, 7)))
    everything = len(pair.mutual)
    assert known["raw"] == (everything, True, True, True)
    assert known["ratio 0.75"] == (np.count_nonzero(pair.attributes.ratio < 0.75), False, True, True)
    assert known["cross-check"] == (everything // 2, False, True, True)
    assert known["bare points"] == (everything, False, False, False)
    rows, attributes = INPUT_KINDS["cross-check"](pair)
    np.testing.assert_array_equal(attributes.size1, pair.attributes.size1[rows])


def test_every_match_of_the_input_has_a_logit(pair):
    match_filter = MatchFilter.over(NetworkBackend(tiny_network()))
    for choose in INPUT_KINDS.values():
        figures = evaluate_pair(match_filter, pair, choose(pair))
        assert figures.logits.shape == figures.truth.shape == (len(choose(pair)[0]),)
        assert np.isfinite(figures.logits).all()
    nothing = evaluate_pair(match_filter, pair, (np.zeros(0, dtype=np.intp), pair.attributes.take(np.zeros(0, int))))
    assert nothing.fit_deg == nothing.essential_deg == 180.0


def test_thresholds_trade_precision_for_recall():
    truth = np.arange(100) < 40
    logits = np.where(truth, 1.0, -1.0) + np.random.default_rng(0).normal(0.0, 1.0, 100)
    figures = PairFigures(logits, truth, 3.0, 12.0)
    study = threshold_study([figures])
    assert [row["logit"] for row in study] == THRESHOLDS.tolist()
    recall = [row["recall"] for row in study]
    assert recall == sorted(recall, reverse=True)
    at = {row["logit"]: row["precision"] for row in study}
    assert at[1.0] > at[0.0] > at[-4.0] == 40.0
    summary = summarize([figures])
    assert summary["fit_mAP@5"] == 100.0
    assert summary["fit_AUC@5"] == pytest.approx(70.0)  # straight from (0, 0) to (3, 1), then level
    assert (summary["essential_mAP@5"], summary["essential_mAP@20"]) == (0.0, 50.0)
    assert summary["F"] == next(row["F"] for row in study if row["logit"] == 0.0)


def test_known_scenes_are_their_held_out_pairs(folder):
    bundles = [SceneBundle(folder / "hall.npz")]
    assert [pair.index for pair in held_out_pairs(bundles, 3, 10)] == [1, 4, 7]
    assert [pair.index for pair in held_out_pairs(bundles, 3, 2)] == [1, 7]
    assert held_out_pairs(bundles, 0, 10) == []


def test_the_command_writes_tables_and_a_picture(folder, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    command = [str(folder / "weights.safetensors"), str(folder), "--scenes", "yard", "--per-scene", "1"]
    command += ["--known", str(folder), "--known-scenes", "hall", "--holdout-every", "3", "--out", str(tmp_path)]
    assert main(command) == 0
    summary = json.loads((tmp_path / "report.json").read_text())
    assert summary["command"].endswith(" ".join(command))
    for group in ("unknown", "known"):
        assert set(summary[group]) == set(INPUT_KINDS)
        assert all(values["pairs"] == 1 for values in summary[group].values())
    text = (tmp_path / "report.md").read_text()
    assert all(f"| known | {kind} | 1 |" in text for kind in INPUT_KINDS)
    assert text.count("\n| +") + text.count("\n| -") == len(THRESHOLDS)
    assert (tmp_path / "thresholds.png").stat().st_size > 10_000

    assert main([*command, "--scenes", "attic"]) == 2
    assert "no scene bundle named attic" in capsys.readouterr().err
    assert main([*command, "--holdout-every", "0"]) == 2
    assert "--holdout-every 0" in capsys.readouterr().err
    assert main([str(folder / "none.safetensors"), *command[1:]]) == 2
    assert "none.safetensors" in capsys.readouterr().err
