"""Tables of text cells: plain text, Markdown or LaTeX.

Callers turn their figures into cells; here cells become lines. ``render_table`` makes a whole table, ``markdown_head``
and ``markdown_row`` one that is printed while its rows are still being measured.

Columns are aligned by a string of ``l`` and ``r``, one letter a column, the last of which goes on to the right: the
default ``"lr"`` is names and then numbers, ``"llr"`` two columns of words first. A missing figure is :data:`MISSING`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

Style = Literal["text", "markdown", "latex"]
STYLES: tuple[Style, ...] = ("text", "markdown", "latex")
MISSING = "–"


def render_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    style: Style = "markdown",
    *,
    align: str = "lr",
    title: str = "",
) -> str:
    """A table in one of the styles, without a line feed at its end.

    Args:
        header: names of the C columns; may be empty strings.
        rows: C cells each.
        style: "text" pads cells to columns; "markdown" does not, so that a row changes when its own figures do; "latex"
            is a floating table with the rules of ``booktabs``.
        align: see the module.
        title: stands above the table, as a heading of second order in Markdown, as the caption in LaTeX.

    Raises:
        ValueError: a row has another number of cells than the header, or ``align`` is no string of l and r.
    """
    body = [list(row) for row in rows]
    sides = _sides(align, len(header))
    for row in body:
        if len(row) != len(header):
            raise ValueError(f"expected {len(header)} cells, as the header has, got {len(row)}: {row}")
    if style == "latex":
        return _latex(header, body, sides, title)
    if style == "markdown":
        lines = [markdown_head(header, align), *(markdown_row(row) for row in body)]
    else:
        lines = _text(header, body, sides)
    return "\n".join([*([heading(title, style), ""] if title else []), *lines])


def heading(title: str, style: Style) -> str:
    """The title of a table or of a paragraph beside tables."""
    return f"## {title}" if style == "markdown" else title


def markdown_head(header: Sequence[str], align: str = "lr") -> str:
    """The first two lines of a Markdown table: names of the columns, and their alignment."""
    rule = "|".join("---" if side == "l" else "---:" for side in _sides(align, len(header)))
    return f"{markdown_row(header)}\n|{rule}|"


def markdown_row(cells: Iterable[str]) -> str:
    """One more line of a Markdown table; a bar within a cell is escaped."""
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _sides(align: str, columns: int) -> str:
    """One letter for each column."""
    if not align or set(align) - {"l", "r"}:
        raise ValueError(f"align must be letters l and r, got {align!r}")
    return align.ljust(columns, align[-1])[:columns]


def _text(header: Sequence[str], body: Sequence[Sequence[str]], sides: str) -> list[str]:
    widths = [max(len(row[column]) for row in [header, *body]) for column in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = (cell.ljust(w) if side == "l" else cell.rjust(w) for cell, w, side in zip(cells, widths, sides))
        return "  ".join(padded).rstrip()

    return [line(header), "  ".join("-" * width for width in widths), *map(line, body)]


def _latex(header: Sequence[str], body: Sequence[Sequence[str]], sides: str, title: str) -> str:
    rows = [" & ".join(_escaped(cell) for cell in cells) + r" \\" for cells in [header, *body]]
    lines = [
        r"\begin{table}",
        r"  \centering",
        rf"  \begin{{tabular}}{{{sides}}}",
        r"    \toprule",
        f"    {rows[0]}",
        r"    \midrule",
        *(f"    {row}" for row in rows[1:]),
        r"    \bottomrule",
        r"  \end{tabular}",
        *([rf"  \caption{{{_escaped(title)}}}"] if title else []),
        r"\end{table}",
    ]
    return "\n".join(lines)


def _escaped(text: str) -> str:
    """Text with the characters that LaTeX reads otherwise escaped."""
    special = {"\\": r"\textbackslash{}", "–": "--", "−": "$-$", "°": r"$^\circ$"}
    special |= {character: "\\" + character for character in "&%$#_{}"}
    return "".join(special.get(character, character) for character in text)
