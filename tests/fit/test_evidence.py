"""What is known of a pair before a model is fitted: order, distinct matches, keypoints that bear witness once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import Scene, make_scene
from fit_inputs import before, normalized, permuted, prepared, scored
from hypothesis import given
from hypothesis import strategies as st

from mgca_filter.fit.evidence import (
    FIRM_MATCHES,
    MIN_ACCEPTED,
    RAW_MAX_RATIO,
    distinct_rows,
    first_of_each,
    gather_scored,
    listed_rows,
    match_order,
    one_to_one,
)
from mgca_filter.inputs.attributes import MatchAttributes

GRID = st.lists(st.tuples(*[st.sampled_from([0.0, 1.0, 2.0])] * 4), max_size=30)


@given(st.lists(st.tuples(*[st.sampled_from([-1.0, -0.0, 0.0, 0.5])] * 3), max_size=30))
def test_distinct_rows_are_those_of_numpy(values: list[tuple[float, ...]]) -> None:
    rows = np.array(values).reshape(-1, 3)
    expected, first = np.unique(rows, axis=0, return_index=True)
    np.testing.assert_array_equal(distinct_rows(rows), first)
    np.testing.assert_array_equal(rows[distinct_rows(rows)], expected)
    np.testing.assert_array_equal(first_of_each(rows), np.sort(first))


@given(GRID)
def test_one_to_one_holds_every_keypoint_once(values: list[tuple[float, ...]]) -> None:
    rows = np.array(values).reshape(-1, 4)
    rows = rows[np.sort(distinct_rows(rows))]
    chosen = one_to_one(rows)
    for part in (rows[chosen, :2], rows[chosen, 2:]):
        assert len(np.unique(part, axis=0)) == np.count_nonzero(chosen)
    assert chosen[:1].all()  # the best of all stands in no better one
    assert one_to_one(rows[chosen]).all()
    # What is left out shares a keypoint with a better match.
    for i in np.flatnonzero(~chosen):
        assert any((rows[j, :2] == rows[i, :2]).all() or (rows[j, 2:] == rows[i, 2:]).all() for j in range(i))


def test_of_the_matches_of_one_keypoint_the_best_bears_witness(scene: Scene) -> None:
    target = int(np.argmin(scene.attributes.ratio))
    crowd = np.flatnonzero(~scene.inlier)[:15]
    points2 = scene.points2.copy()
    points2[crowd] = points2[target]
    evidence = scored(replace(scene, points2=points2))
    assert len(evidence) == 200
    witnesses = evidence.rows[evidence.once]
    assert target in witnesses
    assert not set(crowd.tolist()) & set(witnesses.tolist())
    assert len(witnesses) == 185


@pytest.mark.parametrize("after", [before, scored])
def test_a_match_that_is_listed_twice_counts_once(after, scene: Scene) -> None:
    twice = permuted(scene, np.repeat(np.arange(200), 2))
    one, other = after(scene), after(twice)
    np.testing.assert_array_equal(one.correspondences, other.correspondences)
    np.testing.assert_array_equal(2 * one.rows, other.rows)


@pytest.mark.parametrize("after", [before, scored])
def test_permuting_the_list_permutes_the_rows_alone(after, scene: Scene) -> None:
    order = np.random.default_rng(0).permutation(200)
    one, other = after(scene), after(permuted(scene, order))
    for name in ("correspondences", "once", "listed", "order", "scores", "margins"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.rows, order[other.rows])


def test_before_the_network_the_ratio_orders(scene: Scene) -> None:
    evidence = before(scene)
    np.testing.assert_array_equal(evidence.rows, np.argsort(scene.attributes.ratio, kind="stable"))
    np.testing.assert_allclose(evidence.correspondences, normalized(scene)[evidence.rows], atol=1e-12)
    assert evidence.scores is None
    np.testing.assert_array_equal(evidence.accepted(), np.arange(200))
    np.testing.assert_array_equal(evidence.above(0.0), np.arange(200))
    np.testing.assert_array_equal(evidence.by_list_order(), evidence.correspondences)


def test_a_list_that_nothing_orders_keeps_its_order(scene: Scene) -> None:
    bare = replace(scene, attributes=MatchAttributes())
    np.testing.assert_array_equal(before(bare).rows, np.arange(200))


def test_rows_without_coordinates_bear_no_witness(scene: Scene) -> None:
    points1 = scene.points1.copy()
    points1[:7] = np.nan
    evidence = before(replace(scene, points1=points1))
    assert sorted(evidence.rows.tolist()) == list(range(7, 200))
    assert np.isfinite(evidence.correspondences).all()


def raw(scene: Scene, lost: int = 40) -> Scene:
    """The scene as a raw list: some matches reach for a keypoint that another one holds."""
    best = np.ones(200, dtype=bool)
    best[np.flatnonzero(~scene.inlier)[:lost]] = False
    return replace(scene, attributes=replace(scene.attributes, best=best))


def test_a_filtered_list_counts_whole_and_a_raw_one_where_it_is_clear(scene: Scene) -> None:
    pair = prepared(scene)
    assert listed_rows(pair.attributes, pair.valid).all()
    crowded = raw(scene)
    pair = prepared(crowded)
    listed = listed_rows(pair.attributes, pair.valid)
    np.testing.assert_array_equal(listed, crowded.attributes.best & (crowded.attributes.ratio < RAW_MAX_RATIO))
    assert set(before(crowded).rows.tolist()) == set(np.flatnonzero(listed).tolist())
    # Once scores are known all matches may be sampled, and those of a classical list stay marked.
    evidence = scored(crowded)
    assert len(evidence) == 200
    np.testing.assert_array_equal(evidence.listed, listed[evidence.rows])
    assert len(evidence.by_list_order()) == np.count_nonzero(listed)


def test_a_raw_list_of_which_too_little_is_left_counts_whole(scene: Scene) -> None:
    best = np.zeros(200, dtype=bool)
    for left, expected in ((FIRM_MATCHES - 1, 200), (FIRM_MATCHES, FIRM_MATCHES)):
        best[np.argsort(scene.attributes.ratio)[:left]] = True
        pair = prepared(replace(scene, attributes=replace(scene.attributes, best=best)))
        assert np.count_nonzero(listed_rows(pair.attributes, pair.valid)) == expected


def test_order_mixes_score_and_ratio() -> None:
    margins = np.array([2.0, 4.0, 4.0, -2.0], dtype=np.float32)
    ratio = np.array([0.3, 0.9, 0.5, 0.1], dtype=np.float32)
    known = np.ones(4, dtype=bool)
    assert match_order(margins, ratio, known).tolist() == [0, 2, 1, 3]
    assert match_order(margins, ratio, ~known).tolist() == [1, 2, 0, 3]


def test_scores_travel_with_their_matches(scene: Scene) -> None:
    margins = np.random.default_rng(0).normal(0, 3, 200).astype(np.float32)
    evidence = scored(scene, margins)
    np.testing.assert_array_equal(evidence.margins, margins[evidence.rows])
    np.testing.assert_allclose(evidence.scores, 1 / (1 + np.exp(-margins[evidence.rows])), rtol=1e-5)
    np.testing.assert_allclose(evidence.correspondences, normalized(scene)[evidence.rows], atol=1e-12)
    quality = evidence.scores * (1.2 - scene.attributes.ratio[evidence.rows])
    assert (np.diff(quality) <= 1e-6).all()


def test_only_what_entered_the_network_bears_witness(scene: Scene) -> None:
    candidates = np.arange(0, 200, 2)
    scores = np.full(200, 0.5, dtype=np.float32)
    evidence = gather_scored(prepared(scene), candidates, scores, scores, None)
    assert sorted(evidence.rows.tolist()) == candidates.tolist()


def test_above_a_margin_or_the_best_of_all(scene: Scene) -> None:
    margins = np.random.default_rng(1).permutation(np.linspace(-1, 1, 200)).astype(np.float32)
    evidence = scored(scene, margins)
    best = np.sort(margins)[-MIN_ACCEPTED]
    for margin, expected in ((0.0, margins > 0), (0.9, margins >= best)):
        chosen = evidence.above(margin)
        assert (np.diff(chosen) > 0).all()  # best first, as all of the evidence
        assert set(evidence.rows[chosen].tolist()) == set(np.flatnonzero(expected).tolist())
    scores = 1 / (1 + np.exp(-margins))
    assert set(evidence.rows[evidence.accepted()].tolist()) == set(np.flatnonzero(scores > 0.3).tolist())
    hopeless = scored(scene, margins - 9.0)
    assert set(hopeless.rows[hopeless.accepted()].tolist()) == set(np.flatnonzero(margins >= best).tolist())


def test_without_intrinsics_the_evidence_says_so(scene: Scene) -> None:
    assert before(scene).calibrated
    assert not before(scene, calibrated=False).calibrated
    assert not scored(scene, calibrated=False).calibrated


def test_nothing_to_gather() -> None:
    for evidence in (before(make_scene(right=0, wrong=0)), scored(make_scene(right=0, wrong=0))):
        assert len(evidence) == 0
        assert evidence.correspondences.shape == (0, 4)
        assert len(evidence.accepted()) == len(evidence.above(0.0)) == 0
