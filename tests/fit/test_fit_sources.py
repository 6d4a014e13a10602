"""Sources of hypotheses: what each sees, in which order, and what it says where it sees too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import Scene, make_scene
from fit_inputs import before, normalized, plane_with_twin, scored

from mgca_filter.fit import sources
from mgca_filter.fit.estimators import EstimatorOptions
from mgca_filter.fit.evidence import MIN_ACCEPTED, MIN_MATCHES
from mgca_filter.fit.robust_fit import ALONE, BEFORE_NETWORK, FIRST, POSELIB, SECOND, pose_from_essential
from mgca_filter.fit.sources import ROUGH_MATCHES
from mgca_filter.geometry.epipolar import essential_from_pose

ROBUST = {"listed": sources.listed, "accepted": sources.accepted, "above": sources.above(0.0)}
RUN = EstimatorOptions("magsac")


def same_up_to_sign(E: np.ndarray, other: np.ndarray) -> float:
    E, other = E / np.linalg.norm(E), other / np.linalg.norm(other)
    return float(min(np.abs(E - other).max(), np.abs(E + other).max()))


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """Arguments of every robust estimator that a source calls; each finds nothing."""
    calls: list[tuple] = []
    monkeypatch.setattr(sources, "fit_epipolar", lambda *arguments: calls.append(arguments))
    return calls


@pytest.mark.parametrize("name", ROBUST)
@pytest.mark.parametrize("calibrated", [True, False])
def test_robust_sources_propose_the_model(name: str, calibrated: bool) -> None:
    exact = make_scene(noise_px=0.0)
    (M,) = ROBUST[name](scored(exact, calibrated=calibrated), RUN)
    assert np.linalg.norm(M) == pytest.approx(1.0)
    if not calibrated:
        # Of normalised coordinates under guessed intrinsics: the truth in pixels is no essential matrix there.
        assert np.linalg.svd(M, compute_uv=False)[2] < 1e-8
        return
    assert same_up_to_sign(M, exact.E) < 1e-3


def test_the_network_e_is_proposed_where_it_is_usable(scene: Scene) -> None:
    E = (-3.0 * scene.E).astype(np.float32)
    (found,) = sources.network(scored(scene, network_essential=E), RUN)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, E)
    for useless in (None, np.zeros((3, 3)), np.full((3, 3), np.nan)):
        assert sources.network(scored(scene, network_essential=useless), RUN) == []
    assert sources.network(scored(scene, network_essential=E, calibrated=False), RUN) == []
    assert sources.network(before(scene), RUN) == []


def test_the_list_is_seen_in_its_own_order_whatever_the_network_says(scene: Scene, seen: list) -> None:
    by_ratio = normalized(scene)[np.argsort(scene.attributes.ratio, kind="stable")]
    backwards = 8.0 * (scene.attributes.ratio - 0.8)
    for evidence in (before(scene), scored(scene), scored(scene, backwards)):
        assert sources.listed(evidence, RUN) == []
        rows, focal, options, calibrated = seen.pop()
        np.testing.assert_allclose(rows, by_ratio, atol=1e-12)
        assert (focal, options, calibrated) == (evidence.focal_px, RUN, True)


def test_a_rough_run_sees_the_most_promising_of_a_long_list(seen: list) -> None:
    long = make_scene(right=800, wrong=200)
    rough = replace(RUN, rough=True)
    by_ratio = normalized(long)[np.argsort(long.attributes.ratio, kind="stable")]
    sources.listed(before(long), rough)
    np.testing.assert_allclose(seen.pop()[0], by_ratio[:ROUGH_MATCHES], atol=1e-12)
    sources.listed(before(long), RUN)
    assert len(seen.pop()[0]) == 1000
    nothing_known = replace(before(long), order=np.full(1000, np.nan))
    sources.listed(nothing_known, rough)
    some = seen.pop()[0]
    assert len(some) == ROUGH_MATCHES
    np.testing.assert_array_equal(some[:3], nothing_known.correspondences[[0, 1, 3]])
    np.testing.assert_array_equal(some[-1], nothing_known.correspondences[998])


def test_of_a_raw_list_a_classical_pipeline_sees_what_is_clear(scene: Scene, seen: list) -> None:
    best = np.ones(200, dtype=bool)
    best[np.flatnonzero(~scene.inlier)[:40]] = False
    crowded = replace(scene, attributes=replace(scene.attributes, best=best))
    sources.listed(scored(crowded), RUN)
    assert len(seen.pop()[0]) == np.count_nonzero(best & (scene.attributes.ratio < 0.9))


def test_the_network_chooses_what_its_sources_see(scene: Scene, seen: list) -> None:
    margins = np.linspace(-4.0, 4.0, 200)
    evidence = scored(scene, margins)
    for source, expected in (
        (sources.accepted, 1.0 / (1.0 + np.exp(-margins)) > 0.3),
        (sources.above(-1.0), margins > -1.0),
        (sources.above(1.0), margins > 1.0),
        (sources.above(9.0), margins >= np.sort(margins)[-MIN_ACCEPTED]),
    ):
        source(evidence, RUN)
        rows = seen.pop()[0]
        kept = [row for row in evidence.rows if expected[row]]  # best first
        np.testing.assert_allclose(rows, normalized(scene)[kept], atol=1e-12)


@pytest.mark.parametrize("name", ROBUST)
def test_too_few_matches_are_not_tried(name: str, seen: list) -> None:
    few = make_scene(right=MIN_MATCHES - 1, wrong=0)
    assert ROBUST[name](scored(few), RUN) == []
    assert not seen
    ROBUST[name](scored(make_scene(right=MIN_MATCHES, wrong=0)), RUN)
    assert len(seen) == 1


@pytest.mark.parametrize("seed", range(3))
def test_under_a_plane_the_twin_leads_to_the_truth(seed: int) -> None:
    scene, twin = plane_with_twin(seed=seed)
    R, t = pose_from_essential(twin, normalized(scene), before(scene).focal_px)
    proposed = sources.plane(sources.dominant_plane(before(scene), R, t, 0))
    assert len(proposed) == 2
    errors = [same_up_to_sign(E, scene.E) for E in proposed]
    assert min(errors) < 0.02
    assert min(same_up_to_sign(E, twin) for E in proposed) < 0.02


def test_without_a_plane_there_is_no_twin() -> None:
    turned = make_scene("rotation", wrong=0)
    few = make_scene(right=3, wrong=0)
    assert sources.plane(sources.dominant_plane(before(few), few.R, few.t, 0)) == []
    E = essential_from_pose(turned.R, np.array([1.0, 0.0, 0.0]))
    H = sources.dominant_plane(before(turned), turned.R, E[:, 0], 0)
    assert all(np.isfinite(M).all() for M in sources.plane(H))


def test_no_two_runs_draw_the_same_samples() -> None:
    proposals = {p.name: p for p in (*BEFORE_NETWORK, *FIRST, *SECOND, POSELIB)}.values()
    draws = [(p.family, p.method, p.number) for p in proposals if p.source is not sources.network]
    assert len(set(draws)) == len(draws)
    assert all(p.iterations > 0 for p in (*proposals, *ALONE.values()) if p.source is not sources.network)
    assert [name for name, p in ALONE.items()] == [p.method for p in ALONE.values()]
