"""The study of guessed focal lengths, on small data whose answers are known."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import make_scene
from scene_bundles import write_bundle

from benchmarks import focal_error
from mgca_filter import MatchFilter
from mgca_filter.data.scene_bundle import SceneBundle


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_bundle(tmp_path / "scene.npz", [make_scene(seed=0, noise_px=0.1), make_scene(seed=1, noise_px=0.1)])


def test_right_focal_length_is_best_and_none_gives_a_good_f(bundle: Path, match_filter: MatchFilter) -> None:
    pair = SceneBundle(bundle)[0]
    right, wrong, none = (focal_error.run_pair(pair, factor, match_filter) for factor in (1.0, 0.7, None))
    assert right.error_deg < 1.0
    assert wrong.error_deg > 2.0 * right.error_deg
    assert right.close > 0.95
    assert none.close > 0.9
    assert right.precision > 0.9


def test_focal_command_has_a_row_for_every_factor(
    bundle: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert focal_error.main([str(bundle), "--model", str(model_file), "--per-scene", "1"]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == [
        *(f"× {factor:g}" for factor in focal_error.FACTORS),
        "not given",
    ]
    assert all(row.split(" | ")[1] == "1" for row in rows)
    assert focal_error.main([str(bundle.parent / "none")]) == 2
