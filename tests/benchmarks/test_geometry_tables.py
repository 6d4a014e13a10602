"""Tables of small motion, fisheyes and photographs without K: their pairs are what they say, their rows add up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import fisheye, small_motion, without_intrinsics
from mgca_filter import MatchFilter
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg, sampson_distance


def normalized(points: np.ndarray, K: np.ndarray) -> np.ndarray:
    return (points - K[:2, 2]) / np.array([K[0, 0], K[1, 1]])


@pytest.mark.parametrize("parallax_px", [0.5, 8.0])
def test_tracks_have_the_parallax_that_they_are_made_for(parallax_px: float) -> None:
    tracks = small_motion.make_tracks(parallax_px, 1e-9, 0)
    still = small_motion._project(
        (np.column_stack([normalized(tracks.points1, small_motion.K), np.ones(400)])) @ tracks.R.T
    )
    moved = np.linalg.norm(tracks.points2 - still, axis=1)[tracks.right]
    assert np.median(moved) == pytest.approx(parallax_px, rel=0.2)
    assert not small_motion.make_tracks(0.0, 0.1, 0).t.any()


def test_a_row_of_small_motion(match_filter: MatchFilter) -> None:
    outcomes = [small_motion.run_pair(small_motion.make_tracks(8.0, 0.1, seed), match_filter) for seed in range(2)]
    row = small_motion.cells(8.0, 0.1, outcomes)
    assert len(row) == len(small_motion.HEADER)
    assert float(row[3]) > 95.0
    assert float(row[7]) < 2.0
    still = [small_motion.run_pair(small_motion.make_tracks(0.0, 0.1, 0), match_filter)]
    assert small_motion.cells(0.0, 0.1, still)[2] == "1 pure_rotation"
    assert small_motion.cells(0.0, 0.1, still)[-1] == ""


def test_rings_of_a_fisheye(match_filter: MatchFilter) -> None:
    views = fisheye.make_views(0)
    rings = fisheye.recalls(views, views.right)
    assert rings == [1.0] * len(fisheye.RINGS_DEG)
    lens, flat = (fisheye.run_pair(views, row, match_filter) for row in fisheye.ROWS[:2])
    assert fisheye.recalls(views, lens.mask)[-1] > 0.95 > 0.6 > fisheye.recalls(views, flat.mask)[-1]


@pytest.mark.parametrize("zoom", [1.0, 1.6])
def test_made_up_pairs_obey_their_cameras(zoom: float) -> None:
    pair = without_intrinsics.make_pair(0, zoom)
    right = np.arange(len(pair.points1)) < without_intrinsics.RIGHT
    rows = np.hstack([normalized(pair.points1, pair.K1), normalized(pair.points2, pair.K2)])[right]
    assert np.median(sampson_distance(rows, essential_from_pose(pair.R, pair.t))) * pair.K1[0, 0] < 1.0
    larger = without_intrinsics.zoomed(pair, 2.0)
    assert larger.K2[0, 0] == 2.0 * pair.K2[0, 0]
    assert 0 < len(larger.points2) < len(pair.points2)


def test_a_row_without_intrinsics(match_filter: MatchFilter) -> None:
    pair = without_intrinsics.make_pair(4, 1.6)
    free = MatchFilter.over(*match_filter._backends, options=replace(match_filter.options, geometry="fundamental"))
    outcomes = [without_intrinsics.run_pair(pair, 1.6, match_filter, free)]
    poses = without_intrinsics.pose_cells(1.6, outcomes)
    verdicts = without_intrinsics.verdict_cells(1.6, outcomes)
    focals = without_intrinsics.focal_cells(1.6, outcomes)
    for row, header in (
        (poses, without_intrinsics.POSES),
        (verdicts, without_intrinsics.VERDICTS),
        (focals, without_intrinsics.FOCALS),
    ):
        assert len(row) == len(header)
    assert poses[1:4] == ["1", "100.0", "100.0"]
    assert verdicts[1:7] == ["1", "100.0", "1", "100.0", "100", "1"]
    assert int(verdicts[7]) > 250
    assert focals[1:3] == ["1", "1"]


@pytest.mark.parametrize("seed", range(8))
def test_two_cameras_are_told_apart_wherever_the_search_starts(match_filter: MatchFilter, seed: int) -> None:
    """Of two the shared focal length is a poor start: refinement from there may stand still."""
    pair = without_intrinsics.make_pair(seed, 1.6)
    bare = without_intrinsics.match_pair(pair)
    result = match_filter.filter(
        bare.kp1, bare.kp2, None, attributes=pair.attributes, size1=pair.image_size1, size2=pair.image_size2
    )
    focal1, focal2 = result.info["focal_px"]
    assert np.log(focal2 / focal1) == pytest.approx(np.log(1.6), abs=0.2)
    assert pose_error_deg(result.R, result.t, pair.R, pair.t) < 3.0


def test_what_focal_lengths_alone_make_doubtful_is_counted_before_and_after(match_filter: MatchFilter) -> None:
    sure = without_intrinsics.run_pair(without_intrinsics.make_pair(4, 1.6), 1.6, match_filter, match_filter)
    doubtful = replace(sure, status="low_support", pose=30.0)
    row = without_intrinsics.verdict_cells(1.6, [sure, doubtful])
    assert row[1:7] == ["2", "50.0", "1", "100.0", "100", "2"]
    rejected = replace(doubtful, verified=False, kept=0)
    assert without_intrinsics.verdict_cells(1.6, [sure, rejected])[1:7] == ["1", "100.0", "1", "100.0", "100", "1"]


def test_the_fit_of_the_confidence_finds_what_the_answers_were_drawn_from(match_filter: MatchFilter) -> None:
    rng = np.random.default_rng(0)
    answer = without_intrinsics.run_pair(without_intrinsics.make_pair(4, 1.0), 1.0, match_filter, match_filter)
    outcomes = []
    for k in range(4000):
        fitted, sigma_deg = rng.uniform(0.3, 0.99), np.exp(rng.uniform(-1, 3))
        log_odds = 0.7 * np.log(fitted / (1 - fitted)) - 0.9 * np.log(sigma_deg) + 0.4
        pose = 1.0 if rng.random() < 1 / (1 + np.exp(-log_odds)) else 90.0
        known = {"fitted_confidence": fitted, "sigma_deg": sigma_deg}
        outcomes.append(replace(answer, scene=str(k % 10), pose=pose, **known))
    first = without_intrinsics.describe_fit(outcomes, 0.68).splitlines()[0]
    found = [
        float(word.rstrip(",")) for word in first.split() if word.rstrip(",").lstrip("-").replace(".", "").isdigit()
    ]
    np.testing.assert_allclose(found, [0.7, -0.9, 0.4], atol=0.15)
