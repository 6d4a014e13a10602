"""How sure is a pose? Fits the confidence of the robust fit, and writes all of its coefficients into a model file.

``python -m mgca_filter.export.choice_fit BUNDLES [BUNDLES …] --photos FOLDER --write`` runs the fit on lists of every
kind that users have (raw, cross-checked, ratio-tested), of every detector that the folders hold, and on photographs
that have no pose to find: of different places, and of one place without overlap. A logistic regression on what the
fit measures of its answer gives the probability that the pose is within 10 degrees; folds that keep scenes together
tell how well. The coefficients go to ``fit/choice.json`` and, with ``--write``, into the model file and the weights
beside it.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ..data.scene_bundle import SceneBundle, ScenePair, scene_and_detector
from ..data.source import detect
from ..evaluation.environment import one_thread
from ..evaluation.metrics import FAILURE_DEG
from ..features import create_detector, match_features
from ..fit import choice
from ..fit.choice import EARLY_FEATURES, FEATURES
from ..fit.evidence import Evidence, gather_before, gather_scored
from ..fit.robust_fit import PLAN, Search, TwoViewModel
from ..geometry.epipolar import pose_error_deg
from ..inference.model_file import SUMS_NAME, record_checksums
from ..inputs.pair import MatchPair, PairInput, prepare_pair
from ..match_filter import MatchFilter, find_models
from ..result import FilterResult
from .calibration_fit import expected_calibration_error
from .pairs_apart import CROSS_RATIO, lists_of, parts_of_photographs, plausible_camera, rendered_apart

Array = NDArray[np.float64]

COEFFICIENTS_FILE = Path(choice.__file__).with_name("choice.json")
RIGHT_DEG = 10.0
FOLDS = 5
KINDS = ("raw", "cross", "ratio", "cross and ratio")
PLAIN_RATIO = 0.75
# "ok" is said from the confidence on at which this share is right, and nothing below the second, which is chance's.
OK_PRECISION, LEAST_CONFIDENCE = 0.96, 0.1
# Of the pairs of one place without overlap this share may pass for "ok".
APART_OK = 0.05
# Of the poses that the bundles of a scene vouch for, so many of the easy ones agree with them (``QUALITY.csv``).
LEAST_QUALITY = 0.92
# What the lists of pairs without overlap are made with: as ``match_images`` does, and another kind of corners.
APART_DETECTORS = (("rootsift", 4000), ("orb", 4000))
APART = "apart"
_RIDGE, _NEWTON_STEPS = 3e-3, 30
# Pairs of different places are rarer here than anywhere else: each counts for so many.
_UNRELATED_WEIGHT = 1.0


@dataclass(frozen=True)
class Sample:
    """What one search measured: by names of :data:`FEATURES`, whether the pose is right, and where it comes from."""

    features: Array
    right: bool
    group: str
    early: bool


def kinds_of(pair: ScenePair) -> Iterator[tuple[str, ScenePair]]:
    """The lists that users make of the raw one-way matches of a pair, by kind; those of eight matches or more."""
    ratio = pair.attributes.ratio
    masks = {"raw": np.ones(len(pair.points1), dtype=bool), "cross": pair.mutual}
    if ratio is not None:
        masks |= {"ratio": ratio < PLAIN_RATIO, "cross and ratio": pair.mutual & (ratio < CROSS_RATIO)}
    for kind, kept in masks.items():
        if np.count_nonzero(kept) < 8:
            continue
        attributes = pair.attributes.take(kept)
        if kind != "raw":  # whoever filters tells of no lost alternatives
            attributes = replace(attributes, best=np.ones(np.count_nonzero(kept), dtype=bool))
        yield (
            kind,
            replace(
                pair,
                points1=pair.points1[kept],
                points2=pair.points2[kept],
                attributes=attributes,
                mutual=pair.mutual[kept],
            ),
        )


def unrelated_pairs(folder: Path, count: int, seed: int) -> Iterator[tuple[str, MatchPair]]:
    """SIFT matches of ``count`` pairs of photographs of a folder, all of different places, under a plausible camera."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".png"))
    pairs = list(combinations(paths, 2))
    features = {path: detect(path) for path in paths}
    for i in np.random.default_rng(seed).permutation(len(pairs))[:count]:
        one, two = (features[path] for path in pairs[i])
        matches = match_features(one, two)
        if matches.attributes.ratio is None or one.image_size is None or two.image_size is None:
            continue
        for kind, kept in (
            ("raw", np.ones(len(matches.index1), dtype=bool)),
            ("cross and ratio", matches.mutual & (matches.attributes.ratio < CROSS_RATIO)),
        ):
            attributes = matches.attributes.take(kept)
            points = one.points[matches.index1[kept]], two.points[matches.index2[kept]]
            cameras = (plausible_camera(one.image_size), plausible_camera(two.image_size))
            yield f"{pairs[i][0].stem} {kind}", MatchPair(*points, None, *cameras, attributes=attributes)


