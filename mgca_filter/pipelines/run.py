"""A job: all pairs of a source that the journal does not hold yet, through workers, into the journal."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain, islice
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from numpy.typing import NDArray

from .. import __version__
from ..features import ImageFeatures
from ..html_report.folder_report import PairLine, write_folder_report
from ..inference.model_file import sha256_of
from ..match_filter import MatchFilter, find_models
from ..result import EXPLAINED
from .journal import Journal, PipelineError, output_file
from .worker import (
    FAILED,
    PairRow,
    Unusable,
    call_worker,
    call_worker_process,
    end_worker,
    use_one_thread,
)

# Images whose features the driver holds: 2000 SIFT keypoints take about a third of a megabyte.
_CACHED_IMAGES = 1024
# Tasks that wait at each worker: enough that none idles while the driver reads the next, few enough for its memory.
_QUEUED_PER_WORKER = 2
# Results that the driver may be behind with: joblib hands out the next task whether the last result was taken or not.
_WINDOW_PER_WORKER = 128
# A Ray worker that dies (preempted machine, out of memory) is started again this often, and its tasks are repeated.
RAY_RETRIES = 3


class PairSource(Protocol):
    """Pairs of images with features, and matches where they exist."""

    def pairs(self) -> Sequence[tuple[str, str]]:
        """Names of the images of each pair, no pair twice."""

    def image(self, name: str) -> ImageFeatures | Unusable:
        """Features of an image."""

    def matches(self, name1: str, name2: str) -> NDArray[Any] | Unusable | None:
        """Putative matches (M, 2), or None: match the descriptors."""


class Workers:
    """Runs methods of :class:`.worker.PairWorker`, one model session and one thread a worker: in this process where
    there is one worker, in processes (joblib's loky), or on Ray through joblib's backend. A context manager.

    Args:
        filter_options: of :class:`mgca_filter.MatchFilter`, as JSON values; a model file must lie at the same path on
            every machine.
        count: number of workers.
        engine: "local" or "ray".
        address: of a running Ray cluster ("auto" or "ray://host:10001"), or None: start Ray on this machine.

    Raises:
        PipelineError: no cluster at the address, or, from ``map``, a worker died.
        ImportError: joblib or Ray is not installed. Other errors as of :class:`mgca_filter.MatchFilter`.
    """

    def __init__(
        self, filter_options: dict[str, Any], count: int = 1, engine: str = "local", address: str | None = None
    ) -> None:
        import joblib

        use_one_thread()
        MatchFilter(**filter_options)  # what a worker says when it cannot start does not reach the user
        self._options, self._count, self._ray = json.dumps(filter_options), count, None
        if engine == "ray":
            self._ray = _start_ray(count, address)
        backend = {"backend": "ray"} if self._ray else {"backend": "loky", "inner_max_num_threads": 1}
        with joblib.parallel_config(**backend):
            # Arrays travel with their task: no files in shared memory that a killed run leaves behind.
            self._parallel = joblib.Parallel(
                count,
                return_as="generator_unordered",
                batch_size=1,
                pre_dispatch=count * _QUEUED_PER_WORKER,
                max_nbytes=None,
            )

    def share(self, value: Any) -> Any:
        """A handle of a value that many tasks take: the value itself, or its place in Ray's object store, whence each
        machine fetches it once."""
        return value if self._ray is None else self._ray.put(value)

    def map(self, method: str, tasks: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Results of ``method(*task)`` as they finish; ``tasks`` is read no faster than workers need it."""
        import joblib

        function: Callable[..., Any] = call_worker
        own: tuple[int, ...] = ()
        if self._ray is not None:
            function = call_ray_worker
        elif self._count > 1:
            function, own = call_worker_process, (os.getpid(),)
        calls = (joblib.delayed(function)(self._options, method, task, *own) for task in tasks)
        for first in calls:
            window = chain([first], islice(calls, self._count * _WINDOW_PER_WORKER - 1))
            yield from self._results(window)

    def _results(self, calls: Iterable[Any]) -> Iterator[Any]:
        try:
            results = self._parallel(calls)
            try:
                # Not "yield from": closing must not wait for garbage collection, nor warn of what it cancels.
                for result in results:  # noqa: UP028
                    yield result
            finally:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    results.close()
        except BrokenProcessPool as error:
            raise PipelineError(
                "a worker process died (out of memory?); what is finished is kept, run the command again to go on"
            ) from error
        except Exception as error:
            if self._ray is None or not isinstance(error, self._ray.exceptions.RayActorError):
                raise
            raise PipelineError(
                f"a Ray worker died more than {RAY_RETRIES} times; "
                "what is finished is kept, run the command again to go on"
            ) from error

    def __enter__(self) -> Workers:
        try:
            self._parallel.__enter__()
        except BaseException:  # such as a cluster of fewer processors than workers
            if self._ray is not None:
                self._ray.shutdown()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._parallel.__exit__(kind, error, traceback)
        end_worker()
        if self._ray is not None:
            self._ray.shutdown()
        elif self._count > 1:
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=kind is not None)


