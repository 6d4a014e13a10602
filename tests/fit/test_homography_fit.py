"""The robust fit of homographies, affine maps and similarities, and the decision whether one explains the pair."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mgca_filter.fit.homography_fit import (
    FAMILIES,
    HomographyFit,
    HomographyOptions,
    estimate_homography,
    polish_homography,
)
from mgca_filter.fit.planarity import (
    chance_rates,
    find_plane,
    homography_explains,
    homography_false_alarms,
    parallax_false_alarms,
)
from mgca_filter.geometry.epipolar import essential_from_pose, fundamental_from_essential
from mgca_filter.geometry.homography import transfer
from mgca_filter.geometry.pose_refinement import rotation_from_vector

SIZE = (640, 480)
K = np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]])
MAPS = {
    "homography": np.array([[0.9, -0.2, 60.0], [0.25, 1.1, -40.0], [2e-4, -1e-4, 1.0]]),
    "affine": np.array([[0.9, -0.2, 60.0], [0.25, 1.1, -40.0], [0, 0, 1.0]]),
    "similarity": np.array([[0.8, -0.3, 60.0], [0.3, 0.8, -40.0], [0, 0, 1.0]]),
}


def make_matches(
    H: np.ndarray = MAPS["homography"],
    right: int = 80,
    wrong: int = 120,
    noise_px: float = 0.5,
    seed: int = 0,
    low: tuple[float, float] = (0, 0),
    high: tuple[float, float] = SIZE,
) -> tuple[np.ndarray, np.ndarray]:
    """Matches (N, 4), shuffled, and which are right: inside a rectangle of image 1."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (right, 2))
    good = np.hstack([points, transfer(points, H)]) + rng.normal(0, noise_px, (right, 4))
    bad = rng.uniform((0, 0, 0, 0), (*SIZE, *SIZE), (wrong, 4))
    rows = rng.permutation(right + wrong)
    return np.vstack([good, bad])[rows], (np.arange(right + wrong) < right)[rows]


def corner_error(H: np.ndarray, truth: np.ndarray) -> float:
    corners = np.array([[0.0, 0], [639, 0], [639, 479], [0, 479]])
    return float(np.linalg.norm(transfer(corners, H) - transfer(corners, truth), axis=1).mean())


def fit(rows: np.ndarray, *arguments: object, **options: object) -> HomographyFit:
    found = estimate_homography(rows, HomographyOptions(**options), *arguments)
    assert found is not None
    return found


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("wrong", [0, 100])
def test_exact_points_give_the_exact_map(family: str, wrong: int) -> None:
    rows, inlier = make_matches(MAPS[family], right=60, wrong=wrong, noise_px=0.0)
    found = fit(rows, family=family)
    np.testing.assert_allclose(found.H, MAPS[family], rtol=1e-6, atol=1e-8)
    assert found.inlier[inlier].all()
    assert found.distance[inlier].max() < 1e-6


