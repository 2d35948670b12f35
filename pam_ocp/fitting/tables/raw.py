"""Columns as they stand in a source, with their headers, units and places; and what a file does not
hold and its user knows: a contraction, a muscle, a run, the same for all its rows, given as it is
or by a pattern of the file's name.

A pattern has headers in braces, ``"{muscle}_{contraction [%]}pct_run{run}.csv"``, and ``*`` for
what does not count.
"""

from __future__ import annotations

import codecs
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.calibration import AMBIENT, COUNTS, spelled
from ...core.errors import InputError, UnknownNameError, require_count, require_positive
from ...core.files import MOST_NAME
from ...core.quantities import UnitWarning, doubt, outside, quantity
from .cells import (
    LABELS,
    NAMES,
    QUANTITIES,
    decimal_of,
    is_unit,
    matching,
    numbers_of,
    parse_header,
)


class ReadingWarning(UserWarning):
    """Not all of a file was taken as it stands: what was left out or mended, and where.

    Examples
    --------
    >>> rows = {"p [bar]": [1, 2, 2], "l [mm]": [300, 300, 290], "F [N]": [200, 500, ""]}
    >>> len(pam.read_table(rows, rest_length=0.300))  # and a warning of the row that is left out
    2
    """


class Doubt(str):
    """A note on what no rig of this field measures, with the keyword that settles it."""

    __slots__ = ()


def say(label: str, notes: Sequence[str]) -> None:
    """Warn of what was left out or mended, and of what is doubted; nothing where nothing is."""
    for kind, category in ((False, ReadingWarning), (True, UnitWarning)):
        words = [note for note in notes if isinstance(note, Doubt) is kind]
        if words:
            warnings.warn(f"{label}: {'; '.join(words)}", category, stacklevel=outside())


@dataclass(frozen=True)
class RawTable:
    """Columns as they stand in the source.

    lines : line (or row of the sheet) of each row in its file; rows : its number. decimal : sign in
    cells of text. stated : {header: unit} of a row of units. dialect : how the file was understood,
    notes : what was left out, mended or doubted, both in words. signs : decimal signs of single
    columns. decimal_given : the user said the decimal sign. own : written by this package.
    constant : headers of columns that are not in the file.
    """

    label: str
    columns: Mapping[str, Sequence[Any]]
    lines: Sequence[int] | None = None
    rows: Sequence[int] | None = None
    decimal: str | None = None
    stated: Mapping[str, str] = field(default_factory=dict)
    dialect: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    signs: Mapping[str, str] = field(default_factory=dict)
    decimal_given: bool = False
    own: bool = False
    constant: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return max(map(len, self.columns.values()), default=0)

    def row(self, index: int) -> str:
        """``row 3 (line 5)``, for messages."""
        line = f" (line {self.lines[index]})" if self.lines else ""
        return f"row {(self.rows[index] if self.rows is not None else index) + 1}{line}"

    def header(
        self, quantity: str, spellings: Collection[str], columns: Mapping[str, str]
    ) -> str | None:
        """The header of a quantity: the user's choice, else the one spelled so; None without."""
        if quantity in columns:
            return columns[quantity]
        free = [h for h in self.columns if h not in columns.values()]
        fitting = matching(frozenset(spellings), free)
        if len(fitting) > 1:
            raise InputError(
                f"{self.label}: {' and '.join(map(repr, fitting))} both read as {quantity}; "
                f"choose one with columns={{{quantity!r}: {fitting[0]!r}}}"
            )
        return fitting[0] if fitting else None

    def unit(self, header: str) -> str | None:
        """The unit that stands in a header, or in the row of units below it."""
        name, said = parse_header(header)
        if said is None and header in self.stated:
            said = parse_header(f"{name} [{self.stated[header]}]")[1]
        return said

    def sign(self, header: str) -> str:
        """The decimal sign of a column."""
        return self.signs.get(header) or self.decimal or decimal_of(self.columns[header])

    def numbers(self, header: str) -> NDArray[np.float64]:
        """A column in the unit in which it stands, NaN for empty cells."""
        cells = self.columns[header]
        found, bad = numbers_of(cells, self.sign(header))
        if bad is None:
            infinite = np.nonzero(np.isinf(found))[0]
            if not infinite.size:
                return found
            bad = int(infinite[0])
        place = f"{self.label}: column {header!r}, {self.row(bad)}"
        shown = repr(cells[bad])[:MOST_NAME]
        if np.isinf(found[bad]):
            raise InputError(f"{place} holds {found[bad]}; fill it or take the row out")
        raise InputError(
            f"{place} holds {shown}, which is no number; correct it, say missing=[...] if it marks "
            "a missing value, or leave such rows out with bad_lines='drop'"
        )

    def taken(self, kept: NDArray[np.intp], *notes: str) -> RawTable:
        """The rows of these indices, with what is to be said of the others."""
        index = [int(i) for i in kept]
        rows = self.rows or range(len(self))
        return replace(
            self,
            columns={n: [c[i] for i in index] for n, c in self.columns.items()},
            lines=[self.lines[i] for i in index] if self.lines else None,
            rows=[rows[i] for i in index],
            notes=(*self.notes, *notes),
        )


MOST_LOST = 0.5
"""Share of rows that may be dropped for their empty cells without a word from the user."""


