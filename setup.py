"""What setup.cfg cannot say: links are those of the repository that builds, and absolute in the long description.

README.md has links into the repository, which lead nowhere on PyPI's page. GitHub's workflows say in
``GITHUB_REPOSITORY`` whose repository they run in, and in ``GITHUB_REF_NAME`` of which tag or branch.
"""

import os
import re
from pathlib import Path

from setuptools import setup

REPOSITORY = os.environ.get("GITHUB_REPOSITORY", "mgca-filter/mgca_filter")
REVISION = os.environ.get("GITHUB_REF_NAME", "main")
PAGE = f"https://github.com/{REPOSITORY}"
# [text](target) and ![text](target), where the target is neither absolute nor a place of the page itself.
RELATIVE_LINK = re.compile(r"(!?)(\[[^\]]*\])\((?![a-z]+:|#|/)([^)\s]+)\)")


def absolute(page: str) -> str:
    """The page with links into the repository written out: pictures raw, everything else as GitHub shows it."""

    def link(match: re.Match[str]) -> str:
        picture, text, target = match.groups()
        base = f"https://raw.githubusercontent.com/{REPOSITORY}/{REVISION}" if picture else f"{PAGE}/blob/{REVISION}"
        return f"{picture}{text}({base}/{target})"

    return RELATIVE_LINK.sub(link, page)


setup(
    long_description=absolute(Path(__file__).with_name("README.md").read_text(encoding="utf-8")),
    url=PAGE,
    project_urls={
        "Documentation": f"{PAGE}/tree/{REVISION}/docs",
        "Source": PAGE,
        "Issues": f"{PAGE}/issues",
        "Changelog": f"{PAGE}/blob/{REVISION}/CHANGELOG.md",
    },
)
