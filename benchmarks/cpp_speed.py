"""Is C++ faster than Python? ``python -m benchmarks.cpp_speed --build FOLDER`` prints ratios.

FOLDER is a build of ``cpp/`` with its tests. Both sides get what an OpenCV program holds, keypoints and rows of
matches, of the same pairs: rendered views of ``examples/render_views.py``, and one pair whose points are shuffled. With
``--bundles`` lists of real pairs as well, raw and cross-checked with a ratio below 0.8, in the groups of
``benchmarks.speed``. Both sides and USAC_MAGSAC's 5000 iterations at half a pixel run in turn, on one thread each.
Processor time is measured, which other programs disturb less than they do the clock on the wall; of each pair the
fastest call counts.
"""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from mgca_filter import MatchFilter, model_path
from mgca_filter.data.scene_bundle import ScenePair
from mgca_filter.evaluation.environment import CpuMeter, one_thread
from mgca_filter.evaluation.metrics import true_matches
from mgca_filter.features import create_detector, detect_keypoints, match_descriptors
from mgca_filter.tables import render_table

from .match_lists import open_detector_scenes
from .speed import MAGSAC_OPTIONS, essential_magsac, group_of, timed_lists

ROOT = Path(__file__).resolve().parent.parent
TARGET = 0.8
_MAX_RATIO = 0.8  # of the filtered lists


@dataclass(frozen=True)
class TimedPair:
    """One list of matches as an OpenCV program holds it.

    Attributes:
        group: row of the table. keypoints1, keypoints2: of the images. rows: of ``knnMatch``, or single matches.
        K1, K2: intrinsics (3, 3), or None. full: run with ``effort="full"``.
    """

    group: str
    keypoints1: Sequence[cv2.KeyPoint]
    keypoints2: Sequence[cv2.KeyPoint]
    rows: Sequence[Sequence[cv2.DMatch]]
    K1: NDArray[np.float64] | None
    K2: NDArray[np.float64] | None
    full: bool = False

    @property
    def given(self) -> tuple[Sequence[cv2.KeyPoint], Sequence[cv2.KeyPoint], Sequence[Sequence[cv2.DMatch]]]:
        """What a program hands over, cameras aside."""
        return self.keypoints1, self.keypoints2, self.rows

    def magsac(self) -> None:
        """Run the call that the filter replaces, on the first candidates; without intrinsics that of F."""
        matches = [row[0] for row in self.rows]
        points1 = np.array([self.keypoints1[match.queryIdx].pt for match in matches])
        points2 = np.array([self.keypoints2[match.trainIdx].pt for match in matches])
        if self.K1 is None or self.K2 is None:
            iterations, threshold_px, confidence = MAGSAC_OPTIONS
            cv2.findFundamentalMat(points1, points2, cv2.USAC_MAGSAC, threshold_px, confidence, iterations)
        else:
            essential_magsac(points1, points2, self.K1, self.K2, *MAGSAC_OPTIONS)


@dataclass(frozen=True)
class PairTime:
    """Fastest calls on a pair, milliseconds of the processor, and whether both sides gave the same status."""

    group: str
    python_ms: float
    cpp_ms: float
    magsac_ms: float
    agree: bool


def rendered_pairs(count: int, keypoints: int, supersampling: int = 2) -> list[TimedPair]:
    """Lists of every kind of neighbouring views, and of views two apart.

    Args:
        count: number of views. keypoints: SIFT keypoints of each. supersampling: of the renderer.
    """
    views = _render_views(count, supersampling)
    detector = create_detector("sift", keypoints)
    found = [detect_keypoints(view.image, detector) for view in views]
    pairs = []
    for first, second in [*zip(range(count), range(1, count)), *zip(range(count), range(2, count))]:
        (keypoints1, descriptors1), (keypoints2, descriptors2) = found[first], found[second]
        rows, K = match_descriptors(descriptors1, descriptors2), views[first].K
        tested = [row[:1] for row in rows if row[0].distance < _MAX_RATIO * row[1].distance]
        pairs += [
            TimedPair("raw list", keypoints1, keypoints2, rows, K, K),
            TimedPair("raw list, network always", keypoints1, keypoints2, rows, K, K, full=True),
            TimedPair(f"ratio below {_MAX_RATIO}", keypoints1, keypoints2, tested, K, K),
            TimedPair("raw list without intrinsics", keypoints1, keypoints2, rows, None, None),
        ]
    wrong = np.random.default_rng(0).permutation(len(found[0][0]))
    shuffled = [found[0][0][i] for i in wrong]
    rows = match_descriptors(found[0][1], found[1][1])
    pairs.append(TimedPair("unrelated", shuffled, found[1][0], rows, views[0].K, views[0].K))
    return pairs


