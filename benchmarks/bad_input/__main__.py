"""Every kind of bad input into every entry point: ``python -m benchmarks.bad_input`` prints what was tried.

Entry points: ``filter_matches`` with intrinsics, without, and where the program has numpy raise; the twins of
``cv2.findEssentialMat`` and ``cv2.findFundamentalMat``; ``matchMGCA``; and ``mgca-match`` on image files and COLMAP
databases that are broken in all ways.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mgca_filter import cli
from mgca_filter.inputs.options import FilterOptions
from mgca_filter.match_filter import MatchFilter
from mgca_filter.opencv.twins import findEssentialMat, findFundamentalMat, matchMGCA
from mgca_filter.tables import render_table

from ..study import run_study
from .databases import DATABASES, damage, write_good_database
from .files import FILES
from .matches import FORMS, HEIGHT, KINDS, WIDTH, K
from .promises import broken_promises, broken_twin_answer

COUNTS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 33, 127, 500, 3000)
_SIZE = (int(WIDTH), int(HEIGHT))


@dataclass(frozen=True)
class Trial:
    """One input into one entry point: what kind, and what went wrong, empty where nothing did."""

    kind: str
    entry: str
    failure: str


def try_pairs(match_filter: MatchFilter, rounds: int, seed: int) -> Iterator[Trial]:
    """Every kind of points at ``rounds`` counts, in a type drawn for each, into every entry point."""
    rng = np.random.default_rng(seed)
    for kind, make in KINDS.items():
        for i in range(rounds):
            first, second = make(rng, COUNTS[i % len(COUNTS)])
            form = rng.choice(list(FORMS))
            arguments = FORMS[form](first, second, rng)
            for entry, call in entry_points(match_filter).items():
                label = f"{kind}, {len(first)} matches as {form}"
                yield Trial(kind, entry, _failure(partial(call, *arguments), label))
            strict = partial(_with_strict_numpy, entry_points(match_filter)["filter, K given"])
            yield Trial(kind, "filter, numpy raises", _failure(partial(strict, *arguments), label))


def _with_strict_numpy(call: Callable[[Any, Any, Any], list[str]], *arguments: Any) -> list[str]:
    """As in a program that says ``np.seterr(all="raise")``."""
    with np.errstate(all="raise"):
        return call(*arguments)


def entry_points(match_filter: MatchFilter) -> dict[str, Callable[[Any, Any, Any], list[str]]]:
    """By name: ``(kp1, kp2, matches)`` in, broken promises out."""

    def by_filter(K1: Any) -> Callable[[Any, Any, Any], list[str]]:
        return lambda kp1, kp2, m: broken_promises(
            match_filter.filter(kp1, kp2, m, K1=K1), len(_pixels(kp1)) if m is None else len(m)
        )

    def by_twin(kp1: Any, kp2: Any, essential: bool) -> list[str]:
        points1, points2 = _pixels(kp1), _pixels(kp2)
        answer = findEssentialMat(points1, points2, K) if essential else findFundamentalMat(points1, points2)
        return broken_twin_answer(answer, len(points1), essential)

    def by_gms(kp1: Any, kp2: Any, matches: Any) -> list[str]:
        rows = [cv2.DMatch(i, i, 0.0) for i in range(len(_pixels(kp1)))] if matches is None else matches
        if isinstance(rows, np.ndarray) and rows.dtype != object:
            rows = [cv2.DMatch(int(i), int(j), 0.0) for i, j in rows]
        kept = matchMGCA(_SIZE, _SIZE, kp1, kp2, rows)
        return [] if isinstance(kept, tuple) and all(isinstance(m, cv2.DMatch) for m in kept) else ["no DMatch tuple"]

    return {
        "filter, K given": by_filter(K),
        "filter, no K": by_filter(None),
        "findEssentialMat": lambda kp1, kp2, m: by_twin(kp1, kp2, True),
        "findFundamentalMat": lambda kp1, kp2, m: by_twin(kp1, kp2, False),
        "matchMGCA": by_gms,
    }


def _pixels(keypoints: Any) -> Any:
    if len(keypoints) and isinstance(keypoints[0], cv2.KeyPoint):
        return np.array([keypoint.pt for keypoint in keypoints])
    return np.asarray(keypoints, dtype=np.float64).reshape(-1, 2)


def try_files(model: str) -> Iterator[Trial]:
    """``mgca-match`` on every kind of file: an exit status and at most one line on stderr, never a traceback."""
    with tempfile.TemporaryDirectory() as folder:
        good = Path(folder) / "good.png"
        noise = np.random.default_rng(0).integers(0, 256, (120, 160), dtype=np.uint8)
        cv2.imwrite(str(good), cv2.GaussianBlur(noise, (0, 0), 1.5))
        for kind, (write, statuses) in FILES.items():
            path = Path(folder) / "bad.png"
            write(path, good.read_bytes())

            def call(path: Path = path, statuses: Sequence[int] = statuses) -> list[str]:
                out = io.StringIO()
                with contextlib.redirect_stderr(out), contextlib.redirect_stdout(io.StringIO()):
                    status = cli.main([str(good), str(path), "--model", model, "--max-keypoints", "200"])
                words = out.getvalue()
                unnamed = status == 2 and ("bad.png" not in words or words.count("\n") != 1)
                wrong = [] if status in statuses else [f"exit status {status}"]
                return [*wrong, "no line that names the file"] if unnamed else wrong

            yield Trial(f"file: {kind}", "mgca-match", _failure(call, kind))


def try_databases(model: str) -> Iterator[Trial]:
    """``mgca-match colmap`` on every kind of database: an exit status that is right, never a traceback."""
    try:
        import pycolmap  # noqa: F401
    except ImportError:
        return
    with tempfile.TemporaryDirectory() as folder:
        for number, (kind, (statement, statuses)) in enumerate(DATABASES.items()):
            path = Path(folder) / f"{number}.db"
            write_good_database(path)
            damage(path, statement)

            def call(path: Path = path, statuses: Sequence[int] = statuses) -> list[str]:
                out = io.StringIO()
                words = [str(path), "-o", str(path) + ".out.db", "-q", "--model", model]
                with contextlib.redirect_stderr(out), contextlib.redirect_stdout(io.StringIO()):
                    status = cli.main(["colmap", *words])
                unnamed = status == 2 and (path.name not in out.getvalue() or out.getvalue().count("\n") != 1)
                wrong = [] if status in statuses else [f"exit status {status}: {out.getvalue().strip()}"]
                return [*wrong, "no line that names the file"] if unnamed else wrong

            yield Trial(f"database: {kind}", "mgca-match colmap", _failure(call, kind))


def _failure(call: Callable[[], list[str]], label: str) -> str:
    """Broken promises or the exception, in words; warnings of the runtime count as failures too."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            broken = call()
    except Exception as error:  # whatever it is: it must not be
        return f"{label}: {type(error).__name__}: {error}"
    return f"{label}: {'; '.join(broken)}" if broken else ""