@pytest.mark.parametrize("family", FAMILIES)
def test_a_sample_is_enough(family: str) -> None:
    rows = np.array([[0.0, 0], [600, 20], [580, 400], [30, 380]])[: FAMILIES[family] // 2]
    rows = np.hstack([rows, transfer(rows, MAPS[family])])
    np.testing.assert_allclose(fit(rows, family=family).H, MAPS[family], rtol=1e-6, atol=1e-8)
    assert estimate_homography(rows[1:], HomographyOptions(family=family)) is None


def test_the_family_is_kept() -> None:
    rows, _ = make_matches(MAPS["similarity"])
    similarity, affine = (fit(rows, family=family).H for family in ("similarity", "affine"))
    assert similarity[0, 0] == pytest.approx(similarity[1, 1])
    assert similarity[0, 1] == pytest.approx(-similarity[1, 0])
    assert (similarity[2] == [0, 0, 1]).all()
    assert (affine[2] == [0, 0, 1]).all()
    assert affine[0, 0] != pytest.approx(affine[1, 1], rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("right", "wrong"), [(100, 50), (60, 300), (40, 400)])
def test_many_wrong_matches(right: int, wrong: int, seed: int) -> None:
    rows, inlier = make_matches(right=right, wrong=wrong, seed=seed)
    found = fit(rows, max_iterations=20000)
    assert corner_error(found.H, MAPS["homography"]) < 2.0
    assert found.inlier[inlier].mean() > 0.9
    assert found.inlier[~inlier].mean() < 0.02


@pytest.mark.slow
def test_closer_to_the_truth_than_opencv_on_average() -> None:
    """Right matches of a tenth of a pixel to two: the errors of real keypoints have such tails."""
    ours, theirs = [], []
    for seed in range(30):
        rows, inlier = make_matches(right=60, wrong=60, noise_px=0.0, seed=seed)
        rng = np.random.default_rng(seed)
        rows[inlier] += rng.normal(0, 1, (60, 4)) * rng.choice([0.2, 1.5], (60, 1))
        ours.append(corner_error(fit(rows).H, MAPS["homography"]))
        for threshold in (1.0, 3.0, 5.0):
            H, _ = cv2.findHomography(rows[:, :2], rows[:, 2:], cv2.RANSAC, threshold)
            theirs.append(corner_error(H, MAPS["homography"]))
    assert np.mean(ours) < 0.9 * np.mean(np.reshape(theirs, (30, 3)), axis=0).min()


def test_permutation_moves_inliers_only() -> None:
    rows, _ = make_matches()
    shuffle = np.random.default_rng(9).permutation(len(rows))
    there, back = fit(rows), fit(rows[shuffle])
    assert corner_error(there.H, back.H) < 0.05
    assert (there.inlier[shuffle] == back.inlier).mean() > 0.99


def test_swapping_the_images_inverts() -> None:
    rows, _ = make_matches()
    assert corner_error(np.linalg.inv(fit(rows[:, [2, 3, 0, 1]]).H), fit(rows).H) < 0.1


@pytest.mark.parametrize("scale", [1e-3, 50.0])
def test_units_change_nothing(scale: float) -> None:
    rows, _ = make_matches()
    S = np.diag([scale, scale, 1.0])
    scaled = fit(scale * rows, threshold=2.0 * scale)
    np.testing.assert_allclose(np.linalg.inv(S) @ scaled.H @ S, fit(rows).H, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(scaled.inlier, fit(rows).inlier)


def test_repeated_rows_count_once() -> None:
    rows, _ = make_matches()
    again = np.vstack([rows, np.repeat(rows[:3], 200, axis=0)])
    assert fit(again).support == pytest.approx(fit(rows).support)


def test_matches_that_share_a_point_share_its_weight() -> None:
    """Two hundred keypoints matched to one: a map that collapses onto it would explain them all."""
    rows, inlier = make_matches(right=30, wrong=50)
    hub = np.random.default_rng(1).uniform((0, 0), SIZE, (200, 2))
    rows = np.vstack([rows, np.hstack([hub, np.broadcast_to([300.0, 200.0], hub.shape)])])
    found = fit(rows)
    assert corner_error(found.H, MAPS["homography"]) < 3.0
    assert found.inlier[80:].mean() < 0.1


def test_same_seed_same_bits_and_other_seeds_draw_other_samples() -> None:
    rows, _ = make_matches(right=150, wrong=300)
    first, again, other = (fit(rows, seed=seed, max_iterations=240) for seed in (0, 0, 3))
    np.testing.assert_array_equal(first.H, again.H)
    assert np.any(first.H != other.H)


def test_options_and_arguments_matter() -> None:
    rows, inlier = make_matches(right=15, wrong=500, seed=4)
    truth = MAPS["homography"]
    few = estimate_homography(rows, HomographyOptions(max_iterations=240))
    assert few is None or corner_error(few.H, truth) > 5.0
    scores = np.where(inlier, 0.9, 0.1)
    assert corner_error(fit(rows, scores, max_iterations=240).H, truth) < 5.0
    order = np.argsort(~inlier, kind="stable")
    assert corner_error(fit(rows, None, order, max_iterations=240).H, truth) < 5.0
    # What the order leaves out is measured at the end.
    found = fit(rows, None, np.flatnonzero(inlier)[:10])
    assert found.inlier[inlier].mean() > 0.8
    tight, loose = (fit(rows, scores, threshold=t).inlier.sum() for t in (0.3, 6.0))
    assert tight < loose


def test_confidence_decides_how_many_samples_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    from mgca_filter.fit import homography_fit

    drawn = []
    solve = homography_fit._Search._solve
    monkeypatch.setattr(homography_fit._Search, "_solve", lambda self, s: drawn.append(len(s)) or solve(self, s))
    rows, _ = make_matches(right=50, wrong=150)
    counts = []
    for confidence in (0.5, 0.9999999):
        drawn.clear()
        fit(rows, confidence=confidence, max_iterations=50000)
        counts.append(sum(drawn))
    assert counts[0] < counts[1] < 50000


def test_frames_find_what_sampling_does_not() -> None:
    H = MAPS["similarity"]
    rows, inlier = make_matches(H, right=14, wrong=900, seed=2, low=(100, 100), high=(500, 400))
    frames = np.full((len(rows), 2), np.nan)
    frames[inlier] = np.log2(np.hypot(0.8, 0.3)), np.arctan2(0.3, 0.8)
    with_frames = fit(rows, None, None, frames, max_iterations=240)
    assert with_frames.inlier[inlier].mean() > 0.8
    without = estimate_homography(rows, HomographyOptions(max_iterations=240))
    assert without is None or without.inlier[inlier].mean() < 0.5


@pytest.mark.slow
def test_small_object_is_found_by_neighbours() -> None:
    found = 0
    for seed in range(10):
        rows, inlier = make_matches(right=20, wrong=600, seed=seed, low=(200, 150), high=(320, 250))
        result = estimate_homography(rows)
        found += result is not None and result.inlier[inlier].mean() > 0.8
    assert found >= 8


def test_mirrors_only_where_they_are_allowed() -> None:
    mirror = MAPS["homography"] @ np.array([[-1.0, 0, 640], [0, 1, 0], [0, 0, 1]])
    rows, inlier = make_matches(mirror)
    assert corner_error(fit(rows, reflection=True).H, mirror) < 2.0
    refused = estimate_homography(rows)
    assert refused is None or refused.inlier[inlier].mean() < 0.3


def test_a_fold_is_no_plane() -> None:
    """Half of the points lie beyond the horizon of the map: no plane puts both halves into one image."""
    H = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0 / 320.0, 0, 1.0]])
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0), SIZE, (200, 2))
    points = points[np.abs(points[:, 0] - 320) > 100]
    rows = np.hstack([points, transfer(points, H)])
    left = points[:, 0] < 320
    found = fit(rows, reflection=True)
    assert min(found.inlier[left].mean(), found.inlier[~left].mean()) < 0.1


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    "rows",
    [
        np.zeros((0, 4)),
        np.zeros((3, 4)),
        np.full((50, 4), 7.0),
        np.full((50, 4), np.nan),
        np.outer(np.arange(50.0), [1, 2, 3, 4]),
        np.column_stack([np.random.default_rng(0).uniform(0, 9, (50, 2)), np.ones((50, 2))]),
        np.random.default_rng(0).uniform(0, 1e300, (50, 4)),
        np.random.default_rng(0).uniform(0, 1e-300, (50, 4)),
    ],
    ids=["none", "zeros", "equal", "nan", "line", "collapse", "huge", "tiny"],
)
def test_data_never_raises(family: str, rows: np.ndarray) -> None:
    found = estimate_homography(rows, HomographyOptions(family=family))
    assert found is None or (np.isfinite(found.H).all() and found.inlier.shape == (len(rows),))
    plane = find_plane(rows, None, SIZE, SIZE, options=HomographyOptions(family=family))
    assert plane.inlier.shape == (len(rows),)
    assert not np.isnan(plane.log10_false_alarms)


