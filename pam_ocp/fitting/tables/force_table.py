"""Measured force tables: read, recognised, converted once to SI, and checked.

A header says what a column holds and in which unit, in the usual spellings (``length_m``,
``p [kPa]``, ``pressure (bar)``, ``F/N``, ``kappa [%]``); where it does not, ``columns`` and
``units`` do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.calibration import AMBIENT
from ...core.errors import (
    InputError,
    UnknownNameError,
    kind_of,
    require_numbers,
    require_positive,
    with_kinds,
)
from ...core.quantities import quantity
from ...core.shown import shown
from .columns import (
    Series,
    assigned,
    check_force,
    check_mixed_pressure,
    check_pressure,
    contraction_of,
    read_labels,
    require_columns,
)
from .doubts import (
    Understood,
    checked_cells,
    doubts_of,
    doubts_of_table,
)
from .floor import DETECTED, Floor, find_floor, part_names
from .ramps import Ramp, floor_of, ramp_of
from .raw import RawTable, Reading, complete, say
from .sources import is_source, load, naming, sources_of

Array: TypeAlias = NDArray[np.float64]
MEASURES = ("pressure", "contraction", "force", "scatter", "error")
LABELLED = ("branch", "run", "file")
"""Of each cell."""


@shown
@dataclass(frozen=True, eq=False)
class ForceTable:
    """Static force of one muscle, cell by cell.

    Parameters
    ----------
    pressure : gauge pressure [Pa], shape (n,).
    contraction : contraction ratio kappa = (l0 - l)/l0 [1], shape (n,).
    force : pulling force [N], shape (n,). A force <= 0 means slack: such a cell is censored
        (the law lies somewhere below zero there) and is no equality for a fit. So is one that
        reads no more than the floor.
    rest_length : l0 [m], or None when the table was given over contraction without it.
    source : where the numbers come from.
    branch : of each cell, such as "inflation" and "deflation"; empty when none was named.
    run : which repeat each cell belongs to; empty when none was named.
    file : which file each cell comes from, where several were read.
    scatter, error : of a ramp binned to cells: standard deviation of the rows within a cell, and
        of their mean [N], shape (n,); None where cells were measured one by one.
    notes : what was left out or mended in reading, in words.
    floor : what slack cells read (a load cell's zero, say): "found" in the table, see
        :mod:`pam_ocp.fitting.tables.floor`; known already; or None: any positive force is one.
        Another choice is made by :meth:`with_floor`.
    censored : cells that are slack whatever they read, shape (n,); None: those at the floor.

    Examples
    --------
    >>> cells = pam.fitting.ForceTable([1e5, 2e5], [0.0, 0.05], [300.0, 400.0], rest_length=0.3)
    >>> cells
    ForceTable(2 cells, 2 taut: p 1..2 bar, kappa 0..5 %, F up to 400 N, l0 0.3 m)
    """

    pressure: Array
    contraction: Array
    force: Array
    rest_length: float | None = None
    source: str = ""
    branch: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    file: tuple[str, ...] = ()
    scatter: Array | None = None
    error: Array | None = None
    notes: tuple[str, ...] = ()
    floor: Floor | Literal["found"] | None = "found"
    censored: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        for name, unit in (("pressure", "Pa"), ("contraction", "1"), ("force", "N")):
            given = require_numbers(name, getattr(self, name), unit, doubted=unit == "Pa")
            array = np.array(given)
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
            length = require_positive("rest_length", self.rest_length, "m")
            object.__setattr__(self, "rest_length", length)
        for name in ("scatter", "error"):
            given = getattr(self, name)
            if given is not None and np.shape(given) != self.pressure.shape:
                raise InputError(f"{name} has shape {np.shape(given)} for {len(self)} cells")
        for name in ("branch", "run", "file"):
            labels = tuple(str(label) for label in getattr(self, name))
            if labels and len(labels) != len(self):
                raise InputError(f"{name} has {len(labels)} labels for {len(self)} cells")
            object.__setattr__(self, name, labels)

    @cached_property
    def _floor(self) -> tuple[Floor | None, NDArray[np.bool_]]:
        """The floor, and the cells at it."""
        none = np.zeros(len(self), dtype=bool)
        if self.censored is not None or self.floor is None:
            known = self.floor if isinstance(self.floor, Floor) else None
            return known, none if self.censored is None else np.asarray(self.censored, bool)
        found = find_floor(self.pressure, self.contraction, self.force, self.branch, self.file)
        return found or (None, none)

    def _noted(self, *notes: str) -> ForceTable:
        """The same readings with these notes; their floor is not sought again."""
        noted = replace(self, notes=notes)
        noted.__dict__["_floor"] = self._floor
        return noted

    @property
    def floor_found(self) -> Floor | None:
        """What slack cells read; None where there is no sign of it."""
        return self._floor[0]

    @property
    def slack(self) -> NDArray[np.bool_]:
        """True for the censored cells: force <= 0, or no more than the floor; shape (n,)."""
        return np.asarray((self.force <= 0) | self._floor[1])

    def with_floor(self, floor: float | Literal["found", "zero"] | None) -> ForceTable:
        """The same readings with another floor.

        floor : [N], cells that read no more are slack; None: there is none, a positive force is
            one; "found": as the table tells; "zero": what it tells is the zero of the load cell, so
            it is taken off all forces, those of taut cells too (by branch and file, where the
            slack cells differ). Raises InputError where "zero" finds no slack cell.

        Examples
        --------
        >>> shifted = pam.fitting.ForceTable(table.pressure, table.contraction, table.force + 7.0)
        >>> bool(np.allclose(shifted.with_floor("zero").taut.force, table.taut.force))
        True
        """
        if floor is None or floor == "found":
            return replace(self, floor=floor, censored=None)
        if floor != "zero":
            if str(floor).strip().isalpha():
                raise InputError(
                    f"floor = {floor!r}: give a force such as '5 N', 'found', 'zero' or None"
                )
            limit = require_positive("floor", floor, "N", zero=True)
            return replace(self, floor=None, censored=self.force <= limit)
        known = isinstance(self.floor, Floor)
        fresh = self if known else replace(self, floor="found", censored=None)
        found, slack = fresh._floor
        if found is None:
            raise InputError(
                "floor='zero': the table shows no cells that are slack beyond doubt, from which "
                "the zero of the load cell could be read; give it as a calibration, "
                "units={'force': 'N - 5 N'}"
            )
        parts = part_names(self.branch, self.file, len(self))
        return replace(
            self,
            force=self.force - [found.by.get(n, found.value) for n in parts],
            floor=replace(found, value=0.0, limit=DETECTED * found.scatter, by={}),
            censored=slack,
            notes=(*self.notes, f"{found}; as the zero of the load cell taken off all forces"),
        )

    @property
    def taut(self) -> ForceTable:
        """The cells with force > 0, which a fit may use as equalities."""
        return self.subset(~self.slack)

    def subset(self, chosen: ArrayLike | slice) -> ForceTable:
        """The chosen cells (mask, indices or slice) as a table."""
        try:
            cells = np.arange(len(self))
            index = cells[chosen if isinstance(chosen, slice) else np.asarray(chosen)]
        except (IndexError, ValueError) as error:
            raise InputError(
                f"chosen: {error}; give a mask of {len(self)} cells, their numbers or a slice"
            ) from None
        chosen_cells: dict[str, Any] = {
            n: a[index] for n in MEASURES if (a := getattr(self, n)) is not None
        }
        for name in LABELLED:
            labels = getattr(self, name)
            chosen_cells[name] = tuple(labels[i] for i in index) if labels else ()
        floor, at_floor = self._floor
        return replace(self, **chosen_cells, floor=floor, censored=at_floor[index])

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
        rising = self.contraction[order]
        firsts, place = [], 0
        while place < len(rising):  # from the lowest of a level to that of the next
            firsts.append(place)
            place = int(np.searchsorted(rising, rising[place] + tolerance, side="right"))
        numbers = np.empty(len(self), dtype=np.intp)
        numbers[order] = np.searchsorted(firsts, np.arange(len(order)), side="right") - 1
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


@with_kinds
def read_table(
    source: Any,
    *,
    rest_length: float | None = None,
    columns: Mapping[str, str] | Sequence[str | None] | None = None,
    units: Mapping[str, str] | None = None,
    ambient_pressure: float = AMBIENT,
    sheet: str | int | None = None,
    skip: int = 0,
    pick: str | Sequence[str] | None = None,
    pivot: Sequence[str] | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    encoding: str | None = None,
    bad_lines: Literal["refuse", "drop"] = "refuse",
    constants: Mapping[str, Any] | None = None,
    pattern: str | None = None,
    empty: Literal["drop", "refuse"] = "drop",
    missing: Any = "found",
    ramp: bool | None = None,
    floor: float | str | None = "found",
) -> ForceTable:
    """Read a measured force table; :func:`look` shows beforehand what is understood.

    Parameters
    ----------
    source : path of a text (CSV, TSV, LVM, columns between blanks, ``key=value`` lines; also packed
        as .gz), of an XLSX, XLS, ODS, NPY, NPZ, MAT, HDF5, JSON, Parquet, TDMS, MCAP or BAG file, a
        pandas DataFrame, or a mapping from column names to arrays. The name of a bundled table,
        such as ``"DMSP-20-300_static.csv"``, works where no such file exists. A list of these, a
        folder or a pattern (``"rig/*.csv"``) makes one table; ``file`` then says where each cell
        comes from.
    rest_length : l0 [m]; needed when the table holds lengths instead of contractions.
    columns : which column holds a quantity, ``{"pressure": "P1"}``, where its name does not say
        it. Quantities: pressure, force, and length or contraction; labels: branch (inflation or
        deflation) and run (which repeat). Or the names of all columns from the left, with units,
        where the file has none: ``["length [mm]", "pressure [bar]", None, "force [N]"]``.
    units : ``{"pressure": "kPa"}`` where the header names no unit; ``"bar abs"`` for absolute
        pressures; or a calibration, ``{"pressure": "V * 2 bar/V - 0.3 bar"}``. Default: Pa (gauge),
        N, m, contraction as a fraction.
    ambient_pressure : [Pa], taken off absolute pressures.
    sheet : of a workbook, its name, or its number from 1. skip : lines at the beginning to leave
        out. pick : which table of nested data, or which block of several side by side; a list puts
        tables with clocks of their own on one. delimiter, decimal, encoding : of a text, where they
        are taken wrongly.
    bad_lines : "drop": stray and cut lines are left out, counted and said in a ReadingWarning.
    constants : what the file does not hold and is the same for all its rows:
        ``{"contraction": "5 %", "branch": "inflation", "run": 2}``.
    pattern : the same from the file's name, with headers in braces:
        ``"M1_{contraction [%]}pct_run{run}.csv"``.
    pivot : headers of what runs down, across, and stands in the cells, where a pivot does not say
        it: ``("contraction [%]", "pressure [bar]", "force [N]")``.
    empty : rows with empty cells are dropped, counted and said in a ReadingWarning, or refused.
    missing : values that mark missing ones, as they stand: ``[9999, "off"]``. "found": 9999, -999,
        1e30, 65535 and their like where they stand apart from all others; None: there are none.
    ramp : True: the rows are a slow ramp in the order of time, to be binned to cells; False: each
        row is a cell; None: find out. See :mod:`pam_ocp.fitting.tables.ramps`.
    floor : force [N], or text with a unit, at or below which the sensor shows nothing: these cells
        are slack. "found": a least value that stands there again and again, or what cells read
        where the muscle cannot pull (:mod:`pam_ocp.fitting.tables.floor`); it is said in a
        ReadingWarning. "zero": that is the zero of the load cell, and taken off all forces
        (:meth:`ForceTable.with_floor`). None: there is none, any positive force is one.

    The table is in SI, slack cells included. Raises InputError, UnknownNameError: one sentence with
    column, row, value and remedy. What no rig measures, but cannot be ruled out, is doubted in a
    UnitWarning with the keyword to settle it.

    Examples
    --------
    >>> table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
    >>> len(table), len(table.taut)  # cells, those with a force
    (126, 60)
    """
    given = {name: value for name, value in locals().items() if name != "source"}
    words = TableArguments(**given)
    if is_source(source):
        with naming(source):
            table = table_of(load(source, words), words)
        say(table.source, table.notes)
        return table
    tables = []
    for one in sources_of(source):
        with naming(one):
            tables.append(table_of(load(one, words), words))
        say(tables[-1].source, tables[-1].notes)
    whole = joined_tables(tables)
    if whole.floor_found and not any(t.floor_found for t in tables):
        say(whole.source, _floor_notes(whole))
    return whole


@dataclass(frozen=True)
class TableArguments(Reading):
    """What the user says of a force table; see :func:`read_table`."""

    rest_length: float | None = None
    ramp: bool | None = None
    floor: Any = "found"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rest_length is not None:
            length = require_positive("rest_length", self.rest_length, "m")
            object.__setattr__(self, "rest_length", length)
        if self.floor == "none":
            object.__setattr__(self, "floor", None)
        elif self.floor is not None and self.floor not in ("found", "zero"):
            floor = quantity("floor", self.floor, "N")
            object.__setattr__(self, "floor", require_positive("floor", floor, "N", zero=True))


def table_of(raw: RawTable, words: TableArguments, seen: Understood | None = None) -> ForceTable:
    """The table that columns hold; ``seen`` is told what was understood until an error."""
    seen = seen or Understood(raw)
    columns = assigned(raw, words.columns, words.units, words.ambient_pressure, words.rest_length)
    seen.meanings |= {column.header: (q, column.scale) for q, column in columns.items()}
    require_columns(raw, columns)
    seen.raw = raw = checked_cells(raw, tuple(columns.values()), words.missing)
    raw = complete(raw, [column.header for column in columns.values()], words.empty)
    series = {q: Series(column, raw) for q, column in columns.items()}
    check_pressure(series["pressure"])
    check_force(series["force"])
    kappa = contraction_of(series, words.rest_length)
    p, force, notes = series["pressure"].si, np.array(series["force"].si), list(raw.notes)
    notes += [
        doubt for q, column in columns.items() for doubt in doubts_of(raw, column, series[q].si)
    ]
    notes += doubts_of_table(columns, p, kappa, force)
    floor = {"found": floor_of(force), "zero": None}.get(words.floor, words.floor)
    at_floor = np.zeros(force.size, bool) if floor is None else force <= floor
    force[at_floor] = np.minimum(force[at_floor], 0.0)
    if floor is not None and (floor > 0 or words.floor != "found"):
        count = f"{int(at_floor.sum())} rows at or below the floor of the sensor, {floor:g} N"
        notes.append(f"{count}, count as slack")
    labels = read_labels(raw, words.columns)
    branch, run = labels.get("branch", ()), labels.get("run", ())
    rows = ForceTable(p, kappa, force, words.rest_length, raw.label, branch, run)
    ramp = None if words.ramp is False else ramp_of(p, kappa, force, bool(words.ramp))
    if words.ramp and ramp is None:
        raise InputError(
            f"{raw.label}: no ramp is found in its {len(rows)} rows (one of pressure and "
            "contraction held, the other rising and falling in small steps); leave ramp= away"
        )
    table = rows if ramp is None else _binned(rows, ramp, at_floor)
    notes += [f"a ramp: {ramp.words}"] if ramp else []
    if words.floor not in ("found", "zero"):
        table = table.with_floor(None)
    elif table.floor_found and ramp:
        table = _binned(rows, ramp, at_floor | _shows_floor(table, rows), table.floor_found)
    if words.floor == "zero":
        table = replace(table, notes=tuple(notes)).with_floor("zero")
    else:
        table = table._noted(*notes, *_floor_notes(table))
    check_mixed_pressure(series["pressure"], rows.pressure, rows.force, rows.contraction)
    if not np.any(~table.slack):
        sign = (
            "all forces are negative or zero: count pulling as positive"
            if np.any(table.force < 0)
            else "every force is zero"
        )
        raise InputError(f"{raw.label}: all {len(table)} cells are slack ({sign})")
    return table


def _floor_notes(table: ForceTable) -> tuple[str, ...]:
    """The floor, in words, and what to say if it is something else."""
    floor = table.floor_found
    if floor is None or not floor.matters:
        return ()
    zero = (
        "if that is the zero of the load cell, which taut cells then carry, too, floor='zero' "
        "takes it off; "
    )
    return (f"{floor}; {zero if floor.shifted else ''}floor=None if they are forces",)


def _shows_floor(cells: ForceTable, rows: ForceTable) -> NDArray[np.bool_]:
    """Rows of a ramp that read no more than the floor of its cells, scattering as rows do there."""
    assert cells.floor_found is not None
    assert cells.scatter is not None
    scatter = float(np.median(cells.scatter[cells.slack]))
    return np.asarray(rows.force <= cells.floor_found.limit + DETECTED * scatter)


def _binned(
    rows: ForceTable, ramp: Ramp, at_floor: NDArray[np.bool_], floor: Floor | None = None
) -> ForceTable:
    """A table of the ramp's cells: means of their rows. Where half of them show the sensor's floor
    it is slack; where fewer do it is left out, for their mean would lie too high.
    """
    shares = [float(np.mean(at_floor[cell.rows])) for cell in ramp.cells]
    kept = [(c, share) for c, share in zip(ramp.cells, shares, strict=True) if not 0 < share < 0.5]
    cells, parts = [c for c, _ in kept], [c.rows for c, _ in kept]
    slack = np.array([share > 0 for _, share in kept])
    force = [
        float(np.median(rows.force[c.rows])) if share else float(rows.force[c.rows].mean())
        for c, share in kept
    ]

    def common(labels: tuple[str, ...], own: list[str]) -> tuple[str, ...]:
        """What the user's labels say of a cell, else what the ramp does."""
        if not labels:
            return tuple(own)
        return tuple(Counter(labels[i] for i in part).most_common(1)[0][0] for part in parts)

    return ForceTable(
        np.array([rows.pressure[part].mean() for part in parts]),
        np.array([rows.contraction[part].mean() for part in parts]),
        np.array(force),
        rows.rest_length,
        rows.source,
        common(rows.branch, [c.branch for c in cells]),
        common(rows.run, [c.run for c in cells]),
        scatter=np.array([c.scatter for c in cells]),
        error=np.array([c.error for c in cells]),
        floor=floor or "found",
        censored=slack if slack.any() else None,
    )


def joined_tables(tables: Sequence[ForceTable]) -> ForceTable:
    """Several tables behind each other; one stays as it is."""
    if len(tables) == 1:
        return tables[0]

    def labels(name: str) -> tuple[str, ...]:
        there = [getattr(t, name) or ("",) * len(t) for t in tables]
        return tuple(text for own in there for text in own) if any(map(any, there)) else ()

    columns: dict[str, Any] = {
        name: np.concatenate([getattr(t, name) for t in tables])
        for name in MEASURES
        if all(getattr(t, name) is not None for t in tables)
    }
    return ForceTable(
        **columns,
        rest_length=tables[0].rest_length,
        source=f"{len(tables)} files",
        branch=labels("branch"),
        run=labels("run"),
        file=tuple(t.source for t in tables for _ in range(len(t))),
        notes=tuple(f"{t.source}: {note}" for t in tables for note in t.notes),
        **joined_floor(tables),
    )


def joined_floor(tables: Sequence[ForceTable]) -> dict[str, Any]:
    """``floor`` and ``censored`` of tables together: found anew, unless one of them says more."""
    if all(t.floor == "found" and t.censored is None for t in tables):
        return {}
    floors = [t.floor for t in tables if isinstance(t.floor, Floor)]
    return {
        "floor": floors[0] if floors else None,
        "censored": np.concatenate([t._floor[1] for t in tables]),
    }


def require_table(value: Any, argument: str = "table") -> ForceTable:
    """``value``, or an InputError when it is no ForceTable."""
    if not isinstance(value, ForceTable):
        raise InputError(f"{argument} is {kind_of(value)}; read it with read_table(...)")
    return value
