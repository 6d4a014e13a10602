"""The page of promises: its tables are filled by a script, and the commands that it names exist."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "trust.md"


@pytest.fixture
def write_trust(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    spec = importlib.util.spec_from_file_location("write_trust", ROOT / "export" / "write_trust.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    copy = tmp_path / "trust.md"
    copy.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(module, "PAGE", copy)
    return module


def test_tables_go_to_their_places_and_nothing_else_changes(write_trust, tmp_path, monkeypatch) -> None:
    for name, text in (("a", "| one |"), ("b", "| two |"), ("s", "| three |")):
        (tmp_path / f"{name}.txt").write_text(text + "\n")
    words = ["detectors=a.txt", "detectors=b.txt", "stress=s.txt"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["write_trust.py", *words])
    before = write_trust.PAGE.read_text(encoding="utf-8")
    for _ in range(2):
        write_trust.main()
        after = write_trust.PAGE.read_text(encoding="utf-8")
        assert "<!-- stress -->\n| three |\n<!-- /stress -->" in after
        assert "<!-- detectors -->\na:\n\n| one |\n\nb:\n\n| two |\n<!-- /detectors -->" in after
    blocks = re.compile(r"<!-- (stress|detectors) -->\n.*?<!-- /\1 -->", re.DOTALL)
    assert blocks.sub("", after) == blocks.sub("", before)
    with pytest.raises(ValueError, match="nowhere"):
        write_trust.fill(before, "nowhere", "")


def test_commands_on_the_page_exist() -> None:
    modules = set(re.findall(r"`python -m (mgca_filter[\w.]*)", PAGE.read_text(encoding="utf-8")))
    assert len(modules) >= 5
    for module in sorted(modules):
        command = [sys.executable, "-m", module, "--help"]
        assert subprocess.run(command, capture_output=True, cwd=ROOT).returncode == 0, module
