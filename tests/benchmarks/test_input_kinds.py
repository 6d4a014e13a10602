"""The study of detectors and lists: figures of made-up outcomes by hand, and the command on tiny bundles."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import learned_fields, write_bundle

from benchmarks import input_kinds
from benchmarks.input_kinds import ESTIMATORS, OURS, Cell, Comparison, ConfidenceQuality, Mean, Study
from benchmarks.match_lists import KINDS
from benchmarks.study import CONFIDENCE_LIMITS
from mgca_filter.evaluation.baselines import Baseline
from mgca_filter.evaluation.difficulty import PairProperties
from mgca_filter.evaluation.methods import PairOutcome
from mgca_filter.evaluation.our_rows import ProductMethod
from mgca_filter.evaluation.selection import Selection

RIGHT_EVERYWHERE = [1.0, 1.0, 1.0, 1.0]


def outcome(
    pair: int, error_deg: float, status: str = "", confidence: float | None = None, share: float = 0.3
) -> PairOutcome:
    nothing = (0.0, 0.0, 0.0)
    failure = "no model" if error_deg == 180.0 else ""
    properties = PairProperties(share, 100, 10.0)
    verdict = {"properties": properties, "status": status, "confidence": confidence}
    return PairOutcome(pair, error_deg, error_deg, error_deg, nothing, nothing, failure, **verdict)  # type: ignore[arg-type]


def made_up(
    ours: Sequence[Sequence[float]],
    baselines: dict[str, list[float]],
    status: Sequence[str] = ("ok",) * 4,
    confidence: Sequence[float | None] = (0.9,) * 4,
    share: Sequence[float] = (0.3,) * 4,
    kind: str = "cross",
    doubted: Sequence[bool] = (False,) * 4,
) -> Cell:
    """One scene of four pairs: errors of the filter's runs, and of the baselines; those not named never find a pose."""
    runs = [
        [outcome(i, error, *rest) for i, (error, *rest) in enumerate(zip(run, status, confidence, share))]
        for run in ours
    ]
    outcomes = {OURS: {"hall": runs}}
    for name in ESTIMATORS:
        errors = baselines.get(name, [180.0] * 4)
        outcomes[name] = {"hall": [[outcome(i, error) for i, error in enumerate(errors)]]}
    return Cell("orb2k", KINDS[kind], outcomes, [None] * 4, [1, 1, 2, None], doubted)


def compared(cell: Cell) -> Comparison:
    return Comparison.of(cell.errors, cell.harmful)


def test_every_estimator_gets_the_filters_list() -> None:
    for name, kind in KINDS.items():
        methods = input_kinds.methods_of(kind, "model.onnx")
        assert list(methods) == [OURS, *ESTIMATORS]
        ours = methods.pop(OURS)
        assert ours == ProductMethod("product", Selection(), "model.onnx")
        for one in methods.values():
            assert isinstance(one, Baseline)
            assert one.selection == (Selection(mutual=True, max_ratio=0.9) if name == "raw" else Selection())
            assert one.in_list_order == (name == "clean" and one.estimator.ordered)
    settings = [estimator.settings() for estimator in ESTIMATORS.values() if estimator.name.startswith("PoseLib")]
    assert [one["max_iterations"] for one in settings] == [10_000, 10_000]


def test_harmful_is_far_off_called_usable_and_avoidable() -> None:
    far = [[31.0, 31.0, 31.0, 31.0]]
    assert made_up(far, {"PoseLib 1 px": [4.9, 5.1, 180.0, 4.0]}).harmful.tolist() == [[True, False, False, True]]
    statuses = ("planar", "unrelated", "low_support", "ok")
    cell = made_up(far, {"PROSAC 0.5 px": RIGHT_EVERYWHERE}, statuses)
    assert cell.harmful.tolist() == [[True, False, False, True]]
    close = made_up([[29.0, 180.0, 4.0, 90.0]], {"PROSAC 0.5 px": RIGHT_EVERYWHERE})
    assert close.harmful.tolist() == [[False, False, False, True]]  # without a pose nothing is usable


