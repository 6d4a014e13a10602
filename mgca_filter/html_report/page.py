"""One HTML file out of its parts: nothing that it shows can run, and nothing in it asks the network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

_ASSETS = Path(__file__).parent
LIMIT_BYTES = 1_000_000


def asset(name: str) -> str:
    """Text of an asset file of the package."""
    return (_ASSETS / name).read_text(encoding="utf-8")


def build_page(title: str, body: str, words: Mapping[str, str], scripts: Sequence[str], data: Mapping[str, Any]) -> str:
    """The whole page.

    Args:
        title: of the window; any text.
        body: asset with the body, whose ``$name`` places are filled from ``words``; any text, escaped here.
        scripts: assets, in order; they share one scope and see the data as ``DATA``.
        data: what the scripts draw; arrays and numpy numbers are taken, NaN and infinity become null.

    Returns:
        HTML whose policy allows its own script and style, images inside the file, and nothing else.
    """
    style = asset("style.css")
    script = '"use strict";\n(() => {\n' + "\n".join(asset(name) for name in scripts) + "\n})();\n"
    return Template(asset("page.html")).substitute(
        title=escape(title),
        policy=f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; script-src '{_digest(script)}'",
        style=style,
        body=Template(asset(body)).substitute({name: escape(word) for name, word in words.items()}),
        data=inert_json(data),
        script=script,
    )


def escape(words: str) -> str:
    """Any text as HTML; the slash too, so that no address in a name or command looks like a reference."""
    return html.escape(words.encode("utf-8", "replace").decode()).replace("/", "&#47;")


def inert_json(data: Any) -> str:
    """JSON that can stand inside a script element: no text in it ends the element or starts another."""
    text = json.dumps(plain(data), allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text.replace("://", ":\\u002f\\u002f")  # in a name or command: no reference, so it shall not look like one


def plain(value: Any) -> Any:
    """Arrays to lists; NaN and infinity, which JSON has no word for, to None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
