"""The documentation builds without a warning and without network, and its notebooks run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("sphinx")
pytest.importorskip("myst_nb")
pytest.importorskip("furo")
nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NOTEBOOKS = {"first_steps": 4, "reconstruction": 3}
"""Pictures that each notebook must show."""
# No address outside this machine is reached: whoever tries is answered by nobody.
NO_NETWORK = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9")
ENVIRONMENT = {**os.environ, **NO_NETWORK, "PYTHONPATH": str(ROOT)}


@pytest.fixture(scope="module")
def executed(tmp_path_factory) -> dict[str, nbformat.NotebookNode]:
    """The notebooks with their answers, by name."""
    pytest.importorskip("pycolmap")
    pytest.importorskip("joblib")
    found, place = {}, {"metadata": {"path": DOCS / "notebooks"}}
    with pytest.MonkeyPatch.context() as patch:
        for variable, value in ENVIRONMENT.items():
            patch.setenv(variable, value)
        for name in NOTEBOOKS:
            notebook = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
            nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=place).execute()
            found[name] = notebook
    return found


@pytest.fixture(scope="module")
def site(executed, tmp_path_factory) -> Path:
    """The site, built with warnings as errors; the notebooks have their answers already."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(DOCS, folder / "docs")
    for name in ("examples", "mgca_filter"):  # pages show files of theirs
        (folder / name).symlink_to(ROOT / name)
    for name, notebook in executed.items():
        nbformat.write(notebook, folder / "docs" / "notebooks" / f"{name}.ipynb")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-D",
        "nb_execution_mode=off",
        "docs",
        "site",
    ]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_every_page_is_there_and_every_command_has_its_options(site):
    pages = {path.relative_to(DOCS).with_suffix("") for path in DOCS.rglob("*.md")}
    assert [page for page in pages if not (site / page).with_suffix(".html").is_file()] == []
    commands = (site / "reference" / "command_line.html").read_text(encoding="utf-8")
    for option in ("--keep-precision P", "--in-place", "--engine {local,ray}", "--run-dir", "--time-matched NAME"):
        assert option in commands
    api = (site / "reference" / "api.html").read_text(encoding="utf-8")
    assert 'id="mgca_filter.filter_matches"' in api
    assert "a homography beside or instead of it" in " ".join(api.split())


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_log_is_outside_the_navigation(site):
    start = (site / "index.html").read_text(encoding="utf-8")
    (sidebar,) = re.findall(r'<div class="sidebar-tree">.*?</aside>', start, re.S)
    assert "how_to/no_calibration.html" in sidebar
    assert "training_log.html" not in sidebar
    assert (site / "training_log.html").is_file()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_links_within_the_site_lead_somewhere(site):
    for page in site.rglob("*.html"):
        for link in re.findall(r'(?:href|src)="([^"#?]+)[^"]*"', page.read_text(encoding="utf-8")):
            if not re.match(r"[a-z]+:", link):
                assert (page.parent / link).exists(), f"{page.relative_to(site)}: {link}"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_pages_load_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        loaded = re.findall(r'<(?:script|img|iframe)[^>]* src="(https?:[^"]+)"', page.read_text(encoding="utf-8"))
        assert loaded == [], page.name


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_are_stored_without_answers(name):
    notebook = json.loads((DOCS / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 4
    assert [cell for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_run_and_show_pictures(name, executed):
    outputs = [output for cell in executed[name].cells for output in cell.get("outputs", ())]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) >= NOTEBOOKS[name]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_the_notebooks_say_is_true(executed):
    printed = {
        name: "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ()))
        for name, notebook in executed.items()
    }
    ransac, ours = (float(error) for error in re.findall(r"pose is ([\d.]+) degrees off", printed["first_steps"]))
    assert ours < 1 < ransac
    assert "8 of 8 images registered" in printed["reconstruction"]
    assert float(re.findall(r"off by ([\d.]+) cm", printed["reconstruction"])[0]) < 20


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_site_shows_the_pictures_of_the_notebooks(name, site):
    page = (site / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
    pictures = re.findall(r'<img[^>]* src="(\.\./_images/[^"]+)"', page)
    assert len(pictures) >= NOTEBOOKS[name]
    assert all((site / "notebooks" / picture).is_file() for picture in pictures)