def test_harmful_is_judged_run_by_run() -> None:
    cell = made_up([[31.0, 1.0, 31.0, 31.0], [1.0, 31.0, 31.0, 31.0]], {"MAGSAC 0.5 px": [1.0, 1.0, 180.0, 1.0]})
    assert cell.harmful.tolist() == [[True, False, False, True], [False, True, False, True]]
    assert (compared(cell).harmful, compared(cell).answers, compared(cell).lists) == (4, 8, 4)


def test_the_best_baseline_is_chosen_for_each_measure() -> None:
    cell = made_up(
        [RIGHT_EVERYWHERE],
        {"MAGSAC 0.5 px": [4.0, 4.0, 4.0, 180.0], "PROSAC 0.5 px": [0.1, 0.1, 180.0, 180.0]},
    )
    one = compared(cell)
    assert one.best["mAP@20"] == "MAGSAC 0.5 px"
    assert one.best["AUC@5"] == "PROSAC 0.5 px"
    assert one.against_best("mAP@20")[0] == pytest.approx(25.0)
    assert one.against("PoseLib 1 px", "mAP@20") == (100.0, 100.0, 100.0)
    low, high = one.against_best("mAP@20")[1:]
    assert 0.0 <= low < 25.0 < high <= 100.0
    assert one.lost == []


def test_a_filter_that_is_behind_is_pointed_out() -> None:
    behind = compared(made_up([[1.0, 1.0, 1.0, 180.0]], {"MAGSAC 0.5 px": RIGHT_EVERYWHERE}))
    assert behind.lost == ["mAP@20", "AUC@5"]
    assert behind.doubtful == []
    even = compared(made_up([[1.0, 1.0, 1.0, 180.0]], {"MAGSAC 0.5 px": [1.0, 1.0, 180.0, 1.0]}))
    assert even.lost == []
    assert even.doubtful == ["mAP@20", "AUC@5"]
    same = compared(made_up([RIGHT_EVERYWHERE], {"MAGSAC 0.5 px": RIGHT_EVERYWHERE}))
    assert (same.lost, same.doubtful) == ([], [])


def test_means_weigh_every_list_alike() -> None:
    good = compared(made_up([RIGHT_EVERYWHERE], {"MAGSAC 0.5 px": [1.0, 1.0, 180.0, 180.0]}))
    bad = compared(made_up([[180.0] * 4], {"PROSAC 0.5 px": RIGHT_EVERYWHERE}))
    mean = Mean.of([good, good, bad])
    assert (mean.cells, mean.lists, mean.answers) == (3, 12, 12)
    assert mean.figures["mAP@20"] == pytest.approx(200 / 3)
    assert mean.against_best["mAP@20"][0] == pytest.approx((50 + 50 - 100) / 3)
    assert mean.against["MAGSAC 0.5 px"]["mAP@20"][0] == pytest.approx((50 + 50 + 0) / 3)
    alone = Mean.of([good])
    assert alone.against_best["mAP@20"] == pytest.approx(good.against_best("mAP@20"))
    # Two lists of the same pairs are resampled alike, so that their mean is no more certain than either.
    assert Mean.of([good, good]).against_best == alone.against_best


def test_groups_hold_the_lists_that_belong_to_them() -> None:
    cell = made_up([[1.0, 180.0, 1.0, 1.0]], {"MAGSAC 0.5 px": [1.0, 1.0, 180.0, 1.0]}, share=(0.01, 0.019, 0.02, 0.5))
    groups = input_kinds.grouped([cell, cell], input_kinds.SHARES.title, input_kinds.SHARES.names)
    assert {name: one.lists for name, one in groups.items()} == {"below 2 %": 4, "2 – 5 %": 2, "from 50 %": 2}
    assert groups["below 2 %"].figures[OURS]["mAP@5"] == pytest.approx(50.0)
    assert groups["below 2 %"].figures["MAGSAC 0.5 px"]["mAP@5"] == pytest.approx(100.0)
    gaps = input_kinds.grouped([cell], input_kinds.GAP_TITLE, ["1", "2"])
    assert {name: one.lists for name, one in gaps.items()} == {"1": 2, "2": 1}
    assert input_kinds.grouped([cell], input_kinds.MOTION_TITLE, input_kinds.MOTIONS) == {}


