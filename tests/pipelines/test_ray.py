"""The engine on Ray: a real local Ray, two workers."""

from __future__ import annotations

import os
import threading

import cv2
import pytest
from pipeline_command import K_WORDS

from mgca_filter import cli
from mgca_filter.features import ImageFeatures
from mgca_filter.pipelines.journal import PipelineError
from mgca_filter.pipelines.run import Workers
from mgca_filter.pipelines.worker import PairWorker

ray = pytest.importorskip("ray")
from ray.util.multiprocessing.pool import ResultThread  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(280),
    pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning"),
]


@pytest.fixture
def paths(monkeypatch):
    """Ray's workers import the package from here, whether it is installed or not."""
    root = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # 15 starves on a busy machine


def test_ray_gives_the_rows_of_one_process(paths, image_folder, tmp_path):
    words = ["folder", str(image_folder), "--K", K_WORDS, "-q"]
    assert cli.main([*words, "-o", str(tmp_path / "one.jsonl")]) == 0
    assert cli.main([*words, "-o", str(tmp_path / "ray.jsonl"), "--engine", "ray", "-j", "2"]) == 0
    assert (tmp_path / "ray.jsonl").read_bytes() == (tmp_path / "one.jsonl").read_bytes()
    assert not ray.is_initialized()


def test_killed_worker_is_replaced_and_its_pairs_repeated(paths, views):
    """The process of a worker killed in the middle: all pairs come back, with the rows of one process."""
    files = {view.name: cv2.imencode(".png", view.image)[1].tobytes() for view in views}
    alone = PairWorker({})
    extracted = (alone.extract(name, data, "sift", 1000) for name, data in files.items())
    images: dict[str, ImageFeatures] = {name: features for name, features, *_ in extracted}
    pairs = [(a, b) for a in images for b in images if a < b]
    expected = {(a, b): alone.filter(a, b, images[a], images[b], None).kept.tolist() for a, b in pairs}
    with Workers({}, 2, "ray") as workers:
        shared = {name: workers.share(image) for name, image in images.items()}
        rows = {}
        for row in workers.map("filter", ((a, b, shared[a], shared[b], None) for a, b in pairs)):
            if not rows:
                ray.kill(actors(workers)[0], no_restart=False)
            rows[row.name1, row.name2] = row.kept.tolist()
    assert rows == expected


def actors(workers: Workers) -> list:
    """The actors of the pool that Ray's backend for joblib keeps."""
    return [actor for actor, _ in workers._parallel._backend._pool._actor_pool]


def test_workers_that_stay_dead_are_a_pipeline_error(paths):
    def kill_again_and_again() -> None:
        with Workers({}, 2, "ray") as workers:
            for _ in workers.map("extract", ((f"{k}.png", b"", "sift", 10) for k in range(100))):
                for actor in actors(workers):
                    ray.kill(actor, no_restart=True)

    with pytest.raises(PipelineError, match="a Ray worker died more than 3 times"):
        kill_again_and_again()
    assert_nothing_asks_for_results()


def assert_nothing_asks_for_results() -> None:
    """Ray has ended, and no thread is left that would start it again."""
    assert not ray.is_initialized()
    assert not [thread for thread in threading.enumerate() if isinstance(thread, ResultThread)]


def test_an_error_of_the_source_comes_through(paths):
    def tasks():
        yield from ((f"{k}.png", b"", "sift", 10) for k in range(5))
        raise PipelineError("the source broke")

    with pytest.raises(PipelineError, match="the source broke"), Workers({}, 2, "ray") as workers:
        list(workers.map("extract", tasks()))
    assert_nothing_asks_for_results()


def test_results_that_nobody_takes_leave_no_thread(paths):
    with Workers({}, 2, "ray") as workers:
        next(workers.map("extract", ((f"{k}.png", b"", "sift", 10) for k in range(100))))
    assert_nothing_asks_for_results()


def test_no_cluster_at_the_address_is_one_line(paths, image_folder, tmp_path, capfd):
    words = ["folder", str(image_folder), "-o", str(tmp_path / "o.jsonl"), "--engine", "ray", "-j", "2"]
    assert cli.main([*words, "--address", "auto"]) == 2
    error = capfd.readouterr().err
    assert error.startswith("mgca-match: Ray at auto: ")
    assert error.count("\n") == 1
