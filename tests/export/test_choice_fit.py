"""The fit of the confidence: what it recovers, which lists it asks, and what it writes."""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from conftest import build_model, make_scene
from scene_bundles import write_bundle

from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import SceneBundle
from mgca_filter.export import choice_fit, pairs_apart
from mgca_filter.export.choice_fit import (
    Sample,
    area_under_roc,
    cross_validated,
    fit_logistic,
    kinds_of,
    probabilities,
    sound_scenes,
    unrelated_pairs,
    usable_from,
    write_into,
)
from mgca_filter.fit import choice
from mgca_filter.fit.choice import EARLY_FEATURES, FEATURES, fitted_coefficients
from mgca_filter.inference.model_file import SUMS_NAME, ModelFile, read_checksums, record_checksums
from mgca_filter.inputs.attributes import MatchAttributes


def drawn(count: int, weights: list[float], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Features (N, D) on unlike scales, and what a logistic model of these weights and offset says of them."""
    rng = np.random.default_rng(seed)
    features = rng.normal([3.0, -20.0], [0.5, 10.0], (count, 2))
    p = 1.0 / (1.0 + np.exp(-(features @ weights[:-1] + weights[-1])))
    return features, rng.random(count) < p


def test_known_weights_are_found_again() -> None:
    truth = [1.5, 0.08, -2.5]
    features, right = drawn(60_000, truth)
    found = fit_logistic(features, right, np.ones(len(right)))
    np.testing.assert_allclose(found[:2], truth[:2], rtol=0.12)  # the ridge shrinks them a little
    p = probabilities(found, features)
    assert p.mean() == pytest.approx(right.mean(), abs=0.002)
    assert np.abs(p - probabilities(np.array(truth), features)).max() < 0.06


def test_a_sample_of_weight_two_counts_twice() -> None:
    features, right = drawn(300, [1.0, 0.1, -1.0])
    weight = np.where(np.arange(300) < 100, 2.0, 1.0)
    repeated = np.concatenate([np.arange(300), np.arange(100)])
    heavy = probabilities(fit_logistic(features, right, weight), features)
    twice = probabilities(fit_logistic(features[repeated], right[repeated], np.ones(400)), features)
    assert np.abs(heavy - twice).max() < 0.02
    assert np.abs(heavy - probabilities(fit_logistic(features, right, np.ones(300)), features)).max() > 0.001


def test_separable_samples_do_not_diverge() -> None:
    features = np.linspace(-1, 1, 40)[:, None]
    found = fit_logistic(features, features[:, 0] > 0, np.ones(40))
    assert np.isfinite(found).all()
    p = probabilities(found, features)
    assert (np.diff(p) > 0).all()


def test_a_group_is_never_judged_by_its_own_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    features, right = drawn(200, [1.0, 0.1, -1.0])
    features[:, 0] = np.arange(200)  # tells who is in
    groups = [f"scene {i // 10}" for i in range(200)]
    fitted: list[set[str]] = []
    fit = choice_fit.fit_logistic

    def fit_and_note(chosen, *rest):
        fitted.append({groups[int(row)] for row in chosen[:, 0]})
        return fit(chosen, *rest)

    judged: list[set[str]] = []

    def note(weights, chosen):
        judged.append({groups[int(row)] for row in chosen[:, 0]})
        return probabilities(weights, chosen)

    monkeypatch.setattr(choice_fit, "fit_logistic", fit_and_note)
    monkeypatch.setattr(choice_fit, "probabilities", note)
    p = cross_validated(features, right, np.ones(200), groups)
    assert len(fitted) == len(judged) == choice_fit.FOLDS
    for train, test in zip(fitted, judged):
        assert not train & test
        assert train | test == set(groups)
    assert set.union(*judged) == set(groups)
    assert ((p > 0) & (p < 1)).all()


def test_area_under_roc_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(0)
    p, right = rng.random(80), rng.random(80) < 0.4
    pairs = p[right][:, None] > p[~right][None]
    assert area_under_roc(p, right) == pytest.approx(pairs.mean())
    assert area_under_roc(right.astype(float), right) == 1.0


def test_usable_is_the_least_confidence_of_that_precision() -> None:
    p = np.linspace(0, 1, 1001)
    limit = usable_from(p, np.arange(1001) >= 620)
    assert limit == pytest.approx(0.61, abs=0.011)
    right = np.arange(1001) >= 620
    assert right[p >= limit].mean() >= choice_fit.OK_PRECISION > right[p >= limit - 0.02].mean()
    assert usable_from(p, np.ones(1001, dtype=bool)) == 0.3
    assert usable_from(p, np.zeros(1001, dtype=bool)) == 0.95


def test_lists_are_those_that_users_make(tmp_path: Path) -> None:
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", [make_scene()]))[0]
    mutual = np.arange(200) % 2 == 0
    pair = replace(pair, mutual=mutual)
    lists = dict(kinds_of(pair))
    ratio = pair.attributes.ratio
    assert list(lists) == list(choice_fit.KINDS)
    for kind, kept in (
        ("raw", np.ones(200, dtype=bool)),
        ("cross", mutual),
        ("ratio", ratio < choice_fit.PLAIN_RATIO),
        ("cross and ratio", mutual & (ratio < choice_fit.CROSS_RATIO)),
    ):
        np.testing.assert_array_equal(lists[kind].points1, pair.points1[kept])
        np.testing.assert_array_equal(lists[kind].attributes.ratio, ratio[kept])
    assert lists["cross"].attributes.best.all()
    none = dict(kinds_of(replace(pair, mutual=np.zeros(200, dtype=bool))))
    assert list(none) == ["raw", "ratio"]  # fewer than eight are no list
    bare = dict(kinds_of(replace(pair, attributes=MatchAttributes(best=pair.attributes.best))))
    assert list(bare) == ["raw", "cross"]


def test_samples_know_whether_they_are_right(model_file: Path) -> None:
    scene = make_scene(right=120, wrong=120)
    from conftest import K

    from mgca_filter import MatchPair

    pair = MatchPair(scene.points1, scene.points2, None, K, attributes=scene.attributes)
    match_filter = MatchFilter(model=model_file, effort="full")
    for pose, right in (((scene.R, scene.t), True), ((scene.R.T, scene.t), False), (None, False)):
        samples = choice_fit.samples_of(pair, pose, "hall", [match_filter])
        assert [sample.early for sample in samples] == [True, False, False]  # early, as it ends, with all sources
        assert {sample.right for sample in samples} == {right}
        assert [len(s.features) for s in samples] == [len(EARLY_FEATURES), len(FEATURES), len(FEATURES)]
        assert all(np.isfinite(sample.features).all() for sample in samples)


def test_quality_table_says_which_scenes_are_sound(tmp_path: Path) -> None:
    assert sound_scenes(tmp_path) is None
    (tmp_path / "QUALITY.csv").write_text("scene,share_within_2px\nhall,0.99\nyard,0.5\nroof,\n", encoding="utf-8")
    assert sound_scenes(tmp_path) == {"hall", "roof"}


def test_photographs_of_different_places_have_no_pose(tmp_path: Path) -> None:
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 256, (30, 40), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"{seed}.png"), cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC))
    pairs = list(unrelated_pairs(tmp_path, 2, seed=0))
    assert len(pairs) == 4  # each raw and filtered
    assert len({name for name, _ in pairs}) == 4
    for _, pair in pairs:
        focal = pairs_apart.PLAUSIBLE_FOCAL_FACTOR * 320
        np.testing.assert_allclose(pair.K1, [[focal, 0, 159.5], [0, focal, 119.5], [0, 0, 1]])
    again = [name for name, _ in unrelated_pairs(tmp_path, 2, seed=0)]
    assert again == [name for name, _ in pairs]


def test_lists_without_overlap_are_all_wrong(tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(2):
        noise = np.random.default_rng(seed).integers(0, 256, (60, 80), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"{seed}.png"), cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC))
    monkeypatch.setattr(choice_fit, "APART_DETECTORS", (("sift", 100), ("orb", 100)))
    groups = [group for group, _ in choice_fit.apart_lists(tmp_path, 2, seed=0)]
    assert {group.split()[0] for group in groups} == {choice_fit.APART}
    assert {"apart 0", "apart 1", "apart world 0"} == set(groups)
    assert groups.count("apart world 0") >= 2  # of either detector
    options = argparse.Namespace(
        bundles=[], exclude=[], per_scene=1, seed=0, photos=tmp_path, unrelated=0, apart=2, model=model_file
    )
    samples = choice_fit.collect(options, [MatchFilter(model=model_file, effort="full")])
    assert {sample.group for sample in samples} <= set(groups)
    assert len(samples) > 6
    assert not any(sample.right for sample in samples)
    options.apart = 0
    assert choice_fit.collect(options, [MatchFilter(model=model_file, effort="full")]) == []


def test_the_limit_for_pairs_without_overlap_is_told() -> None:
    p = np.linspace(0.0, 1.0, 1001)
    apart = np.arange(1001) < 801
    right = ~apart
    said = choice_fit.describe_apart(p, right, apart, usable=0.4)
    assert said.startswith("without overlap: 50.1 % of 801 lists are ok; at most 5 % from 0.76 on, with 100.0 %")
    # A limit that is stricter already stays.
    assert "0.0 % of 801 lists are ok; at most 5 % from 0.90 on, with 50.5 %" in choice_fit.describe_apart(
        p, right, apart, usable=0.9
    )


def properties(path: Path) -> dict[str, str]:
    return {entry.key: entry.value for entry in onnx.load(str(path)).metadata_props}


def test_writing_changes_one_key_and_the_checksums(tmp_path: Path) -> None:
    from safetensors import safe_open
    from safetensors.numpy import load_file, save_file

    path = build_model(tmp_path / "m.onnx")
    weights = path.with_suffix(".safetensors")
    tensors = {"w": np.arange(6, dtype=np.float32).reshape(2, 3)}
    save_file(tensors, str(weights), {"name": "tiny", "choice": "{}"})
    record_checksums(tmp_path)
    before, graph = properties(path), onnx.load(str(path)).graph.SerializeToString()
    changed = {**fitted_coefficients(), "verdict": [0.2, 0.6]}
    write_into(path, changed)
    after = properties(path)
    assert json.loads(after.pop("choice")) == changed
    before.pop("choice")
    assert after == before
    assert onnx.load(str(path)).graph.SerializeToString() == graph
    with safe_open(str(weights), "np") as file:
        assert file.metadata() == {"name": "tiny", "choice": json.dumps(changed)}
    np.testing.assert_array_equal(load_file(str(weights))["w"], tensors["w"])
    sums = read_checksums(tmp_path)
    assert sums[path.name] == ModelFile.read(path).sha256
    assert MatchFilter(model=path).metadata.choice == choice.check_coefficients(changed)


def test_writing_makes_no_files_that_were_not_there(tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx")
    write_into(path, fitted_coefficients())
    assert [p.name for p in tmp_path.iterdir()] == ["m.onnx"]
    assert not (tmp_path / SUMS_NAME).exists()


def test_the_command_fits_tells_and_writes(
    tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = Path(shutil.copy(model_file, tmp_path / "m.onnx"))
    target = tmp_path / "choice.json"
    monkeypatch.setattr(choice_fit, "COEFFICIENTS_FILE", target)
    rng = np.random.default_rng(0)

    def sample(i: int, early: bool) -> Sample:
        right = i % 3 > 0
        features = rng.normal(2.0 * right, 1.0, len(EARLY_FEATURES if early else FEATURES))
        return Sample(features, right, "apart 0" if i % 12 == 9 else f"scene {i % 12}", early)

    asked = []
    monkeypatch.setattr(
        choice_fit,
        "collect",
        lambda options, f: asked.append(f[0].options) or [sample(i, i % 2 == 0) for i in range(600)],
    )
    assert choice_fit.main([str(tmp_path), "--model", str(model), "--write"]) == 0
    assert asked[0].effort == "full"
    written = choice.check_coefficients(json.loads(target.read_text(encoding="utf-8")))
    assert json.loads(properties(model)["choice"]) == written
    fixed = fitted_coefficients()
    changed = {name for name in written if written[name] != fixed[name]}
    assert {"confidence", "early_confidence"} <= changed <= {"confidence", "early_confidence", "verdict"}
    shown = capsys.readouterr().out
    assert "early_confidence: 300 lists" in shown
    assert "ok from" in shown
    assert "without overlap: " in shown
    untouched = target.read_bytes()
    assert choice_fit.main(["--model", str(model), "--write"]) == 0  # without lists it writes what is there
    assert target.read_bytes() == untouched


def test_excluded_and_unsound_scenes_are_left_out(tmp_path: Path, model_file: Path) -> None:
    for seed, name in enumerate(("hall", "yard", "roof", "hall.lightglue")):
        write_bundle(tmp_path / f"{name}.npz", [make_scene(seed=seed)])
    (tmp_path / "QUALITY.csv").write_text("scene,share_within_2px\nhall,0.99\nyard,0.5\nroof,0.97\n", encoding="utf-8")
    options = argparse.Namespace(
        bundles=[tmp_path], exclude=["roof"], per_scene=1, seed=0, photos=None, unrelated=0, apart=0, model=model_file
    )
    samples = choice_fit.collect(options, [MatchFilter(model=model_file, effort="full")])
    assert {sample.group for sample in samples} == {"hall"}
