"""Workers: results as they come, little read ahead, nothing left behind; whatever dies, one line says so."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pipeline_command import K_WORDS, ROOT

from mgca_filter.pipelines import run
from mgca_filter.pipelines.journal import PipelineError
from mgca_filter.pipelines.run import Workers

OPTIONS = ["--K", K_WORDS, "--max-keypoints", "500", "-q", "-j", "2"]


def broken_images(count: int, read: list[int] | None = None):
    """Tasks of no work: files that are no images."""
    for k in range(count):
        if read is not None:
            read.append(k)
        yield f"{k}.png", b"", "sift", 10


def test_results_of_processes_stream_and_little_is_read_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that stands still stops the reading, wherever the workers are."""
    monkeypatch.setattr(run, "_WINDOW_PER_WORKER", 3)
    read: list[int] = []
    with Workers({}, 2) as workers:
        results = workers.map("extract", broken_images(20, read))
        names = [next(results)[0]]
        time.sleep(1.0)
        assert len(read) <= 6
        names += [name for name, *_ in results]
    assert sorted(names) == sorted(f"{k}.png" for k in range(20))


def test_one_worker_reads_a_task_when_it_is_done_with_the_last() -> None:
    read: list[int] = []
    with Workers({}, 1) as workers:
        results = workers.map("extract", broken_images(5, read))
        for k in range(5):
            assert next(results)[0] == f"{k}.png"
            assert len(read) == k + 1


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_an_error_of_the_source_comes_through(count: int) -> None:
    def tasks():
        yield from broken_images(5)
        raise PipelineError("the source broke")

    with pytest.raises(PipelineError, match="the source broke"), Workers({}, count) as workers:
        list(workers.map("extract", tasks()))


@pytest.mark.slow
def test_a_driver_that_stops_early_leaves_no_worker_and_no_warning(recwarn: pytest.WarningsRecorder) -> None:
    with Workers({}, 2) as workers:
        next(workers.map("extract", broken_images(100)))
    assert children(os.getpid()) == set()
    assert [str(warning.message) for warning in recwarn] == []


def children(parent: int) -> set[int]:
    """Workers that a process has started; the tracker of their resources, which ends by itself, does not count."""
    found = set()
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
            command = (status.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if int(fields[1]) == parent and fields[0] != "Z" and b"popen_loky" in command:
            found.add(int(status.parent.name))
    return found


# The command, of which the second row kills ({pid}) the process itself or one of its workers.
KILLING = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from test_run import children
from mgca_filter import cli
from mgca_filter.pipelines.journal import Journal
add, rows = Journal.add, []
def add_and_kill(journal, row):
    add(journal, row)
    rows.append(row)
    if len(rows) == 2:
        print(*children(os.getpid()), flush=True)
        os.kill({pid}, signal.SIGKILL)
Journal.add = add_and_kill
sys.exit(cli.main(sys.argv[1:]))
"""


def run_killing(pid: str, images: Path, output: Path) -> subprocess.CompletedProcess:
    code = KILLING.format(tests=str(Path(__file__).parent), pid=pid)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests")))}
    command = [sys.executable, "-c", code, "folder", str(images), "-o", str(output), *OPTIONS]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_a_killed_command_leaves_no_workers(image_folder: Path, tmp_path: Path) -> None:
    done = run_killing("os.getpid()", image_folder, tmp_path / "out.jsonl")
    assert done.returncode == -signal.SIGKILL, done.stderr
    workers = [Path("/proc") / pid for pid in done.stdout.split()]
    assert len(workers) == 2
    deadline = time.monotonic() + 20.0
    while any(path.exists() for path in workers) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert [path for path in workers if path.exists()] == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_a_dead_worker_is_one_line_and_the_run_goes_on_later(image_folder: Path, tmp_path: Path) -> None:
    done = run_killing("min(children(os.getpid()))", image_folder, tmp_path / "out.jsonl")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert "a worker process died" in done.stderr
    assert "run the command again to go on" in done.stderr
    command = [sys.executable, "-m", "mgca_filter", "folder", image_folder, "-o", tmp_path / "out.jsonl", *OPTIONS[:4]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    again = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True, timeout=120)
    assert again.returncode == 0, again.stderr
    assert "were done before)" in again.stdout
