"""Baselines of other libraries, and the network's order."""

from __future__ import annotations

import dataclasses
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
from mgca_filter.evaluation.__main__ import main
from mgca_filter.evaluation.methods import PairOutcome
from mgca_filter.evaluation.predict import evaluate_pair
from mgca_filter.evaluation.registry import GRID_ROWS, TIME_MATCHED_ROWS, parse_method
from mgca_filter.evaluation.selection import Selection
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.inputs.attributes import MatchAttributes

LISTED = "ratio 0.9 + list order + PoseLib progressive 0.75 px up to 10000 iterations"
ORDERED = "mutual + ratio 0.9 + network order + PROSAC 0.5 px"


def as_pair(scene: Scene) -> ScenePair:
    return ScenePair(
        *("scene", 0, "a", "b", scene.points1, scene.points2, K, K, SIZE, SIZE, scene.R, scene.t, scene.attributes),
        mutual=np.ones(len(scene.points1), dtype=bool),
    )


@pytest.fixture
def pair(scene: Scene) -> ScenePair:
    return as_pair(scene)


@pytest.fixture
def waving() -> ScenePair:
    """300 matches that move as one affine patch, and 300 at random."""
    rng = np.random.default_rng(0)
    points1 = rng.uniform([40, 40], [600, 440], (600, 2))
    points2 = points1 @ np.array([[1.05, 0.02], [-0.02, 1.05]]) + [9.0, 4.0]
    points2[300:] = rng.uniform([0, 0], SIZE, (300, 2))
    everything = np.full(600, 4.0, dtype=np.float32)
    ratio = np.where(np.arange(600) < 300, 0.6, 0.9).astype(np.float32)
    attributes = MatchAttributes(ratio, None, everything, everything, 5 * everything, 5 * everything)
    scene = make_scene(right=600, wrong=0)
    return as_pair(dataclasses.replace(scene, points1=points1, points2=points2, attributes=attributes))


@pytest.mark.parametrize(
    "name", [*GRID_ROWS, *TIME_MATCHED_ROWS, ORDERED, LISTED, "AdaLAM + DEGENSAC 1 px 500 iterations"]
)
def test_a_rows_name_gives_the_row(name: str):
    assert parse_method(name).name == name


def test_lmeds_has_no_threshold(pair: ScenePair, monkeypatch: pytest.MonkeyPatch):
    genuine, captured = cv2.findEssentialMat, []

    def spy(*args: Any, **kwargs: Any) -> Any:
        captured.append(kwargs)
        return genuine(*args, **kwargs)

    monkeypatch.setattr(cv2, "findEssentialMat", spy)
    outcome = evaluate_pair(parse_method("ratio 0.8 + LMEDS"), pair, 0)
    assert captured[0]["method"] == cv2.LMEDS
    assert outcome.error_deg < 5.0
    assert parse_method("ratio 0.8 + LMEDS").settings()["estimator"]["threshold_px"] is None


def test_degensac_gets_pixels_threshold_seed_and_budget(pair: ScenePair, monkeypatch: pytest.MonkeyPatch):
    pydegensac = pytest.importorskip("pydegensac")
    genuine, captured = pydegensac.findFundamentalMatrix, []

    def spy(points1: Any, points2: Any, threshold_px: float, **kwargs: Any) -> Any:
        captured.append((points1, threshold_px, kwargs))
        return genuine(points1, points2, threshold_px, **kwargs)

    monkeypatch.setattr(pydegensac, "findFundamentalMatrix", spy)
    outcome = evaluate_pair(parse_method("ratio 0.9 + DEGENSAC 0.75 px"), pair, 2)
    assert outcome.error_deg < 5.0
    assert outcome.mask[0] > 0.8
    points1, threshold_px, options = captured[0]
    np.testing.assert_array_equal(points1, pair.points1[pair.attributes.ratio < 0.9])
    assert (threshold_px, options) == (0.75, {"seed": 2})
    parse_method("NN + DEGENSAC 0.75 px 3000 iterations").run(pair, 0)
    assert captured[1][2]["max_iters"] == 3000
    assert captured[1][2]["conf"] > 1 - 1e-8
    few = dataclasses.replace(pair, mutual=np.arange(len(pair.points1)) < 7)
    assert parse_method("mutual + DEGENSAC 1 px").run(few, 0).failure == "fewer than 8 matches"


