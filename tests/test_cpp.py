"""The C++ library is built, passes its own tests, and gives Python's answers on this very machine.

Needs CMake, a C++ compiler, OpenCV's headers, and ONNX Runtime's headers and library: in the folder that the
environment variable ONNXRUNTIME_ROOT names (include/ and lib/), or where CMake looks by itself. Where something is
missing these tests are skipped with the reason; with MGCA_REQUIRE_CPP=1 they fail instead. MGCA_CPP_BUILD names a
folder in which the library is built already, or is built and stays.
"""

from __future__ import annotations

import fcntl
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from conftest import make_scene

import mgca_filter
from benchmarks import cpp_speed
from benchmarks.cpp_speed import CppFilter

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "cpp"
PORT = SOURCE / "vcpkg" / "mgca"
IMAGES = ROOT / "examples" / "images"
# What the default filter asks, as the programs are given them: the deep network and the first look.
MODELS = (mgca_filter.model_path(), mgca_filter.model_path("fast"))
_BUILDS = tempfile.TemporaryDirectory(prefix="mgca_cpp_")
# The compiler may take minutes on a busy machine.
pytestmark = pytest.mark.timeout(1200)


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(word) for word in command], capture_output=True, text=True)


def missing(reason: str) -> None:
    """Skip, or fail where C++ must be tested."""
    if os.environ.get("MGCA_REQUIRE_CPP") == "1":
        pytest.fail(f"MGCA_REQUIRE_CPP=1, but {reason}")
    pytest.skip(reason)


@functools.cache
def build_folder() -> Path:
    """The library, its tool and its tests, built once."""
    for tool in ("cmake", os.environ.get("CXX", "c++")):
        if shutil.which(tool) is None:
            missing(f"{tool} is not there")
    folder = Path(os.environ.get("MGCA_CPP_BUILD", str(Path(_BUILDS.name) / "build")))
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "pytest.lock", "w") as lock:  # one process of pytest at a time
        fcntl.flock(lock, fcntl.LOCK_EX)
        _configure_and_build(folder)
    return folder


def _configure_and_build(folder: Path) -> None:
    done = run("cmake", "-S", SOURCE, "-B", folder)
    words = re.sub(r"\s+", " ", done.stderr)
    if done.returncode and "OpenCVConfig.cmake" in words:
        missing("OpenCV's headers are not there (Debian: libopencv-dev)")
    if done.returncode and "No ONNX Runtime" in words:
        missing("ONNX Runtime's headers and library are not there; ONNXRUNTIME_ROOT may name their folder")
    assert done.returncode == 0, done.stdout + done.stderr
    done = run("cmake", "--build", folder, "--config", "Release")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def build() -> Path:
    return build_folder()


def program(build: Path, name: str) -> Path:
    found = (folder / name for folder in (build, build / "tools", build / "tests"))
    return next(path for path in found if path.is_file() and os.access(path, os.X_OK))


@pytest.mark.slow
def test_own_tests_of_the_library(build):
    done = run("ctest", "--test-dir", build, "--output-on-failure", "-C", "Release")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "100% tests passed" in done.stdout


@pytest.mark.slow
def test_answers_are_those_of_python_on_this_machine(build, tmp_path):
    """With the same OpenCV in every bit that counts; else as another seed would have it."""
    shutil.copytree(ROOT / "tests" / "golden" / "inputs", tmp_path / "inputs")
    shutil.copy(ROOT / "tests" / "golden" / "cases.json", tmp_path)
    writer = ROOT / "tests" / "golden" / "write_goldens.py"
    written = run(sys.executable, writer, "--expected-only", "--quick", "--out", tmp_path)
    assert written.returncode == 0, written.stderr
    tests = program(build, "test_golden")
    done = run(tests, tmp_path, *MODELS)
    assert done.returncode == 0, done.stdout + done.stderr
    if f"OpenCV {cv2.__version__}\n" in done.stdout:
        done = run(tests, tmp_path, *MODELS, "exact")
        assert done.returncode == 0, done.stdout + done.stderr


def test_versions_are_that_of_the_package():
    header = (SOURCE / "include" / "mgca" / "version.hpp").read_text(encoding="utf-8")
    numbers = [re.search(rf"VERSION_{part} (\d+)", header)[1] for part in ("MAJOR", "MINOR", "PATCH")]
    assert ".".join(numbers) == re.search(r'MGCA_VERSION "(.*)"', header)[1] == mgca_filter.__version__
    assert ElementTree.parse(SOURCE / "package.xml").findtext("version") == mgca_filter.__version__
    assert json.loads((PORT / "vcpkg.json").read_text(encoding="utf-8"))["version"] == mgca_filter.__version__
    wanted = re.escape(".".join(mgca_filter.__version__.split(".")[:2]))
    for user in (ROOT / "docs" / "cpp.md", ROOT / "examples" / "cpp" / "CMakeLists.txt"):
        assert re.search(rf"find_package\(mgca {wanted} REQUIRED\)", user.read_text(encoding="utf-8"))