def apart_lists(folder: Path, count: int, seed: int) -> Iterator[tuple[str, MatchPair]]:
    """Lists of pairs without overlap: ``count`` photographs of a folder cut in two, half as many of rendered worlds.

    Yields:
        The group, which begins with :data:`APART`, and the list.
    """
    detectors = [create_detector(*settings) for settings in APART_DETECTORS]
    for pair in chain(parts_of_photographs(folder, count, seed), rendered_apart(folder, count // 2, seed)):
        for detector in detectors:
            for _, matches in lists_of(pair, detector):
                yield f"{APART} {pair.place}", matches


def samples_of(
    pair: MatchPair, pose: tuple[Array, Array] | None, group: str, filters: Sequence[MatchFilter]
) -> list[Sample]:
    """What the search measures of its answer, before the network, where it settles, and with all sources.

    Args:
        pair, pose, group: the list, its true pose, and the name that is kept out of one fold.
        filters: as :func:`filters_as_asked` gives them.
    """
    prepared = prepare_pair(pair)
    *looks, last = (scored_evidence(one, pair, prepared) for one in filters)
    found = []
    for plan in (PLAN, replace(PLAN, settle=False)):
        search = Search(gather_before(prepared), filters[-1].metadata.choice, filters[-1].options, plan)
        if plan is PLAN:
            search.before_network()
            found.append(_sample(search.current(), pose, group, early=True))
        settled = next((model for model in map(search.after_first_look, looks) if model is not None), None)
        model = search.with_network(last) if settled is None else settled
        found.append(_sample(model, pose, group, early=False))
    return [sample for sample in found if sample is not None]


def filters_as_asked(model: Path | None) -> list[MatchFilter]:
    """Filters of full effort over the networks of a filter as they are asked: each over those before and one more."""
    models = ("fast", None) if model is None else (model,)
    return [MatchFilter(model=name, effort="full") for name in models]


def scored_evidence(match_filter: MatchFilter, pair: MatchPair, prepared: PairInput) -> Evidence:
    """What the fit knows of a pair when the networks of a filter of full effort have scored it."""
    return evidence_behind(match_filter.filter_many([pair])[0], match_filter, prepared)


def evidence_behind(result: FilterResult, match_filter: MatchFilter, prepared: PairInput) -> Evidence:
    """What the fit knew of a pair when a filter of full effort answered."""
    margins = result.info["logits"] - np.float32(match_filter.metadata.decision_threshold)
    return gather_scored(
        prepared, result.info["network_rows"], result.scores, margins, result.info["network_essential"]
    )


def _sample(model: TwoViewModel | None, pose: tuple[Array, Array] | None, group: str, early: bool) -> Sample | None:
    if model is None or model.judgement is None:
        return None
    error = FAILURE_DEG if pose is None else pose_error_deg(model.answer.R, model.answer.t, *pose)
    names = EARLY_FEATURES if early else FEATURES
    features = np.array([model.judgement.features[name] for name in names])
    return Sample(features, error < RIGHT_DEG, group, early)


def fit_logistic(features: Array, right: NDArray[np.bool_], weight: Array) -> Array:
    """Weights and offset (D + 1,) of a logistic regression, with a ridge on standardised features (N, D)."""
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    design = np.column_stack([(features - mean) / scale, np.ones(len(features))])
    penalty = _RIDGE * len(features) * np.diag([*([1.0] * features.shape[1]), 0.0])
    w = np.zeros(design.shape[1])
    for _ in range(_NEWTON_STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(design @ w, -30.0, 30.0)))
        gradient = design.T @ (weight * (p - right)) + penalty @ w
        hessian = (design * (weight * p * (1.0 - p))[:, None]).T @ design + penalty + 1e-9 * np.eye(len(w))
        step = np.linalg.solve(hessian, gradient)
        w = w - step
        if np.abs(step).max() < 1e-8:
            break
    return np.append(w[:-1] / scale, w[-1] - float((w[:-1] * mean / scale).sum()))


def probabilities(weights: Array, features: Array) -> Array:
    """Confidence (N,) of features (N, D)."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(features @ weights[:-1] + weights[-1], -40.0, 40.0))))


def cross_validated(features: Array, right: NDArray[np.bool_], weight: Array, groups: Sequence[str]) -> Array:
    """Confidence (N,) of every sample by a regression that saw no sample of its group."""
    names = sorted(set(groups))
    fold_of = {name: i % FOLDS for i, name in enumerate(np.random.default_rng(0).permutation(names))}
    fold = np.array([fold_of[name] for name in groups])
    p = np.zeros(len(right))
    for k in range(FOLDS):
        train, test = fold != k, fold == k
        if test.any():
            p[test] = probabilities(fit_logistic(features[train], right[train], weight[train]), features[test])
    return p


def area_under_roc(p: Array, right: NDArray[np.bool_]) -> float:
    """Probability that a right pose has the higher confidence."""
    rank = np.argsort(np.argsort(p, kind="stable"), kind="stable") + 1.0
    positive = np.count_nonzero(right)
    return float((rank[right].sum() - positive * (positive + 1) / 2) / max(positive * (len(right) - positive), 1))


def usable_from(p: Array, right: NDArray[np.bool_]) -> float:
    """The least confidence above which :data:`OK_PRECISION` of the poses are right; rounded up to a hundredth."""
    for limit in np.arange(0.3, 0.95, 0.01):
        if right[p >= limit].mean() >= OK_PRECISION:
            return float(round(limit, 2))
    return 0.95


def sound_scenes(folder: Path) -> set[str] | None:
    """Scenes whose poses can be trusted, by the ``QUALITY.csv`` of a folder; None where it has none."""
    table = folder / "QUALITY.csv"
    if not table.is_file():
        return None
    with table.open(encoding="utf-8", newline="") as file:
        return {row["scene"] for row in csv.DictReader(file) if float(row["share_within_2px"] or 1.0) >= LEAST_QUALITY}


def describe_verdicts(p: Array, right: NDArray[np.bool_], least: float, usable: float) -> str:
    """What the two limits of the confidence do, in a line."""
    said, withheld = p >= usable, p < least
    return (
        f"ok from {usable:.2f}: {100.0 * right[said].mean():.1f} % of these right, {100.0 * said[right].mean():.1f} % "
        f"of the right ones; withheld below {least}: {100.0 * withheld[right].mean():.2f} % of the right ones, "
        f"{100.0 * withheld[~right].mean():.1f} % of the wrong ones"
    )


def describe_apart(p: Array, right: NDArray[np.bool_], apart: NDArray[np.bool_], usable: float) -> str:
    """How many lists without overlap are "ok", and the limit of the confidence that would make it few, in a line."""
    limit = max(float(np.quantile(p[apart], 1.0 - APART_OK)), usable)
    return (
        f"without overlap: {100.0 * (p[apart] >= usable).mean():.1f} % of {np.count_nonzero(apart)} lists are ok; "
        f"at most {100.0 * APART_OK:.0f} % from {limit:.2f} on, with {100.0 * (p[right] >= limit).mean():.1f} % of the "
        "right ones"
    )


def collect(options: argparse.Namespace, filters: Sequence[MatchFilter]) -> list[Sample]:
    """Samples of all lists."""
    sound = next((s for s in map(sound_scenes, options.bundles) if s is not None), None)
    samples: list[Sample] = []
    paths = [path for folder in options.bundles for path in sorted(folder.glob("*.npz"))]
    for path in tqdm(paths, unit=" bundles", disable=None):
        scene = scene_and_detector(path.stem)[0]
        if "lightglue" in path.stem or scene in options.exclude or (sound is not None and scene not in sound):
            continue
        bundle = SceneBundle(path)
        chosen = np.random.default_rng(options.seed).permutation(len(bundle))[: options.per_scene]
        for index in sorted(chosen):
            raw = bundle[int(index)]
            for _, pair in kinds_of(raw):
                cameras = (pair.K1, pair.K2, None, None, pair.image_size1, pair.image_size2)
                matches = MatchPair(pair.points1, pair.points2, None, *cameras, pair.attributes)
                samples += samples_of(matches, (pair.R, pair.t), scene, filters)
    if options.photos is not None:
        for name, matches in unrelated_pairs(options.photos, options.unrelated, options.seed):
            samples += samples_of(matches, None, f"unrelated {name}", filters)
        for group, matches in apart_lists(options.photos, options.apart, options.seed):
            samples += samples_of(matches, None, group, filters)
    return samples


def save_samples(path: Path, samples: Sequence[Sample]) -> None:
    """Write samples, for a second fit to the same."""
    width = len(FEATURES)
    features = np.stack([np.pad(sample.features, (0, width - len(sample.features))) for sample in samples])
    facts = {name: np.array([getattr(sample, name) for sample in samples]) for name in ("right", "group", "early")}
    np.savez_compressed(path, features=features, **facts)  # type: ignore[arg-type]  # its stub takes names for options


def load_samples(path: Path) -> list[Sample]:
    """What :func:`save_samples` wrote."""
    with np.load(path, allow_pickle=False) as data:
        columns = zip(data["features"], data["right"], data["group"], data["early"])
        return [
            Sample(row[: len(EARLY_FEATURES) if early else len(FEATURES)], bool(right), str(group), bool(early))
            for row, right, group, early in columns
        ]


def fit(samples: Sequence[Sample], early: bool) -> tuple[list[float], Array, NDArray[np.bool_]]:
    """Coefficients, and the cross-validated confidence of every sample with whether it is right."""
    chosen = [sample for sample in samples if sample.early == early]
    features = np.stack([sample.features for sample in chosen])
    right = np.array([sample.right for sample in chosen])
    weight = np.array([_UNRELATED_WEIGHT if sample.group.startswith("unrelated") else 1.0 for sample in chosen])
    p = cross_validated(features, right, weight, [sample.group for sample in chosen])
    return [round(float(value), 5) for value in fit_logistic(features, right, weight)], p, right


def write_into(path: Path, coefficients: dict[str, list[float]]) -> None:
    """Put coefficients into the metadata of an ONNX file and of the weights beside it, and renew their checksums."""
    import onnx
    from safetensors import safe_open
    from safetensors.torch import load_file, save_file

    text = json.dumps(coefficients)
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {p.key: p.value for p in model.metadata_props} | {"choice": text})
    onnx.save(model, str(path))
    weights = path.with_suffix(".safetensors")
    if weights.is_file():
        with safe_open(str(weights), "pt") as file:
            metadata = dict(file.metadata())
        save_file(load_file(str(weights)), str(weights), metadata | {"choice": text})
        weights.chmod(0o644)
    if (path.parent / SUMS_NAME).is_file():
        record_checksums(path.parent)


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit, tell how well, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", nargs="*", type=Path, help="folders of scene bundles, of any detectors")
    parser.add_argument("--per-scene", type=int, default=2, metavar="N", help="pairs of each bundle (default 2)")
    parser.add_argument("--photos", type=Path, metavar="FOLDER", help="photographs, all of different places")
    parser.add_argument("--unrelated", type=int, default=150, metavar="N", help="pairs of photographs (default 150)")
    parser.add_argument(
        "--apart",
        type=int,
        default=80,
        metavar="N",
        help="photographs cut in two, and half as many rendered pairs, of one place without overlap (default 80)",
    )
    parser.add_argument("--exclude", nargs="*", default=[], metavar="SCENE", help="scenes of doubtful poses")
    parser.add_argument(
        "--model",
        type=Path,
        metavar="FILE",
        help="whose scores are used (default: the published ones, as they are asked)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn")
    parser.add_argument(
        "--samples", type=Path, metavar="FILE.npz", help="keep what was measured here, or take it from it"
    )
    parser.add_argument("--write", action="store_true", help="put the coefficients into the model files as well")
    options = parser.parse_args(arguments)
    coefficients = choice.fitted_coefficients()
    samples: list[Sample] = []
    if options.samples is not None and options.samples.is_file():
        samples = load_samples(options.samples)
    elif options.bundles:
        with one_thread():
            samples = collect(options, filters_as_asked(options.model))
        if options.samples is not None:
            save_samples(options.samples, samples)
    if samples:
        for name, early in (("confidence", False), ("early_confidence", True)):
            coefficients[name], p, right = fit(samples, early)
            error = expected_calibration_error(p, right)
            area, share = area_under_roc(p, right), 100.0 * right.mean()
            print(
                f"{name}: {len(p)} lists, {share:.1f} % right, area under ROC {area:.3f}, calibration error {error:.3f}"
            )
            if not early:
                coefficients["verdict"] = [LEAST_CONFIDENCE, usable_from(p, right)]
                print(describe_verdicts(p, right, *coefficients["verdict"]))
                apart = np.array([sample.group.startswith(APART) for sample in samples if not sample.early])
                if apart.any():
                    print(describe_apart(p, right, apart, coefficients["verdict"][1]))
        text = json.dumps(choice.check_coefficients(coefficients), indent=1)
        COEFFICIENTS_FILE.write_text(text + "\n", encoding="utf-8")
    if options.write:
        for path in find_models(options.model):
            write_into(path, coefficients)
    return 0


if __name__ == "__main__":
    sys.exit(main())
