"""The engine on Ray: a real local Ray, two workers."""

from __future__ import annotations

import os

import cv2
import pytest
from pipeline_command import K_WORDS

from mgca_filter import cli
from mgca_filter.pipelines.worker import ImageFeatures, PairWorker

ray = pytest.importorskip("ray")
from mgca_filter.pipelines.ray_engine import RayEngine  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.timeout(280)]


@pytest.fixture
def paths(monkeypatch):
    """Ray's workers import the package from here, whether it is installed or not."""
    root = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    monkeypatch.setenv("PYTHONPATH", root)
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
    images: dict[str, ImageFeatures] = dict(alone.extract(name, data, "sift", 1000) for name, data in files.items())
    pairs = [(a, b) for a in images for b in images if a < b]
    expected = {(a, b): alone.filter(a, b, images[a], images[b], None).kept.tolist() for a, b in pairs}
    engine = RayEngine({}, 2)
    try:
        shared = {name: engine.share(image) for name, image in images.items()}
        rows = {}
        for row in engine.map("filter", ((a, b, shared[a], shared[b], None) for a, b in pairs)):
            if not rows:
                ray.kill(engine._actors[0], no_restart=False)
            rows[row.name1, row.name2] = row.kept.tolist()
    finally:
        engine.close()
    assert rows == expected
