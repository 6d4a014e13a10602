"""The study of a matcher's own confidence: its parts by hand, and the command on tiny bundles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import learned_fields, write_bundle

from benchmarks import matcher_confidence as study
from benchmarks.matcher_confidence import CONFIDENCE, NETWORK, ListedPair, Replaced
from mgca_filter.inference import shared_backend
from mgca_filter.match_filter import MatchFilter, model_path


def listed(scene: str, seed: int) -> ListedPair:
    """A hundred matches of which the confidence tells much and the network nothing."""
    rng = np.random.default_rng(seed)
    truth = rng.random(100) < 0.5
    told = {NETWORK: rng.normal(size=100), CONFIDENCE: 2.0 * truth - 1.0 + rng.normal(0.0, 0.5, 100)}
    return ListedPair(scene, None, told, truth)  # type: ignore[arg-type]


def test_average_precision_of_a_ranking() -> None:
    truth = np.array([True, False, True])
    assert study.average_precision(np.array([0.9, 0.8, 0.7]), truth) == pytest.approx((1.0 + 2.0 / 3.0) / 2.0)
    assert study.average_precision(np.array([0.9, 0.1, 0.7]), truth) == 1.0


def test_each_half_is_judged_by_the_other() -> None:
    pairs = [listed("hall", 0), listed("yard", 1)]
    backwards = ListedPair("yard", None, pairs[1].log_odds, ~pairs[1].truth)  # type: ignore[arg-type]
    told = study.cross_fitted(pairs, [CONFIDENCE])
    assert study.average_precision(told[0], pairs[0].truth) > 0.95
    of_the_other = study.cross_fitted([pairs[0], backwards], [CONFIDENCE])[0]
    assert study.average_precision(of_the_other, pairs[0].truth) < 0.5
    useless = study.cross_fitted(pairs, [NETWORK])
    assert float(study.score_cells("", pairs, useless)[1]) > 2.0 * float(study.score_cells("", pairs, told)[1])


def test_replaced_scores_are_those_of_the_result(scene) -> None:
    backend = Replaced(shared_backend(model_path("fast"), "auto", None))
    asked = MatchFilter.over(backend)
    asked.options = MatchFilter(method="none").options
    before = asked.filter(scene.points1, scene.points2, None).scores
    backend.probabilities = np.linspace(0.1, 0.9, len(scene.points1))
    after = asked.filter(scene.points1, scene.points2, None).scores
    np.testing.assert_allclose(after, backend.probabilities, atol=1e-5)
    assert np.abs(after - before).max() > 0.1


def test_the_command_prints_both_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("hall", 0), ("yard", 3)):
        scenes = [make_scene(right=60, wrong=80, seed=seed + i) for i in range(3)]
        write_bundle(tmp_path / f"{name}.aliked_lightglue.npz", scenes, **learned_fields(scenes))
        write_bundle(tmp_path / f"{name}.npz", scenes)
    assert study.main([str(tmp_path), "--per-scene", "2"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("4 lists of 2 scenes, ")
    assert all(printed.count(f"| regression on {name} |") == 4 for name in study.INFORMED)
    assert study.main([str(tmp_path / "hall.npz")]) == 2
    assert "learned matchers' lists of two scenes" in capsys.readouterr().err
