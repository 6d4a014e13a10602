"""The choice among hypotheses and its confidence: laws of the likelihood, of depths, of rivals, of the coefficients."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Scene, make_scene
from fit_inputs import COEFFICIENTS, FOCAL, joined, normalized, permuted, plane_with_twin

from mgca_filter.fit import choice
from mgca_filter.fit.choice import COEFFICIENTS as LENGTHS
from mgca_filter.fit.choice import (
    EARLY_FEATURES,
    FEATURES,
    Hypotheses,
    Judgement,
    Residuals,
    check_coefficients,
    confidence,
    early_confidence,
    explains_list,
    independent_counts,
    judge,
    log_likelihoods,
    measure_residuals,
    pairwise_angles_deg,
    posterior,
    prior,
)
from mgca_filter.fit.robust_fit import pose_from_essential
from mgca_filter.geometry.epipolar import (
    essential_from_pose,
    pose_error_deg,
    sampson_distance,
    triangulated_depths,
)
from mgca_filter.geometry.pose_refinement import rotation_from_vector


def random_poses(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    R = np.stack([rotation_from_vector(vector) for vector in rng.normal(0, 0.3, (count, 3))])
    t = rng.normal(0, 1, (count, 3))
    return R, t / np.linalg.norm(t, axis=1, keepdims=True)


def with_truth(scene: Scene, others: int = 6, seed: int = 0) -> Hypotheses:
    """The true pose first, then random ones, each of its own family."""
    R, t = random_poses(others, seed)
    R, t = np.concatenate([scene.R[None], R]), np.concatenate([scene.t[None], t])
    return Hypotheses(R, t, np.arange(others + 1))


def scores_of(scene: Scene, right: float = 0.9, wrong: float = 0.1) -> np.ndarray:
    return np.where(scene.inlier, right, wrong)


def judged(scene: Scene, hypotheses: Hypotheses, scores: np.ndarray | None = None, network=None) -> Judgement:
    return judge(normalized(scene), scores, hypotheses, FOCAL, network, COEFFICIENTS)


def test_residuals_are_sampson_distances_and_signs_of_depths() -> None:
    scene = make_scene(wrong=80)
    rows = normalized(scene)
    R, t = random_poses(5)
    R[0], t[0] = scene.R, scene.t
    residuals = measure_residuals(rows, R, t, FOCAL)
    for h in range(5):
        expected = sampson_distance(rows, essential_from_pose(R[h], t[h])) * FOCAL
        np.testing.assert_allclose(residuals.distance_px[h], expected, rtol=1e-9, atol=1e-9)
        depths = np.stack(triangulated_depths(rows, R[h], t[h]))
        clear = np.abs(depths) < 100.0  # rays that are far from parallel
        behind = (depths < 0).any(axis=0)
        apart = clear.all(axis=0)
        np.testing.assert_array_equal(residuals.behind[h][apart], behind[apart])
    assert not residuals.behind[0][scene.inlier].any()


def test_exact_points_have_no_residual() -> None:
    exact = make_scene(wrong=0, noise_px=0.0)
    residuals = measure_residuals(normalized(exact), exact.R[None], exact.t[None], FOCAL)
    assert residuals.distance_px.max() < 1e-9
    assert not residuals.behind.any()
    assert measure_residuals(normalized(exact), exact.R[None], -exact.t[None], FOCAL).behind.all()


def test_nearly_parallel_rays_say_nothing_of_depths() -> None:
    far = make_scene("rotation", wrong=0)
    for t in (np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])):
        assert not measure_residuals(normalized(far), far.R[None], t[None], FOCAL).behind.any()


def test_angles_between_poses_are_those_of_the_evaluation() -> None:
    R, t = random_poses(4)
    other_R, other_t = random_poses(3, seed=1)
    angles = pairwise_angles_deg(R, t, other_R, other_t)
    assert angles.shape == (4, 3)
    for h in range(4):
        for g in range(3):
            both = (pose_error_deg(R[h], sign * t[h], other_R[g], other_t[g]) for sign in (1.0, -1.0))
            assert angles[h, g] == pytest.approx(min(both), abs=1e-5)
    np.testing.assert_allclose(np.diag(pairwise_angles_deg(R, -t, R, t)), 0.0, atol=1e-5)


def likelihood_of(distance_px: list[float], behind: list[bool] | None = None, probability: float = 0.5) -> float:
    distances = np.array(distance_px)[None]
    signs = np.zeros(distances.shape, dtype=bool) if behind is None else np.array(behind)[None]
    each = np.full(distances.shape[1], probability)
    return float(log_likelihoods(Residuals(distances, signs), each, COEFFICIENTS)[0, 0])


def test_likelihood_rises_with_matches_that_agree() -> None:
    agreeing = [likelihood_of([0.3] * count + [50.0] * (20 - count)) for count in range(21)]
    assert (np.diff(agreeing) > 0).all()
    falling = [likelihood_of([distance]) for distance in np.linspace(0, 5, 30)]
    assert (np.diff(falling) < 0).all()
    assert likelihood_of([1e6] * 9) == pytest.approx(0.0, abs=1e-9)  # nothing agrees: as likely as chance
    trusted = [likelihood_of([0.3], probability=p) for p in (0.1, 0.5, 0.9)]
    assert trusted == sorted(trusted)
    assert likelihood_of([0.3], [True]) < likelihood_of([0.3], [False])
    assert likelihood_of([0.3], [True]) > 0  # seen in a corridor: less, and not nothing


def test_matches_that_lie_together_count_less_each_and_more_in_all() -> None:
    side, power = COEFFICIENTS["crowding"]
    spread = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 4))
    sums = []
    for crowd in (1, 4, 25, 100):
        rows = np.concatenate([spread, np.tile(spread[:1], (crowd, 1))])
        counts = independent_counts(rows, np.ones(len(rows)), COEFFICIENTS)
        assert counts[-1] <= (crowd + 1.0) ** -power + 1e-12
        assert counts.max() <= 1.0
        sums.append(counts[len(spread) :].sum())
        doubtful = independent_counts(rows, np.full(len(rows), 1e-3), COEFFICIENTS)  # hardly any of them is there
        np.testing.assert_array_equal(doubtful, 1.0)
    assert sums == sorted(sums)
    assert sums[-1] < 12.0
    apart = np.concatenate([spread, spread[:1] + [0.0, 0.0, 3.0 * side, 0.0]])  # together in one image alone
    assert independent_counts(apart, np.ones(41), COEFFICIENTS)[-1] > 0.5**power


@pytest.mark.parametrize("factor", [1e-3, 40.0])
def test_what_a_match_counts_does_not_depend_on_units_or_on_which_image_is_first(factor: float) -> None:
    rng = np.random.default_rng(1)
    rows, weights = rng.normal(0.0, 0.1, (300, 4)), rng.uniform(size=300)
    counts = independent_counts(rows, weights, COEFFICIENTS)
    assert counts.min() < 0.9
    np.testing.assert_array_equal(independent_counts(rows * 2.0**-3, weights, COEFFICIENTS), counts)
    np.testing.assert_allclose(independent_counts(rows * factor, weights, COEFFICIENTS), counts)
    np.testing.assert_allclose(independent_counts(rows[:, [2, 3, 0, 1]], weights, COEFFICIENTS), counts)
    one_place = independent_counts(np.ones((9, 4)), np.ones(9), COEFFICIENTS)
    np.testing.assert_allclose(one_place, 9.0 ** -COEFFICIENTS["crowding"][1])


def test_a_repeated_window_does_not_outvote_the_rest_of_the_view() -> None:
    """Matches spread over the view agree with the truth; a few more, all in one place, with another pose."""
    scene = make_scene(right=60, wrong=0, noise_px=0.1)
    other = rotation_from_vector(np.array([0.0, 0.0, 0.15])) @ scene.R
    true, rng = normalized(scene), np.random.default_rng(2)
    window = np.column_stack([rng.uniform(0.2, 0.23, (70, 2)), np.zeros((70, 2))])
    rays = np.column_stack([window[:, :2], np.ones(70)]) @ other.T * 5.0 + scene.t
    window[:, 2:] = rays[:, :2] / rays[:, 2:]
    rows = np.concatenate([true, window])
    poses = Hypotheses(np.stack([scene.R, other]), np.stack([scene.t] * 2), np.arange(2))
    crowded = judge(rows, np.full(130, 0.9), poses, FOCAL, None, COEFFICIENTS)
    each_alike = judge(rows, np.full(130, 0.9), poses, FOCAL, None, {**COEFFICIENTS, "crowding": [0.15, 0.0]})
    assert (crowded.chosen, each_alike.chosen) == (0, 1)


def test_prior_follows_the_score_and_stays_below_one() -> None:
    p = prior(np.linspace(0, 1, 50), COEFFICIENTS)
    assert (np.diff(p) >= 0).all()
    assert p[0] > 0
    assert p[-1] < 1
    assert prior(np.ones(1), {**COEFFICIENTS, "score_trust": [2.0, 1.0, 0.0]})[0] < 1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["general", "wide", "skew", "planar"])
@pytest.mark.parametrize("known", [True, False])
def test_the_truth_is_chosen(kind: str, known: bool, seed: int) -> None:
    scene = make_scene(kind, right=60, wrong=90, seed=seed)
    answer = judged(scene, with_truth(scene, 12, seed), scores_of(scene) if known else None)
    assert answer.chosen == 0
    assert answer.likelihood.argmax() == 0
    assert np.median(answer.distance_px[scene.inlier]) < 0.5


def test_a_pose_behind_the_cameras_loses(scene: Scene) -> None:
    poses = Hypotheses(np.stack([scene.R] * 2), np.stack([-scene.t, scene.t]), np.arange(2))
    answer = judged(scene, poses, scores_of(scene))
    assert answer.chosen == 1
    assert answer.likelihood[1] > answer.likelihood[0] + 50
    behind = judged(scene, Hypotheses(poses.R[:1], poses.t[:1], poses.family[:1]), scores_of(scene))
    assert np.isinf(behind.distance_px[scene.inlier]).all()


@pytest.mark.parametrize("known", [True, False])
def test_the_order_of_matches_and_of_hypotheses_does_not_matter(known: bool, scene: Scene) -> None:
    hypotheses, scores = with_truth(scene), scores_of(scene) if known else None
    one = judged(scene, hypotheses, scores)
    rows = np.random.default_rng(0).permutation(200)
    shuffled = judge(
        normalized(scene)[rows], None if scores is None else scores[rows], hypotheses, FOCAL, None, COEFFICIENTS
    )
    assert shuffled.chosen == one.chosen
    for name, value in one.features.items():
        assert shuffled.features[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name
    np.testing.assert_allclose(shuffled.distance_px, one.distance_px[rows])
    order = np.random.default_rng(1).permutation(7)
    turned = judged(scene, Hypotheses(hypotheses.R[order], hypotheses.t[order], hypotheses.family[order]), scores)
    assert order[turned.chosen] == one.chosen
    np.testing.assert_allclose(turned.likelihood, one.likelihood[order])


def test_features_have_the_names_that_the_coefficients_belong_to(scene: Scene) -> None:
    answer = judged(scene, with_truth(scene), scores_of(scene))
    assert tuple(answer.features) == FEATURES
    assert set(EARLY_FEATURES) <= set(FEATURES)
    assert np.isfinite(list(answer.features.values())).all()


def test_a_coarse_detector_is_measured_on_its_own_scale() -> None:
    scales = [
        judged(s, with_truth(s), scores_of(s)).scale for s in (make_scene(noise_px=0.2), make_scene(noise_px=1.2))
    ]
    assert scales == sorted(COEFFICIENTS["noise_scales"])


def test_on_long_lists_support_counts_beside_the_likelihood() -> None:
    """A pose that more matches of a high score are near wins where the likelihood alone would have another."""
    scene = make_scene(right=2000, wrong=0, noise_px=0.5)
    tilted = rotation_from_vector(np.array([0.0, 0.0, 0.0012])) @ scene.R
    poses = Hypotheses(np.stack([scene.R, tilted]), np.stack([scene.t] * 2), np.arange(2))
    assert judged(scene, poses, np.full(2000, 0.9)).chosen == 0
    bonus = [
        choice.support_bonus(
            measure_residuals(normalized(scene)[:count], poses.R, poses.t, FOCAL), np.full(count, 0.9), COEFFICIENTS
        )
        for count in (100, 2000)
    ]
    for of_both in bonus:
        assert of_both.max() == pytest.approx(0.0, abs=1e-6)  # the better of the two has the most at every distance
    assert bonus[1].min() < 20.0 * bonus[0].min() < 0  # more than in proportion to the length of the list


def test_who_agrees_is_counted_by_family(scene: Scene) -> None:
    near = rotation_from_vector(np.array([0.0, 0.02, 0.0])) @ scene.R  # 1.1 degrees off
    R, t = np.stack([scene.R, near, near, near]), np.stack([scene.t] * 4)
    agreed = {}
    for name, family in {"unlike": [0, 1, 2, 3], "alike": [0, 1, 1, 1], "same": [0, 0, 0, 0]}.items():
        answer = judged(scene, Hypotheses(R, t, np.array(family)), scores_of(scene))
        assert answer.chosen == 0
        agreed[name] = answer.features["other families within 2 deg"]
    assert agreed == {"unlike": 3.0, "alike": 1.0, "same": 0.0}


def test_the_network_e_is_a_witness(scene: Scene) -> None:
    poses = with_truth(scene)
    absent = judged(scene, poses, scores_of(scene))
    near = judged(scene, poses, scores_of(scene), (scene.R[None], scene.t[None]))
    far = judged(scene, poses, scores_of(scene), random_poses(1, seed=3))
    assert (absent.features["no network E"], near.features["no network E"]) == (1.0, 0.0)
    assert near.features["near network E 3 deg"] == pytest.approx(1.0, abs=1e-3)
    assert far.features["near network E 10 deg"] < 0.3


@pytest.mark.parametrize("rate", [confidence, early_confidence])
def test_confidence_is_a_probability_that_rises_with_the_evidence(rate) -> None:
    values = []
    for right in (0, 20, 40, 80, 200):
        scene = make_scene(right=right, wrong=200 - right, seed=4)
        if right == 0:
            scene = make_scene(right=0, wrong=200, seed=4)
        truth = make_scene(seed=4)
        R, t = random_poses(6)
        poses = Hypotheses(np.concatenate([truth.R[None], R]), np.concatenate([truth.t[None], t]), np.arange(7))
        values.append(rate(judged(scene, poses, scores_of(scene)), COEFFICIENTS))
    assert all(0.0 <= value <= 1.0 for value in values)
    assert values == sorted(values)
    assert values[0] < 0.2
    assert values[-1] > 0.9


def test_a_rival_takes_confidence_away() -> None:
    scene, twin = plane_with_twin(off_plane=0, wrong=0)
    R, t = pose_from_essential(twin, normalized(scene), FOCAL)
    in_front = ~measure_residuals(normalized(scene), R[None], t[None], FOCAL).behind[0]
    scene = joined(permuted(scene, np.flatnonzero(in_front)), make_scene(right=0, wrong=30))  # both poses see them
    alone = Hypotheses(scene.R[None], scene.t[None], np.zeros(1, dtype=int))
    rivals = Hypotheses(np.stack([scene.R, R]), np.stack([scene.t, t]), np.array([0, 0]))
    for rate in (confidence, early_confidence):
        values = [rate(judged(scene, poses, scores_of(scene)), COEFFICIENTS) for poses in (alone, rivals)]
        assert values[1] < values[0]
    share, number, behind, _, gap = COEFFICIENTS["early_end"]
    loosely_held = {**COEFFICIENTS, "early_end": [share, number, behind, 90.0, gap]}  # as a plane holds a pose
    assert explains_list(judged(scene, alone), loosely_held)
    assert not explains_list(judged(scene, rivals), loosely_held)


EASY = {
    "log share": np.log(0.9),
    "log count": np.log(200.0),
    "share behind": 0.0,
    "log uncertainty deg": np.log(0.05),
    "plain likelihood to alternative": np.arcsinh(500.0),
}


def easy(**changes: float) -> Judgement:
    return Judgement(0, {**EASY, **changes}, np.zeros(1), np.zeros(1), 0.9, 1.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("log share", np.log(0.45)),
        ("log count", np.log(40.0)),
        ("share behind", 0.1),
        ("log uncertainty deg", np.log(2.0)),
        ("plain likelihood to alternative", np.arcsinh(1.0)),
    ],
)
def test_every_doubt_asks_the_network(name: str, value: float) -> None:
    assert explains_list(easy(), COEFFICIENTS)
    assert not explains_list(easy(**{name: value}), COEFFICIENTS)
    # And each of the five limits is the one that says so.
    generous = {**COEFFICIENTS, "early_end": [0.01, 1.0, 1.0, 90.0, -1e9]}
    assert explains_list(easy(**{name: value}), generous)


def test_posterior_tells_right_from_wrong(scene: Scene) -> None:
    residuals = measure_residuals(normalized(scene), scene.R[None], scene.t[None], FOCAL)
    p = posterior(residuals, (np.ones(200, dtype=bool),), 1.0, COEFFICIENTS)
    assert p.min() >= 0
    assert p.max() <= 1
    assert p[scene.inlier].mean() > 0.95
    assert p[~scene.inlier].mean() < 0.1
    assert p.sum() == pytest.approx(120, abs=10)


def test_posterior_gives_every_group_its_own_share(scene: Scene) -> None:
    """The same residual says less where few matches are right; what is in no group is not judged."""
    distance = np.concatenate([np.full(90, 0.5), np.full(10, 90.0), np.full(10, 0.5), np.full(90, 90.0), [0.5]])
    residuals = Residuals(distance[None], np.zeros((1, 201), dtype=bool))
    good, bad = np.arange(201) < 100, (np.arange(201) >= 100) & (np.arange(201) < 200)
    p = posterior(residuals, (good, bad), 1.0, COEFFICIENTS)
    assert p[0] > p[100] > 0.5
    assert p[95] < 0.01
    assert p[200] == 0.0
    behind = Residuals(distance[None], np.ones((1, 201), dtype=bool))
    assert posterior(behind, (good, bad), 1.0, COEFFICIENTS)[0] < p[0]


def test_the_fitted_coefficients_are_complete() -> None:
    shipped = json.loads(Path(choice.__file__).with_name("choice.json").read_text(encoding="utf-8"))
    assert set(shipped) == set(LENGTHS)
    assert check_coefficients(shipped) == COEFFICIENTS
    withheld, usable = COEFFICIENTS["verdict"]
    assert 0 < withheld < usable < 1


@pytest.mark.parametrize("name", sorted(LENGTHS))
def test_coefficients_that_are_wrong_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is missing"):
        check_coefficients({k: v for k, v in COEFFICIENTS.items() if k != name})
    with pytest.raises(ValueError, match=f"{name}: expected .* finite numbers"):
        check_coefficients({**COEFFICIENTS, name: [*COEFFICIENTS[name][:-1], float("nan")]})
    with pytest.raises(ValueError, match=f"{name}: expected .* finite numbers"):
        check_coefficients({**COEFFICIENTS, name: []})


@pytest.mark.parametrize("name", sorted(name for name, count in LENGTHS.items() if count is not None))
def test_coefficients_of_another_length_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected {LENGTHS[name]} finite numbers"):
        check_coefficients({**COEFFICIENTS, name: [*COEFFICIENTS[name], 1.0]})


def test_a_mixture_needs_as_many_weights_as_widths() -> None:
    with pytest.raises(ValueError, match="noise_px and noise_weights differ"):
        check_coefficients({**COEFFICIENTS, "noise_px": [*COEFFICIENTS["noise_px"], 3.0]})
