"""Messages of the library in the words of a command: its options in place of Python's arguments."""

from __future__ import annotations

import argparse
import re

__all__ = ["command_words"]

NAMED = (
    *("columns", "units", "ambient_pressure", "sheet", "pick", "constants", "pattern", "encoding"),
    *("bad_lines", "skip", "delimiter", "missing", "decimal", "pivot", "floor", "fixed"),
    *("rest_length", "diameter", "clock", "max_gap", "sample_time"),
)
"""Arguments that messages name as remedies, and that commands have as options."""
VALUE = r"(?P<value>'[^']*'|\{[^{}]*\}|\[(?:'[^']*'|[^\[\]'])*\]|None|[\d.e+-]*\d|\.\.\.)"


def command_words(text: str, options: argparse.Namespace) -> str:
    """A message as the command says it: ``--sheet 'M3'`` for ``sheet='M3'``.

    What the command has no option for stays; so do lines that show a call of Python.
    """
    names = [n for n in NAMED if hasattr(options, n)]
    if not names:
        return text
    lines = text.split("\n")
    return "\n".join(x if x.startswith("  call: ") else _line(x, names) for x in lines)


def _line(text: str, names: list[str]) -> str:
    text = re.sub(r" \(of read_table, or table\.with_floor\('\w+'\)\)", "", text)
    if "rest_length" in names:
        example = r"rest_length in metres, as in read_table\(.*?\)"
        text = re.sub(example, "--rest-length, as --rest-length '300 mm'", text)
    return re.sub(rf"(?<![\w.]){_any(names)}={VALUE}", _option, text)


def _any(names: list[str]) -> str:
    return rf"(?P<name>{'|'.join(names)})"


def _option(found: re.Match[str]) -> str:
    value = found["value"]
    if value == "None":
        value = "" if found["name"] == "missing" else "none"
    elif value.startswith("{"):
        value = re.sub(r"'([^']*)': ('[^']*'|[^,}]+)", r"\1=\2", value[1:-1]).replace(", ", " ")
    elif value.startswith("["):
        value = re.sub(r", *(?=['\d])", " ", value[1:-1])
    value = re.sub(r"'([\w.+-]+)'", r"\1", value)  # a shell needs no quotes there
    return f"--{found['name'].replace('_', '-')} {value}".rstrip()
