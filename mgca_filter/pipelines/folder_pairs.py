"""A folder of images: which there are, and which of them to match."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from .journal import PipelineError

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".jp2"))


def list_images(folder: Path) -> list[str]:
    """Paths of the images below ``folder``, relative to it, with "/", sorted.

    Raises:
        PipelineError: no such folder, or no images in it.
    """
    if not folder.is_dir():
        raise PipelineError(f"{folder}: no such folder")
    files = (path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    names = sorted(path.relative_to(folder).as_posix() for path in files)
    if not names:
        raise PipelineError(f"{folder}: no images ({', '.join(sorted(SUFFIXES))})")
    return names


def exhaustive_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Every image with every other."""
    return list(combinations(names, 2))


def sequential_pairs(names: Sequence[str], overlap: int) -> list[tuple[str, str]]:
    """Every image with the ``overlap`` next ones."""
    return [(name, later) for k, name in enumerate(names) for later in names[k + 1 : k + 1 + overlap]]


def read_pairs(path: Path, names: Sequence[str], folder: Path) -> list[tuple[str, str]]:
    """Pairs of a text file, one a line: two names, separated by a tab (for names with spaces) or by blanks.

    Empty lines and lines that begin with # are skipped, pairs that are there before in either order too.

    Raises:
        PipelineError: the file cannot be read, a line has not two names, or names an image that ``names`` lacks.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(f"{path}: {getattr(error, 'strerror', None) or 'not a text file'}") from error
    known, pairs = set(names), dict[frozenset[str], tuple[str, str]]()
    for number, line in enumerate(lines, 1):
        words = [word.strip() for word in line.split("\t")] if "\t" in line else line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 2 or words[0] == words[1]:
            raise PipelineError(f"{path}:{number}: expected two names of images, got {line.strip()!r}")
        for word in words:
            if word not in known:
                raise PipelineError(f"{path}:{number}: {word} is not in {folder}")
        pairs.setdefault(frozenset(words), (words[0], words[1]))
    return list(pairs.values())