def bundle_pairs(bundles: Sequence[Path], per_scene: int) -> list[TimedPair]:
    """Lists of the pairs of scene bundles, raw and filtered, by the groups of ``benchmarks.speed``."""
    match_filter = MatchFilter(backend="onnxruntime")
    pairs = []
    for family, pair in timed_lists(open_detector_scenes(bundles, per_scene=per_scene), ("raw", "cross-ratio")):
        timed = _as_opencv_holds_it(pair)
        result = match_filter.filter(*timed.given, K1=timed.K1, K2=timed.K2)
        right = true_matches(pair.correspondences, pair.E)
        network_ms = result.info["timings_ms"].get("network", 0.0)
        pairs.append(replace(timed, group=group_of(family, len(right), float(right.mean()), network_ms > 0)))
    return pairs


def _as_opencv_holds_it(pair: ScenePair) -> TimedPair:
    """Keypoints and ``knnMatch`` rows; the ratio stands for the distance, and 1 for that of the second candidate."""
    attributes, count = pair.attributes, len(pair.points1)
    keypoints, indices = [], []
    for points, size, angle in (
        (pair.points1, attributes.size1, attributes.angle1),
        (pair.points2, attributes.size2, attributes.angle2),
    ):
        given = [np.zeros(count) if size is None else size, np.full(count, -1.0) if angle is None else angle]
        distinct, index = np.unique(np.column_stack([points, *given]), axis=0, return_inverse=True)
        keypoints.append([cv2.KeyPoint(*map(float, row)) for row in distinct])
        indices.append(index.reshape(-1))
    rows = []
    for i in range(count):
        query, train = int(indices[0][i]), int(indices[1][i])
        if attributes.ratio is None:
            rows.append([cv2.DMatch(query, train, 0.0)])
            continue
        second = (train + 1) % len(keypoints[1])
        rows.append([cv2.DMatch(query, train, float(attributes.ratio[i])), cv2.DMatch(query, second, 1.0)])
    return TimedPair("", keypoints[0], keypoints[1], rows, pair.K1, pair.K2)


def _render_views(count: int, supersampling: int) -> Any:
    return runpy.run_path(str(ROOT / "examples" / "render_views.py"))["render_views"](count, supersampling)


