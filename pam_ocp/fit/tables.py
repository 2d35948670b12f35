"""Measured force tables: read, recognised, converted once to SI, and checked.

A header says what a column holds and in which unit, in the usual spellings (``length_m``,
``p [kPa]``, ``pressure (bar)``, ``F/N``, ``kappa [%]``); where it does not, ``columns`` and
``units`` do.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, UnknownNameError, require_positive
from ..units import unit
from .sources import SPELLINGS, RawTable, load, parse_header

__all__ = ["ForceTable", "read_table"]

Array: TypeAlias = NDArray[np.float64]

# quantity: (SI unit, names by which a header calls it)
_QUANTITIES: dict[str, tuple[str, frozenset[str]]] = {
    "length": ("m", frozenset({"length", "l", "len", "muscle length", "active length"})),
    "contraction": (
        "1",
        frozenset({"contraction", "contraction ratio", "kappa", "κ", "eps", "epsilon", "ε"}),
    ),
    "pressure": ("Pa", frozenset({"pressure", "p", "gauge pressure", "pressure gauge", "p gauge"})),
    "force": ("N", frozenset({"force", "f", "pulling force", "tension", "tensile force"})),
}

LARGEST_PRESSURE = (1e3, 5e6)
"""Where the largest gauge pressure of a table may lie [Pa]; beyond, its unit is in doubt."""
LARGEST_FORCE = 1e5
"""Beyond any fluidic muscle [N]."""
CONTRACTION_RANGE = (-0.10, 0.60)
"""10 % beyond the rest length; the braid locks at 35-40 %."""


@dataclass(frozen=True, eq=False)
class ForceTable:
    """Static force of one muscle, cell by cell.

    Parameters
    ----------
    pressure : gauge pressure [Pa], shape (n,).
    contraction : contraction ratio kappa = (l0 - l)/l0 [1], shape (n,).
    force : pulling force [N], shape (n,). A force <= 0 means slack: such a cell is censored
        (the law lies somewhere below zero there) and is no equality for a fit.
    rest_length : l0 [m], or None when the table was given over contraction without it.
    source : where the numbers come from.
    """

    pressure: Array
    contraction: Array
    force: Array
    rest_length: float | None = None
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("pressure", "contraction", "force"):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != (array.size,) or array.size != np.size(self.pressure):
                raise InputError(
                    f"{name} has shape {array.shape}; pressure, contraction and force of a table "
                    "must be one-dimensional and equally long"
                )
            bad = np.nonzero(~np.isfinite(array))[0]
            if bad.size:
                raise InputError(f"{name} = {array[bad[0]]} in row {bad[0] + 1} must be finite")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.rest_length is not None:
            require_positive("rest_length", self.rest_length, "m")

    @property
    def slack(self) -> NDArray[np.bool_]:
        """True for the censored cells, force <= 0; shape (n,)."""
        return np.asarray(self.force <= 0)

    @property
    def taut(self) -> ForceTable:
        """The cells with force > 0, which a fit may use as equalities."""
        return self.subset(~self.slack)

    def subset(self, chosen: ArrayLike | slice) -> ForceTable:
        """The chosen cells (mask, indices or slice) as a table."""
        index = chosen if isinstance(chosen, slice) else np.asarray(chosen)
        return ForceTable(
            self.pressure[index],
            self.contraction[index],
            self.force[index],
            self.rest_length,
            self.source,
        )

    def levels(self, tolerance: float = 0.005) -> NDArray[np.intp]:
        """Number of the contraction level of each cell, from 0; shape (n,).

        Cells are measured at nominal lengths with small deviations: contractions within
        ``tolerance`` of the lowest of their level count as one level.
        """
        order = np.argsort(self.contraction, kind="stable")
        numbers = np.zeros(len(self), dtype=np.intp)
        current, first = -1, -np.inf
        for i in order:
            if self.contraction[i] > first + tolerance:
                current, first = current + 1, self.contraction[i]
            numbers[i] = current
        return numbers

    def __len__(self) -> int:
        return int(self.force.size)

    def __repr__(self) -> str:
        if not len(self):
            return "ForceTable(no cells)"
        p, k = self.pressure / 1e5, self.contraction * 100
        length = "" if self.rest_length is None else f", l0 {self.rest_length:g} m"
        source = f", {self.source}" if self.source else ""
        return (
            f"ForceTable({len(self)} cells, {int(np.sum(~self.slack))} taut: "
            f"p {p.min():.4g}..{p.max():.4g} bar, kappa {k.min():.4g}..{k.max():.4g} %, "
            f"F up to {self.force.max():.4g} N{length}{source})"
        )


def read_table(
    source: Any,
    *,
    rest_length: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> ForceTable:
    """Read a measured force table.

    Parameters
    ----------
    source : path of a CSV or TSV file (also NPZ, MAT, Parquet, XLSX), a pandas DataFrame, or a
        mapping from column names to arrays. The name of a bundled table, such as
        ``"DMSP-20-300_static.csv"``, works where no such file exists.
    rest_length : l0 [m]; needed when the table holds lengths instead of contractions.
    columns : which column holds a quantity, ``{"pressure": "P1"}``, where its name does not say
        it. Quantities: pressure, force, and length or contraction.
    units : ``{"pressure": "kPa"}`` where the header names no unit. Default: Pa (gauge), N, m,
        contraction as a fraction.

    Returns
    -------
    ForceTable in SI, slack cells included.

    Raises
    ------
    InputError, UnknownNameError : one sentence with column, row, value and remedy.
    """
    raw = load(source)
    if rest_length is not None:
        require_positive("rest_length", rest_length, "m")
    found = _assign(raw, dict(columns or {}), dict(units or {}))
    series = {q: _Series(q, header, name, raw) for q, (header, name) in found.items()}
    _check_pressure(series["pressure"])
    _check_force(series["force"])
    kappa = _contraction(series, rest_length)
    table = ForceTable(
        series["pressure"].si, kappa, series["force"].si, rest_length, source=raw.label
    )
    _check_mixed_pressure(series["pressure"], table)
    if not np.any(~table.slack):
        sign = (
            "all forces are negative or zero: count pulling as positive"
            if np.any(table.force < 0)
            else "every force is zero"
        )
        raise InputError(f"{raw.label}: all {len(table)} cells are slack ({sign})")
    return table


# ---- which column is what -----------------------------------------------------------------------
def _assign(
    raw: RawTable, columns: dict[str, str], units: dict[str, str]
) -> dict[str, tuple[str, str | None]]:
    """quantity -> (header, unit or None), from the user's words first, then from the headers."""
    for argument, given in (("columns", columns), ("units", units)):
        for quantity in given:
            if quantity not in _QUANTITIES:
                raise UnknownNameError(f"quantity in {argument}", quantity, _QUANTITIES)
    for header in columns.values():
        if header not in raw.columns:
            raise UnknownNameError("column", header, raw.columns)
    parsed = {h: parse_header(h) for h in raw.columns if h not in columns.values()}
    found: dict[str, tuple[str, str | None]] = {}
    for quantity, (_, names) in _QUANTITIES.items():
        fitting = [h for h, (name, _) in parsed.items() if name in names]
        if quantity in columns:
            fitting = [columns[quantity]]
        if len(fitting) > 1:
            raise InputError(
                f"{raw.label}: {' and '.join(map(repr, fitting))} both read as {quantity}; "
                f"choose one with columns={{{quantity!r}: {fitting[0]!r}}}"
            )
        if fitting:
            found[quantity] = (fitting[0], _unit_of(quantity, fitting[0], units))
    _require_columns(raw, found)
    return found


