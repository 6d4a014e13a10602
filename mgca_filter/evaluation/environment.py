"""Where figures come from: machine, versions, commit, and whether the machine was otherwise idle."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2

from ..inference.onnxruntime_ import THREADS_VARIABLE

PACKAGES = (
    *("numpy", "opencv-contrib-python-headless", "opencv-contrib-python", "onnxruntime", "mgca-filter"),
    *("poselib", "pydegensac", "kornia", "torch", "pycolmap"),
)
BUSY_LOAD = 0.25
"""Processors used by other programs from which on times are not to be relied upon."""


def processor_name() -> str:
    """The processor's model name, or what the platform module knows of it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def machine_description() -> dict[str, str | int | None]:
    """Processor, number of logical processors, operating system and Python version."""
    return {
        "processor": processor_name(),
        "cpus": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def library_versions() -> dict[str, str]:
    """Versions of the installed packages that results depend on."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def source_commit() -> str | None:
    """Git commit of the package's checkout, with ``+changes`` where files differ from it; None outside a checkout."""
    folder = Path(__file__).resolve().parent.parent
    try:
        commit = _git(folder, "rev-parse", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", str(folder))
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + ("+changes" if changed else "")


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(folder), *arguments], check=True, capture_output=True, text=True)
    return done.stdout.strip()


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV, and sessions of ONNX Runtime that are opened within the block, keep to one thread.

    The number of threads changes no figure but the times, in which baselines have one thread too.
    """
    opencv_threads, onnx_threads = cv2.getNumThreads(), os.environ.get(THREADS_VARIABLE)
    cv2.setNumThreads(1)
    os.environ[THREADS_VARIABLE] = "1"
    try:
        yield
    finally:
        cv2.setNumThreads(opencv_threads)
        os.environ.pop(THREADS_VARIABLE)
        if onnx_threads is not None:
            os.environ[THREADS_VARIABLE] = onnx_threads


class CpuMeter:
    """Tells how much other programs worked beside this process since the meter was made."""

    def __init__(self) -> None:
        self._start = (time.perf_counter(), time.process_time(), _machine_cpu_seconds())

    def others_load(self) -> float:
        """Number of processors that other programs used, on average.

        The count is Linux's (``/proc/stat``); elsewhere the load average stands in for it, and 0 where there is none.
        """
        wall, own, machine = self._start
        elapsed = time.perf_counter() - wall
        now = _machine_cpu_seconds()
        if machine is None or now is None:
            return max(os.getloadavg()[0] - 1.0, 0.0) if hasattr(os, "getloadavg") else 0.0
        # The kernel counts in ticks of 10 ms on every processor, of which a short measurement must not make much.
        others = now - machine - (time.process_time() - own) - 0.05
        return max(others, 0.0) / elapsed


def _machine_cpu_seconds() -> float | None:
    """Seconds that all processors together have worked since the machine started."""
    try:
        fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
        ticks_per_second = os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, AttributeError):
        return None
    user, nice, system, _, _, interrupt, soft_interrupt = fields[:7]
    return (user + nice + system + interrupt + soft_interrupt) / ticks_per_second
