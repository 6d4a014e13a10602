"""Pages from the code itself: commands from argparse, statuses from their texts, and the example pair's report.

::

    ```{command} mgca_filter.cli.pair
    ```
    ```{command} mgca_filter.cli.pipelines colmap
    ```
    ```{statuses}
    ```
"""

from __future__ import annotations

import argparse
import importlib
import re
from pathlib import Path
from typing import Any
from unittest import mock

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class _Reached(Exception):
    """A command has built its parser and is about to read the arguments."""


def parser_of(module: str, subcommand: str = "") -> argparse.ArgumentParser:
    """The parser with which ``main`` of a module reads its arguments.

    Raises:
        LookupError: ``main`` reads none, or there is no such subcommand.
    """

    def stop(parser: argparse.ArgumentParser, *_: Any) -> None:
        raise _Reached(parser)

    names = ("parse_args", "parse_known_args")
    with mock.patch.multiple(argparse.ArgumentParser, **dict.fromkeys(names, stop)):
        try:
            importlib.import_module(module).main([])
        except _Reached as reached:
            parser = reached.args[0]
        else:
            raise LookupError(f"{module}: main reads no arguments")
    if not subcommand:
        return parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and subcommand in action.choices:
            return action.choices[subcommand]
    raise LookupError(f"{module}: no subcommand {subcommand}")


def _words(text: str) -> list[nodes.Node]:
    """Plain text with ``literals``."""
    parts = re.split(r"``(.+?)``", " ".join(text.split()))
    return [nodes.literal(text=part) if i % 2 else nodes.Text(part) for i, part in enumerate(parts) if part]


def _paragraphs(text: str | None) -> list[nodes.Node]:
    """Paragraphs of a description; indented ones are shown as they are."""
    found: list[nodes.Node] = []
    for block in (text or "").strip("\n").split("\n\n"):
        if block.startswith("    "):
            found.append(nodes.literal_block(text=block))
        elif block.strip():
            found.append(nodes.paragraph("", "", *_words(block)))
    return found


def _invocation(action: argparse.Action) -> str:
    """``-o OUT.png, --output OUT.png`` as ``-o, --output OUT.png``."""
    value = ""
    if action.nargs != 0:
        choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else None
        name = action.metavar or choices or action.dest.upper()
        value = " ".join(name) if isinstance(name, tuple) else name
        if action.nargs in ("+", "*", argparse.REMAINDER):
            value += " …"
    if not action.option_strings:
        return value
    return f"{', '.join(action.option_strings)} {value}".strip()


class Command(SphinxDirective):
    """A command's usage and its options, as argparse knows them."""

    required_arguments, optional_arguments = 1, 1

    def run(self) -> list[nodes.Node]:
        parser = parser_of(*self.arguments)
        usage = parser.format_usage().removeprefix("usage: ").rstrip()
        usage = re.sub(r"^\S*__main__\.py|^sphinx-build|^\S*pytest\S*", f"python -m {self.arguments[0]}", usage)
        found: list[nodes.Node] = [*_paragraphs(parser.description), nodes.literal_block(usage, usage, language="text")]
        formatter = parser._get_formatter()
        for group in parser._action_groups:
            actions = [a for a in group._group_actions if not isinstance(a, argparse._HelpAction)]
            if not actions:
                continue
            listed = nodes.definition_list(classes=["options"])
            for action in actions:
                term = nodes.term("", "", nodes.literal(text=_invocation(action)))
                help_text = formatter._expand_help(action) if action.help else ""
                meaning = nodes.definition("", nodes.paragraph("", "", *_words(help_text)))
                listed += nodes.definition_list_item("", term, meaning)
            found += [nodes.rubric(text=(group.title or "").capitalize()), *_paragraphs(group.description), listed]
        return [*found, *_paragraphs(parser.epilog)]


class Statuses(SphinxDirective):
    """Table of all statuses: what each means, and what to do next."""

    def run(self) -> list[nodes.Node]:
        from mgca_filter import Status
        from mgca_filter.verdict_text import describe_verdict

        table = nodes.table(classes=["colwidths-given"])
        group = nodes.tgroup(cols=3)
        table += group
        for width in (20, 40, 40):
            group += nodes.colspec(colwidth=width)
        rows = [["status", "what it means", "what to do"]]
        for status in Status:
            text = describe_verdict(status.value)
            rows.append([f"``{status.value}``", text.headline, text.advice])
        head, body = nodes.thead(), nodes.tbody()
        for index, row in enumerate(rows):
            entries = [nodes.entry("", nodes.paragraph("", "", *_words(cell))) for cell in row]
            (head if index == 0 else body).append(nodes.row("", *entries))
        group += head
        group += body
        return [table]


def write_example_report(app: Sphinx) -> None:
    """The example pair's report, as ``mgca-match --html`` writes it, at the root of the site."""
    from mgca_filter.cli import main

    images = Path(app.srcdir).parent / "examples" / "images"
    target = Path(app.config.html_extra_path[0]) / "example_report.html"
    pair = [str(images / "left.jpg"), str(images / "right.jpg"), "--K", "820,820,511.5,383.5"]
    if app.builder.format == "html" and main([*pair, "--compare", "--html", str(target), "-q"]) != 0:
        raise RuntimeError("no geometry in the example pair")


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("command", Command)
    app.add_directive("statuses", Statuses)
    app.connect("builder-inited", write_example_report)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
