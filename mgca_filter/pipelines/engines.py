"""Engines: a stream of tasks through one worker, or through many processes, results in any order."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

import cv2

from .journal import PipelineError
from .worker import PairWorker

# Tasks that wait at each worker: enough that none idles while the driver reads the next, few enough for its memory.
QUEUED_PER_WORKER = 2


class Engine(Protocol):
    """Runs methods of :class:`PairWorker`; each worker keeps one model session."""

    def share(self, value: Any) -> Any:
        """A handle of a value that many tasks take as an argument."""

    def map(self, method: str, tasks: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Results of ``method(*task)`` as they finish; ``tasks`` is read no faster than workers need it."""

    def close(self) -> None:
        """Stop the workers."""


class SerialEngine:
    """One worker in this process."""

    def __init__(self, filter_options: dict[str, Any]) -> None:
        use_one_thread()
        self._worker = PairWorker(filter_options)

    def share(self, value: Any) -> Any:
        """The value itself."""
        return value

    def map(self, method: str, tasks: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Results in the order of the tasks."""
        for task in tasks:
            yield getattr(self._worker, method)(*task)

    def close(self) -> None:
        """Nothing to stop."""


class ProcessEngine:
    """Workers in processes of their own, one thread each.

    Raises:
        PipelineError: from ``map``, when a worker process dies.
    """

    def __init__(self, filter_options: dict[str, Any], workers: int) -> None:
        self._workers = workers
        context = multiprocessing.get_context("spawn")  # forked children inherit locks of ONNX Runtime's threads
        self._pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(filter_options,))

    def share(self, value: Any) -> Any:
        """The value itself, which travels with every task."""
        return value

    def map(self, method: str, tasks: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Results as they finish."""
        pending: set[Future[Any]] = set()
        try:
            for task in tasks:
                pending.add(self._pool.submit(_call_worker, method, task))
                if len(pending) >= self._workers * QUEUED_PER_WORKER:
                    done, pending = wait(pending, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        except BrokenProcessPool as error:
            raise PipelineError(
                "a worker process died (out of memory?); what is finished is kept, run the command again to go on"
            ) from error

    def close(self) -> None:
        """Stop the processes; tasks that wait are dropped."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def use_one_thread() -> None:
    """One thread for ONNX Runtime: with small graphs as fast as many, and the same bits on every engine."""
    os.environ.setdefault("MGCA_FILTER_NUM_THREADS", "1")


_worker: PairWorker | None = None


def _start_worker(filter_options: dict[str, Any]) -> None:
    """Initialise a worker process."""
    global _worker
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    use_one_thread()
    cv2.setNumThreads(1)
    _worker = PairWorker(filter_options)


def _exit_with_parent() -> None:
    """A killed parent cannot stop its workers: they watch for it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _call_worker(method: str, task: tuple[Any, ...]) -> Any:
    return getattr(_worker, method)(*task)
