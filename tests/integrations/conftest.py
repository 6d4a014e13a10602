"""A rendered scene in four views, and the command as users call it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import multi_view
import pytest

ROOT = Path(__file__).parent.parent.parent
K_WORDS = "512,512,319.5,239.5"


@pytest.fixture(scope="session")
def views() -> list[multi_view.View]:
    return multi_view.render_views(4)


@pytest.fixture(scope="session")
def raw_matches(views):
    return multi_view.raw_matches(views)


@pytest.fixture
def image_folder(tmp_path, views) -> Path:
    """The views as files, and one file that is no image."""
    folder = tmp_path / "images"
    folder.mkdir()
    for view in views:
        cv2.imwrite(str(folder / view.name), view.image)
    return folder


def start_command(*arguments: object, **options) -> subprocess.Popen:
    """``mgca-match`` in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "mgca_filter.cli", *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **options
    )


def assert_one_line(captured, *words: str) -> None:
    """One line on stderr with all the words, nothing on stdout."""
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    for word in words:
        assert word in captured.err
