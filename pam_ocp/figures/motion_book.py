"""Motions, plans and fits to records as workbooks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..canvas import axis_label
from ..sheet import number_in
from ..sheets import SHEETS
from .book import Book, column_name

if TYPE_CHECKING:
    from ...core.trajectory import Trajectory
    from ...core.variables import Variable
    from ...fitting.dynamic.plant_fit import PlantFit
    from ...planning.result import Plan

__all__ = ["write_motion_book", "write_plan_book", "write_plant_fit_book"]

MOST_LINES = 8
"""Of a chart."""


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
    rows = [
        (v.name, v.causality, v.unit, v.display_unit, *_ends(v), v.description) for v in variables
    ]
    book.table(page, 0, head, rows)
    page.set_column(0, 0, 26)
    page.set_column(1, 5, 12)
    page.set_column(6, 6, 60)


def _ends(variable: Variable) -> tuple[float, float]:
    return variable.min / variable.display_factor, variable.max / variable.display_factor


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
