"""Tables of text cells in three styles."""

from __future__ import annotations

import pytest

from mgca_filter.tables import STYLES, markdown_head, markdown_row, render_table

HEADER = ["method", "mAP@5", "note"]
ROWS = [["a | b", "50.0", "x_1"], ["longer name", "100.0", ""]]


def test_markdown_is_what_its_rows_are() -> None:
    table = render_table(HEADER, ROWS, title="Figures", align="lrl")
    assert table.splitlines() == [
        "## Figures",
        "",
        "| method | mAP@5 | note |",
        "|---|---:|---|",
        r"| a \| b | 50.0 | x_1 |",
        "| longer name | 100.0 |  |",
    ]
    assert table.endswith("\n".join([markdown_head(HEADER, "lrl"), *map(markdown_row, ROWS)]))


def test_text_stands_in_columns() -> None:
    assert render_table(HEADER, ROWS, "text", align="lrl").splitlines() == [
        "method       mAP@5  note",
        "-----------  -----  ----",
        "a | b         50.0  x_1",
        "longer name  100.0",
    ]


def test_latex_escapes_and_aligns() -> None:
    table = render_table(["\\{}", "p %"], [["a & b_1 – 3°", "−1 #$"]], "latex", title="50 %")
    assert r"\begin{tabular}{lr}" in table
    assert r"    \textbackslash{}\{\} & p \% \\" in table
    assert r"    a \& b\_1 -- 3$^\circ$ & $-$1 \#\$ \\" in table
    assert r"\caption{50 \%}" in table
    assert "caption" not in render_table(HEADER, ROWS, "latex")


@pytest.mark.parametrize(
    ("align", "rule"), [("lr", "|---|---:|---:|"), ("l", "|---|---|---|"), ("rlrr", "|---:|---|---:|")]
)
def test_the_last_letter_goes_on(align: str, rule: str) -> None:
    assert markdown_head(HEADER, align).splitlines()[1] == rule


@pytest.mark.parametrize("style", STYLES)
def test_a_table_may_have_no_rows_and_no_row_another_length(style: str) -> None:
    assert "mAP@5" in render_table(HEADER, [], style)
    with pytest.raises(ValueError, match="expected 3 cells"):
        render_table(HEADER, [["a", "b"]], style)
    for align in ("", "lc"):
        with pytest.raises(ValueError, match="align"):
            render_table(HEADER, ROWS, style, align=align)
