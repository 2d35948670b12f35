"""What a file does not hold and its user knows: a contraction, a muscle, a run, the same for all
its rows; given as it is, or by a pattern of the file's name.

A pattern has headers in braces, ``"{muscle}_{contraction [%]}pct_run{run}.csv"``, and ``*`` for
what does not count.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...core.calibration import COUNTS, spelled
from ...core.errors import InputError, UnknownNameError
from ...core.quantities import quantity
from .headers import NAMES, is_unit, parse_header
from .labels import LABELS
from .raw import RawTable

__all__ = ["checked_constants", "glob_of", "labels_of", "require_pattern", "with_constants"]

MEASURES = {"pressure": "Pa", "force": "N", "length": "m", "contraction": "1"}
"""Quantities of a force table, and their units."""
_FIELD = re.compile(r"\{([^{}]+)\}")
_NUMBER = r"[+-]?\d+(?:[.,p]\d+)?"


def checked_constants(given: Any) -> dict[str, Any]:
    """{header: value}: quantities in SI, whatever the unit they were said in. Raises InputError."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(
            f"constants = {given!r}: give {{name: value}}, as {{'contraction': '5 %', 'run': 2}}"
        )
    made: dict[str, Any] = {}
    for name, value in given.items():
        plain, said = parse_header(str(name))
        if plain in (*LABELS, "muscle"):
            made[plain] = str(value)
            continue
        measured = MEASURES.get(plain)
        if isinstance(value, str):
            match = re.match(rf"\s*({_NUMBER}|[+-]?[\d.]+[eE][+-]?\d+)\s*(\S.*)$", value)
            if match and is_unit(match[2]) and measured is None and said is None:
                made[f"{name} [{match[2]}]"] = float(match[1].replace(",", "."))
                continue
        if measured is not None and said is None:
            where = f"constants[{name!r}]"
            value = quantity(
                where, value.replace(",", ".") if isinstance(value, str) else value, measured
            )
            made[f"{plain} [{measured}]"] = value
        elif isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(
                f"constants[{name!r}] = {value!r}: give a number, with its unit where it has one, "
                "as '300 mm'; muscle, branch and run may be any text"
            )
        else:
            made[str(name)] = value
    return made


def require_pattern(pattern: Any) -> list[str]:
    """The headers of a pattern, checked. Raises InputError."""
    if not isinstance(pattern, str) or not pattern.strip():
        raise InputError(
            f"pattern = {pattern!r}: give the form of the files' names, with headers in braces, as "
            "'{muscle}_{contraction [%]}pct_run{run}.csv'"
        )
    rest = _FIELD.sub("", pattern)
    fields = [f.strip() for f in _FIELD.findall(pattern)]
    if "{" in rest or "}" in rest or len(set(fields)) < len(fields):
        raise InputError(
            f"pattern = {pattern!r}: each brace holds one header, and each header stands once"
        )
    for header in fields:
        said = parse_header(header)[1]
        if said is not None and not is_unit(said):
            raise InputError(f"pattern = {pattern!r}: {said!r} in {header!r} is no unit")
    return fields


def glob_of(pattern: str) -> str:
    """The files that a pattern may fit."""
    return _FIELD.sub("*", pattern)


def labels_of(name: str | None, pattern: str | None) -> dict[str, Any]:
    """{header: value} that a file's name holds. Raises InputError where it does not fit."""
    fields = [] if pattern is None else require_pattern(pattern)
    if pattern is None or not fields:
        return {}
    form = Path(pattern).name
    match = None if name is None else re.fullmatch(_expression(form), name, re.IGNORECASE)
    if match is None:
        raise InputError(f"pattern = {form!r} does not fit the name {str(name)!r}; correct it")
    inside = [f.strip() for f in _FIELD.findall(form)]
    made: dict[str, Any] = {}
    for header, text in zip(inside, match.groups(), strict=True):
        plain, said = parse_header(header)
        if _is_number(header):
            if not re.fullmatch(_NUMBER, text):
                raise InputError(
                    f"{name}: {text!r} stands where pattern = {form!r} has {header!r}, a number"
                )
            if plain in MEASURES and said is None:
                raise InputError(
                    f"pattern = {form!r}: say the unit of {plain}, as '{{{plain} [%]}}' or "
                    f"'{{{plain} [mm]}}'"
                )
            made[header] = float(re.sub("[,p]", ".", text))
        else:
            made[plain if plain in (*LABELS, "muscle") else header] = text
    return made


def _is_number(header: str) -> bool:
    plain, said = parse_header(header)
    return said is not None or plain in MEASURES


def _expression(form: str) -> str:
    """A regular expression of a pattern: numbers where a unit is named, else words."""
    parts, at = [], 0
    for match in _FIELD.finditer(form):
        parts.append(re.escape(form[at : match.start()]))
        parts.append(f"({_NUMBER})" if _is_number(match[1]) else "(.+?)")
        at = match.end()
    parts.append(re.escape(form[at:]))
    return "".join(parts).replace(r"\*", ".*").replace(r"\?", ".")


def with_constants(raw: RawTable, constants: Mapping[str, Any]) -> RawTable:
    """The table with columns of one value. Raises InputError where it has such a column already."""
    names = {parse_header(h)[0]: h for h in raw.columns}
    for header in constants:
        plain = parse_header(header)[0]
        alike = NAMES.get(plain, frozenset({plain}))
        there = next((h for name, h in names.items() if name in alike), None)
        if there is not None:
            raise InputError(
                f"{raw.label} has a column {there!r} already, beside the constant {header!r}; "
                "leave one of them"
            )
        said = parse_header(header)[1]
        if said is not None and spelled(said).lower() not in COUNTS and not is_unit(said):
            raise UnknownNameError(f"unit of constant {header!r}", said, MEASURES.values())
    words = ", ".join(f"{n} = {v}" for n, v in constants.items())
    columns = {n: [v] * len(raw) for n, v in constants.items()}
    return replace(
        raw,
        columns={**raw.columns, **columns},
        dialect=(*raw.dialect, f"constant: {words}"),
        constant=frozenset(columns),
    )