def test_confidence_is_judged_where_there_is_a_pose() -> None:
    cell = made_up([[1.0, 9.0, 40.0, 180.0]], {}, ("ok", "unrelated", "ok", "no_geometry"), (0.9, 0.65, 0.65, None))
    quality = ConfidenceQuality.of([cell])
    assert (quality.answers, quality.known, quality.usable) == (4, 3, 2)
    assert quality.auroc == pytest.approx(0.75)  # 0.9 against 0.65, and a tie
    assert quality.ece == pytest.approx((0.1 + 2 * 0.15) / 3)
    assert quality.right_where_usable == pytest.approx(0.5)
    assert quality.kept_of_right == pytest.approx(0.5)
    assert [one.matches for one in quality.bins] == [2, 1]
    assert CONFIDENCE_LIMITS[:2] == (0.5, 0.8)
    assert quality.curve[:2] == [(2 / 3, 1.0), (1.0, 0.5)]
    assert np.isnan(quality.curve[-1][0])
    assert quality.curve[-1][1] == 0.0
    assert quality.to_json()["curve"][-1] == [None, 0.0]
    never = ConfidenceQuality.of([made_up([[180.0] * 4], {}, ("unrelated",) * 4, (None,) * 4)])
    assert never.to_json()["auroc"] is None
    assert never.to_json()["right_where_usable"] is None


def test_confidence_is_also_judged_without_labels_in_doubt() -> None:
    first = [False, False, True, False]
    cell = made_up([[1.0, 9.0, 40.0, 180.0]], {}, ("ok",) * 4, (0.9, 0.65, 0.95, 0.3), doubted=first)
    quality = ConfidenceQuality.of([cell], doubted=False)
    assert (quality.answers, quality.known, quality.usable) == (3, 3, 2)
    assert quality.auroc == 1.0
    assert quality.right_where_usable == 1.0
    confidence = Study.of([cell]).confidence
    assert list(confidence) == ["orb2k", "all", input_kinds.UNDOUBTED]
    assert confidence["all"].answers == 4
    assert input_kinds.UNDOUBTED not in Study.of([made_up([RIGHT_EVERYWHERE], {})]).confidence


def test_the_study_of_several_cells_adds_up() -> None:
    cells = [
        made_up([RIGHT_EVERYWHERE], {"MAGSAC 0.5 px": RIGHT_EVERYWHERE}, kind=kind)
        for kind in ("raw", "ratio", "cross-ratio")
    ]
    study = Study.of(cells)
    assert list(study.means) == ["all", "raw", "ratio-tested"]
    assert [mean.cells for mean in study.means.values()] == [3, 1, 2]
    text = input_kinds.format_study(study, gaps=False)
    assert input_kinds.GAP_TITLE not in text
    assert input_kinds.GAP_TITLE in input_kinds.format_study(study, gaps=True)
    assert json.loads(json.dumps(study.to_json()))["cells"][2]["kind"] == "cross-check + ratio 0.8"


@pytest.fixture
def bundles(tmp_path: Path) -> Path:
    pytest.importorskip("poselib")
    scenes = [make_scene(seed=0), make_scene(right=60, wrong=60, seed=1)]
    names = np.array(["0000.png", "0001.png", "0010.png", "0012.png"])
    folder = tmp_path / "bundles"
    folder.mkdir()
    for name in ("hall", "hall.orb2k", "yard.orb2k"):
        write_bundle(folder / f"{name}.npz", scenes, image_name=names)
    write_bundle(folder / "hall.aliked_lightglue.npz", scenes, **learned_fields(scenes), image_name=names)
    return folder