def write_pairs(path: Path, pairs: Sequence[TimedPair]) -> None:
    """Write the pairs as ``cpp/tests/time_pairs.cpp`` reads them."""
    lines = []
    for pair in pairs:
        lines.append(f"{len(pair.keypoints1)} {len(pair.keypoints2)} {len(pair.rows)}")
        for K in (pair.K1, pair.K2):
            camera = [0.0] * 4 if K is None else K[[0, 1, 0, 1], [0, 1, 2, 2]]
            lines.append(" ".join(repr(float(value)) for value in camera))
        for keypoint in (*pair.keypoints1, *pair.keypoints2):
            lines.append(f"{keypoint.pt[0]!r} {keypoint.pt[1]!r} {keypoint.size!r} {keypoint.angle!r}")
        for row in pair.rows:
            second = (row[1].trainIdx, row[1].distance) if len(row) > 1 else (-1, 0.0)
            lines.append(f"{row[0].queryIdx} {row[0].trainIdx} {row[0].distance!r} {second[0]} {second[1]!r}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


class CppFilter:
    """The C++ filter in a process of its own, which answers one pair at a time.

    Args:
        program: ``time_pairs`` of a build. pairs: what it will be asked for.

    Raises:
        RuntimeError: the program fails; the message is what it wrote.
    """

    def __init__(self, program: Path, pairs: Sequence[TimedPair]) -> None:
        self._folder = tempfile.TemporaryDirectory()
        file = Path(self._folder.name) / "pairs.txt"
        write_pairs(file, pairs)
        self._process = subprocess.Popen(
            [str(program), str(model_path()), str(model_path("fast")), str(file)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.versions = self._line()

    def __enter__(self) -> CppFilter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()
        self._folder.cleanup()

    def time(self, index: int, full: bool) -> tuple[float, str]:
        """Milliseconds and status of a pair."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{index} {int(full)}\n")
        self._process.stdin.flush()
        ms, status, _ = self._line().split()
        return float(ms), status

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            _, words = self._process.communicate()
            raise RuntimeError(words.strip() or "time_pairs ended")
        return line.strip()


def time_pairs(cpp: CppFilter, pairs: Sequence[TimedPair], repeats: int) -> list[PairTime]:
    """The fastest of ``repeats`` calls of each side and of MAGSAC on each pair, in turn, after one that warms up."""
    filters = {full: MatchFilter(effort="full" if full else "auto", backend="onnxruntime") for full in (False, True)}
    times = []
    for index, pair in enumerate(pairs):
        python_ms, cpp_ms, magsac_ms, status, cpp_status = [], [], [], "", ""
        for turn in range(repeats + 1):
            started = time.process_time()
            status = filters[pair.full].filter(*pair.given, K1=pair.K1, K2=pair.K2).status.value
            answered = time.process_time()
            pair.magsac()
            ended = time.process_time()
            ms, cpp_status = cpp.time(index, pair.full)
            if turn:
                python_ms.append(1e3 * (answered - started))
                magsac_ms.append(1e3 * (ended - answered))
                cpp_ms.append(ms)
        times.append(PairTime(pair.group, min(python_ms), min(cpp_ms), min(magsac_ms), status == cpp_status))
    return times


def ratio_table(times: Sequence[PairTime]) -> str:
    """A row for each group: medians, ratios of the sums of the times, and how often the statuses are the same."""
    rows = []
    for group in [*dict.fromkeys(one.group for one in times), "all"]:
        chosen = [one for one in times if group in (one.group, "all")]
        python, cpp, magsac = (
            np.array([getattr(one, f"{name}_ms") for one in chosen]) for name in ("python", "cpp", "magsac")
        )
        medians = [f"{np.median(values):.1f}" for values in (python, cpp, magsac)]
        ratios = [f"{one.sum() / other.sum():.2f}" for one, other in ((cpp, python), (cpp, magsac), (python, magsac))]
        agree = sum(one.agree for one in chosen)
        rows.append([group, str(len(chosen)), *medians, *ratios, f"{agree} of {len(chosen)}"])
    header = ["lists", "number", "Python, ms", "C++, ms", "MAGSAC, ms"]
    header += ["C++ / Python", "C++ / MAGSAC", "Python / MAGSAC", "same status"]
    return render_table(header, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.cpp_speed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--build", type=Path, required=True, metavar="FOLDER", help="where cpp/ was built")
    parser.add_argument("--views", type=int, default=6, help="rendered views (default 6)")
    parser.add_argument("--keypoints", type=int, default=2000, help="of each view (default 2000)")
    parser.add_argument("--repeats", type=int, default=5, help="calls of each side on each pair (default 5)")
    parser.add_argument(
        "--bundles", type=Path, nargs="+", default=[], metavar="FOLDER", help="lists of their pairs too"
    )
    parser.add_argument("--per-scene", type=int, default=1, metavar="N", help="pairs of each bundle (default 1)")
    options = parser.parse_args(arguments)
    program = options.build / "tests" / "time_pairs"
    if not program.is_file():
        print(f"error: {program} is not there: cmake -S cpp -B {options.build} && cmake --build …", file=sys.stderr)
        return 2
    pairs = rendered_pairs(options.views, options.keypoints)
    if options.bundles:
        pairs += bundle_pairs(options.bundles, options.per_scene)
    meter = CpuMeter()
    try:
        with one_thread(), CppFilter(program, pairs) as cpp:
            versions, times = cpp.versions, time_pairs(cpp, pairs, options.repeats)
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    and_bundles = ", and pairs of photographs" if options.bundles else ""
    print(
        f"Rendered views, {options.keypoints} SIFT keypoints{and_bundles}; processor time of one thread, in turn, the "
        f"fastest of {options.repeats} calls. Python: ONNX Runtime {onnxruntime.__version__}, OpenCV "
        f"{cv2.__version__}; C++: {versions}; other programs used {meter.others_load():.1f} processors meanwhile. "
        f"Target, C++ / Python: {TARGET}.\n\n"
        f"{ratio_table(times)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
