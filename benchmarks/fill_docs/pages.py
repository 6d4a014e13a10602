"""The generated places of the documentation, and what they say of the files behind their figures."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path

import cv2

from mgca_filter.match_filter import PUBLISHED_MODELS, model_path


def provenance() -> str:
    """Which models and library gave the figures."""
    files = [model_path(name) for name in PUBLISHED_MODELS]
    digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    names = ", ".join(f"`{path.name}` {digest[:12]}" for path, digest in zip(files, digests))
    return f"{names}, OpenCV {cv2.__version__}."


def fill(page: str, name: str, content: str) -> str:
    """The page with ``content`` between the comments ``<!-- name -->`` and ``<!-- /name -->``.

    Raises:
        ValueError: the page does not have exactly one such place.
    """
    place = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- /{re.escape(name)} -->)", re.DOTALL)
    filled, count = place.subn(lambda match: f"{match[1]}{content}\n{match[2]}", page)
    if count != 1:
        raise ValueError(f"no {name} markers" if count == 0 else f"{count} places named {name}, expected one")
    return filled


def fill_file(path: Path, places: Mapping[str, str]) -> None:
    """The same for a file and all of its ``places``: content by name.

    Raises:
        SystemExit: a place is missing or there more than once; the message names the file, which stays as it is.
    """
    page = path.read_text(encoding="utf-8")
    for name, content in places.items():
        try:
            page = fill(page, name, content)
        except ValueError as error:
            raise SystemExit(f"{path}: {error}") from error
    path.write_text(page, encoding="utf-8")
