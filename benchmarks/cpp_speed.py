"""Is C++ faster than Python? ``python -m benchmarks.cpp_speed --build FOLDER`` prints ratios.

FOLDER is a build of ``cpp/`` with its tests. Both sides get what an OpenCV program holds, keypoints and rows of
matches, of the same pairs: rendered views of ``examples/render_views.py``, and one pair whose points are shuffled. They
run in turn, one call here and one there, on one thread each. Processor time is measured, which other programs disturb
less than they do the clock on the wall; of each pair the fastest call counts.
"""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from mgca_filter import MatchFilter, model_path
from mgca_filter.evaluation.environment import CpuMeter, one_thread
from mgca_filter.features import create_detector, detect_keypoints, match_descriptors
from mgca_filter.tables import render_table

ROOT = Path(__file__).resolve().parent.parent
TARGET = 0.8
_MAX_RATIO = 0.8  # of the filtered lists


@dataclass(frozen=True)
class TimedPair:
    """One list of matches as an OpenCV program holds it.

    Attributes:
        group: row of the table. keypoints1, keypoints2: of the images. rows: of ``knnMatch``, or single matches.
        K: intrinsics (3, 3), or None. full: run with ``effort="full"``.
    """

    group: str
    keypoints1: Sequence[cv2.KeyPoint]
    keypoints2: Sequence[cv2.KeyPoint]
    rows: Sequence[Sequence[cv2.DMatch]]
    K: NDArray[np.float64] | None
    full: bool = False


@dataclass(frozen=True)
class PairTime:
    """Fastest calls on a pair, milliseconds of the processor, and whether both sides gave the same status."""

    group: str
    python_ms: float
    cpp_ms: float
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
            TimedPair("raw list", keypoints1, keypoints2, rows, K),
            TimedPair("raw list, network always", keypoints1, keypoints2, rows, K, full=True),
            TimedPair(f"ratio below {_MAX_RATIO}", keypoints1, keypoints2, tested, K),
            TimedPair("raw list without intrinsics", keypoints1, keypoints2, rows, None),
        ]
    wrong = np.random.default_rng(0).permutation(len(found[0][0]))
    shuffled = [found[0][0][i] for i in wrong]
    rows = match_descriptors(found[0][1], found[1][1])
    pairs.append(TimedPair("unrelated", shuffled, found[1][0], rows, views[0].K))
    return pairs


def _render_views(count: int, supersampling: int) -> Any:
    return runpy.run_path(str(ROOT / "examples" / "render_views.py"))["render_views"](count, supersampling)


def write_pairs(path: Path, pairs: Sequence[TimedPair]) -> None:
    """Write the pairs as ``cpp/tests/time_pairs.cpp`` reads them."""
    lines = []
    for pair in pairs:
        lines.append(f"{len(pair.keypoints1)} {len(pair.keypoints2)} {len(pair.rows)}")
        camera = [0.0] * 4 if pair.K is None else pair.K[[0, 1, 0, 1], [0, 1, 2, 2]]
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
    """The fastest of ``repeats`` calls of each side on each pair, in turn, after one that warms up."""
    filters = {full: MatchFilter(effort="full" if full else "auto", backend="onnxruntime") for full in (False, True)}
    times = []
    for index, pair in enumerate(pairs):
        python_ms, cpp_ms, status, cpp_status = [], [], "", ""
        for turn in range(repeats + 1):
            started = time.process_time()
            status = filters[pair.full].filter(pair.keypoints1, pair.keypoints2, pair.rows, K1=pair.K).status.value
            elapsed = 1e3 * (time.process_time() - started)
            ms, cpp_status = cpp.time(index, pair.full)
            if turn:
                python_ms.append(elapsed)
                cpp_ms.append(ms)
        times.append(PairTime(pair.group, min(python_ms), min(cpp_ms), status == cpp_status))
    return times


def ratio_table(times: Sequence[PairTime]) -> str:
    """A row for each group: medians, ratio of the sums of the times, and how often the statuses are the same."""
    rows = []
    for group in [*dict.fromkeys(one.group for one in times), "all"]:
        chosen = [one for one in times if group in (one.group, "all")]
        ours, theirs = (np.array([getattr(one, f"{name}_ms") for one in chosen]) for name in ("cpp", "python"))
        agree = sum(one.agree for one in chosen)
        medians = (f"{np.median(theirs):.1f}", f"{np.median(ours):.1f}")
        rows.append(
            [group, str(len(chosen)), *medians, f"{ours.sum() / theirs.sum():.2f}", f"{agree} of {len(chosen)}"]
        )
    return render_table(["lists", "number", "Python, ms", "C++, ms", "C++ / Python", "same status"], rows)


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
    options = parser.parse_args(arguments)
    program = options.build / "tests" / "time_pairs"
    if not program.is_file():
        print(f"error: {program} is not there: cmake -S cpp -B {options.build} && cmake --build …", file=sys.stderr)
        return 2
    pairs = rendered_pairs(options.views, options.keypoints)
    meter = CpuMeter()
    try:
        with one_thread(), CppFilter(program, pairs) as cpp:
            versions, times = cpp.versions, time_pairs(cpp, pairs, options.repeats)
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(
        f"Rendered views, {options.keypoints} SIFT keypoints, processor time of one thread, in turn, the fastest of "
        f"{options.repeats} calls. Python: ONNX Runtime {onnxruntime.__version__}, OpenCV {cv2.__version__}; C++: "
        f"{versions}; other programs used {meter.others_load():.1f} processors meanwhile. Target: {TARGET}.\n\n"
        f"{ratio_table(times)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
