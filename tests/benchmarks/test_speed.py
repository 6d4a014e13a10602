"""Ratios of the filter's time to MAGSAC's on the lists that users make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks import speed
from benchmarks.match_lists import open_detector_scenes
from benchmarks.speed import CLEAR, FILTERED, RAW_EARLY, RAW_NETWORK, ListTime


@pytest.mark.parametrize(
    ("family", "matches", "right_share", "network_ms", "group"),
    [
        ("raw", 2000, 0.1, 15.0, RAW_NETWORK),
        ("raw", 2000, 0.8, 0.0, RAW_EARLY),
        ("clean", 200, 0.7, 0.0, CLEAR),
        ("cross-check", 1500, 0.9, 15.0, CLEAR),
        ("cross-check", 1501, 0.9, 15.0, FILTERED),
        ("ratio-tested", 199, 0.9, 0.0, FILTERED),
        ("learned", 500, 0.69, 0.0, FILTERED),
    ],
)
def test_lists_are_grouped_as_the_targets_are(
    family: str, matches: int, right_share: float, network_ms: float, group: str
) -> None:
    assert ListTime(family, matches, right_share, 20.0, network_ms, 1.0).group == group


def test_ratios_by_hand() -> None:
    times = [ListTime("clean", 300, 0.9, *ms) for ms in ((10.0, 0.0, 10.0), (40.0, 15.0, 10.0), (30.0, 15.0, 20.0))]
    lines = speed.ratio_table(times).splitlines()
    assert len(lines) == 3
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    # medians 30 and 10; ratios 1, 4 and 1.5; sums 80 and 40; fits 10, 25 and 15, their ratios 1, 2.5 and 0.75
    assert cells == [CLEAR, "3", "300", "90 %", "30.0", "15.0", "10.0", "3.00", "1.50", "2.00", "2", "1.00"]


def test_clear_lists_by_length_by_hand() -> None:
    early = [ListTime("clean", 300, 0.9, *ms) for ms in ((10.0, 0.0, 10.0), (40.0, 0.0, 10.0))]
    others = [ListTime("clean", 349, 0.9, 40.0, 15.0, 10.0), ListTime("clean", 1500, 0.9, 30.0, 0.0, 10.0)]
    lines = speed.length_table([*early, *others, ListTime("clean", 100, 0.9, 30.0, 0.0, 10.0)]).splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert rows[0] == ["200 to 349", "3", "2", "25.0", "10.0", "2.50", "2.50"]
    assert rows[1] == ["1250 to 1500", "1", "1", "30.0", "10.0", "3.00", "3.00"]
    assert len(rows) == 2


def test_every_kind_of_list_of_every_pair_is_timed(tmp_path: Path, model_file: Path) -> None:
    pytest.importorskip("poselib")
    scenes = [make_scene(), make_scene(right=5, wrong=2, seed=1)]
    write_bundle(tmp_path / "hall.npz", scenes, match_mutual=np.packbits(np.ones(207, dtype=bool)))
    times = speed.time_lists(open_detector_scenes([tmp_path]), 1, str(model_file))
    # Of the second pair no list has eight matches.
    assert [one.family for one in times] == ["raw", "cross-check", "ratio-tested", "ratio-tested", "clean"]
    assert [one.matches for one in times][:2] == [200, 200]
    assert times[4].right_share > 0.9
    assert all(0.0 <= one.network_ms < one.filter_ms for one in times)
    assert all(one.magsac_ms > 0 for one in times)


def test_command_prints_ratios_for_bundles_alone(
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("poselib")
    for name in ("hall.orb2k", "hall.akaze2k"):
        write_bundle(tmp_path / f"{name}.npz", [make_scene(right=60, wrong=20, seed=seed) for seed in range(2)])
    options = ["--bundles", str(tmp_path), "--repeats", "1", "--model", str(model_file)]

    def number_of_lists(*more: str) -> int:
        speed.main([*options, *more])
        printed = capsys.readouterr().out
        assert "USAC_MAGSAC" in printed
        assert "Cold start" not in printed
        rows = [line.split("|") for line in printed.split("Of the ")[0].splitlines() if line.startswith("|")][2:]
        return sum(int(row[2]) for row in rows)

    assert number_of_lists() == 20
    assert number_of_lists("--per-scene", "1") == 10
    assert number_of_lists("--detectors", "orb2k") == 10
    assert number_of_lists("--kinds", "cross", "raw") == 8
