"""The report of many pairs: the graph's laws, the file, and the page in a browser."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest
from browser import ask, needs_chromium, open_page

from mgca_filter.html_report import PairLine, write_folder_report
from mgca_filter.html_report.folder_report import MAX_PAIRS_SHOWN, describe_collection
from mgca_filter.html_report.match_graph import build_graph
from mgca_filter.html_report.page import LIMIT_BYTES

EVIL = "<img src=x onerror=alert(1)>.jpg"
ROWS = [
    ("a.jpg", "b.jpg", "ok", 900, 300, 0.9),
    ("b.jpg", "c.jpg", "ok", 800, 12, 0.4),
    ("a.jpg", "c.jpg", "unrelated", 700, 0, None),
    ("c.jpg", EVIL, "planar", 600, 150, 0.8),
]


def random_edges(seed: int, num_images: int = 9, count: int = 11) -> list[tuple[int, int, int]]:
    rng = np.random.default_rng(seed)
    pairs = list(combinations(range(num_images), 2))
    return [(*pairs[i], int(rng.integers(0, 50))) for i in rng.permutation(len(pairs))[:count]]


def connected(num_images: int, edges, a: int, b: int) -> bool:
    """By brute force."""
    reach = np.eye(num_images, dtype=bool)
    for i, j, kept in edges:
        reach[i, j] = reach[j, i] = kept > 0 or reach[i, j]
    return bool(np.linalg.matrix_power(reach.astype(float), num_images)[a, b] > 0)


@pytest.mark.parametrize("seed", range(20))
def test_groups_are_what_chains_of_edges_join(seed):
    edges = random_edges(seed)
    graph = build_graph(9, edges)
    for a, b in combinations(range(9), 2):
        assert (graph.groups[a] == graph.groups[b]) == connected(9, edges, a, b)
    sizes = np.bincount(graph.groups)
    assert (np.diff(sizes) <= 0).all()
    assert len(graph.links) == 9 - len(sizes)


@pytest.mark.parametrize("seed", range(20))
def test_a_bridge_is_an_edge_whose_loss_separates(seed):
    edges = random_edges(seed)
    expected = {
        (a, b) for a, b, kept in edges if kept and not connected(9, [e for e in edges if e[:2] != (a, b)], a, b)
    }
    graph = build_graph(9, edges)
    assert graph.bridges == expected
    assert graph.bridges <= {link[:2] for link in graph.links}


@pytest.mark.parametrize("seed", range(10))
def test_the_weakest_link_is_as_strong_as_can_be(seed):
    """Without all edges as weak as it, its two images are no longer joined; with it they are."""
    edges = random_edges(seed, count=20)
    graph = build_graph(9, edges)
    assert [link[2] for link in graph.links] == sorted(link[2] for link in graph.links)
    for a, b, kept in graph.links:
        assert not connected(9, [edge for edge in edges if edge[2] > kept], a, b)


def test_order_of_the_edges_changes_nothing():
    edges = random_edges(3)
    assert build_graph(9, edges) == build_graph(9, edges[::-1])


def test_parallel_edges_are_no_bridge():
    assert build_graph(2, [(0, 1, 5), (1, 0, 6)]).bridges == frozenset()


def verdict_of(rows):
    lines = [PairLine(*row) for row in rows]
    names = sorted({name for line in lines for name in line[:2]})
    edges = [(names.index(line.name1), names.index(line.name2), line.kept) for line in lines]
    return describe_collection(names, lines, build_graph(len(names), edges))


def test_the_verdict_names_what_is_wrong():
    assert verdict_of([]).headline == "There are no pairs."
    assert verdict_of([("a", "b", "unrelated", 9, 0)]).headline == "No two images match."
    assert "by a thread" in verdict_of(ROWS).headline
    assert "b.jpg – c.jpg with 12 matches" in verdict_of(ROWS).advice
    strong = [("a", "b", "ok", 99, 90), ("b", "c", "ok", 99, 80), ("a", "c", "failed", 0, 0)]
    assert verdict_of(strong).tone == "good"
    assert "1 pair could not be read" in verdict_of(strong).advice
    assert verdict_of([*strong, ("c", "d", "unrelated", 9, 0)]).headline == "1 of 4 images matches no other."
    two = verdict_of([*strong, ("d", "e", "ok", 99, 70)])
    assert two.headline == "The images fall into 2 groups."


def test_the_file_is_alone_and_harmless(tmp_path):
    path = write_folder_report(tmp_path / "f.html", ROWS, title=EVIL, command="see https://example.org")
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"https?://|<img|<link|url\(|xmlns", text)
    assert "default-src 'none'" in text


def test_large_folders_stay_small(tmp_path):
    rng = np.random.default_rng(0)
    names = [f"folder/IMG_{i:05d}.JPG" for i in range(400)]
    rows = [(a, b, "ok", 2000, int(rng.integers(0, 900)), 0.5) for a, b in combinations(names, 2)]
    thumbnails = {name: rng.integers(0, 256, (90, 120, 3), dtype=np.uint8) for name in names}
    path = write_folder_report(tmp_path / "f.html", rows, thumbnails=thumbnails)
    assert len(rows) > MAX_PAIRS_SHOWN
    assert path.stat().st_size <= LIMIT_BYTES
    assert path.read_text(encoding="utf-8").count("data:image/jpeg") == 400


def test_thumbnails_must_be_images(tmp_path):
    with pytest.raises(ValueError, match="thumbnails\\['a.jpg'\\]"):
        write_folder_report(tmp_path / "f.html", ROWS, thumbnails={"a.jpg": np.zeros((3, 3))})


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    thumbnails = {
        "b.jpg": np.full((300, 400, 3), (200, 90, 30), np.uint8),
        "not in the rows": np.zeros((9, 9), np.uint8),
    }
    path = tmp_path_factory.mktemp("folder") / "f.html"
    return write_folder_report(path, ROWS, title="my folder", thumbnails=thumbnails, command="a7c3f")


@pytest.mark.slow
@needs_chromium
def test_the_page_runs_under_its_own_policy(report, tmp_path):
    page = open_page(report, tmp_path)
    assert page.complaints == []
    assert "my folder" in page.dom
    assert "a7c3f" in page.dom
    assert page.dom.count("<tr") == 1 + len(ROWS)
    assert 'src="x"' not in page.dom


@pytest.fixture(scope="module")
def seen(report, tmp_path_factory):
    """What all checks saw, by name."""
    return ask(report, tmp_path_factory.mktemp("asked"), "folder_checks.js", {"matrix": None, "table": None})


@pytest.mark.slow
@needs_chromium
def test_table_sorts_and_filters(seen):
    seen = seen["table"]
    assert seen["first"] == [300, 150, 12, 0]
    assert seen["up"] == [0, 12, 150, 300]
    assert seen["byTotal"] == [300, 12, 0, 150]
    assert seen["marked"] == ["matches ↓"]
    assert seen["byName"] == ["a.jpg", "a.jpg", "b.jpg", "c.jpg"]
    assert seen["planar"] == [150]
    assert seen["filtered"] == 2
    assert seen["words"] == "2 of 2 pairs shown."


@pytest.mark.slow
@needs_chromium
def test_matrix_links_and_keys(seen):
    seen = seen["matrix"]
    assert seen["start"] == "ok, 12 of 800 kept, confidence 40 %"
    assert seen["colours"] > 4
    assert seen["links"] == ["b.jpg – c.jpg", f"c.jpg – {EVIL}", "a.jpg – b.jpg"]
    assert seen["bridges"] == 3
    assert [cell[0] for cell in seen["cells"]] == [cell[1] for cell in seen["cells"]]
    assert seen["cells"][0][0] == "ok, 300 of 900 kept, confidence 90 %"
    assert seen["cells"][3][0] == "unrelated, 0 of 700 kept"
    assert seen["self"] == "one image"
    assert seen["pictures"] == 1
    assert seen["moved"] == [0, 1]
    assert seen["filter"] in {name for row in ROWS for name in row[:2]}
    assert seen["said"] == "b.jpg and c.jpg: ok, 12 of 800 kept, confidence 40 %"
