"""Runs methods over pairs, in worker processes if wanted, and keeps every result as it comes."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from ..data import PairSource
from ..data.scene_bundle import ScenePair
from ..errors import DatasetError
from ..geometry.epipolar import rotation_error_deg, translation_error_deg
from .difficulty import PairProperties
from .environment import one_thread
from .methods import UNREADABLE, Answer, Method, PairOutcome
from .metrics import FAILURE_DEG, PAPER_LOGIT, count_scores, precision_recall_f, true_matches
from .pairs import SceneSelection
from .store import ResultKey, ResultStore

logger = logging.getLogger(__name__)

CHUNK_PAIRS = 40
"""Pairs between two writes to the store: what an interrupted run loses at most, per worker."""

_read_pairs: OrderedDict[tuple[str, str, int], ScenePair | DatasetError] = OrderedDict()

SceneOutcomes = dict[str, list[list[PairOutcome]]]
"""Outcomes by scene: one list per seed, each in the order of the pairs."""


@dataclass(frozen=True)
class _Task:
    method: Method
    key: ResultKey
    source: PairSource
    indices: tuple[int, ...]


def predict(
    methods: Sequence[Method],
    selections: Sequence[SceneSelection],
    *,
    seeds: int = 3,
    workers: int = 1,
    store: ResultStore | None = None,
    progress: bool = False,
) -> dict[str, SceneOutcomes]:
    """Outcomes of every method on every chosen pair, by name of the method and scene.

    Results do not depend on ``workers``. What the store knows already is not run again.

    Args:
        methods: rows to run; names must differ.
        selections: pairs to run them on.
        seeds: number of runs, seeds 0 … seeds − 1, of the methods whose ``seeded`` is True; the others run once.
        workers: processes; 1 runs everything in this one.
        store: where results are looked up and kept; None keeps them in memory.
        progress: show a bar on standard error.

    What a method raises counts as a failure of the pair, and so does a pair that cannot be read: then of every method.

    Raises:
        ValueError: ``seeds`` or ``workers`` is below 1, or two methods share a name.
        ImportError: ``progress`` without tqdm.
    """
    if seeds < 1 or workers < 1:
        raise ValueError(f"seeds and workers must be at least 1, got {seeds} and {workers}")
    if len({method.name for method in methods}) < len(methods):
        raise ValueError("two methods have the same name")
    store = ResultStore(None) if store is None else store
    keys = _result_keys(methods, selections, seeds)
    tasks = list(_missing_tasks(methods, selections, keys, store))
    total = sum(len(task.indices) for task in tasks)
    logger.info("%d pairs to run, the others are in the store", total)
    with _progress_bar(total, progress) as bar:
        for task, outcomes in _run_tasks(tasks, workers):
            store.add(task.key, outcomes)
            if bar is not None:
                bar.set_postfix_str(f"{task.key.method}, {task.key.scene}, seed {task.key.seed}", refresh=False)
                bar.update(len(outcomes))
    results: dict[str, SceneOutcomes] = {}
    for method in methods:
        results[method.name] = {}
        for selection in selections:
            runs = [store.load(key) for key in keys[method.name, selection.scene]]
            results[method.name][selection.scene] = [[run[index] for index in selection.indices] for run in runs]
    return results


def _progress_bar(total: int, shown: bool) -> Any:
    """A context manager: tqdm's bar over pairs, or None where nothing is to be shown."""
    if not shown:
        return nullcontext()
    from tqdm import tqdm

    return tqdm(total=total, unit="pair", smoothing=0.05)


def _result_keys(
    methods: Sequence[Method], selections: Sequence[SceneSelection], seeds: int
) -> dict[tuple[str, str], list[ResultKey]]:
    """Keys by method and scene, one per seed."""
    keys = {}
    for method in methods:
        settings = method.settings()
        for selection in selections:
            keys[method.name, selection.scene] = [
                ResultKey(method.name, selection.scene, seed, selection.sha256, settings)
                for seed in range(seeds if method.seeded else 1)
            ]
    return keys


