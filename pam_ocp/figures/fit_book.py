"""A fitted force law as a workbook: parameters, data, the law as live formulas, charts."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ..core.errors import InputError
from ..core.expressions import carried_out, steps_of
from .canvas import COLOURS
from .workbook import Book, address, column_name

if TYPE_CHECKING:
    from ..fitting.static.force_fit import ForceFit

LONGEST = 8000
"""Characters of a formula that every spreadsheet takes (Excel: 8192)."""
SHARED = 24
"""From this length on, what is used twice gets a cell of its own."""

SUM, PRODUCT, POWER, ATOM = range(1, 5)
"""How tightly the outermost operation of a text binds. A minus sign in front binds tighter than ^
in spreadsheets, and is never written without brackets.
"""
_BINARY = {"add": ("+", SUM), "sub": ("-", SUM), "mul": ("*", PRODUCT)}
_BINARY |= {"div": ("/", PRODUCT), "pow": ("^", POWER), "constpow": ("^", POWER)}
_COMPARED = {"lt": "<", "le": "<=", "eq": "=", "ne": "<>"}
_CALLED = {
    **{n.lower(): n for n in ("EXP", "SQRT", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SIGN")},
    **{n.lower(): n for n in ("SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH", "ERF")},
    "log": "LN",
    "fabs": "ABS",
    "fmin": "MIN",
    "fmax": "MAX",
    "floor": "INT",
}
_WRITTEN: dict[str, tuple[str, int]] = {
    "neg": ("(-{0})", ATOM),
    "sq": ("{0}^2", POWER),
    "twice": ("2*{0}", PRODUCT),
    "inv": ("1/{0}", PRODUCT),
    "expm1": ("EXP({0})-1", SUM),
    "log1p": ("LN(1+{0})", ATOM),
    "ceil": ("(-INT(-{0}))", ATOM),
    "not": ("IF({0}=0,1,0)", ATOM),
    "and": ("IF(AND({0}<>0,{1}<>0),1,0)", ATOM),
    "or": ("IF(OR({0}<>0,{1}<>0),1,0)", ATOM),
    "if_else_zero": ("IF({0}<>0,{1},0)", ATOM),
    "atan2": ("ATAN2({1},{0})", ATOM),
    "hypot": ("SQRT({0}^2+{1}^2)", ATOM),
}
"""{0} and {1} are put in brackets where they are no atoms."""


@dataclass(eq=False)
class _Node:
    """A place in the graph: an operation on others, a number, or a name."""

    op: str
    below: tuple[_Node, ...] = ()
    text: str = ""
    uses: int = 0
    cell: str = ""
    """Name of the cell of its own, where it has one."""

    def length(self) -> int:
        """About how long its text is, with cells in place of what has one."""
        return len(self.text) or 8 + sum(4 if n.cell else n.length() for n in self.below)


@dataclass(frozen=True)
class Formula:
    """An expression in cells: ``cells`` in their order, each from those before; then ``result``.

    Texts hold names; :meth:`written` puts addresses in their place.
    """

    _cells: tuple[_Node, ...]
    _result: _Node

    @property
    def cells(self) -> tuple[str, ...]:
        """Names of the cells that it needs besides its own."""
        return tuple(n.cell for n in self._cells)

    def written(self, address: Callable[[str], str] | Mapping[str, str]) -> dict[str, str]:
        """{cell: formula}, with the result under "". ``address`` : of each name, of a cell too.

        Raises InputError for one that is too long for a spreadsheet.
        """
        of = address if callable(address) else address.__getitem__
        found = {n.cell: f"={_text(n, of, True)[0]}" for n in self._cells}
        found[""] = f"={_text(self._result, of, True)[0]}"
        if max(map(len, found.values())) > LONGEST:
            raise InputError("the formula is longer than what spreadsheets take")
        return found


def formula_of(expression: ca.SX, symbols: Mapping[str, ca.SX]) -> Formula:
    """The formula of a scalar expression in named scalar symbols.

    Raises InputError for an operation that spreadsheets do not have.
    """
    function = ca.Function("formula", list(symbols.values()), [expression])
    made: list[_Node] = []

    def node(op: str, *below: _Node, text: str = "") -> _Node:
        for part in below:
            part.uses += 1
        made.append(_Node(op, below, text))
        return made[-1]

    table = {op: partial(node, op) for op in (*_BINARY, *_COMPARED, *_CALLED, *_WRITTEN)}
    names = [partial(lambda name, _: node("input", text=name), name) for name in symbols]
    number = lambda value: node("const", text=_number(value))  # noqa: E731
    try:
        ((result,),) = carried_out(steps_of(function), table, names, [1], number)
    except KeyError as error:
        raise InputError(f"spreadsheets have no {error.args[0]}") from None
    cells: list[_Node] = []
    for each in made:  # in the order of the graph: what is below is decided first
        if each.uses > 1 and each.below and each is not result and each.length() > SHARED:
            each.cell = f"part{len(cells) + 1}"
            cells.append(each)
    return Formula(tuple(cells), result)


def _number(value: float) -> str:
    if not math.isfinite(value):
        raise InputError(f"spreadsheets have no {value}")
    text = repr(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value).upper()
    return text if value >= 0 else f"({text})"


def _text(node: _Node, of: Callable[[str], str], top: bool = False) -> tuple[str, int]:
    """(text, how tightly it binds); ``top`` : the cell's own formula, not its address."""
    if node.cell and not top:
        return of(node.cell), ATOM
    if node.op == "const":
        return node.text, ATOM
    if node.op == "input":
        address = of(node.text)
        return address, ATOM
    parts = [_text(n, of) for n in node.below]
    if node.op in _BINARY:
        sign, binds = _BINARY[node.op]
        (a, left), (b, right) = parts
        tight = binds + (sign in "-/^")  # a - (b - c)
        return f"{_within(a, left, binds + (sign == '^'))}{sign}{_within(b, right, tight)}", binds
    if node.op in _COMPARED:
        (a, _), (b, _) = parts
        return f"IF({a}{_COMPARED[node.op]}{b},1,0)", ATOM
    if node.op in _CALLED:
        return f"{_CALLED[node.op]}({','.join(t for t, _ in parts)})", ATOM
    pattern, binds = _WRITTEN[node.op]
    return pattern.format(*(_within(t, b, ATOM) for t, b in parts)), binds


