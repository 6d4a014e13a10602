"""The public door: results, laws of the flow, and every option makes a difference."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from inspect import signature
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import METADATA, SIZE, K, Scene, build_model, make_scene

import mgca_filter
from mgca_filter import FilterResult, MatchAttributes, MatchFilter, MatchPair, Status, filter_many, filter_matches
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg, sampson_distance
from mgca_filter.inference.calibration import largest_set_of_precision
from mgca_filter.inference.scoring import MAX_NETWORK_MATCHES


def run(scene: Scene, model_file: Path, **options: object) -> FilterResult:
    options = {"K1": K, "attributes": scene.attributes, "model": model_file, **options}
    return filter_matches(scene.points1, scene.points2, None, **options)


def assert_same(one: FilterResult, other: FilterResult) -> None:
    for name in ("mask", "scores", "E", "F", "R", "t"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.status is other.status


def test_three_positional_arguments_are_enough(scene: Scene, model_file: Path) -> None:
    result = filter_matches(*scene.keypoints(), scene.knn_matches(), model=model_file)
    assert result.status is Status.OK
    assert result.info["intrinsics"] == "estimated"
    focal1, focal2 = result.info["focal_px"]
    assert 0.25 * K[0, 0] < focal1 == focal2 < 4.0 * K[0, 0]
    assert len(result.info["assumptions"]) == 3
    assert np.mean(result.mask == scene.inlier) > 0.95


def test_the_doors_take_the_same_arguments() -> None:
    """The lists that a reader sees are written out; none of them may fall behind."""
    pair, options = dict(signature(MatchPair).parameters), signature(MatchFilter).parameters
    assert pair.pop("stretch1").default is pair.pop("stretch2").default is None  # for pipelines: MatchPair alone
    function, method = signature(filter_matches).parameters, signature(MatchFilter.filter).parameters
    shared_K = {"K": None}  # another word for K1 alone
    assert {name: p.default for name, p in function.items()} == {
        **{name: p.default for name, p in {**pair, **options}.items()},
        **shared_K,
    }
    assert {p.name: p.default for p in list(method.values())[1:]} == {
        **{p.name: p.default for p in pair.values()},
        **shared_K,
    }
    assert [p.name for p in method.values()][1:4] == ["kp1", "kp2", "matches"]


def test_result_holds_what_it_promises(scene: Scene, model_file: Path) -> None:
    result = run(scene, model_file, effort="full")
    assert result.status is Status.OK
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 1.0
    assert result.H is None
    assert 0.9 < result.confidence <= 1.0
    assert result.info["translation_sigma_deg"] < 1.0
    assert result.mask.dtype == bool
    assert result.mask.shape == result.scores.shape == (200,)
    assert result.scores.dtype == np.float32
    assert result.num_inliers == result.mask.sum() == len(result.matches)
    assert result.info["logits"].dtype == np.float32
    assert result.info["backend"] == "onnxruntime"
    assert result.info["model"] == "ratio_test"
    assert len(result.info["model_sha256"]) == 64
    assert result.info["intrinsics"] == "given"
    assert set(result.info["timings_ms"]) == {"prepare", "network", "fit", "verdict", "total"}
    np.testing.assert_array_equal(result.info["fitted_essential"], result.E)
    np.testing.assert_allclose(np.linalg.svd(result.E, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-9)
    pixels = np.hstack([scene.points1, scene.points2])
    np.testing.assert_array_equal(result.mask, sampson_distance(pixels, result.F) < 1.0)
    assert len({result, run(scene, model_file)}) == 2  # compared by identity: arrays have no one answer
    kept = f"{result.num_inliers} of 200 matches kept, confidence {result.confidence:.2f}"
    assert repr(result) == f"FilterResult(status='ok', {kept})"
    with pytest.raises(AttributeError):
        result.mask = result.mask  # type: ignore[misc]


def test_every_type_of_input_gives_the_same_answer(scene: Scene, model_file: Path) -> None:
    options = {"K1": K, "attributes": scene.attributes, "model": model_file}
    rows = np.arange(200)
    reference = filter_matches(scene.points1, scene.points2, None, **options)
    for kp1, kp2, matches in (
        (scene.points1[:, None], scene.points2[:, None], np.stack([rows, rows], axis=1)),
        (scene.points1.tolist(), scene.points2.tolist(), tuple(cv2.DMatch(i, i, float(i)) for i in range(200))),
    ):
        assert_same(filter_matches(kp1, kp2, matches, **options), reference)


def test_kept_matches_come_in_the_callers_type(scene: Scene, model_file: Path) -> None:
    kp1, kp2 = scene.keypoints()
    knn = scene.knn_matches()
    result = filter_matches(kp1, kp2, knn, model=model_file)
    assert result.matches == [knn[i] for i in np.flatnonzero(result.mask)]
    flat = [row[0] for row in knn]
    result = filter_matches(kp1, kp2, flat, model=model_file)
    assert result.matches == [flat[i] for i in np.flatnonzero(result.mask)]


def test_permuting_the_matches_permutes_the_answer(scene: Scene, model_file: Path) -> None:
    order = np.random.default_rng(0).permutation(200)
    shuffled = replace(
        scene,
        points1=scene.points1[order],
        points2=scene.points2[order],
        attributes=scene.attributes.take(order),
    )
    for effort in ("auto", "full"):
        one, other = run(scene, model_file, effort=effort), run(shuffled, model_file, effort=effort)
        np.testing.assert_allclose(one.scores[order], other.scores, atol=1e-6)
        np.testing.assert_array_equal(one.mask[order], other.mask)
        np.testing.assert_array_equal(one.E, other.E)


def test_swapping_the_images_inverts_the_pose(scene: Scene, model_file: Path) -> None:
    swapped = replace(scene, points1=scene.points2, points2=scene.points1)
    one, other = run(scene, model_file), run(swapped, model_file)
    assert pose_error_deg(other.R, other.t, one.R.T, -one.R.T @ one.t) < 0.5


def test_scaling_pixels_with_the_intrinsics_changes_nothing(scene: Scene, model_file: Path) -> None:
    doubled = replace(scene, points1=2 * scene.points1, points2=2 * scene.points2)
    K2x = np.diag([2.0, 2.0, 1.0]) @ K
    one = run(scene, model_file, threshold=0.5, effort="full")
    other = run(doubled, model_file, K1=K2x, threshold=1.0, effort="full")
    assert pose_error_deg(other.R, other.t, one.R, one.t) < 0.5
    np.testing.assert_allclose(one.scores, other.scores, atol=1e-6)


def test_same_seed_gives_the_same_bits(scene: Scene, model_file: Path) -> None:
    assert_same(run(scene, model_file, seed=5), run(scene, model_file, seed=5))


def test_threshold_moves_the_mask_only(scene: Scene, model_file: Path) -> None:
    tight, loose = run(scene, model_file, threshold=0.1), run(scene, model_file, threshold=5.0)
    np.testing.assert_array_equal(tight.E, loose.E)
    assert tight.num_inliers < run(scene, model_file).num_inliers < loose.num_inliers


NOISY = make_scene(right=60, wrong=240, noise_px=0.8)


@pytest.fixture(scope="module")
def noisy(model_file: Path) -> dict[bool, FilterResult]:
    """Answers to a noisy scene with the defaults: with intrinsics, and without, as where a size is to help."""
    return {False: run(NOISY, model_file), True: run(NOISY, model_file, K1=None)}


@pytest.mark.parametrize(
    "change",
    [
        {"method": "magsac"},
        {"method": "ransac"},
        {"method": "prosac"},
        {"method": "none"},
        {"geometry": "fundamental"},
        {"geometry": "homography"},
        {"max_iterations": 3},
        {"confidence": 0.01},
        {"seed": 1},
        {"K1": None},
        {"K2": np.diag([1.2, 1.2, 1.0]) @ K},
        {"dist1": [0.2, -0.1, 0.0, 0.0]},
        {"dist2": [0.2, -0.1, 0.0, 0.0]},
        {"attributes": None},
        {"K1": None, "size1": (4000, 3000)},
        {"K1": None, "size2": (4000, 3000)},
    ],
    ids=lambda change: "-".join(change),
)
def test_every_option_changes_the_answer(change: dict, noisy: dict[bool, FilterResult], model_file: Path) -> None:
    one, other = noisy["size" in str(change)], run(NOISY, model_file, **change)
    assert one.E is not None
    assert other.E is None or not np.array_equal(one.E, other.E)


def test_poselib_finds_the_pose(scene: Scene, model_file: Path) -> None:
    pytest.importorskip("poselib")
    result = run(scene, model_file, method="poselib")
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 1.0


def test_method_none_keeps_what_the_network_believes(scene: Scene, model_file: Path) -> None:
    result = run(scene, model_file, method="none")
    np.testing.assert_array_equal(result.mask, result.scores > 0.5)
    assert result.E is None
    assert result.F is None
    assert result.R is None
    assert result.status is Status.OK
    assert result.info["network_essential"].shape == (3, 3)


def test_what_the_verdict_rejects_can_still_be_seen(model_file: Path) -> None:
    result = run(make_scene("rotation"), model_file)
    assert result.E is None
    assert result.info["fitted_essential"].shape == (3, 3)
    assert run(make_scene(), model_file, method="none").info["fitted_essential"] is None


@pytest.mark.parametrize("precision", [0.55, 0.8, 0.95])
def test_largest_set_of_precision(precision: float) -> None:
    scores = np.random.default_rng(0).choice(np.linspace(0, 1, 23), 300).astype(np.float32)
    kept = largest_set_of_precision(scores, precision)
    assert scores[kept].mean() >= precision - 1e-6
    next_best = scores[~kept].max()
    assert scores[scores >= next_best].mean() < precision
    assert scores[kept].min() > next_best
    order = np.random.default_rng(1).permutation(300)
    np.testing.assert_array_equal(largest_set_of_precision(scores[order], precision), kept[order])
    assert not largest_set_of_precision(np.full(9, 0.5, np.float32), precision).any()
    assert largest_set_of_precision(np.zeros(0, np.float32), precision).shape == (0,)


@pytest.mark.parametrize("method", ["prosac", "none"])
def test_keep_precision_replaces_the_threshold(scene: Scene, model_file: Path, method: str) -> None:
    loose, tight = (run(scene, model_file, method=method, keep_precision=p) for p in (0.7, 0.95))
    for result, precision in ((loose, 0.7), (tight, 0.95)):
        np.testing.assert_array_equal(result.mask, largest_set_of_precision(result.scores, precision))
        assert result.num_inliers == len(result.matches) == result.mask.sum()
    assert loose.num_inliers > tight.num_inliers > 0
    np.testing.assert_array_equal(loose.E, run(scene, model_file, method=method, threshold=9.0).E)


def test_keep_precision_keeps_nothing_without_a_model(model_file: Path) -> None:
    lost = make_scene(right=0, wrong=300, seed=1)
    result = run(lost, model_file, keep_precision=0.1)
    assert result.E is None
    assert not result.mask.any()
    bad = np.where(np.arange(200)[:, None] < 50, np.nan, make_scene().points1)
    kept = filter_matches(bad, make_scene().points2, None, K1=K, keep_precision=0.01, model=model_file).mask
    assert kept[50:].all()
    assert not kept[:50].any()


def test_keep_precision_that_keeps_nothing_is_told(
    scene: Scene, model_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    none, some = (run(scene, model_file, keep_precision=p, effort="full") for p in (0.9999, 0.7))
    assert not none.mask.any()
    assert none.E is not None
    told = f"keep_precision=0.9999 keeps no match, for the best score is {none.scores.max():.2f}"
    assert none.info["assumptions"][-1].startswith(told)
    assert caplog.messages == [none.info["assumptions"][-1]]
    assert not any("keep_precision" in text for text in some.info["assumptions"])


def test_second_intrinsics_default_to_the_first(scene: Scene, model_file: Path) -> None:
    one, other = run(scene, model_file, K1=K), run(scene, model_file, K1=K, K2=K)
    assert_same(one, other)
    assert one.info["assumptions"] == ["both images share K1"]
    assert other.info["assumptions"] == []


def test_distortion_is_undone(scene: Scene, model_file: Path) -> None:
    coefficients = np.array([-0.2, 0.05, 0.001, -0.001, 0.0])
    rays = [np.column_stack([(p - K[:2, 2]) / K[0, 0], np.ones(len(p))]) for p in (scene.points1, scene.points2)]
    bent = [cv2.projectPoints(r, np.zeros(3), np.zeros(3), K, coefficients)[0].reshape(-1, 2) for r in rays]
    distorted = replace(scene, points1=bent[0], points2=bent[1])
    result = run(distorted, model_file, dist1=coefficients)
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 1.0
    assert result.num_inliers > 110
    assert run(distorted, model_file).num_inliers < result.num_inliers


def test_attributes_of_the_caller_override_those_of_the_matches(scene: Scene, model_file: Path) -> None:
    kp1, kp2 = scene.keypoints()
    read = filter_matches(kp1, kp2, scene.knn_matches(), model=model_file)
    candidate = scene.attributes.ratio < 0.95
    expected = 6.4 - 8 * scene.attributes.ratio
    np.testing.assert_allclose(read.info["logits"][candidate], expected[candidate], atol=1e-4)
    worst = MatchAttributes(ratio=np.full(200, 0.9, dtype=np.float32))
    given = filter_matches(kp1, kp2, scene.knn_matches(), attributes=worst, model=model_file)
    np.testing.assert_allclose(given.info["logits"], -0.8, atol=1e-4)


def test_matches_that_are_no_candidates_score_by_the_prior_and_may_return(scene: Scene, model_file: Path) -> None:
    ratio = scene.attributes.ratio.copy()
    hopeless = np.flatnonzero(scene.inlier)[:20]
    ratio[hopeless] = 0.99
    attributes = replace(scene.attributes, ratio=ratio)
    result = run(scene, model_file, attributes=attributes, effort="full")
    assert result.info["num_network_matches"] == np.count_nonzero(ratio < 0.95)
    assert (result.scores[hopeless] < 0.5).all()
    assert (result.info["logits"][hopeless] < 0).all()
    assert result.mask[hopeless].mean() > 0.8


def test_calibration_of_the_model_file_is_applied(scene: Scene, tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx", {**METADATA, "calibration": '{"scale": 0.5, "offset": 1.0}'})
    result = run(scene, path, effort="full")
    expected = 1 / (1 + np.exp(-(0.5 * result.info["logits"] + 1.0)))
    np.testing.assert_allclose(result.scores, expected, rtol=1e-5)


def test_the_networks_own_essential_matrix_may_be_the_answer(tmp_path: Path) -> None:
    hard = make_scene(right=40, wrong=400)
    options = {"attributes": None, "confidence": 0.01}  # bare points, which all are accepted, and next to no sampling
    model = build_model(tmp_path / "m.onnx", essential=essential_from_pose(hard.R, hard.t))
    result = run(hard, model, **options)
    assert result.info["origin"] == "network"
    assert pose_error_deg(result.R, result.t, hard.R, hard.t) < 1.0
    unaided = run(hard, build_model(tmp_path / "n.onnx"), **options)
    assert unaided.R is None or pose_error_deg(unaided.R, unaided.t, hard.R, hard.t) > 5.0


@pytest.mark.parametrize("bare", [False, True])
def test_many_matches_are_all_tested(model_file: Path, bare: bool) -> None:
    scene = make_scene(right=14000, wrong=6000)
    attributes = None if bare else replace(scene.attributes, best=None)
    result = run(scene, model_file, attributes=attributes, effort="full")
    assert result.info["num_network_matches"] == MAX_NETWORK_MATCHES
    assert result.status is Status.OK
    assert result.mask[scene.inlier].mean() > 0.95
    assert result.mask[~scene.inlier].mean() < 0.1
    if not bare:
        sent = result.info["logits"] >= np.sort(result.info["logits"])[-MAX_NETWORK_MATCHES]
        assert scene.attributes.ratio[sent].max() <= scene.attributes.ratio[~sent].min() + 1e-6


def test_object_and_function_agree_and_pairs_batch(match_filter: MatchFilter, model_file: Path) -> None:
    scenes = [make_scene(seed=seed, right=100 + 10 * (seed % 2), wrong=50) for seed in range(4)]
    pairs = [MatchPair(s.points1, s.points2, None, K1=K, attributes=s.attributes) for s in scenes]
    singles = [run(s, model_file) for s in scenes]
    for one, other in zip(singles, match_filter.filter_many(pairs)):
        np.testing.assert_allclose(one.scores, other.scores, atol=1e-6)
        np.testing.assert_array_equal(one.mask, other.mask)
    tuples = filter_many([(s.points1, s.points2, None) for s in scenes], model=model_file)
    assert [len(r.mask) for r in tuples] == [150, 160, 150, 160]
    assert filter_many([], model=model_file) == []


def test_filter_is_thread_safe(match_filter: MatchFilter) -> None:
    scenes = [make_scene(seed=seed) for seed in range(8)]

    def work(s: Scene) -> FilterResult:
        return match_filter.filter(s.points1, s.points2, None, K1=K, attributes=s.attributes)

    with ThreadPoolExecutor(4) as pool:
        for one, other in zip(pool.map(work, scenes), map(work, scenes)):
            assert_same(one, other)


def test_filter_is_picklable(match_filter: MatchFilter, scene: Scene) -> None:
    again = pickle.loads(pickle.dumps(match_filter))
    arguments = (scene.points1, scene.points2, None)
    assert_same(again.filter(*arguments, K1=K), match_filter.filter(*arguments, K1=K))


def test_a_changed_model_file_is_read_again(scene: Scene, tmp_path: Path) -> None:
    path = build_model(tmp_path / "m.onnx")
    first = run(scene, path)
    build_model(path, {**METADATA, "name": "another model"})
    assert run(scene, path).info["model"] != first.info["model"]


@pytest.fixture(scope="module")
def photographs() -> tuple[np.ndarray, np.ndarray]:
    """Two views of a textured plane related by a homography, 1500 x 1200."""
    noise = np.random.default_rng(0).integers(0, 256, (100, 125)).astype(np.uint8)
    image = cv2.resize(noise, (1500, 1200), interpolation=cv2.INTER_CUBIC)
    H = np.array([[0.95, 0.03, 20.0], [-0.02, 0.97, 30.0], [2e-5, 1e-5, 1.0]])
    return image, cv2.warpPerspective(image, H, (1500, 1200))


@pytest.mark.parametrize("detector", ["sift", "rootsift", "orb", "brisk", cv2.SIFT.create(nfeatures=500)])
def test_match_images_in_pixels_of_the_originals(
    photographs: tuple[np.ndarray, np.ndarray], detector: object, model_file: Path
) -> None:
    found = mgca_filter.match_images(*photographs, detector=detector, max_keypoints=800, model=model_file)
    assert isinstance(found.keypoints1[0], cv2.KeyPoint)
    assert len(found.matches) == len(found.keypoints1) == len(found.result.mask)
    assert found.result.status in (Status.PLANAR, Status.PURE_ROTATION, Status.LOW_SUPPORT)  # the pose may be doubtful
    assert found.result.H is not None
    H = np.array([[0.95, 0.03, 20.0], [-0.02, 0.97, 30.0], [2e-5, 1e-5, 1.0]])
    kept = [row[0] for row in found.result.matches]
    source = np.array([[found.keypoints1[m.queryIdx].pt for m in kept]], dtype=np.float64)
    target = np.array([found.keypoints2[m.trainIdx].pt for m in kept])
    distance = np.linalg.norm(cv2.perspectiveTransform(source, H)[0] - target, axis=1)
    assert np.median(distance) < 1.5
    assert found.result.info["assumptions"][0].endswith("guessed from the image size")


@pytest.mark.slow
def test_match_images_finds_4000_rootsift_keypoints_unless_told_otherwise(
    photographs: tuple[np.ndarray, np.ndarray], model_file: Path
) -> None:
    options = {"model": model_file, "method": "none"}  # the fit takes most of the time
    default = mgca_filter.match_images(*photographs, **options)
    named = mgca_filter.match_images(*photographs, detector="rootsift", max_keypoints=4000, **options)
    plain = mgca_filter.match_images(*photographs, detector="sift", max_keypoints=4000, **options)
    few = mgca_filter.match_images(*photographs, max_keypoints=100, **options)

    def distances(found: mgca_filter.ImageMatchResult) -> list[float]:
        return [row[0].distance for row in found.matches]

    assert distances(default) == distances(named)
    assert max(distances(default)) < 2**0.5 < max(distances(plain))
    assert len(few.keypoints1) <= 101 < len(default.keypoints1) <= 4001


def test_match_images_with_a_matcher_of_opencv(photographs: tuple[np.ndarray, np.ndarray], model_file: Path) -> None:
    options = {"max_keypoints": 500, "model": model_file}
    plain = mgca_filter.match_images(*photographs, **options)
    crossed = mgca_filter.match_images(*photographs, matcher=cv2.BFMatcher(crossCheck=True), **options)
    flann = mgca_filter.match_images(*photographs, matcher=cv2.FlannBasedMatcher(), **options)
    assert len(crossed.matches) < len(plain.matches) == len(flann.matches)
    for found in (crossed, flann):
        assert len(found.matches) == len(found.result.mask)
        assert found.result.status in (Status.PLANAR, Status.PURE_ROTATION)
    with pytest.raises(TypeError, match="matcher: expected a cv2.DescriptorMatcher or None, got str"):
        mgca_filter.match_images(*photographs, matcher="flann", **options)


def test_match_images_of_blank_images(model_file: Path) -> None:
    blank = np.zeros((60, 80), dtype=np.uint8)
    found = mgca_filter.match_images(blank, blank, model=model_file)
    assert found.result.status is Status.TOO_FEW_MATCHES
    assert len(found.matches) == 0
    with pytest.raises(TypeError, match="detector"):
        mgca_filter.match_images(blank, blank, detector=7, model=model_file)


def test_sizes_help_the_guess(scene: Scene, model_file: Path) -> None:
    sized = run(scene, model_file, K1=None, size1=SIZE, size2=SIZE)
    assert sized.info["assumptions"][0] == "focal length 768 px of image 1 guessed from the image size"
    extent = run(scene, model_file, K1=None)
    assert "extent of the keypoints" in extent.info["assumptions"][0]


# --- Effort, geometry, limits -----------------------------------------------------------------------------------------

EASY, HARD = make_scene(right=150, wrong=50), make_scene(right=60, wrong=240)


@pytest.fixture
def asked(match_filter: MatchFilter, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many matches each call sent to the network."""
    (backend,), seen = match_filter._backends, []
    infer = backend.infer
    monkeypatch.setattr(backend, "infer", lambda *arrays: seen.append(arrays[0].shape[1]) or infer(*arrays))
    return seen