def test_package_for_ros_names_what_is_there():
    package = ElementTree.parse(SOURCE / "package.xml").getroot()
    assert (package.get("format"), package.findtext("name"), package.findtext("license")) == ("3", "mgca", "MIT")
    assert (SOURCE / package.find("license").get("file")).is_file()
    assert package.findtext("export/build_type") == "cmake"
    assert "project(mgca " in (SOURCE / "CMakeLists.txt").read_text(encoding="utf-8")


def test_port_for_vcpkg_configures_what_is_there(tmp_path):
    """The port runs with vcpkg's functions in words; its options and features are those of the library."""
    port = json.loads((PORT / "vcpkg.json").read_text(encoding="utf-8"))
    assert port["name"] == PORT.name
    functions = re.findall(r"^ *(vcpkg_\w+)\(", (PORT / "portfile.cmake").read_text(encoding="utf-8"), re.MULTILINE)
    (tmp_path / "run.cmake").write_text(
        "cmake_minimum_required(VERSION 3.16)\nset(FEATURES core tools)\n"
        "set(CURRENT_PACKAGES_DIR ${CMAKE_CURRENT_LIST_DIR})\n"
        + "".join(f'function({name})\n  message("{name};${{ARGN}}")\nendfunction()\n' for name in functions)
        + f'include("{PORT / "portfile.cmake"}")\n'
    )
    done = run("cmake", "-P", tmp_path / "run.cmake")
    assert done.returncode == 0, done.stderr
    calls = {words[0]: words[1:] for words in (line.split(";") for line in done.stderr.splitlines())}
    assert "vcpkg_copy_tools" in calls
    configured = calls["vcpkg_cmake_configure"]
    assert Path(configured[configured.index("SOURCE_PATH") + 1]) == SOURCE
    features = calls["vcpkg_check_features"][calls["vcpkg_check_features"].index("FEATURES") + 1 :]
    assert set(features[::2]) == set(port["features"])
    known = "".join(path.read_text(encoding="utf-8") for path in (SOURCE / "CMakeLists.txt", *SOURCE.glob("cmake/*")))
    for name in [*features[1::2], *re.findall(r"-D(\w+)=", " ".join(configured))]:
        assert re.search(rf"(option|set)\({name} ", known)


def test_public_header_names_no_runtime():
    text = (SOURCE / "include" / "mgca" / "filter.hpp").read_text(encoding="utf-8")
    included = set(re.findall(r"#include <(.*)>", text))
    assert {name for name in included if "/" in name} == {"mgca/version.hpp", "opencv2/core.hpp"}
    assert "Ort::" not in text


def camera() -> str:
    K = json.loads((IMAGES / "pair.json").read_text(encoding="utf-8"))["K1"]
    return ",".join(repr(float(value)) for value in (K[0][0], K[1][1], K[0][2], K[1][2]))


@pytest.mark.slow
def test_tool_answers_in_words_and_json(build):
    tool = program(build, "mgca_match")
    views = (IMAGES / "left.jpg", IMAGES / "right.jpg")
    done = run(tool, *views, "--K", camera())
    assert done.returncode == 0, done.stderr
    assert re.search(r"status +ok\n", done.stdout)
    images = (*views, "--model", MODELS[0])
    files = ((), ("--model", MODELS[0], "--first-look", MODELS[1]), images[2:])
    within, both, alone = (run(tool, *views, *words, "--effort", "full", "--json").stdout for words in files)
    assert json.loads(within) == json.loads(both)
    assert json.loads(both)["scores"] != json.loads(alone)["scores"]
    done = run(tool, *images, "--K", camera(), "--json", "--method", "magsac", "--seed", "3", "--threads", "2")
    answer = json.loads(done.stdout)
    assert done.returncode == 0
    assert (answer["status"], answer["num_inliers"]) == ("ok", sum(answer["mask"]))
    assert len(answer["scores"]) == len(answer["mask"]) > 1000
    guessed = run(tool, *images, "--max-keypoints", "500")
    assert "guessed from the image size" in guessed.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected two images"),
        (["a.png", "b.png"], "a.png: not a readable image"),  # by the model within the library
        (["a.png", "b.png", "--model", "m.onnx", "--K", "1,2,3"], "--K: expected fx,fy,cx,cy"),
        (["a.png", "b.png", "--model", "m.onnx", "--no", "1"], "--no: unknown"),
        (["a.png", "b.png", "--model", "m.onnx", "--method", "best"], "method: expected one of auto, prosac"),
        (["a.png", "b.png", "--model", "m.onnx", "--seed", "1.5"], "--seed: expected an integer"),
        (["a.png", "b.png", "--model", "m.onnx"], "m.onnx: model file not found"),
        (["a.png", "b.png", "--model", str(MODELS[0]), "--first-look", "m.onnx"], "m.onnx: model file not found"),
        (["a.png", "b.png", "--first-look", str(MODELS[1])], "--first-look: needs --model"),
        (["a.png", "b.png", "--model", str(mgca_filter.model_path())], "a.png: not a readable image"),
        (["a.png", "b.png", "--model", str(mgca_filter.model_path()), "--threshold", "0"], "threshold: expected"),
    ],
)
def test_tool_names_what_is_wrong(build, words, message):
    done = run(program(build, "mgca_match"), *words)
    assert done.returncode == 2
    assert message in done.stderr


