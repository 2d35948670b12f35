"""A CasADi expression as formulas of a spreadsheet.

The graph of the expression is walked once; what is used more than once and is long gets a cell of
its own, so that no formula outgrows what spreadsheets take. So a law stands in the workbook as it
stands in its class, and nowhere a second time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca

from ...core.errors import InputError

__all__ = ["LONGEST", "Formula", "formula_of"]

LONGEST = 8000
"""Characters of a formula that every spreadsheet takes (Excel: 8192)."""
SHARED = 24
"""From this length on, what is used twice gets a cell of its own."""

SUM, PRODUCT, POWER, ATOM = range(1, 5)
"""How tightly the outermost operation of a text binds. A minus sign in front binds tighter than ^
in spreadsheets, and is never written without brackets.
"""
_BINARY = {"OP_ADD": ("+", SUM), "OP_SUB": ("-", SUM), "OP_MUL": ("*", PRODUCT)}
_BINARY |= {"OP_DIV": ("/", PRODUCT), "OP_POW": ("^", POWER), "OP_CONSTPOW": ("^", POWER)}
_COMPARED = {"OP_LT": "<", "OP_LE": "<=", "OP_EQ": "=", "OP_NE": "<>"}
_CALLED = {
    **{f"OP_{n}": n for n in ("EXP", "SQRT", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SIGN")},
    **{f"OP_{n}": n for n in ("SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH", "ERF")},
    "OP_LOG": "LN",
    "OP_FABS": "ABS",
    "OP_FMIN": "MIN",
    "OP_FMAX": "MAX",
    "OP_FLOOR": "INT",
}
_WRITTEN: dict[str, tuple[str, int]] = {
    "OP_NEG": ("(-{0})", ATOM),
    "OP_SQ": ("{0}^2", POWER),
    "OP_TWICE": ("2*{0}", PRODUCT),
    "OP_INV": ("1/{0}", PRODUCT),
    "OP_EXPM1": ("EXP({0})-1", SUM),
    "OP_LOG1P": ("LN(1+{0})", ATOM),
    "OP_CEIL": ("(-INT(-{0}))", ATOM),
    "OP_NOT": ("IF({0}=0,1,0)", ATOM),
    "OP_AND": ("IF(AND({0}<>0,{1}<>0),1,0)", ATOM),
    "OP_OR": ("IF(OR({0}<>0,{1}<>0),1,0)", ATOM),
    "OP_IF_ELSE_ZERO": ("IF({0}<>0,{1},0)", ATOM),
    "OP_ATAN2": ("ATAN2({1},{0})", ATOM),
    "OP_HYPOT": ("SQRT({0}^2+{1}^2)", ATOM),
}
"""{0} and {1} are put in brackets where they are no atoms."""
_OPS = {getattr(ca, n): n for n in dir(ca) if n.startswith("OP_")}


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
    names = list(symbols)
    work: dict[int, _Node] = {}
    made: list[_Node] = []
    result: _Node | None = None
    for k in range(function.n_instructions()):
        op = _OPS.get(function.instruction_id(k), "?")
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if op == "OP_OUTPUT":
            result = work[sources[0]]
            continue
        if op == "OP_INPUT":
            node = _Node(op, text=names[sources[0]])
        elif op == "OP_CONST":
            node = _Node(op, text=_number(function.instruction_constant(k)))
        else:
            if op not in (*_BINARY, *_COMPARED, *_CALLED, *_WRITTEN):
                raise InputError(f"spreadsheets have no {op.removeprefix('OP_').lower()}")
            node = _Node(op, tuple(work[s] for s in sources))
            for below in node.below:
                below.uses += 1
        work[targets[0]] = node
        made.append(node)
    assert result is not None
    cells: list[_Node] = []
    for node in made:  # in the order of the graph: what is below is decided first
        if node.uses > 1 and node.below and node is not result and node.length() > SHARED:
            node.cell = f"part{len(cells) + 1}"
            cells.append(node)
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
    if node.op == "OP_CONST":
        return node.text, ATOM
    if node.op == "OP_INPUT":
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
