"""How fast is the filter here? ``python -m benchmarks.speed [--threads 2] [--bundle FILE --pair 0]`` prints ratios.

All calls run in turn in one process, on as many threads, on the raw SIFT matches of the example pair (or of a pair of
a scene bundle); medians. Whole calls have the pose error of their answer beside them. Cold start and memory are
measured in processes of their own. ``benchmarks.profile_network`` tells where the milliseconds of the network go.

``--bundles FOLDER …`` prints another table instead: on one thread, the whole call on the lists that users make of the
matches, and what remains of it without the network, as multiples of USAC_MAGSAC's 5000 iterations on the same list.
Raw lists are told apart by whether MAGSAC's first short run explains them, so that the network is not asked. Of
filtered lists of which most is right a second table tells the ratio by length. Easy lists alone, in a few minutes:

    python -m benchmarks.speed --bundles FOLDER --detectors SIFT-2000 --kinds cross-ratio --per-scene 1
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from mgca_filter import BackendError, FilterResult, MatchFilter, match_images, model_path
from mgca_filter.data.scene_bundle import SceneBundle, ScenePair
from mgca_filter.data.source import read_image
from mgca_filter.evaluation.environment import CpuMeter, one_thread
from mgca_filter.evaluation.metrics import FAILURE_DEG, true_matches
from mgca_filter.evaluation.pairs import sample_pairs
from mgca_filter.fit.evidence import FIRM_MATCHES
from mgca_filter.fit.robust_fit import pose_from_essential
from mgca_filter.geometry.cameras import mean_focal_length, normalize_points
from mgca_filter.geometry.epipolar import essential_from_pose, pose_error_deg
from mgca_filter.inference import open_backend
from mgca_filter.inference.onnxruntime_ import THREADS_VARIABLE
from mgca_filter.tables import MISSING, markdown_head, markdown_row, render_table

from .match_lists import KINDS, RAW, DetectorScene, open_detector_scenes
from .study import match_pair

FloatArray = NDArray[np.float64]

EXAMPLES = Path(__file__).resolve().parent.parent / "examples" / "images"
MAGSAC_ITERATIONS = (1000, 5000, 100_000)  # OpenCV's default; the evaluation's baselines; enough for one right in ten
MAGSAC_OPTIONS = (5000, 0.5, 0.9999)
"""Iterations, threshold in pixels and confidence of the MAGSAC that lists are timed against."""
MEMORY_COUNTS = (500, 2000, 8000)

COLD_START = """
import sys, time
started = time.perf_counter()
import mgca_filter
imported = time.perf_counter()
import numpy as np
points = np.random.default_rng(0).random((2, 500, 2)) * 500
mgca_filter.filter_matches(*points, None, backend=sys.argv[1])
first = time.perf_counter()
mgca_filter.filter_matches(*points, None, backend=sys.argv[1])
print(imported - started, first - imported, time.perf_counter() - first)
"""
# The peak from /proc (Linux): that of getrusage starts at the parent's.
MEMORY = """
import re, sys
import numpy as np
import mgca_filter
from mgca_filter.inference import open_backend
def peak_mib():
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1]) / 1024
before = peak_mib()
backend, count = open_backend(mgca_filter.model_path(), sys.argv[1]), int(sys.argv[2])
rng = np.random.default_rng(0)
backend.infer(rng.random((1, count, 4), dtype=np.float32), rng.random((1, count, 8), dtype=np.float32))
print(peak_mib() - before)
"""


@dataclass(frozen=True)
class RawPair:
    """Raw matches as a user holds them, their pixels (M, 2) under K (3, 3), and the true pose R (3, 3), t (3,)."""

    arguments: tuple[Any, Any, Any]
    attributes: Any
    points1: FloatArray
    points2: FloatArray
    K1: FloatArray
    K2: FloatArray
    R: FloatArray
    t: FloatArray

    @property
    def correspondences(self) -> FloatArray:
        """(M, 4) on the normalised image planes."""
        return np.hstack([normalize_points(self.points1, self.K1), normalize_points(self.points2, self.K2)])

    @property
    def inlier_share(self) -> float:
        """Share of the matches near their true epipolar lines."""
        return float(np.mean(true_matches(self.correspondences, essential_from_pose(self.R, self.t))))


def example_pair() -> RawPair:
    """SIFT nearest neighbours of the example pair: cv2.KeyPoint and knnMatch rows."""
    truth = json.loads((EXAMPLES / "pair.json").read_text())
    K1, K2 = np.array(truth["K1"]), np.array(truth["K2"])
    image1, image2 = (read_image(EXAMPLES / truth[name]) for name in ("image1", "image2"))
    matched = match_images(image1, image2, detector="sift", max_keypoints=2000, K1=K1, K2=K2)
    points1 = np.array([matched.keypoints1[row[0].queryIdx].pt for row in matched.matches])
    points2 = np.array([matched.keypoints2[row[0].trainIdx].pt for row in matched.matches])
    arguments = (matched.keypoints1, matched.keypoints2, matched.matches)
    return RawPair(arguments, None, points1, points2, K1, K2, np.array(truth["R"]), np.array(truth["t"]))


def bundle_pair(path: Path, index: int) -> RawPair:
    """Raw matches of a pair of a scene bundle: arrays."""
    pair = SceneBundle(path)[index]
    arguments = (pair.points1, pair.points2, None)
    return RawPair(arguments, pair.attributes, pair.points1, pair.points2, pair.K1, pair.K2, pair.R, pair.t)


def magsac(
    pair: RawPair | ScenePair, iterations: int, threshold_px: float = 1.0, confidence: float = 0.999
) -> tuple[Any, Any]:
    """The call that the filter replaces, at one pixel unless told otherwise: E and mask."""
    return essential_magsac(pair.points1, pair.points2, pair.K1, pair.K2, iterations, threshold_px, confidence)


def essential_magsac(
    points1: FloatArray,
    points2: FloatArray,
    K1: FloatArray,
    K2: FloatArray,
    iterations: int,
    threshold_px: float,
    confidence: float,
) -> tuple[Any, Any]:
    """E and mask of matched pixels (N, 2) by USAC_MAGSAC on the normalised image planes."""
    x1, x2 = normalize_points(points1, K1), normalize_points(points2, K2)
    threshold = threshold_px / mean_focal_length(K1, K2)
    return cv2.findEssentialMat(x1, x2, np.eye(3), cv2.USAC_MAGSAC, confidence, threshold, iterations)


def answer_error_deg(pair: RawPair | ScenePair, answer: Any) -> float | None:
    """Pose error of what a whole call returned, 180 without a pose; None where it returns no geometry at all."""
    if isinstance(answer, FilterResult):
        pose = None if answer.R is None or answer.t is None else (answer.R, answer.t)
    elif isinstance(answer, tuple):
        E, mask = answer
        pose = (
            None
            if E is None
            else pose_from_essential(E[:3], pair.correspondences[mask.ravel() > 0], mean_focal_length(pair.K1, pair.K2))
        )
    else:
        return None
    return FAILURE_DEG if pose is None else pose_error_deg(*pose, pair.R, pair.t)


def full_calls(pair: RawPair) -> dict[str, Callable[[], Any]]:
    """What is compared, by name: whole calls on the raw matches."""
    filters = MatchFilter(backend="onnxruntime")
    known = {"K1": pair.K1, "K2": pair.K2, "attributes": pair.attributes}
    bare = (pair.points1, pair.points2, None)
    calls: dict[str, Callable[[], Any]] = {
        "filter_matches, ratio known": lambda: filters.filter(*pair.arguments, **known),
        "filter_matches, points only": lambda: filters.filter(*bare, K1=pair.K1, K2=pair.K2),
    }
    for iterations in MAGSAC_ITERATIONS:
        calls[f"findEssentialMat(USAC_MAGSAC), {iterations} iterations"] = partial(magsac, pair, iterations)
    calls["`paper` preset, torch eager, all raw matches"] = paper_pass(len(pair.points1))
    return calls


def paper_pass(count: int) -> Callable[[], Any]:
    """One forward pass of the reference design with random weights: its time counts, its answer means nothing."""
    import torch

    from mgca_filter.network import PRESETS, MGCANet

    network = MGCANet(PRESETS["paper"]).eval()
    inputs = torch.rand(1, count, 4) - 0.5, torch.rand(1, count, 8)

    def run() -> None:
        with torch.inference_mode():
            network(*inputs)

    return run


def network_input(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Correspondences (1, N, 4) and attributes (1, N, 8) at random: time does not depend on what they are."""
    rng = np.random.default_rng(0)
    return rng.random((1, count, 4), dtype=np.float32) - 0.5, rng.random((1, count, 8), dtype=np.float32)


