"""How hard a pair is, and the figures on easier and harder ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.evaluation.difficulty import (
    GROUPINGS,
    UNKNOWN,
    Grouping,
    PairProperties,
    figures_by_difficulty,
    ray_angles_deg,
)
from mgca_filter.evaluation.methods import PairOutcome
from mgca_filter.evaluation.pairs import select_pairs
from mgca_filter.evaluation.predict import predict
from mgca_filter.evaluation.registry import parse_method
from mgca_filter.evaluation.report import format_report
from mgca_filter.evaluation.summarize import summarize
from mgca_filter.inputs.attributes import candidate_mask


@pytest.fixture
def pair(tmp_path: Path) -> ScenePair:
    """60 right matches of 200."""
    return SceneBundle(write_bundle(tmp_path / "hall.npz", [make_scene(right=60, wrong=140)]))[0]


def test_angles_between_rays_by_hand():
    ahead, left, right = [0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]
    matches = np.array([[*ahead, *ahead], [*ahead, *right], [*left, *right]])
    np.testing.assert_allclose(ray_angles_deg(matches, np.eye(3)), [0.0, 45.0, 90.0], atol=1e-6)
    quarter = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # turns straight ahead to the right
    np.testing.assert_allclose(ray_angles_deg(matches[1:2], quarter), [45.0], atol=1e-6)
    assert ray_angles_deg(np.zeros((0, 4)), np.eye(3)).shape == (0,)


def test_properties_of_a_pair(pair: ScenePair):
    truth = np.zeros(len(pair.points1), dtype=bool)
    candidates = np.flatnonzero(candidate_mask(pair.attributes.encode(len(truth))))
    others = np.setdiff1d(np.arange(len(truth)), candidates)
    truth[candidates[:5]] = truth[others[:1]] = True
    properties = PairProperties.of(pair, truth)
    assert properties.inlier_share == pytest.approx(6 / 200)
    assert properties.candidates == len(candidates)
    expected = np.median(ray_angles_deg(pair.correspondences[candidates[:5]], pair.R))
    assert properties.baseline_deg == pytest.approx(expected)
    only = np.isin(np.arange(len(truth)), others[:1])
    expected = ray_angles_deg(pair.correspondences[only], pair.R)[0]
    assert PairProperties.of(pair, only).baseline_deg == pytest.approx(expected)
    assert PairProperties.of(pair, np.zeros_like(truth)).baseline_deg is None


def test_groups_have_their_lower_end():
    grouping = Grouping("share", "inlier_share", (0.05, 0.1), 100.0, " %")
    assert grouping.names == ["below 5 %", "5 – 10 %", "from 10 %"]
    named = [grouping.name_of(PairProperties(share, 1, 1.0)) for share in (0.0, 0.049, 0.05, 0.1, 1.0)]
    assert named == ["below 5 %", "below 5 %", "5 – 10 %", "from 10 %", "from 10 %"]
    assert grouping.name_of(None) == UNKNOWN
    (angle,) = [one for one in GROUPINGS if one.field == "baseline_deg"]
    assert angle.name_of(PairProperties(0.0, 1, None)) == UNKNOWN


def test_figures_of_each_group_by_hand():
    errors = {"ours": {"a": np.array([[1.0, 7.0]]), "b": np.array([[180.0, 2.0]])}}
    errors["theirs"] = {"a": np.array([[180.0, 180.0], [1.0, 180.0]]), "b": np.array([[180.0, 180.0], [1.0, 1.0]])}
    properties = [PairProperties(0.01, 100, 2.0), PairProperties(0.5, 100, 2.0), None, PairProperties(0.01, 900, None)]
    share, candidates, angle = figures_by_difficulty(errors, properties)
    assert share.property == GROUPINGS[0].title
    assert [(group.group, group.pairs) for group in share.groups] == [
        *(("below 5 %", 2), ("from 20 %", 1), (UNKNOWN, 1))
    ]
    low, high, unknown = (group.methods for group in share.groups)
    assert low["ours"] == {"mAP@5": 100.0, "mAP@20": 100.0}
    assert low["theirs"] == {"mAP@5": 50.0, "mAP@20": 50.0}
    assert high["ours"] == {"mAP@5": 0.0, "mAP@20": 75.0}
    assert unknown["ours"] == {"mAP@5": 0.0, "mAP@20": 0.0}
    assert [(group.group, group.pairs) for group in candidates.groups] == [
        *(("below 400", 2), ("from 700", 1), (UNKNOWN, 1))
    ]
    assert [(group.group, group.pairs) for group in angle.groups] == [("below 5°", 2), (UNKNOWN, 2)]


def test_every_pair_is_in_one_group_of_the_report(tmp_path: Path):
    scenes = [make_scene(right=right, wrong=100, seed=right) for right in (4, 30, 100)]
    write_bundle(tmp_path / "hall.npz", scenes)
    results = predict([parse_method("NN + MAGSAC 0.5 px")], select_pairs(tmp_path), seeds=1)
    summary = summarize(results, replicates=0)
    for entry in summary.difficulty:
        assert sum(group.pairs for group in entry.groups) == len(scenes)
        pooled = sum(g.pairs * g.methods["NN + MAGSAC 0.5 px"]["mAP@20"] for g in entry.groups) / len(scenes)
        assert pooled == pytest.approx(summary.rows[-1].pose["mAP@20"])
    text = format_report(summary, "text")
    assert "mAP@20 by share of right matches among the raw ones (number of pairs)" in text
    assert "from 20 % (2)" in text
    outcomes = results["NN + MAGSAC 0.5 px"]["hall"][0]
    assert outcomes[0].properties is not None


def test_outcomes_that_do_not_know_take_it_from_those_that_do():
    known = PairProperties(0.3, 600, 20.0)
    nothing = (0.0, 0.0, 0.0)

    def outcome(properties: PairProperties | None) -> PairOutcome:
        return PairOutcome(0, 180.0, None, None, nothing, nothing, "no pose", properties=properties)

    results = {"old": {"hall": [[outcome(None)]]}, "new": {"hall": [[outcome(None)], [outcome(known)]]}}
    groups = [table.groups[0].group for table in summarize(results, replicates=0).difficulty]
    assert groups == ["from 20 %", "500 – 700", "15 – 30°"]
