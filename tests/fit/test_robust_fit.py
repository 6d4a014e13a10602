"""The search for a pose: what ends it early, who proposes, that every option reaches every run, laws of the answer."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import K, Scene, make_scene
from fit_inputs import COEFFICIENTS, FOCAL, before, joined, normalized, permuted, plane_with_twin, prepared, scored

from benchmarks.small_motion import K as TRACKS_K
from benchmarks.small_motion import make_tracks
from mgca_filter import MatchAttributes
from mgca_filter.fit import robust_fit, sources
from mgca_filter.fit.estimators import EstimatorOptions, fit_epipolar
from mgca_filter.fit.evidence import MIN_MATCHES
from mgca_filter.fit.robust_fit import (
    ALONE,
    FIRST,
    PLAN,
    SECOND,
    Search,
    TwoViewModel,
    fit_alone,
    pose_from_essential,
    scores_by_residuals,
)
from mgca_filter.geometry.epipolar import cross_matrix, essential_from_pose, pose_error_deg, sampson_distance
from mgca_filter.geometry.pose_refinement import rotation_from_vector
from mgca_filter.inputs.options import METHODS, FilterOptions

HARD = {"right": 40, "wrong": 360}
FITS = [method for method in METHODS if method != "none"]


def options_of(method: str, **changes: object) -> FilterOptions:
    if method == "poselib":
        pytest.importorskip("poselib")
    return FilterOptions(method=method, **changes)


def early(scene: Scene, options: FilterOptions | None = None, plan: robust_fit.Plan = PLAN) -> TwoViewModel | None:
    return Search(before(scene), COEFFICIENTS, options or FilterOptions(), plan).before_network()


def late(
    scene: Scene,
    options: FilterOptions | None = None,
    plan: robust_fit.Plan = PLAN,
    calibrated: bool = True,
    **network: object,
) -> TwoViewModel | None:
    """The answer of a search that begins with the network."""
    search = Search(before(scene, calibrated), COEFFICIENTS, options or FilterOptions(), plan)
    return search.with_network(scored(scene, calibrated=calibrated, **network))


def error_deg(model: TwoViewModel, scene: Scene) -> float:
    return pose_error_deg(model.R, model.t, scene.R, scene.t)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, EstimatorOptions, bool]]:
    """Number of rows, options and kind of every robust estimator that is run."""
    seen: list[tuple[int, EstimatorOptions, bool]] = []

    def fit_and_note(rows, focal_px, options, calibrated):
        seen.append((len(rows), options, calibrated))
        return fit_epipolar(rows, focal_px, options, calibrated)

    monkeypatch.setattr(sources, "fit_epipolar", fit_and_note)
    return seen


@pytest.mark.parametrize("method", FITS)
def test_every_method_finds_the_pose(method: str, scene: Scene) -> None:
    model = late(scene, options_of(method))
    assert model is not None
    assert error_deg(model, scene) < 1.0
    np.testing.assert_allclose(np.linalg.svd(model.E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
    np.testing.assert_allclose(model.R @ model.R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(model.R) == pytest.approx(1.0)
    assert np.linalg.norm(model.t) == pytest.approx(1.0)
    np.testing.assert_array_equal(model.M, model.E)
    assert 0.0 <= model.confidence <= 1.0
    assert model.ended in ("first sources", "all sources")


@pytest.mark.parametrize("kind", ["general", "wide", "skew"])
def test_exact_points_give_the_exact_pose(kind: str) -> None:
    exact = make_scene(kind, noise_px=0.0)
    for model in (early(exact), late(exact)):
        assert model is not None
        assert error_deg(model, exact) < 1e-3
        assert sampson_distance(normalized(exact)[exact.inlier], model.E).max() * FOCAL < 1e-2


@pytest.mark.parametrize("method", FITS)
def test_without_intrinsics_the_fundamental_matrix_fits(method: str) -> None:
    scene = make_scene(right=120, wrong=80, noise_px=0.1)
    model = late(scene, options_of(method), calibrated=False)
    assert model is not None
    assert model.confidence is None
    assert model.judgement is None
    assert model.ended == "all sources"
    pair = prepared(scene, calibrated=False)
    distance = sampson_distance(pair.correspondences, model.M) * pair.focal_px
    assert np.median(distance[scene.inlier]) < 0.5
    assert np.linalg.norm(model.M) == pytest.approx(1.0)
    assert np.ptp(np.linalg.svd(model.M, compute_uv=False)[:2]) > 1e-5  # not bound to the guessed intrinsics
    np.testing.assert_allclose(np.linalg.svd(model.E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-9)


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("method", FITS)
def test_same_seed_gives_the_same_bits(method: str, calibrated: bool) -> None:
    hard = make_scene(**HARD)
    options = options_of(method, seed=3, max_iterations=500)
    fits = [late(hard, options, calibrated=calibrated) for _ in range(2)]
    assert fits[0] is not None
    for name in ("M", "E", "R", "t"):
        np.testing.assert_array_equal(getattr(fits[0], name), getattr(fits[1], name))
    assert (fits[0].origin, fits[0].confidence) == (fits[1].origin, fits[1].confidence)


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("method", FITS)
def test_another_seed_draws_other_samples(method: str, calibrated: bool) -> None:
    hard = make_scene(right=40, wrong=160, noise_px=1.0)
    fits = [late(hard, options_of(method, seed=s, max_iterations=50), calibrated=calibrated) for s in range(6)]
    assert len({fit.M.tobytes() for fit in fits if fit is not None}) > 1


@pytest.mark.parametrize("scene", [make_scene(), make_scene(**HARD)], ids=["easy", "hard"])
def test_permuting_the_matches_changes_nothing(scene: Scene) -> None:
    shuffled = permuted(scene, np.random.default_rng(0).permutation(len(scene.inlier)))
    for one, other in ((early(scene), early(shuffled)), (late(scene), late(shuffled))):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one.E, other.E)
    assert late(scene) is not None


@pytest.mark.parametrize("kind", ["general", "wide", "skew"])
def test_swapping_the_images_inverts_the_pose(kind: str) -> None:
    scene = make_scene(kind)
    swapped = replace(scene, points1=scene.points2, points2=scene.points1)
    for one, other in ((early(scene), early(swapped)), (late(scene), late(swapped))):
        assert one is not None
        assert pose_error_deg(other.R, other.t, one.R.T, -one.R.T @ one.t) < 0.3


def test_a_keypoint_in_many_matches_bears_witness_once(scene: Scene) -> None:
    """A crowd around one keypoint, all of it near another epipolar geometry, moves neither pose nor confidence."""
    target = int(np.argmin(scene.attributes.ratio))
    model = late(scene)
    epipole_side = scene.points1 + np.random.default_rng(0).normal(0, 40, scene.points1.shape)
    crowd = replace(
        permuted(scene, np.full(150, target)),
        points1=np.repeat(epipole_side[:150], 1, axis=0),
        inlier=np.zeros(150, dtype=bool),
        attributes=replace(scene.attributes.take(np.full(150, target)), ratio=np.full(150, 0.79, np.float32)),
    )
    crowded = joined(scene, crowd)
    margins = 8.0 * (0.8 - crowded.attributes.ratio)
    other = late(crowded, margins=margins)
    assert error_deg(other, scene) < error_deg(model, scene) + 0.3
    witnesses = scored(crowded, margins)
    assert len(other.judgement.distance_px) == np.count_nonzero(witnesses.once) < 205
    assert other.judgement.features["log share"] == pytest.approx(model.judgement.features["log share"], abs=0.05)


# --- The end before the network ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("right", "wrong"), [(150, 30), (400, 300)])
def test_an_easy_list_needs_no_network(right: int, wrong: int, seed: int) -> None:
    scene = make_scene(right=right, wrong=wrong, seed=seed)
    model = early(scene)
    assert model is not None
    assert model.ended == "before the network"
    assert error_deg(model, scene) < 1.0
    assert model.confidence > 0.9


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("kind", "right", "wrong"),
    [
        ("general", 60, 240),  # explains too little
        ("general", 30, 3),  # too few
        ("general", 0, 200),
    ],
)
def test_a_hard_list_asks_the_network(kind: str, right: int, wrong: int, seed: int) -> None:
    assert early(make_scene(kind, right=right, wrong=wrong, seed=seed)) is None


def test_a_plane_ends_early_with_the_right_pose_or_not_at_all() -> None:
    """Its pose is held loosely, and its twin comes near: mostly the network is asked."""
    planes = [make_scene("planar", right=200, wrong=20, seed=seed) for seed in range(8)]
    models = [early(plane) for plane in planes]
    assert sum(model is None for model in models) >= 4
    assert max(error_deg(m, p) for m, p in zip(models, planes) if m is not None) < 2.0


def test_a_turning_camera_holds_no_direction() -> None:
    turned = [early(make_scene("rotation", right=200, wrong=20, seed=seed)) for seed in range(8)]
    assert sum(model is None for model in turned) >= 6


def test_without_intrinsics_nothing_ends_early(runs: list) -> None:
    scene = make_scene(right=300, wrong=0)
    assert Search(before(scene, calibrated=False), COEFFICIENTS, FilterOptions()).before_network() is None
    assert not runs


def test_hopeless_lists_cost_one_run_before_the_network(runs: list) -> None:
    early(make_scene(right=0, wrong=200))
    assert [(options.method, options.max_iterations) for _, options, _ in runs] == [("magsac", 300)]
    runs.clear()
    early(make_scene(right=300, wrong=0))
    assert len(runs) == 1  # so do those that the first run explains
    runs.clear()
    early(make_scene(right=120, wrong=120))
    assert [options.seed for _, options, _ in runs] == [0, 4]  # between the two the second has a try


def test_what_was_found_early_is_known_later(runs: list) -> None:
    scene = make_scene(right=90, wrong=120)
    search = Search(before(scene), COEFFICIENTS, FilterOptions(), replace(PLAN, settle=False))
    assert search.before_network() is None
    assert search.current() is not None
    tried = len(runs)
    model = search.with_network(scored(scene))
    assert error_deg(model, scene) < 1.0
    assert len(runs) - tried == len(FIRST) - 1 + len(SECOND) - (tried - 1)  # no source draws the same twice


def test_scores_of_an_early_end_tell_right_from_wrong() -> None:
    scene = make_scene(right=150, wrong=100)
    points1, best = scene.points1.copy(), np.ones(250, dtype=bool)
    best[np.flatnonzero(~scene.inlier)[:40]] = False  # a raw list: some are not even listed
    points1[0] = np.nan
    pair = prepared(replace(scene, points1=points1, attributes=replace(scene.attributes, best=best)))
    model = early(scene)
    scores = scores_by_residuals(pair, model, COEFFICIENTS)
    assert scores.dtype == np.float32
    assert scores[0] == 0.0
    assert 0.0 <= scores.min() < scores.max() <= 1.0
    right, wrong = scores[1:][scene.inlier[1:]], scores[1:][~scene.inlier[1:]]
    assert np.mean(right > 0.5) > 0.95
    assert np.mean(wrong > 0.5) < 0.1


# --- Sources, with the network ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["prosac", "magsac", "ransac"])
@pytest.mark.parametrize("calibrated", [True, False])
def test_a_method_that_is_asked_for_runs_alone(method: str, calibrated: bool, runs: list) -> None:
    model = late(make_scene(**HARD), FilterOptions(method=method), calibrated=calibrated, network_essential=np.eye(3))
    assert [(options.method, kind) for _, options, kind in runs] == [(method, calibrated)]
    assert model is not None
    assert model.origin == method


def test_a_method_that_is_asked_for_runs_alone_whatever_was_found_before(runs: list) -> None:
    hard = make_scene(right=80, wrong=120)
    search = Search(before(hard), COEFFICIENTS, FilterOptions(method="magsac"))
    search.before_network()
    runs.clear()
    assert search.with_network(scored(hard)).origin == "magsac"
    assert len(runs) == 1


@pytest.mark.parametrize("calibrated", [True, False])
def test_poselib_joins_the_others(calibrated: bool, runs: list) -> None:
    pytest.importorskip("poselib")
    hard = make_scene(**HARD)
    late(hard, FilterOptions(method="poselib"), calibrated=calibrated)
    methods = [options.method for _, options, _ in runs]
    assert methods.count("poselib") == 1
    assert {"magsac", "prosac"} <= set(methods)
    runs.clear()
    late(hard, calibrated=calibrated)
    assert "poselib" not in [options.method for _, options, _ in runs]


def test_poselib_runs_even_where_the_first_agree(runs: list) -> None:
    pytest.importorskip("poselib")
    scene = make_scene(right=200, wrong=20)
    assert late(scene, FilterOptions(method="poselib"), network_essential=scene.E).ended == "all sources"
    assert [options.method for _, options, _ in runs].count("poselib") == 1


def test_where_unlike_sources_agree_the_second_are_left_out(runs: list) -> None:
    scene = make_scene(right=200, wrong=20)
    model = late(scene, network_essential=scene.E)
    assert model.ended == "first sources"
    assert len(runs) == len(FIRST) - 1  # the network runs nothing
    runs.clear()
    assert late(scene, plan=replace(PLAN, settle=False), network_essential=scene.E).ended == "all sources"
    assert len(runs) == len(FIRST) - 1 + len(SECOND)


def test_where_hope_is_lost_the_second_are_left_out(runs: list) -> None:
    assert late(make_scene(right=0, wrong=300)).ended == "first sources"
    assert len(runs) == len(FIRST) - 1


def few_and_noisy(seed: int) -> Scene:
    return make_scene("planar", right=60, wrong=30, noise_px=2.5, seed=seed)


def test_of_few_matches_the_expected_best_is_answered_and_the_best_explanation_is_judged() -> None:
    differing = 0
    for seed in range(12):
        scene = few_and_noisy(seed)
        model = late(scene)
        plain = late(scene, plan=replace(PLAN, expected=False))
        for name in ("M", "E", "R", "t", "origin", "ended", "confidence"):
            np.testing.assert_array_equal(getattr(model, name), getattr(plain, name))
        assert plain.expected is None
        assert plain.answer is plain
        if model.expected is None:
            assert model.answer is model
            continue
        differing += 1
        answer = model.answer
        assert answer.origin == robust_fit.EXPECTED
        assert answer.answer is answer
        np.testing.assert_array_equal(answer.E, essential_from_pose(answer.R, answer.t))
        assert pose_error_deg(answer.R, answer.t, model.R, model.t) >= robust_fit.EXPECTED_DEG
    assert differing >= 3


def test_nothing_is_expected_of_many_matches_nor_of_a_sure_or_hopeless_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(robust_fit, "expected_best", lambda rows, *others: asked.append(len(rows)))
    late(few_and_noisy(0))
    assert asked == [90]
    late(make_scene("planar", right=60, wrong=200, noise_px=2.5))
    late(make_scene(right=100, wrong=20))
    late(make_scene(right=0, wrong=150))
    late(few_and_noisy(0), FilterOptions(method="magsac"))
    late(few_and_noisy(0), calibrated=False)
    assert asked == [90]


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("method", FITS)
def test_options_reach_every_run(method: str, calibrated: bool, runs: list) -> None:
    hard = make_scene(**HARD)
    late(hard, options_of(method, confidence=0.77, max_iterations=60, seed=1000), calibrated=calibrated)
    early(hard, options_of(method, confidence=0.77, max_iterations=60, seed=1000))
    assert {options.confidence for _, options, _ in runs} == {0.77}
    assert {options.max_iterations for _, options, _ in runs} == {60}
    assert min(options.seed for _, options, _ in runs) == 1000
    runs.clear()
    late(hard, options_of(method, max_iterations=100_000), calibrated=calibrated)
    assert max(options.max_iterations for _, options, _ in runs) <= 10_000  # each source has its own limit
    assert min(options.max_iterations for _, options, _ in runs) >= 300


@pytest.mark.parametrize("change", [{"max_iterations": 2}, {"confidence": 1e-6}, {"seed": 7}], ids=str)
def test_every_option_changes_the_answer(change: dict) -> None:
    def answers(options: FilterOptions) -> list[bytes]:
        models = [late(make_scene(right=90, wrong=60, noise_px=0.8, seed=seed), options) for seed in range(3)]
        return [b"" if model is None else model.E.tobytes() for model in models]

    alone = FilterOptions(method="magsac", max_iterations=300)
    assert answers(replace(alone, **change)) != answers(alone)


def test_what_the_network_proposes_can_win(monkeypatch: pytest.MonkeyPatch) -> None:
    hard = make_scene(**HARD)
    nearby = essential_from_pose(rotation_from_vector(np.array([0.001, -0.001, 0.001])) @ hard.R, hard.t)
    monkeypatch.setattr(sources, "fit_epipolar", lambda *arguments: None)
    model = late(hard, network_essential=(-3.0 * nearby).astype(np.float32))
    assert model.origin == "network"
    assert error_deg(model, hard) < 1.0
    assert model.M.dtype == np.float64
    assert late(hard) is None


@pytest.mark.parametrize("proposal", [np.full((3, 3), np.nan), np.zeros((3, 3)), None], ids=["nan", "zero", "none"])
def test_a_useless_network_e_is_none(proposal: np.ndarray | None) -> None:
    hard = make_scene(**HARD)
    model, expected = late(hard, network_essential=proposal), late(hard)
    np.testing.assert_array_equal(model.E, expected.E)
    assert model.confidence == expected.confidence


def test_a_wrong_network_e_does_no_harm(scene: Scene) -> None:
    assert error_deg(late(scene, network_essential=np.eye(3)), scene) < 1.0


def test_guessed_intrinsics_have_no_use_for_the_networks_answer(scene: Scene) -> None:
    models = [late(scene, calibrated=False, network_essential=E) for E in (scene.E, None)]
    np.testing.assert_array_equal(models[0].M, models[1].M)


def test_the_network_decides_which_matches_count() -> None:
    """Two motions in one list: the scores tell which of them is meant."""
    one = make_scene(right=70, wrong=0, seed=1)
    other = make_scene("wide", right=70, wrong=0, seed=2)
    both = joined(one, other)
    for first, truth in ((4.0, one), (-4.0, other)):
        margins = np.concatenate([np.full(70, first), np.full(70, -first)])
        assert error_deg(late(both, margins=margins), truth) < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_twin_under_a_plane_is_proposed(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sampling looks at no depths: here every run meets the pose that only the plane allows."""
    scene, twin = plane_with_twin(seed=seed)
    monkeypatch.setattr(sources, "fit_epipolar", lambda *arguments: twin)
    model = late(scene)
    assert model.origin == "plane"
    assert error_deg(model, scene) < 0.5
    assert early(scene).origin == "plane"
    without = replace(PLAN, twins=False)
    assert error_deg(late(scene, plan=without), scene) > 20.0
    assert early(scene, plan=without) is None


