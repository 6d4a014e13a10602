"""The demo of the documentation in a browser: Python's logits, photographs of one's own, nothing from elsewhere."""

from __future__ import annotations

import base64
import functools
import http.server
import importlib
import json
import queue
import re
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, needs_chromium

from mgca_filter import model_path
from mgca_filter.features import create_detector, describe, match_features
from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import fundamental_from_essential, sampson_distance
from mgca_filter.inference import Backend, open_backend
from mgca_filter.inference.scoring import prior_logits, run_network, select_network_input

pytest.importorskip("skimage")
pytestmark = [needs_chromium, pytest.mark.slow, pytest.mark.timeout(600)]
# Neighbours are chosen by comparison, so that runtimes differ where two are equally far (mgca_filter.export.parity),
# the larger network more. Nine of ten logits, which reach ten, agree better than the first number, all than the second.
AGREEMENT = {"default": (0.05, 1.0), "fast": (2e-4, 0.02)}
QUESTIONS = Path(__file__).with_name("demo_questions.js")


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    """The demo as the documentation has it."""
    folder = tmp_path_factory.mktemp("site") / "demo"
    reason = browser_demo().build(folder)
    if reason:
        pytest.skip(f"no ONNX Runtime and OpenCV for the browser: {reason}")
    return folder


def browser_demo() -> Any:
    """The extension of Sphinx that writes the demo."""
    place = str(Path(__file__).parents[2] / "docs" / "extensions")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(place)
        return importlib.import_module("browser_demo")


class Visit(http.server.SimpleHTTPRequestHandler):
    """Serves the demo, and takes what the questions' answers are."""

    outcomes: queue.Queue[Any] = queue.Queue()
    asked: list[str] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        super().do_GET()

    def do_POST(self) -> None:
        self.outcomes.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Nothing is printed."""


@pytest.fixture(scope="module")
def seen(demo, tmp_path_factory) -> dict[str, Any]:
    """Answers to all questions, by name, in one visit."""
    page = (demo / "index.html").read_text(encoding="utf-8")
    questions = f"<script>{QUESTIONS.read_text(encoding='utf-8')}</script></body>"
    (demo / "asked.html").write_text(page.replace("</body>", questions), encoding="utf-8")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Visit, directory=str(demo)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
    profile = f"--user-data-dir={tmp_path_factory.mktemp('profile')}"
    # A debugging port keeps the browser open until it is told to go.
    address = f"http://127.0.0.1:{server.server_port}/asked.html"
    visit = subprocess.Popen(
        [str(CHROMIUM), *flags, profile, "--remote-debugging-port=0", address],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        outcome = Visit.outcomes.get(timeout=300)
    finally:
        visit.terminate()
        visit.wait(30)
        server.shutdown()
        server.server_close()
    assert {name: answer["error"] for name, answer in outcome.items() if "error" in answer} == {}
    return outcome


def floats(text: str, width: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, width)


def python_answer(pair: dict[str, Any], backend: Backend) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logits (M,) of a pair as ``filter_matches`` gets them, rows (N,) that are the network's, and its E (3, 3)."""
    points, attributes = floats(pair["points"], 4), floats(pair["attributes"], 8)
    x = np.hstack([normalize_points(points[:, :2], pair["K1"]), normalize_points(points[:, 2:], pair["K2"])])
    valid = np.ones(len(x), dtype=bool)
    sent = select_network_input(x, attributes, valid, backend, seed=0)
    (output,) = run_network(backend, [sent])
    logits = prior_logits(attributes, valid, backend.metadata)
    logits[sent.rows] = output.finite_logits
    return logits, sent.rows, output.essential


@pytest.mark.parametrize("name", AGREEMENT)
@pytest.mark.parametrize("number", range(5))
def test_logits_are_those_of_python(seen, demo, name, number):
    backend = open_backend(model_path(name))
    pair = json.loads((demo / f"pair{number}.json").read_text(encoding="utf-8"))
    expected, rows, essential = python_answer(pair, backend)
    answer = seen["scores"][model_path(name).stem][number]
    logits = np.array(answer["logits"])
    difference = np.abs(logits - expected)
    most = np.quantile(difference[rows], 0.9)
    print(f"{name}, pair {number}: nine of ten logits within {most:.0e}, all within {difference.max():.0e}")
    assert 300 < len(rows) < len(expected) == len(logits)
    assert most < AGREEMENT[name][0]
    assert difference.max() < AGREEMENT[name][1]
    # What never met the network differs by the rounding of one number.
    np.testing.assert_allclose(np.delete(logits, rows), np.delete(expected, rows), atol=1e-5)
    threshold = backend.metadata.decision_threshold
    np.testing.assert_array_equal(answer["accepted"], logits > threshold)
    assert np.count_nonzero((logits > threshold) != (expected > threshold)) <= len(rows) // 100
    np.testing.assert_allclose(answer["scores"], backend.metadata.calibration.probabilities(logits), atol=1e-6)
    F = fundamental_from_essential(essential, pair["K1"], pair["K2"])
    F, F_there = (np.ravel(matrix) / np.linalg.norm(matrix) for matrix in (F, answer["F"]))
    assert abs(F @ F_there) == pytest.approx(1, abs=1e-4)