@pytest.mark.slow
def test_odometry_times_every_frame(build, image_folder, tmp_path):
    """The example, built on the installed library."""
    prefix, examples = tmp_path / "prefix", tmp_path / "examples"
    for command in (
        ("cmake", "--install", build, "--prefix", prefix),
        ("cmake", "-S", ROOT / "examples" / "cpp", "-B", examples, f"-DCMAKE_PREFIX_PATH={prefix}"),
        ("cmake", "--build", examples, "--target", "odometry"),
    ):
        done = run(*command)
        assert done.returncode == 0, done.stdout + done.stderr
    for source in ("orb", "flow"):
        done = run(program(examples, "odometry"), image_folder, "800,800,319.5,239.5", source, *MODELS)
        assert done.returncode == 0, done.stderr
        assert re.search(r"3 pairs: .* filter [\d.]+ ms per frame", done.stdout)
        assert len(re.findall(r"(?m)^\S+  [a-z_]+  \d+ of \d+  features", done.stdout)) == 3
    assert run(program(examples, "odometry"), image_folder, "800", "orb").returncode == 2


def test_c_interface_from_python(build, tmp_path):
    """The code of the page, run: the answer is Python's own."""
    page = (ROOT / "docs" / "cpp.md").read_text(encoding="utf-8")
    (tmp_path / "program.py").write_text(re.search(r"```python\n(import ctypes.*?)```", page, re.DOTALL)[1])
    scene = make_scene("wide", right=150)
    points = np.stack([scene.points1, scene.points2])
    np.savetxt(tmp_path / "points.txt", points.reshape(-1, 2), fmt="%.17g")
    (library,) = (build / "tests").glob("libmgca_shared.*")
    done = run(sys.executable, tmp_path / "program.py", library, tmp_path / "points.txt")
    assert done.returncode == 0, done.stderr
    K = np.array([[800.0, 0.0, 319.5], [0.0, 800.0, 239.5], [0.0, 0.0, 1.0]])
    expected = mgca_filter.filter_matches(*points, None, K1=K, threshold=1.5)
    verdict, translation = done.stdout.splitlines()
    assert (verdict.split()[0], expected.ok) == (expected.status, True)
    assert abs(int(verdict.split()[1]) - expected.num_inliers) <= 3
    assert np.dot(np.array(translation.split(), float), expected.t) > np.cos(np.radians(0.2))


def test_speed_is_compared_on_the_same_pairs(build):
    pairs = cpp_speed.rendered_pairs(2, 300, supersampling=1)
    assert {pair.full for pair in pairs} == {True, False}
    with CppFilter(program(build, "time_pairs"), pairs) as filters:
        times = cpp_speed.time_pairs(filters, pairs, 1)
        assert "OpenCV" in filters.versions
    assert all(one.cpp_ms > 0 and one.python_ms > 0 for one in times)
    assert sum(one.agree for one in times) >= len(times) - 1


@pytest.mark.slow
def test_opencv_4_alone_is_refused(build, tmp_path):
    version = re.search(r"OpenCV ([\d.]+)", run(program(build, "test_golden"), *golden_arguments()).stdout)
    assert version is not None
    done = run("cmake", "-S", SOURCE, "-B", tmp_path, "-DMGCA_RUNTIME=opencv")
    if int(version[1].split(".")[0]) >= 5:
        assert done.returncode == 0
    else:
        assert "cannot run the model" in re.sub(r"\s+", " ", done.stderr)


def test_models_to_embed_are_checked(build, tmp_path):
    shutil.copytree(MODELS[0].parent, tmp_path / "models", ignore=shutil.ignore_patterns("*.safetensors"))
    with open(tmp_path / "models" / "mgca_fast.onnx", "ab") as file:
        file.write(b"more")
    for option in ("MGCA_MODEL_FILE", "MGCA_FIRST_LOOK_FILE"):
        for name, message in (("mgca_fast.onnx", "damaged or replaced"), ("no.onnx", f"-D{option}=... names")):
            path = tmp_path / "models" / name
            done = run("cmake", "-S", SOURCE, "-B", tmp_path / option, f"-D{option}={path}")
            words = re.sub(r"\s+", "", done.stderr)
            assert done.returncode != 0
            assert f"{path}is" in words
            assert message.replace(" ", "") in words


def golden_arguments() -> tuple[Path, Path, Path]:
    return ROOT / "tests" / "golden", *MODELS