def ask(match_filter: MatchFilter, scene: Scene, **options: object) -> FilterResult:
    chosen = MatchFilter.over(*match_filter._backends, options=replace(match_filter.options, **options))
    return chosen.filter(scene.points1, scene.points2, None, K1=K, attributes=scene.attributes)


def test_an_easy_list_is_not_sent_to_the_network(match_filter: MatchFilter, asked: list[int]) -> None:
    result = ask(match_filter, EASY)
    assert asked == []
    assert result.info["ended"] == "before the network"
    assert result.info["num_network_matches"] == len(result.info["network_rows"]) == 0
    assert result.info["network_essential"] is None
    assert set(result.info["timings_ms"]) == {"prepare", "fit", "verdict", "total"}
    assert result.status is Status.OK
    assert pose_error_deg(result.R, result.t, EASY.R, EASY.t) < 1.0
    # The scores separate, and say the same as the logits do through the calibration.
    assert result.scores[EASY.inlier].min() > result.scores[~EASY.inlier].mean()
    assert np.mean(result.scores[EASY.inlier] > 0.5) > 0.95
    assert np.mean(result.scores[~EASY.inlier] > 0.5) < 0.1
    calibrated = match_filter.metadata.calibration.probabilities(result.info["logits"])
    np.testing.assert_allclose(calibrated, result.scores, atol=1e-4)