def test_rows_that_are_not_finite_are_passed_over() -> None:
    rows, inlier = make_matches()
    rows[~inlier] = np.where(np.arange(4) % 2, np.nan, np.inf)
    found = fit(rows)
    np.testing.assert_array_equal(np.isinf(found.distance), ~inlier)
    np.testing.assert_allclose(found.H, fit(rows[inlier]).H, rtol=0.05, atol=1e-4)


def test_misuse_is_named() -> None:
    with pytest.raises(ValueError, match="family"):
        estimate_homography(np.zeros((9, 4)), HomographyOptions(family="rigid"))
    with pytest.raises(ValueError, match="threshold"):
        estimate_homography(np.zeros((9, 4)), HomographyOptions(threshold=0.0))


# The decision


@pytest.mark.parametrize("right", [10, 15, 30])
def test_small_planes_are_meaningful(right: int) -> None:
    found = 0
    for seed in range(10):
        rows, inlier = make_matches(right=right, wrong=60, seed=seed, low=(200, 150), high=(350, 280))
        plane = find_plane(rows, None, SIZE, SIZE)
        found += plane.meaningful and plane.inlier[inlier].mean() > 0.7
    assert found >= 8


def test_a_good_order_makes_small_planes_meaningful_in_many_matches() -> None:
    rows, inlier = make_matches(right=10, wrong=1500, seed=1, low=(200, 150), high=(350, 280))
    scores = np.where(inlier, 0.9, 0.1)
    assert find_plane(rows, scores, SIZE, SIZE).meaningful