@pytest.mark.parametrize("method", FITS)
@pytest.mark.parametrize("count", range(MIN_MATCHES))
def test_too_few_matches_give_none(method: str, count: int, scene: Scene) -> None:
    few = permuted(scene, np.arange(count))
    repeated = permuted(scene, np.repeat(np.arange(count), 20))
    for matches in (few, repeated):
        assert early(matches) is None
        assert late(matches, options_of(method)) is None


@pytest.mark.parametrize("method", FITS)
@pytest.mark.parametrize("calibrated", [True, False])
def test_degenerate_points_do_not_raise(method: str, calibrated: bool) -> None:
    rng = np.random.default_rng(0)
    scene = make_scene(right=30, wrong=0)
    line = np.linspace(0, 400, 30)[:, None] * [1.0, 0.5]
    for points1, points2 in (
        (line, line),
        (line, line + [9.0, 0.0]),
        (rng.uniform(0, 400, (30, 2)), rng.uniform(0, 400, (30, 2))),
        (np.eye(30, 2), np.eye(30, 2)),
    ):
        model = late(replace(scene, points1=points1, points2=points2), options_of(method), calibrated=calibrated)
        assert model is None or np.isfinite(model.E).all()


def test_one_estimator_alone_is_the_classical_pipeline(scene: Scene) -> None:
    """Neither scores nor refinement: what cv2.findEssentialMat gives on the same list."""
    rows = normalized(scene)[np.argsort(scene.attributes.ratio, kind="stable")]
    expected, _ = cv2.findEssentialMat(
        rows[:, :2], rows[:, 2:], np.eye(3), method=cv2.USAC_MAGSAC, prob=0.99, threshold=0.75 / FOCAL, maxIters=200
    )
    model = fit_alone(before(scene), "magsac", 0.75, FilterOptions(confidence=0.99, max_iterations=200))
    np.testing.assert_allclose(model.M, expected / np.linalg.norm(expected), atol=1e-9)
    assert error_deg(model, scene) < 2.0
    assert model.confidence is None
    assert fit_alone(before(permuted(scene, np.arange(5))), "magsac", 0.75, FilterOptions()) is None
    assert sorted(ALONE) == ["magsac", "prosac", "ransac"]


