"""The dialect of a text file: what separates its cells, its decimal sign, its comments.

Each separator with each decimal sign is tried on a sample of the lines. The one is taken in which
most cells of rows of equal width are numbers or stamps of time, as DuckDB's sniffer does
(G. van den Burg, A. Nazábal, C. Sutton, Wrangling messy CSV files by detecting row and type
patterns, Data Min. Knowl. Disc. 33 (2019) 1799-1820). Their package clevercsv finds the same
separators in 127 of 127 texts of benchmarks/files_study.py and the tests, in twice the time, and no
decimal signs, comments or rows of units; pandas finds 91.

LabVIEW's measurement files (.lvm) have a header, then segments with headers of their own (NI,
"Specification for the LabVIEW Measurement File (.lvm)"); the package lvm_read reads what is no
number as NaN without a word, no unit, and one column of times only. Tables in HTML, or in Excel's
XML of 2003, are what programs save as .xls; pandas reads the former by lxml, the latter not.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

from ...core.errors import InputError
from ...core.files import MOST_COLUMNS, MOST_LINE, MOST_SHEET_CELLS, require_size
from .cells import decimal_of, is_empty, is_number, is_stamp, number, parted
from .raw import Reading

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "bars", " ": "blanks"}
"""What may stand between cells, the likelier ones first."""
_OF_UNITS = re.compile(r"\s*%\s*[;,|\t]")
"""A row of units that begins with per cent."""
COMMENTS = ("#", "%", "//", "!")
_STAMP_FIRST = re.compile(
    r"\"?\d{1,4}[-/.]\d\d?[-/.]\d{1,4}[T ]\d\d?:\d\d(?::\d\d(?:[.,]\d{1,9})?)?"
    r"(?: ?[AP]M)?(?: ?[+-]\d\d(?::?\d\d)?| ?[A-Z]{3,4}|Z)?\"?\s*(?P<cut>[,;\t|])"
)
"""A date and time of day at the beginning of a line, and what stands behind it."""
CUT_AFTER = 12
"""Rows of one number of digits from which on fewer in the last are those of a cut line."""
SAMPLE = 120
"""Lines that are looked at, from the lower part of the first thousand."""


class Unsaid(InputError):
    """A file can be read once a keyword says what it does not say itself."""


def nothing_in(label: str, of: str = "") -> InputError:
    """The error of a source without rows. of : what they must hold."""
    what = "is empty, or no table" if of else "is empty"
    return InputError(f"{label} {what}: it needs a header and at least one row{of}")


@dataclass
class Grid:
    """Cells row by row, as they stand. lines : where each row stands in its file. comments : lines
    of comment, cut like the others, one of which may name the columns. text : rows that are too
    short are faults, not rows whose last cells are empty.
    """

    label: str
    rows: list[Sequence[Any]]
    lines: list[int]
    decimal: str = "."
    comments: list[Sequence[str]] = field(default_factory=list)
    dialect: tuple[str, ...] = ()
    text: bool = False
    notes: tuple[str, ...] = ()

    def holds(self, cell: Any) -> bool:
        """Whether a cell is a number, or a stamp of time."""
        return is_number(cell, self.decimal) or is_stamp(cell)


def grid_of_text(text: str, label: str, suffix: str, how: Reading) -> Grid:
    """The cells of a text; of ``how`` the lines to skip, delimiter and decimal sign count."""
    skip, delimiter, decimal = how.skip, how.delimiter, how.decimal
    lines: list[tuple[int, str]] = []
    comments: list[str] = []
    for i, line in enumerate(text.splitlines(), start=1):
        if i <= skip or not line.strip(" \t\r\n,;|"):
            continue
        if line.lstrip().startswith(COMMENTS) and not _OF_UNITS.match(line):
            comments.append(line.strip().lstrip("#%/! "))
        else:
            lines.append((i, line))
    if not lines:
        raise nothing_in(label)
    longest, length = max(((i, len(line)) for i, line in lines), key=lambda found: found[1])
    if length > MOST_LINE:
        raise InputError(
            f"{label}: line {longest} has {length} characters, at most {MOST_LINE} are read; "
            "save the table as CSV, a line for each row"
        )
    pairs = _pairs(lines) if delimiter is None else None
    if pairs is not None:
        rows, places = pairs
        require_size(label, len(rows), max(map(len, rows)))
        texts = [(parted(c) or (c, ""))[0] for row in rows[1:200] for c in row if c]
        sign = decimal or decimal_of(texts)
        return Grid(label, rows, places, sign, dialect=("lines of key = value",), text=True)
    sample = [line for _, line in lines[:1000]][-SAMPLE:]
    if delimiter is None and suffix == ".tsv" and any("\t" in line for line in sample):
        delimiter = "\t"
    separator, sign = _sniffed(sample, delimiter, decimal)
    try:
        rows = _cut([line for _, line in lines], separator)
    except csv.Error as error:
        raise InputError(f"{label}: {error}; save the table as CSV anew") from None
    require_size(label, len(rows), max(map(len, rows)))
    widths = Counter(map(len, rows[-SAMPLE:]))
    width = widths.most_common(1)[0][0]
    if separator == " ":
        rows = [
            r if len(r) == width else _head(s, r, width)
            for (_, s), r in zip(lines, rows, strict=True)
        ]
    words = [_head(c, _cut([c], separator)[0], width) for c in comments if c]
    said = [f"cells between {SEPARATORS.get(separator, repr(separator))}"]
    said += ["decimal comma"] if sign == "," else []
    said += [f"{len(comments)} comment lines"] if comments else []
    said += [f"{skip} lines skipped"] if skip else []
    places = [i for i, _ in lines]
    notes: tuple[str, ...] = ()
    if not text.endswith(("\n", "\r")) and _is_cut(rows, sign):
        notes = (f"line {places[-1]}, the last, is cut off and left out",)
        rows, places = rows[:-1], places[:-1]
    return Grid(label, rows, places, sign, words, tuple(said), True, notes)


def _is_cut(rows: Sequence[Sequence[str]], sign: str) -> bool:
    """Whether the last cell of a text without a last line end has fewer digits than all above."""
    last = [row[-1] for row in rows[-CUT_AFTER:] if len(row) == len(rows[-1])]
    digits = [len(c.partition(sign)[2]) for c in last if is_number(c, sign)]
    return (
        len(digits) == len(last) == CUT_AFTER
        and len(set(digits[:-1])) == 1
        and digits[-1] < digits[0]
    )


_VALUE = (
    r"(?:\d{4}-\d\d-\d\d[T ]?[\d:.]*|\d{1,2}:\d\d:\d\d[\d.]*"
    r"|[+-]?(?:\d+(?:[.,]\d+)?|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])|[^\s,;|=:]+)"
    r"(?:\s*(?:[^\W\d_][^\s,;|=:]*|%|°)(?=[\s,;|]|$)(?!\s*[=:]))?"
)
_PAIR = re.compile(rf"(?P<key>[^\W\d][\w.\[\]/%()°-]*)\s*[=:]\s*(?P<value>{_VALUE})")
_STAMPED = re.compile(r"\[?(?P<time>(?:\d{4}-\d\d-\d\d[T ])?\d{1,2}:\d\d:\d\d[\d.,]*Z?)\]?\s")
MOSTLY = 0.7
"""Share of lines that must be key = value for a text to be of such."""


def _pairs(lines: Sequence[tuple[int, str]]) -> tuple[list[Sequence[Any]], list[int]] | None:
    """Rows of a text of ``t=0.01 p=1.2 bar F=200`` below their keys; None where it is none."""
    sample = [line for _, line in lines[:SAMPLE]]
    if sum(len(_PAIR.findall(line)) >= 2 for line in sample) < MOSTLY * len(sample):
        return None
    first = next(i for i, (_, line) in enumerate(lines) if len(_PAIR.findall(line)) >= 2)
    before, lines = lines[:first], lines[first:]
    keys: dict[str, None] = {}
    found: list[tuple[int, str, dict[str, str]]] = []
    for i, line in lines:
        stamp = _STAMPED.match(line)
        rest = line[stamp.end() :] if stamp else line
        said = [(m["key"], m["value"].strip()) for m in _PAIR.finditer(rest)]
        row = dict(said) if len({k for k, _ in said}) == len(said) else {}
        if stamp and len(row) > 1:
            row = {"time": stamp["time"], **row}
        rubbish = _PAIR.sub("", rest).strip(" \t,;|{}()")
        row = row if len(row) >= 2 and not any(c in rubbish for c in "=:") else {}
        keys |= dict.fromkeys(row)
        found.append((i, line, row))
    if not keys:
        return None
    head = list(keys)
    rows: list[Sequence[Any]] = [*([line.strip()] for _, line in before), head]
    for _, line, row in found:
        rows.append([row.get(k, "") for k in head] if row else [line.strip()])
    return rows, [*(i for i, _ in before), lines[0][0], *(i for i, _, _ in found)]


def _cut(lines: Sequence[str], separator: str) -> list[Sequence[str]]:
    if separator == " ":
        return [line.split() for line in lines]
    rows: Iterator[list[str]] = csv.reader(lines, delimiter=separator)
    return [[cell.strip() for cell in row] for row in rows]


def _head(line: str, cells: Sequence[str], width: int) -> Sequence[str]:
    """A line of words over columns between blanks: ``muscle length [mm]  p [bar]``."""
    for pattern in (r"\t+|\s{2,}", r"\s+(?![\[(])", r"[\t;,|]\s*"):
        found = re.split(pattern, line.strip())
        if len(found) == width:
            return found
    return cells


def _sniffed(sample: Sequence[str], delimiter: str | None, decimal: str | None) -> tuple[str, str]:
    """(separator, decimal sign) in which the sample reads best."""
    best: tuple[tuple[float, int, int, int], str, str] | None = None
    stamped = [m["cut"] for line in sample if (m := _STAMP_FIRST.match(line))]
    if delimiter is None and len(stamped) > 0.8 * len(sample) and len(set(stamped)) == 1:
        delimiter = stamped[0]
    tabs = Counter(line.count("\t") for line in sample).most_common(1)[0]
    tabbed = tabs[0] > 0 and tabs[1] > 0.6 * len(sample)
    for rank, separator in enumerate([delimiter] if delimiter else SEPARATORS):
        if separator == " " and tabbed and not delimiter:
            continue  # blanks stand within cells: 12.03.2024 14:05
        try:
            rows = _cut(sample, separator)
        except csv.Error:
            continue
        commas = sum("," in cell for row in rows for cell in row)
        for sign in [decimal] if decimal else ".,":
            share, width = _sense(rows, sign)
            # where both signs read all: beside commas the comma, else the point
            likely = int((sign == ",") == (commas > 0 and separator != ","))
            score = (round(share, 3), width, likely, -rank)
            if best is None or score > best[0]:
                best = (score, separator, sign)
    return (best[1], best[2]) if best else (delimiter or ",", decimal or ".")


def _sense(rows: Sequence[Sequence[str]], sign: str) -> tuple[float, int]:
    """(share of cells that make sense in rows of the commonest width, that width)."""
    kept = [row for row in rows if any(any(c.isdigit() for c in cell) for cell in row)] or rows
    width = Counter(map(len, kept)).most_common(1)[0][0]
    total = 0.0
    for row in kept:
        if len(row) == width:
            sound = sum(
                is_number(c, sign) or is_stamp(c) or _with_unit(c, sign) or 0.5 * is_empty(c)
                for c in row
            )
            total += sound / max(1, len(row))
    return (total / len(kept) if width > 1 else 0.3 * total / len(kept)), width


def _with_unit(cell: str, sign: str) -> bool:
    two = parted(cell)
    return two is not None and is_number(two[0], sign)


_END = "***End_of_Header***"


def is_lvm(text: str) -> bool:
    return text.lstrip("\ufeff \t\r\n").startswith("LabVIEW Measurement")


def segments_of(text: str, label: str) -> dict[str, Grid] | Grid:
    """{segment: its cells}, or those of the only one."""
    lines = text.splitlines()
    ends = [i for i, line in enumerate(lines) if line.startswith(_END)]
    if not ends:
        raise InputError(f"{label} has no line {_END}, which ends the header of an .lvm file")
    tabs = any(line.split()[0:2] == ["Separator", "Tab"] or "\t" in line for line in lines[:20])
    cut = "\t" if tabs else ","
    told = _told(lines[: ends[0]], cut)
    sign = "," if (told.get("Decimal_Separator") or ["."])[0] == "," else "."
    found, before = {}, ends[0] + 1
    for count, end in enumerate(ends[1:] or ends, start=1):
        until = next((e for e in ends if e > end), len(lines))
        head = _told(lines[before:end], cut) if len(ends) > 1 else told
        body = lines[end + 1 : until]
        stop = next(
            (i for i, one in enumerate(body) if i and one.startswith("Channels")), len(body)
        )
        rows = [(end + 2 + i, one.split(cut)) for i, one in enumerate(body[:stop]) if one.strip()]
        if len(rows) > 1:
            found[f"segment {count}"] = _segment(rows, head, sign, label)
        before = end + 1 + stop
    if not found:
        raise InputError(f"{label} is empty: no segment of it has rows of numbers")
    return found if len(found) > 1 else next(iter(found.values()))


def _told(lines: Sequence[str], cut: str) -> dict[str, list[str]]:
    """What lines of a header say, by its first word."""
    parts = ([cell.strip() for cell in line.split(cut)] for line in lines if line.strip())
    return {one[0]: one[1:] for one in parts}


def _segment(
    rows: list[tuple[int, list[str]]], head: dict[str, list[str]], sign: str, label: str
) -> Grid:
    """Names with their units above their cells; times by X0 and Delta_X where no column has any."""
    names, units = [cell.strip() for cell in rows[0][1]], iter(head.get("Y_Unit_Label") or [])
    kept = [i for i, name in enumerate(names) if name not in ("Comment", "")]
    cells: list[list[Any]] = [
        [row[i].strip() if i < len(row) else "" for i in kept] for _, row in rows[1:]
    ]
    titles = []
    for name in (names[i] for i in kept):
        said = "s" if name == "X_Value" else next(units, "")
        titles.append(f"{name} [{said}]" if said else name)
    clock = int(titles[:1] == ["X_Value [s]"])
    if not clock or not any(row[0] for row in cells):
        zero, step = (
            [number(c.replace(",", ".")) for c in head.get(key) or [] if not is_empty(c)]
            for key in ("X0", "Delta_X")
        )
        start = zero[0] if zero else 0.0
        times = [[start + step[0] * i] if step else [] for i in range(len(cells))]
        titles = [*(["X_Value [s]"] if step else []), *titles[clock:]]
        cells = [[*time, *row[clock:]] for time, row in zip(times, cells, strict=True)]
    return Grid(label, [titles, *cells], [line for line, _ in rows], sign)


_STARTS = re.compile(
    r"\s*(?:<\?xml|<!doctype html|<html|<table|<head|<meta|<body|<div|<style)", re.I
)
_ROWS, _CELLS = ("tr", "row", "ss:row"), ("td", "th", "cell", "ss:cell")
_TABLES = ("table", "ss:table")


def is_markup(text: str) -> bool:
    return _STARTS.match(text.lstrip("\ufeff")[:2000]) is not None and "<" in text


def tables_of(text: str) -> dict[str, list[Any]]:
    """{"table 1": rows} of the tables in HTML, {sheet: rows} of Excel's XML. Raises InputError."""
    parser = _Tables()
    parser.feed(text)
    parser.close()
    found = {n: rows for n, rows in parser.found.items() if rows}
    if not found:
        raise InputError("it is HTML or XML without a table; save the table as CSV")
    return found


