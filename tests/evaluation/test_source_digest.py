"""The key of stored results follows the code that gives the answers."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import mgca_filter
from mgca_filter.evaluation import our_rows

PACKAGE = Path(mgca_filter.__file__).parent


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the package that the digest looks at."""
    package = tmp_path / "mgca_filter"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("models", "__pycache__"))
    monkeypatch.setattr(our_rows, "__file__", str(package / "evaluation" / "our_rows.py"))
    return package


def digest() -> str:
    return our_rows.runtime_source_digest.__wrapped__()


def test_every_folder_is_named_once() -> None:
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert sorted([*our_rows.ANSWER_PACKAGES, *our_rows.OTHER_PACKAGES]) == sorted(folders)


@pytest.mark.parametrize("folder", ["", *our_rows.ANSWER_PACKAGES])
def test_a_change_of_answering_code_changes_the_key(copy: Path, folder: str) -> None:
    before = digest()
    module = min((copy / folder).glob("*.py"))
    module.write_text(module.read_text() + "# changed\n")
    assert digest() != before


def test_a_module_that_moves_into_a_deeper_folder_still_counts(copy: Path) -> None:
    deeper = copy / our_rows.ANSWER_PACKAGES[0] / "deeper"
    deeper.mkdir()
    before = digest()
    (deeper / "new.py").write_text("X = 1\n")
    assert digest() != before


def test_the_evaluation_itself_does_not_count(copy: Path) -> None:
    before = digest()
    (copy / "evaluation" / "report.py").write_text("")
    assert digest() == before
