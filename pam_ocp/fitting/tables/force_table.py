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

from ...core.errors import InputError, UnknownNameError, require_positive
from ...core.shown import shown
from ...core.units import unit
from .labels import LABELS, read_labels
from .sources import SPELLINGS, RawTable, load, naming, parse_header
from .table_checks import (
    QUANTITIES,
    Series,
    check_force,
    check_mixed_pressure,
    check_pressure,
    contraction_of,
)

__all__ = ["ForceTable", "read_table", "require_table"]

Array: TypeAlias = NDArray[np.float64]


@shown
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
    branch : of each cell, such as "inflation" and "deflation"; empty when none was named.
    run : which repeat each cell belongs to; empty when none was named.
    """

    pressure: Array
    contraction: Array
    force: Array
    rest_length: float | None = None
    source: str = ""
    branch: tuple[str, ...] = ()
    run: tuple[str, ...] = ()

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
        for name in ("branch", "run"):
            labels = tuple(str(label) for label in getattr(self, name))
            if labels and len(labels) != len(self):
                raise InputError(f"{name} has {len(labels)} labels for {len(self)} cells")
            object.__setattr__(self, name, labels)

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
        index = np.arange(len(self))[chosen if isinstance(chosen, slice) else np.asarray(chosen)]
        return ForceTable(
            self.pressure[index],
            self.contraction[index],
            self.force[index],
            self.rest_length,
            self.source,
            tuple(self.branch[i] for i in index if self.branch),
            tuple(self.run[i] for i in index if self.run),
        )

    @property
    def branches(self) -> tuple[str, ...]:
        """The distinct branches, in the order in which they come."""
        return tuple(dict.fromkeys(self.branch))

    def of_branch(self, name: str) -> ForceTable:
        """The cells of one branch, ``"inflation"`` say."""
        if name not in self.branches:
            raise UnknownNameError("branch of the table", name, self.branches)
        return self.subset(np.array([b == name for b in self.branch]))

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
        it. Quantities: pressure, force, and length or contraction; labels: branch (inflation or
        deflation) and run (which repeat).
    units : ``{"pressure": "kPa"}`` where the header names no unit. Default: Pa (gauge), N, m,
        contraction as a fraction.

    Returns
    -------
    ForceTable in SI, slack cells included.

    Raises
    ------
    InputError, UnknownNameError : one sentence with column, row, value and remedy.
    """
    if rest_length is not None:
        require_positive("rest_length", rest_length, "m")
    with naming(source):
        return _table(load(source), rest_length, dict(columns or {}), dict(units or {}))


def _table(
    raw: RawTable, rest_length: float | None, columns: dict[str, str], units: dict[str, str]
) -> ForceTable:
    found = _assign(raw, columns, units)
    series = {q: Series(q, header, name, raw) for q, (header, name) in found.items()}
    check_pressure(series["pressure"])
    check_force(series["force"])
    kappa = contraction_of(series, rest_length)
    table = ForceTable(
        series["pressure"].si,
        kappa,
        series["force"].si,
        rest_length,
        source=raw.label,
        **read_labels(raw, columns),
    )
    check_mixed_pressure(series["pressure"], table.pressure, table.force, table.contraction)
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
    for argument, given, known in (
        ("columns", columns, (*QUANTITIES, *LABELS)),
        ("units", units, (*QUANTITIES,)),
    ):
        for quantity in given:
            if quantity not in known:
                raise UnknownNameError(f"quantity in {argument}", quantity, known)
    for header in columns.values():
        if header not in raw.columns:
            raise UnknownNameError("column", header, raw.columns)
    found: dict[str, tuple[str, str | None]] = {}
    for quantity, (_, names) in QUANTITIES.items():
        chosen = raw.header(quantity, names, columns)
        if chosen is not None:
            found[quantity] = (chosen, _unit_of(quantity, chosen, units))
    _require_columns(raw, found)
    return found


def _unit_of(quantity: str, header: str, units: dict[str, str]) -> str | None:
    """The unit that the header or the user states for a quantity; None when neither does."""
    said = parse_header(header)[1]
    wanted = units.get(quantity)
    base = unit(QUANTITIES[quantity][0])
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


def require_table(value: Any, argument: str = "table") -> ForceTable:
    """``value``, or an InputError when it is no ForceTable."""
    if not isinstance(value, ForceTable):
        raise InputError(f"{argument} is a {type(value).__name__}; read it with read_table(...)")
    return value
