"""Life in a long-running service: threads, processes, repetition, and the same answer everywhere."""

from __future__ import annotations

import gc
import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import K, Scene, make_scene

from mgca_filter import FilterResult, MatchFilter

ROOT = Path(__file__).parent.parent
THREADS = 16
CALLS = 10_000
# A copy of the filter's session or of one pair's arrays left behind per call would be hundreds of times as much.
ALLOWED_GROWTH_BYTES = 32 * 2**20

# Run in a process of its own: the number of threads is read when the session opens.
ANSWER_IN_PROCESS = """
import os, sys
sys.path.insert(0, sys.argv[1])
import numpy as np
from conftest import K, make_scene
from mgca_filter import MatchFilter
match_filter = MatchFilter()
def answers():
    scenes = [make_scene(seed=seed, right=300 * seed + 60, wrong=200) for seed in range(3)]
    results = [match_filter.filter(s.points1, s.points2, None, K1=K, attributes=s.attributes) for s in scenes]
    return np.concatenate([r.info["logits"] for r in results]), np.concatenate([r.mask for r in results])
logits, mask = answers()
np.savez(sys.argv[2], logits=logits, mask=mask)
if len(sys.argv) > 3:
    child = os.fork()
    if child == 0:
        logits, mask = answers()
        np.savez(sys.argv[3], logits=logits, mask=mask)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""


def answer(match_filter: MatchFilter, scene: Scene) -> FilterResult:
    return match_filter.filter(scene.points1, scene.points2, None, K1=K, attributes=scene.attributes)


def assert_same_bits(one: FilterResult, other: FilterResult) -> None:
    for name in ("mask", "scores", "E", "R", "t"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def in_process(tmp_path: Path, threads: int, *, fork: bool = False) -> list[dict[str, np.ndarray]]:
    """Logits and masks of three scenes, computed in a process with that many threads, and in its forked child."""
    paths = [tmp_path / f"{who}{threads}.npz" for who in ("parent", "child")[: 1 + fork]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MGCA_FILTER_NUM_THREADS": str(threads)}
    command = [sys.executable, "-c", ANSWER_IN_PROCESS, str(ROOT / "tests"), *map(str, paths)]
    subprocess.run(command, env=environment, check=True, timeout=120)
    answers = []
    for path in paths:
        with np.load(path) as arrays:
            answers.append({name: arrays[name] for name in arrays.files})
    return answers


@pytest.mark.slow
def test_sixteen_threads_share_one_filter() -> None:
    match_filter = MatchFilter()
    scenes = [make_scene(seed=seed, right=80 + 20 * (seed % 3)) for seed in range(THREADS)]
    with ThreadPoolExecutor(THREADS) as pool:
        together = list(pool.map(lambda scene: answer(match_filter, scene), scenes))
    for scene, result in zip(scenes, together):
        assert_same_bits(result, answer(match_filter, scene))


@pytest.mark.parametrize("start", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_filter_travels_to_other_processes(start: str) -> None:
    if start not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {start} on this system")
    match_filter, scene = MatchFilter(seed=3), make_scene()
    with multiprocessing.get_context(start).Pool(1) as pool:
        result = pool.apply_async(answer, (match_filter, scene)).get(timeout=120)
    assert_same_bits(result, answer(match_filter, scene))


@pytest.mark.slow
def test_number_of_threads_changes_nothing_that_matters(tmp_path: Path) -> None:
    (one,), (four,) = in_process(tmp_path, 1), in_process(tmp_path, 4)
    assert np.abs(one["logits"] - four["logits"]).max() < 1e-4
    np.testing.assert_array_equal(one["mask"], four["mask"])
    assert one["mask"].any()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child_goes_on_with_the_open_session(tmp_path: Path) -> None:
    parent, child = in_process(tmp_path, 2, fork=True)
    np.testing.assert_array_equal(child["mask"], parent["mask"])
    np.testing.assert_array_equal(child["logits"], parent["logits"])


def resident_bytes() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the memory of the process from /proc")
def test_ten_thousand_calls_leave_no_memory_behind() -> None:
    match_filter = MatchFilter()
    # Small pairs of every outcome: what leaks does so per call, whatever its size.
    sizes = ((0, 0), (4, 2), (6, 6), (14, 2), (40, 8))
    scenes = [make_scene(kind, right=right, wrong=wrong) for kind in ("general", "planar") for right, wrong in sizes]
    first = [answer(match_filter, scene) for scene in scenes]
    for i in range(CALLS // 10):
        answer(match_filter, scenes[i % len(scenes)])
    before = resident_bytes()
    for i in range(CALLS):
        result = answer(match_filter, scenes[i % len(scenes)])
    assert resident_bytes() - before < ALLOWED_GROWTH_BYTES
    assert_same_bits(result, first[(CALLS - 1) % len(scenes)])
