"""What is installed, and that the documents name the commands that are run."""

import configparser
import re
import runpy
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest

import mgca_filter

ROOT = Path(__file__).parent.parent
TEST_COMMAND = 'python -m pip install ".[test]" && ./check'
FIRST_COMMAND = 'python -m pip install ".[opencv]" && mgca-match examples/images/left.jpg examples/images/right.jpg '


def test_continuous_integration_runs_the_readme_s_test_command():
    assert TEST_COMMAND in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    commands = [line.strip() for line in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()]
    install, check = TEST_COMMAND.split(" && ")
    assert install in commands
    assert any(command.split()[:1] == [check] for command in commands)


def test_the_readme_s_first_command_brings_an_opencv():
    assert any(line.startswith(FIRST_COMMAND) for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines())


def extras() -> dict[str, list[str]]:
    """Requirements of the package itself ("") and of each extra."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    listed = {name: words.splitlines() for name, words in setup["options.extras_require"].items()}
    return {"": setup["options"]["install_requires"].splitlines()} | listed


def test_running_the_filter_needs_no_torch():
    assert [name.split(">")[0] for name in extras()[""] if name] == ["numpy", "onnxruntime"]


def test_only_the_extras_for_fresh_environments_bring_an_opencv():
    """Any other would put its files over those of the OpenCV that the user has."""
    bringing = {name for name, packages in extras().items() if any("opencv" in package for package in packages)}
    assert bringing == {"opencv", "test"}


def test_import_loads_no_optional_package():
    code = "import sys, mgca_filter; print(sorted({'torch', 'onnx', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel of a copy of the working tree: building in place would leave files behind."""
    folder = tmp_path_factory.mktemp("wheel")
    tracked = subprocess.run(["git", "ls-files"], capture_output=True, text=True, cwd=ROOT, check=False).stdout
    names = tracked.splitlines() or [str(path.relative_to(ROOT)) for path in ROOT.rglob("*") if path.is_file()]
    for name in names:
        if name.startswith(("mgca_filter/", "setup.", "pyproject.toml", "README.md", "LICENSE")):
            target = folder / "source" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([*command, str(folder / "source")], check=True, capture_output=True, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


def check_wheel(path: Path) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, ROOT / ".ci" / "check_wheel.py", path], capture_output=True, text=True)


@pytest.mark.slow
def test_wheel_holds_what_it_must_and_nothing_else(wheel):
    done = check_wheel(wheel)
    assert (done.returncode, done.stderr) == (0, "")
    assert "mgca_filter/models" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("tests/test_x.py", b"", "holds tests/test_x.py"),
        ("mgca_filter/notes.txt", b"", "holds mgca_filter/notes.txt"),
        ("mgca_filter/models/big.onnx", np.random.default_rng(0).bytes(4_000_000), "the limit is"),
    ],
)
def test_a_wheel_with_more_in_it_is_refused(wheel, tmp_path, name, content, fault):
    path = tmp_path / wheel.name
    path.write_bytes(wheel.read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, content)
    done = check_wheel(path)
    assert done.returncode == 1
    assert fault in done.stderr


@pytest.mark.slow
def test_a_wheel_that_requires_an_opencv_is_refused(wheel, tmp_path):
    path = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as good, zipfile.ZipFile(path, "w") as bad:
        for name in good.namelist():
            content = good.read(name)
            if name.endswith("/METADATA"):
                content = content.replace(
                    b"Requires-Dist: numpy", b"Requires-Dist: opencv-python\nRequires-Dist: numpy"
                )
            bad.writestr(name, content)
    assert "requires opencv-python" in check_wheel(path).stderr


def test_links_are_absolute_and_those_of_the_repository_that_builds(monkeypatch):
    """In the long description; README.md keeps relative ones, which work in a checkout."""
    monkeypatch.setenv("GITHUB_REPOSITORY", "someone/else")
    monkeypatch.setenv("GITHUB_REF_NAME", "v9")
    given = {}
    monkeypatch.setattr("setuptools.setup", given.update)
    absolute = runpy.run_path(str(ROOT / "setup.py"))["absolute"]
    assert "](docs/" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert "](docs/" not in given["long_description"]
    assert all("someone/else" in url for url in given["project_urls"].values())
    raw, shown = "https://raw.githubusercontent.com/someone/else/v9/", "https://github.com/someone/else/blob/v9/"
    assert absolute("![a](docs/a.png) [b](docs/b.md#c)") == f"![a]({raw}docs/a.png) [b]({shown}docs/b.md#c)"
    assert absolute("[a](https://x.org) [b](#c) x(y)") == "[a](https://x.org) [b](#c) x(y)"


def test_the_readme_s_links_lead_somewhere():
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#]+)", page)
    assert targets
    for target in targets:
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_the_statement_on_the_weights_is_that_of_the_model_card():
    card = (ROOT / "mgca_filter" / "models" / "mgca_small.md").read_text(encoding="utf-8")
    statement = card.partition("## Licence of the weights\n")[2].strip()
    assert statement
    assert (ROOT / "LICENSE-WEIGHTS.md").read_text(encoding="utf-8").strip().endswith(statement)


def test_the_citation_is_of_this_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {mgca_filter.__version__}\n" in citation


@pytest.mark.slow
def test_wheel_alone_runs_the_command_outside_the_source_tree(wheel, tmp_path):
    """Zip imports cannot open the model file, hence unpacked; dependencies come from this environment."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    images = ROOT / "examples" / "images"
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); from mgca_filter.cli import main; sys.exit(main())"
    pair = [str(images / "left.jpg"), str(images / "right.jpg"), "--K", "820,820,511.5,383.5"]
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "site"), *pair], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "status ok" in done.stdout


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_installing_beside_opencv_python_changes_nothing_of_it(wheel, tmp_path):
    """A drop-in does not replace the user's OpenCV, in which windows (``cv2.imshow``) work."""
    python = tmp_path / "env" / "bin" / "python"
    venv.create(tmp_path / "env", with_pip=True)
    install = [str(python), "-m", "pip", "install", "-q"]
    if subprocess.run([*install, "opencv-python"], capture_output=True).returncode:
        pytest.skip("no package index")
    folder = next((tmp_path / "env" / "lib").glob("python*/site-packages/cv2"))

    def files() -> dict[str, int]:
        return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*") if "__pycache__" not in path.parts}

    before = files()
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    assert files() == before
    listed = subprocess.run([str(python), "-m", "pip", "list"], check=True, capture_output=True, text=True).stdout
    assert [word for word in listed.split() if word.startswith("opencv")] == ["opencv-python"]
    assert subprocess.run([python, "-c", "import cv2; cv2.imshow"]).returncode == 0
    images = ROOT / "examples" / "images"
    command = [str(python), "-m", "mgca_filter", str(images / "left.jpg"), str(images / "right.jpg")]
    done = subprocess.run([*command, "--K", "820,820,511.5,383.5"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "status ok" in done.stdout