@pytest.mark.parametrize(
    ("scene", "options"),
    [(HARD, {}), (EASY, {"effort": "full"}), (EASY, {"geometry": "fundamental"}), (EASY, {"geometry": "homography"})]
    + [(EASY, {"method": method}) for method in ("prosac", "magsac", "ransac", "none")],
    ids=str,
)
def test_every_other_list_is(match_filter: MatchFilter, asked: list[int], scene: Scene, options: dict) -> None:
    result = ask(match_filter, scene, **options)
    assert len(asked) == 1
    assert result.info["ended"] != "before the network"
    assert result.info["num_network_matches"] == len(result.info["network_rows"]) == asked[0]
    assert "network" in result.info["timings_ms"]


def test_without_intrinsics_every_list_is(match_filter: MatchFilter, asked: list[int]) -> None:
    result = match_filter.filter(EASY.points1, EASY.points2, None, attributes=EASY.attributes)
    assert len(asked) == 1
    assert result.info["ended"] != "before the network"
    assert result.info["intrinsics"] == "estimated"
    assert result.confidence > 0.5


def test_a_list_that_explains_itself_is_filtered_by_itself(match_filter: MatchFilter, asked: list[int]) -> None:
    def pair(scene: Scene, intrinsics: np.ndarray | None) -> MatchPair:
        return MatchPair(scene.points1, scene.points2, None, K1=intrinsics, attributes=scene.attributes)

    assert_same(match_filter.filter_list(pair(EASY, K)), ask(match_filter, EASY))
    bare = match_filter.filter_list(pair(EASY, None))
    assert (bare.status, bare.R, bare.t, bare.E, bare.confidence) == (Status.OK, None, None, None, None)
    assert (bare.info["ended"], bare.info["intrinsics"]) == ("before the network", "guessed")
    assert bare.mask[EASY.inlier].mean() > 0.97
    assert bare.mask[~EASY.inlier].mean() < 0.1
    assert bare.scores[EASY.inlier].min() > bare.scores[~EASY.inlier].mean()
    error = sampson_distance(np.hstack([EASY.points1, EASY.points2])[EASY.inlier], bare.F)
    assert np.median(error) < 0.5
    assert match_filter.filter_list(pair(make_scene("planar", right=200, wrong=0), None)).status is Status.PLANAR
    assert match_filter.filter_list(pair(HARD, K)) is match_filter.filter_list(pair(HARD, None)) is None
    for options in ({"effort": "full"}, {"method": "magsac"}, {"method": "none"}, {"geometry": "homography"}):
        chosen = MatchFilter.over(*match_filter._backends, options=replace(match_filter.options, **options))
        assert chosen.filter_list(pair(EASY, K)) is None
    assert asked == []


