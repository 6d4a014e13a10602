"""Labels in doubt: who votes, how many it takes, and the command on bundles with a wrong pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Scene, make_scene
from scene_bundles import write_bundle

from benchmarks import doubted_labels as study
from benchmarks.doubted_labels import DETECTORS, Vote, against, main
from benchmarks.match_lists import open_detector_scenes
from mgca_filter.geometry.pose_refinement import apply_step

NAMES = np.array(["a.png", "b.png", "c.png", "d.png"])


def vote(off_deg: float = 40.0, explained: int = 100, by_label: int = 20, turn: float = 0.0) -> Vote:
    R, t = apply_step(np.eye(3), np.array([1.0, 0.0, 0.0]), np.array([turn, 0.0, 0.0, 0.0, 0.0]))
    return Vote("orb2k", R, t, off_deg, explained, by_label)


def mislabelled(scene: Scene) -> Scene:
    R, t = apply_step(scene.R, scene.t, np.array([0.2, 0.3, 0.0, 0.8, 0.0]))
    return replace(scene, R=R, t=t)


def test_a_vote_against_a_label_is_far_from_it_and_explains_far_more() -> None:
    assert vote().contradicts
    assert not vote(off_deg=9.0).contradicts
    assert not vote(by_label=60).contradicts
    assert not vote(explained=12, by_label=0).contradicts


def test_enough_detectors_must_vote_alike() -> None:
    assert len(against([vote()] * DETECTORS)) == DETECTORS
    assert against([vote()] * (DETECTORS - 1)) == []
    assert against([vote(turn=0.2 * k) for k in range(DETECTORS)]) == []  # each for another pose
    assert len(against([vote(turn=0.2), *[vote()] * DETECTORS, vote(off_deg=1.0)])) == DETECTORS
    assert against([]) == []


@pytest.fixture
def bundles(tmp_path: Path) -> Path:
    """Three detectors, two pairs each; the label of the second is wrong."""
    pytest.importorskip("poselib")
    for k, detector in enumerate(("", ".orb2k", ".akaze2k")):
        right, wrong = make_scene(seed=k), mislabelled(make_scene(seed=10 + k))
        write_bundle(tmp_path / f"hall{detector}.npz", [right, wrong], image_name=NAMES)
    return tmp_path


def test_the_wrong_pose_is_found(bundles: Path, capsys: pytest.CaptureFixture[str]) -> None:
    doubted = study.doubted_labels(open_detector_scenes([bundles]))
    assert list(doubted) == [("hall", "c.png", "d.png")]
    assert {one.detector for one in doubted["hall", "c.png", "d.png"]} == {"SIFT-2000", "orb2k", "akaze2k"}
    assert main([str(bundles)]) == 0
    assert capsys.readouterr().out.count("| hall | c.png | d.png |") == 3


def test_two_detectors_raise_no_doubt(bundles: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(bundles / "hall.npz"), str(bundles / "hall.orb2k.npz")]) == 0
    assert capsys.readouterr().out == "No label is in doubt.\n"
    assert main([str(bundles / "missing.npz")]) == 2
    assert "missing.npz" in capsys.readouterr().err
