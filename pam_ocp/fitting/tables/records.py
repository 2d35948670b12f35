"""Measured records: time series from files, named and united like a plant's variables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ...core.errors import InputError, UnknownNameError, require_positive
from ...core.signals import Interpolation
from ...core.trajectory import HELD, Trajectory, interpolation_of
from ...core.units import Unit, unit
from ...core.variables import Variable
from ...core.calibration import SPELLINGS
from .raw import RawTable
from .headers import parse_header
from .sources import load, naming

if TYPE_CHECKING:
    from ...plants.plant import Plant
    from ..statistics import Array

__all__ = ["read_record", "read_records"]

TIME_NAMES = ("time", "t", "zeit", "timestamp")
GAP = 10.0
"""A step of time longer than this many usual ones is a gap."""
BEYOND = 20.0
"""A value this many times beyond a variable's bounds was read in a wrong unit."""
LEAST_PRESSURE = 1e3
"""A record whose pressures stay below this [Pa] was read in a wrong unit."""
_SI = ("1", "m", "s", "kg", "K", "rad", "N", "Pa", "J", "W", "m/s", "rad/s", "m3", "N.m", "Pa/s")


def read_record(
    source: Any,
    plant: Plant | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    time: str | None = None,
    interpolation: Interpolation | None = None,
    inputs: Literal["held", "linear"] | None = None,
    max_gap: float | None = None,
) -> Trajectory:
    """Read one measured record as a Trajectory in SI, sampled as it is.

    Parameters
    ----------
    source : path of a CSV, TSV, NPZ, MAT, Parquet or XLSX file, a DataFrame, or a mapping from
        column names to arrays. Headers name a quantity and its unit: ``x [mm]``, ``p1_bar``.
    plant : its variables give names, units and kinds to the columns (``_`` for ``.`` in headers);
        columns that it does not know are left out. Without a plant every column is an output.
    columns : {variable: header} where the header does not say it.
    units : {variable: unit} where the header names none; by default SI.
    time : header of the time; by default the one called time or t. Without a unit in seconds.
    inputs : how inputs ran between samples: "held" (as a digital controller writes them) or
        "linear". By default as the file says, if a Trajectory wrote it. Where nothing says it, they
        count as linear until a fit tries both (``Trajectory.interpolation_known``).
    interpolation : the same as ``inputs``, as Trajectory calls it: "previous" (held) or "linear".
    max_gap : longest step of time [s] that is no gap; by default ten times the usual one.

    Raises
    ------
    InputError : time that runs backwards or has a gap (and where), cells that are no numbers, units
        that do not fit, no column of use. UnknownNameError : names that are not there.
    """
    between = _between(inputs, interpolation)
    with naming(source):
        return _record(
            _loaded(source), plant, dict(columns or {}), dict(units or {}), time, between, max_gap
        )


def read_records(
    sources: Any, plant: Plant | None = None, *, split: str | None = None, **options: Any
) -> list[Trajectory]:
    """Read several records: a list of sources, or one source cut where column ``split`` changes.

    options : as for :func:`read_record`.
    """
    if split is None:
        if isinstance(sources, (str, Path, Mapping)) or not isinstance(sources, Iterable):
            sources = [sources]
        sources = list(sources)
        if not sources:
            raise InputError("sources is empty: give at least one file or table")
        return [read_record(source, plant, **options) for source in sources]
    with naming(sources):
        return _parts(sources, plant, split, options)


def _parts(
    source: Any, plant: Plant | None, split: str, options: Mapping[str, Any]
) -> list[Trajectory]:
    """The records of one source, cut where a column changes."""
    raw = _loaded(source)
    if split not in raw.columns:
        raise UnknownNameError("column to split at", split, raw.columns)
    label = raw.columns[split]
    cuts = [0, *(i for i in range(1, len(label)) if label[i] != label[i - 1]), len(label)]
    arguments = {
        "columns": None,
        "units": None,
        "time": None,
        "interpolation": None,
        "inputs": None,
        "max_gap": None,
        **options,
    }
    between = _between(arguments["inputs"], arguments["interpolation"])
    records = []
    for first, last in pairwise(cuts):
        part = replace(
            raw,
            label=f"{raw.label}, {split} {label[first]}",
            columns={n: c[first:last] for n, c in raw.columns.items()},
            lines=raw.lines[first:last] if raw.lines else None,
        )
        records.append(
            _record(
                part,
                plant,
                dict(arguments["columns"] or {}),
                dict(arguments["units"] or {}),
                arguments["time"],
                between,
                arguments["max_gap"],
            )
        )
    return records


