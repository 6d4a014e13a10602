"""Every command and every snippet of the pages runs, in the order of the page, in a folder of its own.

``bash`` and ``python`` blocks are run; the Python blocks of a page share their names. The folder holds ``examples``, as
a checkout does. Lines of a ``text`` block are found in what the block before it prints, but for the figures. A block
below a paragraph that begins with "Not run by the tests:" is only checked for options that its commands do not have,
and so are commands within the text and within blocks of no language.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import matplotlib
import pytest
from conftest import make_scene
from scene_bundles import bundle_fields, learned_fields

import mgca_filter
from mgca_filter import Status
from mgca_filter.cli import main
from mgca_filter.pipelines import folder

matplotlib.use("Agg")
ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
NOT_RUN = "Not run by the tests:"
LARGEST_NOT_RUN = 12
"""Blocks of all pages that are not run: few."""
NEEDS = {
    "evaluation.md": ["matplotlib"],
    "how_to/no_calibration.md": ["joblib", "pycolmap"],
    "pipelines/colmap.md": ["pycolmap", "joblib"],
    "pipelines/folder.md": ["pycolmap", "joblib"],
    "pipelines/hloc.md": ["h5py", "joblib"],
    "pipelines/ray.md": ["ray"],
}
"""Packages that a page needs beyond the runtime's."""
SLOW = {
    "evaluation.md",
    "how_to/no_calibration.md",
    "pipelines/colmap.md",
    "pipelines/folder.md",
    "pipelines/hloc.md",
    "pipelines/ray.md",
    "training.md",
}
ELSEWHERE = {"cpp.md"}
"""Pages whose blocks need the built C++ library: tests/test_cpp.py builds and uses it."""
# The package and the interpreter from here, under the names that users type.
PREAMBLE = f"""set -euo pipefail
python() {{ "{sys.executable}" "$@"; }}
mgca-match() {{ "{sys.executable}" -m mgca_filter "$@"; }}
"""


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, and whether the page says that it is not run."""

    language: str
    text: str
    run: bool


def read_blocks(page: str) -> list[Block]:
    """The fenced blocks of a page, in their order."""
    text = (DOCS / page).read_text(encoding="utf-8")
    blocks, before = [], 0
    for match in re.finditer(r"^```(\S*)[^\n]*\n(.*?)^```$", text, re.M | re.S):
        paragraph = text[before : match.start()].rstrip().rsplit("\n\n", 1)[-1].strip()
        blocks.append(Block(match[1], match[2], not paragraph.startswith(NOT_RUN)))
        before = match.end()
    return blocks


def runnable(page: str) -> list[Block]:
    if page in ELSEWHERE:
        return []
    return [block for block in read_blocks(page) if block.language in ("bash", "python", "text") and block.run]


def without_figures(line: str) -> str:
    """A line with its numbers and spaces alike, for times and last digits differ."""
    return re.sub(r"\s+", " ", re.sub(r"[+-]?\d+(\.\d*)?(e[+-]?\d+)?", "0", line)).strip()


@pytest.fixture
def workshop(tmp_path, monkeypatch) -> Path:
    """An empty folder that is the current one, with the examples of the repository in it."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def run_bash(text: str, folder: Path) -> str:
    """What the commands print, on both streams."""
    ray = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **ray}
    done = subprocess.run(["bash", "-c", PREAMBLE + text], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def run_python(text: str, name: str, names: dict[str, object]) -> str:
    """What the code prints; ``names`` are those of the page so far."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        exec(compile(text, name, "exec"), names)
    return output.getvalue()


def run_page(page: str, folder: Path) -> None:
    """All blocks of a page in their order; one that fails is named."""
    for package in NEEDS.get(page, ()):
        pytest.importorskip(package)
    names: dict[str, object] = {"__name__": "__main__"}
    printed = ""
    for number, block in enumerate(runnable(page), 1):
        if block.language == "bash":
            printed = run_bash(block.text, folder)
        elif block.language == "python":
            printed = run_python(block.text, f"{page}, block {number}", names)
        else:
            lines = {without_figures(line) for line in printed.splitlines()}
            assert {without_figures(line) for line in block.text.splitlines()} <= lines, printed


@pytest.mark.parametrize("page", [page for page in PAGES if runnable(page) and page not in SLOW])
def test_blocks_of_the_page(page, workshop):
    run_page(page, workshop)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("page", sorted(SLOW))
def test_blocks_of_the_long_page(page, workshop):
    assert runnable(page)
    run_page(page, workshop)


def test_no_block_hides_in_a_list():
    """Indented fences are not found, and would not be run."""
    hidden = [page for page in PAGES if re.search(r"^ +```", (DOCS / page).read_text(encoding="utf-8"), re.M)]
    assert hidden == []


def test_few_blocks_are_not_run():
    left_out = [page for page in PAGES for block in read_blocks(page) if not block.run]
    assert 1 <= len(left_out) <= LARGEST_NOT_RUN, left_out


def commands(page: str) -> list[list[str]]:
    """Words of the commands of this package that the tests do not run: in blocks that are not run, and in the text."""
    text = (DOCS / page).read_text(encoding="utf-8")
    for block in runnable(page):
        text = text.replace(block.text, "")
    text = re.sub(r"\\\n\s*", "", text)
    found = re.findall(
        r"`((?:python -m (?:mgca_filter|benchmarks)\b|mgca-match)[^`]*)`", re.sub(r"\n(?=\S)", " ", text)
    )
    found += re.findall(r"^.*?((?:python -m (?:mgca_filter|benchmarks)\b|mgca-match ).*)$", text, re.M)
    return [shlex.split(re.sub(r"`.*", "", line), comments=True) for line in found if line.count('"') % 2 == 0]


def help_of(words: list[str]) -> str:
    """What the command says with --help."""
    if words[0] == "python":
        module, rest = words[2], words[3:]
    else:
        module, rest = "mgca_filter", words[1:]
    if module == "mgca_filter":
        command = main
        rest = [word for word in rest[:1] if word in ("colmap", "hloc", "folder", "run", "train", "evaluate")]
    else:
        package = importlib.util.find_spec(module)
        assert package is not None, f"there is no {module}"
        name = f"{module}.__main__" if package.submodule_search_locations else module
        command, rest = importlib.import_module(name).main, []
    arguments = mock.patch.object(sys, "argv", ["command", *rest, "--help"])  # some read it themselves
    with arguments, contextlib.redirect_stdout(io.StringIO()) as output, contextlib.suppress(SystemExit):
        command()
    return output.getvalue()


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)])
def test_commands_that_are_not_run_have_their_options(page):
    for words in commands(page):
        said = help_of(words)
        for option in (word.split("=")[0] for word in words if re.fullmatch(r"--[a-z][a-z0-9-]*(=.*)?", word)):
            assert re.search(rf"{option}\b", said), f"{page}: {' '.join(words)}: no option {option}"


def test_the_api_page_names_all_that_is_public():
    text = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    missing = [name for name in mgca_filter.__all__ if not re.search(rf"auto\w+:: {name}\b", text)]
    assert missing == ["__version__"]


def test_the_status_page_tells_what_each_status_gives():
    table = (DOCS / "reference" / "statuses.md").read_text(encoding="utf-8").split("## What is given")[1]
    assert [status for status in Status if f"`{status.value}`" not in table] == []


def test_the_page_on_output_describes_json_lines():
    text = (DOCS / "reference" / "command-line-output.md").read_text(encoding="utf-8").split(".jsonl`")[1]
    keys = re.findall(r"``(\w+)``", folder.write_json_lines.__doc__ or "")
    assert "points1" in keys
    assert set(keys) <= set(re.findall(r"`(\w+)`", text))


def test_the_page_on_bundles_describes_every_array(tmp_path):
    text = (DOCS / "reference" / "bundle.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| ([^|]+) \|", text, re.M))))
    scenes = [make_scene()]
    assert named == set(bundle_fields(scenes)) | set(learned_fields(scenes)) | {"match_label"}