def with_coarse_keypoints(seed: int) -> Scene:
    """A third of the right matches is fine, the rest coarse, as the sizes of their keypoints tell."""
    fine = make_scene(right=50, wrong=20, noise_px=0.1, seed=seed)
    coarse = make_scene(right=100, wrong=40, noise_px=0.8, seed=seed + 100)
    scene = joined(fine, coarse)
    size = np.repeat([1.0, 8.0], [70, 140]).astype(np.float32)
    return replace(scene, attributes=replace(scene.attributes, size1=size, size2=size))


@pytest.mark.parametrize("fit", [early, late])
def test_the_last_refinement_knows_which_keypoints_are_fine(fit) -> None:
    plain = replace(PLAN, last_refinement=False)
    errors = np.array(
        [
            [error_deg(fit(scene), scene), error_deg(fit(scene, plan=plain), scene)]
            for scene in map(with_coarse_keypoints, range(6))
        ]
    )
    assert errors.mean(axis=0)[0] < 0.8 * errors.mean(axis=0)[1]


def slow_camera(seed: int) -> Scene:
    """Tracks that move by 8 pixels, a fifth of them lost: those lie anywhere, hundreds of pixels apart."""
    tracks = make_tracks(8.0, 0.1, seed)
    points1, points2 = (
        (points - TRACKS_K[:2, 2]) / TRACKS_K[0, 0] * K[0, 0] + K[:2, 2] for points in (tracks.points1, tracks.points2)
    )
    return Scene(points1, points2, tracks.right, tracks.R, tracks.t / np.linalg.norm(tracks.t), MatchAttributes())


