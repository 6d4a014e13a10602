"""The page of promises: its tables are filled by a script, and the commands that it names exist."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from export_tools import load_export_module

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "trust.md"
PLACES = ("stress", "verdicts", "scores", "never_worse", "focal", "detectors")


@pytest.fixture
def write_trust(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    module = load_export_module("write_trust")
    copy = tmp_path / "trust.md"
    copy.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(module, "PAGE", copy)
    return module


ARGUMENTS = ["--bundles", "B", "--rendered", "R.npz", "--photos", "P", "--same-place", "S", "--store", "D"]


def test_studies_fill_their_places_and_nothing_else_changes(write_trust, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, list[str]] = {}

    def fake(name: str, status: int = 0):
        def study(arguments: list[str]) -> int:
            seen[name] = arguments
            print(f"| {name} |\n")
            return status

        return study

    for name in ("stress", "never_worse"):
        monkeypatch.setattr(getattr(write_trust, name), "main", fake(name, status=int(name == "stress")))
    before = write_trust.PAGE.read_text(encoding="utf-8")
    for _ in range(2):
        write_trust.main([*ARGUMENTS, "--only", "stress", "never_worse"])
        after = write_trust.PAGE.read_text(encoding="utf-8")
        for name in ("stress", "never_worse"):
            assert f"<!-- {name} -->\n| {name} |\n\n{write_trust.provenance()}\n<!-- /{name} -->" in after
    assert seen["never_worse"][:2] == ["B", "R.npz"]
    assert set(seen) == {"stress", "never_worse"}
    blocks = re.compile(r"<!-- (stress|never_worse) -->\n.*?<!-- /\1 -->", re.DOTALL)
    assert blocks.sub("", after) == blocks.sub("", before)


def test_every_study_takes_its_arguments_and_has_its_place(write_trust, capsys: pytest.CaptureFixture[str]) -> None:
    page = write_trust.PAGE.read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        write_trust.main([*ARGUMENTS, "--only", "nowhere"])
    pages = load_export_module("pages")
    places = re.search(r"some of (.*), got nowhere", capsys.readouterr().err)[1].split(", ")
    assert sorted(places) == sorted(PLACES)
    for place in places:
        pages.fill(page, place, "")
    with pytest.raises(ValueError, match="nowhere"):
        pages.fill(page, "nowhere", "")


def test_a_study_that_cannot_run_leaves_the_page_alone(write_trust, capsys: pytest.CaptureFixture[str]) -> None:
    before = write_trust.PAGE.read_text(encoding="utf-8")
    with pytest.raises(SystemExit, match="2"):
        write_trust.main([*ARGUMENTS, "--only", "scores"])
    assert "B" in capsys.readouterr().err
    assert write_trust.PAGE.read_text(encoding="utf-8") == before


def test_commands_on_the_page_exist() -> None:
    modules = set(re.findall(r"`python -m (mgca_filter[\w.]*)", PAGE.read_text(encoding="utf-8")))
    assert len(modules) >= 7
    for module in sorted(modules):
        command = [sys.executable, "-m", module, "--help"]
        assert subprocess.run(command, capture_output=True, cwd=ROOT).returncode == 0, module