def _between(inputs: Any, interpolation: Any) -> Interpolation | None:
    """How inputs ran, from either argument; None where nothing is said."""
    if inputs not in (None, "held", "linear"):
        raise InputError(f"inputs = {inputs!r}: choose 'held' or 'linear'")
    said: Interpolation | None = {"held": "previous", "linear": "linear"}.get(inputs)  # type: ignore[assignment]
    if said and interpolation and said != interpolation:
        raise InputError(
            f"inputs = {inputs!r} contradicts interpolation = {interpolation!r}; leave one"
        )
    return said or interpolation


def _loaded(source: Any) -> RawTable:
    """The columns of a source; a Trajectory in a binary file keeps what it says of its inputs."""
    if isinstance(source, (str, Path)) and Path(source).suffix.lower() in (".npz", ".parquet"):
        try:
            saved = Trajectory.load(source)
        except InputError:
            return load(source)  # made by others
        columns: dict[str, Any] = {"time [s]": saved.t.tolist()}
        columns |= {f"{v.name} [{v.unit}]": saved[v.name].tolist() for v in saved.variables}
        if saved.interpolation_known and saved.named("input"):
            columns[HELD] = [float(saved.interpolation == "previous")] * len(saved)
        return RawTable(Path(source).name, columns)
    return load(source)


def _record(
    raw: RawTable,
    plant: Plant | None,
    columns: dict[str, str],
    units: dict[str, str],
    time: str | None,
    interpolation: Interpolation | None,
    max_gap: float | None,
) -> Trajectory:
    if HELD in raw.columns:
        interpolation = interpolation or interpolation_of(raw.numbers(HELD), raw.label)
        raw = replace(raw, columns={n: c for n, c in raw.columns.items() if n != HELD})
    for header in columns.values():
        if header not in raw.columns:
            raise UnknownNameError("column", header, raw.columns)
    clock = _clock(raw, time)
    t = raw.numbers(clock) * _factor(raw, clock, "time", unit("s"), units.get("time"))
    _check_time(raw, clock, t, max_gap)
    found = _variables(raw, plant, columns, clock)
    unknown = set(units) - {v.name for v, _ in found} - {"time"}
    if unknown:
        raise UnknownNameError("variable in units", unknown.pop(), [v.name for v, _ in found])
    values: dict[str, Array] = {}
    variables = []
    for variable, header in found:
        base = unit(variable.unit) if plant is not None else None
        factor = _factor(raw, header, variable.name, base, units.get(variable.name))
        values[variable.name] = raw.numbers(header) * factor
        if plant is not None:
            said = units.get(variable.name) or parse_header(header)[1]
            _check_size(raw, header, variable, values[variable.name], said)
        if plant is None:
            said = units.get(variable.name) or parse_header(header)[1] or "1"
            variable = Variable(variable.name, "output", unit=_si(said))
        variables.append(variable)
    return Trajectory(t, values, variables, interpolation)


def _clock(raw: RawTable, time: str | None) -> str:
    if time is not None:
        if time not in raw.columns:
            raise UnknownNameError("column of the time", time, raw.columns)
        return time
    for header in raw.columns:
        if parse_header(header)[0] in TIME_NAMES:
            return header
    raise InputError(
        f"{raw.label} has no column for the time among {', '.join(map(repr, raw.columns))}: "
        "name it 'time [s]' or give time=..."
    )


def _factor(raw: RawTable, header: str, name: str, base: Unit | None, wanted: str | None) -> float:
    """SI value per value of a column."""
    said = parse_header(header)[1]
    text = wanted or said
    if text is None:
        return 1.0
    measured = unit(SPELLINGS.get(text.lower(), text))
    if wanted and said and not unit(said).compatible(measured):
        raise InputError(
            f"{raw.label}: column {header!r} says {said} but units[{name!r}] = {wanted!r}; "
            "correct the header or leave units away"
        )
    if base is not None and not measured.compatible(base):
        raise InputError(
            f"{raw.label}: column {header!r} is in {text}, which is no unit of {name} "
            f"({base.name}); correct the header or give units={{{name!r}: ...}}"
        )
    return measured.factor