def test_the_best_matches_of_rendered_pairs_are_right(seen):
    for answers in seen["scores"].values():
        for answer in answers[:4]:
            best = np.argsort(answer["scores"])[-50:]
            assert np.mean(np.array(answer["right"])[best]) > 0.8


def test_the_viewer_shows_what_is_accepted(seen):
    shown = seen["viewer"]
    assert shown["colours"] > 1000
    assert shown["kept"] == sum(seen["scores"]["mgca_small"][1]["accepted"])
    assert 0 < shown["fewer"] < shown["kept"]
    assert shown["complaints"] == []


def test_photographs_of_ones_own_are_matched_and_scored(seen, demo):
    own = seen["own"]
    pair = json.loads((demo / "pair1.json").read_text(encoding="utf-8"))
    points = np.array(own["points"]).reshape(-1, 4)
    accepted = np.array(own["accepted"])
    right = sampson_distance(points, np.array(pair["true_F"])) < 3
    assert accepted.sum() > 100
    assert np.mean(right[accepted]) > 0.9
    assert "AKAZE" in own["said"]
    assert any("Loading OpenCV" in words for words in own["steps"])


def test_matches_of_photographs_are_described_as_in_python(seen, demo):
    pair = json.loads((demo / "pair1.json").read_text(encoding="utf-8"))
    codes = (np.frombuffer(base64.b64decode(address.split(",")[1]), np.uint8) for address in pair["images"])
    found = [describe(cv2.imdecode(code, cv2.IMREAD_COLOR), create_detector("akaze")) for code in codes]
    matches = match_features(*found)
    expected = np.hstack([found[0].points[matches.index1], found[1].points[matches.index2]])  # (M, 4)
    there = np.array(seen["own"]["points"]).reshape(-1, 4)
    # Another decoder and another rounding of grey: most keypoints are the same to a tenth of a pixel.
    distance = np.abs(expected[:, None] - there[None]).max(axis=2)
    same = distance.min(axis=1) < 0.1
    assert same.sum() > 0.6 * len(expected)
    attributes = np.array(seen["own"]["attributes"]).reshape(-1, 8)[distance.argmin(axis=1)]
    difference = np.abs(attributes - matches.attributes.encode(len(expected)))[same]
    assert np.quantile(difference, 0.8, axis=0).max() < 0.05
    assert difference[:, 5:].max() == 0


def test_the_package_says_which_pairs_have_a_geometry(demo):
    remarks = [json.loads((demo / f"pair{number}.json").read_text(encoding="utf-8"))["remark"] for number in range(5)]
    assert ["both images show one scene" in remark for remark in remarks] == [True, True, True, True, False]


def test_images_without_keypoints_have_no_matches(seen):
    assert seen["blank"]["said"].startswith("0 of 0 matches accepted")


def test_a_file_that_is_no_image_is_told(seen):
    assert "notes.txt" in seen["noImage"]["said"]
    assert seen["noImage"]["failed"]


def test_nothing_comes_from_elsewhere(seen, demo):
    assert "/opencv.js" in Visit.asked
    for path in [*demo.glob("*.html"), demo / "demo.js", demo / "worker.js", demo / "demo.css", demo / "style.css"]:
        loaded = re.findall(
            r"(?:src=|href=|url\(|fetch\(|importScripts\()[\"']?https?:", path.read_text(encoding="utf-8")
        )
        assert loaded == [], path.name


def test_without_npm_the_page_says_that_it_cannot_score(tmp_path, monkeypatch):
    extension = browser_demo()
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert extension.build(tmp_path) == "npm is not installed"
    settings = json.loads((tmp_path / "settings.json").read_text(encoding="utf-8"))
    assert settings["complete"] is False
    assert len(settings["pairs"]) == 5
    assert not (tmp_path / "opencv.js").exists()