def test_the_last_refinement_gives_wrong_matches_no_lever() -> None:
    plain, errors = replace(PLAN, last_refinement=False), []
    for scene in map(slow_camera, range(20)):
        # Most of the list agrees with the pose: then what the network says of a match hardly counts.
        blind = np.zeros(len(scene.inlier))
        found, before_it = late(scene, margins=blind), late(scene, plan=plain, margins=blind)
        errors.append([error_deg(found, scene), error_deg(before_it, scene)])
    ours, without = np.exp(np.log(errors).mean(axis=0))
    assert ours < 0.65 * without


def test_the_last_refinement_trusts_scores_unless_the_list_knows_better() -> None:
    # A third of the matches is wrong and lies near the epipolar lines all the same.
    scene = make_scene(right=100, wrong=0, noise_px=0.2)
    shifted = make_scene(right=50, wrong=0, noise_px=0.2, seed=5)
    shifted = replace(shifted, points2=shifted.points2 + [0.0, 1.5], inlier=np.zeros(50, dtype=bool))
    mixed = joined(scene, shifted, make_scene(right=0, wrong=150, seed=6))
    margins = np.where(mixed.inlier, 4.0, -6.0)
    known, blind = late(mixed, margins=margins), late(mixed, margins=np.zeros(len(margins)))
    assert known is not None
    assert blind is not None
    assert error_deg(known, mixed) < 0.7 * error_deg(blind, mixed)


def test_pose_puts_points_in_front_however_far() -> None:
    far = make_scene(noise_px=0.0, wrong=0)
    rows = normalized(far)
    E = cross_matrix(far.t * 1e-3) @ far.R
    pose = pose_from_essential(E, rows, FOCAL)
    assert pose is not None
    assert pose_error_deg(*pose, far.R, far.t) < 1e-3
    assert float(pose[1] @ far.t) > 0
    for useless in (np.zeros((3, 3)), np.full((3, 3), np.inf)):
        assert pose_from_essential(useless, rows, FOCAL) is None
    assert pose_from_essential(E, np.zeros((0, 4)), FOCAL) is None
