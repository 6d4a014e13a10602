"""The scoreboard on synthetic bundles: baselines, product rows, workers, resumption, reports."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, Scene, make_scene
from scene_bundles import write_bundle

from mgca_filter import filter_matches
from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.errors import BundleError, DatasetError
from mgca_filter.evaluation import predict as predict_module
from mgca_filter.evaluation.__main__ import main
from mgca_filter.evaluation.baselines import OpenCvEstimator, PoseLibEstimator, estimate_from_essential
from mgca_filter.evaluation.environment import BUSY_LOAD, CpuMeter
from mgca_filter.evaluation.methods import Answer, PairOutcome
from mgca_filter.evaluation.metrics import precision_recall_f
from mgca_filter.evaluation.our_rows import pose_by_paper_protocol, pose_without_ransac
from mgca_filter.evaluation.pairs import draw_indices, iterate_pairs, select_pairs
from mgca_filter.evaluation.predict import evaluate_pair, predict
from mgca_filter.evaluation.registry import BASELINE_ROWS, PRODUCT_ROWS, parse_method
from mgca_filter.evaluation.report import format_report
from mgca_filter.evaluation.selection import Selection
from mgca_filter.evaluation.store import ResultStore
from mgca_filter.evaluation.summarize import summarize
from mgca_filter.evaluation.summary import Context, Summary
from mgca_filter.evaluation.timing import Timing
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg, symmetric_epipolar_distance_squared

PROSAC = "mutual + ratio 0.9 + PROSAC 0.5 px"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of three and two easy pairs."""
    folder = tmp_path_factory.mktemp("bundles")
    write_bundle(folder / "hall.npz", [make_scene(seed=seed) for seed in range(3)])
    write_bundle(folder / "yard.npz", [make_scene(seed=seed, right=90) for seed in (3, 4)])
    return folder


@pytest.fixture
def pair(folder: Path) -> ScenePair:
    return next(iterate_pairs(select_pairs(folder)))


@dataclasses.dataclass(frozen=True)
class CountingMethod:
    """Answers with the truth and notes which pairs it saw; stops like a user's Ctrl-C at ``stop_at``."""

    seen: list[tuple[str, int]]
    label: str = "counting"
    stop_at: int | None = None
    seeded: bool = False

    @property
    def name(self) -> str:
        return "counting"

    def settings(self) -> dict[str, Any]:
        return {"label": self.label}

    def run(self, pair: ScenePair, seed: int) -> Answer:
        if self.stop_at == len(self.seen):
            raise KeyboardInterrupt
        self.seen.append((pair.name, seed))
        everything = np.ones(len(pair.points1), dtype=bool)
        return Answer(pair.R, pair.t, everything, everything)


@dataclasses.dataclass(frozen=True)
class RaisingMethod:
    name: str = "raising"
    seeded: bool = False

    def settings(self) -> dict[str, Any]:
        return {}

    def run(self, pair: ScenePair, seed: int) -> Answer:
        raise RuntimeError("out of luck")


# Pairs


def test_draw_is_seeded_and_keeps_to_the_cap():
    drawn = draw_indices(100, "hall", 10, seed=0)
    assert drawn == draw_indices(100, "hall", 10, seed=0)
    assert drawn == tuple(sorted(set(drawn)))
    assert len(drawn) == 10
    assert drawn != draw_indices(100, "hall", 10, seed=1)
    assert drawn != draw_indices(100, "yard", 10, seed=0)
    assert draw_indices(5, "hall", None, 0) == draw_indices(5, "hall", 9, 0) == (0, 1, 2, 3, 4)


def test_selection_covers_a_folder_one_file_or_named_scenes(folder):
    assert [(s.scene, len(s)) for s in select_pairs(folder)] == [("hall", 3), ("yard", 2)]
    assert [s.scene for s in select_pairs(folder / "yard.npz")] == ["yard"]
    assert [s.scene for s in select_pairs(folder, ["hall"])] == ["hall"]
    capped = select_pairs(folder, per_scene=1)
    assert [pair.scene for pair in iterate_pairs(capped)] == ["hall", "yard"]


