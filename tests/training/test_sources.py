"""Every data source draws from its generator alone, labels by the truth that it knows, and checks its files first."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from photographs import write_photographs
from scene_bundles import bundle_fields, learned_fields, write_bundle

from mgca_filter.data.scene_bundle import LABEL_FIELD, SceneBundle
from mgca_filter.errors import BundleError, DatasetError
from mgca_filter.geometry.epipolar import symmetric_epipolar_distance_squared
from mgca_filter.training.config import ConfigError, SourceConfig, TrainingConfig
from mgca_filter.training.pairs import IGNORED, NEGATIVE, POSITIVE, TrainingPair, clean_labels
from mgca_filter.training.sources import BundleSource, DataSource, MixedSource, OanetSource, open_sources
from mgca_filter.training.synthetic import MatchStatistics, SyntheticSource, main, measure
from mgca_filter.training.worlds.photographs import PhotoError

KINDS = ("bundles", "oanet", "rendered", "synthetic", "mixed")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with bundles and photographs."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "bundles").mkdir()
    for first, name in enumerate(("hall", "yard")):
        write_bundle(folder / "bundles" / f"{name}.npz", [make_scene(seed=10 * first + i) for i in range(3)])
    write_photographs(folder / "photos")
    return folder


def open_kind(kind: str, data: Path) -> DataSource:
    if kind == "oanet":
        write_oanet = pytest.importorskip("oanet_files").write_oanet
        if not (data / "dump.hdf5").is_file():
            write_oanet(data / "dump.hdf5", [make_scene(seed=seed) for seed in range(4)])
        return OanetSource(data / "dump.hdf5")
    if kind == "mixed":
        return MixedSource([open_kind("bundles", data), SyntheticSource()], [1.0, 1.0])
    config = TrainingConfig(name="x", sources=(SourceConfig(kind, "" if kind == "synthetic" else path_of(kind)),))
    return open_sources(config, data).source


def path_of(kind: str) -> str:
    return "photos" if kind == "rendered" else kind


def assert_same(one: TrainingPair, other: TrainingPair) -> None:
    assert one.name == other.name
    for name in ("correspondences", "R", "t", "mutual", "labels"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.attributes.encode(len(one)), other.attributes.encode(len(other)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_pair_follows_from_the_generator_in_every_process(kind, data):
    source = open_kind(kind, data)
    copy = pickle.loads(pickle.dumps(source))
    drawn = source.draw(np.random.default_rng(3))
    others = [copy.draw(np.random.default_rng(8))]  # another history
    assert_same(drawn, copy.draw(np.random.default_rng(3)))
    if kind != "rendered":  # slow, and no two worlds are alike
        others += [source.draw(np.random.default_rng(seed)) for seed in range(4, 10)]
    assert any(len(o) != len(drawn) or (o.correspondences != drawn.correspondences).any() for o in others)


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_hold_what_training_needs(kind, data):
    pair = open_kind(kind, data).draw(np.random.default_rng(0))
    assert pair.correspondences.shape == (len(pair), 4)
    assert pair.mutual.shape == pair.labels.shape == (len(pair),)
    assert set(np.unique(pair.labels)) <= {POSITIVE, NEGATIVE, IGNORED}
    np.testing.assert_allclose(pair.R @ pair.R.T, np.eye(3), atol=1e-6)
    distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
    right = pair.labels == POSITIVE
    assert np.count_nonzero(right) >= 20
    assert distance[right].max() < 1.6e-5
    encoded = pair.attributes.encode(len(pair))
    assert np.isfinite(encoded).all()
    assert encoded[:, 5:7].all()
    assert encoded[right, 0].mean() < encoded[pair.labels == NEGATIVE, 0].mean()


def test_sources_are_mixed_by_their_weights(data):
    bundles, synthetic = open_kind("bundles", data), SyntheticSource()
    for weights, share in (([1.0, 3.0], 0.75), ([1.0, 0.0], 0.0)):
        mixed = MixedSource([bundles, synthetic], weights)
        names = [mixed.draw(np.random.default_rng(seed)).name for seed in range(120)]
        assert abs(np.mean([name == "synthetic" for name in names]) - share) < 0.13
    for weights in ([1.0], [0.0, 0.0], [-1.0, 2.0]):
        with pytest.raises(ValueError, match="weights"):
            MixedSource([bundles, synthetic], weights)


def test_bundles_that_hold_labels_keep_them(tmp_path):
    scenes = [make_scene(seed=seed) for seed in range(2)]
    labels = np.random.default_rng(0).integers(-1, 2, 400).astype(np.int8)
    path = write_bundle(tmp_path / "hall.npz", scenes, **{LABEL_FIELD: labels})
    source = BundleSource([SceneBundle(path)])
    np.testing.assert_array_equal(source.pair(0, 1).labels, labels[200:])
    write_bundle(path, scenes, **{LABEL_FIELD: labels[:7]})
    with pytest.raises(BundleError, match=rf"hall\.npz: {LABEL_FIELD}"):
        BundleSource([SceneBundle(path)])


def test_labels_may_be_those_of_the_field(data):
    config = TrainingConfig(name="x", sources=(SourceConfig(path="bundles", labels="epipolar"),))
    for source, expected in ((open_sources(config, data).source, "field"), (open_kind("bundles", data), "clean")):
        pair = source.draw(np.random.default_rng(1))
        distance = symmetric_epipolar_distance_squared(pair.correspondences, pair.E)
        truth = np.where(distance < 1e-4, POSITIVE, NEGATIVE) if expected == "field" else clean_labels(pair)
        np.testing.assert_array_equal(pair.labels, truth)


def test_oanet_labels_may_be_those_of_the_field(data):
    open_kind("oanet", data)
    pair = OanetSource(data / "dump.hdf5", "epipolar").draw(np.random.default_rng(0))
    near = symmetric_epipolar_distance_squared(pair.correspondences, pair.E) < 1e-4
    np.testing.assert_array_equal(pair.labels, np.where(near, POSITIVE, NEGATIVE))


def test_dumps_without_enough_matches_are_refused(tmp_path):
    write_oanet = pytest.importorskip("oanet_files").write_oanet
    write_oanet(tmp_path / "small.hdf5", [make_scene(right=15, wrong=10)])
    with pytest.raises(DatasetError, match=r"small\.hdf5: xs"):
        OanetSource(tmp_path / "small.hdf5")


@pytest.mark.parametrize(("field", "message"), [("t", "t: pair 1: both images"), ("covisible", "covisible: pair 1")])
def test_pairs_without_geometry_are_refused(tmp_path, field, message):
    scenes = [make_scene(seed=seed) for seed in range(2)]
    fields = bundle_fields(scenes)
    changes = {"t": fields["t"].copy(), "R": fields["R"], "covisible": np.array([9, 9])}
    if field == "t":
        changes["t"][3] = 0.0
    else:
        changes["covisible"][1] = 0
    bundle = SceneBundle(write_bundle(tmp_path / "hall.npz", scenes, **changes))
    with pytest.raises(BundleError, match=rf"hall\.npz: {message}"):
        bundle.check_training_pairs()


def test_scenes_choose_among_all_bundle_sources(data, monkeypatch):
    opened_files = []
    load = np.load
    monkeypatch.setattr(np, "load", lambda path, **options: opened_files.append(path.stem) or load(path, **options))
    sources = (SourceConfig(path="bundles"), SourceConfig(path="bundles/yard.npz", weight=0.5))
    config = TrainingConfig(name="x", tuning_scenes=("hall",), sources=sources)
    opened = open_sources(config, data)
    assert [bundle.scene for bundle in opened.tuning] == ["hall"]
    assert [bundle.scene for bundle in opened.training] == ["yard"]
    assert opened_files == ["hall", "yard"]  # each once, whatever names it
    assert {opened.source.draw(np.random.default_rng(seed)).name[:4] for seed in range(20)} == {"yard"}
    chosen = open_sources(TrainingConfig(name="x", scenes=("hall",), sources=sources[:1]), data)
    assert {chosen.source.draw(np.random.default_rng(seed)).name[:4] for seed in range(20)} == {"hall"}
    assert chosen.tuning == []
    for changes, message in (
        ({"scenes": ("attic",)}, "scenes: not in the data folder: attic"),
        ({"tuning_scenes": ("hall", "yard")}, "scenes: nothing is left"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_sources(dataclasses.replace(config, **changes), data)


def test_a_name_stands_for_the_bundles_of_all_detectors(tmp_path):
    scenes = [make_scene(seed=seed) for seed in range(2)]
    for name in ("hall", "hall.orb2k", "yard.orb2k", "attic"):
        write_bundle(tmp_path / f"{name}.npz", scenes)
    write_bundle(tmp_path / "hall.aliked_lightglue.npz", scenes, **learned_fields(scenes))
    config = TrainingConfig(name="x", tuning_scenes=("hall",), doubtful_scenes=("attic",))
    opened = open_sources(config, tmp_path)
    assert [bundle.scene for bundle in opened.training] == ["yard.orb2k"]
    assert [bundle.scene for bundle in opened.tuning] == ["hall", "hall.orb2k"]  # validation tests ratios
    with pytest.raises(ConfigError, match="doubtful_scenes: not in the data folder: cellar"):
        open_sources(dataclasses.replace(config, doubtful_scenes=("cellar",)), tmp_path)


def test_lists_of_a_learned_matcher_are_drawn_without_what_it_does_not_know(tmp_path):
    scenes = [make_scene(seed=seed, right=200, wrong=100) for seed in range(2)]
    write_bundle(tmp_path / "hall.aliked_lightglue.npz", scenes, **learned_fields(scenes))
    pair = open_sources(TrainingConfig(name="x"), tmp_path).source.draw(np.random.default_rng(0))
    assert not pair.attributes.encode(len(pair)).any()
    assert {POSITIVE, NEGATIVE} <= set(pair.labels.tolist())


@pytest.mark.parametrize(
    ("source", "error"),
    [
        (SourceConfig("rendered", "bundles"), PhotoError),
        (SourceConfig("rendered", "torn"), PhotoError),
        (SourceConfig("bundles", "photos"), BundleError),
        (SourceConfig("oanet", "none.hdf5"), DatasetError),
    ],
)
def test_files_that_cannot_be_used_are_named_before_training(data, source, error):
    if source.kind == "oanet":
        pytest.importorskip("h5py")
    (data / "torn").mkdir(exist_ok=True)
    (data / "torn" / "a.jpg").write_bytes(b"torn")
    with pytest.raises(error, match=source.path):
        open_sources(TrainingConfig(name="x", sources=(source,)), data)


def test_synthetic_pairs_have_the_statistics_they_are_drawn_from():
    statistics = MatchStatistics.load()
    easy = MatchStatistics(statistics.difficulties[-1:])
    pairs = [SyntheticSource(easy).draw(np.random.default_rng(seed)) for seed in range(12)]
    rows = [pair.labels == POSITIVE for pair in pairs]
    share = np.mean([right.mean() for right in rows])
    low, high = statistics.difficulties[-1].right_share[0], statistics.difficulties[-1].right_share[-1]
    assert 0.6 * low < share < high
    ratio = np.concatenate([pair.attributes.ratio[right] for pair, right in zip(pairs, rows)])
    right = statistics.difficulties[-1].right
    expected = np.average([np.mean(q) for q in right.ratio], weights=right.state_share)
    assert abs(ratio.mean() - expected) < 0.05
    assert all((pair.attributes.best | ~pair.mutual).all() for pair in pairs)  # mutual implies best


def test_synthetic_matches_share_keypoints_where_they_are_not_best():
    pair = SyntheticSource().draw(np.random.default_rng(1))
    points, counts = np.unique(pair.correspondences[:, 2:], axis=0, return_counts=True)
    shared = {tuple(point) for point in points[counts > 1]}
    lost = (pair.labels == NEGATIVE) & ~pair.attributes.best
    assert lost.any()
    assert np.mean([tuple(point) in shared for point in pair.correspondences[lost, 2:]]) == 1.0


def test_statistics_are_measured_and_saved(data, tmp_path):
    main([str(data / "bundles"), str(tmp_path / "out.json")])
    saved = MatchStatistics.load(tmp_path / "out.json")
    pairs = [
        bundle[i]
        for name in ("hall", "yard")
        for bundle in [SceneBundle(data / "bundles" / f"{name}.npz")]
        for i in range(3)
    ]
    assert saved == measure(pairs)
    for group in saved.difficulties:
        assert np.mean(group.right.ratio[2]) < np.mean(group.wrong.ratio[2])