def complete(raw: RawTable, headers: Sequence[str], empty: str = "drop") -> RawTable:
    """The rows with numbers in all of these columns; others are dropped, noted, or refused
    (``empty``).
    """
    missing = {h: np.isnan(raw.numbers(h)) for h in headers}
    gone = np.any(list(missing.values()), axis=0) if missing else np.zeros(len(raw), bool)
    if not np.any(gone):
        return raw
    counts = {h: int(m.sum()) for h, m in missing.items() if m.any()}
    worst = max(counts, key=lambda h: counts[h])
    first = int(np.argmax(missing[worst]))
    if empty == "refuse":
        raise InputError(
            f"{raw.label}: column {worst!r}, {raw.row(first)} is empty; fill it or take the row out"
        )
    if gone.sum() > MOST_LOST * len(raw):
        raise InputError(
            f"{raw.label}: column {worst!r} is empty in {counts[worst]} of {len(raw)} rows (first "
            f"{raw.row(first)}): fill it, name another with columns={{...}}, or take the rows out"
        )
    words = ", ".join(f"{n} in {h!r}" for h, n in counts.items())
    dropped = f"{int(gone.sum())} of {len(raw)} rows dropped for empty cells ({words}; first "
    return raw.taken(np.nonzero(~gone)[0], f"{dropped}{raw.row(first)})")


# ---- what the user says --------------------------------------------------------------------------
@dataclass(frozen=True)
class Reading:
    """What the user says of a source, whatever it holds, as ``read_table`` and ``read_record`` take
    it, checked. names : of the columns from the left, where ``columns`` lists them. Raises
    InputError.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    ambient_pressure: float = AMBIENT
    sheet: str | int | None = None
    skip: int = 0
    pick: str | tuple[str, ...] | None = None
    pivot: tuple[str, ...] | None = None
    delimiter: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    bad_lines: str = "refuse"
    constants: Mapping[str, Any] = field(default_factory=dict)
    pattern: str | None = None
    empty: str = "drop"
    missing: Any = "found"
    names: tuple[str | None, ...] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        require_count("skip", self.skip, 0)
        for name, known in (
            ("decimal", (None, ".", ",")),
            ("bad_lines", ("refuse", "drop")),
            ("empty", ("drop", "refuse")),
        ):
            value = getattr(self, name)
            if value not in known:
                shown = " or ".join(repr(k) for k in known if k)
                raise InputError(f"{name} = {value!r}: choose {shown}")
        if self.encoding is not None:
            _require_encoding(self.encoding)
        if self.pattern is not None:
            require_pattern(self.pattern)
        cut: Any = self.delimiter
        if cut is not None and (not isinstance(cut, str) or len(cut) != 1):
            raise InputError(f"delimiter = {cut!r}: give one character, ' ' for blanks")
        columns: Any = self.columns
        mapped = isinstance(columns, Mapping)
        checked = {
            "columns": dict(columns) if mapped else {},
            "names": None if mapped or columns is None else _names(columns),
            "units": dict(self.units or {}),
            "ambient_pressure": require_ambient(self.ambient_pressure),
            "pick": tuple(self.pick) if isinstance(self.pick, list) else self.pick,
            "pivot": None if self.pivot is None else _pivot(self.pivot),
            "constants": checked_constants(self.constants),
            "missing": require_missing(self.missing),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @classmethod
    def own(cls) -> tuple[str, ...]:
        """Names of the arguments that sources of another kind do not have."""
        return tuple(f.name for f in fields(cls)[len(fields(Reading)) :])


def _names(columns: Any) -> tuple[str | None, ...]:
    if isinstance(columns, str) or not isinstance(columns, Sequence):
        raise InputError(
            f"columns = {columns!r}: give {{quantity: header}}, or a list of names from the left, "
            "as ['length [mm]', 'pressure [bar]', 'force [N]']"
        )
    return tuple(None if name is None else str(name) for name in columns)


def _require_encoding(encoding: Any) -> None:
    try:
        codecs.lookup(encoding)
    except (LookupError, TypeError):
        raise InputError(
            f"encoding = {encoding!r} is not known; give one as 'utf-8', 'cp1252' or 'shift_jis'"
        ) from None


def _pivot(said: Any) -> tuple[str, ...]:
    if isinstance(said, str) or not isinstance(said, Sequence):
        raise InputError(
            f"pivot = {said!r}: say what runs down, across and stands in the cells, as "
            "pivot=('contraction [%]', 'pressure [bar]', 'force [N]')"
        )
    return tuple(str(s) for s in said)


def require_missing(missing: Any) -> Any:
    """ "found", None, or the values that mark missing ones as a tuple. Raises InputError."""
    if missing is None or (isinstance(missing, str) and missing == "found"):
        return missing
    values = tuple(missing) if isinstance(missing, list | tuple | set) else (missing,)
    for value in values:
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise InputError(
                f"missing = {missing!r}: give the values that mark missing ones, as [9999, 'off'], "
                "'found', or None where there are none"
            )
    return values


def require_ambient(pressure: Any) -> float:
    """The pressure of the surroundings [Pa absolute]. Raises InputError; doubts a wrong unit."""
    found = require_positive("ambient_pressure", pressure, "Pa")
    doubt("ambient_pressure", found, "Pa")
    return found


# ---- constants -----------------------------------------------------------------------------------
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
        measured = QUANTITIES[plain][0] if plain in QUANTITIES else None
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
            if plain in QUANTITIES and said is None:
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
    return said is not None or plain in QUANTITIES


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
            raise UnknownNameError(
                f"unit of constant {header!r}", said, [si for si, _ in QUANTITIES.values()]
            )
    words = ", ".join(f"{n} = {v}" for n, v in constants.items())
    columns = {n: [v] * len(raw) for n, v in constants.items()}
    return replace(
        raw,
        columns={**raw.columns, **columns},
        dialect=(*raw.dialect, f"constant: {words}"),
        constant=frozenset(columns),
    )
