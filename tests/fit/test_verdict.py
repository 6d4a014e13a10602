"""From the model to the answer: what deserves trust, what is withheld, and which homography comes with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, Scene, make_scene
from fit_inputs import COEFFICIENTS, before, joined, plane_with_twin, prepared

from mgca_filter import FilterResult, MatchAttributes, MatchFilter, Status
from mgca_filter.fit import verdict as verdict_module
from mgca_filter.fit.evidence import MIN_MATCHES
from mgca_filter.fit.robust_fit import Search
from mgca_filter.fit.verdict import judge
from mgca_filter.geometry.epipolar import pose_error_deg, rotation_error_deg, sampson_distance
from mgca_filter.inputs.options import FilterOptions

HANDHELD_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


def run(match_filter: MatchFilter, scene: Scene, **options: object) -> FilterResult:
    options = {"K1": K, **options}
    return match_filter.filter(scene.points1, scene.points2, None, attributes=scene.attributes, **options)


def rms_px(H: np.ndarray, points1: np.ndarray, points2: np.ndarray) -> float:
    """Root mean square distance of the mapped points to where they should be."""
    difference = cv2.perspectiveTransform(points1[None], H)[0] - points2
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


def handheld(seed: int, move: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tracks of a slow hand-held camera, the first 60 of 600 wrong: the baseline is 0.8 % of the depth."""
    rng = np.random.default_rng(seed)
    R, _ = cv2.Rodrigues(np.array([0.002, 0.004, -0.001]))
    t = move * np.array([1.0, 0.1, 0.2])
    points1 = rng.uniform((0, 0), SIZE, (600, 2))
    X = np.column_stack([points1, np.ones(600)]) @ np.linalg.inv(HANDHELD_K).T * rng.uniform(4, 10, (600, 1))
    projected = (X @ R.T + t) @ HANDHELD_K.T
    points2 = projected[:, :2] / projected[:, 2:] + rng.normal(0, 0.1, (600, 2))
    points2[:60] = rng.uniform((0, 0), SIZE, (60, 2))
    return points1 + rng.normal(0, 0.1, (600, 2)), points2, R, t


def test_a_small_translation_is_one(match_filter: MatchFilter) -> None:
    errors = []
    for seed in range(5):
        points1, points2, R, t = handheld(seed)
        result = match_filter.filter(points1, points2, None, K1=HANDHELD_K)
        assert result.ok
        assert result.E is not None
        errors.append(pose_error_deg(result.R, result.t, R, t / np.linalg.norm(t)))
        assert result.info["translation_sigma_deg"] < 1.5
        assert result.mask[60:].all()
        assert result.mask[:60].mean() < 0.1
    assert np.median(errors) < 1.0
    assert max(errors) < 10.0


@pytest.mark.parametrize("seed", range(3))
def test_a_standing_camera_only_turns(match_filter: MatchFilter, seed: int) -> None:
    points1, points2, R, _ = handheld(seed, move=0.0)
    result = match_filter.filter(points1, points2, None, K1=HANDHELD_K)
    assert result.status is Status.PURE_ROTATION
    assert rotation_error_deg(result.R, R) < 0.1
    assert all(value is None for value in (result.E, result.F, result.t, result.confidence))
    assert result.mask[60:].all()
    assert rms_px(result.H, points1[60:], points2[60:]) < 0.3


