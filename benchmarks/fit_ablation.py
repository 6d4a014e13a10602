"""What each piece of the robust fit is worth: ``python -m benchmarks.fit_ablation BUNDLES``.

The networks score every pair once; then the fit runs as users get it, and with one thing changed at a time. Each row
has its difference to the fit as it is, on the same pairs and the same draws of the bootstrap. A second table tells
where the answers came from, and how often each origin is right. Times are the processor's, on one thread; beside each
stands what the fit and the networks that it asked take together, as a multiple of USAC_MAGSAC's 5000 iterations at half
a pixel on the same list, whose own answers are the last row: the rows are a curve of accuracy over time. ``--kinds``
makes lists of the raw matches first, as users do; every scene counts once for each detector and kind. ``--variants``
runs some rows alone.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from tqdm import tqdm

from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.metrics import (
    FAILURE_DEG,
    POSE_STATISTICS,
    FloatArray,
    mean_over_scenes,
    paired_bootstrap_interval,
)
from mgca_filter.export.choice_fit import evidence_behind, filters_as_asked
from mgca_filter.fit.evidence import Evidence, gather_before
from mgca_filter.fit.robust_fit import PLAN, POSELIB, Plan, Search, TwoViewModel
from mgca_filter.fit.sources import Proposal
from mgca_filter.geometry.epipolar import pose_error_deg
from mgca_filter.inputs.options import FilterOptions
from mgca_filter.inputs.pair import prepare_pair
from mgca_filter.match_filter import MatchFilter
from mgca_filter.tables import render_table

from .match_lists import KINDS, open_detector_scenes
from .speed import MAGSAC_OPTIONS, answer_error_deg, magsac
from .study import match_pair, run_study, study_parser

STATISTICS = ("mAP@5", "mAP@20", "AUC@5")
AS_IT_IS = "the fit as it is"
REPLACED = "USAC_MAGSAC, 5000 iterations"
RIGHT_DEG = 10.0


def _each_stage(change: Callable[[Sequence[Proposal]], Iterable[Proposal]]) -> Plan:
    """The plan with the sources of every stage changed."""
    before, first, second = (tuple(change(stage)) for stage in (PLAN.before, PLAN.first, PLAN.second))
    return replace(PLAN, before=before, first=first, second=second)


def _without(*names: str) -> Plan:
    """The plan without the sources of these names."""
    return _each_stage(lambda stage: (proposal for proposal in stage if proposal.name not in names))


def _drawing(factor: float) -> Plan:
    """The plan with so many times the samples."""
    return _each_stage(lambda stage: (replace(one, iterations=int(factor * one.iterations)) for one in stage))


@dataclass(frozen=True)
class Variant:
    """A fit with one thing changed: the plan, the options, whether it may end before the network, or who is asked.

    Attributes:
        looks: which of the evidences behind the networks the fit is given, in turn, until one settles it; None = all.
    """

    plan: Plan = PLAN
    options: FilterOptions = FilterOptions()
    early_end: bool = True
    looks: tuple[int, ...] | None = None


VARIANTS = {
    AS_IT_IS: Variant(),
    "no end before the network": Variant(early_end=False),
    "all sources always": Variant(replace(PLAN, settle=False), early_end=False),
    "the first sources alone": Variant(replace(PLAN, second=())),
    "both networks always": Variant(looks=(-1,)),
    "the fast network alone": Variant(looks=(0,)),
    "without the network E": Variant(_without("network"), early_end=False),
    "without runs on the list": Variant(_without("list", "list, 1 px", "list order"), early_end=False),
    "without runs on what is accepted": Variant(_without("accepted"), early_end=False),
    "without runs in the order of the scores": Variant(_without("score order", "score order, all"), early_end=False),
    "a quarter of the samples": Variant(_drawing(0.25)),
    "half the samples": Variant(_drawing(0.5)),
    "twice the samples": Variant(_drawing(2.0)),
    "without the twin under the plane": Variant(replace(PLAN, twins=False)),
    "without the last refinement": Variant(replace(PLAN, last_refinement=False)),
    "the best explanation, not the expected best": Variant(replace(PLAN, expected=False)),
    "PoseLib among the sources": Variant(replace(PLAN, second=(*PLAN.second, POSELIB))),
    "MAGSAC alone": Variant(options=FilterOptions(method="magsac"), early_end=False),
    "PROSAC alone": Variant(options=FilterOptions(method="prosac"), early_end=False),
    "the fast network, the first sources, a quarter of the samples": Variant(
        replace(_drawing(0.25), second=()), looks=(0,)
    ),
}


@dataclass(frozen=True)
class ScoredPair:
    """A pair behind the networks: what the fit sees before them, and after each.

    Attributes:
        network_ms: what the networks up to each took together.
    """

    pair: ScenePair
    before: Evidence
    after: tuple[Evidence, ...]
    network_ms: tuple[float, ...]
    coefficients: Mapping[str, Sequence[float]]

    @classmethod
    def of(cls, pair: ScenePair, filters: Sequence[MatchFilter]) -> ScoredPair:
        """Run the networks once; ``filters`` are over the networks as they are asked."""
        asked = match_pair(pair)
        prepared = prepare_pair(asked)
        results = [match_filter.filter_many([asked])[0] for match_filter in filters]
        after = tuple(evidence_behind(*behind, prepared) for behind in zip(results, filters))
        network_ms = tuple(result.info["timings_ms"]["network"] for result in results)
        return cls(pair, gather_before(prepared), after, network_ms, filters[-1].metadata.choice)

    def fit(self, variant: Variant) -> tuple[TwoViewModel | None, float]:
        """The model that a variant finds, and the milliseconds of the networks that it asked."""
        search = Search(self.before, self.coefficients, variant.options, variant.plan)
        model = search.before_network() if variant.early_end else None
        if model is not None:
            return model, 0.0
        looks = list(zip(self.after, self.network_ms))
        *looks, (last, all_ms) = looks if variant.looks is None else [looks[i] for i in variant.looks]
        for evidence, ms in looks:
            model = search.after_first_look(evidence)
            if model is not None:
                return model, ms
        return search.with_network(last), all_ms

    def error_deg(self, model: TwoViewModel | None) -> float:
        """Pose error, degrees; 180 without a model."""
        if model is None:
            return FAILURE_DEG
        return pose_error_deg(model.answer.R, model.answer.t, self.pair.R, self.pair.t)


@dataclass
class Times:
    """Milliseconds of one variant, an entry an answer: of the fit, and of the networks that it asked."""

    fit: list[float] = field(default_factory=list)
    networks: list[float] = field(default_factory=list)

    def cells(self, magsac_ms: float) -> list[str]:
        """Mean time of the fit, and of all as a multiple of MAGSAC's mean."""
        fit_ms = float(np.mean(self.fit))
        return [f"{fit_ms:.1f}", f"{(fit_ms + float(np.mean(self.networks))) / magsac_ms:.2f}"]