def _unit_of(quantity: str, header: str, units: dict[str, str]) -> str | None:
    """The unit that the header or the user states for a quantity; None when neither does."""
    said = parse_header(header)[1]
    wanted = units.get(quantity)
    base = unit(_QUANTITIES[quantity][0])
    if wanted is None:
        if said is not None and not unit(said).compatible(base):
            raise InputError(
                f"column {header!r} names the unit {said}, which is none of a {quantity} "
                f"(such as {base.name}); correct the header or give units={{{quantity!r}: ...}}"
            )
        return said
    name = SPELLINGS.get(wanted.lower(), wanted)
    if not unit(name).compatible(base):
        raise InputError(f"units[{quantity!r}] = {wanted!r} is no unit of a {quantity}")
    if said in SPELLINGS.values() and unit(str(said)).compatible(base) and said != name:
        raise InputError(
            f"column {header!r} says {said} but units[{quantity!r}] = {wanted!r}; "
            "correct the header or leave units away"
        )
    return name


def _require_columns(raw: RawTable, found: Mapping[str, Any]) -> None:
    missing = [q for q in ("pressure", "force") if q not in found]
    if "length" not in found and "contraction" not in found:
        missing.append("length")
    if not missing:
        return
    quantity = missing[0]
    words = "length or contraction" if quantity == "length" else quantity
    example = {"pressure": "pressure_Pa", "force": "force_N", "length": "length_m"}[quantity]
    near = _near_headers(quantity, raw.columns)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    raise InputError(
        f"{raw.label} has no column for the {words} among {', '.join(map(repr, raw.columns))}: "
        f"{hint}Name it {example!r} or give columns={{{quantity!r}: ...}}"
    )


def _near_headers(quantity: str, headers: Iterable[str]) -> list[str]:
    plain = {parse_header(h)[0]: h for h in headers}
    wanted = [quantity, "contraction"] if quantity == "length" else [quantity]
    near = [m for w in wanted for m in difflib.get_close_matches(w, plain, n=2, cutoff=0.6)]
    return [plain[m] for m in near]


