"""The command-line reference, made of the parsers as the documentation is built."""

import argparse
from typing import Any

from nfriction.cli import make_parser

MARK = "<!-- the commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for every page."""
    return markdown.replace(MARK, reference()) if MARK in markdown else markdown


def reference() -> str:
    """Every command with its arguments and options."""
    parser = make_parser()
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return "\n".join(describe(name, command) for name, command in commands.choices.items())


def describe(name: str, command: argparse.ArgumentParser) -> str:
    """A command as a section with a table."""
    lines = [f"## nfriction {name}", "", command.description or "", ""]
    if command.epilog:
        example = command.epilog.removeprefix("example:\n")
        lines += ["```sh", *(line.removeprefix("  ") for line in example.splitlines()), "```", ""]
    lines += ["| argument | meaning |", "|---|---|"]
    formatter = command._get_formatter()
    for action in command._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        head = ", ".join(action.option_strings) or str(action.metavar or action.dest)
        if action.option_strings and action.nargs != 0:
            value = action.metavar or (
                "{" + ",".join(map(str, action.choices)) + "}" if action.choices else "VALUE"
            )
            head += f" {value}"
        text = " ".join(formatter._expand_help(action).split()) if action.help else ""
        lines.append(f"| `{head}` | {text.replace('|', '&#124;')} |".replace("*", "&#42;"))
    return "\n".join([*lines, ""])