@pytest.mark.parametrize("noise_px", [0.3, 1.0])
@pytest.mark.parametrize("zoom", [0.4, 0.6, 1.0, 1.6, 3.0])
def test_a_zoom_on_the_spot_is_a_rotation(match_filter: MatchFilter, zoom: float, noise_px: float) -> None:
    rng = np.random.default_rng(1)
    K2 = K * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]
    R, _ = cv2.Rodrigues(rng.normal(0, 0.03, 3))
    points1 = rng.uniform((0, 0), SIZE, (6000, 2))
    points2 = cv2.perspectiveTransform(points1[None], K2 @ R @ np.linalg.inv(K))[0]
    seen = np.flatnonzero(((points2 > 0) & (points2 < SIZE)).all(axis=1))[:250]
    ends = [p[seen] + rng.normal(0, noise_px, (len(seen), 2)) for p in (points1, points2)]
    ends1, ends2 = (np.vstack([p, rng.uniform((0, 0), SIZE, (80, 2))]) for p in ends)
    ratio = np.concatenate([rng.uniform(0.3, 0.85, len(seen)), rng.uniform(0.7, 1.0, 80)]).astype(np.float32)
    result = match_filter.filter(ends1, ends2, None, K1=K, K2=K2, attributes=MatchAttributes(ratio=ratio))
    assert result.status is Status.PURE_ROTATION
    assert rotation_error_deg(result.R, R) < 0.3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("kind", "status"), [("planar", Status.PLANAR), ("rotation", Status.PURE_ROTATION)], ids=["planar", "rotation"]
)
def test_the_homography_is_as_good_as_opencvs(match_filter: MatchFilter, kind: str, status: Status, seed: int) -> None:
    scene = make_scene(kind, 120, 80, seed=seed)
    result = run(match_filter, scene)
    assert result.status is status
    np.testing.assert_array_equal(result.H, result.info["homography"])
    assert result.H[2, 2] == 1.0
    theirs, _ = cv2.findHomography(scene.points1[result.mask], scene.points2[result.mask], cv2.USAC_MAGSAC, 2.0)
    right = scene.points1[scene.inlier], scene.points2[scene.inlier]
    assert rms_px(result.H, *right) < 1.05 * rms_px(theirs, *right) + 0.01


@pytest.mark.parametrize("kind", ["general", "wide", "skew"])
def test_a_scene_with_depth_has_no_homography(match_filter: MatchFilter, kind: str) -> None:
    result = run(match_filter, make_scene(kind))
    assert result.status is Status.OK
    assert result.H is None
    assert "homography" not in result.info


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_with_little_off_it_keeps_the_right_pose(match_filter: MatchFilter, seed: int) -> None:
    scene, _ = plane_with_twin(seed=seed)
    result = run(match_filter, scene)
    assert result.ok
    assert pose_error_deg(result.R, result.t, scene.R, scene.t) < 1.0


def planar_object(right: int, seed: int, wrong: int = 400) -> tuple[Scene, np.ndarray]:
    """A book on a table: few right matches, all on a small plane, among many wrong; and its homography."""
    rng = np.random.default_rng(seed)
    H = np.array([[0.9, 0.1, 30.0], [-0.08, 1.05, -20.0], [1e-4, 5e-5, 1.0]])
    points1 = rng.uniform([200, 150], [330, 260], (right, 2))
    points2 = cv2.perspectiveTransform(points1[None], H)[0]
    book = replace(
        make_scene(right=right, wrong=0, seed=seed),
        points1=points1 + rng.normal(0, 0.3, points1.shape),
        points2=points2 + rng.normal(0, 0.3, points2.shape),
        attributes=MatchAttributes(ratio=rng.uniform(0.4, 0.85, right).astype(np.float32)),
    )
    return joined(book, make_scene(right=0, wrong=wrong, seed=seed)), H


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("right", [15, 25, 40])
def test_a_small_planar_object_is_found(match_filter: MatchFilter, right: int, seed: int) -> None:
    scene, H = planar_object(right, seed)
    result = run(match_filter, scene)
    assert result.status in (Status.PLANAR, Status.LOW_SUPPORT)
    corners = np.array([[200.0, 150.0], [330.0, 150.0], [330.0, 260.0], [200.0, 260.0]])
    mapped = [cv2.perspectiveTransform(corners[None], M)[0] for M in (result.H, H)]
    assert np.linalg.norm(mapped[0] - mapped[1], axis=1).max() < 3.0
    assert result.mask[scene.inlier].mean() > 0.8
    assert result.mask[~scene.inlier].mean() < 0.05