def test_adalam_keeps_what_moves_with_its_neighbours(waving: ScenePair):
    pytest.importorskip("kornia")
    kept = Selection(adalam=True).apply(waving)
    assert kept[:300].mean() > 0.8
    assert kept[300:].mean() < 0.1
    np.testing.assert_array_equal(kept, Selection(adalam=True).apply(waving))
    bare = dataclasses.replace(waving, attributes=MatchAttributes(waving.attributes.ratio))
    assert Selection(adalam=True).apply(bare)[:300].mean() > 0.8
    with pytest.raises(ValueError, match="AdaLAM needs the distance ratios"):
        Selection(adalam=True).apply(dataclasses.replace(waving, attributes=MatchAttributes()))


def test_adalam_takes_orientation_and_mutual_matches_into_account(waving: ScenePair):
    pytest.importorskip("kornia")
    random = np.random.default_rng(1).uniform(0, 360, 600).astype(np.float32)
    turned = dataclasses.replace(waving, attributes=dataclasses.replace(waving.attributes, angle2=random))
    kept, kept_turned = (Selection(adalam=True).apply(pair)[:300].sum() for pair in (waving, turned))
    assert kept_turned < kept - 5
    # Without a mutual match there is no seed, and kornia falls back on the squared ratio.
    seedless = dataclasses.replace(waving, mutual=np.zeros(600, dtype=bool))
    assert Selection(adalam=True).apply(seedless).all()


def test_older_stored_results_keep_their_key():
    assert Selection(mutual=True, max_ratio=0.9).settings() == {"mutual": True, "max_ratio": 0.9, "gms": False}


def test_network_order_sorts_plain_matches_by_logit(pair: ScenePair, model_file: Path, monkeypatch: pytest.MonkeyPatch):
    genuine, captured = cv2.findEssentialMat, []

    def spy(x1: Any, *args: Any, **kwargs: Any) -> Any:
        captured.append(x1)
        return genuine(x1, *args, **kwargs)

    monkeypatch.setattr(cv2, "findEssentialMat", spy)
    ratio = pair.attributes.ratio
    mutual = np.arange(len(ratio)) % 3 > 0
    pair = dataclasses.replace(pair, mutual=mutual)
    answer = parse_method(ORDERED, str(model_file)).run(pair, 0)
    np.testing.assert_array_equal(answer.kept, mutual & (ratio < 0.9))
    result = filter_matches(
        *(pair.points1, pair.points2, None), K1=K, K2=K, attributes=pair.attributes, model=model_file, method="none"
    )
    logits = result.info["logits"]
    rows = np.flatnonzero(answer.kept)
    rows = rows[np.argsort(-logits[rows], kind="stable")]
    np.testing.assert_allclose(captured[-1], (pair.points1[rows] - K[:2, 2]) / 800.0)
    np.testing.assert_allclose(answer.logits, logits)
    assert pose_error_deg(answer.R, answer.t, pair.R, pair.t) < 3.0


def test_what_is_not_installed_is_listed_and_the_rest_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "pydegensac", None)
    path = write_bundle(tmp_path / "hall.npz", [make_scene()])
    arguments = [str(path), "--bootstrap", "0", "-q", "--methods", "NN + DEGENSAC 1 px"]
    assert main([*arguments, "NN + MAGSAC 1 px"]) == 0
    text = capsys.readouterr().out
    assert "NN + DEGENSAC 1 px: not installed" in text
    assert "NN + MAGSAC 1 px" in text
    assert main(arguments) == 2
    assert "pydegensac" in capsys.readouterr().err