def format_study(errors: Mapping[str, Mapping[str, FloatArray]], times: Mapping[str, Times]) -> str:
    """A row a variant: means over scenes, differences to the fit as it is, times.

    Args:
        errors: by variant and scene, (S, P) degrees of S seeds and P pairs.
        times: by variant; those of :data:`REPLACED` are what the others are compared with.
    """
    magsac_ms = float(np.mean(times[REPLACED].fit))
    body = []
    for name, by_scene in errors.items():
        cells = [f"{100 * mean_over_scenes(POSE_STATISTICS[s], by_scene):.1f}" for s in STATISTICS]
        for statistic in ("mAP@20", "AUC@5"):
            if name == AS_IT_IS:
                cells.append("")
                continue
            reference = errors[AS_IT_IS]
            function = POSE_STATISTICS[statistic]
            difference = mean_over_scenes(function, by_scene) - mean_over_scenes(function, reference)
            interval = paired_bootstrap_interval(by_scene, reference, function)
            low, middle, high = (100 * value for value in (interval[0], difference, interval[1]))
            cells.append(f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]")
        body.append([name, *cells, *times[name].cells(magsac_ms)])
    header = ["", *STATISTICS, "difference in mAP@20", "in AUC@5", "fit, ms", "with networks, of MAGSAC's time"]
    return render_table(header, body)


