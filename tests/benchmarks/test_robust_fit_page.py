"""The tables of the page on the robust fit come from what studies print."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.fill_docs import robust_fit

PRINTED = (
    "All of it.\n\n## Detectors\n\n| a |\n\n## By frames between the images\n\n| gap |\n|---|\n| 1 |\n\n## Confidence\n"
)


def test_each_place_holds_what_its_study_prints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, printed = tmp_path / "page.md", tmp_path / "printed.md"
    page.write_text("".join(f"<!-- {place} -->\n<!-- /{place} -->\n" for place in robust_fit.PLACES), encoding="utf-8")
    printed.write_text(PRINTED, encoding="utf-8")
    monkeypatch.setattr(robust_fit, "PAGE", page)
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(robust_fit, "run", lambda command: asked.append(command) or PRINTED.strip())
    robust_fit.main(["--printed", f"gaps={printed}"])
    text = page.read_text(encoding="utf-8")
    assert "<!-- gaps -->\n| gap |\n|---|\n| 1 |\n\n`mgca_small.onnx` " in text
    assert text.count("Detectors") == len(asked) == 0
    robust_fit.main(["A", "B", "--per-scene", "3"])
    assert [command[1].partition(".")[2] for command in asked] == ["fit_ablation", "input_kinds", "input_kinds"]
    assert asked[0][2:] == ("A", "--per-scene", "3")
    assert asked[2][2:4] == ("A", "B")
    assert page.read_text(encoding="utf-8").count("### Detectors") == 2
