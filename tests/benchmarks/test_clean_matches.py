"""The filter over the matches that COLMAP's verification keeps: rows by hand, and the command on rendered views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import clean_matches
from benchmarks.clean_matches import Verification, comparison_table, in_turn


def test_ratios_are_to_the_first_row() -> None:
    rows = [Verification("COLMAP", 6, 700, 20.0, 4, 120), Verification("mgca_filter", 6, 690, 50.0, 4, 118)]
    lines = comparison_table(rows).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert cells == [
        ["COLMAP", "6", "700", "20.0", "1.00", "4", "120"],
        ["mgca_filter", "6", "690", "50.0", "2.50", "4", "118"],
    ]


def test_calls_take_turns_and_the_first_one_is_not_timed() -> None:
    called: list[str] = []
    answers, best = in_turn({name: lambda name=name: called.append(name) or name for name in "ab"}, 2)
    assert called == ["a", "b"] * 3
    assert answers == {"a": "a", "b": "b"}
    assert all(0 <= value < 1000 for value in best.values())


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, views: list) -> Path:
    """Three views as files."""
    import cv2

    folder = tmp_path_factory.mktemp("images")
    for view in views[:3]:
        cv2.imwrite(str(folder / view.name), view.image)
    return folder


@pytest.mark.slow
def test_both_verify_what_colmap_keeps(rendered: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    database = tmp_path / "colmap.db"
    matches = clean_matches.verified_by_colmap(rendered, database, clean_matches.RENDERED_CAMERA, 0)
    assert len(matches) == 3
    assert all(rows.shape[1] == 2 and len(rows) >= 15 for rows in matches.values())
    colmap, ours = clean_matches.compare(database, matches, 1, 0, None)
    total = sum(map(len, matches.values()))
    assert (colmap.name, ours.name) == ("COLMAP", "mgca_filter")
    for one in (colmap, ours):
        assert one.pairs == one.images == 3
        assert 0.5 * total < one.matches <= total
        assert one.points > 30
        assert one.ms > 0


def test_the_command_renders_or_takes_a_folder(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap")
    asked: list[tuple[Path, object, int]] = []

    def verified(images: Path, database: Path, camera: object, seed: int) -> dict:
        asked.append((images, camera, seed))
        return {(1, 2): np.zeros((20, 2), np.uint32)}

    monkeypatch.setattr(clean_matches, "render_views", lambda folder, count: folder / f"{count} views")
    monkeypatch.setattr(clean_matches, "verified_by_colmap", verified)
    monkeypatch.setattr(
        clean_matches, "compare", lambda database, matches, *options: [Verification(str(options), 1, 20, 5.0, 2, 9)]
    )
    assert clean_matches.main(["--views", "5", "--repeats", "4", "--seed", "3"]) == 0
    assert clean_matches.main([str(rendered), "--model", "other.onnx"]) == 0
    assert (asked[0][0].name, *asked[0][1:]) == ("5 views", clean_matches.RENDERED_CAMERA, 3)
    assert asked[1] == (rendered, None, 0)
    printed = capsys.readouterr().out
    assert "1 pairs with 20 matches" in printed
    assert "(4, 3, None)" in printed
    assert "(3, 0, 'other.onnx')" in printed


def test_images_without_a_match_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pycolmap")
    import cv2

    for name in "ab":
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((120, 160), 90, np.uint8))
    assert clean_matches.main([str(tmp_path)]) == 2
    assert "keeps no match" in capsys.readouterr().err