def scored(pair: ScenePair) -> ScenePair:
    """The same matches as a learned matcher gives them: scores, no ratios."""
    assert pair.attributes.ratio is not None
    attributes = dataclasses.replace(pair.attributes, ratio=None)
    return dataclasses.replace(pair, attributes=attributes, match_scores=1 - pair.attributes.ratio**2)


@pytest.mark.parametrize("words", ["NN", "NN + list order"])
def test_order_is_that_of_the_ratio_or_of_the_score_or_of_the_list(
    words: str, pair: ScenePair, monkeypatch: pytest.MonkeyPatch
) -> None:
    genuine, captured = cv2.findEssentialMat, []

    def spy(x1: Any, *args: Any, **kwargs: Any) -> Any:
        captured.append(x1)
        return genuine(x1, *args, **kwargs)

    monkeypatch.setattr(cv2, "findEssentialMat", spy)
    assert pair.attributes.ratio is not None
    ascending = np.argsort(pair.attributes.ratio, kind="stable")
    expected = pair.correspondences[ascending if words == "NN" else np.arange(len(ascending)), :2]
    for one in (pair, scored(pair)):
        assert evaluate_pair(parse_method(f"{words} + PROSAC 0.5 px"), one, 0).error_deg < 5.0
    for x1 in captured:
        np.testing.assert_allclose(x1, expected)
    assert len(captured) == 2
    settings = [parse_method(f"{words} + PROSAC 0.5 px").settings() for words in ("NN", "NN + list order")]
    assert settings[0] != settings[1]


def test_without_ratio_or_score_only_the_order_of_the_list_is_left(pair: ScenePair) -> None:
    unknown = dataclasses.replace(pair, attributes=MatchAttributes())
    assert "ratios" in evaluate_pair(parse_method("NN + PROSAC 0.5 px"), unknown, 0).failure
    assert evaluate_pair(parse_method("NN + list order + PROSAC 0.5 px"), unknown, 0).error_deg < 5.0


def test_poselib_can_be_limited(pair: ScenePair, monkeypatch: pytest.MonkeyPatch) -> None:
    poselib = pytest.importorskip("poselib")
    genuine, options = poselib.estimate_relative_pose, []
    monkeypatch.setattr(poselib, "estimate_relative_pose", lambda *args: options.append(args[4]) or genuine(*args))
    method = parse_method("NN + PoseLib 1 px up to 10000 iterations")
    method.run(pair, 0)
    assert options[0]["max_iterations"] == 10_000
    assert "min_iterations" not in options[0]
    assert method.settings()["estimator"]["max_iterations"] == 10_000
    for name in ("NN + PROSAC 1 px up to 100 iterations", "NN + LMEDS up to 100 iterations"):
        with pytest.raises(ValueError, match="limits PoseLib alone"):
            parse_method(name)


def test_the_filter_sees_scores_as_distances(
    pair: ScenePair, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def spy(points1: Any, points2: Any, matches: Any, **options: Any) -> Any:
        seen.append(matches)
        return filter_matches(points1, points2, matches, **options)

    monkeypatch.setattr("mgca_filter.match_filter.filter_matches", spy)
    one = scored(pair)
    for words in ("product", "product bare"):
        outcome = evaluate_pair(parse_method(words, str(model_file)), one, 0)
        assert outcome.error_deg < 5.0
        assert outcome.status == "ok"
        assert outcome.confidence is not None
        assert 0.5 < outcome.confidence <= 1.0
    assert one.match_scores is not None
    np.testing.assert_allclose([match.distance for match in seen[0]], 1 - one.match_scores, atol=1e-6)
    assert [(match.queryIdx, match.trainIdx) for match in seen[0]] == [(i, i) for i in range(200)]
    assert seen[1] is None


def test_baselines_have_neither_status_nor_confidence(pair: ScenePair) -> None:
    outcome = evaluate_pair(parse_method("NN + PROSAC 0.5 px"), pair, 0)
    assert (outcome.status, outcome.confidence) == ("", None)
    assert PairOutcome.from_json(dataclasses.asdict(outcome)) == outcome
