"""The page of speed, memory and parity: a script fills its tables; what the benchmark compares is an answer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mgca_filter
from benchmarks import speed
from benchmarks.fill_docs import pages, runtime
from mgca_filter.geometry.epipolar import essential_from_pose

ROOT = Path(__file__).parents[2]


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy that the command fills."""
    copy = tmp_path / "runtime.md"
    copy.write_text((ROOT / "docs" / "runtime.md").read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(runtime, "PAGE", copy)
    return copy


def test_every_command_has_its_place_on_the_page(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "run", lambda command: "| " + " ".join(command) + " |")
    runtime.main(["--bundles", "B", "--lists", "C", "D"])
    before = page.read_text(encoding="utf-8")
    lists = " --bundles C D"
    for name, command in runtime.COMMANDS.items():
        words = " ".join(command) + {"parity": " --bundles B", "lists": lists, "lists_fast": lists}.get(name, "")
        assert f"<!-- {name} -->\n| {words} |\n\n`mgca_small.onnx` " in before
    runtime.main(["--only", "parity"])
    assert page.read_text(encoding="utf-8") == before.replace(" --bundles B |", " |")
    with pytest.raises(SystemExit):
        runtime.main(["--bundles", "B"])


@pytest.mark.slow
def test_the_commands_exist_and_a_failure_ends_the_run() -> None:
    words: dict[tuple[str, ...], set[str]] = {}
    for command in runtime.COMMANDS.values():
        script = command[:2] if command[0] == "-m" else command[:1]
        words.setdefault(script, set()).update(word for word in command if word.startswith("--"))
    for script, options in words.items():
        shown = subprocess.run([sys.executable, *script, "--help"], capture_output=True, text=True, cwd=ROOT)
        assert shown.returncode == 0
        assert all(option in shown.stdout for option in options)
    with pytest.raises(SystemExit):
        runtime.run(("-m", "benchmarks.profile_network", "missing.onnx"))


def test_what_a_failing_command_printed_is_not_lost(tmp_path: Path, capfd, monkeypatch) -> None:
    (tmp_path / "disagrees.py").write_text("print('| FAILED |')\nraise SystemExit(1)\n")
    monkeypatch.setattr(runtime, "ROOT", tmp_path)
    with pytest.raises(SystemExit):
        runtime.run(("disagrees.py",))
    assert "| FAILED |" in capfd.readouterr().err


def test_a_place_that_is_there_twice_stops_the_script(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- a -->\n<!-- /a -->\n" * 2)
    with pytest.raises(SystemExit, match=r"page\.md: 2 places named a, expected one"):
        pages.fill_file(page, {"a": "new"})
    assert "new" not in page.read_text()


def test_errors_of_the_compared_answers() -> None:
    pair = speed.example_pair()
    assert 0.05 < pair.inlier_share < 0.2
    right = np.ones((len(pair.points1), 1), np.uint8)
    E = essential_from_pose(pair.R, pair.t)
    assert speed.answer_error_deg(pair, (np.vstack([E, np.eye(3)]), right)) == pytest.approx(0.0, abs=1e-5)
    assert speed.answer_error_deg(pair, (None, right)) == 180.0
    assert speed.answer_error_deg(pair, speed.paper_pass(20)()) is None
    result = mgca_filter.filter_matches(*pair.arguments, K1=pair.K1, K2=pair.K2)
    assert speed.answer_error_deg(pair, result) < 2.0
    lost = mgca_filter.filter_matches(pair.points1[:5], pair.points2[:5], None, K1=pair.K1, K2=pair.K2)
    assert speed.answer_error_deg(pair, lost) == 180.0
