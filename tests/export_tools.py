"""The modules of the folder export/, for the tests."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

EXPORT = Path(__file__).parent.parent / "export"
sys.path.append(str(EXPORT))  # the scripts import each other, as they can where they are run


def load_export_module(name: str) -> ModuleType:
    """A module of export/, which is no package."""
    spec = importlib.util.spec_from_file_location(f"export_{name}", EXPORT / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
