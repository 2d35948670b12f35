"""A workbook: sheets with heads, columns of numbers, formulas and charts, by XlsxWriter; motions,
plans and fits to records as such.

The same content gives the same bytes: no date stands in it.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .. import __version__
from ..core.atomic import atomic_path
from ..core.errors import InputError
from ..core.files import require_ending
from ..core.lazy import library
from .canvas import COLOURS, axis_label
from .sheets import SHEETS, number_in

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory
    from ..core.variables import Variable
    from ..fitting.dynamic.plant_fit import PlantFit
    from ..planning.result import Plan

MOST_ROWS = 1_048_000
"""Of a sheet (Excel: 1 048 576)."""
A4 = 9
_EPOCH = datetime(2000, 1, 1)


def require_writer() -> None:
    """InputError where XlsxWriter is not installed."""
    library("xlsxwriter", "excel", "writing a workbook")


def column_name(index: int) -> str:
    """A, B, ..., Z, AA, ... of the column with this number from 0."""
    from xlsxwriter.utility import xl_col_to_name

    return str(xl_col_to_name(index))


def address(row: int, column: int, *, sheet: str = "", fixed: bool = False) -> str:
    """Of a cell, rows and columns from 0: "B3", "Data!$B$3"."""
    from xlsxwriter.utility import xl_rowcol_to_cell

    place = str(xl_rowcol_to_cell(row, column, fixed, fixed))
    return f"{sheet}!{place}" if sheet else place


class Book:
    """A workbook that is being written. ``sheet`` begins a page; columns and charts go onto it."""

    def __init__(self, workbook: Any) -> None:
        self.workbook = workbook
        plain = {"font_name": "Calibri", "font_size": 11}
        self.bold = workbook.add_format({**plain, "bold": True})
        self.title = workbook.add_format({**plain, "bold": True, "font_size": 14})
        self.head = workbook.add_format(
            {**plain, "bold": True, "bottom": 1, "bg_color": "#e8eef4", "text_wrap": True}
        )
        self._plain, self._numbers = plain, dict[str, Any]()
        self.input = workbook.add_format(
            {**plain, "num_format": "General", "bg_color": "#fff2cc", "border": 1}
        )
        self.grey = workbook.add_format({**plain, "font_color": "#808080"})

    @classmethod
    @contextmanager
    def writing(cls, path: str | os.PathLike[str], title: str) -> Iterator[Book]:
        """A workbook that is in its place when the block ends, all of it or nothing.

        Raises InputError for another ending than .xlsx and without XlsxWriter, WriteError where
        nothing can be written.
        """
        require_ending(path, ".xlsx", "a workbook")
        require_writer()
        import xlsxwriter

        content = io.BytesIO()
        options = {"in_memory": True, "nan_inf_to_errors": True, "strings_to_formulas": False}
        workbook = xlsxwriter.Workbook(content, {**options, "strings_to_urls": False})
        said = {"title": title, "comments": f"pam_ocp {__version__}", "created": _EPOCH}
        workbook.set_properties(said)
        yield cls(workbook)
        workbook.close()
        with atomic_path(path) as temporary:
            temporary.write_bytes(content.getvalue())

    def sheet(self, name: str) -> Any:
        """A new page."""
        page = self.workbook.add_worksheet(name[:31])
        page.hide_gridlines(2)
        page.set_landscape()
        page.set_paper(A4)
        page.fit_to_pages(1, 0)
        page.set_footer("&L&A&R&P / &N")
        return page

    def heads(self, page: Any, rows: int, columns: int = 0) -> None:
        """Rows and columns that stay in sight; the last of these rows heads each printed page."""
        page.freeze_panes(rows, columns)
        page.repeat_rows(rows - 1)

    def number(self, size: float) -> Any:
        """The format of numbers up to this size: four digits are seen, all are kept."""
        shape = "0.000E+00"
        if 1e-3 <= abs(size) < 1e6 or size == 0:
            decimals = max(0, 3 - math.floor(math.log10(abs(size)))) if size else 0
            shape = f"0.{'0' * decimals}" if decimals else "0"
        if shape not in self._numbers:
            said = {**self._plain, "num_format": shape}
            self._numbers[shape] = self.workbook.add_format(said)
        return self._numbers[shape]

    def text(self, page: Any, row: int, lines: Sequence[str], column: int = 0) -> int:
        """Lines, the first as a title; returns the next row."""
        for i, line in enumerate(lines):
            page.write_string(row + i, column, line, self.title if i == 0 and row == 0 else None)
        return row + len(lines)

    def table(self, page: Any, row: int, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> int:
        """A head and rows of texts and numbers; returns the row behind."""
        for j, text in enumerate(head):
            page.write_string(row, j, text, self.head)
        for i, cells in enumerate(rows, start=row + 1):
            for j, cell in enumerate(cells):
                self.cell(page, i, j, cell)
        return row + 1 + len(rows)

    def cell(self, page: Any, row: int, column: int, value: Any, form: Any = None) -> None:
        """A text, a number, or nothing: also for NaN, which a chart would show as 0 in a text."""
        if value is None or value == "":
            return
        if isinstance(value, str):
            page.write_string(row, column, value, form)
        elif math.isfinite(value):
            whole = isinstance(value, bool) or value == int(value)
            form = form or (None if whole else self.number(value))
            page.write_number(row, column, value, form)
        elif not math.isnan(value):
            page.write_string(row, column, "∞" if value > 0 else "-∞", form)

    def columns(
        self, page: Any, row: int, heads: Sequence[str], columns: Sequence[ArrayLike]
    ) -> None:
        """Numbers below heads. Raises InputError for more rows than a sheet has."""
        for j, (head, column) in enumerate(zip(heads, columns, strict=True)):
            page.write_string(row, j, head, self.head)
            values = np.asarray(column, float)
            if row + 1 + values.size > MOST_ROWS:
                raise InputError(
                    f"{values.size} rows are more than a sheet has ({MOST_ROWS}); thin them out "
                    "by trajectory.at(times), or save as .csv or .parquet"
                )
            form = self.number(float(np.nanmax(np.abs(values), initial=0.0)))
            for i, value in enumerate(values.tolist(), start=row + 1):
                self.cell(page, i, j, value, form)

    def chart(
        self,
        page: Any,
        place: str,
        series: Sequence[dict[str, Any]],
        labels: tuple[str, str],
        title: str = "",
        size: tuple[int, int] = (760, 380),
    ) -> None:
        """A scatter chart. series : name, x, y (ranges), marks (instead of a line), colour."""
        chart = self.workbook.add_chart({"type": "scatter", "subtype": "straight"})
        for i, one in enumerate(series):
            colour = one.get("colour", COLOURS[i % len(COLOURS)])
            marks = one.get("marks", False)
            kind = "circle" if marks else "none"
            mark = {"type": kind, "size": 4, "fill": {"color": colour}, "border": {"color": colour}}
            line = {"none": True} if marks else {"color": colour, "width": 1.5}
            said = {"categories": f"={one['x']}", "values": f"={one['y']}", "name": one["name"]}
            chart.add_series({**said, "marker": mark, "line": line})
        for axis, label in zip((chart.set_x_axis, chart.set_y_axis), labels, strict=True):
            light = {"visible": True, "line": {"color": "#dddddd"}}
            axis({"name": label, "major_gridlines": light, "label_position": "low"})
        if title:
            chart.set_title({"name": title, "name_font": {"size": 12}})
        else:
            chart.set_title({"none": True})
        chart.set_size({"width": size[0], "height": size[1]})
        page.insert_chart(place, chart)


MOST_LINES = 8
"""Of a chart."""


# ---- motions, plans and fits to records ----------------------------------------------------------
def write_motion_book(motion: Trajectory, path: str | os.PathLike[str]) -> Path:
    """Sheets: Motion (all columns over time in display units, a chart per unit), Variables."""
    with Book.writing(path, "Motion") as book:
        _motion(book, motion)
        _variables(book, motion.variables)
    return Path(path)


def write_plan_book(plan: Plan, path: str | os.PathLike[str]) -> Path:
    """Sheets: Plan (verdict and figures), Motion, Variables. Raises PlanError for a failed plan."""
    motion = plan.trajectory
    with Book.writing(path, f"Plan of {plan.plant.name}") as book:
        _said(book, "Plan", plan)
        _motion(book, motion)
        _variables(book, motion.variables)
    return Path(path)


def write_plant_fit_book(fit: PlantFit, path: str | os.PathLike[str]) -> Path:
    """Sheets: Fit (agreement, parameters with intervals), and one of each record: measured,
    simulated and their difference as a live formula.
    """
    with Book.writing(path, f"{fit.plant.name}, fitted") as book:
        _said(book, "Fit", fit)
        for number, (measured, simulated) in enumerate(
            zip(fit.records, fit.simulated, strict=True), start=1
        ):
            _record(book, f"Record {number}", measured, simulated, fit.measured)
    return Path(path)


def _said(book: Book, name: str, thing: Any) -> None:
    """What an object shows in a notebook, as a sheet: texts, and numbers as numbers."""
    sheet = SHEETS[type(thing).__name__](thing)
    page = book.sheet(name)
    row = book.text(page, 0, [sheet.heading, *([sheet.verdict] if sheet.verdict else [])]) + 1
    for grid in sheet.grids:
        if grid.title:
            row = book.text(page, row, [grid.title])
        rows = [[number_in(cell) for cell in cells] for cells in grid.rows]
        row = book.table(page, row, grid.head, rows) + 1
    book.text(page, row, sheet.notes)
    page.set_column(0, 0, 22)
    page.set_column(1, 1, 44)
    page.set_column(2, 8, 18)


def _head(variable: Variable) -> str:
    unit = "" if variable.display_unit == "1" else f" [{variable.display_unit}]"
    return f"{variable.name}{unit}"


def _motion(book: Book, motion: Trajectory) -> None:
    page = book.sheet("Motion")
    heads = ["time [s]", *(_head(v) for v in motion.variables)]
    columns = [motion.t, *(motion[v.name] / v.display_factor for v in motion.variables)]
    book.columns(page, 0, heads, columns)
    book.heads(page, 1, 1)
    page.set_column(0, len(heads), 13)
    panels: dict[str, list[int]] = {}
    for i, variable in enumerate(motion.variables, start=1):
        panels.setdefault(variable.display_unit, []).append(i)
    last, place = len(motion) + 1, column_name(len(heads) + 1)
    for number, members in enumerate(panels.values()):
        series = [
            {
                "name": motion.variables[i - 1].name,
                "x": f"Motion!$A$2:$A${last}",
                "y": f"Motion!${column_name(i)}$2:${column_name(i)}${last}",
            }
            for i in members[:MOST_LINES]
        ]
        label = axis_label(*(motion.variables[i - 1] for i in members)).replace("\n", " ")
        book.chart(page, f"{place}{2 + 16 * number}", series, ("time [s]", label), size=(760, 300))


def _variables(book: Book, variables: Any) -> None:
    page = book.sheet("Variables")
    head = ("name", "kind", "unit (SI)", "unit here", "lowest", "highest", "description")
    rows = []
    for v in variables:
        ends = (end / v.display_factor for end in (v.min, v.max))
        rows.append((v.name, v.causality, v.unit, v.display_unit, *ends, v.description))
    book.table(page, 0, head, rows)
    page.set_column(0, 0, 26)
    page.set_column(1, 5, 12)
    page.set_column(6, 6, 60)


def _record(
    book: Book, name: str, measured: Trajectory, simulated: Trajectory, names: tuple[str, ...]
) -> None:
    page = book.sheet(name)
    heads, columns = ["time [s]"], [measured.t]
    for n in names:
        variable = measured.variable(n)
        heads += [f"{_head(variable)} measured", f"{_head(variable)} simulated"]
        there = simulated[n]
        if len(there) != len(measured):
            there = np.interp(measured.t, simulated.t, there)
        columns += [measured[n] / variable.display_factor, there / variable.display_factor]
    book.columns(page, 0, heads, columns)
    last, first = len(measured) + 1, len(heads)
    for i, n in enumerate(names):
        variable, own = measured.variable(n), first + i
        page.write_string(0, own, f"{_head(variable)} difference", book.head)
        one, other = column_name(1 + 2 * i), column_name(2 + 2 * i)
        values = columns[1 + 2 * i] - columns[2 + 2 * i]
        form = book.number(float(np.nanmax(np.abs(values), initial=0.0)))
        for row, value in enumerate(values.tolist(), start=1):
            page.write_formula(row, own, f"={one}{row + 1}-{other}{row + 1}", form, value)
        series = [
            {"name": label, "x": f"'{name}'!$A$2:$A${last}", "y": f"'{name}'!${c}$2:${c}${last}"}
            for label, c in (("measured", one), ("simulated", other))
        ]
        place = f"{column_name(first + len(names) + 1)}{2 + 16 * i}"
        book.chart(page, place, series, ("time [s]", _head(variable)), size=(760, 300))
    book.heads(page, 1, 1)
    page.set_column(0, first + len(names), 15)
