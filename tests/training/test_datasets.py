"""Batches depend on seed and step alone, hold what their regime says, and never a held-out pair."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_scene
from scene_bundles import bundle_fields, write_bundle
from torch.utils.data import DataLoader

from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.errors import BundleError
from mgca_filter.geometry.epipolar import symmetric_epipolar_distance_squared
from mgca_filter.training.augmentation import AugmentationConfig
from mgca_filter.training.datasets import TrainingDataset
from mgca_filter.training.pairs import POSITIVE, TrainingPair, clean_labels
from mgca_filter.training.samples import (
    PRIOR_MATCHES,
    DegenerateDataError,
    Draw,
    build_sample,
    draw_sample,
    has_variety,
    virtual_correspondences,
)
from mgca_filter.training.sampling import DISTANCE_COLUMNS, SHAPE_COLUMNS, SamplingConfig
from mgca_filter.training.sources import BundleSource, is_held_out

SAMPLING = SamplingConfig(batch_size=4, matches=(40, 64), matches_weights=(0.5, 0.5), holdout_every=3, pool_batches=2)
UNCHANGED = AugmentationConfig(tilt_deg=0.0, roll_deg=0.0, turn=0.0, mirror=0.0, focal_error=0.0)


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> list[SceneBundle]:
    """Two scenes of eight and two pairs, with sizes, angles, and flags that differ."""
    folder = tmp_path_factory.mktemp("bundles")
    rng = np.random.default_rng(0)
    bundles = []
    for name, scenes in (
        ("hall", [make_scene(seed=seed) for seed in range(8)]),
        ("yard", [make_scene(seed=seed, right=70) for seed in (8, 9)]),
    ):
        fields = bundle_fields(scenes)
        keypoints, matches = len(fields["keypoint_size"]), len(fields["match_ratio"])
        changes = {
            "keypoint_size": rng.uniform(2, 30, keypoints).astype(np.float16),
            "keypoint_angle": rng.integers(256, size=keypoints).astype(np.uint8),
            "match_mutual": np.packbits(rng.random(matches) < 0.6),
            "match_best": np.packbits(rng.random(matches) < 0.8),
        }
        bundles.append(SceneBundle(write_bundle(folder / f"{name}.npz", scenes, **changes)))
    return bundles


def build(bundles: list[SceneBundle], seed: int = 0, **changes: object) -> TrainingDataset:
    sampling = dataclasses.replace(SAMPLING, **changes)
    source = BundleSource(bundles, sampling.scene_exponent, sampling.holdout_every)
    return TrainingDataset(source, sampling, AugmentationConfig(), seed, 12)


def drawn_from(dataset: TrainingDataset, *seed: int) -> Draw:
    """One sample as the dataset draws it."""
    return draw_sample(dataset.source, dataset.sampling, seed)


def place(pair: TrainingPair) -> tuple[int, int]:
    """Bundle and number of a pair of the two scenes."""
    scene, index = pair.name.split("/")
    return ("hall", "yard").index(scene), int(index)


def scene_pair(bundles: list[SceneBundle], pair: TrainingPair) -> ScenePair:
    scene, index = place(pair)
    return bundles[scene][index]


def assert_equal(batch: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert list(batch) == list(other)
    for name, tensor in batch.items():
        torch.testing.assert_close(other[name], tensor, atol=0, rtol=0)


def test_batches_depend_on_seed_and_step_alone(bundles):
    dataset = build(bundles)
    in_order = [dataset[step] for step in range(6)]
    for step in (5, 0, 3, 2):  # another history
        assert_equal(in_order[step], build(bundles)[step])
        assert_equal(in_order[step], dataset[step])
    other = build(bundles, seed=1)[0]["correspondences"]
    assert other.shape != in_order[0]["correspondences"].shape or (other != in_order[0]["correspondences"]).any()
    first = [float(batch["correspondences"][0, 0, 0]) for batch in in_order]
    assert len(set(first)) == 6


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_change_nothing(bundles, workers):
    loader = DataLoader(build(bundles), batch_size=None, sampler=range(2, 6), num_workers=workers)
    expected = build(bundles)
    for step, batch in zip(range(2, 6), loader, strict=True):
        assert_equal(batch, expected[step])


def test_pools_are_whole_and_change_nothing(bundles):
    dataset = build(bundles)
    assert dataset.pools(3, 9) == [[3], [4, 5], [6, 7], [8]]
    assert dataset.pools(2, 3) == [[2]]
    assert dataset.pools(4, 4) == []
    for workers in (0, 2):
        loader = DataLoader(dataset, batch_sampler=dataset.pools(1, 5), collate_fn=list, num_workers=workers)
        batches = [batch for pool in loader for batch in pool]
        for step, batch in zip(range(1, 5), batches, strict=True):
            assert_equal(batch, build(bundles)[step])


def test_processes_share_a_batch_between_them(bundles):
    whole = build(bundles)
    source, arguments = whole.source, (SAMPLING, AugmentationConfig(), 0, 12)
    shares = [TrainingDataset(source, *arguments, (rank, 2))[3] for rank in range(2)]
    for name, tensor in whole[3].items():
        assert torch.equal(tensor[0::2], shares[0][name])
        assert torch.equal(tensor[1::2], shares[1][name])
    with pytest.raises(ValueError, match="batch_size.*3 processes"):
        TrainingDataset(source, *arguments, (0, 3))


class OneMatch:
    """A source whose matches are all the same."""

    def draw(self, rng: np.random.Generator) -> TrainingPair:
        scene = make_scene(seed=int(rng.integers(5)))
        x = np.tile(rng.uniform(-0.5, 0.5, 4), (200, 1))
        return TrainingPair("one/0", x, scene.R, scene.t, scene.attributes, np.ones(200, dtype=bool))


def test_pairs_whose_matches_are_all_alike_are_never_drawn():
    x = np.random.default_rng(0).uniform(-1, 1, (16, 4))
    assert has_variety(x)
    assert not has_variety(x[:15])
    assert not has_variety(np.hstack([x[:, :2], np.tile(x[:1, 2:], (16, 1))]))
    with pytest.raises(DegenerateDataError, match="one/0"):
        TrainingDataset(OneMatch(), SAMPLING, AugmentationConfig(), 0, 4)[0]


def test_datasets_travel_to_spawned_workers(bundles):
    dataset = build(bundles)
    reference = dataset[3]
    assert_equal(pickle.loads(pickle.dumps(dataset))[3], reference)


def test_fields_have_their_shapes_and_types(bundles):
    for step in range(4):
        batch = build(bundles)[step]
        count = batch["labels"].shape[1]
        assert 32 <= count <= 64
        shapes = {name: (tuple(tensor.shape[1:]), tensor.dtype) for name, tensor in batch.items()}
        assert shapes == {
            "correspondences": ((count, 4), torch.float32),
            "attributes": ((count, 8), torch.float32),
            "labels": ((count,), torch.int8),
            "virtual": ((400, 4), torch.float32),
            "virtual_valid": ((), torch.float32),
            "prior_attributes": ((PRIOR_MATCHES, 8), torch.float32),
            "prior_labels": ((PRIOR_MATCHES,), torch.int8),
        }
        assert all(len(tensor) == 4 and torch.isfinite(tensor.float()).all() for tensor in batch.values())


def test_held_out_pairs_are_never_drawn(bundles):
    assert [index for index in range(9) if is_held_out(index, 3)] == [1, 4, 7]
    assert not any(is_held_out(index, 0) for index in range(100))
    dataset = build(bundles)
    drawn = {place(drawn_from(dataset, 0, i).pair) for i in range(300)}
    assert drawn == {(0, index) for index in (0, 2, 3, 5, 6)} | {(1, 0)}


@pytest.mark.parametrize(("exponent", "share"), [(0.0, 1 / 2), (0.5, 2 / 3), (1.0, 8 / 10)])
def test_scenes_are_drawn_by_their_exponent(bundles, exponent, share):
    dataset = build(bundles, scene_exponent=exponent, holdout_every=0)
    np.testing.assert_allclose(dataset.source.scene_probability, [share, 1 - share])
    drawn = [place(drawn_from(dataset, 1, i).pair)[0] for i in range(200)]
    assert abs(np.mean(drawn) - (1 - share)) < 0.12


def only(regime: str) -> dict[str, float]:
    return {name: float(name == regime) for name in ("candidates", "filtered", "bare")}


def draws(bundles: list[SceneBundle], regime: str, number: int = 60) -> list:
    dataset = build(bundles, **only(regime))
    found = [drawn_from(dataset, 2, i) for i in range(number)]
    assert {draw.regime for draw in found} == {regime}
    return found


def test_candidates_are_best_of_the_list_and_below_the_ratio(bundles):
    forgotten = 0
    for draw in draws(bundles, "candidates"):
        kept = draw.attributes[draw.rows]
        assert (kept[:, 0] < 0.95).all()
        assert (kept[:, 1] == 1).all()
        encoded = scene_pair(bundles, draw.pair).attributes.encode(len(draw.attributes))
        assert len(draw.rows) == np.count_nonzero((encoded[:, 0] < 0.95) & (encoded[:, 1] == 1))
        np.testing.assert_array_equal(draw.attributes[:, DISTANCE_COLUMNS], encoded[:, DISTANCE_COLUMNS])
        forgotten += int((draw.attributes[:, SHAPE_COLUMNS] == 0).all())
    assert 0 < forgotten < 25  # sizes and angles are unknown now and then


def test_bare_lists_know_nothing_and_lack_nothing(bundles):
    for draw in draws(bundles, "bare"):
        assert (draw.attributes == 0).all()
        np.testing.assert_array_equal(draw.rows, np.arange(len(draw.attributes)))


def test_filtered_lists_passed_a_ratio_test_or_a_cross_check(bundles):
    kinds, known, thinned = set(), set(), 0
    for draw in draws(bundles, "filtered", 120):
        pair = scene_pair(bundles, draw.pair)
        by_ratio = bool((pair.attributes.ratio[draw.rows] < 0.9).all())
        by_cross_check = bool(pair.mutual[draw.rows].all())
        by_best = bool(pair.attributes.best[draw.rows].all())
        kinds.add((by_ratio, by_cross_check, by_best and not by_ratio and not by_cross_check))
        thinned += int(
            len(draw.rows) < 0.6 * min(np.count_nonzero(pair.mutual), np.count_nonzero(pair.attributes.best))
        )
        known.add((bool(draw.attributes[:, 5].any()), bool(draw.attributes[:, 7].any())))
        assert len(draw.rows) >= 32
    assert {(True, False, False), (False, True, False), (True, True, False), (False, False, True)} <= kinds
    assert thinned > 0
    assert known == {(True, True), (True, False), (False, True), (False, False)}


def test_samples_are_their_pairs_where_nothing_is_changed(bundles):
    dataset = build(bundles, **only("candidates"))
    for i in range(5):
        draw = drawn_from(dataset, 3, i)
        sample = build_sample(draw, 40, UNCHANGED)
        pair = scene_pair(bundles, draw.pair)
        everything = pair.correspondences.astype(np.float32)
        rows = [int(np.flatnonzero((everything == row).all(1))[0]) for row in sample["correspondences"]]
        assert len(set(rows)) == 40
        assert set(rows) <= set(draw.rows.tolist())
        np.testing.assert_array_equal(sample["labels"], clean_labels(pair)[rows])
        np.testing.assert_allclose(sample["attributes"], draw.attributes[rows], atol=1e-5)
        assert symmetric_epipolar_distance_squared(sample["virtual"], pair.E).max() < 1e-8


@pytest.mark.parametrize("regime", ["candidates", "bare"])
def test_right_matches_and_virtual_points_share_one_geometry(bundles, regime):
    dataset = build(bundles, **only(regime))
    checked = 0
    for i in range(12):
        sample = build_sample(drawn_from(dataset, 4, i), 60, AugmentationConfig())
        assert sample["virtual_valid"] == 1
        # The geometry is that of the virtual points: solve it from them, without the dataset's help.
        x1, x2 = (np.hstack([p, np.ones((400, 1))]) for p in np.hsplit(sample["virtual"].astype(float), 2))
        F = np.linalg.svd(np.einsum("ni,nj->nij", x2, x1).reshape(-1, 9))[2][-1].reshape(3, 3)
        distance = symmetric_epipolar_distance_squared(sample["correspondences"], F)
        right = sample["labels"] == POSITIVE
        assert np.median(distance[right]) < 2e-5
        assert np.median(distance[~right]) > 1e-3
        checked += int(right.sum())
    assert checked > 200


def test_virtual_points_lie_on_the_geometry(bundles):
    for bundle in bundles:
        E = bundle[0].E
        virtual, usable = virtual_correspondences(E)
        assert usable
        assert virtual.shape == (400, 4)
        assert symmetric_epipolar_distance_squared(virtual, E).max() < 1e-8
        ticks = np.arange(20) * 0.1 - 1.0
        grid = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
        moved = np.linalg.norm(virtual - np.hstack([grid, grid]), axis=1)
        assert np.median(moved) < 0.5


def test_pairs_with_few_right_matches_have_no_virtual_points(bundles):
    dataset = build(bundles)
    draw = drawn_from(dataset, 5, 0)
    wrong = np.flatnonzero(clean_labels(scene_pair(bundles, draw.pair)) != POSITIVE)
    assert build_sample(dataclasses.replace(draw, rows=wrong), 30, UNCHANGED)["virtual_valid"] == 0


def test_pairs_with_few_matches_are_left_out(tmp_path: Path):
    scenes = [make_scene(seed=0, right=20, wrong=11), make_scene(seed=1, right=20, wrong=12)]
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes))
    dataset = build([bundle], holdout_every=0)
    assert dataset.source.pairs == [[1]]
    assert dataset[0]["labels"].shape == (4, 32)
    poor = SceneBundle(write_bundle(tmp_path / "poor.npz", scenes[:1]))
    assert build([poor, bundle], holdout_every=0, scene_exponent=0.0).source.scene_probability.tolist() == [0.0, 1.0]
    for nothing in ([poor], []):
        with pytest.raises(BundleError, match="32 matches"):
            build(nothing)