def test_in_a_batch_only_the_hard_ones_are(match_filter: MatchFilter, asked: list[int]) -> None:
    pairs = [MatchPair(s.points1, s.points2, None, K1=K, attributes=s.attributes) for s in (EASY, HARD, EASY, HARD)]
    results = match_filter.filter_many(pairs)
    assert len(asked) == 1  # both in one batch
    assert [r.info["ended"] == "before the network" for r in results] == [True, False, True, False]
    assert_same(results[0], ask(match_filter, EASY))


@pytest.mark.parametrize("scene", [EASY, HARD], ids=["easy", "hard"])
def test_both_efforts_find_the_pose(match_filter: MatchFilter, scene: Scene) -> None:
    results = [ask(match_filter, scene, effort=effort) for effort in ("auto", "full")]
    for result in results:
        assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 1.0
    assert (results[0].info["ended"] == results[1].info["ended"]) == (scene is HARD)


def test_an_essential_matrix_needs_intrinsics(model_file: Path) -> None:
    with pytest.raises(ValueError, match="K1: geometry='essential'"):
        run(EASY, model_file, K1=None, geometry="essential")
    assert_same(run(EASY, model_file, geometry="essential"), run(EASY, model_file))


def test_a_fundamental_matrix_is_not_bound_to_the_intrinsics(model_file: Path) -> None:
    """Under a wrong K it fits as well as without one, and a list that E contradicts is not suspicious to it."""
    scene = make_scene("wide", right=200, wrong=40)
    wrong_K = np.array([[2400.0, 0.0, 1279.5], [0.0, 800.0, 959.5], [0.0, 0.0, 1.0]])
    assert run(scene, model_file, K1=wrong_K).status is Status.SUSPICIOUS_INTRINSICS
    for given in (K, wrong_K):
        result = run(scene, model_file, K1=given, geometry="fundamental")
        assert result.status is Status.OK
        assert result.confidence is None
        assert result.info["intrinsics"] == "given"
        pixels = np.hstack([scene.points1, scene.points2])
        assert np.mean(sampson_distance(pixels[scene.inlier], result.F) < 1.0) > 0.95
    values = np.linalg.svd(K.T @ run(scene, model_file, geometry="fundamental").F @ K, compute_uv=False)
    assert values[0] / values[1] > 1.0001


