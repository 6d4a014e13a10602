"""The report of many pairs: the match graph as a matrix, a table to sort, and the weakest links."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..atomic_file import replaced_when_done
from ..drawing import as_bgr
from ..verdict_text import BAD, CAUTION, GOOD, VerdictText
from .embedded import embed_images, pack
from .match_graph import MatchGraph, build_graph
from .page import LIMIT_BYTES, build_page

MAX_PAIRS_SHOWN = 30_000
_SCRIPTS = ("shell.js", "folder.js")
_THUMBNAIL_PX = (48, 320)
_LINKS_SHOWN = 60
_SPARE_BYTES = 4_000
_THIN_LINK = 30  # matches; what reconstruction programs ask of a pair that they start from


class PairLine(NamedTuple):
    """One pair of a collection; a plain tuple in this order serves as well.

    Attributes:
        name1, name2: the images.
        status: word of :class:`mgca_filter.Status`, or "failed".
        num_matches, kept: putative matches, and those that are kept.
        confidence: probability that the pose is within 10 degrees, or None.
    """

    name1: str
    name2: str
    status: str
    num_matches: int
    kept: int
    confidence: float | None = None


def write_folder_report(
    path: str | Path,
    rows: Iterable[PairLine | tuple[str, str, str, int, int, float | None]],
    *,
    title: str = "",
    thumbnails: Mapping[str, NDArray[np.uint8]] | None = None,
    command: str = "",
) -> Path:
    """Write a self-contained HTML report of many pairs, about one megabyte at most.

    Args:
        path: the file to write.
        rows: the pairs, no pair twice.
        title: what the report calls the collection, such as its folder; any text.
        thumbnails: images by name, uint8 of any size; names that are missing have none.
        command: what was run, to be shown.

    Returns:
        ``path``. Of more than 30 000 pairs those with the most kept matches are in the file.

    Raises:
        ValueError: a thumbnail is empty or no uint8 image.
        OSError: the file cannot be written.
    """
    lines = [PairLine(*row) for row in rows]
    names = sorted({name for line in lines for name in (line.name1, line.name2)})
    number = {name: i for i, name in enumerate(names)}
    graph = build_graph(len(names), [(number[line.name1], number[line.name2], int(line.kept)) for line in lines])
    shown = sorted(lines, key=lambda line: -line.kept)[:MAX_PAIRS_SHOWN]
    statuses = sorted({str(line.status) for line in shown})
    verdict = describe_collection(names, lines, graph)
    data: dict[str, Any] = {
        "images": names,
        "groups": graph.groups,
        "statuses": statuses,
        "columns": {
            "a": pack([number[line.name1] for line in shown]),
            "b": pack([number[line.name2] for line in shown]),
            "status": pack([statuses.index(str(line.status)) for line in shown]),
            "num_matches": pack([line.num_matches for line in shown]),
            "kept": pack([line.kept for line in shown]),
            "confidence": pack([np.nan if line.confidence is None else line.confidence for line in shown]),
        },
        "links": [[a, b, kept, (a, b) in graph.bridges] for a, b, kept in graph.links[:_LINKS_SHOWN]],
        "left_out": len(lines) - len(shown),
        "facts": [
            ["Version", f"mgca_filter {__version__}"],
            ["Written", datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M")],
            *([["Command", command]] if command else []),
        ],
        "thumbnails": {},
    }
    used = sum(1 for line in lines if line.kept > 0)
    words = {
        "tone": verdict.tone,
        "headline": verdict.headline,
        "advice": verdict.advice,
        "title": title,
        "counts": f"{len(names):,} images · {len(lines):,} pairs · {used:,} with kept matches".replace(",", "\u202f"),
    }
    window = f"{title}: match graph" if title else "Match graph"
    if thumbnails:
        held = [name for name in names if name in thumbnails]
        frame = len(build_page(window, "folder.html", words, _SCRIPTS, data).encode("utf-8"))
        room = LIMIT_BYTES - frame - _SPARE_BYTES - sum(len(name.encode("utf-8")) * 6 + 8 for name in held)
        pictures = [as_bgr(thumbnails[name], f"thumbnails[{name!r}]") for name in held]
        least, most = _THUMBNAIL_PX
        # A JPEG file takes about a third of a byte a pixel: start there rather than at the largest.
        side = min(max(int((3.0 * max(room, 0) / max(len(held), 1)) ** 0.5), least), most)
        encoded = embed_images(pictures, room, side, least) if pictures else []
        if sum(map(len, encoded)) <= room:
            data["thumbnails"] = dict(zip(held, encoded))
    page = build_page(window, "folder.html", words, _SCRIPTS, data)
    path = Path(path)
    with replaced_when_done(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def describe_collection(names: list[str], lines: list[PairLine], graph: MatchGraph) -> VerdictText:
    """Whether the images hang together, and what to do about it."""
    if not names:
        return VerdictText(BAD, "There are no pairs.", "Match some images first.")
    sizes = np.bincount(np.asarray(graph.groups))
    alone = int(np.count_nonzero(sizes == 1)) if len(names) > 1 else 0
    large = int(np.count_nonzero(sizes > 1))
    failed = sum(1 for line in lines if line.status == "failed")
    remark = f" {_plural(failed, 'pair')} could not be read." if failed else ""
    if not graph.links:
        return VerdictText(
            BAD, "No two images match.", "Check that they overlap, and look at one pair with mgca-match a b." + remark
        )
    if large > 1 or alone:
        lonely = "" if not alone else f"{alone} of {len(names)} images {'matches' if alone == 1 else 'match'} no other"
        headline = f"The images fall into {large} groups" + (f", and {lonely}." if lonely else ".")
        return VerdictText(
            CAUTION,
            headline if large > 1 else lonely + ".",
            "Without a kept match between them, each part becomes a reconstruction of its own. Take pictures in "
            "between, or match more pairs." + remark,
        )
    a, b, kept = graph.links[0]
    weakest = f"The weakest link that it needs is {names[a]} – {names[b]} with {_plural(kept, 'match', 'matches')}."
    if kept < _THIN_LINK and (a, b) in graph.bridges:
        advice = weakest + " Nothing else joins its two sides: take a picture in between." + remark
        return VerdictText(CAUTION, f"All {len(names)} images hang together, in one place by a thread.", advice)
    return VerdictText(GOOD, f"All {len(names)} images hang together.", weakest + remark)


def _plural(count: int, noun: str, nouns: str | None = None) -> str:
    return f"{count} {noun if count == 1 else nouns or noun + 's'}"
