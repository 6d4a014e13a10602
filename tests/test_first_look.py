"""Two networks: the quick one is asked first, the deep one where the fit on its scores settles nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import K, Scene, make_scene
from numpy.typing import NDArray

from mgca_filter import FilterResult, MatchFilter, MatchPair, model_path
from mgca_filter.inference import Backend, OnnxBackend
from mgca_filter.inference.scoring import FEWEST_UNDECIDED, HOPELESS_SCORE, Opinion

CLEAR, HARD = make_scene(right=60, wrong=240), make_scene(right=20, wrong=500, seed=1)


class Witness:
    """A backend that remembers how many matches it saw."""

    def __init__(self, backend: Backend) -> None:
        self.name, self.metadata, self._backend = backend.name, backend.metadata, backend
        self.seen: list[int] = []

    def infer(self, correspondences: NDArray, attributes: NDArray) -> tuple[NDArray, NDArray]:
        self.seen.append(correspondences.shape[1])
        return self._backend.infer(correspondences, attributes)


class Strict(Witness):
    """A network that holds for certainly wrong what the one behind it doubts."""

    def infer(self, correspondences: NDArray, attributes: NDArray) -> tuple[NDArray, NDArray]:
        logits, essential = super().infer(correspondences, attributes)
        return np.where(logits < -2.0, logits - 4.0, logits), essential


@pytest.fixture(scope="module")
def published() -> tuple[Backend, Backend]:
    return OnnxBackend(model_path("fast")), OnnxBackend(model_path())


def run(scene: Scene, *backends: Backend, **options: object) -> FilterResult:
    match_filter = MatchFilter.over(*backends, options=replace(MatchFilter().options, **options))
    return match_filter.filter(scene.points1, scene.points2, None, K1=K, attributes=scene.attributes)


def test_what_the_first_look_settles_needs_no_second(published: tuple[Backend, Backend]) -> None:
    quick, deep = map(Witness, published)
    result = run(CLEAR, quick, deep)
    assert len(quick.seen) == 1
    assert deep.seen == []
    assert result.info["networks"] == ["mgca_fast"]
    assert result.info["ended"] == "first sources"
    alone = run(CLEAR, published[0])
    seen = alone.info["network_rows"]
    np.testing.assert_array_equal(result.scores[seen], alone.scores[seen])
    np.testing.assert_array_equal(result.mask, alone.mask)
    np.testing.assert_array_equal(result.E, alone.E)


def test_elsewhere_the_deep_one_sees_what_may_be_right(published: tuple[Backend, Backend]) -> None:
    quick, deep = Strict(published[0]), Witness(published[1])
    result = run(HARD, quick, deep)
    assert result.info["networks"] == ["mgca_fast", "mgca_small"]
    assert result.info["num_network_matches"] == quick.seen[0]
    alone = run(HARD, Strict(published[0]))
    undecided = np.count_nonzero(alone.scores[alone.info["network_rows"]] > HOPELESS_SCORE)
    assert FEWEST_UNDECIDED < undecided < quick.seen[0]
    assert deep.seen == [undecided]
    # What the first holds for wrong keeps its score.
    hopeless = alone.scores <= HOPELESS_SCORE
    np.testing.assert_array_equal(result.scores[hopeless], alone.scores[hopeless])
    assert (result.scores[~hopeless] != alone.scores[~hopeless]).mean() > 0.5


@pytest.mark.parametrize("options", [{"effort": "full"}, {"method": "none"}, {"method": "prosac"}], ids=str)
def test_whoever_wants_all_networks_has_them(published: tuple[Backend, Backend], options: dict[str, str]) -> None:
    quick, deep = map(Witness, published)
    result = run(CLEAR, quick, deep, **options)
    assert result.info["networks"] == ["mgca_fast", "mgca_small"]
    assert len(quick.seen) == len(deep.seen) == 1


@pytest.mark.parametrize("geometry", ["fundamental", "homography"])
def test_models_without_a_confidence_ask_all_networks(published: tuple[Backend, Backend], geometry: str) -> None:
    assert len(run(CLEAR, *published, geometry=geometry).info["networks"]) == 2


def test_what_enters_no_network_has_the_mean_of_their_priors(published: tuple[Backend, Backend]) -> None:
    scene = make_scene(right=60, wrong=240, seed=5)
    ratio = np.where(scene.inlier, 0.7, np.linspace(0.5, 1.0, len(scene.inlier)))  # some are no candidates
    match_filter = MatchFilter.over(*published)
    attributes = replace(scene.attributes, ratio=ratio)

    def logits(*backends: Backend) -> tuple[NDArray, NDArray]:
        chosen = MatchFilter.over(*backends, options=replace(match_filter.options, effort="full"))
        result = chosen.filter(scene.points1, scene.points2, None, K1=K, attributes=attributes)
        outside = np.setdiff1d(np.arange(len(ratio)), result.info["network_rows"])
        return outside, result.info["logits"][outside]

    outside, together = logits(*published)
    assert 10 < len(outside) < 100
    apart = [logits(backend)[1] for backend in published]
    assert np.abs(apart[0] - apart[1]).max() > 0.1
    np.testing.assert_allclose(together, np.mean(apart, axis=0), atol=1e-6)


def test_two_networks_that_agree_say_what_one_says(published: tuple[Backend, Backend]) -> None:
    quick = published[0]
    once, twice = run(HARD, quick, effort="full"), run(HARD, quick, quick, effort="full")
    assert twice.info["networks"] == ["mgca_fast"] * 2
    assert once.scores.min() > HOPELESS_SCORE  # the second sees all of it
    np.testing.assert_allclose(twice.scores, once.scores, atol=1e-6)
    np.testing.assert_array_equal(twice.mask, once.mask)


def test_pairs_of_a_batch_go_as_far_as_each_needs(published: tuple[Backend, Backend]) -> None:
    easy = make_scene(right=150, wrong=50)
    match_filter = MatchFilter.over(*published)
    pairs = [
        MatchPair(scene.points1, scene.points2, None, K1=K, attributes=scene.attributes)
        for scene in (HARD, easy, CLEAR, HARD)
    ]
    together = match_filter.filter_many(pairs)
    assert [len(result.info["networks"]) for result in together] == [2, 0, 1, 2]
    for pair, result in zip(pairs, together):
        (alone,) = match_filter.filter_many([pair])
        np.testing.assert_allclose(result.scores, alone.scores, atol=1e-2)


def test_opinions_are_means_over_those_who_saw() -> None:
    rng = np.random.default_rng(0)
    one, two, three = (Opinion(*rng.normal(size=(2, 50)).astype(np.float32)) for _ in range(3))
    some, fewer = np.arange(0, 50, 2), np.arange(0, 50, 4)
    seen_by_two, seen_by_three = (
        Opinion(other.margins[rows], other.log_odds[rows]) for other, rows in ((two, some), (three, fewer))
    )
    joined = one.joined(seen_by_two, some).joined(seen_by_three, fewer)
    for name in ("margins", "log_odds"):
        first, second, third = (getattr(opinion, name) for opinion in (one, two, three))
        expected = first.copy()
        expected[some] = (first[some] + second[some]) / 2.0
        expected[fewer] = (first[fewer] + second[fewer] + third[fewer]) / 3.0
        np.testing.assert_allclose(getattr(joined, name), expected, atol=1e-6)
    assert joined.networks == 3


def test_a_few_matches_are_never_too_hopeless() -> None:
    hopeless = Opinion(*np.tile(np.linspace(-9.0, -8.0, 200).astype(np.float32), (2, 1)))
    undecided = hopeless.undecided(np.arange(200))
    assert np.flatnonzero(undecided).tolist() == list(range(200 - FEWEST_UNDECIDED, 200))
    assert hopeless.undecided(np.arange(10)).all()
    assert not hopeless.undecided(np.zeros(0, dtype=np.intp)).any()