def test_bundles_that_cannot_be_used_are_named(folder, tmp_path):
    with pytest.raises(DatasetError, match="no scene named cellar"):
        select_pairs(folder, ["cellar", "hall"])
    with pytest.raises(BundleError, match="no scene bundle"):
        select_pairs(tmp_path)
    with pytest.raises(ValueError, match="per_scene"):
        select_pairs(folder, per_scene=0)
    for name in ("all", "pairs"):
        with pytest.raises(DatasetError, match=f"a scene cannot be called '{name}'"):
            select_pairs(write_bundle(tmp_path / f"{name}.npz", [make_scene()]))
        (tmp_path / f"{name}.npz").unlink()
    write_bundle(tmp_path / "good.npz", [make_scene()])
    (tmp_path / "torn.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:3000])
    with pytest.raises(BundleError, match=r"torn\.npz"):
        select_pairs(tmp_path)


# Baselines


@pytest.mark.parametrize(
    "name", [*BASELINE_ROWS, *PRODUCT_ROWS, "mutual + ratio 0.8 + product", "NN + ACCURATE 0.5 px"]
)
def test_a_rows_name_gives_the_row(name):
    assert parse_method(name).name == name


@pytest.mark.parametrize(
    "name",
    [
        "RANSAC",
        "NN + LMEDS 1 px",
        "NN + network order + MAGSAC 1 px",
        "NN + network order + product",
        "best + RANSAC 1 px",
        "NN + RANSAC 0 px",
        "ratio 2 + MAGSAC 1 px",
        "",
        "NN +",
    ],
)
def test_other_names_are_refused(name):
    with pytest.raises(ValueError, match="expected|positive"):
        parse_method(name)


@pytest.mark.parametrize("name", [row for row in BASELINE_ROWS if "GMS" not in row])
def test_baselines_solve_an_easy_pair(name, pair):
    for word, package in (("PoseLib", "poselib"), ("AdaLAM", "kornia"), ("DEGENSAC", "pydegensac")):
        if word in name:
            pytest.importorskip(package)
    outcome = evaluate_pair(parse_method(name), pair, 0)
    assert outcome.failure == ""
    assert outcome.error_deg < 3.0
    assert outcome.error_deg == max(outcome.rotation_deg, outcome.translation_deg)
    assert outcome.mask[0] > 0.8


def test_selections_keep_what_they_say(pair):
    mutual = np.arange(len(pair.points1)) % 2 == 0
    pair = dataclasses.replace(pair, mutual=mutual)
    ratio = pair.attributes.ratio
    assert Selection().apply(pair).all()
    np.testing.assert_array_equal(Selection(mutual=True, max_ratio=0.8).apply(pair), mutual & (ratio < 0.8))


def test_gms_keeps_a_regular_shift():
    x, y = np.meshgrid(np.arange(5.0, 600, 9), np.arange(5.0, 440, 9))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    scene = make_scene(right=len(points), wrong=0)
    scene = dataclasses.replace(scene, points1=points, points2=points + 7.0)
    pair = _as_pair(scene)
    assert Selection(gms=True).apply(pair).mean() > 0.9
    shuffled = dataclasses.replace(pair, points2=np.random.default_rng(0).permutation(pair.points2))
    assert Selection(gms=True).apply(shuffled).mean() < 0.1


def test_gms_rejects_points_outside_the_image(pair):
    points2 = pair.points2.copy()
    points2[:20] = [SIZE[0] + 300.0, SIZE[1] + 300.0]
    points2[20:40] = [-50.0, 10.0]
    pair = dataclasses.replace(pair, points2=points2)
    for _ in range(20):
        assert not Selection(gms=True).apply(pair)[:40].any()
    nowhere = dataclasses.replace(pair, points1=pair.points1 - 5000.0)
    assert not Selection(gms=True).apply(nowhere).any()


def _as_pair(scene: Scene) -> ScenePair:
    everything = np.ones(len(scene.points1), dtype=bool)
    return ScenePair(
        *("scene", 0, "a", "b", scene.points1, scene.points2, K, K, SIZE, SIZE, scene.R, scene.t, scene.attributes),
        mutual=everything,
    )


@pytest.mark.parametrize("kind", ["PROSAC", "MAGSAC"])
def test_only_prosac_gets_its_matches_sorted(kind, pair, monkeypatch):
    captured = []
    genuine = cv2.findEssentialMat

    def spy(x1, *args, **kwargs):
        captured.append((x1, kwargs))
        return genuine(x1, *args, **kwargs)

    monkeypatch.setattr(cv2, "findEssentialMat", spy)
    parse_method(f"ratio 0.9 + {kind} 0.5 px").run(pair, 0)
    rows = np.flatnonzero(pair.attributes.ratio < 0.9)
    if kind == "PROSAC":
        rows = rows[np.argsort(pair.attributes.ratio[rows], kind="stable")]
    x1, options = captured[0]
    np.testing.assert_allclose(x1, (pair.points1[rows] - K[:2, 2]) / 800.0)
    assert options["threshold"] == pytest.approx(0.5 / 800.0)
    assert (options["prob"], options["maxIters"]) == (0.9999, 5000)


def test_poselib_gets_seed_threshold_and_sampling(pair, monkeypatch):
    poselib = pytest.importorskip("poselib")
    captured = []
    genuine = poselib.estimate_relative_pose

    def spy(*args):
        captured.append((args[0], args[4]))
        return genuine(*args)

    monkeypatch.setattr(poselib, "estimate_relative_pose", spy)
    parse_method("ratio 0.9 + PoseLib progressive 0.75 px").run(pair, 2)
    points1, options = captured[0]
    rows = np.flatnonzero(pair.attributes.ratio < 0.9)
    np.testing.assert_array_equal(points1, pair.points1[rows[np.argsort(pair.attributes.ratio[rows], kind="stable")]])
    assert options == {"max_epipolar_error": 0.75, "progressive_sampling": True, "seed": 2}


def test_poselibs_identity_is_no_pose(pair, monkeypatch):
    poselib = pytest.importorskip("poselib")
    nothing = (poselib.CameraPose(), {"num_inliers": 0, "inliers": [False] * 8})
    monkeypatch.setattr(poselib, "estimate_relative_pose", lambda *args: nothing)
    estimate = PoseLibEstimator(0.75).estimate(pair, np.arange(8), 0)
    assert estimate.R is None
    assert estimate.failure == "no model"


def test_essential_matrices_in_any_form(scene):
    x1, x2 = ((points - K[:2, 2]) / 800.0 for points in (scene.points1, scene.points2))
    other = essential_from_pose(np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 1.0])
    stacked = estimate_from_essential(np.vstack([other, scene.E]), x1, x2, scene.inlier)
    assert pose_error_deg(stacked.R, stacked.t, scene.R, scene.t) < 1e-4
    for useless in (None, np.zeros((0, 3)), np.full((3, 3), np.nan), np.zeros((2, 3))):
        assert estimate_from_essential(useless, x1, x2, scene.inlier).failure == "no model"


