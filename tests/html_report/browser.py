"""Reports in headless Chromium: what the page shows once its scripts have run, and answers to questions put to it."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium (Debian: apt-get install chromium): the page itself is not tested"
)
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1400,900",
    "--virtual-time-budget=6000", "--enable-logging=stderr",
)  # fmt: skip
_POLICY = re.compile(r"<meta http-equiv=\"Content-Security-Policy\"[^>]*>")
_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Page:
    """What Chromium made of a file: the document as it stands in the end, and the console's complaints."""

    dom: str
    complaints: list[str]


def open_page(path: Path, profile: Path, *flags: str, place: str = "") -> Page:
    """Load a file, without a network, and give back the document after its scripts; ``place`` goes behind the #."""
    address = path.as_uri() + (f"#{place}" if place else "")
    command = [CHROMIUM, *_FLAGS, f"--user-data-dir={profile}", *flags, "--dump-dom", address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "willReadFrequently" not in line]
    return Page(done.stdout, complaints)


def ask(path: Path, folder: Path, checks: str, questions: dict[str, Any], *flags: str) -> dict[str, Any]:
    """Run functions of a file of checks in a copy of the page, each with its argument, and give back what they return.

    The copy lacks the page's policy, which forbids every script but its own; that the policy works is a test of its
    own.
    """
    page_text, found = _POLICY.subn("", path.read_text(encoding="utf-8"))
    assert found == 1
    scripts = "".join((_HERE / file).read_text(encoding="utf-8") for file in (checks, "harness.js"))
    call = f"addEventListener('load', () => setTimeout(() => answer({json.dumps(questions)}), 300));"
    asked = f"<script>(() => {{\n{scripts}\n{call}\n}})();</script></body>"
    copy = folder / "asked.html"
    copy.write_text(page_text.replace("</body>", asked), encoding="utf-8")
    page = open_page(copy, folder / "profile", *flags)
    assert page.complaints == []
    outcome = re.search(r'<pre id="outcome">(.*?)</pre>', page.dom, re.DOTALL)
    assert outcome, "the checks did not end"
    answers: dict[str, Any] = json.loads(html.unescape(outcome[1]))
    return answers
