"""The comparison of C++ with Python: both sides get the same pairs, in turn, and the table adds up."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks import cpp_speed
from benchmarks.cpp_speed import CppFilter, PairTime, TimedPair, ratio_table, write_pairs
from benchmarks.fill_docs import cpp
from benchmarks.speed import CLEAR, FILTERED, RAW_EARLY, RAW_NETWORK
from mgca_filter.data.scene_bundle import SceneBundle

# Answers as time_pairs does, 2 ms for each pair, and says how many pairs it was given.
PROGRAM = """#!{python}
import sys
print("Runtime 1, OpenCV 9", flush=True)
words = open(sys.argv[3]).read().split()
for line in sys.stdin:
    index, full = map(int, line.split())
    print(2.0 + full, "ok" if index == 0 else "planar", 7, flush=True)
"""


def pair(group: str, full: bool = False, camera: bool = True) -> TimedPair:
    rng = np.random.default_rng(0)
    points = [[cv2.KeyPoint(float(x), float(y), 4.0, 30.0) for x, y in rng.random((20, 2)) * 400] for _ in range(2)]
    rows = [(cv2.DMatch(i, i, 10.0), cv2.DMatch(i, 0, 20.0))[: 1 + i % 2] for i in range(20)]
    K = np.array([[500.0, 0.0, 200.0], [0.0, 500.0, 200.0], [0.0, 0.0, 1.0]]) if camera else None
    return TimedPair(group, *points, rows, K, K, full)


def test_pairs_are_written_as_the_program_reads_them(tmp_path: Path) -> None:
    write_pairs(tmp_path / "pairs.txt", [pair("a"), pair("b", camera=False)])
    numbers = np.array((tmp_path / "pairs.txt").read_text().split(), dtype=float)
    size = 3 + 8 + 20 * 4 * 2 + 20 * 5
    assert len(numbers) == 2 * size
    assert numbers[:11].tolist() == [20, 20, 20, *[500, 500, 200, 200] * 2]
    assert numbers[size : size + 11].tolist() == [20, 20, 20, *[0] * 8]
    assert numbers[size - 10 : size].tolist() == [18, 18, 10, -1, 0, 19, 19, 10, 0, 20]


def test_sides_take_turns_on_the_same_pairs(tmp_path: Path) -> None:
    program = tmp_path / "time_pairs"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    pairs = [pair("a"), pair("b", full=True)]
    with CppFilter(program, pairs) as filters:
        assert filters.versions == "Runtime 1, OpenCV 9"
        times = cpp_speed.time_pairs(filters, pairs, 2)
    assert [one.group for one in times] == ["a", "b"]
    assert [one.cpp_ms for one in times] == [2.0, 3.0]
    assert all(one.python_ms > 0 and one.magsac_ms > 0 for one in times)
    assert not any(one.agree for one in times)  # twenty points at random are no geometry


def test_what_a_failing_program_says_is_told(tmp_path: Path) -> None:
    program = tmp_path / "time_pairs"
    program.write_text("#!/bin/sh\necho 'time_pairs: no model' >&2\nexit 1\n")
    program.chmod(0o755)
    with pytest.raises(RuntimeError, match="no model"):
        CppFilter(program, [pair("a")])
    assert cpp_speed.main(["--build", str(tmp_path / "nowhere")]) == 2


def test_ratios_are_of_sums_within_a_group() -> None:
    times = [
        PairTime("raw", 10.0, 4.0, 8.0, True),
        PairTime("raw", 30.0, 16.0, 12.0, False),
        PairTime("clean", 10.0, 10.0, 5.0, True),
    ]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in ratio_table(times).splitlines()[2:]]
    assert rows == [
        ["raw", "2", "20.0", "10.0", "10.0", "0.50", "1.00", "2.00", "1 of 2"],
        ["clean", "1", "10.0", "10.0", "5.0", "1.00", "2.00", "2.00", "1 of 1"],
        ["all", "3", "10.0", "10.0", "8.0", "0.60", "1.20", "2.00", "2 of 3"],
    ]


def test_lists_of_a_bundle_are_what_opencv_holds(tmp_path: Path) -> None:
    write_bundle(tmp_path / "hall.npz", [make_scene(seed=4)])
    raw, filtered = cpp_speed.bundle_pairs([tmp_path / "hall.npz"], 1)
    source = SceneBundle(tmp_path / "hall.npz")[0]
    assert raw.group in (RAW_NETWORK, RAW_EARLY)
    assert filtered.group in (CLEAR, FILTERED)
    assert len(raw.rows) == len(source.points1) >= len(filtered.rows)
    points = [raw.keypoints2[row[0].trainIdx].pt for row in raw.rows]
    np.testing.assert_allclose(points, source.points2, atol=1e-3)
    assert source.attributes.ratio is not None
    np.testing.assert_allclose([row[0].distance for row in raw.rows], source.attributes.ratio)
    assert {row[1].distance for row in raw.rows} == {1.0}
    raw.magsac()


def test_the_page_has_the_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "cpp.md"
    copy.write_text(cpp.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(cpp, "PAGE", copy)
    monkeypatch.setattr(cpp, "run", lambda command: "| " + " ".join(command) + " |")
    cpp.main(["--build", "B", "--bundles", "C"])
    assert "<!-- speed -->\n| -m benchmarks.cpp_speed --build B --bundles C |\n\n`mgca_small.onnx` " in copy.read_text()
