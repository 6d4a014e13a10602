"""Can the status be trusted? ``python -m benchmarks.verdicts PHOTOS --bundles BUNDLES``.

Two questions, each with intrinsics given and without: how many pairs of photographs that show different places come
out as ``ok``, and how many true pairs whose pose the fit had solved are doubted (``low_support``, with the pose) or
lost (any status but that, ``ok`` and ``planar``).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from mgca_filter.atomic_file import replaced_when_done
from mgca_filter.data.source import detect, digest_files
from mgca_filter.evaluation.metrics import FAILURE_DEG
from mgca_filter.evaluation.our_rows import runtime_source_digest
from mgca_filter.evaluation.pairs import iterate_pairs, select_pairs
from mgca_filter.features import FEATURE_SETTINGS, match_features
from mgca_filter.geometry.epipolar import decompose_essential, pose_error_deg
from mgca_filter.inputs.attributes import MatchAttributes
from mgca_filter.inputs.options import FilterOptions
from mgca_filter.inputs.pair import MatchPair
from mgca_filter.match_filter import MatchFilter, find_models
from mgca_filter.result import Status
from mgca_filter.tables import render_table

from .study import match_pair, run_study, study_parser

SOLVED_DEG = 10.0
# Photographs come without intrinsics; a plausible camera stands in for those that a user would give.
PLAUSIBLE_FOCAL_FACTOR = 1.2
INTRINSICS = ("given", "none")
# These two come with a pose that can be used as it is; everything else takes it away or warns of it.
TRUSTED = (Status.OK.value, Status.PLANAR.value)
_CHUNK = 40
_SUFFIXES = (".jpg", ".jpeg", ".png")


def read_places(path: str | Path) -> list[set[str]]:
    """Groups of photographs of the same place: one group a line, names without suffix between blanks."""
    return [set(line.split()) for line in Path(path).read_text(encoding="utf-8").splitlines() if line.strip()]


def draw_unrelated(names: Sequence[str], places: Sequence[set[str]], count: int, seed: int) -> list[tuple[str, str]]:
    """At most ``count`` pairs of names, none from the same place, drawn without replacement and sorted."""
    pairs = [pair for pair in combinations(sorted(names), 2) if not any(set(pair) <= place for place in places)]
    chosen = np.random.default_rng(seed).permutation(len(pairs))[:count]
    return [pairs[i] for i in sorted(chosen)]


class PhotoFolder:
    """Photographs of a folder; the matches of each pair are computed once and kept under ``store``.

    Raises:
        ValueError: the folder holds fewer than two photographs (.jpg, .png).
    """

    def __init__(self, folder: str | Path, store: str | Path) -> None:
        self._paths = {path.stem: path for path in sorted(Path(folder).iterdir()) if path.suffix.lower() in _SUFFIXES}
        self._store = Path(store) / "matches"
        if len(self._paths) < 2:
            raise ValueError(f"{folder}: expected at least two photographs ({', '.join(_SUFFIXES)})")

    @property
    def names(self) -> list[str]:
        """File names without suffix, sorted."""
        return sorted(self._paths)

    def pair(self, name1: str, name2: str) -> MatchPair:
        """Raw matches of two photographs: pixels row by row, sizes, and what the matcher knew; no intrinsics.

        Raises:
            DatasetError: a file is no image.
        """
        paths = (self._paths[name1], self._paths[name2])
        file = self._store / f"{name1}.{name2}.{digest_files(paths, FEATURE_SETTINGS)[:16]}.npz"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            with replaced_when_done(file) as partial, partial.open("wb") as out:
                np.savez(out, **_matched_arrays(*paths))  # type: ignore[arg-type]  # its stub takes names for options
        with np.load(file, allow_pickle=False) as loaded:
            arrays = dict(loaded)
        points1, points2, size1, size2 = (arrays.pop(name) for name in ("points1", "points2", "image1", "image2"))
        return MatchPair(points1, points2, None, size1=size1, size2=size2, attributes=MatchAttributes(**arrays))


def _matched_arrays(path1: Path, path2: Path) -> dict[str, NDArray[Any]]:
    """Pixels (M, 2), the images' sizes, and the attributes that are known (M,), by name."""
    one, two = detect(path1), detect(path2)
    matches = match_features(one, two)
    return {
        "points1": one.points[matches.index1],
        "points2": two.points[matches.index2],
        "image1": np.array(one.image_size),
        "image2": np.array(two.image_size),
        **{name: values for name, values in asdict(matches.attributes).items() if values is not None},
    }


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
    for pair in iterate_pairs(select_pairs(path, None, per_scene, seed)):
        yield Trial(f"{pair.scene} {pair.index}", match_pair(pair), (pair.R, pair.t))


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
    """Answers on disk, a file for each set of models, options and code; an interrupted run goes on where it stopped."""

    def __init__(self, folder: Path, models: Sequence[Path], method: str) -> None:
        parts = [method, runtime_source_digest(), cv2.__version__]
        parts += [hashlib.sha256(model.read_bytes()).hexdigest() for model in models]
        self._path = folder / f"verdicts.{hashlib.sha256('|'.join(parts).encode()).hexdigest()[:16]}.jsonl"
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        self._known = {(row.name, row.intrinsics): row for row in (Judged(**json.loads(line)) for line in lines)}

    def judge(self, trials: Iterator[Trial], match_filter: MatchFilter) -> list[Judged]:
        """The answers on all trials, computed where they are not known."""
        answers, fresh = [], []
        for trial in tqdm(trials, unit="pair", disable=None):
            for intrinsics in INTRINSICS:
                judged = self._known.get((trial.name, intrinsics))
                if judged is None:
                    judged = judge_trial(trial, intrinsics, match_filter)
                    fresh.append(judged)
                answers.append(judged)
            if len(fresh) >= _CHUNK:
                self._append(fresh)
                fresh = []
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
    body = []
    for related in (False, True):
        for intrinsics in INTRINSICS:
            rows = [r for r in judged if r.related == related and r.intrinsics == intrinsics]
            if related:
                rows = [r for r in rows if r.error_deg < SOLVED_DEG]
            if not rows:
                continue
            counts = Counter(row.status for row in rows)
            doubted = counts[Status.LOW_SUPPORT.value]
            lost = len(rows) - doubted - sum(counts[status] for status in TRUSTED)
            kind = f"true, solved within {SOLVED_DEG:.0f}°" if related else "unrelated"
            share = (
                f"{100.0 * lost / len(rows):.1f} % lost, {100.0 * doubted / len(rows):.1f} % doubted"
                if related
                else f"{100.0 * counts['ok'] / len(rows):.1f} % false ok"
            )
            words = [kind, intrinsics, str(len(rows)), *(str(counts[status]) for status in statuses), share]
            body.append(words)
    return render_table(["pairs", "intrinsics", "number", *statuses, "share"], body, align="llr")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file, folder or option that cannot be used."""
    parser = study_parser("verdicts", __doc__)
    parser.add_argument("photos", metavar="PHOTOS", type=Path, help="folder of photographs, taken as unrelated")
    parser.add_argument(
        "--same-place", metavar="FILE", help="a line of names without suffix for each place shown twice"
    )
    parser.add_argument("--pairs", type=int, default=1200, metavar="N", help="of photographs, drawn (default 1200)")
    parser.add_argument("--bundles", type=Path, metavar="PATH", help="scene bundles: pairs with known pose")
    parser.add_argument("--store", type=Path, required=True, metavar="DIR", help="keeps features, matches and answers")
    parser.add_argument("--method", default=FilterOptions.method)
    parser.add_argument("--list", metavar="FILE", type=Path, help="write the false and the lost pairs here")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Draw the pairs, judge them, print the table."""
    match_filter = MatchFilter(model=options.model, method=options.method)
    store = JudgedStore(options.store, find_models(options.model), options.method)
    photos = PhotoFolder(options.photos, options.store)
    places = read_places(options.same_place) if options.same_place else []
    names = draw_unrelated(photos.names, places, options.pairs, options.seed)
    judged = store.judge(photo_trials(photos, names), match_filter)
    if options.bundles:
        judged += store.judge(scene_trials(options.bundles, options.per_scene, options.seed), match_filter)
    print(format_table(judged))
    if options.list:
        wrong = [
            r for r in judged if (r.status in TRUSTED) != r.related and (not r.related or r.error_deg < SOLVED_DEG)
        ]
        options.list.write_text("".join(json.dumps(asdict(row)) + "\n" for row in wrong))
    return 0


if __name__ == "__main__":
    sys.exit(main())
