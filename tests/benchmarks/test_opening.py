"""The benchmark of opening times: what passes, what it prints, and a run on the ONNX Runtime that is here."""

from __future__ import annotations

import sys
from pathlib import Path

import onnxruntime
import pytest

from benchmarks import opening
from benchmarks.opening import Opening, format_openings


@pytest.mark.parametrize(
    ("row", "passed"),
    [
        (Opening("1", 0.9, 0.5, 1e-3, 0), True),
        (Opening("1", 0.1, 0.7, 1e-3, 0), False),
        (Opening("1", 0.1, 0.1, 1.0, 0), False),
        (Opening("1", 0.1, 0.1, 1e-3, 1), False),
    ],
)
def test_slow_versions_and_other_answers_fail(row: Opening, passed: bool) -> None:
    assert row.passed(0.6) == passed
    assert ("FAILED" in format_openings([row], 0.6)) != passed


@pytest.mark.parametrize(("limit", "status"), [("100", 0), ("0", 1)])
def test_versions_open_the_shipped_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], limit: str, status: int
) -> None:
    monkeypatch.setattr(opening, "environment_python", lambda folder, version: Path(sys.executable))
    version = onnxruntime.__version__
    arguments = ["--versions", version, "--repeats", "1", "--limit", limit, "--environments", str(tmp_path)]
    assert opening.main(arguments) == status
    shown = capsys.readouterr().out
    assert "`mgca_small.onnx` has " in shown
    assert f"| {version} |" in shown
