"""Can the status be trusted? ``python -m mgca_filter.evaluation.verdicts PHOTOS --bundles BUNDLES``.

Two questions, each with intrinsics given and without: how many pairs of photographs that show different places come
out as ``ok``, and how many true pairs whose pose the fit had solved are turned into something else.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data.scene_bundle import load_scene_bundles
from ..errors import MgcaFilterError
from ..geometry.epipolar import decompose_essential, pose_error_deg
from ..inputs.pair import MatchPair
from ..match_filter import MatchFilter, model_path
from ..result import Status
from .metrics import FAILURE_DEG
from .pairs import draw_indices
from .photo_pairs import PhotoFolder, draw_unrelated, read_places
from .product import runtime_source_digest

SOLVED_DEG = 10.0
# Photographs come without intrinsics; a plausible camera stands in for those that a user would give.
PLAUSIBLE_FOCAL_FACTOR = 1.2
INTRINSICS = ("given", "none")
# These two come with a pose that can be used as it is; everything else takes it away or warns of it.
TRUSTED = (Status.OK.value, Status.PLANAR.value)
_CHUNK = 40

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trial:
    """One pair, intrinsics included, and its true pose (R, t), None for photographs of different places."""

    name: str
    pair: MatchPair
    truth: tuple[NDArray[np.float64], NDArray[np.float64]] | None


@dataclass(frozen=True)
class Judged:
    """The filter's status on one pair, and the error of the pose that the verdict saw (180 = none or no truth)."""

    name: str
    related: bool
    intrinsics: str
    status: str
    error_deg: float


def photo_trials(photos: PhotoFolder, names: Sequence[tuple[str, str]]) -> Iterator[Trial]:
    """Pairs of photographs of different places."""
    for name1, name2 in names:
        pair = photos.pair(name1, name2)
        with_cameras = replace(pair, K1=_plausible_camera(pair.size1), K2=_plausible_camera(pair.size2))
        yield Trial(f"{name1} {name2}", with_cameras, None)


def scene_trials(path: Path, per_scene: int | None, seed: int) -> Iterator[Trial]:
    """Pairs of scene bundles, at most ``per_scene`` of each."""
    for bundle in load_scene_bundles(path):
        for index in draw_indices(len(bundle), bundle.scene, per_scene, seed):
            pair = bundle[index]
            cameras = (pair.K1, pair.K2, None, None, pair.image_size1, pair.image_size2)
            arrays = MatchPair(pair.points1, pair.points2, None, *cameras, pair.attributes)
            yield Trial(f"{pair.scene} {pair.index}", arrays, (pair.R, pair.t))


def judge_trial(trial: Trial, intrinsics: str, match_filter: MatchFilter) -> Judged:
    """Run the filter with the pair's intrinsics (``"given"``) or without them (``"none"``)."""
    pair = trial.pair if intrinsics == "given" else replace(trial.pair, K1=None, K2=None)
    result = match_filter.filter_many([pair])[0]
    E = result.info["fitted_essential"]
    errors = []
    if E is not None and trial.truth is not None:
        errors = [pose_error_deg(R, t, *trial.truth) for R, t in decompose_essential(E)]
    return Judged(
        trial.name, trial.truth is not None, intrinsics, result.status.value, min(errors, default=FAILURE_DEG)
    )


def _plausible_camera(size: Any) -> NDArray[np.float64]:
    focal = PLAUSIBLE_FOCAL_FACTOR * max(size)
    return np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])


