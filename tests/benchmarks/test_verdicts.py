"""The study of the status: unrelated photographs, true pairs, and the table of both."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks import verdicts
from benchmarks.verdicts import PhotoFolder, draw_unrelated, read_places


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures of blurred noise; the last two are the same."""
    folder = tmp_path_factory.mktemp("photos")
    for i in range(4):
        noise = np.random.default_rng(min(i, 2)).integers(0, 256, (120, 160), dtype=np.uint8)
        cv2.imwrite(str(folder / f"p{i}.png"), cv2.GaussianBlur(noise, (0, 0), 1.5))
    return folder


def test_pairs_of_one_place_are_never_drawn(tmp_path: Path) -> None:
    (tmp_path / "places.txt").write_text("a b c\n\nd e\n")
    places = read_places(tmp_path / "places.txt")
    names = list("fedcba")
    drawn = draw_unrelated(names, places, 100, seed=0)
    assert len(drawn) == 15 - 3 - 1
    assert all(one < two for one, two in drawn)
    assert not {("a", "b"), ("b", "c"), ("a", "c"), ("d", "e")} & set(drawn)
    assert len(draw_unrelated(names, places, 4, seed=0)) == 4
    assert draw_unrelated(names, places, 4, seed=0) != draw_unrelated(names, places, 4, seed=1)


def test_features_and_matches_are_computed_once(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = PhotoFolder(photos, tmp_path).pair("p0", "p1")
    assert first.kp1.shape == first.kp2.shape == (len(first.attributes.ratio), 2)
    assert tuple(first.size1) == (160, 120)

    def fail(*arguments: object) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr(verdicts, "detect", fail)
    monkeypatch.setattr(verdicts, "match_features", fail)
    again = PhotoFolder(photos, tmp_path).pair("p0", "p1")
    np.testing.assert_array_equal(first.kp2, again.kp2)
    np.testing.assert_array_equal(first.attributes.ratio, again.attributes.ratio)


def test_command_counts_every_pair_and_goes_on_where_it_stopped(
    photos: Path, tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "places.txt").write_text("p2 p3\n")
    bundle = write_bundle(tmp_path / "scene.npz", [make_scene(seed=0), make_scene(seed=1)])
    arguments = [str(photos), "--store", str(tmp_path / "store"), "--model", str(model_file)]
    arguments += ["--same-place", str(tmp_path / "places.txt"), "--bundles", str(bundle), "--list", str(tmp_path / "l")]
    assert verdicts.main(arguments) == 0
    table = capsys.readouterr().out
    rows = [line.split(" | ") for line in table.splitlines()[2:]]
    assert [row[2] for row in rows[:2]] == ["5", "5"]
    assert [row[0] for row in rows[:2]] == ["| unrelated"] * 2
    assert rows[2][2] == "2"
    monkeypatch.setattr(verdicts, "judge_trial", None)
    assert verdicts.main(arguments) == 0
    assert capsys.readouterr().out == table


def test_table_tells_false_from_lost() -> None:
    rows = [
        verdicts.Judged("a", False, "given", status, 180.0) for status in ("ok", "unrelated", "planar", "unrelated")
    ]
    rows += [
        verdicts.Judged("b", True, "given", status, 1.0) for status in ("ok", "planar", "low_support", "unrelated")
    ]
    rows += [verdicts.Judged("c", True, "given", "unrelated", 11.0)]
    unrelated, true = verdicts.format_table(rows).splitlines()[2:]
    assert "25.0 % false ok" in unrelated
    assert "25.0 % lost, 25.0 % doubted" in true
    assert "| 4 |" in true


def test_misuse_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert verdicts.main([str(tmp_path), "--store", str(tmp_path)]) == 2
    assert "two photographs" in capsys.readouterr().err