def network_calls(count: int) -> dict[str, Callable[[], Any]]:
    """One forward pass of the shipped model in each runtime."""
    inputs = network_input(count)
    calls: dict[str, Callable[[], Any]] = {}
    for name in ("onnxruntime", "opencv", "torch"):
        try:
            backend = open_backend(model_path(), name)
        except BackendError as error:
            print(f"without {name}: {error}", file=sys.stderr)
            continue
        calls[name] = partial(backend.infer, *inputs)
    return calls


def median_ms(
    calls: dict[str, Callable[[], Any]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Median duration of each call; they take turns, so that a busy moment hits all."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            started = clock()
            call()
            if turn:  # the first one warms up
                times[name].append(1e3 * (clock() - started))
    return {name: float(np.median(values)) for name, values in times.items()}


def print_ratios(title: str, times: dict[str, float], errors_deg: dict[str, float | None] | None = None) -> None:
    """Milliseconds, each as a multiple of the first, and pose errors where they are given."""
    first = next(iter(times.values()))
    header = ["", "ms", "ratio", *([] if errors_deg is None else ["pose error"])]
    body = []
    for name, value in times.items():
        cells = [name, f"{value:.1f}", f"{value / first:.2f}"]
        if errors_deg is not None:
            error = errors_deg[name]
            cells.append(MISSING if error is None else f"{error:.1f}°")
        body.append(cells)
    print(f"\n{title}:\n\n{render_table(header, body)}")


def run_alone(program: str, *arguments: object) -> list[float]:
    """Numbers that a program prints in a fresh process."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return [float(word) for word in subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()]


def print_cold_start_and_memory(names: list[str]) -> None:
    """Seconds from import to the first answer, and how far the process grows at its peak."""
    print("\nCold start (seconds; best of three) and peak growth of the process, one pass over N matches (MiB):\n")
    counts = [f"N = {count}" for count in MEMORY_COUNTS]
    print(markdown_head(["backend", "import", "first call", "next call", *counts]))
    for name in names:
        start = min((run_alone(COLD_START, name) for _ in range(3)), key=lambda times: times[0] + times[1])
        memory = [run_alone(MEMORY, name, count)[0] for count in MEMORY_COUNTS]
        cells = [f"{value:.2f}" for value in start] + [f"{value:.0f}" for value in memory]
        print(markdown_row([name, *cells]))


@dataclass(frozen=True)
class ListTime:
    """Processor times of one list, on one thread, so that other programs do not count: of the filter's whole call, of
    its forward pass, and of USAC_MAGSAC at half a pixel; medians.

    ``network_ms`` is 0 where the search ended before the network; ``right_share`` is 0 … 1.
    """

    family: str
    matches: int
    right_share: float
    filter_ms: float
    network_ms: float
    magsac_ms: float

    @property
    def fit_ms(self) -> float:
        """The call without the forward pass: the matches read, the robust fit, the verdict."""
        return self.filter_ms - self.network_ms

    @property
    def group(self) -> str:
        """The one of :data:`RATIO_TARGETS` that the list belongs to."""
        return group_of(self.family, self.matches, self.right_share, self.network_ms > 0)


CLEAR_COUNTS, CLEAR_SHARE = (200, 1500), 0.7
RAW_NETWORK, RAW_EARLY, CLEAR, FILTERED = (
    *("raw, network needed", "raw, ended before the network"),
    *("filtered, 200 to 1500 matches, from 70 % right", "filtered, others"),
)
RATIO_TARGETS = {RAW_NETWORK: "0.6", RAW_EARLY: MISSING, CLEAR: "2", FILTERED: "5"}
"""Groups of lists, and the ratio to MAGSAC's time that none should pass."""


def group_of(family: str, matches: int, right_share: float, network: bool) -> str:
    """The one of :data:`RATIO_TARGETS` that a list belongs to, by whether a network was asked for it."""
    if family == RAW:
        return RAW_NETWORK if network else RAW_EARLY
    low, high = CLEAR_COUNTS
    return CLEAR if low <= matches <= high and right_share >= CLEAR_SHARE else FILTERED


LENGTHS = (350, 750, 1250, CLEAR_COUNTS[1] + 1)
"""Clear lists are told apart by their length: each is shorter than the first of these that it can be."""


def time_lists(
    scenes: Sequence[DetectorScene], repeats: int, model: str | None = None, kinds: Collection[str] = tuple(KINDS)
) -> list[ListTime]:
    """Times on every kind of list of every pair, or on some; lists of fewer than eight matches are left out."""
    match_filter = MatchFilter(model=model, backend="onnxruntime")
    lists = timed_lists(tqdm(scenes, disable=None, unit=" bundles"), kinds)
    return [time_list(match_filter, pair, family, repeats) for family, pair in lists]


def timed_lists(scenes: Iterable[DetectorScene], kinds: Iterable[str]) -> Iterator[tuple[str, ScenePair]]:
    """Family and pair of every list of these kinds; those of fewer than eight matches are left out."""
    for scene in scenes:
        for kind in (KINDS[name] for name in kinds):
            selection = scene.lists(kind)
            for pair in () if selection is None else sample_pairs([selection], len(selection)):
                if len(pair.points1) >= FIRM_MATCHES:
                    yield kind.family, pair


def time_list(match_filter: MatchFilter, pair: ScenePair, family: str, repeats: int) -> ListTime:
    """Times of one list."""
    given, network_shares = match_pair(pair), []

    def call() -> None:
        (result,) = match_filter.filter_many([given])
        taken = result.info["timings_ms"]
        network_shares.append(taken.get("network", 0.0) / taken["total"])

    calls: dict[str, Callable[[], Any]] = {"filter": call, "magsac": partial(magsac, pair, *MAGSAC_OPTIONS)}
    ms = median_ms(calls, repeats, time.process_time)
    truth = true_matches(pair.correspondences, pair.E)
    network_ms = ms["filter"] * float(np.median(network_shares[1:]))  # the first one warms up
    return ListTime(family, len(truth), float(truth.mean()), ms["filter"], network_ms, ms["magsac"])


def ratio_table(times: Sequence[ListTime]) -> str:
    """A row for each group that has a list: medians, and the ratios of the medians and of the sums of the times.

    "fit" is the call without the forward pass; the ratios before it are of the whole call.
    """
    rows = []
    for group, target in RATIO_TARGETS.items():
        chosen = [one for one in times if one.group == group]
        if not chosen:
            continue

        def column(name: str, chosen: Sequence[ListTime] = chosen) -> FloatArray:
            return np.array([getattr(one, name) for one in chosen], dtype=np.float64)

        ours, fit, theirs = (column(f"{name}_ms") for name in ("filter", "fit", "magsac"))
        ratios = (np.median(ours) / np.median(theirs), np.median(ours / theirs), ours.sum() / theirs.sum())
        cells = [group, str(len(chosen)), f"{np.median(column('matches')):.0f}"]
        cells += [f"{100 * np.median(column('right_share')):.0f} %"]
        cells += [f"{np.median(values):.1f}" for values in (ours, fit, theirs)]
        rows.append([*cells, *(f"{ratio:.2f}" for ratio in ratios), target, f"{np.median(fit / theirs):.2f}"])
    header = ["lists", "number", "matches", "right", "filter, ms", "of it fit, ms", "MAGSAC, ms"]
    header += ["ratio of medians", "median of ratios", "ratio of sums", "target", "fit, median of ratios"]
    return render_table(header, rows)


def length_table(times: Sequence[ListTime]) -> str:
    """The clear lists by length: how many ended before the network, and the ratios of those."""
    rows = []
    shortest = CLEAR_COUNTS[0]
    for limit in LENGTHS:
        chosen = [one for one in times if one.group == CLEAR and shortest <= one.matches < limit]
        early = [one for one in chosen if one.network_ms == 0.0]
        if early:
            ours, theirs = (np.array([getattr(one, f"{name}_ms") for one in early]) for name in ("filter", "magsac"))
            ratios = (np.median(ours / theirs), ours.sum() / theirs.sum())
            cells = [f"{shortest} to {limit - 1}", str(len(chosen)), str(len(early))]
            cells += [f"{np.median(values):.1f}" for values in (ours, theirs)]
            rows.append([*cells, *(f"{ratio:.2f}" for ratio in ratios)])
        shortest = limit
    header = ["matches", "lists", "before the network", "filter, ms", "MAGSAC, ms", "median of ratios", "ratio of sums"]
    return render_table(header, rows)


def print_list_ratios(options: argparse.Namespace) -> None:
    """The tables of ``--bundles``."""
    chosen = (options.detectors, None, options.per_scene)
    scenes = open_detector_scenes(options.bundles, *chosen)
    meter = CpuMeter()
    with one_thread():
        times = time_lists(scenes, options.repeats, options.model, options.kinds)
    print(
        "Whole calls against USAC_MAGSAC (0.5 px, confidence 0.9999, 5000 iterations) on the same list, one thread, in "
        f"turn, processor time, medians; other programs used {meter.others_load():.1f} processors meanwhile.\n\n"
        f"{ratio_table(times)}\n\nOf the {CLEAR}, those that ended before the network:\n\n{length_table(times)}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--bundle", type=Path, help="a scene bundle instead of the example pair")
    parser.add_argument("--pair", type=int, default=0, help="index in the bundle")
    parser.add_argument(
        "--bundles", type=Path, nargs="+", metavar="FOLDER", help="ratios on the lists of these bundles"
    )
    parser.add_argument("--per-scene", type=int, metavar="N", help="with --bundles: at most N pairs of each")
    parser.add_argument("--detectors", nargs="+", metavar="NAME", help="with --bundles: these alone")
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="with --bundles: these lists alone"
    )
    parser.add_argument(
        "--model", metavar="FILE", help="with --bundles: of the filter (default: the one in the package)"
    )
    options = parser.parse_args(arguments)
    if options.bundles:
        print_list_ratios(options)
        return
    os.environ[THREADS_VARIABLE] = os.environ["OMP_NUM_THREADS"] = str(options.threads)
    cv2.setNumThreads(options.threads)
    import torch

    torch.set_num_threads(options.threads)
    pair = bundle_pair(options.bundle, options.pair) if options.bundle else example_pair()
    threads = f"{options.threads} thread{'s' if options.threads > 1 else ''}"
    print(f"{len(pair.points1)} raw matches, {100 * pair.inlier_share:.0f} % right; {threads}.")
    calls = full_calls(pair)
    errors_deg = {name: answer_error_deg(pair, call()) for name, call in calls.items()}
    print_ratios("Whole calls", median_ms(calls, options.repeats), errors_deg)
    for count in (500, 2000):
        print_ratios(f"One pass of the network, N = {count}", median_ms(network_calls(count), options.repeats))
    print_cold_start_and_memory(["onnxruntime", "opencv", "torch"])


if __name__ == "__main__":
    main()
