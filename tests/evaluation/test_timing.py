"""Times: all rows in turn on the same pairs; and estimators that get the filter's milliseconds."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import SIZE, K, Scene, make_scene
from scene_bundles import write_bundle

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation import timing
from mgca_filter.evaluation.__main__ import main
from mgca_filter.evaluation.environment import one_thread
from mgca_filter.evaluation.methods import Answer
from mgca_filter.evaluation.store import ResultStore
from mgca_filter.evaluation.timing import interleaved_ms, match_times, time_methods
from mgca_filter.inference.onnxruntime_ import THREADS_VARIABLE

NO_STORE = ResultStore(None)


def as_pair(scene: Scene, index: int = 0) -> ScenePair:
    everything = np.ones(len(scene.points1), dtype=bool)
    return ScenePair(
        *("scene", index, "a", "b", scene.points1, scene.points2, K, K, SIZE, SIZE, scene.R, scene.t),
        scene.attributes,
        everything,
    )


class ClockedMethod:
    """Takes the given time on the clock that the test puts in, and notes the pairs that it saw."""

    seeded = False

    def __init__(self, name: str, milliseconds: float, clock: list[float], seen: list[tuple[str, int]]) -> None:
        self.name, self._milliseconds, self._clock, self._seen = name, milliseconds, clock, seen

    def settings(self) -> dict[str, Any]:
        return {}

    def run(self, pair: ScenePair, seed: int) -> Answer:
        self._clock[0] += self._milliseconds / 1e3
        self._seen.append((self.name, pair.index))
        nothing = np.zeros(len(pair.points1), dtype=bool)
        return Answer(None, None, nothing, nothing, "clocked")


@pytest.fixture
def clocked(monkeypatch: pytest.MonkeyPatch) -> Callable[..., ClockedMethod]:
    """Makes methods by name and milliseconds; their time passes on a clock of their own."""
    clock, seen = [0.0], []
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock[0])

    def make(name: str, milliseconds: float) -> ClockedMethod:
        method = ClockedMethod(name, milliseconds, clock, seen)
        method.seen = seen
        return method

    return make


@pytest.fixture
def pairs(scene: Scene) -> list[ScenePair]:
    return [as_pair(scene, 0), as_pair(scene, 1)]


def test_rows_are_timed_in_turn_each_pair_beginning_with_another(clocked: Any, pairs: list[ScenePair]) -> None:
    methods = [clocked("a", 5.0), clocked("b", 7.0), clocked("c", 1.0)]
    np.testing.assert_allclose(interleaved_ms(methods, pairs), [[5.0, 5.0], [7.0, 7.0], [1.0, 1.0]])
    warm_up = [("a", 0), ("b", 0), ("c", 0)]
    assert methods[0].seen == [*warm_up, ("a", 0), ("b", 0), ("c", 0), ("b", 1), ("c", 1), ("a", 1)]
    assert interleaved_ms(methods, []).shape == (3, 0)


def test_times_are_taken_once_for_the_same_rows_and_pairs(clocked: Any, pairs: list[ScenePair], tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    first = time_methods([clocked("a", 5.0), clocked("b", 7.0)], pairs, store)
    assert first.milliseconds["b"] == {"scene": pytest.approx([7.0, 7.0])}
    assert time_methods([clocked("a", 50.0), clocked("b", 70.0)], pairs, store) == first
    assert time_methods([clocked("a", 50.0), clocked("c", 70.0)], pairs, store).milliseconds["a"] != first
    other = time_methods([clocked("a", 50.0), clocked("b", 70.0)], pairs[:1], store)
    assert other.milliseconds["a"] == {"scene": pytest.approx([50.0])}
    namesakes = [as_pair(make_scene(seed=seed), seed) for seed in (1, 0)]
    other = time_methods([clocked("a", 60.0), clocked("b", 70.0)], namesakes, store)
    assert other.milliseconds["a"] == {"scene": pytest.approx([60.0, 60.0])}


def test_one_thread_holds_within_the_block_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    threads = cv2.getNumThreads()
    for before in (None, "3"):
        monkeypatch.delenv(THREADS_VARIABLE, raising=False)
        if before is not None:
            monkeypatch.setenv(THREADS_VARIABLE, before)
        with one_thread():
            assert (cv2.getNumThreads(), os.environ[THREADS_VARIABLE]) == (1, "1")
        assert (cv2.getNumThreads(), os.environ.get(THREADS_VARIABLE)) == (threads, before)


@pytest.mark.parametrize(("count", "timed"), [("0", None), ("1", 2), ("10", 3)])
def test_command_times_as_many_pairs_of_each_scene_as_it_is_told(
    count: str, timed: int | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, number in (("hall", 2), ("yard", 1)):
        scenes = [make_scene(seed=seed, right=40, wrong=10) for seed in range(number)]
        write_bundle(tmp_path / f"{name}.npz", scenes)
    arguments = [str(tmp_path), "--methods", "NN + MAGSAC 1 px", "--bootstrap", "0", "-q", "--times", count]
    assert main([*arguments, "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert [row.get("timed_pairs") for row in summary["rows"] if row["scene"] == "pairs"] == [timed]
    assert ("median_ms" in summary["rows"][0]) is (timed is not None)
    assert main(arguments) == 0
    assert (f"{timed} pairs; other programs used" in capsys.readouterr().out) is (timed is not None)


# Time-matched rows


@pytest.fixture
def costing(clocked: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[int], float], float], ClockedMethod]:
    """Gives baselines the cost that a function has for their iterations; returns the row to match."""

    def install(cost: Callable[[int], float], target_ms: float) -> ClockedMethod:
        monkeypatch.setattr(timing, "parse_method", lambda name: clocked(name, cost(int(name.split()[-2]))))
        return clocked("ours", target_ms)

    return install


@pytest.mark.parametrize(("target_ms", "per_thousand"), [(50.0, 3.0), (50.0, 400.0), (8.0, 8.0)])
def test_iterations_are_found_that_take_our_time(
    target_ms: float, per_thousand: float, costing: Any, pairs: list[ScenePair]
) -> None:
    like = costing(lambda iterations: per_thousand * iterations / 1000, target_ms)
    (match,) = match_times(["NN + MAGSAC 1 px"], like, pairs, NO_STORE)
    assert match.share == pytest.approx(1.0, rel=0.2)
    assert match.share == pytest.approx(per_thousand * match.iterations / 1000 / target_ms)
    assert match.method == f"NN + MAGSAC 1 px {match.iterations} iterations"
    assert match.like == "ours"


def test_an_estimator_that_stops_early_says_so(costing: Any, pairs: list[ScenePair]) -> None:
    like = costing(lambda iterations: min(iterations / 1000, 5.0), 50.0)
    (match,) = match_times(["NN + MAGSAC 1 px"], like, pairs, NO_STORE)
    assert match.share == pytest.approx(0.1)
    assert match.iterations == 16_000  # the most that was tried before it was given up
    like = costing(lambda iterations: 100.0, 50.0)
    assert match_times(["NN + MAGSAC 1 px"], like, pairs, NO_STORE)[0].iterations == timing.MIN_ITERATIONS


def test_the_iterations_found_are_kept(costing: Any, pairs: list[ScenePair], tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    first = match_times(["NN + MAGSAC 1 px"], costing(lambda i: i / 1000, 50.0), pairs, store)
    dearer = costing(lambda i: 9 * i / 1000, 50.0)
    assert match_times(["NN + MAGSAC 1 px"], dearer, pairs, store) == first
    (other,) = match_times(["NN + RANSAC 1 px"], dearer, pairs, store)
    assert other.iterations < first[0].iterations


def test_times_cannot_be_matched_without_a_pair(costing: Any) -> None:
    with pytest.raises(ValueError, match="not one pair can be read"):
        match_times(["NN + MAGSAC 1 px"], costing(lambda i: 1.0, 50.0), [], NO_STORE)


def test_command_adds_time_matched_rows(
    tmp_path: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import mgca_filter.evaluation.__main__ as command

    monkeypatch.setattr(command, "TIME_MATCHED_ROWS", ("mutual + PROSAC 0.5 px",))
    monkeypatch.setattr(timing, "MAX_ITERATIONS", 2000)
    path = write_bundle(tmp_path / "hall.npz", [make_scene()])
    arguments = [str(path), "--methods", "product", "--model", str(model_file), "--time-matched", "product"]
    assert main([*arguments, "--bootstrap", "0", "-q"]) == 0
    text = capsys.readouterr().out
    assert "times as long as product" in text
    assert "iterations " in next(line for line in text.splitlines() if line.startswith("mutual + PROSAC 0.5 px "))