def _within(text: str, binds: int, wanted: int) -> str:
    return text if binds >= wanted else f"({text})"


BAR, PERCENT = 1e5, 1e-2
FIRST = 6
"""Row of the first coefficient."""
CURVE = 41
"""Points of a curve."""
MOST_CURVES = 8
NAMED = "law_"
"""In front of a coefficient's name: a1 alone would be the address of a cell."""


def write_fit_book(fit: ForceFit, path: str | os.PathLike[str]) -> Path:
    """Write the workbook; returns its path.

    Sheets: Parameters (change one, and all else follows), Data (measured, law, residual), Curves
    (the law over contraction at pressures that can be changed).
    """
    with Book.writing(path, f"{fit.law.title}, fitted") as book:
        _FitBook(book, fit).write()
    return Path(path)


class _FitBook:
    """The sheets of one fit."""

    def __init__(self, book: Book, fit: ForceFit) -> None:
        self.book, self.fit = book, fit
        self.names = list(fit.coefficients)
        self.formula = self._formula()
        self.force = book.number(float(np.abs(fit.table.force).max()))

    def _formula(self) -> Formula | None:
        """The law's; None where spreadsheets have none."""
        symbols = {n: ca.SX.sym(n) for n in ("p", "kappa", *self.names)}
        law = type(self.fit.law)(**{n: symbols[n] for n in self.names})
        expression = law.formula(symbols["p"], symbols["kappa"])
        try:
            found = formula_of(ca.SX(expression), symbols)
            found.written(lambda name: f"{NAMED}{name}")
        except InputError:
            return None
        return found

    def write(self) -> None:
        """All sheets."""
        page = self.book.sheet("Parameters")
        last = self._data()
        self._parameters(page, last)
        self._curves()

    # ---- parameters ---------------------------------------------------------------------------
    def _parameters(self, page: Any, last: int) -> None:
        book, fit = self.book, self.fit
        said = [
            f"{fit.law.title}, fitted to {fit.table.source or 'a table'}",
            fit.law.reference,
            "Change a yellow cell: law, residuals, RMSE and curves follow."
            if self.formula
            else "This law has no formula that spreadsheets take: forces are numbers here.",
        ]
        book.text(page, 0, said)
        intervals = fit.intervals()
        heads = ("coefficient", "value (SI)", "standard error", "from (95 %)", "to (95 %)")
        book.table(page, FIRST - 1, (*heads, "unit", "description"), [])
        for i, c in enumerate(fit.coefficients.values()):
            row = FIRST + i
            page.write_string(row, 0, c.name, book.bold)
            page.write_number(row, 1, c.value, book.input)
            low, high = intervals.get(c.name, (c.value, c.value))
            error: tuple[Any, ...] = ("held", "", "") if c.held else (c.stderr, low, high)
            for j, value in enumerate((*error, "" if c.unit == "1" else c.unit, c.description), 2):
                book.cell(page, row, j, value)
            place = address(row, 1, sheet="Parameters", fixed=True)
            book.workbook.define_name(f"{NAMED}{c.name}", f"={place}")
        row = FIRST + len(self.names) + 1
        taut, residual, measured = (f"Data!{c}5:{c}{last}" for c in "FEC")
        mean = f"SUMPRODUCT({taut},{measured})/SUM({taut})"
        squares = f"SUMPRODUCT({taut},{residual},{residual})"
        spread = f"SUMPRODUCT({taut},({measured}-{mean})^2)"
        for name, formula, value, unit in (
            ("RMSE", f"=SQRT({squares}/SUM({taut}))", fit.rmse, "N"),
            ("R²", f"=1-{squares}/{spread}", fit.r2, ""),
            ("taut cells", f"=SUM({taut})", float(fit.n), ""),
        ):
            page.write_string(row, 0, name, book.bold)
            page.write_formula(row, 1, formula, book.number(value), value)
            page.write_string(row, 5, unit)
            row += 1
        book.text(page, row + 1, fit.warnings)
        page.set_column(0, 0, 14)
        page.set_column(1, 4, 15)
        page.set_column(6, 6, 40)

    # ---- cells with the law -------------------------------------------------------------------
    def _law(
        self, page: Any, row: int, column: int, helpers: int, value: float, slack: bool = False
    ) -> None:
        """The law in a cell, of the pressure and contraction in the first two of its row; at a
        slack point 0 where it is below.
        """
        value = max(0.0, value) if slack else value
        if self.formula is None:
            page.write_number(row, column, value, self.force)
            return
        cells = {n: address(row, helpers + i) for i, n in enumerate(self.formula.cells)}

        def place(name: str) -> str:
            if name == "p":
                return f"({address(row, 0)}*{BAR:.0f})"
            if name == "kappa":
                return f"({address(row, 1)}/100)"
            return cells.get(name) or f"{NAMED}{name}"

        for name, text in self.formula.written(place).items():
            if name:
                at = helpers + self.formula.cells.index(name)
                page.write_formula(row, at, text, self.book.grey)
            else:
                text = f"=MAX(0,{text.removeprefix('=')})" if slack else text
                page.write_formula(row, column, text, self.force, value)

    def _helpers(self, page: Any, row: int, column: int) -> None:
        for i, name in enumerate(self.formula.cells if self.formula else ()):
            page.write_string(row, column + i, f"{name} of the formula", self.book.grey)

    def _data(self) -> int:
        """Measured cells in the order of pressure and contraction; returns the last row."""
        book, table = self.book, self.fit.table
        page = book.sheet("Data")
        book.text(page, 0, ["Measured cells, and the law there"])
        heads = ["pressure [bar]", "contraction [%]", "measured force [N]", "law [N]"]
        heads += ["measured - law [N]", "taut (fitted)"]
        labels = [n for n in ("branch", "run", "file") if getattr(table, n)]
        book.table(page, 3, [*heads, *labels], [])
        helpers = len(heads) + len(labels) + 1
        self._helpers(page, 3, helpers)
        order = np.lexsort((table.contraction, table.pressure))
        law = np.asarray(self.fit.law.tension(table.pressure, table.contraction))
        for row, i in enumerate(order.tolist(), start=4):
            book.cell(page, row, 0, float(table.pressure[i] / BAR))
            book.cell(page, row, 1, float(table.contraction[i] / PERCENT))
            page.write_number(row, 2, table.force[i], self.force)
            slack = bool(table.slack[i])
            self._law(page, row, 3, helpers, float(law[i]), slack)
            difference = float(table.force[i] - (max(0.0, law[i]) if slack else law[i]))
            page.write_formula(row, 4, f"=C{row + 1}-D{row + 1}", self.force, difference)
            page.write_number(row, 5, float(not table.slack[i]))
            for j, name in enumerate(labels):
                page.write_string(row, 6 + j, getattr(table, name)[i])
        last = 4 + len(order)
        self._data_charts(page, table.pressure[order], last)
        page.set_column(0, helpers - 2, 13)
        book.heads(page, 4)
        return last

    def _data_charts(self, page: Any, pressure: Any, last: int) -> None:
        levels = np.unique(pressure)
        series: list[dict[str, Any]] = []
        for i, level in enumerate(levels[:: max(1, len(levels) // MOST_CURVES)]):
            rows = np.flatnonzero(pressure == level)
            x, measured, law = (f"Data!${c}${rows[0] + 5}:${c}${rows[-1] + 5}" for c in "BCD")
            said = {"x": x, "colour": COLOURS[i % len(COLOURS)]}
            name = f"{level / BAR:.3g} bar"
            series += [{**said, "y": measured, "name": f"{name}, measured", "marks": True}]
            series += [{**said, "y": law, "name": f"{name}, law"}]
        place = self._chart_place()
        axis = "contraction [%]"
        self.book.chart(page, f"{place}2", series, (axis, "pulling force [N]"), "Measured and law")
        rest = {"x": f"Data!$B$5:$B${last}", "y": f"Data!$E$5:$E${last}", "marks": True}
        label = "measured - law [N]"
        self.book.chart(page, f"{place}23", [{**rest, "name": label}], (axis, label), "Residuals")

    def _chart_place(self) -> str:
        labels = sum(bool(getattr(self.fit.table, n)) for n in ("branch", "run", "file"))
        cells = len(self.formula.cells) if self.formula else 0
        return column_name(6 + labels + 1 + cells + (1 if cells else 0))

    # ---- curves -------------------------------------------------------------------------------
    def _curves(self) -> None:
        """The law over contraction, at a few pressures that can be changed."""
        book, table, law = self.book, self.fit.table, self.fit.law
        page = book.sheet("Curves")
        book.text(page, 0, ["The law over contraction; change a yellow pressure"])
        heads = ("pressure [bar]", "contraction [%]", "law [N]", "pulling force [N]")
        book.table(page, 3, heads, [])
        self._helpers(page, 3, 5)
        low, high = float(table.pressure.min()), float(table.pressure.max())
        grid = np.linspace(min(0.0, table.contraction.min()), table.contraction.max(), CURVE)
        series, row = [], 4
        for i, p in enumerate(np.linspace(low, high, 6)):
            begin = row
            for kappa in grid.tolist():
                if row == begin:
                    page.write_number(row, 0, round(float(p) / BAR, 3), book.input)
                else:
                    page.write_formula(row, 0, f"=A{begin + 1}", None, round(float(p) / BAR, 3))
                book.cell(page, row, 1, 100 * kappa)
                value = float(law.tension(round(float(p) / BAR, 3) * BAR, kappa))
                self._law(page, row, 2, 5, value)
                page.write_formula(row, 3, f"=MAX(0,C{row + 1})", self.force, max(0.0, value))
                row += 1
            x, y = (f"Curves!${c}${begin + 1}:${c}${row}" for c in "BD")
            name = f"=Curves!$A${begin + 1}"
            series.append({"x": x, "y": y, "name": name, "colour": COLOURS[i % len(COLOURS)]})
        cells = len(self.formula.cells) if self.formula else 0
        labels = ("contraction [%]", "pulling force [N]")
        place = f"{column_name(5 + cells + (1 if cells else 0))}2"
        book.chart(page, place, series, labels, "Pulling force, pressures in bar")
        page.set_column(0, 4 + cells, 13)
        book.heads(page, 4)