def origin_table(models: Sequence[TwoViewModel | None], errors_deg: Sequence[float]) -> str:
    """Where the answers came from, the most frequent first, and how often each is within 10 degrees."""
    names = ["none" if model is None else f"{model.answer.origin} ({model.ended})" for model in models]
    counts = {name: names.count(name) for name in dict.fromkeys(names)}
    body = []
    for name in sorted(counts, key=lambda name: -counts[name]):
        right = [error < RIGHT_DEG for own, error in zip(names, errors_deg) if own == name]
        body.append([name, f"{100.0 * counts[name] / len(names):.0f} %", f"{100.0 * np.mean(right):.0f} %"])
    return render_table(["origin of the answer", "of the pairs", "right within 10 deg"], body)


def run(options: argparse.Namespace) -> int:
    """Print both tables."""
    filters = filters_as_asked(options.model)
    variants = {name: VARIANTS[name] for name in (AS_IT_IS, *options.variants)}
    drawn = open_detector_scenes(options.bundles, options.detectors, None, options.per_scene, options.seed)
    lists = [(scene, kind, scene.lists(KINDS[kind])) for scene in drawn for kind in options.kinds]
    errors: dict[str, dict[str, list[list[float]]]] = {name: {} for name in (*variants, REPLACED)}
    times = {name: Times() for name in errors}
    models: list[TwoViewModel | None] = []
    first_errors: list[float] = []
    for scene, kind, selection in tqdm(lists, disable=None, unit=" lists of a scene"):
        for index in () if selection is None else selection.indices:
            scored = ScoredPair.of(selection.source[index], filters)
            key = f"{scene.scene}, {scene.detector}, {kind}"
            for name, variant in variants.items():
                of_scene = errors[name].setdefault(key, [[] for _ in options.seeds])
                for row, seed in zip(of_scene, options.seeds):
                    started = time.process_time()
                    model, network_ms = scored.fit(replace(variant, options=replace(variant.options, seed=seed)))
                    times[name].fit.append(1e3 * (time.process_time() - started))
                    times[name].networks.append(network_ms)
                    row.append(scored.error_deg(model))
                    if name == AS_IT_IS:
                        models.append(model)
                        first_errors.append(row[-1])
            started = time.process_time()
            answer = magsac(scored.pair, *MAGSAC_OPTIONS)
            times[REPLACED].fit.append(1e3 * (time.process_time() - started))
            times[REPLACED].networks.append(0.0)
            error = answer_error_deg(scored.pair, answer)
            for row in errors[REPLACED].setdefault(key, [[] for _ in options.seeds]):
                row.append(FAILURE_DEG if error is None else error)
    arrays = {name: {scene: np.array(rows) for scene, rows in by_scene.items()} for name, by_scene in errors.items()}
    print(format_study(arrays, times))
    print("\n" + origin_table(models, first_errors))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 = done, 2 = a file or option that cannot be used."""
    parser = study_parser("fit_ablation", __doc__)
    parser.add_argument("bundles", metavar="BUNDLES", nargs="+", help="scene bundles, files or folders")
    parser.add_argument("--detectors", nargs="+", metavar="NAME", help="these alone, as the bundles' names have them")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=["raw", "learned"], help="of lists")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), help="rows (all)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="SEED", help="of the fit (default 0)")
    return run_study(run, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
