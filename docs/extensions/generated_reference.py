"""Pages from the code itself: commands from argparse, statuses from their texts, signatures as they are written.

The report of the example pair is made with them.

::

    ```{command} mgca_filter.cli
    ```
    ```{command} mgca_filter.cli colmap
    ```
    ```{statuses}
    ```
"""

from __future__ import annotations

import argparse
import importlib
import inspect
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
    """The parser with which ``main`` of a module reads its arguments, or those after the name of a subcommand.

    Raises:
        LookupError: ``main`` reads none.
    """

    def stop(parser: argparse.ArgumentParser, *_: Any) -> None:
        raise _Reached(parser)

    names = ("parse_args", "parse_known_args")
    with mock.patch.multiple(argparse.ArgumentParser, **dict.fromkeys(names, stop)):
        try:
            importlib.import_module(module).main([subcommand] if subcommand else [])
        except _Reached as reached:
            parser: argparse.ArgumentParser = reached.args[0]
        else:
            raise LookupError(f"{module} {subcommand}: main reads no arguments")
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and subcommand in action.choices:
            return action.choices[subcommand]
    return parser


def _words(text: str) -> list[nodes.Node]:
    """Plain text with ``literals``; options are literals in any case."""
    parts = re.split(r"(``.+?``|(?<!\S)--[a-z][\w-]*)", " ".join(text.split()))
    return [nodes.literal(text=part.strip("`")) if i % 2 else nodes.Text(part) for i, part in enumerate(parts) if part]


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
        module = self.arguments[0].removesuffix(".__main__")
        usage = re.sub(r"^\S*__main__\.py|^sphinx-build|^\S*pytest\S*", f"python -m {module}", usage)
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


def written_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str, str | None] | None:
    """Signatures with the annotations as the source has them: ``MatchesLike`` rather than all that it stands for."""
    if what not in ("function", "method", "class") or signature is None:
        return None
    written = inspect.signature(obj)
    words, starred = [], False
    for index, parameter in enumerate(written.parameters.values()):
        if what == "method" and index == 0:
            continue
        if parameter.kind is parameter.VAR_POSITIONAL or (parameter.kind is parameter.KEYWORD_ONLY and not starred):
            starred = True
            if parameter.kind is parameter.KEYWORD_ONLY:
                words.append("*")
        word = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "") + parameter.name
        if parameter.annotation is not parameter.empty:
            word += f": {_written(parameter.annotation)}"
        if parameter.default is not parameter.empty:
            default = repr(parameter.default)
            word += f" = {'...' if default.startswith('<') else default}"
        words.append(word)
    answer = None if written.return_annotation in (written.empty, None, "None") else _written(written.return_annotation)
    return f"({', '.join(words)})", None if what == "class" else answer


def _written(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("command", Command)
    app.add_directive("statuses", Statuses)
    app.connect("builder-inited", write_example_report)
    app.connect("autodoc-process-signature", written_signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