@pytest.mark.parametrize("returned", [(None, None), (np.full((3, 3), np.nan), np.ones((200, 1), np.uint8))])
def test_an_estimator_without_a_model_is_a_failure(returned, pair, monkeypatch):
    monkeypatch.setattr(cv2, "findEssentialMat", lambda *args, **kwargs: returned)
    estimate = OpenCvEstimator("RANSAC", 1.0).estimate(pair, np.arange(200), 0)
    assert estimate.R is None
    assert estimate.failure == "no model"


def test_too_few_matches_and_exceptions_count_as_180_degrees(pair):
    few = dataclasses.replace(pair, mutual=np.arange(len(pair.points1)) < 4)
    outcome = evaluate_pair(parse_method("mutual + RANSAC 1 px"), few, 0)
    assert (outcome.error_deg, outcome.failure) == (180.0, "fewer than 5 matches")
    outcome = evaluate_pair(RaisingMethod(), pair, 0)
    assert (outcome.error_deg, outcome.failure) == (180.0, "error: RuntimeError: out of luck")
    assert outcome.kept == outcome.mask == (0.0, 0.0, 0.0)


def test_time_matched_rows_use_up_their_iterations(pair, monkeypatch):
    poselib = pytest.importorskip("poselib")
    captured = []
    monkeypatch.setattr(cv2, "findEssentialMat", lambda *args, **kwargs: captured.append(kwargs) or (None, None))
    opencv, progressive = "NN + MAGSAC 0.5 px 7000 iterations", "NN + PoseLib progressive 1 px 3000 iterations"
    assert [parse_method(name).name for name in (opencv, progressive)] == [opencv, progressive]
    parse_method(opencv).run(pair, 0)
    assert captured[0]["maxIters"] == 7000
    assert captured[0]["prob"] > 1 - 1e-8
    genuine, spent = poselib.estimate_relative_pose, []

    def spy(*args):
        pose, info = genuine(*args)
        spent.append(info["iterations"])
        return pose, info

    monkeypatch.setattr(poselib, "estimate_relative_pose", spy)
    parse_method(progressive).run(pair, 0)
    assert spent[0] >= 3000


# The filter's own rows


