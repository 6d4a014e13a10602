"""The report of a pair as a file: alone, small, harmless, and true to the result it is about."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import SIZE, K, make_scene

from mgca_filter import FilterResult, MatchFilter, Status, cli
from mgca_filter.html_report import Baseline, Truth, show, write_pair_report
from mgca_filter.html_report.embedded import embed_images, pack, pack_mask
from mgca_filter.html_report.page import LIMIT_BYTES, escape, inert_json
from mgca_filter.html_report.pair_report import MAX_MATCHES_SHOWN
from mgca_filter.verdict_text import describe_verdict

SCENE = make_scene(seed=3, right=80, wrong=40)
ASSETS = Path(cli.__file__).parents[1] / "html_report"
IMAGES = Path(__file__).parents[2] / "examples" / "images"


def noise(width: int, height: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def result(model_file) -> FilterResult:
    return MatchFilter(model=model_file, effort="full").filter(*SCENE.keypoints(), SCENE.knn_matches(), K1=K)


@pytest.fixture
def written(tmp_path, result):
    """Writes a report of noise images and gives back (text, data)."""

    def write(answer: FilterResult = result, **options) -> tuple[str, dict]:
        path = write_pair_report(tmp_path / "pair.html", noise(*SIZE), noise(*SIZE, seed=1), answer, **options)
        text = path.read_text(encoding="utf-8")
        return text, data_of(text)

    return write


def data_of(text: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def unpacked(column: dict) -> np.ndarray:
    codes = np.frombuffer(base64.b64decode(column["codes"]), dtype="<u2").astype(float)
    return np.where(codes == 65535, np.nan, column["lo"] + (column["hi"] - column["lo"]) * codes / 65534)


def test_nothing_in_the_file_asks_a_network(written):
    text, data = written(name1="https://example.org/a.jpg", command="mgca-match http://example.org/a b")
    assert not re.search(r"https?://|//[a-z]+\.|@import|url\(|<link|<iframe|xmlns|fetch\(|XMLHttp|WebSocket", text)
    assert set(re.findall(r'\bsrc="([^"]*)"', text)) == set()
    assert all(address.startswith("data:image/jpeg;base64,") for address in data["images"])
    assert "default-src 'none'; img-src data:;" in text
    assert data["names"][0] == "https://example.org/a.jpg"


@pytest.mark.parametrize("size", [(64, 48), (1024, 768), (4000, 3000), (30, 4000)])
def test_the_file_is_small_whatever_the_images(tmp_path, result, size):
    path = write_pair_report(tmp_path / "pair.html", noise(*size), noise(*size, seed=1), result)
    assert path.stat().st_size <= LIMIT_BYTES == 1_000_000


def many_matches(count: int, kept: int) -> FilterResult:
    rng = np.random.default_rng(0)
    mask = np.zeros(count, dtype=bool)
    mask[rng.permutation(count)[:kept]] = True
    points = rng.uniform(0, 480, (2, count, 2))
    scores = rng.uniform(0, 1, count).astype(np.float32)
    F = np.random.default_rng(1).normal(size=(3, 3))
    return FilterResult(
        mask, scores, np.zeros((kept, 2), np.intp), None, F, None, None, None, Status.OK, kept, None, *points
    )


@pytest.mark.parametrize(("kept", "shown_kept"), [(500, 500), (25_000, MAX_MATCHES_SHOWN)])
def test_of_very_many_matches_the_kept_ones_are_in_the_file(tmp_path, kept, shown_kept):
    path = write_pair_report(tmp_path / "pair.html", noise(3000, 2000), noise(3000, 2000), many_matches(50_000, kept))
    assert path.stat().st_size <= LIMIT_BYTES
    data = data_of(path.read_text(encoding="utf-8"))
    assert data["total"] == 50_000
    assert len(data["rows"]) == MAX_MATCHES_SHOWN
    assert data["why"]["left_out"] == 50_000 - MAX_MATCHES_SHOWN
    bits = np.unpackbits(np.frombuffer(base64.b64decode(data["mask"]), np.uint8), bitorder="little")
    assert bits.sum() == shown_kept


@pytest.mark.parametrize(
    "word", ["<script>alert(1)</script>.jpg", "</script><img src=x onerror=alert(1)>", "\"&'<b>", "\ud800"]
)
def test_names_and_commands_are_text(written, word):
    text, data = written(name1=word, name2=word, command=word)
    assert "<script>alert" not in text
    assert "<img" not in text
    assert "<b>" not in text
    assert text.count("<script") == text.count("</script>") == 2
    assert data["names"] == [word, word]


def test_columns_are_those_of_the_result(written, result):
    _, data = written(K1=K, matches=SCENE.knn_matches())
    columns = {name: unpacked(column) for name, column in data["columns"].items()}
    np.testing.assert_allclose(np.stack([columns["x1"], columns["y1"]], axis=1), result.points1, atol=0.01)
    np.testing.assert_allclose(np.stack([columns["x2"], columns["y2"]], axis=1), result.points2, atol=0.01)
    np.testing.assert_allclose(columns["score"], result.scores, atol=1e-4)
    np.testing.assert_allclose(columns["ratio"], SCENE.attributes.ratio, atol=1e-4)
    kept = 10 ** columns["log_residual"] < 1.0
    np.testing.assert_array_equal(kept, result.mask)


def test_ratios_are_asked_of_the_matches_and_else_of_the_kept_ones(written, result):
    rows = SCENE.knn_matches()
    given = {"all": rows, "kept": None, "none": [row[0] for row in rows]}
    columns = {name: written(matches=matches)[1]["columns"]["ratio"] for name, matches in given.items()}
    known = {name: ~np.isnan(unpacked(column)) for name, column in columns.items()}
    assert known["all"].all()
    np.testing.assert_array_equal(known["kept"], result.mask)
    assert not known["none"].any()


def test_truth_tells_right_from_wrong_and_how_far_the_pose_is_off(written, result):
    _, data = written(K1=K, truth=Truth(R=SCENE.R, t=5 * SCENE.t), baselines=[Baseline("all", np.ones(120, bool))])
    ours, everything = data["methods"]
    assert ours["error_deg"] < 3.0
    assert everything["error_deg"] is None
    assert ours["right"] + ours["wrong"] == ours["kept"] == result.num_inliers
    assert everything["right"] >= 80 > ours["wrong"]
    np.testing.assert_allclose(np.linalg.norm(data["scene"]["truth"]["t"]), 1.0)
    same = written(K1=K, truth=Truth(E=SCENE.E))[1]
    assert same["right"] == data["right"]
    assert same["methods"][0]["error_deg"] is None
    in_pixels = np.linalg.inv(K).T @ SCENE.E @ np.linalg.inv(K)
    assert written(truth=Truth(F=in_pixels))[1]["right"] == data["right"]


def test_geometry_needs_the_intrinsics_that_the_filter_had(written, result, model_file):
    assert written()[1]["scene"] is None
    scene = written(K1=K)[1]["scene"]
    assert scene["guessed"] is False
    assert scene["focal_px"] == [800, 800]
    assert len(scene["points"]) + scene["behind"] == result.num_inliers
    assert written(K1=K, K2=2 * K - np.diag([0, 0, 1]))[1]["scene"]["focal_px"] == [800, 1600]
    guessed = MatchFilter(model=model_file).filter(*SCENE.keypoints(), SCENE.knn_matches(), size1=SIZE, size2=SIZE)
    assert written(guessed)[1]["scene"]["guessed"] is True


def test_triangulated_points_lie_on_their_rays(written, result):
    scene = written(K1=K)[1]["scene"]
    projected = np.array(scene["points"]) @ K.T
    np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], result.points1[scene["rows"]], atol=0.3)


def test_the_funnel_narrows_to_what_was_accepted(written, result):
    funnel = {name: count for name, count, _ in written()[1]["why"]["funnel"]}
    assert list(funnel) == ["raw", "candidates", "accepted", "supporting", "kept"]
    assert funnel["raw"] >= funnel["candidates"] >= funnel["accepted"] >= funnel["supporting"]
    assert funnel["kept"] == result.num_inliers


def test_the_funnel_of_a_pair_that_needed_no_network_has_no_step_for_it(written, model_file):
    easy = MatchFilter(model=model_file).filter(*SCENE.keypoints(), SCENE.knn_matches(), K1=K)
    assert easy.info["ended"] == "before the network"
    funnel = {name: count for name, count, _ in written(easy)[1]["why"]["funnel"]}
    assert list(funnel) == ["raw", "accepted", "supporting", "kept"]
    assert funnel["raw"] >= funnel["accepted"] >= funnel["supporting"] > 0


@pytest.mark.parametrize("option", ["name1", "name2", "command"])
def test_words_of_the_caller_are_in_the_file(written, option):
    assert "a7c3f" in written(**{option: "a7c3f"})[0]
    assert "a7c3f" not in written()[0]


@pytest.mark.parametrize("kind", ["empty", "five", "nan", "huge", "equal", "planar", "rotation", "scores"])
def test_data_never_raises(tmp_path, model_file, kind):
    scene = make_scene(kind if kind in ("planar", "rotation") else "general")
    count = {"empty": 0, "five": 5}.get(kind, 200)
    points1, points2 = scene.points1[:count].copy(), scene.points2[:count].copy()
    points1[: count // 2] = {"nan": np.nan, "huge": 1e300}.get(kind, points1[: count // 2])
    points1[:] = 7.0 if kind == "equal" else points1
    method = "none" if kind == "scores" else "prosac"
    answer = MatchFilter(model=model_file, method=method).filter(points1, points2, None, K1=K)
    with np.errstate(all="raise"):
        path = write_pair_report(tmp_path / "p.html", noise(*SIZE), noise(*SIZE)[:, :, 0], answer, K1=K)
    assert data_of(path.read_text(encoding="utf-8"))["total"] == count


@pytest.mark.parametrize("image", [np.zeros((0, 5), np.uint8), np.zeros((5, 5)), np.zeros((5, 5, 2), np.uint8)])
def test_what_is_no_image_is_refused_before_anything_is_written(tmp_path, result, image):
    with pytest.raises(ValueError, match="image2"):
        write_pair_report(tmp_path / "p.html", noise(*SIZE), image, result)
    assert list(tmp_path.iterdir()) == []


def test_lengths_must_agree(tmp_path, result):
    half = Baseline("half", np.ones(60, bool))
    with pytest.raises(ValueError, match="baselines: half: expected a mask of length 120"):
        write_pair_report(tmp_path / "p", noise(9, 9), noise(9, 9), result, baselines=[half])
    with pytest.raises(ValueError, match="matches: expected 120 rows"):
        write_pair_report(tmp_path / "p", noise(9, 9), noise(9, 9), result, matches=[])
    without = dataclasses.replace(result, points1=np.zeros((0, 2)))
    with pytest.raises(ValueError, match="result: expected points1 and points2 of 120 rows"):
        write_pair_report(tmp_path / "p", noise(9, 9), noise(9, 9), without)


def test_show_writes_a_file_and_opens_it(result, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    path = show(result, noise(*SIZE), noise(*SIZE), name1="first.png")
    assert opened == [path.as_uri()]
    assert "first.png" in path.read_text(encoding="utf-8")


def test_a_result_shows_its_verdict_in_a_notebook(result):
    text = result._repr_html_()
    assert describe_verdict("ok").headline in text
    assert f"{result.num_inliers} of 120 matches" in text
    assert "<img" not in text
    nothing = dict.fromkeys(("E", "F", "R", "t", "H"))
    few = FilterResult(
        np.zeros(0, bool), np.zeros(0, np.float32), [], **nothing, status=Status.UNRELATED, num_inliers=0
    )
    assert "rotation" not in few._repr_html_()


@pytest.mark.parametrize("status", Status)
@pytest.mark.parametrize("guessed", [False, True])
def test_every_status_has_a_sentence_and_advice(status, guessed):
    verdict = describe_verdict(status.value, guessed=guessed)
    assert verdict.headline.endswith(".")
    assert verdict.advice.endswith(".")
    assert (verdict.tone == "good") == (status in (Status.OK, Status.PLANAR))
    assert not verdict.headline.startswith("The filter's verdict")


def test_advice_depends_on_what_is_known():
    assert "--K" in describe_verdict("ok", guessed=True).advice
    assert "--K" not in describe_verdict("ok").advice
    assert "1.4 times" in describe_verdict("suspicious_intrinsics", focal_factor=1.44).advice
    sure, unsure = (describe_verdict("ok", confidence=p) for p in (0.93, 0.21))
    assert (sure.tone, unsure.tone) == ("good", "caution")
    assert "93 %" in sure.advice
    assert "only 21 %" in unsure.advice
    doubtful = describe_verdict("low_support", focal_doubt=True)
    assert doubtful.tone == "caution"
    assert "Use the kept matches" in doubtful.advice
    assert "--K" in doubtful.advice
    assert describe_verdict("new_word").headline == "The filter's verdict is new word."


def test_confidence_of_a_result_reaches_the_report(written, result):
    sure = dataclasses.replace(result, confidence=0.42)
    assert "only 42 %" in written(sure)[0]
    assert "42 %" in sure._repr_html_()


def test_command_line_writes_the_report(tmp_path, model_file, capsys):
    path = tmp_path / "pair.html"
    words = [str(IMAGES / "left.jpg"), str(IMAGES / "right.jpg"), "--model", str(model_file), "--compare", "-q"]
    words += ["--max-keypoints", "1000"]
    assert cli.main([*words, "--K", "820,820,511.5,383.5", "--html", str(path)]) == 0
    data = data_of(path.read_text(encoding="utf-8"))
    assert data["names"] == ["left.jpg", "right.jpg"]
    assert [method["name"] for method in data["methods"]] == ["mgca_filter", "RANSAC", "MAGSAC"]
    assert data["scene"]["focal_px"] == [820, 820]
    assert "--html" in dict(data["why"]["facts"])["Command"]
    assert path.stat().st_size <= LIMIT_BYTES
    assert cli.main([*words, "--html", str(tmp_path / "missing" / "pair.html")]) == 2
    assert "its folder does not exist" in capsys.readouterr().err


def test_a_column_comes_back():
    for values in ([], [3.0], [2.0, 2.0], [np.nan, -5.0, 700.25, np.inf]):
        column = np.asarray(values)
        back = unpacked(pack(column))
        np.testing.assert_allclose(back, np.where(np.isfinite(column), column, np.nan), atol=706 / 131_068)
    whole = np.arange(-100, 65_000)
    np.testing.assert_array_equal(np.rint(unpacked(pack(whole))), whole)


def test_a_mask_comes_back():
    mask = np.random.default_rng(0).random(77) < 0.4
    bits = np.unpackbits(np.frombuffer(base64.b64decode(pack_mask(mask)), np.uint8), bitorder="little")[:77]
    np.testing.assert_array_equal(bits.astype(bool), mask)


def test_images_keep_quality_where_the_budget_allows():
    flat, wild = np.full((300, 400, 3), 90, np.uint8), noise(400, 300)
    generous, tight = (sum(map(len, embed_images([flat, wild], budget))) for budget in (900_000, 60_000))
    assert tight <= 60_000 < generous


def test_escaped_text_is_inert():
    assert (
        inert_json({"a": ["</script>&", float("nan"), np.int64(3)]}) == '{"a":["\\u003c/script\\u003e\\u0026",null,3]}'
    )
    assert escape("<a href='http://x'>") == "&lt;a href=&#x27;http:&#47;&#47;x&#x27;&gt;"


def test_assets_are_installed():
    listed = (ASSETS.parents[1] / "setup.cfg").read_text(encoding="utf-8")
    kinds = {path.suffix for path in ASSETS.iterdir() if path.suffix not in (".py", "")}
    assert kinds == {".html", ".css", ".js"}
    assert all(f"html_report/*{kind}\n" in listed for kind in kinds)
