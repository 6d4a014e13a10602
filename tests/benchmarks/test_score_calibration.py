"""The study of scores and ``keep_precision``, on scores whose truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks import score_calibration
from benchmarks.score_calibration import KINDS, InputKind, ScoredPair, calibration_cells, precision_cells, score_pairs
from mgca_filter import filter_matches
from mgca_filter.evaluation.pairs import select_pairs


def scored(scores: list[float], right: list[bool]) -> ScoredPair:
    return ScoredPair(np.array(scores, dtype=np.float32), np.array(right))


def test_precision_is_asked_and_reached() -> None:
    pairs = [scored([0.92] * 10 + [0.1] * 10, [True] * 9 + [False] * 11), scored([0.85] * 4, [True] * 2 + [False] * 2)]
    # Of both pairs 14 matches are kept, 11 of them right; the pairs have 90 and 50 per cent.
    assert precision_cells("raw", pairs, 0.8) == ["raw", "80.0", "78.6", "70.0", "100.0", "0.0"]
    assert precision_cells("raw", pairs, 0.9) == ["raw", "90.0", "90.0", "90.0", "81.8", "50.0"]
    assert precision_cells("raw", pairs, 0.99) == ["raw", "99.0", "0.0", "0.0", "0.0", "100.0"]


def test_calibration_error_of_all_and_of_those_in_doubt() -> None:
    pairs = [scored([0.0] * 90 + [0.9] * 10, [False] * 90 + [True] * 5 + [False] * 5)]
    assert calibration_cells("raw", pairs) == ["raw", "1", "100", "0.040", "10", "0.400"]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_scores_are_those_of_filter_matches(kind: InputKind, tmp_path: Path, model_file: Path) -> None:
    bundle = write_bundle(tmp_path / "hall.npz", [make_scene(seed=0)])
    pair = select_pairs(bundle)[0].source[0]
    (one,) = score_pairs([pair], kind, str(model_file))
    rows = np.flatnonzero(kind.selection.apply(pair))
    attributes = None if kind.bare else pair.attributes.take(rows)
    result = filter_matches(
        pair.points1[rows],
        pair.points2[rows],
        None,
        K1=pair.K1,
        K2=pair.K2,
        attributes=attributes,
        model=model_file,
        method="none",
    )
    np.testing.assert_array_equal(one.scores, result.scores)
    assert 0 < np.count_nonzero(one.truth) <= len(rows)


def test_command_has_a_row_for_every_kind_and_precision(
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bundle(tmp_path / "hall.npz", [make_scene(seed=0), make_scene(seed=1)])
    assert score_calibration.main([str(tmp_path), "--model", str(model_file), "--per-scene", "1"]) == 0
    calibration, precision = capsys.readouterr().out.split("\n\n")
    assert [row.split(" | ")[:2] for row in calibration.splitlines()[2:]] == [[f"| {kind.name}", "1"] for kind in KINDS]
    assert len(precision.splitlines()) == 2 + len(KINDS) * len(score_calibration.ASKED)
    assert score_calibration.main([str(tmp_path / "none")]) == 2
