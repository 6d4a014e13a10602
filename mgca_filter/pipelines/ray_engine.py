"""The engine on Ray: one actor, and so one model session, per worker; on this machine or on a cluster."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import cv2

from .engines import QUEUED_PER_WORKER, use_one_thread
from .journal import PipelineError
from .worker import PairWorker

# A worker that dies (preempted machine, out of memory) is started again this often, and its tasks are repeated.
RETRIES = 3


class _RayWorker(PairWorker):
    """A worker that keeps to the one processor that Ray gave it."""

    def __init__(self, filter_options: dict[str, Any]) -> None:
        use_one_thread()
        cv2.setNumThreads(1)
        super().__init__(filter_options)


class RayEngine:
    """Workers as Ray actors.

    Args:
        filter_options: of :class:`mgca_filter.MatchFilter`; a model file must lie at the same path on every machine.
        workers: number of actors; they take one processor each.
        address: of a running cluster (``"auto"`` or ``"ray://host:10001"``), or None: start Ray on this machine.

    Raises:
        PipelineError: no cluster at the address, or, from ``map``, a worker died more often than it was restarted.
        ImportError: Ray is not installed.
    """

    def __init__(self, filter_options: dict[str, Any], workers: int, address: str | None = None) -> None:
        import ray

        self._ray = ray
        local: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False} if address is None else {}
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **local)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise PipelineError(f"Ray at {address or 'this machine'}: {' '.join(str(error).split())}") from error
        remote = ray.remote(num_cpus=1, max_restarts=RETRIES, max_task_retries=RETRIES)(_RayWorker)
        self._actors = [remote.remote(filter_options) for _ in range(workers)]

    def share(self, value: Any) -> Any:
        """Put the value into Ray's object store, whence each machine fetches it once."""
        return self._ray.put(value)

    def map(self, method: str, tasks: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Results as they finish."""
        free = deque(self._actors * QUEUED_PER_WORKER)
        busy: dict[Any, Any] = {}
        try:
            for task in tasks:
                if not free:
                    yield self._next_result(busy, free)
                actor = free.popleft()
                busy[getattr(actor, method).remote(*task)] = actor
            while busy:
                yield self._next_result(busy, free)
        except self._ray.exceptions.RayActorError as error:
            raise PipelineError(
                f"a Ray worker died more than {RETRIES} times; what is finished is kept, run the command again to go on"
            ) from error

    def _next_result(self, busy: dict[Any, Any], free: deque[Any]) -> Any:
        (done,), _ = self._ray.wait(list(busy), num_returns=1)
        free.append(busy.pop(done))
        return self._ray.get(done)

    def close(self) -> None:
        """Stop the actors and leave the cluster; a Ray started here ends."""
        self._ray.shutdown()
