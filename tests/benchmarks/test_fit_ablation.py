"""The study of the robust fit's pieces: its first row is what users get, and each other row changes something."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks.fit_ablation import (
    AS_IT_IS,
    REPLACED,
    VARIANTS,
    ScoredPair,
    Times,
    Variant,
    format_study,
    main,
    origin_table,
)
from mgca_filter import MatchFilter
from mgca_filter.evaluation.our_rows import filter_pair
from mgca_filter.evaluation.pairs import select_pairs
from mgca_filter.geometry.epipolar import pose_error_deg


@pytest.fixture
def scored(tmp_path: Path, model_file: Path) -> ScoredPair:
    write_bundle(tmp_path / "hall.npz", [make_scene(seed=4)])
    return ScoredPair.of(select_pairs(tmp_path)[0].source[0], [MatchFilter(model=model_file, effort="full")])


@pytest.mark.parametrize(("variant", "options"), [(AS_IT_IS, {}), ("no end before the network", {"effort": "full"})])
def test_the_fit_as_it_is_is_what_the_filter_does(
    scored: ScoredPair, model_file: Path, variant: str, options: dict[str, str]
) -> None:
    pair = scored.pair
    result = filter_pair(pair, np.arange(len(pair.points1)), str(model_file), options)
    model, network_ms = scored.fit(VARIANTS[variant])
    assert model is not None
    assert network_ms == (0.0 if model.ended == "before the network" else scored.network_ms[0])
    np.testing.assert_array_equal(model.R, result.R)
    assert scored.error_deg(model) == pose_error_deg(result.R, result.t, pair.R, pair.t)
    assert model.ended == result.info["ended"]


@pytest.mark.parametrize(("variant", "model"), [(AS_IT_IS, None), ("the fast network alone", "fast")])
@pytest.mark.parametrize("right", [12, 40])
def test_the_networks_are_asked_as_the_filter_asks_them(
    tmp_path: Path, variant: str, model: str | None, right: int
) -> None:
    write_bundle(tmp_path / "hall.npz", [make_scene(right=right, wrong=300, seed=2)])
    pair = select_pairs(tmp_path)[0].source[0]
    scored = ScoredPair.of(pair, [MatchFilter(model=name, effort="full") for name in ("fast", None)])
    result = filter_pair(pair, np.arange(len(pair.points1)), model, {})
    found, network_ms = scored.fit(VARIANTS[variant])
    assert found is not None
    assert network_ms == scored.network_ms[len(result.info["networks"]) - 1]
    np.testing.assert_array_equal(found.E, result.info["fitted_essential"])
    assert found.ended == result.info["ended"]


def test_every_variant_but_the_first_changes_something() -> None:
    assert [name for name, variant in VARIANTS.items() if variant == Variant()] == [AS_IT_IS]
    assert len({repr(variant) for variant in VARIANTS.values()}) == len(VARIANTS)


def test_the_table_has_means_and_differences() -> None:
    good, bad = np.array([[1.0, 2.0]]), np.array([[1.0, 180.0]])
    errors = {AS_IT_IS: {"a": good, "b": good}, REPLACED: {"a": bad, "b": good}}
    table = format_study(errors, {AS_IT_IS: Times([4.0, 6.0], [30.0, 10.0]), REPLACED: Times([10.0], [0.0])})
    first, second = table.splitlines()[2:]
    assert first == f"| {AS_IT_IS} | 100.0 | 100.0 | 80.0 |  |  | 5.0 | 2.50 |"
    assert second.startswith(f"| {REPLACED} | 75.0 | 75.0 | 62.5 | -25.0 [-50.0, +0.0] | -17.5 [")
    assert second.endswith("] | 10.0 | 1.00 |")


def test_origins_are_counted(scored: ScoredPair) -> None:
    model, _ = scored.fit(VARIANTS[AS_IT_IS])
    rows = origin_table([model, model, model, None], [1.0, 2.0, 30.0, 180.0]).splitlines()[2:]
    assert rows[0].endswith("| 75 % | 67 % |")
    assert rows[1] == "| none | 25 % | 0 % |"


def test_command(tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("poselib")
    write_bundle(tmp_path / "hall.npz", [make_scene(seed=4)])
    assert main([str(tmp_path / "hall.npz"), "--model", str(model_file), "--seeds", "0", "1"]) == 0
    study, origins = capsys.readouterr().out.split("\n\n")
    assert study.count("\n| ") == len(VARIANTS) + 1
    assert "100 %" in origins
    chosen = ["--kinds", "raw", "cross-ratio", "--variants", "PROSAC alone", "--detectors", "SIFT-2000"]
    assert main([str(tmp_path), "--model", str(model_file), *chosen]) == 0
    study, origins = capsys.readouterr().out.split("\n\n")
    assert [row.split(" | ")[0] for row in study.splitlines()[2:]] == [
        *(f"| {AS_IT_IS}", "| PROSAC alone", f"| {REPLACED}")
    ]
    assert "100 %" in origins
    assert main([str(tmp_path / "missing.npz")]) == 2
    assert "missing.npz" in capsys.readouterr().err