# ---- numbers, and whether they can be what the header says ---------------------------------------
class _Series:
    """One column as numbers: ``values`` as they stand, ``si`` converted."""

    def __init__(self, quantity: str, header: str, name: str | None, raw: RawTable) -> None:
        self.quantity, self.header, self.raw = quantity, header, raw
        self.declared = name is not None
        self.unit = name or _QUANTITIES[quantity][0]
        self.values = raw.numbers(header)
        self.si: Array = self.values * unit(self.unit).factor

    def shown(self, index: int) -> str:
        """``pressure 0.35 bar in row 3``."""
        name = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.quantity} {self.values[index]:g}{name} in {self.raw.row(index)}"

    @property
    def reading(self) -> str:
        return f"read in {self.unit}" + ("" if self.declared else ", as no unit was named")


def _check_pressure(pressure: _Series) -> None:
    top = int(np.argmax(pressure.si))
    low = int(np.argmin(pressure.si))
    largest, smallest = pressure.si[top], pressure.si[low]
    if smallest < -max(0.02 * largest, 2e3):
        raise InputError(
            f"{pressure.shown(low)} is negative beyond noise; pressures are gauge pressures >= 0"
        )
    low_end, high_end = LARGEST_PRESSURE
    if not low_end <= largest <= high_end:
        fitting = [
            u for u in ("bar", "kPa", "Pa") if 5e4 <= pressure.values[top] * unit(u).factor <= 2e6
        ]
        guess = f"it looks like {' or '.join(fitting)}" if fitting else "that cannot be"
        remedy = fitting[0] if fitting else "bar"
        raise InputError(
            f"the largest {pressure.shown(top)} ({pressure.reading}) is {largest / 1e5:g} bar, "
            f"outside {low_end / 1e5:g} .. {high_end / 1e5:g} bar: {guess}; "
            f"correct the header or give units={{'pressure': {remedy!r}}}"
        )


def _check_mixed_pressure(pressure: _Series, table: ForceTable) -> None:
    """A muscle at its rest length or shorter cannot pull hard with next to no pressure."""
    doubtful = (
        (table.pressure < table.pressure.max() / 500)
        & (table.force > 0.2 * table.force.max())
        & (table.contraction >= 0)
    )
    if np.any(doubtful):
        i = int(np.argmax(doubtful))
        raise InputError(
            f"{pressure.shown(i)} goes with a force of {table.force[i]:g} N, while other rows reach "
            f"{pressure.values.max():g} {pressure.unit}: the column mixes units"
        )


def _check_force(force: _Series) -> None:
    top = int(np.argmax(np.abs(force.si)))
    if abs(force.si[top]) > LARGEST_FORCE:
        raise InputError(
            f"{force.shown(top)} ({force.reading}) is beyond any fluidic muscle "
            f"({LARGEST_FORCE:g} N); check the unit"
        )


def _contraction(series: Mapping[str, _Series], rest_length: float | None) -> Array:
    """kappa from whichever column there is; both must agree where both are."""
    low, high = CONTRACTION_RANGE
    direct = series.get("contraction")
    if direct is not None:
        _check_contraction(direct)
    if "length" not in series:
        assert direct is not None
        return direct.si
    if rest_length is None:
        if direct is not None:
            return direct.si
        raise InputError(
            f"column {series['length'].header!r} holds lengths: give rest_length in metres, "
            "as in read_table(..., rest_length=0.300)"
        )
    length = series["length"]
    shortest = int(np.argmin(length.si))
    if length.si[shortest] <= 0:
        raise InputError(f"{length.shown(shortest)} must be > 0")
    kappa: Array = 1.0 - length.si / rest_length
    for i in (int(np.argmin(kappa)), int(np.argmax(kappa))):
        if not low <= kappa[i] <= high:
            side = "more than 10 % beyond" if kappa[i] < low else "far too short for"
            raise InputError(
                f"{length.shown(i)} ({length.reading}) is {side} the rest length {rest_length:g} m; "
                "check rest_length (in metres) and the unit of the lengths (mm?)"
            )
    if direct is not None:
        gap = np.abs(kappa - direct.si)
        i = int(np.argmax(gap))
        if gap[i] > 0.01:
            raise InputError(
                f"{direct.shown(i)} contradicts {length.shown(i)}, which is a contraction of "
                f"{kappa[i]:.4g} at rest_length = {rest_length:g} m; correct one of them"
            )
    return kappa


def _check_contraction(contraction: _Series) -> None:
    low, high = CONTRACTION_RANGE
    size = np.abs(contraction.si)
    worst = int(np.argmax(size))
    if size[worst] > 1:
        raise InputError(
            f"{contraction.shown(worst)} ({contraction.reading}) is beyond 1: it looks like "
            "percent; give units={'contraction': '%'}"
        )
    if 0 < size[worst] < 0.006 and contraction.unit == "%":
        raise InputError(
            f"the largest {contraction.shown(worst)} is next to nothing: it looks like a fraction; "
            "correct the header or give units={'contraction': '1'}"
        )
    for i in (int(np.argmin(contraction.si)), int(np.argmax(contraction.si))):
        if not low <= contraction.si[i] <= high:
            raise InputError(
                f"{contraction.shown(i)} is outside {low * 100:g} .. {high * 100:g} %; contraction is "
                "(rest length - length)/rest length, positive when shorter"
            )