@pytest.mark.parametrize("intrinsics", [K, None])
def test_only_wrong_matches_lie_on_no_plane(match_filter: MatchFilter, intrinsics: np.ndarray | None) -> None:
    for seed in range(10):
        result = run(match_filter, make_scene(right=0, wrong=300, seed=seed), K1=intrinsics)
        assert result.status in (Status.UNRELATED, Status.NO_GEOMETRY)
        assert all(value is None for value in (result.E, result.F, result.R, result.t, result.H, result.confidence))


@pytest.mark.parametrize(
    ("kind", "options"),
    [("general", {"geometry": "fundamental"}), ("planar", {"K1": None}), ("rotation", {}), ("collinear", {})],
    ids=["fundamental", "guessed-plane", "rotation", "collinear"],
)
def test_no_confidence_where_no_pose_is_claimed(model_file: Path, kind: str, options: dict) -> None:
    options = dict(options)
    match_filter = MatchFilter(model=model_file, geometry=options.pop("geometry", "auto"))
    assert run(match_filter, make_scene(kind), **options).confidence is None


def test_confidence_falls_as_wrong_matches_drown_the_right_ones(match_filter: MatchFilter) -> None:
    means = []
    for wrong in (0, 100, 300, 600):
        results = [run(match_filter, make_scene(right=40, wrong=wrong, seed=seed)) for seed in range(3)]
        assert all(0.0 <= result.confidence <= 1.0 for result in results)
        means.append(np.mean([result.confidence for result in results]))
    assert means == sorted(means, reverse=True)
    assert means[0] > 0.9


def judged(scene: Scene, confidence: float | None, limits: tuple[float, float] = (0.1, 0.5)) -> object:
    """The verdict on a pose of a given confidence."""
    model = Search(before(scene), COEFFICIENTS, FilterOptions()).before_network()
    coefficients = {**COEFFICIENTS, "verdict": limits}
    options = FilterOptions()
    return judge(prepared(scene), replace(model, confidence=confidence), before(scene), 1.0, coefficients, options)


def test_the_status_follows_the_confidence_and_its_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verdict_module, "fit_homography", lambda *arguments, **options: None)  # no plane helps
    scene = make_scene(right=200, wrong=20)
    for confidence, limits, status in (
        (0.9, (0.1, 0.5), Status.OK),
        (0.9, (0.1, 0.95), Status.LOW_SUPPORT),
        (0.9, (0.92, 0.95), Status.UNRELATED),
        (0.3, (0.1, 0.5), Status.LOW_SUPPORT),
        (0.05, (0.1, 0.5), Status.UNRELATED),
        (0.05, (0.01, 0.02), Status.OK),
    ):
        verdict = judged(scene, confidence, limits)
        assert verdict.status is status
        withheld = status is Status.UNRELATED
        assert (verdict.E is None) == (verdict.R is None) == (verdict.t is None) == withheld
        assert verdict.mask.any() != withheld


def test_the_mask_is_the_distance_to_the_model(match_filter: MatchFilter) -> None:
    for threshold in (0.5, 3.0):
        scene = make_scene()
        chosen = MatchFilter.over(*match_filter._backends, options=FilterOptions(threshold=threshold))
        result = run(chosen, scene)
        pixels = np.hstack([scene.points1, scene.points2])
        np.testing.assert_array_equal(result.mask, sampson_distance(pixels, result.F) < threshold)


def test_nothing_to_judge() -> None:
    scene = make_scene(right=9, wrong=0)
    pair, evidence = prepared(scene), before(scene)
    options = FilterOptions()
    assert judge(pair, None, evidence, 1.0, COEFFICIENTS, options).status is Status.NO_GEOMETRY
    few = make_scene(right=MIN_MATCHES - 1, wrong=0)
    assert judge(prepared(few), None, before(few), 1.0, COEFFICIENTS, options).status is Status.TOO_FEW_MATCHES
