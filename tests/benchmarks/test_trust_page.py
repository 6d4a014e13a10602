"""The page of promises: its tables are filled by a script, and the commands that it names exist."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

from benchmarks.fill_docs import pages, trust

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "trust.md"
PLACES = (
    *("bad_input", "verdicts", "no_overlap", "score_calibration", "prefiltered_pairs", "focal_error", "detectors"),
    "photographs",
)


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy that the command fills."""
    copy = tmp_path / "trust.md"
    copy.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(trust, "PAGE", copy)
    return copy


ARGUMENTS = ["--bundles", "B", "--rendered", "R.npz", "--photos", "P", "--same-place", "S", "--store", "D"]
ARGUMENTS += ["--photographs", "hall", "yard", "--indoors", "hall", "--detector-bundles", "D"]


def test_studies_fill_their_places_and_nothing_else_changes(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, list[str]] = {}

    def fake(name: str, status: int = 0):
        def study(arguments: list[str]) -> int:
            seen[name] = arguments
            print(f"| {name} |\n")
            return status

        return study

    for name in ("bad_input", "prefiltered_pairs", "photographs"):
        monkeypatch.setattr(getattr(trust, name), "main", fake(name, status=int(name == "bad_input")))
    before = page.read_text(encoding="utf-8")
    for _ in range(2):
        trust.main([*ARGUMENTS, "--only", "bad_input", "prefiltered_pairs", "photographs"])
        after = page.read_text(encoding="utf-8")
        for name in ("bad_input", "prefiltered_pairs", "photographs"):
            assert f"<!-- {name} -->\n| {name} |\n\n{trust.provenance()}\n<!-- /{name} -->" in after
    assert seen["prefiltered_pairs"][:2] == ["B", "R.npz"]
    assert seen["photographs"][:6] == ["hall", "yard", "--indoors", "hall", "--bundles", "D"]
    assert set(seen) == {"bad_input", "prefiltered_pairs", "photographs"}
    blocks = re.compile(r"<!-- (bad_input|prefiltered_pairs|photographs) -->\n.*?<!-- /\1 -->", re.DOTALL)
    assert blocks.sub("", after) == blocks.sub("", before)


def test_every_study_takes_its_arguments_and_has_its_place(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = page.read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        trust.main([*ARGUMENTS, "--only", "nowhere"])
    places = re.search(r"some of (.*), got nowhere", capsys.readouterr().err)[1].split(", ")
    assert sorted(places) == sorted(PLACES)
    for place in places:
        pages.fill(text, place, "")
    with pytest.raises(ValueError, match="nowhere"):
        pages.fill(text, "nowhere", "")


def test_a_study_that_cannot_run_leaves_the_page_alone(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = page.read_text(encoding="utf-8")
    with pytest.raises(SystemExit, match="2"):
        trust.main([*ARGUMENTS, "--only", "score_calibration"])
    assert "B" in capsys.readouterr().err
    assert page.read_text(encoding="utf-8") == before


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_commands_on_the_page_exist(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    modules = set(re.findall(r"`python -m ((?:mgca_filter|benchmarks)[\w.]*)", PAGE.read_text(encoding="utf-8")))
    assert len(modules) >= 7
    for module in sorted(modules):
        monkeypatch.setattr(sys, "argv", [module, "--help"])
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        assert ended.value.code == 0, module
        assert capsys.readouterr().out.startswith("usage: "), module
