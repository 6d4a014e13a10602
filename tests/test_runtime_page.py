"""The page of speed, memory and parity: a script fills its tables; what the benchmark compares is an answer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from export_tools import EXPORT, load_export_module

import mgca_filter
from mgca_filter.geometry.epipolar import essential_from_pose

ROOT = Path(__file__).parent.parent


@pytest.fixture
def write_runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    module = load_export_module("write_runtime")
    copy = tmp_path / "runtime.md"
    copy.write_text((ROOT / "docs" / "runtime.md").read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(module, "PAGE", copy)
    return module


def test_every_command_has_its_place_on_the_page(write_runtime, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write_runtime, "run", lambda command: "| " + " ".join(command) + " |")
    write_runtime.main(["--bundles", "B"])
    page = write_runtime.PAGE.read_text(encoding="utf-8")
    for name, command in write_runtime.COMMANDS.items():
        words = " ".join(command) + (" --bundles B" if name == "parity" else "")
        assert f"<!-- {name} -->\n| {words} |\n\n`mgca_small.onnx` " in page
    before = page
    write_runtime.main(["--only", "parity"])
    assert write_runtime.PAGE.read_text(encoding="utf-8") == before.replace(" --bundles B |", " |")


def test_the_commands_exist_and_a_failure_ends_the_run(write_runtime) -> None:
    for script, *arguments in write_runtime.COMMANDS.values():
        assert (EXPORT / script).is_file()
        shown = subprocess.run([sys.executable, str(EXPORT / script), "--help"], capture_output=True, text=True)
        assert shown.returncode == 0
        assert all(word in shown.stdout for word in arguments if word.startswith("--"))
    with pytest.raises(SystemExit):
        write_runtime.run(("floor.py", "missing.onnx"))


def test_what_a_failing_command_printed_is_not_lost(write_runtime, tmp_path: Path, capfd, monkeypatch) -> None:
    (tmp_path / "disagrees.py").write_text("print('| FAILED |')\nraise SystemExit(1)\n")
    monkeypatch.setattr(write_runtime, "FOLDER", tmp_path)
    with pytest.raises(SystemExit):
        write_runtime.run(("disagrees.py",))
    assert "| FAILED |" in capfd.readouterr().err


def test_a_place_that_is_there_twice_stops_the_script(tmp_path: Path) -> None:
    pages, page = load_export_module("pages"), tmp_path / "page.md"
    page.write_text("<!-- a -->\n<!-- /a -->\n" * 2)
    with pytest.raises(SystemExit, match=r"page\.md: 2 places named a, expected one"):
        pages.fill_file(page, {"a": "new"})
    assert "new" not in page.read_text()


def test_errors_of_the_compared_answers() -> None:
    benchmark = load_export_module("benchmark")
    pair = benchmark.example_pair()
    assert 0.05 < pair.inlier_share < 0.2
    right = np.ones((len(pair.points1), 1), np.uint8)
    E = essential_from_pose(pair.R, pair.t)
    assert benchmark.answer_error_deg(pair, (np.vstack([E, np.eye(3)]), right)) == pytest.approx(0.0, abs=1e-5)
    assert benchmark.answer_error_deg(pair, (None, right)) == 180.0
    assert benchmark.answer_error_deg(pair, benchmark.paper_pass(20)()) is None
    result = mgca_filter.filter_matches(*pair.arguments, K1=pair.K1, K2=pair.K2)
    assert benchmark.answer_error_deg(pair, result) < 2.0
    lost = mgca_filter.filter_matches(pair.points1[:5], pair.points2[:5], None, K1=pair.K1, K2=pair.K2)
    assert benchmark.answer_error_deg(pair, lost) == 180.0