class JudgedStore:
    """Answers on disk, one file per model, options and source code; an interrupted run goes on where it stopped."""

    def __init__(self, folder: Path, model: Path, method: str) -> None:
        parts = [method, runtime_source_digest(), cv2.__version__, hashlib.sha256(model.read_bytes()).hexdigest()]
        self._path = folder / f"verdicts.{hashlib.sha256('|'.join(parts).encode()).hexdigest()[:16]}.jsonl"
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        self._known = {(row.name, row.intrinsics): row for row in (Judged(**json.loads(line)) for line in lines)}

    def judge(self, trials: Iterator[Trial], match_filter: MatchFilter) -> list[Judged]:
        """The answers on all trials, computed where they are not known."""
        answers, fresh = [], []
        for count, trial in enumerate(trials, 1):
            for intrinsics in INTRINSICS:
                judged = self._known.get((trial.name, intrinsics))
                if judged is None:
                    judged = judge_trial(trial, intrinsics, match_filter)
                    fresh.append(judged)
                answers.append(judged)
            if len(fresh) >= _CHUNK:
                self._append(fresh)
                fresh = []
                logger.info("%d pairs", count)
        self._append(fresh)
        return answers

    def _append(self, rows: list[Judged]) -> None:
        if rows:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.writelines(json.dumps(asdict(row)) + "\n" for row in rows)


def format_table(judged: Sequence[Judged]) -> str:
    """Counts by status, one row per kind of pair and intrinsics, and the two shares that matter."""
    statuses = [status.value for status in Status]
    header = ["pairs", "intrinsics", "number", *statuses, "share"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for related in (False, True):
        for intrinsics in INTRINSICS:
            rows = [r for r in judged if r.related == related and r.intrinsics == intrinsics]
            if related:
                rows = [r for r in rows if r.error_deg < SOLVED_DEG]
            if not rows:
                continue
            counts = Counter(row.status for row in rows)
            trusted = sum(counts[status] for status in TRUSTED)
            kind = f"true, solved within {SOLVED_DEG:.0f}°" if related else "unrelated"
            share = (
                f"{100.0 * (1.0 - trusted / len(rows)):.1f} % lost"
                if related
                else f"{100.0 * counts['ok'] / len(rows):.1f} % false ok"
            )
            words = [kind, intrinsics, str(len(rows)), *(str(counts[status]) for status in statuses), share]
            lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file, folder or option that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m mgca_filter.evaluation.verdicts", description=__doc__)
    parser.add_argument("photos", metavar="PHOTOS", type=Path, help="folder of photographs, taken as unrelated")
    parser.add_argument(
        "--same-place", metavar="FILE", help="a line of names without suffix for each place shown twice"
    )
    parser.add_argument("--pairs", type=int, default=1200, metavar="N", help="of photographs, drawn (default 1200)")
    parser.add_argument("--bundles", type=Path, metavar="PATH", help="scene bundles: pairs with known pose")
    parser.add_argument("--per-scene", type=int, metavar="N", help="at most N pairs of a scene")
    parser.add_argument("--store", type=Path, required=True, metavar="DIR", help="keeps features, matches and answers")
    parser.add_argument("--model", type=Path, default=model_path(), metavar="FILE")
    parser.add_argument("--method", default="prosac")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default 0)")
    parser.add_argument("--list", metavar="FILE", type=Path, help="write the false and the lost pairs here")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        judged = run(options)
    except (MgcaFilterError, ValueError, TypeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(format_table(judged))
    if options.list:
        wrong = [
            r for r in judged if (r.status in TRUSTED) != r.related and (not r.related or r.error_deg < SOLVED_DEG)
        ]
        options.list.write_text("".join(json.dumps(asdict(row)) + "\n" for row in wrong))
    return 0


def run(options: argparse.Namespace) -> list[Judged]:
    """Draw the pairs and judge them."""
    cv2.setNumThreads(1)
    match_filter = MatchFilter(model=options.model, method=options.method)
    store = JudgedStore(options.store, options.model, options.method)
    photos = PhotoFolder(options.photos, options.store)
    places = read_places(options.same_place) if options.same_place else []
    names = draw_unrelated(photos.names, places, options.pairs, options.seed)
    judged = store.judge(photo_trials(photos, names), match_filter)
    if options.bundles:
        judged += store.judge(scene_trials(options.bundles, options.per_scene, options.seed), match_filter)
    return judged


if __name__ == "__main__":
    sys.exit(main())