@pytest.mark.slow  # chance needs many draws
@pytest.mark.parametrize("wrong", [20, 100, 500])
def test_chance_is_not_meaningful(wrong: int) -> None:
    values = [find_plane(make_matches(right=0, wrong=wrong, seed=s)[0], None, SIZE, SIZE) for s in range(20)]
    assert not any(plane.meaningful for plane in values)


def test_one_blob_found_many_times_is_one_witness() -> None:
    rows, _ = make_matches(right=0, wrong=60)
    H = MAPS["homography"]
    blob = np.array([[100.0, 100.0], [300, 120], [310, 300], [90, 310], [200, 200]])
    blob = np.repeat(np.hstack([blob, transfer(blob, H)]), 12, axis=0)
    blob += np.random.default_rng(0).uniform(-0.2, 0.2, blob.shape)
    assert homography_false_alarms(np.vstack([blob, rows]), H, 2.0, SIZE, SIZE) > -2.0


def test_false_alarms_fall_with_support_and_rise_with_the_number_of_matches() -> None:
    values = [
        homography_false_alarms(make_matches(right=r, wrong=w)[0], MAPS["homography"], 2.0, SIZE, SIZE)
        for r, w in ((40, 100), (20, 100), (20, 1000))
    ]
    assert values[0] < values[1] < values[2]


def test_chance_rate_is_the_area_that_a_match_may_fall_into() -> None:
    rows, _ = make_matches(np.eye(3), right=0, wrong=400)
    expected = np.pi * (np.sqrt(2) * 10.0) ** 2 / (640 * 480)
    rates = chance_rates(rows, np.eye(3), [5.0, 10.0], SIZE, SIZE)
    assert rates == pytest.approx([expected / 4.0, expected], rel=0.15)
    assert chance_rates(rows[:5], np.eye(3), [2.0], SIZE, SIZE)[0] < 1e-3


def test_larger_images_make_the_same_support_rarer() -> None:
    rows, _ = make_matches(right=8, wrong=2)
    small, large = (homography_false_alarms(rows, MAPS["homography"], 2.0, s, s) for s in (SIZE, (6400, 4800)))
    assert large < small


def scene(depth_off_plane: float, off: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plane, ``off`` points off it by a share of its depth, wrong matches; with H and F of the pair."""
    rng = np.random.default_rng(0)
    R, t = rotation_from_vector(np.array([0.03, -0.1, 0.02])), np.array([1.0, 0.2, 0.1])
    pixels = rng.uniform((0, 0), SIZE, (150, 2))
    depth = np.full(150, 6.0)
    depth[:off] *= 1.0 + rng.uniform(0.5, 1.0, off) * depth_off_plane
    X1 = np.column_stack([(pixels - K[:2, 2]) / 600.0, np.ones(150)]) * depth[:, None]
    X2 = X1 @ R.T + t
    rows = np.hstack([pixels, X2[:, :2] / X2[:, 2:] * 600.0 + K[:2, 2]]) + rng.normal(0, 0.3, (150, 4))
    rows = np.vstack([rows, rng.uniform((0, 0, 0, 0), (*SIZE, *SIZE), (60, 4))])
    H = K @ (R + np.outer(t, [0, 0, 1.0 / 6.0])) @ np.linalg.inv(K)
    return rows, H, fundamental_from_essential(essential_from_pose(R, t), K, K)


def test_a_plane_is_explained_by_its_homography_and_a_scene_with_depth_is_not() -> None:
    rows, H, F = scene(0.0, 0)
    assert homography_explains(rows, H, F, 1.0)
    rows, H, F = scene(0.4, 40)
    assert not homography_explains(rows, H, F, 1.0)
    assert parallax_false_alarms(rows, H, F, 1.0) < parallax_false_alarms(*scene(0.4, 15), 1.0)


def test_polish_takes_in_matches_that_the_fit_did_not_see() -> None:
    rows, right = make_matches(right=120, wrong=60)
    few = estimate_homography(rows[np.flatnonzero(right)[:12]], HomographyOptions(threshold=2.0))
    exact = cv2.perspectiveTransform(rows[right][None, :, :2], MAPS["homography"])[0]
    errors = []
    for H in (few.H, polish_homography(rows, few.H, HomographyOptions(threshold=2.0))):
        errors.append(np.sqrt(np.mean((cv2.perspectiveTransform(rows[right][None, :, :2], H)[0] - exact) ** 2)))
    assert errors[1] < errors[0]
    np.testing.assert_array_equal(polish_homography(rows[:3], few.H), few.H)
