"""Put what the studies printed into ``docs/trust.md``: ``python export/write_trust.py focal=FILE stress=FILE``.

Each file is the standard output of a command that the page names; a place may be given several files, one a scene say.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "trust.md"


def fill(page: str, name: str, content: str) -> str:
    """The page with ``content`` between the comments ``<!-- name -->`` and ``<!-- /name -->``.

    Raises:
        ValueError: the page has no such place.
    """
    place = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- /{re.escape(name)} -->)", re.DOTALL)
    filled, count = place.subn(lambda match: f"{match[1]}{content}\n{match[2]}", page)
    if count != 1:
        raise ValueError(f"{PAGE.name}: expected one place named {name}, found {count}")
    return filled


def main() -> None:
    """Fill the places that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("places", nargs="+", metavar="NAME=FILE", help="place in the page, and what goes there")
    options = parser.parse_args()
    contents: dict[str, list[str]] = {}
    for place in options.places:
        name, _, file = place.partition("=")
        path = Path(file)
        title = f"{path.stem}:\n\n" if sum(p.startswith(f"{name}=") for p in options.places) > 1 else ""
        contents.setdefault(name, []).append(title + path.read_text(encoding="utf-8").strip())
    page = PAGE.read_text(encoding="utf-8")
    for name, texts in contents.items():
        page = fill(page, name, "\n\n".join(texts))
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