@pytest.mark.parametrize(
    ("variant", "seed", "options"),
    [
        ("product", 0, {}),
        ("product", 2, {"seed": 2}),
        ("product bare", 0, {"attributes": None}),
        ("product poselib", 1, {"method": "poselib", "seed": 1}),
    ],
)
def test_product_rows_equal_filter_matches(variant, seed, options, pair, model_file):
    outcome = evaluate_pair(parse_method(variant, str(model_file)), pair, seed)
    arguments = {"attributes": pair.attributes, "model": model_file, **options}
    result = filter_matches(pair.points1, pair.points2, None, K1=K, K2=K, size1=SIZE, size2=SIZE, **arguments)
    truth = symmetric_epipolar_distance_squared(pair.correspondences, pair.E) < 1e-4
    assert outcome.error_deg == pose_error_deg(result.R, result.t, pair.R, pair.t)
    assert outcome.mask == precision_recall_f(result.mask, truth)
    assert outcome.kept == precision_recall_f(result.info["logits"] > 0, truth)


def test_product_after_a_selection_sees_only_what_is_left(pair, model_file):
    name = "ratio 0.7 + product"
    answer = parse_method(name, str(model_file)).run(pair, 0)
    outside = pair.attributes.ratio >= 0.7
    assert not answer.mask[outside].any()
    assert not answer.kept[outside].any()
    assert answer.mask.any()


def test_network_rows_run_without_the_robust_fit(scene, model_file, pair):
    x1, x2 = ((points - K[:2, 2]) / 800.0 for points in (scene.points1, scene.points2))
    logits = np.where(scene.inlier, 1.0, -1.0) + 1e-3 * np.arange(len(x1))
    plain = pose_without_ransac(scene.E, logits, x1, x2)
    assert pose_error_deg(plain.R, plain.t, scene.R, scene.t) < 1e-4
    np.testing.assert_array_equal(np.flatnonzero(plain.inliers), np.sort(np.argsort(logits)[-20:]))
    fitted = pose_by_paper_protocol(logits, x1, x2)
    assert pose_error_deg(fitted.R, fitted.t, scene.R, scene.t) < 5.0
    assert not fitted.inliers[logits <= 0].any()
    assert pose_without_ransac(None, logits, x1, x2).failure == "no essential matrix from the network"
    assert pose_by_paper_protocol(-np.ones(len(x1)), x1, x2).failure == "fewer than 5 matches"
    for variant in ("network E", "network RANSAC"):
        assert evaluate_pair(parse_method(variant, str(model_file)), pair, 0).failure == ""


# Runs


@pytest.mark.slow
def test_workers_do_not_change_the_numbers(folder, model_file):
    methods = [parse_method(name, str(model_file)) for name in (PROSAC, "NN + PoseLib 0.75 px", "product")]
    selections = select_pairs(folder)
    threads = cv2.getNumThreads()
    alone = predict(methods, selections, seeds=2)
    assert cv2.getNumThreads() == threads
    parallel = predict(methods, selections, seeds=2, workers=2)
    assert alone == parallel
    assert [len(runs) for runs in parallel["NN + PoseLib 0.75 px"].values()] == [2, 2]
    assert [len(runs) for runs in parallel["product"].values()] == [2, 2]
    assert [len(runs) for runs in parallel[PROSAC].values()] == [1, 1]