def _missing_tasks(
    methods: Sequence[Method],
    selections: Sequence[SceneSelection],
    keys: dict[tuple[str, str], list[ResultKey]],
    store: ResultStore,
) -> Iterator[_Task]:
    """Chunk by chunk, all methods on each: pairs that are slow to read are read once for all of them."""
    for selection in selections:
        known = {method.name: [set(store.load(k)) for k in keys[method.name, selection.scene]] for method in methods}
        for first in range(0, len(selection), CHUNK_PAIRS):
            chunk = selection.indices[first : first + CHUNK_PAIRS]
            for method in methods:
                for key, done in zip(keys[method.name, selection.scene], known[method.name]):
                    missing = tuple(index for index in chunk if index not in done)
                    if missing:
                        yield _Task(method, key, selection.source, missing)


def _run_tasks(tasks: list[_Task], workers: int) -> Iterator[tuple[_Task, list[PairOutcome]]]:
    if workers == 1 or len(tasks) < 2:
        for task in tasks:
            yield task, _run_task(task)
        return
    # Fresh interpreters: ONNX Runtime's and OpenCV's threads do not survive a fork.
    with ProcessPoolExecutor(min(workers, len(tasks)), mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(_run_task, task): task for task in tasks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _read_pair(source: PairSource, index: int) -> ScenePair | DatasetError:
    """The pair, or why it cannot be read; the latest of them are kept, for the methods that come next."""
    key = (source.scene, source.sha256, index)
    if key not in _read_pairs:
        try:
            _read_pairs[key] = source[index]
        except DatasetError as error:
            _read_pairs[key] = error
        if len(_read_pairs) > 2 * CHUNK_PAIRS:
            _read_pairs.popitem(last=False)
    return _read_pairs[key]


def _run_task(task: _Task) -> list[PairOutcome]:
    outcomes = []
    with one_thread():
        for index in task.indices:
            pair = _read_pair(task.source, index)
            if isinstance(pair, ScenePair):
                outcomes.append(evaluate_pair(task.method, pair, task.key.seed))
            else:
                outcomes.append(_unreadable_outcome(index, pair))
    return outcomes


def _unreadable_outcome(index: int, error: DatasetError) -> PairOutcome:
    """A failure in every figure: no pose, nothing found."""
    nothing = (0.0, 0.0, 0.0)
    return PairOutcome(index, FAILURE_DEG, None, None, nothing, nothing, f"{UNREADABLE}{error}")


def answer_pair(method: Method, pair: ScenePair, seed: int) -> Answer:
    """The method's answer; what it raises becomes a failure, since a user's pair would be lost just the same."""
    try:
        return method.run(pair, seed)
    except Exception as error:
        nothing = np.zeros(len(pair.points1), dtype=bool)
        return Answer(None, None, nothing, nothing, f"error: {type(error).__name__}: {error}")


def evaluate_pair(method: Method, pair: ScenePair, seed: int) -> PairOutcome:
    """Run a method on one pair and compare its answer with the truth."""
    answer = answer_pair(method, pair, seed)
    truth = true_matches(pair.correspondences, pair.E)
    rotation_deg = translation_deg = None
    error_deg = FAILURE_DEG
    failure = answer.failure
    if answer.R is not None and answer.t is not None:
        rotation_deg = rotation_error_deg(answer.R, pair.R)
        translation_deg = translation_error_deg(answer.t, pair.t)
        error_deg = max(rotation_deg, translation_deg)
    elif not failure:
        failure = "no pose"
    paper = counts = None
    if answer.logits is not None and answer.scores is not None:
        paper = precision_recall_f(answer.logits > PAPER_LOGIT, truth)
        counts = count_scores(answer.logits, answer.scores, truth)
    return PairOutcome(
        pair=pair.index,
        error_deg=error_deg,
        rotation_deg=rotation_deg,
        translation_deg=translation_deg,
        kept=precision_recall_f(answer.kept, truth),
        mask=precision_recall_f(answer.mask, truth),
        failure=failure,
        paper=paper,
        counts=counts,
        properties=PairProperties.of(pair, truth),
        status=answer.status,
        confidence=answer.confidence,
    )
