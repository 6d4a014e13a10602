"""What the studies share: errors in one line, pairs as they were drawn, two methods side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import learned_fields, write_bundle

from benchmarks.study import drawn_pairs, match_pair, paired_cells, result_error_deg, run_study, study_parser
from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import SceneBundle
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.metrics import FAILURE_DEG, POSE_STATISTICS
from mgca_filter.evaluation.pairs import iterate_pairs, select_pairs


@pytest.mark.parametrize(
    "error", [DatasetError("a.npz: torn"), ValueError("N"), ImportError("no h5py"), OSError("full")]
)
def test_what_cannot_be_used_is_one_line(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    def run(options: argparse.Namespace) -> int:
        raise error

    assert run_study(run, argparse.Namespace()) == 2
    assert capsys.readouterr().err == f"error: {error}\n"


def test_a_fault_of_the_study_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        run_study(lambda options: 1 // 0, argparse.Namespace())


def test_a_learned_matchers_scores_reach_the_filter_as_distances(tmp_path: Path) -> None:
    scene = make_scene()
    pair = SceneBundle(write_bundle(tmp_path / "hall.npz", [scene], **learned_fields([scene])))[0]
    given = match_pair(pair)
    assert pair.match_scores is not None
    np.testing.assert_allclose([match.distance for match in given.matches], 1 - pair.match_scores, atol=1e-6)
    assert MatchFilter().filter_many([given])[0].ok
    assert match_pair(SceneBundle(write_bundle(tmp_path / "yard.npz", [scene]))[0]).matches is None


def test_studies_run_on_one_thread_and_leave_the_others_as_they_were() -> None:
    before = cv2.getNumThreads()
    assert run_study(lambda options: cv2.getNumThreads(), argparse.Namespace()) == 1
    assert cv2.getNumThreads() == before


def test_options_draw_the_pairs(tmp_path: Path) -> None:
    write_bundle(tmp_path / "hall.npz", [make_scene(seed=seed, right=20, wrong=5) for seed in range(6)])
    parser = study_parser("verdicts", "Words.")
    parser.add_argument("bundles")
    options = parser.parse_args([str(tmp_path), "--per-scene", "2", "--seed", "5"])
    (drawn,) = drawn_pairs(options)
    assert drawn.indices == select_pairs(tmp_path, None, 2, 5)[0].indices
    assert len(drawn_pairs(parser.parse_args([str(tmp_path)]))[0]) == 6
    with pytest.raises(SystemExit):
        study_parser("detectors", "Words.", per_scene=False).parse_args(["--per-scene", "2"])


def test_the_filter_gets_all_that_is_known_of_a_pair(tmp_path: Path, match_filter: MatchFilter) -> None:
    write_bundle(tmp_path / "hall.npz", [make_scene()])
    (pair,) = iterate_pairs(select_pairs(tmp_path))
    given = match_pair(pair)
    assert (given.size1, given.size2) == (pair.image_size1, pair.image_size2)
    np.testing.assert_array_equal(given.K2, pair.K2)
    assert given.attributes is pair.attributes
    assert result_error_deg(match_filter.filter_many([given])[0], pair) < 1.0
    assert result_error_deg(match_filter.filter(pair.points1[:4], pair.points2[:4], None), pair) == FAILURE_DEG


def test_paired_cells_tell_figures_difference_and_interval() -> None:
    good, bad = np.full((1, 20), 1.0), np.full((1, 20), 90.0)
    statistic = POSE_STATISTICS["mAP@5"]
    assert paired_cells(good, good, statistic) == ["100.0", "100.0", "+0.0 [+0.0, +0.0]"]
    assert paired_cells(bad, good, statistic) == ["0.0", "100.0", "-100.0 [-100.0, -100.0]"]
    half = np.where(np.arange(20) < 10, 1.0, 90.0)[None]
    cells = paired_cells(half, bad, statistic)
    assert cells[:2] == ["50.0", "0.0"]
    assert cells[2].startswith("+50.0 [+")
