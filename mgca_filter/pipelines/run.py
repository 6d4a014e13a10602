"""A job: all pairs of a source that the journal does not hold yet, through an engine, into the journal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from .. import __version__
from ..inference.model_file import sha256_of
from ..match_filter import MatchFilter, model_path
from .engines import Engine, ProcessEngine, SerialEngine, use_one_thread
from .journal import Journal
from .worker import EXPLAINED, ImageFeatures

# Images whose features the driver holds: 2000 SIFT keypoints take about a third of a megabyte.
_CACHED_IMAGES = 1024
_MAX_MESSAGES = 5


class PairSource(Protocol):
    """Pairs of images with features, and matches where they exist."""

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images of each pair, no pair twice."""

    def image(self, name: str) -> ImageFeatures | None:
        """Features; None for an image that cannot be read."""

    def matches(self, name1: str, name2: str) -> NDArray[Any] | None:
        """Putative matches (M, 2), or None: match the descriptors."""


@dataclass(frozen=True)
class EngineOptions:
    """Which engine: ``kind`` is "local" or "ray"; ``workers``; ``address`` of a Ray cluster, or None."""

    kind: str = "local"
    workers: int = 1
    address: str | None = None

    def open(self, filter_options: dict[str, Any]) -> Engine:
        """Start the workers; errors as of :class:`mgca_filter.MatchFilter`."""
        use_one_thread()
        MatchFilter(**filter_options)  # what a worker says when it cannot start does not reach the user
        if self.kind == "ray":
            from .ray_engine import RayEngine

            return RayEngine(filter_options, self.workers, self.address)
        if self.workers > 1:
            return ProcessEngine(filter_options, self.workers)
        return SerialEngine(filter_options)


@dataclass(frozen=True)
class Summary:
    """What a run came to: pairs, matches in and matches kept by status; pairs done now, and their time."""

    by_status: dict[str, tuple[int, int, int]]
    failures: list[str]
    pairs_now: int
    seconds: float

    @property
    def found_geometry(self) -> bool:
        """A model explains one pair at least."""
        return any(status in EXPLAINED for status in self.by_status)

    def __str__(self) -> str:
        pairs, matches, kept = (sum(column) for column in zip(*self.by_status.values(), (0, 0, 0)))
        lines = [f"{pairs} pairs, {matches} matches in, {kept} kept"]
        lines += [f"{count:8d} {status}" for status, (count, _, _) in self.by_status.items()]
        rate = f", {self.pairs_now / self.seconds:.1f} pairs/s" if self.pairs_now and self.seconds > 0 else ""
        resumed = f" ({pairs - self.pairs_now} were done before)" if pairs > self.pairs_now else ""
        return "\n".join([*lines, f"{self.pairs_now} pairs in {self.seconds:.1f} s{rate}{resumed}"])


def run_identity(filter_options: dict[str, Any]) -> dict[str, Any]:
    """What a resumed run must have in common with the killed one besides its input, as JSON values.

    The options of the filter, the content of its model and the version of this package: each of them changes rows.
    """
    model = Path(filter_options.get("model") or model_path())
    return {**filter_options, "model_sha256": sha256_of(model), "version": __version__}


def run_pairs(source: PairSource, engine: Engine, journal: Journal, quiet: bool = False) -> Summary:
    """Filter every pair of ``source`` that ``journal`` lacks; ``quiet`` hides the progress bar."""
    image = lru_cache(_CACHED_IMAGES)(lambda name: engine.share(source.image(name)))
    pairs = source.pairs()
    todo = [pair for pair in pairs if pair not in journal]

    def tasks() -> Iterator[tuple[Any, ...]]:
        for name1, name2 in todo:
            yield name1, name2, image(name1), image(name2), source.matches(name1, name2)

    started = time.perf_counter()
    with progress_bar("pairs", len(pairs), len(pairs) - len(todo), quiet) as bar:
        for row in engine.map("filter", tasks()):
            journal.add(row)
            bar.update()
    seconds = time.perf_counter() - started
    return Summary(journal.statistics(), journal.failures(_MAX_MESSAGES), len(todo), seconds)


def progress_bar(unit: str, total: int, done: int, quiet: bool) -> Any:
    """tqdm's bar on stderr with rate and time left; ten seconds between lines where nobody watches a terminal."""
    from tqdm import tqdm

    interval = 0.1 if sys.stderr.isatty() else 10.0
    return tqdm(total=total, initial=done, unit=" " + unit, disable=quiet, mininterval=interval, file=sys.stderr)


def work_folder(output: Path) -> Path:
    """Folder beside the output that holds what is unfinished; made when it does not exist."""
    folder = output.with_name(output.name + ".work")
    folder.mkdir(exist_ok=True)
    return folder
