"""Faults in C: the same operators on the words of a line."""

from __future__ import annotations

import re
from collections.abc import Iterator

from .faults import Fault

__all__ = ["c_faults"]

RULES: tuple[tuple[str, str, str], ...] = (
    (r" \+ ", " - ", "operator"),
    (r" - ", " + ", "operator"),
    (r" \* ", " / ", "operator"),
    (r" / ", " * ", "operator"),
    (r" \+= ", " -= ", "operator"),
    (r" < ", " <= ", "comparison"),
    (r" < ", " >= ", "comparison"),
    (r" <= ", " < ", "comparison"),
    (r" > ", " >= ", "comparison"),
    (r" > ", " <= ", "comparison"),
    (r" >= ", " > ", "comparison"),
    (r" == ", " != ", "comparison"),
    (r" != ", " == ", "comparison"),
    (r" && ", " || ", "operator"),
    (r" \|\| ", " && ", "operator"),
    (r"\bfmax\(", "fmin(", "function"),
    (r"\bfmin\(", "fmax(", "function"),
    (r"(?<=[(=?:,] )-(?=\w)", "", "sign dropped"),
    (r"(?<=\()!(?=\w)", "", "condition negated"),
    (r"(?<=if \()(?=[a-z])(?!int)", "!", "condition negated"),
    (r" \* [\w.>-]+(?:\[\w+\])?(?=[;,)])", "", "factor dropped"),
    (r" \+ [\w.>-]+(?:\[\w+\])?(?=[;,)])", "", "term dropped"),
    (r"(?<=\[)0(?=\])", "1", "index"),
    (r"(?<=int [a-z] = )0(?=;)", "1", "index"),
)
NUMBER = re.compile(r"(?<![\w.\"%])(\d+\.\d*(?:e-?\d+)?|\d+e-?\d+)(?![\w.])")
STATEMENT = re.compile(r"^ +((?:\w+\([^;{}]*\)|[\w.>\[\]*-]+ [+|]?= [^;{}]*);)", re.M)
HIDDEN = re.compile(r"/\*.*?\*/|\"(?:[^\"\\\n]|\\.)*\"|^#[^\n]*$", re.S | re.M)
SPOKEN = re.compile(r"\b(?:report|warn_\w+|snprintf|static_assert)\s*\(")
"""Calls whose arguments are words for the importer's log."""


def c_faults(file: str, text: str) -> Iterator[Fault]:
    """Faults of the code, comments, words and declarations of macros left alone."""
    bare = HIDDEN.sub(lambda m: re.sub(r"[^\n]", "\x01", m.group()), text)
    for spoken in SPOKEN.finditer(bare):
        depth, end = 1, spoken.end()
        while depth and end < len(bare):
            depth += {"(": 1, ")": -1}.get(bare[end], 0)
            end += 1
        bare = bare[: spoken.end()] + "\x01" * (end - spoken.end()) + bare[end:]

    def fault(start: int, end: int, new: str, kind: str) -> Fault:
        line = text.count("\n", 0, start) + 1
        return Fault(file, start, end, new, kind, line, text[start:end])

    for pattern, new, kind in RULES:
        for found in re.finditer(pattern, bare):
            yield fault(found.start(), found.end(), new, kind)
    for number in NUMBER.finditer(bare):
        value = float(number.group())
        yield fault(*number.span(), repr(2 * value) if value else "1.0", "constant")
    for statement in STATEMENT.finditer(bare):
        words = statement.group(1)
        if not re.match(r"(?:const |static |int |double |return|typedef)", words):
            yield fault(*statement.span(1), ";", "statement dropped")