@pytest.mark.slow
def test_command_prints_all_tables_and_takes_known_results_from_the_store(
    bundles: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = tmp_path / "figures.json"
    arguments = [str(bundles), "--model", str(model_file), "--store", str(tmp_path / "store"), "--json", str(figures)]
    assert input_kinds.main(arguments) == 0
    printed = capsys.readouterr().out
    content = json.loads(figures.read_text())
    assert content["filter"]["model"] == model_file.name
    assert content["options"] == {"per_scene": None, "seed": 0, "seeds": 1, "gaps": None}
    cells = {(cell["detector"], cell["kind"]): cell for cell in content["cells"]}
    own = [kind.name for name, kind in KINDS.items() if name != "learned"]
    expected = [(detector, name) for detector in ("SIFT-2000", "orb2k") for name in own]
    assert sorted(cells) == sorted([*expected, ("aliked_lightglue", "the matcher's own")])
    for cell in cells.values():
        assert cell["lists"] == (4 if cell["detector"] == "orb2k" else 2)
        assert cell["figures"][OURS]["mAP@20"] == 100.0
        assert set(cell["figures"]) == {OURS, *ESTIMATORS}
        assert max(cell["figures"][name]["mAP@20"] for name in ESTIMATORS) == 100.0
        assert cell["harmful"] == 0
    for title in ("Detectors and lists", "Means over the rows above", "Confidence", "Reliability", "By share of right"):
        assert f"## {title}" in printed
    stored = {path: path.stat().st_mtime_ns for path in (tmp_path / "store").rglob("*.json")}
    assert input_kinds.main(arguments) == 0
    assert capsys.readouterr().out == printed
    assert stored == {path: path.stat().st_mtime_ns for path in (tmp_path / "store").rglob("*.json")}


def test_options_choose_detectors_scenes_kinds_pairs_and_runs(
    bundles: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures, store = tmp_path / "figures.json", tmp_path / "store"

    def cells(*options: str) -> dict[tuple[str, str], tuple[int, int]]:
        arguments = [str(bundles), "--model", str(model_file), "--store", str(store), "--json", str(figures)]
        assert input_kinds.main([*arguments, *options]) == 0
        found = json.loads(figures.read_text())["cells"]
        return {(one["detector"], one["kind"]): (one["lists"], one["answers"]) for one in found}

    few = ("--detectors", "orb2k", "--kinds", "cross")
    row = ("orb2k", "cross-check")
    assert cells(*few) == {row: (4, 4)}
    assert cells(*few, "--scenes", "yard") == {row: (2, 2)}
    assert cells(*few, "--per-scene", "1") == {row: (2, 2)}
    assert cells(*few, "--seeds", "2") == {row: (4, 8)}
    assert "By frames" not in capsys.readouterr().out
    assert cells(*few, "--gaps", "2", "5") == {row: (2, 2)}
    assert "| 2 | 2 |" in capsys.readouterr().out.split("## By frames between the images")[1]


def test_a_pair_that_cannot_be_read_is_a_failure_of_every_method(
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes = [make_scene(seed=0), make_scene(seed=1)]
    index = np.concatenate([np.full(200, 9999), np.arange(200)]).astype(np.uint16)
    path = write_bundle(tmp_path / "hall.orb2k.npz", scenes, match_index=index)
    figures = tmp_path / "figures.json"
    options = [str(path), "--model", str(model_file), "--kinds", "raw", "cross", "--json", str(figures)]
    assert input_kinds.main(options) == 0
    for cell in json.loads(figures.read_text())["cells"]:
        assert cell["lists"] == 2
        assert {one["mAP@20"] for one in cell["figures"].values()} == {50.0}


def test_misuse_is_one_line(bundles: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options in (
        [str(tmp_path / "none")],
        [str(bundles), "--detectors", "brisk"],
        [str(bundles), "--detectors", "orb2k", "--kinds", "learned"],
        [str(bundles), "--gaps", "7"],
    ):
        assert input_kinds.main(options) == 2
        assert capsys.readouterr().err.count("\n") == 1