def test_an_interrupted_run_resumes(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(predict_module, "CHUNK_PAIRS", 1)
    selections, store = select_pairs(folder), ResultStore(tmp_path)
    first, second = CountingMethod([], stop_at=2), CountingMethod([])
    with pytest.raises(KeyboardInterrupt):
        predict([first], selections, store=store)
    results = predict([second], selections, store=ResultStore(tmp_path))
    assert first.seen + second.seen == [("hall/0", 0), ("hall/1", 0), ("hall/2", 0), ("yard/0", 0), ("yard/1", 0)]
    assert all(o.error_deg < 1e-4 for runs in results["counting"].values() for o in runs[0])


def test_a_bar_counts_the_pairs_that_are_run(folder, tmp_path, monkeypatch, capsys):
    pytest.importorskip("tqdm")
    store, selections = ResultStore(tmp_path), select_pairs(folder)
    predict([CountingMethod([])], selections, store=store, progress=True)
    assert "5/5" in capsys.readouterr().err
    predict([CountingMethod([], "other")], selections, store=store)
    assert capsys.readouterr().err == ""


def test_without_tqdm_a_bar_is_refused_before_anything_runs(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    method = CountingMethod([])
    with pytest.raises(ImportError, match="tqdm"):
        predict([method], select_pairs(folder), progress=True)
    assert method.seen == []
    predict([method], select_pairs(folder))
    assert len(method.seen) == 5


def test_stored_results_are_reused_only_for_equal_data_and_settings(folder, tmp_path, monkeypatch):
    store = ResultStore(tmp_path / "store")

    def pairs_run(path, label="counting", per_scene=None, seeds=1):
        method = CountingMethod([], label, seeded=seeds > 1)
        predict([method], select_pairs(path, ["hall"], per_scene), seeds=seeds, store=store)
        return len(method.seen)

    assert pairs_run(folder, per_scene=2) == 2
    assert pairs_run(folder) == 1
    assert pairs_run(folder) == 0
    assert pairs_run(folder, seeds=3) == 6
    assert pairs_run(folder, label="other settings") == 3
    write_bundle(tmp_path / "hall.npz", [make_scene(seed=9)])
    assert pairs_run(tmp_path) == 1
    assert pairs_run(folder) == 0


def test_a_damaged_stored_result_is_computed_again(folder, tmp_path, monkeypatch, caplog):
    predict([CountingMethod([])], select_pairs(folder, ["yard"]), store=ResultStore(tmp_path))
    (stored,) = tmp_path.glob("yard/*.json")
    stored.write_text(stored.read_text()[:100])
    again = CountingMethod([])
    predict([again], select_pairs(folder, ["yard"]), store=ResultStore(tmp_path))
    assert len(again.seen) == 2
    assert str(stored) in caplog.text


def test_predict_refuses_what_it_cannot_run(folder):
    selections = select_pairs(folder)
    with pytest.raises(ValueError, match="at least 1"):
        predict([RaisingMethod()], selections, workers=0)
    with pytest.raises(ValueError, match="same name"):
        predict([RaisingMethod(), RaisingMethod()], selections)


def test_a_busy_machine_is_noticed(monkeypatch):
    from mgca_filter.evaluation import environment

    for extra, expected in ((0.0, False), (1e3, True)):
        readings = iter([100.0, 100.0 + extra])
        monkeypatch.setattr(environment, "_machine_cpu_seconds", lambda readings=readings: next(readings))
        assert (CpuMeter().others_load() > BUSY_LOAD) is expected


# Reports


def outcome(pair: int, error_deg: float, failure: str = "", kept: float = 0.5) -> PairOutcome:
    return PairOutcome(pair, error_deg, None, None, (kept,) * 3, (0.25,) * 3, failure)


def small_results() -> dict[str, Any]:
    ours = {"hall": [[outcome(0, 1.0), outcome(1, 180.0, "no model")]], "yard": [[outcome(0, 7.0, kept=1.0)]]}
    theirs = {"hall": [[outcome(0, 30.0), outcome(1, 1.0)]] * 2, "yard": [[outcome(0, 30.0)], [outcome(0, 1.0)]]}
    return {"product": ours, "baseline": theirs}


def test_summary_rows_by_scene_over_scenes_and_over_pairs():
    milliseconds = {"hall": [10.0, 20.0], "yard": [10.0]}
    timing = Timing({"product": milliseconds, "baseline": milliseconds}, "Abacus", 0.0)
    summary = summarize(small_results(), Context(commit="abc"), timing, replicates=50)
    rows = {(row.method, row.scene): row for row in summary.rows}
    assert [scene for method, scene in rows if method == "product"] == ["hall", "yard", "all", "pairs"]
    assert rows["product", "hall"].pose["mAP@5"] == 50.0
    assert rows["product", "all"].pose["mAP@5"] == pytest.approx(25.0)
    assert rows["product", "pairs"].pose["mAP@5"] == pytest.approx(100 / 3)
    assert rows["product", "all"].pose["mAP@20"] == pytest.approx((50 + 75) / 2)
    assert pytest.approx(75.0) == rows["product", "all"].kept.F
    assert pytest.approx(200 / 3) == rows["product", "pairs"].kept.F
    assert rows["product", "all"].median_ms == pytest.approx((15 + 10) / 2)
    assert rows["product", "pairs"].median_ms == pytest.approx(10.0)
    assert rows["product", "pairs"].p95_ms == pytest.approx(19.0)  # nine tenths of the way from 10 to 20
    assert [rows["product", scene].timed_pairs for scene in ("hall", "yard", "all", "pairs")] == [2, 1, 3, 3]
    assert rows["product", "all"].failures == 1
    assert rows["baseline", "all"].pose["mAP@5"] == pytest.approx(50.0)
    wanted = {"method", "scene", "pairs", "mAP@5", "mAP@20", "AUC@5", "AUC@10", "AUC@20", "P", "R", "F", "median_ms"}
    assert all(wanted <= set(row.to_json()) for row in summary.rows)
    assert summary.failures == {"product": {"no model": 1}, "baseline": {}}
    assert summary.context.commit == "abc"
    (difference,) = summary.differences
    assert (difference.method, difference.minus) == ("product", "baseline")
    assert difference.figures["mAP@5"][0] == pytest.approx(-25.0)
    # hall has one pair right of two, yard's only pair is wrong
    assert rows["product", "hall"].intervals["mAP@5"] == (0.0, 100.0)
    assert rows["product", "yard"].intervals["mAP@5"] == (0.0, 0.0)
    assert rows["product", "all"].intervals["mAP@5"] == (0.0, 50.0)
    assert rows["product", "pairs"].intervals is None
    written = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    assert written["rows"][0]["intervals"]["mAP@5"] == [0.0, 100.0]
    assert Summary.from_json(written) == summary


def test_a_single_row_has_its_interval():
    results = {"product": small_results()["product"]}
    assert "intervals of the headline" in format_report(summarize(results, replicates=10), "text")
    assert "intervals" not in format_report(summarize(results, replicates=0), "text")


def test_reference_of_the_differences_can_be_chosen():
    summary = summarize(small_results(), replicates=10, reference="baseline")
    assert summary.differences[0].minus == "product"
    assert summarize(small_results(), replicates=0).differences == []
    with pytest.raises(ValueError, match="not among the methods"):
        summarize(small_results(), replicates=10, reference="somebody")


@pytest.mark.parametrize(("style", "row"), [("text", "product "), ("markdown", "| product"), ("latex", "product &")])
def test_tables_show_every_row_and_how_it_was_measured(style, row):
    text = format_report(summarize(small_results(), Context(commit="abc", seed=0), replicates=10), style)
    for expected in ("mAP@20 by scene", "(baseline)", "the final mask", "bootstrap intervals", row):
        assert expected in text
    told = ("no model (1)", "on one thread", "commit: abc")
    assert [words in text for words in told] == [style != "latex"] * 3


def test_command_writes_tables_and_figures(folder, tmp_path, model_file, capsys):
    arguments = [str(folder), "--methods", PROSAC, "product", "--model", str(model_file), "--per-scene", "2"]
    arguments += ["--bootstrap", "20", "--store", str(tmp_path / "store"), "--quiet"]
    files = ["--json", str(tmp_path / "out.json"), "--markdown", str(tmp_path / "out.md")]
    assert main(arguments + files) == 0
    text = capsys.readouterr().out
    assert "Mean over scenes (headline)" in text
    summary = json.loads((tmp_path / "out.json").read_text())
    assert {row["method"] for row in summary["rows"]} == {PROSAC, "product"}
    assert {"versions", "seed", "commit", "machine", "settings"} <= set(summary)
    assert summary["settings"]["methods"]["product"]["model"] == model_file.name
    assert "| product" in (tmp_path / "out.md").read_text()
    assert main([*arguments, "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == summary["rows"]


def test_command_names_what_is_wrong(folder, tmp_path, capsys):
    (tmp_path / "torn.npz").write_bytes(b"no bundle")
    assert main([str(tmp_path), "--methods", PROSAC, "-q"]) == 2
    assert "torn.npz" in capsys.readouterr().err
    assert main([str(folder), "--methods", "NN + LMEDS 2 px", "-q"]) == 2
    assert "NN + LMEDS 2 px" in capsys.readouterr().err
    assert main([str(folder), "--methods", "product", "--model", str(tmp_path / "absent.onnx"), "-q"]) == 2
    assert "absent.onnx" in capsys.readouterr().err


def test_command_refuses_before_it_runs(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(predict_module, "evaluate_pair", None)  # whoever calls it fails
    arguments = [str(folder), "--methods", PROSAC, "-q"]
    assert main([*arguments, "--reference", "NN + RANSAC 1 px"]) == 2
    assert "reference 'NN + RANSAC 1 px' is not among the methods" in capsys.readouterr().err
    for option in ("--json", "--markdown", "--latex"):
        assert main([*arguments, option, str(tmp_path / "absent" / "out")]) == 2
        assert f"error: {option}: {tmp_path / 'absent' / 'out'}" in capsys.readouterr().err
