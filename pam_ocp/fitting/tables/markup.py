"""Tables in HTML, or in Excel's XML of 2003: what programs save as .xls."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import Any

from ...core.errors import InputError
from ...core.files import MOST_COLUMNS, MOST_SHEET_CELLS

__all__ = ["is_markup", "tables_of"]

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
    """Cells as they are shown; a cell that spans several stands in the first of them.

    The standard library's parser takes any text in linear time, which suits files of strangers.
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

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

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