def _check_size(
    raw: RawTable, header: str, variable: Variable, values: Array, said: str | None
) -> None:
    """Values that no such variable takes come from a wrong unit."""
    bound = max((abs(v) for v in (variable.min, variable.max) if np.isfinite(v)), default=np.inf)
    worst = int(np.argmax(np.abs(values)))
    size = float(abs(values[worst]))
    read = f"read in {said}" if said else f"read in {variable.unit}, as no unit was named"
    place = (
        f"{raw.label}: column {header!r}, {raw.row(worst)}, is {values[worst]:.4g} {variable.unit}"
    )
    remedy = f"correct the header or give units={{{variable.name!r}: ...}}"
    if np.isfinite(bound) and size > BEYOND * max(bound, 1e-3 * variable.nominal):
        raise InputError(
            f"{place} ({read}), where {variable.name} lies within {variable.min:g} .. "
            f"{variable.max:g}: the unit cannot be right; {remedy}"
        )
    if variable.unit == "Pa" and 0 < size < LEAST_PRESSURE:
        raise InputError(
            f"{place} at most ({read}): no muscle moves at that, it looks like bar or kPa; {remedy}"
        )


def _si(text: str) -> str:
    measured = unit(SPELLINGS.get(text.lower(), text))
    fitting = (name for name in _SI if unit(name).compatible(measured))
    return next(fitting, text if measured.factor == 1.0 else "1")


def _check_time(raw: RawTable, header: str, t: Array, max_gap: float | None) -> None:
    if len(t) < 2:
        raise InputError(f"{raw.label}: {len(t)} sample; a record needs at least 2")
    steps = np.diff(t)
    back = np.nonzero(steps <= 0)[0]
    if back.size:
        i = int(back[0])
        words = "stands still" if steps[i] == 0 else "runs backwards"
        raise InputError(
            f"{raw.label}: time {words} in {raw.row(i + 1)}, from {t[i]:g} to {t[i + 1]:g} s; "
            "sort the rows, or read the parts as separate records (read_records with split=...)"
        )
    usual = float(np.median(steps))
    limit = GAP * usual if max_gap is None else require_positive("max_gap", max_gap, "s")
    wide = np.nonzero(steps > limit * (1 + 1e-9))[0]
    if wide.size:
        i = int(wide[0])
        raise InputError(
            f"{raw.label}: a gap of {steps[i]:g} s before {raw.row(i + 1)} (from {t[i]:g} to "
            f"{t[i + 1]:g} s, where {usual:g} s are usual); read the parts as separate records, or "
            f"allow it with max_gap={1.01 * steps[i]:.3g}"
        )


def _variables(
    raw: RawTable, plant: Plant | None, columns: dict[str, str], clock: str
) -> list[tuple[Variable, str]]:
    """(variable, header) of every column of use."""
    taken = {*columns.values(), clock}
    rest = {h: parse_header(h)[0] for h in raw.columns if h not in taken}
    if plant is None:
        made = {"".join(c if c.isalnum() else "_" for c in n): h for h, n in rest.items()}
        return [(Variable(n, "output"), h) for n, h in {**columns, **made}.items()]
    chosen = {plant.variable(n).name: h for n, h in columns.items()}
    plain = {v.name.replace(".", " ").replace("_", " ").lower(): v for v in plant.variables}
    for header, name in rest.items():
        for words in (name, header.lower().replace("_", " ")):
            variable = plain.get(words.replace(".", " "))
            if variable is not None and variable.name not in chosen:
                chosen[variable.name] = header
    chosen = {n: h for n, h in chosen.items() if plant.variable(n).causality != "parameter"}
    if not chosen:
        raise InputError(
            f"{raw.label}: no column among {', '.join(map(repr, rest))} bears the name of a "
            f"variable of plant {plant.name!r}; give columns={{variable: header}}"
        )
    return [(plant.variable(n), h) for n, h in chosen.items()]
