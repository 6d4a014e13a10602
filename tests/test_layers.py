"""Imports point down: no module imports from a floor above its own, or from a neighbour on it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import mgca_filter

PACKAGE = Path(mgca_filter.__file__).parent

# From the roof to the ground. A floor is one folder or one module, or several that know nothing of each other.
FLOORS = (
    ("__main__",),
    ("cli",),
    ("export",),
    ("training",),
    ("evaluation",),
    ("pipelines",),
    ("opencv",),
    ("match_images",),
    ("match_filter",),
    ("data",),
    ("inference",),
    ("fit",),
    ("features",),
    ("inputs",),
    ("html_report",),
    ("result",),
    ("network", "drawing", "images", "tables", "verdict_text"),
    ("exif", "geometry", "image_header", "input_file"),
    ("types", "atomic_file"),
    ("errors", "opencv_version"),
)
HEIGHT = {room: -index for index, floor in enumerate(FLOORS) for room in floor}


def rooms() -> dict[Path, str]:
    """Every module of the package with the room that it belongs to, but for the package's own front."""
    paths = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
    return {path: path.relative_to(PACKAGE).with_suffix("").parts[0] for path in paths}


def imported(path: Path) -> set[tuple[str, ...]]:
    """What a module imports of the package, wherever in its text: ``from ..fit.choice import f`` is ("fit", "choice",
    "f"). Imports for type checkers alone count like any other."""
    package = path.relative_to(PACKAGE).parts[:-1]
    found: set[tuple[str, ...]] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {
                tuple(name.name.split(".")[1:]) for name in node.names if name.name.split(".")[0] == "mgca_filter"
            }
        elif isinstance(node, ast.ImportFrom):
            module = tuple(node.module.split(".")) if node.module else ()
            if node.level:
                base = package[: len(package) - (node.level - 1)]
            elif module[:1] == ("mgca_filter",):
                base, module = (), module[1:]
            else:
                continue
            found |= {(*base, *module, name.name) for name in node.names}
    return found


def wrong_arrows(path: Path, room: str) -> list[str]:
    """Imports of a module that do not point down."""
    return [
        f"{path.relative_to(PACKAGE)} imports {'.'.join(target)}"
        for target in sorted(imported(path))
        if target[0] != "__version__" and target[0] != room and HEIGHT.get(target[0], 1) >= HEIGHT[room]
    ]


def test_every_room_has_its_floor() -> None:
    assert sorted(set(rooms().values())) == sorted(HEIGHT)


@pytest.mark.parametrize("room", sorted(HEIGHT))
def test_imports_point_down(room: str) -> None:
    assert [arrow for path, own in rooms().items() if own == room for arrow in wrong_arrows(path, room)] == []


def test_an_upward_and_a_sideways_arrow_are_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check itself can fail: in a copy of two rooms with one arrow each that points wrong."""
    monkeypatch.setattr("test_layers.PACKAGE", tmp_path)
    (tmp_path / "geometry").mkdir()
    upward, sideways = tmp_path / "geometry" / "epipolar.py", tmp_path / "drawing.py"
    upward.write_text("def f():\n    from ..fit.evidence import Evidence\n")
    sideways.write_text("from .errors import MgcaFilterError\nfrom .network import MGCANet\n")
    assert wrong_arrows(upward, "geometry") == ["geometry/epipolar.py imports fit.evidence.Evidence"]
    assert wrong_arrows(sideways, "drawing") == ["drawing.py imports network.MGCANet"]
