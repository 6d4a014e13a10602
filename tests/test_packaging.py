"""What is installed, and that the documents name the commands that are run."""

import configparser
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TEST_COMMAND = 'python -m pip install ".[test]" && ./check'


def test_continuous_integration_runs_the_readme_s_test_command():
    assert TEST_COMMAND in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    commands = [line.strip() for line in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()]
    install, check = TEST_COMMAND.split(" && ")
    assert install in commands
    assert any(command.split()[:1] == [check] for command in commands)


def test_running_the_filter_needs_no_torch():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    required = setup["options"]["install_requires"].split()
    assert [name.split(">")[0] for name in required] == ["numpy", "opencv-contrib-python-headless", "onnxruntime"]


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
        if name.startswith(("mgca_filter/", "setup.cfg", "pyproject.toml", "README.md", "LICENSE")):
            target = folder / "source" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(folder)]
    subprocess.run([*command, str(folder / "source")], check=True, capture_output=True, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_wheel_holds_the_model_its_card_and_the_type_marker(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert "mgca_filter/py.typed" in names
    assert "mgca_filter/fit/choice.json" in names
    assert any(name.startswith("mgca_filter/models/") and name.endswith(".onnx") for name in names)
    assert any(name.startswith("mgca_filter/models/") and name.endswith(".md") for name in names)
    assert any(name.endswith("LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "examples/", "export/", "benchmarks/")) for name in names)


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
def test_the_filter_runs_over_the_plain_opencv_wheel(wheel, tmp_path):
    """Both wheels write the folder cv2; whichever files win, the filter works."""
    python = tmp_path / "env" / "bin" / "python"
    venv.create(tmp_path / "env", with_pip=True)
    install = [str(python), "-m", "pip", "install", "-q"]
    if subprocess.run([*install, "opencv-python"], capture_output=True).returncode:
        pytest.skip("no package index")
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    listed = subprocess.run([str(python), "-m", "pip", "list"], check=True, capture_output=True, text=True).stdout
    assert {"opencv-python", "opencv-contrib-python-headless"} <= set(listed.split())
    images = ROOT / "examples" / "images"
    command = [str(python), "-m", "mgca_filter", str(images / "left.jpg"), str(images / "right.jpg")]
    done = subprocess.run([*command, "--K", "820,820,511.5,383.5"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "status ok" in done.stdout
