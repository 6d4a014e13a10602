"""Never worse than what it replaces? ``python -m benchmarks.input_kinds FOLDER [FOLDER ...]``.

Every detector whose bundles the folders hold (``scene.detector.npz``; ``scene.npz`` is SIFT-2000), every kind of list
that users make of its raw matches, and the filter at its defaults against every robust estimator on exactly the same
list. An answer is *harmful* that is more than 30 degrees off and called usable while a baseline on the same list is
below 5. Further tables: means over the lists, bins by the share of right matches and by motion, and what the confidence
is worth, also without the pairs whose label is in doubt (``benchmarks.doubted_labels``). ``--gaps 1 2 5`` keeps images
of sequences that are so many frames apart, and bins by that too.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mgca_filter.atomic_file import replaced_when_done
from mgca_filter.errors import DatasetError
from mgca_filter.evaluation.baselines import Baseline, Estimator, OpenCvEstimator, PoseLibEstimator
from mgca_filter.evaluation.difficulty import Grouping
from mgca_filter.evaluation.methods import Method, PairOutcome
from mgca_filter.evaluation.metrics import (
    POSE_STATISTICS,
    BoolArray,
    FloatArray,
    ReliabilityBin,
    SceneErrors,
    area_under_roc,
    calibration_gap,
    count_scores,
    mean_over_scenes,
    percentile_interval,
    pool_pairs,
    reliability,
    resampled_figures,
)
from mgca_filter.evaluation.our_rows import ProductMethod
from mgca_filter.evaluation.predict import SceneOutcomes, predict
from mgca_filter.evaluation.store import ResultStore
from mgca_filter.evaluation.summarize import scene_errors
from mgca_filter.result import Status
from mgca_filter.tables import MISSING, render_table

from .doubted_labels import PairName, doubted_labels
from .match_lists import KINDS, DetectorScene, ListKind, frame_gap, open_detector_scenes
from .motion import MOTIONS, Motion
from .study import CONFIDENCE_LIMITS, run_study, study_parser

OURS = "filter"
# PoseLib's own limit of 100 000 iterations takes seconds on a hopeless list.
ESTIMATORS: dict[str, Estimator] = {
    "MAGSAC 0.5 px": OpenCvEstimator("MAGSAC", 0.5),
    "PROSAC 0.5 px": OpenCvEstimator("PROSAC", 0.5),
    "PoseLib 1 px": PoseLibEstimator(1.0, max_iterations=10_000),
    "PoseLib progressive 0.75 px": PoseLibEstimator(0.75, progressive=True, max_iterations=10_000),
}
"""Baselines by name, PROSAC and PoseLib progressive in the order that :attr:`ScenePair.order` gives."""

STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
COMPARED = ("mAP@20", "AUC@5")
REPLICATES = 1000
HARMFUL_DEG, BASELINE_RIGHT_DEG, RIGHT_DEG = 30.0, 5.0, 10.0
USABLE = (Status.OK.value, Status.PLANAR.value)
TOLERATED, TOLERATED_LOW = -1.0, -2.0
"""Difference to the best baseline, points, and lower end of its interval below which a row is pointed out."""

SHARES = Grouping("share of right matches in the list", "inlier_share", (0.02, 0.05, 0.1, 0.2, 0.5), 100.0, " %")
UNDOUBTED = "all whose label is not in doubt"
MOTION_TITLE, GAP_TITLE = "motion of the camera (a pair may belong to several kinds)", "frames between the images"

NOTES = (
    "Figures are per cent, means over scenes; a list without a pose counts 180°. Baselines run on exactly the same "
    "list (raw: on its mutual, ratio < 0.9 part): USAC confidence 0.9999 and 5000 iterations, PoseLib at most 10 000; "
    "PROSAC and PoseLib progressive by ratio, a learned matcher's list by its score, clean lists as they are. The best "
    "baseline is chosen after the fact for each row and each measure, which favours it. Differences: filter − best "
    "baseline, with a 95 % bootstrap interval over the pairs."
)


def methods_of(kind: ListKind, model: str | None) -> dict[str, Method]:
    """The filter and all baselines on a kind of list, by the names of the tables; of clean lists no order is known."""
    methods: dict[str, Method] = {OURS: ProductMethod("product", model=model)}
    for name, estimator in ESTIMATORS.items():
        methods[name] = Baseline(kind.baseline_selection, estimator, kind.verified and estimator.ordered)
    return methods


@dataclass(frozen=True)
class Cell:
    """All methods on one kind of list of one detector.

    Attributes:
        outcomes: by method, the filter first.
        motions, gaps: of the pairs of all scenes one after the other; None where a pair cannot be read, and where the
            images' names tell no distance in frames.
        doubted: likewise, whether unlike detectors contradict the label (:mod:`benchmarks.doubted_labels`).
    """

    detector: str
    kind: ListKind
    outcomes: Mapping[str, SceneOutcomes]
    motions: Sequence[Motion | None]
    gaps: Sequence[int | None]
    doubted: Sequence[bool]

    @cached_property
    def errors(self) -> dict[str, dict[str, FloatArray]]:
        """Pose errors (S, P) by method and scene, degrees."""
        return {name: scene_errors(outcomes) for name, outcomes in self.outcomes.items()}

    @cached_property
    def answers(self) -> list[list[PairOutcome]]:
        """What the filter said, run by run, the pairs of all scenes one after the other."""
        scenes = list(self.outcomes[OURS].values())
        return [[outcome for runs in scenes for outcome in runs[s]] for s in range(len(scenes[0]))]

    @cached_property
    def usable(self) -> BoolArray:
        """(S, P): the filter gives a pose and calls it usable."""
        return np.array([[one.status in USABLE and not one.failure for one in run] for run in self.answers])

    @cached_property
    def harmful(self) -> BoolArray:
        """(S, P): a usable pose far off, where a baseline is right in the same run, or in its only one."""
        pooled = {name: pool_pairs(errors) for name, errors in self.errors.items()}
        ours = pooled.pop(OURS)
        best = np.min([np.resize(errors, ours.shape) for errors in pooled.values()], axis=0)  # runs repeat
        return np.asarray(self.usable & (ours > HARMFUL_DEG) & (best < BASELINE_RIGHT_DEG))

    def groups(self, title: str) -> list[tuple[str, ...]]:
        """Names of the groups of a table that each pair belongs to."""
        if title == MOTION_TITLE:
            return [() if one is None else one.kinds for one in self.motions]
        if title == GAP_TITLE:
            return [() if gap is None else (str(gap),) for gap in self.gaps]
        return [(SHARES.name_of(one.properties),) for one in self.answers[0]]


@dataclass(frozen=True)
class Comparison:
    """The filter against all baselines on the same lists.

    Attributes:
        lists: how many.
        figures: by method and statistic, per cent.
        best: by statistic, the baseline of the highest figure.
        differences: by baseline and statistic, filter − baseline, points.
        resampled: the same on the bootstrap's draws, (replicates,) each.
        harmful, answers: numbers of answers.
    """

    lists: int
    figures: Mapping[str, Mapping[str, float]]
    best: Mapping[str, str]
    differences: Mapping[str, Mapping[str, float]]
    resampled: Mapping[str, Mapping[str, FloatArray]]
    harmful: int
    answers: int

    @classmethod
    def of(cls, errors: Mapping[str, SceneErrors], harmful: BoolArray) -> Comparison:
        """Of pose errors by method and scene, degrees, and the harmful answers (S, P)."""
        figures = {
            name: {key: 100.0 * mean_over_scenes(POSE_STATISTICS[key], scenes) for key in STATISTICS}
            for name, scenes in errors.items()
        }
        draws = {name: {key: _resampled(scenes, key) for key in COMPARED} for name, scenes in errors.items()}
        baselines = [name for name in errors if name != OURS]
        return cls(
            lists=pool_pairs(errors[OURS]).shape[1],
            figures=figures,
            best={key: max(baselines, key=partial(_rank, figures, key)) for key in STATISTICS},
            differences={
                name: {key: figures[OURS][key] - figures[name][key] for key in STATISTICS} for name in baselines
            },
            resampled={name: {key: draws[OURS][key] - draws[name][key] for key in COMPARED} for name in baselines},
            harmful=int(np.count_nonzero(harmful)),
            answers=harmful.size,
        )

    def against(self, baseline: str, statistic: str) -> tuple[float, float, float]:
        """Difference to a baseline, and its 95 % interval, points."""
        return self.differences[baseline][statistic], *percentile_interval(self.resampled[baseline][statistic])

    def against_best(self, statistic: str) -> tuple[float, float, float]:
        """The same to the best baseline."""
        return self.against(self.best[statistic], statistic)

    @property
    def lost(self) -> list[str]:
        """Statistics in which the filter is below the best baseline by more than is tolerated."""
        return [key for key in COMPARED if self.against_best(key)[0] < TOLERATED]

    @property
    def doubtful(self) -> list[str]:
        """Those of the others in which it might be, as the lower end of the interval says."""
        return [key for key in COMPARED if key not in self.lost and self.against_best(key)[1] < TOLERATED_LOW]

    def to_json(self) -> dict[str, Any]:
        """JSON values of all but the draws."""
        return {
            "lists": self.lists,
            "figures": {name: dict(values) for name, values in self.figures.items()},
            "best": dict(self.best),
            "differences": {name: {k: self.against(name, k) for k in COMPARED} for name in self.differences},
            "harmful": self.harmful,
            "answers": self.answers,
        }


def _rank(figures: Mapping[str, Mapping[str, float]], statistic: str, name: str) -> tuple[float, float]:
    """By one statistic, of equal ones by all."""
    return round(figures[name][statistic], 6), sum(figures[name].values())


def _resampled(errors: SceneErrors, statistic: str) -> FloatArray:
    draws = resampled_figures(errors, POSE_STATISTICS[statistic], replicates=REPLICATES, seed=0)
    return np.asarray(100.0 * draws.mean(axis=0))


@dataclass(frozen=True)
class Mean:
    """Mean over cells, each weighing the same: figures of the filter, differences to each cell's best baseline and to
    every single one, with intervals; and all harmful answers."""

    cells: int
    lists: int
    figures: Mapping[str, float]
    against_best: Mapping[str, tuple[float, float, float]]
    against: Mapping[str, Mapping[str, tuple[float, float, float]]]
    harmful: int
    answers: int

    @classmethod
    def of(cls, comparisons: Sequence[Comparison]) -> Mean:
        """Of at least one comparison. Cells that hold the same pairs are resampled alike."""

        def mean(statistic: str, baselines: Sequence[str]) -> tuple[float, float, float]:
            pairs = list(zip(comparisons, baselines))
            draws = np.mean([one.resampled[name][statistic] for one, name in pairs], axis=0)
            middle = float(np.mean([one.differences[name][statistic] for one, name in pairs]))
            return middle, *percentile_interval(draws)

        return cls(
            cells=len(comparisons),
            lists=sum(one.lists for one in comparisons),
            figures={key: float(np.mean([one.figures[OURS][key] for one in comparisons])) for key in STATISTICS},
            against_best={key: mean(key, [one.best[key] for one in comparisons]) for key in COMPARED},
            against={name: {k: mean(k, [name] * len(comparisons)) for k in COMPARED} for name in ESTIMATORS},
            harmful=sum(one.harmful for one in comparisons),
            answers=sum(one.answers for one in comparisons),
        )


@dataclass(frozen=True)
class ConfidenceQuality:
    """What ``result.confidence`` and ``result.status`` are worth on a set of answers; right = within 10 degrees.

    Attributes:
        answers: how many. known: those of them with a confidence, that is, with a pose.
        auroc, ece: of the confidence, over those.
        usable: answers with a pose that is called usable. right_where_usable: share of them.
        kept_of_right: share of the right poses that are called usable.
        bins: reliability of the confidence.
        curve: for each of CONFIDENCE_LIMITS, the share of right ones among the poses at least so sure, and the share of
            the right poses that are.
    """

    answers: int
    known: int
    auroc: float
    ece: float
    usable: int
    right_where_usable: float
    kept_of_right: float
    bins: list[ReliabilityBin]
    curve: list[tuple[float, float]]

    @classmethod
    def of(cls, cells: Sequence[Cell], *, doubted: bool = True) -> ConfidenceQuality:
        """Over all answers of some cells; or over those alone whose label is not in doubt."""
        rows = [(cell, np.flatnonzero(~np.array(cell.doubted) | doubted)) for cell in cells]
        answers = [run[row] for cell, kept in rows for run in cell.answers for row in kept]
        usable = np.concatenate([cell.usable[:, kept].ravel() for cell, kept in rows])
        right = np.array([one.error_deg < RIGHT_DEG for one in answers])
        known = np.array([one.confidence is not None for one in answers])
        confidence = np.array([one.confidence for one in answers if one.confidence is not None], dtype=np.float64)
        bins = reliability([count_scores(confidence, confidence, right[known])])
        return cls(
            answers=len(answers),
            known=int(np.count_nonzero(known)),
            auroc=area_under_roc(confidence, right[known]),
            ece=calibration_gap(bins),
            usable=int(np.count_nonzero(usable)),
            right_where_usable=_share(right[usable]),
            kept_of_right=_share(usable[right]),
            bins=bins,
            curve=[
                (_share(right[known][confidence >= limit]), _share((confidence >= limit)[right[known]]))
                for limit in CONFIDENCE_LIMITS
            ],
        )

    def to_json(self) -> dict[str, Any]:
        """JSON values; what is not defined is None."""
        curve = [[_defined(share) for share in shares] for shares in self.curve]
        values = {**vars(self), "bins": [vars(one) for one in self.bins], "curve": curve}
        return {name: _defined(value) for name, value in values.items()}


def _defined(value: Any) -> Any:
    return None if isinstance(value, float) and np.isnan(value) else value


def _share(flags: BoolArray) -> float:
    return float(np.mean(flags)) if len(flags) else float("nan")


def run_cells(
    scenes: Sequence[DetectorScene], kinds: Sequence[ListKind], model: str | None, store: ResultStore, **options: Any
) -> list[Cell]:
    """All methods on all kinds of lists of each detector; ``options`` as :func:`predict.predict` takes them."""
    doubted = doubted_labels(scenes)
    facts = {scene: list(_facts(scene, doubted)) for scene in scenes}
    cells = []
    planned = [(d, kind) for d in dict.fromkeys(scene.detector for scene in scenes) for kind in kinds]
    for detector, kind in tqdm(planned, disable=None, unit=" kinds of lists"):
        listed = [(scene, scene.lists(kind)) for scene in scenes if scene.detector == detector]
        selections = [selection for _, selection in listed if selection is not None]
        if not selections:
            continue
        methods = methods_of(kind, model)
        results = predict(list(methods.values()), selections, store=store, **options)
        known = [one for scene, selection in listed if selection is not None for one in facts[scene]]
        outcomes = {name: results[method.name] for name, method in methods.items()}
        motions, gaps, in_doubt = zip(*known)
        cells.append(Cell(detector, kind, outcomes, motions, gaps, in_doubt))
    return cells


def _facts(scene: DetectorScene, doubted: Container[PairName]) -> Iterator[tuple[Motion | None, int | None, bool]]:
    """Motion, gap, and whether its label is in doubt, of each pair."""
    for index in scene.indices:
        try:
            pair = scene.source[index]
        except DatasetError:
            yield None, None, False
            continue
        name = (scene.scene, pair.image1, pair.image2)
        yield Motion.of(pair), frame_gap(pair.image1, pair.image2), name in doubted


def grouped(cells: Sequence[Cell], title: str, names: Sequence[str]) -> dict[str, Comparison]:
    """A comparison a group, over the lists of all cells together (means over lists); groups without a list are left
    out."""
    belongs = [groups for cell in cells for groups in cell.groups(title)]
    harmful = np.concatenate([cell.harmful for cell in cells], axis=1)
    pooled = {
        name: np.concatenate([pool_pairs(cell.errors[name]) for cell in cells], axis=1) for name in cells[0].errors
    }
    comparisons = {}
    for group in names:
        chosen = np.array([group in groups for groups in belongs])
        if chosen.any():
            errors = {name: {"all": values[:, chosen]} for name, values in pooled.items()}
            comparisons[group] = Comparison.of(errors, harmful[:, chosen])
    return comparisons


COMPARISON_HEADER = ("lists", "filter", "best, mAP@20", "", "difference", "best, AUC@5", "", "difference", "harmful")


def comparison_cells(one: Comparison) -> list[str]:
    """Number of lists, the filter, per measure the best baseline with its figures and the difference, harmful."""
    cells = [str(one.lists), _figures(one.figures[OURS])]
    for statistic in COMPARED:
        name = one.best[statistic]
        cells += [name, _figures(one.figures[name]), _interval(one.against(name, statistic))]
    return [*cells, _harmful(one.harmful, one.answers)]


def _figures(values: Mapping[str, float]) -> str:
    return " / ".join(f"{values[key]:.1f}" for key in STATISTICS)


def _interval(values: tuple[float, float, float]) -> str:
    middle, low, high = values
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def _harmful(count: int, answers: int) -> str:
    return f"{count} ({100.0 * count / answers:.2f} %)"


def _number(value: float, factor: float = 1.0, digits: int = 3, unit: str = "") -> str:
    return MISSING if np.isnan(value) else f"{factor * value:.{digits}f}{unit}"


@dataclass(frozen=True)
class Study:
    """Everything that is printed."""

    cells: Mapping[tuple[str, str], Comparison]
    means: Mapping[str, Mean]
    groups: Mapping[str, Mapping[str, Comparison]]
    confidence: Mapping[str, ConfidenceQuality]

    @classmethod
    def of(cls, cells: Sequence[Cell]) -> Study:
        """Of at least one cell."""
        compared = [(cell, Comparison.of(cell.errors, cell.harmful)) for cell in cells]
        families = dict.fromkeys(cell.kind.family for cell in cells)
        means = {"all": Mean.of([one for _, one in compared])}
        means |= {f: Mean.of([one for cell, one in compared if cell.kind.family == f]) for f in families}
        gaps = sorted({gap for cell in cells for gap in cell.gaps if gap is not None})
        names = {SHARES.title: SHARES.names, MOTION_TITLE: MOTIONS, GAP_TITLE: [str(gap) for gap in gaps]}
        detectors = dict.fromkeys(cell.detector for cell in cells)
        confidence = {d: ConfidenceQuality.of([cell for cell in cells if cell.detector == d]) for d in detectors}
        confidence["all"] = ConfidenceQuality.of(cells)
        if any(any(cell.doubted) for cell in cells):
            confidence[UNDOUBTED] = ConfidenceQuality.of(cells, doubted=False)
        return cls(
            cells={(cell.detector, cell.kind.name): one for cell, one in compared},
            means=means,
            groups={title: grouped(cells, title, groups) for title, groups in names.items()},
            confidence=confidence,
        )

    def to_json(self) -> dict[str, Any]:
        """JSON values of all tables."""
        return {
            "cells": [{"detector": d, "kind": kind, **one.to_json()} for (d, kind), one in self.cells.items()],
            "lost": [[d, kind, *one.lost] for (d, kind), one in self.cells.items() if one.lost],
            "doubtful": [[d, kind, *one.doubtful] for (d, kind), one in self.cells.items() if one.doubtful],
            "means": {name: vars(one) for name, one in self.means.items()},
            "groups": {t: {name: one.to_json() for name, one in groups.items()} for t, groups in self.groups.items()},
            "confidence": {name: one.to_json() for name, one in self.confidence.items()},
        }


def format_study(study: Study, *, gaps: bool) -> str:
    """All tables; the one by frames between the images where it is wanted."""
    align = "llrrlrrlrrr"
    header = ["detector", "list", *COMPARISON_HEADER]
    rows = [[*names, *comparison_cells(one)] for names, one in study.cells.items()]
    parts = [
        f"Three figures are {' / '.join(STATISTICS)}. {NOTES}",
        render_table(header, rows, align=align, title="Detectors and lists"),
        _lost_sentence(study),
        _means_table(study.means),
        _baselines_table(study.means["all"]),
    ]
    for title, groups in study.groups.items():
        if title != GAP_TITLE or gaps:
            rows = [[name, *comparison_cells(one)] for name, one in groups.items()]
            parts.append(render_table(["group", *COMPARISON_HEADER], rows, align=align[1:], title=f"By {title}"))
    tables = (_confidence_table, _curve_table, _reliability_table)
    return "\n\n".join([*parts, *(table(study.confidence) for table in tables)])


def _lost_sentence(study: Study) -> str:
    def listed(name: str) -> str:
        found = {names: getattr(one, name) for names, one in study.cells.items()}
        return "; ".join(f"{d}, {kind} ({', '.join(keys)})" for (d, kind), keys in found.items() if keys) or "none"

    return (
        f"Below the best baseline by more than {-TOLERATED:g} point: {listed('lost')}.\n\n"
        f"Not so, but the interval's lower end is below {TOLERATED_LOW:g}: {listed('doubtful')}."
    )


def _means_table(means: Mapping[str, Mean]) -> str:
    rows = [
        [
            *(name, str(one.cells), str(one.lists), _figures(one.figures)),
            *(_interval(one.against_best[statistic]) for statistic in COMPARED),
            _harmful(one.harmful, one.answers),
        ]
        for name, one in means.items()
    ]
    header = ["lists", "rows above", "number", "filter", "mAP@20 against the best of each row", "AUC@5", "harmful"]
    return render_table(header, rows, title="Means over the rows above")


def _baselines_table(mean: Mean) -> str:
    rows = [[name, *(_interval(values[statistic]) for statistic in COMPARED)] for name, values in mean.against.items()]
    return render_table(["against", *COMPARED], rows, title="Against one baseline throughout, mean over all rows")


def _confidence_table(confidence: Mapping[str, ConfidenceQuality]) -> str:
    rows = [
        [
            *(name, str(one.answers), str(one.known), _number(one.auroc), _number(one.ece), str(one.usable)),
            *(_number(share, 100.0, 1, " %") for share in (one.right_where_usable, one.kept_of_right)),
        ]
        for name, one in confidence.items()
    ]
    header = [
        "detector",
        "answers",
        "with a pose",
        "AUROC",
        "ECE",
        "usable",
        "right where usable",
        "usable where right",
    ]
    return render_table(header, rows, title="Confidence (right = within 10°)")


def _curve_table(confidence: Mapping[str, ConfidenceQuality]) -> str:
    rows = [
        [name, *(f"{_number(right, 100.0, 1)} · {_number(kept, 100.0, 1)}" for right, kept in quality.curve)]
        for name, quality in confidence.items()
    ]
    header = ["detector", *(f"from {limit}" for limit in CONFIDENCE_LIMITS)]
    title = "Right where the confidence is at least so much, % · of the right poses, those that are kept, %"
    return render_table(header, rows, title=title)


def _reliability_table(confidence: Mapping[str, ConfidenceQuality]) -> str:
    rows = [
        [name, f"{one.probability:.2f}", f"{one.share_right:.2f}", str(one.matches)]
        for name, quality in confidence.items()
        for one in quality.bins
    ]
    return render_table(["detector", "confidence", "share right", "answers"], rows, title="Reliability")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("input_kinds", __doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("bundles", metavar="FOLDER", nargs="+", type=Path, help="folders of scene bundles, or bundles")
    parser.add_argument("--detectors", nargs="+", metavar="NAME", help="these alone, as the bundles' names have them")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="these alone")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="of lists (default: all)")
    parser.add_argument("--gaps", nargs="+", type=int, metavar="N", help="frames between the images of a pair")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="runs of what draws by a seed (default 1)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default 1)")
    parser.add_argument("--store", metavar="DIR", help="keep results here, and take from here what is known")
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write all figures here")
    return run_study(run, parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Print all tables."""
    chosen = (options.detectors, options.scenes, options.per_scene, options.seed, options.gaps)
    scenes = open_detector_scenes(options.bundles, *chosen)
    kinds = [KINDS[name] for name in dict.fromkeys(options.kinds)]
    store = ResultStore(options.store)
    cells = run_cells(scenes, kinds, options.model, store, seeds=options.seeds, workers=options.workers)
    if not cells:
        raise DatasetError(f"{', '.join(map(str, options.bundles))}: no list of the kinds {', '.join(options.kinds)}")
    study = Study.of(cells)
    print(format_study(study, gaps=options.gaps is not None))
    if options.json is not None:
        asked = {"per_scene": options.per_scene, "seed": options.seed, "seeds": options.seeds, "gaps": options.gaps}
        content = {"filter": ProductMethod("product", model=options.model).settings(), "options": asked}
        with replaced_when_done(options.json) as temporary:
            temporary.write_text(json.dumps({**content, **study.to_json()}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
