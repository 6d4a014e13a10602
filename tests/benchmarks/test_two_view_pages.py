"""The pages on two views: a script fills their tables."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.fill_docs import two_views

ROOT = Path(__file__).parents[2]


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copies that the command fills."""
    shutil.copytree(ROOT / "docs" / "how_to", tmp_path / "how_to")
    monkeypatch.setattr(two_views, "PAGES", tmp_path / "how_to")
    return tmp_path / "how_to"


def test_every_command_has_its_place(pages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_views, "run", lambda command: " ".join(command))
    two_views.main(["--bundles", "B", "--per-scene", "7"])
    for name, (page, command) in two_views.COMMANDS.items():
        words = " ".join(command) + (" B --per-scene 7" if name == "without_intrinsics" else "")
        assert f"<!-- {name} -->\n{words}\n\n`mgca_small.onnx` " in (pages / page).read_text(encoding="utf-8")


def test_bundles_are_asked_for_where_they_are_needed(pages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_views, "run", lambda command: "")
    with pytest.raises(SystemExit):
        two_views.main([])
    two_views.main(["--only", "fisheye"])


@pytest.mark.slow
@pytest.mark.parametrize("name", two_views.COMMANDS)
def test_the_commands_exist(name: str) -> None:
    command = two_views.COMMANDS[name][1]
    shown = subprocess.run([sys.executable, *command[:2], "--help"], capture_output=True, text=True, cwd=ROOT)
    assert shown.returncode == 0
    assert all(word in shown.stdout for word in command if word.startswith("--"))
