"""One command, one usage: which words lead where, options written out, what every command does first."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pipeline_command import ROOT, assert_one_line, start_command

from mgca_filter import cli
from mgca_filter.cli.arguments import add_filter_options, filter_options
from mgca_filter.inputs.options import FilterOptions

IMAGES = ROOT / "examples" / "images"
LEFT, RIGHT = str(IMAGES / "left.jpg"), str(IMAGES / "right.jpg")
COMMANDS = ("colmap", "hloc", "folder", "run", "train", "evaluate")


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        cli.main([*words, "--help"])
    assert stopped.value.code == 0
    return capsys.readouterr().out


def test_the_usage_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    usage = help_of(capsys).partition("\n\n")[0]
    for command in COMMANDS:
        assert f"mgca-match {command} " in usage
        help_of(capsys, command)


def test_help_says_whether_photos_are_turned(capsys: pytest.CaptureFixture[str]) -> None:
    for words, expected in (([], "turned first"), (["folder"], "turned\nback to the pixels of the files")):
        text = help_of(capsys, *words)
        assert expected in text
        assert "--K is for the photo" in text


@pytest.mark.parametrize(
    ("word", "package", "extra"), [("train", "training", "train"), ("evaluate", "evaluation", "eval")]
)
def test_siblings_tell_which_extra_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], word: str, package: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, f"mgca_filter.{package}.__main__", None)
    assert cli.main([word]) == 2
    assert_one_line(capsys.readouterr(), f"'mgca_filter[{extra}]'")


def test_run_has_the_options_of_a_command_before_the_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", str(tmp_path / "none.py")]) == 2
    assert_one_line(capsys.readouterr(), f"mgca-match: {tmp_path / 'none.py'}: no such file")
    assert cli.main(["run", "--providers", "abacus", "x.py"]) == 2
    assert_one_line(capsys.readouterr(), "mgca-match run --help")
    (tmp_path / "script.py").write_text("import os, sys; print(os.environ['MGCA_FILTER_PROVIDERS'], sys.argv[1:])")
    process = start_command("run", "--providers", "cpu", "script.py", "--providers", "mine", cwd=tmp_path)
    out, err = process.communicate()
    assert (process.returncode, out) == (0, "CPUExecutionProvider ['--providers', 'mine']\n"), err


def test_run_is_a_word_of_the_command_as_well(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text("import sys; print(sys.argv[1:])")
    process = start_command("run", "script.py", "--flag", cwd=tmp_path)
    out, err = process.communicate()
    assert (process.returncode, out) == (0, "['--flag']\n"), err


@pytest.mark.parametrize(
    "words",
    [
        [LEFT, RIGHT, "--k", "820,820,511.5,383.5"],
        [LEFT, RIGHT, "--keep", "0.9"],
        [LEFT, RIGHT, "--thresh", "2"],
        ["colmap", "a.db", "-o", "b.db", "--no-desc"],
        ["hloc", "f.h5", "m.h5", "--out", "o.h5"],
        ["folder", "images", "-o", "o.jsonl", "--k", "1,1,1,1"],
    ],
)
def test_options_are_written_out(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    assert cli.main(words) == 2
    assert_one_line(capsys.readouterr(), "--")


def test_the_runtime_does_not_report_home_unless_the_user_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for before, after in ((None, "1"), ("0", "0")):
        monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
        if before is not None:
            monkeypatch.setenv("ORT_DISABLE_TELEMETRY", before)
        assert cli.main(["no.png", "such.png", "-q"]) == 2
        assert os.environ["ORT_DISABLE_TELEMETRY"] == after


def test_quiet_says_nothing_without_a_home(tmp_path: Path) -> None:
    """As in a container: no folder for what the runtime wants to keep."""
    (tmp_path / "file").touch()
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path / "file" / "home"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "mgca_filter", LEFT, RIGHT, "--max-keypoints", "300", "-q"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


K_WORDS = ["--K", "820,820,511.5,383.5"]


@pytest.mark.parametrize(("scale", "turned"), [(0.9, False), (0.4, False), (1.0, True)])
def test_one_K_for_images_of_two_sizes_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scale: float, turned: bool
) -> None:
    image = cv2.resize(cv2.imread(RIGHT), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    path = str(tmp_path / "other.png")
    cv2.imwrite(path, cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE) if turned else image)
    assert cli.main([LEFT, path, *K_WORDS, "--max-keypoints", "100"]) == 2
    assert_one_line(capsys.readouterr(), "K2: one K cannot be right for images of 1024x768 and")


def test_a_principal_point_far_from_the_middle_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "other.png")
    cv2.imwrite(path, cv2.resize(cv2.imread(RIGHT), None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA))
    words = [LEFT, path, "--K1", K_WORDS[1], "--K2", K_WORDS[1], "--max-keypoints", "100"]
    cli.main(words)
    far = "the principal point 511.5,383.5 is far from the middle of an image of 410 x 307"
    assert capsys.readouterr().err == f"mgca-match: warning: {far}\n"
    cli.main([*words, "-q"])
    assert capsys.readouterr().err == ""


def kept_of(capsys: pytest.CaptureFixture[str], *images: str) -> int:
    """How many matches of a pair the command keeps."""
    assert cli.main([*images, *K_WORDS, "--max-keypoints", "2000"]) == 0
    return int(capsys.readouterr().out.splitlines()[2].split(" matches in, ")[1].split(" kept")[0])


@pytest.mark.slow
def test_sixteen_bit_files_keep_their_matches(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """10 bits, thermal cameras, 8 bits in 16: about as many matches as of the picture itself."""
    pictures = {name: cv2.imread(path, cv2.IMREAD_GRAYSCALE) for name, path in (("left", LEFT), ("right", RIGHT))}

    def stored(convert: Callable[[np.ndarray], np.ndarray]) -> list[str]:
        paths = [str(tmp_path / f"{name}.png") for name in pictures]
        for path, grey in zip(paths, pictures.values()):
            cv2.imwrite(path, convert(grey))
        return paths

    expected = kept_of(capsys, *stored(lambda grey: grey))
    assert expected > 100
    for gain, offset in ((4, 0), (5, 7000), (1, 7424), (1, 0)):
        images = stored(lambda grey: grey.astype(np.uint16) * gain + offset)  # noqa: B023
        assert kept_of(capsys, *images) > 0.9 * expected, (gain, offset)


def test_the_command_line_has_the_defaults_of_the_library() -> None:
    parser = argparse.ArgumentParser()
    add_filter_options(parser)
    given = filter_options(parser.parse_args([]))
    defaults = FilterOptions()
    for name in ("threshold", "keep_precision", "method", "seed"):
        assert given[name] == getattr(defaults, name), name