def format_table(trials: Sequence[Trial]) -> str:
    """Inputs tried by kind (rows) and entry point (columns); failures, where there are any, in brackets."""
    tried = Counter((trial.kind, trial.entry) for trial in trials)
    failed = Counter((trial.kind, trial.entry) for trial in trials if trial.failure)
    columns = list(dict.fromkeys(trial.entry for trial in trials))
    body = []
    for kind in dict.fromkeys(trial.kind for trial in trials):
        cells = [f"{tried[kind, c]}" + f" ({failed[kind, c]} failed)" * (failed[kind, c] > 0) for c in columns]
        body.append([kind, *("" if cell == "0" else cell for cell in cells)])
    table = render_table(["", *columns], body)
    return f"{table}\n\n{len(trials)} inputs tried, {sum(failed.values())} failures"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = no failure, 1 = some, listed on stderr, 2 = a model or option that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bad_input", description=__doc__)
    parser.add_argument("--rounds", type=int, default=len(COUNTS), metavar="N", help="inputs of each kind and entry")
    parser.add_argument("--model", default="default", metavar="MODEL", help="file, or name as in filter_matches")
    parser.add_argument("--method", default=FilterOptions.method)
    parser.add_argument("--seed", type=int, default=0)
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Try everything and print the table."""
    match_filter = MatchFilter(model=options.model, method=options.method)
    trials = [*try_pairs(match_filter, options.rounds, options.seed), *try_files(options.model)]
    trials += try_databases(options.model)
    print(format_table(trials))
    for trial in trials:
        if trial.failure:
            print(f"{trial.entry}: {trial.failure}", file=sys.stderr)
    return 1 if any(trial.failure for trial in trials) else 0


if __name__ == "__main__":
    sys.exit(main())
