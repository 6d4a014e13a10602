"""The generated places of the documentation, and what they say of the files behind their figures."""

from __future__ import annotations

import hashlib
import re

import cv2

from mgca_filter import model_path


def provenance() -> str:
    """Which model and library gave the figures."""
    path = model_path()
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return f"`{path.name}` {digest[:12]}, OpenCV {cv2.__version__}."


def fill(page: str, name: str, content: str, where: str) -> str:
    """The page with ``content`` between the comments ``<!-- name -->`` and ``<!-- /name -->``.

    Raises:
        ValueError: the page, which ``where`` names, does not have exactly one such place.
    """
    place = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- /{re.escape(name)} -->)", re.DOTALL)
    filled, count = place.subn(lambda match: f"{match[1]}{content}\n{match[2]}", page)
    if count != 1:
        raise ValueError(f"{where}: expected one place named {name}, found {count}")
    return filled