def _start_ray(count: int, address: str | None) -> Any:
    """The module of a Ray that runs, as joblib's backend "ray"."""
    import joblib
    import ray
    from ray.util.joblib.ray_backend import RayBackend
    from ray.util.multiprocessing.pool import ResultThread

    class StreamingRayBackend(RayBackend):  # type: ignore[misc,unused-ignore]
        """Ray's backend, freed of what it inherits from joblib's for multiprocessing: that it does not stream, and
        that it waits for each actor to finish where Ray itself ends with the run."""

        supports_return_generator = True

        def terminate(self) -> None:
            """Kill the actors, and wait for the threads that would still ask for results: a thread that asks after
            the run has ended starts a Ray of its own."""
            for actor, _ in self._pool._actor_pool:
                ray.kill(actor)
            for thread in threading.enumerate():
                if isinstance(thread, ResultThread):
                    thread.join()

        def abort_everything(self, ensure_ready: bool = True) -> None:
            pass

    local: dict[str, Any] = {"num_cpus": count, "include_dashboard": False} if address is None else {}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **local)
    except Exception as error:  # Ray raises this one itself where its processes do not start
        raise PipelineError(f"Ray at {address or 'this machine'}: {' '.join(str(error).split())}") from error
    actor = {"num_cpus": 1, "max_restarts": RAY_RETRIES, "max_task_retries": RAY_RETRIES}
    joblib.register_parallel_backend("ray", partial(StreamingRayBackend, ray_remote_args=actor))
    return ray


def call_ray_worker(filter_options: str, method: str, task: tuple[Any, ...]) -> Any:
    """:func:`.worker.call_worker` on Ray, with the shared values fetched from the object store.

    The task is one argument: Ray's backend for joblib keeps every larger one in the store until the end of the run.
    """
    import ray

    use_one_thread()
    fetched = tuple(ray.get(value) if isinstance(value, ray.ObjectRef) else value for value in task)
    return call_worker(filter_options, method, fetched)


@dataclass(frozen=True)
class Summary:
    """What a run came to: pairs, matches in and matches kept by status; pairs done now, and their time.

    ``failures`` are lines that say why pairs failed, ``doubts`` what is odd about the input.
    """

    by_status: dict[str, tuple[int, int, int]]
    pairs_now: int
    seconds: float
    failures: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    @property
    def found_geometry(self) -> bool:
        """A model explains one pair at least."""
        return any(status in EXPLAINED or kept > 0 for status, (_, _, kept) in self.by_status.items())

    def __str__(self) -> str:
        pairs, matches, kept = (sum(column) for column in zip(*self.by_status.values(), (0, 0, 0)))
        lines = [f"{pairs} pairs, {matches} matches in, {kept} kept"]
        lines += [f"{count:8d} {status}" for status, (count, _, _) in self.by_status.items()]
        rate = f", {self.pairs_now / self.seconds:.1f} pairs/s" if self.pairs_now and self.seconds > 0 else ""
        resumed = f" ({pairs - self.pairs_now} were done before)" if pairs > self.pairs_now else ""
        return "\n".join([*lines, f"{self.pairs_now} pairs in {self.seconds:.1f} s{rate}{resumed}"])


@dataclass(frozen=True)
class Report:
    """The HTML report of a run: where it goes, what it calls the collection, and the command that it shows."""

    path: Path
    title: str
    command: str

    def write(self, rows: Iterable[PairRow]) -> None:
        """Write it from all rows.

        Raises:
            PipelineError: the file cannot be written.
        """
        lines = (
            PairLine(row.name1, row.name2, row.status, row.num_matches, len(row.kept), row.confidence) for row in rows
        )
        with output_file(self.path) as partial:
            write_folder_report(partial, lines, title=self.title, command=self.command)


def run_identity(filter_options: dict[str, Any]) -> dict[str, Any]:
    """What a resumed run must have in common with the killed one besides its input, as JSON values.

    The options of the filter, the content of its model and the version of this package: each of them changes rows.
    """
    models = find_models(filter_options.get("model"))
    return {**filter_options, "model_sha256": " + ".join(map(sha256_of, models)), "version": __version__}


def run_pairs(source: PairSource, workers: Workers, journal: Journal, quiet: bool = False) -> Summary:
    """Filter every pair of ``source`` that ``journal`` lacks; ``quiet`` hides the progress bar."""
    image = lru_cache(_CACHED_IMAGES)(lambda name: workers.share(source.image(name)))
    pairs = source.pairs()
    todo = [pair for pair in pairs if pair not in journal]
    tasks = ((name1, name2, image(name1), image(name2), source.matches(name1, name2)) for name1, name2 in todo)
    started = time.perf_counter()
    with progress_bar("pairs", len(pairs), len(pairs) - len(todo), quiet) as bar:
        for row in workers.map("filter", tasks):
            journal.add(row)
            bar.update()
    seconds = time.perf_counter() - started
    by_status = dict(sorted(journal.statistics.items(), key=lambda item: -item[1][0]))
    failures, failed = list(journal.failures), by_status.get(FAILED, (0, 0, 0))[0]
    if failed > len(failures):
        failures.append(f"{failed} pairs failed")
    return Summary(by_status, len(todo), seconds, failures)


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
