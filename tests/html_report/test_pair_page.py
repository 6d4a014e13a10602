"""The report of a pair in a browser: it runs under its own policy, and every control does what it says."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from browser import ask, needs_chromium, open_page
from conftest import SIZE, K, make_scene

from mgca_filter import FilterResult, MatchFilter
from mgca_filter.geometry.cameras import normalize_points
from mgca_filter.geometry.epipolar import sampson_distance
from mgca_filter.html_report import Baseline, Truth, write_pair_report

pytestmark = [needs_chromium, pytest.mark.slow]
SCENE = make_scene(seed=3, right=80, wrong=40)
CHECKS = "pair_checks.js"
NAME = "<img src=x onerror='document.title=1'>.jpg"


@pytest.fixture(scope="module")
def result(model_file) -> FilterResult:
    return MatchFilter(model=model_file, effort="full").filter(*SCENE.keypoints(), SCENE.knn_matches(), K1=K)


@pytest.fixture(scope="module")
def baseline() -> np.ndarray:
    return np.random.default_rng(5).random(120) < 0.5


@pytest.fixture(scope="module")
def report(tmp_path_factory, result, baseline):
    """A report with everything in it, of smooth random images."""
    noise = [np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8) for seed in (0, 1)]
    images = [cv2.GaussianBlur(image, (9, 9), 3) for image in noise]
    path = tmp_path_factory.mktemp("report") / "pair.html"
    return write_pair_report(
        path, *images, result, name1="one.jpg", name2=NAME, baselines=[Baseline("RANSAC", baseline)], K1=K,
        truth=Truth(R=SCENE.R, t=SCENE.t), matches=SCENE.knn_matches(),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rows(result) -> dict[str, int]:
    """The kept matches that a check is about."""
    kept = np.flatnonzero(result.mask)
    return {"hover": int(kept[7]), "epipolarLine": int(kept[3])}


@pytest.fixture(scope="module")
def seen(report, rows, tmp_path_factory):
    """What all checks saw, by name."""
    names = ("names", "sliders", "hover", "epipolarLine", "looseClick", "keys", "wheelAndDrag", "comparison", "scene")
    questions = {name: rows.get(name) for name in (*names, "colours", "unnamed")}
    return ask(report, tmp_path_factory.mktemp("asked"), CHECKS, questions)


def test_the_page_runs_under_its_own_policy(report, tmp_path, result):
    page = open_page(report, tmp_path)
    assert page.complaints == []
    assert f"<strong>{result.num_inliers}</strong> of 120 kept" in page.dom
    assert re.search(r'id="tab-matches"[^>]*aria-selected="true"', page.dom)
    assert "<img" not in page.dom
    assert f"<title>{NAME}" not in page.dom


def test_the_policy_stops_a_script_that_is_not_the_page_s_own(report, tmp_path):
    intruded = tmp_path / "intruded.html"
    intruder = '<script>document.body.dataset.intruded = "yes"</script>'
    intruded.write_text(report.read_text(encoding="utf-8").replace("</body>", intruder + "</body>"), encoding="utf-8")
    page = open_page(intruded, tmp_path / "profile")
    assert 'data-intruded="yes"' not in page.dom
    assert any("Content Security Policy" in line for line in page.complaints)


def test_a_name_is_text_and_nothing_else(seen):
    seen = seen["names"]
    assert seen["names"] == ["one.jpg", NAME]
    assert seen["images"] == 0
    assert NAME in seen["title"]


def test_sliders_count_as_numpy_does(seen, result):
    seen = seen["sliders"]
    x = np.hstack([normalize_points(points, K) for points in (result.points1, result.points2)])
    near = 800 * sampson_distance(x, result.E) <= 0.4
    assert int(seen["near"].split()[0]) == pytest.approx(near.sum(), abs=1)
    assert int(seen["both"].split()[0]) == pytest.approx((near & (result.scores >= 0.6)).sum(), abs=1)
    assert 0 < int(seen["both"].split()[0]) < int(seen["near"].split()[0]) < result.num_inliers
    assert seen["said"] == "0.60"
    assert f"{result.num_inliers} of 120 kept" in seen["own"]
    assert seen["own"].endswith("the filter’s own")
    np.testing.assert_array_equal(seen["selected"], result.mask)
    assert seen["disabled"]


def test_pointing_at_a_match_shows_its_patches_and_numbers(seen, rows, result):
    row = rows["hover"]
    seen = seen["hover"]
    assert seen["values"]["score"] == f"{result.scores[row]:.3f}"
    assert seen["values"]["ratio"] == f"{SCENE.attributes.ratio[row]:.2f}"
    assert seen["values"]["residual"].endswith(" px")
    assert seen["values"]["verdict"] == "kept"
    assert seen["values"]["truth"] == "right"
    assert min(seen["patches"]) > 100
    assert seen["hover"] == -1
    assert seen["left"] == 0


def test_a_click_draws_the_epipolar_line_through_the_match(seen, rows, result):
    row = rows["epipolarLine"]
    seen = seen["epipolarLine"]
    assert seen["pin"] == row
    expected = result.F @ [*result.points1[row], 1.0]
    cosine = np.dot(expected, seen["line"]) / np.linalg.norm(expected) / np.linalg.norm(seen["line"])
    assert abs(cosine) > 1 - 1e-6
    a, b, c = seen["line"]
    assert abs(a * result.points2[row, 0] + b * result.points2[row, 1] + c) / np.hypot(a, b) < 3.0
    assert min(seen["pixel"][:2]) > 180  # yellow, or the white of the true line above it
    assert "Epipolar line of the match" in seen["hint"]
    assert f"Match {row + 1}" in seen["status"]


def test_a_click_beside_the_matches_draws_a_line_as_well(seen):
    seen = seen["looseClick"]
    assert seen["spot"]["side"] == 1
    assert (seen["spot"]["x"], seen["spot"]["y"]) == pytest.approx((100, 200), abs=0.01)
    assert seen["after"] is None


def test_keys_do_what_the_list_of_keys_says(seen, result):
    seen = seen["keys"]
    assert seen["flags"] == [True, True, True, True]
    assert seen["first"] == seen["again"]
    assert result.scores[seen["first"]] == pytest.approx(result.scores.max(), abs=1e-4)
    assert seen["further"] < seen["fit"] == pytest.approx(seen["back"])
    assert seen["closer"] == pytest.approx(1.25 * seen["fit"])
    assert seen["zoomed"] > 2 * seen["fit"]
    assert seen["moved"] == pytest.approx(40)
    assert seen["tabs"] == ["compare", "geometry", "why", "matches"]
    assert seen["one"] != seen["two"]
    assert seen["dialog"]
    assert seen["listed"] > 12


def test_wheel_and_drag_move_the_image_under_the_pointer(seen):
    seen = seen["wheelAndDrag"]
    x, y = seen["start"]
    assert seen["wheeled"] == pytest.approx([x, y], abs=1.0)  # events of the wheel know whole pixels
    assert seen["dragged"] == pytest.approx([seen["wheeled"][0] + 30, seen["wheeled"][1] - 20], abs=0.01)
    assert seen["still"] == pytest.approx(seen["other"])
    assert seen["scale"] > 100
    assert seen["pin"] == -1


def test_comparison_counts_who_keeps_what(seen, result, baseline):
    seen = seen["comparison"]
    tally = {name: sum(counts) for name, counts in seen["tally"].items()}
    assert tally == {
        "both": np.count_nonzero(result.mask & baseline),
        "ours": np.count_nonzero(result.mask & ~baseline),
        "theirs": np.count_nonzero(~result.mask & baseline),
        "neither": np.count_nonzero(~result.mask & ~baseline),
    }
    assert seen["groups"] == {"both": False, "ours": True, "theirs": True, "neither": False}
    assert seen["only"]
    kept = [str(result.num_inliers), str(np.count_nonzero(baseline))]
    assert [cells[:2] for cells in seen["cells"]] == [["mgca_filter", kept[0]], ["RANSAC", kept[1]]]


def test_the_scene_turns(seen):
    seen = seen["scene"]
    assert seen["colours"] > 50
    assert seen["turned"]
    assert seen["through"]
    assert seen["again"]
    assert seen["hidden"]


def test_every_way_to_colour_the_matches_looks_different(seen):
    assert seen["colours"] == 4


def test_controls_have_names(seen):
    seen = seen["unnamed"]
    assert seen["controls"] > 25
    assert seen["unnamed"] == []


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_the_address_says_how_it_opens(report, tmp_path, theme):
    page = open_page(report, tmp_path, place=f"tab=why&theme={theme}")
    assert f'data-theme="{theme}"' in page.dom[:200]
    assert re.search(r'id="tab-why"[^>]*aria-selected="true"', page.dom)


def test_light_and_dark_follow_the_system_until_the_reader_says_otherwise(report, tmp_path):
    seen = [
        ask(report, tmp_path, CHECKS, {"theme": None}, f"--blink-settings=preferredColorScheme={scheme}")["theme"]
        for scheme in (0, 1)
    ]
    assert sorted(one["dark"] for one in seen) == [False, True]
    assert seen[0]["background"] == seen[1]["other"] != seen[0]["other"] == seen[1]["background"]


@pytest.mark.parametrize("kind", ["unrelated", "rotation", "empty"])
def test_pairs_without_a_model_open_as_well(tmp_path, model_file, kind):
    scene = make_scene("rotation") if kind == "rotation" else make_scene(right=0, wrong=200)
    count = 0 if kind == "empty" else 200
    answer = MatchFilter(model=model_file).filter(scene.points1[:count], scene.points2[:count], None, K1=K)
    image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
    seen = ask(
        write_pair_report(tmp_path / "p.html", image, image, answer, K1=K), tmp_path, CHECKS, {"everyTab": None}
    )["everyTab"]
    assert seen["headline"].endswith(".")
    assert seen["residual"] == any(model is not None for model in (answer.E, answer.H))
    assert seen["residual"] or kind != "rotation"
    assert f"of {count} kept" in seen["live"]