def test_a_homography_that_is_asked_for_comes_alone(model_file: Path) -> None:
    plane = make_scene("planar", right=120, wrong=80)
    result = run(plane, model_file, geometry="homography")
    assert result.status is Status.OK
    assert all(value is None for value in (result.E, result.F, result.R, result.t, result.confidence))
    mapped = cv2.perspectiveTransform(plane.points1[None], result.H)[0]
    assert np.median(np.linalg.norm(mapped - plane.points2, axis=1)[plane.inlier]) < 1.0
    assert result.mask[plane.inlier].mean() > 0.9
    assert result.mask[~plane.inlier].mean() < 0.05
    np.testing.assert_array_equal(result.info["homography"], result.H)
    lost = run(make_scene(right=0, wrong=200), model_file, geometry="homography")
    assert lost.status in (Status.UNRELATED, Status.NO_GEOMETRY)
    assert lost.H is None
    assert not lost.mask.any()
    few = filter_matches(plane.points1[:3], plane.points2[:3], None, geometry="homography", model=model_file)
    assert few.status is Status.TOO_FEW_MATCHES


def test_two_keypoints_and_more_of_one_match_are_one_witness(match_filter: MatchFilter) -> None:
    repeated = np.repeat(np.arange(200), 4)
    one = ask(match_filter, EASY)
    kp1, kp2 = EASY.points1, EASY.points2
    many = match_filter.filter(
        kp1, kp2, np.stack([repeated] * 2, axis=1), K1=K, attributes=EASY.attributes.take(repeated)
    )
    np.testing.assert_array_equal(many.E, one.E)
    assert many.confidence == one.confidence
    np.testing.assert_array_equal(many.mask, np.repeat(one.mask, 4))


@pytest.mark.parametrize("count", [6, 7])
def test_hardly_more_matches_than_a_pose_takes_are_an_answer_to_doubt(model_file: Path, count: int) -> None:
    near = 0
    for seed in range(10):
        scene = make_scene(right=count, wrong=0, seed=seed)
        result = run(scene, model_file)
        assert result.status in (Status.LOW_SUPPORT, Status.NO_GEOMETRY)  # never ok
        if result.t is not None:
            near += pose_error_deg(result.R, result.t, scene.R, scene.t) < 10.0
            np.testing.assert_array_equal(
                result.mask, sampson_distance(np.hstack([scene.points1, scene.points2]), result.F) < 1.0
            )
    assert near >= 7


def test_as_few_inliers_of_a_longer_list_are_none(model_file: Path) -> None:
    for seed in range(10):
        scene = make_scene(right=0, wrong=16, seed=seed)
        result = run(scene, model_file)
        assert result.t is None
        assert not result.mask.any()
