"""Messages of the library in the words of a command: its options in place of Python's arguments."""

from __future__ import annotations

import argparse
import ast
import re
from functools import partial

__all__ = ["command_of", "command_words"]


def command_of(options: argparse.Namespace) -> argparse.ArgumentParser:
    """The parser of the command that was given."""
    (commands,) = (a for a in options.parser._actions if a.dest == "command")
    found: argparse.ArgumentParser = commands.choices[options.command]
    return found


def command_words(text: str, options: argparse.Namespace) -> str:
    """A message as the command says it: ``--clock cut`` for ``clock='cut'``.

    What the command has no option for stays; so do lines that show a call of Python.
    """
    if not hasattr(options, "parser"):  # what a command does is called from elsewhere
        return text
    named = [
        (action.dest, long)
        for action in command_of(options)._actions
        if (long := next((o for o in action.option_strings if o.startswith("--")), None))
    ]
    lines = text.split("\n")
    return "\n".join(x if x.startswith("  call: ") else _line(x, named) for x in lines)


def _line(text: str, named: list[tuple[str, str]]) -> str:
    text = re.sub(r" \(of read_table, or table\.with_floor\('\w+'\)\)", "", text)
    if "rest_length" in dict(named):
        example = r"rest_length in metres, as in read_table\(.*?\)"
        text = re.sub(example, "--rest-length, as --rest-length '300 mm'", text)
    text = re.sub(r"\bread_\w+\(\.\.\., (\w+=[^)]*)\)", r"\1", text)
    for name, option in named:
        text = text.replace(f"{name}=True", option)
        # mass=2.0 alone is an example of NAME=VALUE
        plain = r"|[\d.]*\d" if "_" in name else ""
        value = rf"(\{{[^}}]*\}}|\[(?:'[^']*'|[^\[\]'])*\]|'[^']*'|None|\.\.\.{plain})(?!\w)"
        text = re.sub(rf"(?<![\w.]){name}={value}", partial(_option, option), text)
    return text


def _option(option: str, found: re.Match[str]) -> str:
    try:
        given = ast.literal_eval(found[1])
    except (SyntaxError, ValueError):
        return f"{option} {found[1]}"
    if given is None:
        return f"{option} none" if option != "--missing" else option  # of no text at all
    if isinstance(given, dict):
        parts = [f"{n}={'...' if v is ... else v}" for n, v in given.items()]
    else:
        several = given if isinstance(given, list) else [given]
        parts = ["..." if v is ... else str(v) for v in several]
    return " ".join([option, *map(_quoted, parts)])


def _quoted(part: str) -> str:
    return f"'{part}'" if set(part) & set(" *[]()") else part
