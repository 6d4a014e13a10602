"""The study of easy pairs and of matches filtered beforehand, on scenes whose answers are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks import prefiltered_pairs
from mgca_filter.evaluation.pairs import iterate_pairs, select_pairs
from mgca_filter.evaluation.selection import Selection


@pytest.fixture
def bundles(tmp_path: Path) -> Path:
    """An easy, a hard and another easy pair."""
    folder = tmp_path / "bundles"
    folder.mkdir()
    scenes = [make_scene(seed=0), make_scene(right=20, wrong=300, seed=1), make_scene(seed=2)]
    write_bundle(folder / "hall.npz", scenes)
    return folder


def test_easy_pairs_are_those_with_many_right_matches(bundles: Path, tmp_path: Path) -> None:
    write_bundle(tmp_path / "cellar.npz", [make_scene(right=20, wrong=300)])
    selections = select_pairs([bundles, tmp_path / "cellar.npz"])
    easy = prefiltered_pairs.easy_pairs(selections)
    assert [(selection.scene, selection.indices) for selection in easy] == [("hall", (0, 2))]
    assert all(prefiltered_pairs.right_share(pair) >= prefiltered_pairs.EASY_SHARE for pair in iterate_pairs(easy))


def test_without_ratio_the_selection_has_it_and_the_filter_has_not(
    bundles: Path, model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = select_pairs(bundles)[0].source[0]
    method = prefiltered_pairs.ProductWithoutRatio(Selection(max_ratio=0.8), str(model_file))
    seen = {}

    def spy(shown, rows, model, options):
        seen["ratio"], seen["size"], seen["rows"] = shown.attributes.ratio, shown.attributes.size1, rows
        return unchanged(shown, rows, model, options)

    unchanged = prefiltered_pairs.filter_pair
    monkeypatch.setattr(prefiltered_pairs, "filter_pair", spy)
    answer = method.run(pair, 0)
    assert seen["ratio"] is None
    assert seen["size"] is not None
    np.testing.assert_array_equal(seen["rows"], np.flatnonzero(pair.attributes.ratio < 0.8))
    np.testing.assert_array_equal(answer.kept, pair.attributes.ratio < 0.8)
    assert 50 < np.count_nonzero(answer.mask) <= np.count_nonzero(answer.kept)
    assert not (answer.mask & ~answer.kept).any()
    assert answer.R is not None


def test_command_prints_two_tables_and_takes_known_results_from_the_store(
    bundles: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rendered = write_bundle(tmp_path / "rendered.npz", [make_scene(seed=7)])
    arguments = [str(bundles), str(rendered), "--model", str(model_file), "--per-scene", "1"]
    arguments += ["--store", str(tmp_path / "store")]
    assert prefiltered_pairs.main(arguments) == 0
    tables = capsys.readouterr().out.split("\n\n")
    rows = [[line.split(" | ") for line in table.splitlines()[2:]] for table in tables]
    assert [row[0] for row in rows[0]] == ["| photographs, easy", "| rendered, easy", "| rendered, all"]
    assert [row[1] for row in rows[0]] == ["2", "1", "1"]
    assert len(rows[1]) == 4 * len(prefiltered_pairs.TESTS)
    assert {row[3] for row in rows[1]} == {"1"}
    stored = {path: path.stat().st_mtime_ns for path in (tmp_path / "store").rglob("*.json")}
    assert prefiltered_pairs.main(arguments) == 0
    again = capsys.readouterr().out.split("\n\n")
    assert [again[0], again[1].strip()] == [tables[0], tables[1].strip()]
    assert stored == {path: path.stat().st_mtime_ns for path in (tmp_path / "store").rglob("*.json")}


def test_misuse_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert prefiltered_pairs.main([str(tmp_path), str(tmp_path / "none.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