class _Tables(HTMLParser):
    """Cells as they are shown; a cell that spans several stands in the first of them. The standard
    library's parser takes any text in linear time, which suits files of strangers.
    """

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.found: dict[str, list[Any]] = {}
        self.rows: list[Any] | None = None
        self.row: list[str | None] | None = None
        self.cell: list[str] | None = None
        self.spanned: dict[int, int] = {}
        self.span, self.sheet, self.left = (1, 1), "", MOST_SHEET_CELLS
        self.blind = 0
        self.outer: list[Any] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        told = dict(attrs)
        if tag in ("style", "script"):
            self.blind += 1
        elif tag in ("worksheet", "ss:worksheet"):
            self.sheet = told.get("ss:name") or ""
        elif tag in _TABLES:
            self.outer.append((self.rows, self.row, self.cell, self.spanned))
            self.rows, self.row, self.cell, self.spanned = [], None, None, {}
            self.found[self.sheet or f"table {len(self.found) + 1}"] = self.rows
        elif tag in _ROWS and self.rows is not None:
            self._end_row()
            at = _whole(told.get("ss:index"), 0)
            while at > len(self.rows) + 1:
                self._take(1)
                self.rows.append([])
            self.row = []
        elif tag in _CELLS and self.row is not None:
            self._end_cell()
            at = _whole(told.get("ss:index"), 0)
            while at > len(self.row) + 1:
                self._add(None)
            across = told.get("colspan") or str(1 + _whole(told.get("ss:mergeacross"), 0))
            down = told.get("rowspan") or str(1 + _whole(told.get("ss:mergedown"), 0))
            self.cell, self.span = [], (_whole(across, 1), _whole(down, 1))

    def handle_endtag(self, tag: str) -> None:
        if tag in ("style", "script"):
            self.blind = max(0, self.blind - 1)
        elif tag in _CELLS:
            self._end_cell()
        elif tag in _ROWS:
            self._end_row()
        elif tag in _TABLES:
            self._end_row()
            if self.outer:  # a table within a cell of another
                self.rows, self.row, self.cell, self.spanned = self.outer.pop()

    def handle_data(self, data: str) -> None:
        if self.cell is not None and not self.blind:
            self.cell.append(data)

    def _take(self, cells: int) -> None:
        self.left -= cells
        if self.left < 0:
            raise InputError(f"it has more than the {MOST_SHEET_CELLS} cells allowed; cut it")

    def _add(self, text: str | None) -> None:
        assert self.row is not None
        self._take(1)
        if len(self.row) > MOST_COLUMNS:
            raise InputError(f"it has more than the {MOST_COLUMNS} columns allowed; cut it")
        while self.spanned.get(len(self.row), 0) > 0:  # a cell above reaches down to here
            self.spanned[len(self.row)] -= 1
            self.row.append(None)
        self.row.append(text)

    def _end_cell(self) -> None:
        if self.cell is None or self.row is None:
            return
        text = " ".join("".join(self.cell).split())
        self.cell = None
        self._add(text or None)
        first, (across, down) = len(self.row) - 1, self.span
        for _ in range(min(across, MOST_COLUMNS) - 1):
            self._add(None)
        for i in range(first, len(self.row)):
            if down > 1:
                self.spanned[i] = min(down, MOST_SHEET_CELLS) - 1

    def _end_row(self) -> None:
        self._end_cell()
        if self.row is not None and self.rows is not None:
            self.rows.append(self.row)
        self.row = None


def _whole(text: str | None, otherwise: int) -> int:
    return int(text) if text and text.isdigit() else otherwise
