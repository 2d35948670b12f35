"""Measured records: time series from files, named and united like a plant's variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ...core.calibration import AMBIENT, scale_of
from ...core.errors import InputError, UnknownNameError, require_positive, with_kinds
from ...core.signals import Interpolation
from ...core.trajectory import HELD, Trajectory, interpolation_of
from ...core.units import unit
from ...core.variables import Variable
from .cells import measures, parse_header
from .clock import (
    clock_words,
    doubts_of_clock,
    find_clock,
    mended,
    parts_of,
    read_clock,
    rows_before_jumps,
)
from .columns import check_size, column_scale, display_of, has_numbers, record_variables
from .doubts import (
    Column,
    Understood,
    above_ambient,
    checked_cells,
    doubts_of,
    kind_of,
)
from .raw import Doubt, RawTable, Reading, complete, say
from .sources import is_source, load, naming, sources_of

if TYPE_CHECKING:
    from ...plants.plant import Plant
    from ..statistics import Array


@dataclass(frozen=True)
class RecordArguments(Reading):
    """What the user says of a record; see :func:`read_record`."""

    time: str | None = None
    interpolation: Interpolation | None = None
    inputs: Literal["held", "linear"] | None = None
    max_gap: float | None = None
    clock: str = "mend"
    sample_time: float | str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clock not in ("mend", "cut", "refuse"):
            raise InputError(f"clock = {self.clock!r}: choose 'mend', 'cut' or 'refuse'")
        if self.sample_time is not None and self.sample_time != "even":
            step = require_positive("sample_time", self.sample_time, "s")
            object.__setattr__(self, "sample_time", step)
        object.__setattr__(self, "interpolation", _between(self.inputs, self.interpolation))


@with_kinds
def read_record(
    source: Any,
    plant: Plant | None = None,
    *,
    columns: Mapping[str, str] | Sequence[str | None] | None = None,
    units: Mapping[str, str] | None = None,
    time: str | None = None,
    interpolation: Interpolation | None = None,
    inputs: Literal["held", "linear"] | None = None,
    max_gap: float | None = None,
    clock: Literal["mend", "cut", "refuse"] = "mend",
    sample_time: float | str | None = None,
    ambient_pressure: float = AMBIENT,
    sheet: str | int | None = None,
    skip: int = 0,
    pick: str | Sequence[str] | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    encoding: str | None = None,
    bad_lines: Literal["refuse", "drop"] = "refuse",
    constants: Mapping[str, Any] | None = None,
    pattern: str | None = None,
    empty: Literal["drop", "refuse"] = "drop",
    missing: Any = "found",
) -> Trajectory:
    """Read one measured record as a Trajectory in SI, sampled as it is; :func:`look` shows
    beforehand what is understood.

    Parameters
    ----------
    source : path of a text (CSV, TSV, LVM, columns between blanks, ``key=value`` lines; also packed
        as .gz), of an NPY, NPZ, MAT, HDF5, JSON, Parquet, XLSX, TDMS, MCAP or BAG file, a folder
        that is a bag of ROS 2, a DataFrame, or a mapping from column names to arrays. Topics,
        groups and structures with clocks of their own are put on one. Headers name a quantity and
        its unit: ``x [mm]``, ``p1_bar``.
    plant : its variables give names, units and kinds to the columns (``_`` for ``.`` in headers;
        "Druck 1" or "p1" for ``muscle1.pressure``); columns that it does not know are left out.
        Without a plant every column of numbers is an output.
    columns : {variable: header} where the header does not say it; or the names of all columns from
        the left, where the file has none.
    units : {variable: unit} where the header names none; by default SI. ``"bar abs"`` for absolute
        pressures; or a calibration, ``{"muscle1.command": "V * 2 bar/V - 0.3 bar"}``.
    time : header of the time; by default the one called time or t. Without a unit in seconds
        (else ``units={"time": "ms"}``); steps that no rig takes are doubted. Dates, times of day,
        days of a spreadsheet and counts from 1970 are read as such, and begin with 0.
    inputs : how inputs ran between samples: "held" (as a digital controller writes them) or
        "linear". By default as the file says, if a Trajectory wrote it. Where nothing says it, they
        count as linear until a fit tries both (``Trajectory.interpolation_known``).
    interpolation : the same as ``inputs``, as Trajectory calls it: "previous" (held) or "linear".
    max_gap : longest step of time [s] that is no gap; by default ten times the usual one.
    clock : "mend": rows of a repeated or a single wrong time are dropped, a coarse clock is spread
        evenly, a counter that began anew is counted on (each said in a ReadingWarning), gaps and
        backward steps are refused. "cut": there the record is cut, and the longest part taken
        (:func:`read_records` gives all). "refuse": nothing is mended.
    sample_time : resample to even steps [s], or "even": to the usual step of the record. Of a file
        without a time: the time between its rows.
    ambient_pressure : [Pa], taken off absolute pressures.
    sheet, skip, pick, delimiter, decimal, encoding, bad_lines, constants, pattern, empty,
    missing : as for :func:`read_table`.

    Raises InputError (time that runs backwards or has a gap (and where), cells that are no numbers,
    units that do not fit, no column of use), UnknownNameError. What no rig measures, but cannot be
    ruled out, is doubted in a UnitWarning that names the remedy.

    Examples
    --------
    >>> path = record.save("run.csv")
    >>> pam.read_record(path, plant)["x"].shape
    (201,)
    """
    given = {n: value for n, value in locals().items() if n not in ("source", "plant")}
    words = RecordArguments(**given)
    if plant is not None:
        from ...plants.plant import require_plant

        require_plant(plant)
    if not is_source(source):
        folder = isinstance(source, str | Path) and Path(source).is_dir()
        what = f"{source} is a folder" if folder else "source is several"
        raise InputError(f"{what}; give a file, or read all of them by read_records(...)")
    with naming(source):
        raw = loaded(source, words)
        parts, notes = record_parts(raw, plant, words)
    longest = max(parts, key=len)
    if len(parts) > 1:
        notes.append(f"the longest of {len(parts)} parts is taken, {len(longest)} rows")
    say(raw.label, notes)
    return longest


@with_kinds
def read_records(
    sources: Any, plant: Plant | None = None, *, split: str | None = None, **options: Any
) -> list[Trajectory]:
    """Read several records: a list of sources, a folder, a pattern such as ``"rig/run*.csv"``, or
    one source cut where column ``split`` changes, or where its clock jumps (``clock="cut"``).

    options : as for :func:`read_record`.

    Examples
    --------
    >>> paths = [record.save("run1.csv"), record.save("run2.csv")]
    >>> len(pam.read_records(paths, plant))
    2
    """
    words = RecordArguments(**options)
    found: list[Trajectory] = []
    for source in [sources] if is_source(sources) else sources_of(sources):
        with naming(source):
            raw = loaded(source, words)
            notes: list[str] = []
            for part in [raw] if split is None else _split(raw, split):
                records, told = record_parts(part, plant, words)
                found += records
                notes += told
        say(raw.label, notes)
    return found


def _split(raw: RawTable, split: str) -> list[RawTable]:
    """The parts of a table, cut where a column changes."""
    if split not in raw.columns:
        raise UnknownNameError("column to split at", split, raw.columns)
    label = raw.columns[split]
    cuts = [0, *(i for i in range(1, len(label)) if label[i] != label[i - 1]), len(label)]
    parts = (raw.taken(np.arange(a, b)) for a, b in pairwise(cuts))
    return [
        replace(part, label=f"{raw.label}, {split} {label[first]}")
        for part, first in zip(parts, cuts[:-1], strict=True)
    ]


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


def loaded(source: Any, how: Reading) -> RawTable:
    """The columns of a source; a Trajectory in a binary file keeps what it says of its inputs."""
    own = isinstance(source, (str, Path)) and Path(source).suffix.lower() in (".npz", ".parquet")
    if own and not (how.constants or how.pattern):
        try:
            saved = Trajectory.load(source)
        except InputError:
            return load(source, how)  # made by others
        columns: dict[str, Any] = {"time [s]": saved.t.tolist()}
        columns |= {f"{v.name} [{v.unit}]": saved[v.name].tolist() for v in saved.variables}
        if saved.interpolation_known and saved.named("input"):
            columns[HELD] = [float(saved.interpolation == "previous")] * len(saved)
        return RawTable(Path(source).name, columns, dialect=("a saved Trajectory",), own=True)
    return load(source, how)


def record_parts(
    raw: RawTable, plant: Plant | None, words: RecordArguments, seen: Understood | None = None
) -> tuple[list[Trajectory], list[str]]:
    """(records between the cuts, notes); ``seen`` is told what was understood until an error."""
    seen, between = seen or Understood(raw), words.interpolation
    if HELD in raw.columns:
        between = between or interpolation_of(raw.numbers(HELD), raw.label)
        raw = replace(raw, columns={n: c for n, c in raw.columns.items() if n != HELD})
    for named in words.columns.values():
        if named not in raw.columns:
            raise UnknownNameError("column", named, raw.columns)
    raw, header = _clock_of(raw, words)
    seen.raw, seen.meanings[header] = raw, ("time", None)
    raw = raw if plant is not None else _in_known_units(raw, words, header)
    pairs = record_variables(raw, plant, dict(words.columns), header)
    if plant is not None and not any(v.causality == "input" for v, _ in pairs):
        raw = _without_input(raw, plant, {h for _, h in pairs} | {header})
    seen.meanings |= {h: (variable.name, None) for variable, h in pairs}
    columns = [_column(raw, variable, h, plant, words) for variable, h in pairs]
    seen.meanings |= {c.header: (c.argument, c.scale) for c in columns}
    known = [column.argument for column in columns]
    unknown = set(words.units) - {*known, "time"}
    if unknown:
        raise UnknownNameError("variable in units", unknown.pop(), known)
    raw = checked_cells(raw, columns, words.missing)
    seen.raw = replace(raw, columns={**seen.raw.columns, **raw.columns})
    t, kind, doubts = read_clock(raw, header, words.units.get("time"))
    seen.clock = clock_words(header, kind, t[~np.isnan(t)])
    scale = column_scale(raw, header, "time", unit("s"), words.units.get("time"))
    factor = float(np.ptp(scale.si(np.array([0.0, 1.0])))) if scale and not kind else 1.0
    used = {c.header: raw.columns[c.header] for c in columns}
    timed = replace(raw, columns={**used, header: t.tolist()})
    timed = complete(timed, [header, *used], words.empty)
    t = timed.numbers(header)
    before = rows_before_jumps(timed, header, t)
    if before.size:
        between = between or "previous"
        said = f"{before.size} times stand twice, as in FMI's tables of held inputs: taken as jumps"
        timed, t = timed.taken(np.delete(np.arange(t.size), before), said), np.delete(t, before)
    if words.clock != "refuse":
        timed, t = mended(timed, header, t, factor)
    spans = parts_of(timed, header, t, words.max_gap, words.clock == "cut")
    variables, values = _values(timed, plant, columns)
    records = [
        Trajectory(t[a:b], {n: v[a:b] for n, v in values.items()}, variables, between)
        for a, b in spans
    ]
    notes = [*timed.notes, *doubts, *_doubts(timed, columns, values)]
    if not (kind or raw.own):
        notes += doubts_of_clock(header, t, raw.unit(header), words.units.get("time"))
    if len(spans) > 1:
        notes.append(f"the clock jumps: cut into {len(spans)} parts")
    seen.clock = clock_words(header, kind, t)
    if words.sample_time is not None:
        records = [_even(record, words.sample_time) for record in records]
    return records, notes


COUNTED = "time [s]"
"""Header of times that were made of ``sample_time``."""


def _clock_of(raw: RawTable, words: RecordArguments) -> tuple[RawTable, str]:
    """(table, header of its time), which is counted where the user says how long a row takes."""
    raw, header = find_clock(raw, words.time)
    if header is not None:
        return raw, header
    timed = [h for h in raw.columns if measures(raw.unit(h), "s")]
    step = words.sample_time
    if not isinstance(step, float) or timed:
        shown = f"time={timed[0]!r}" if timed else "time=..."
        raise InputError(
            f"{raw.label} has no column for the time among {', '.join(map(repr, raw.columns))}: "
            f"name it 'time [s]', give {shown}, or, where its rows are evenly apart and no column "
            "is their time, sample_time=0.001 [s]"
        )
    times = (step * np.arange(len(raw))).tolist()
    note = f"no column is the time: rows are counted, {step:g} s apart"
    columns = {COUNTED: times, **raw.columns}
    return replace(raw, columns=columns, notes=(*raw.notes, note)), COUNTED


def _in_known_units(raw: RawTable, words: RecordArguments, clock: str) -> RawTable:
    """The table without columns in units that are not known here, such as a temperature in °C; they
    are named, unless the user says what they are.
    """
    lost = []
    for header in raw.columns:
        name, said = parse_header(header)
        told = header in words.columns.values() or name in words.units or header == clock
        if (said is None and (said := raw.unit(header)) is None) or told:
            continue
        try:
            scale_of(header, said, None, None)
        except UnknownNameError:
            lost.append(header)
        except InputError:
            continue
    if not lost or len(lost) >= len(raw.columns) - 1:
        return raw
    note = (
        f"{', '.join(map(repr, lost))} left out, for the unit is not known here; to keep it say "
        f"units={{{parse_header(lost[0])[0]!r}: ...}}"
    )
    kept = {h: c for h, c in raw.columns.items() if h not in lost}
    return replace(raw, columns=kept, notes=(*raw.notes, note))


def _without_input(raw: RawTable, plant: Plant, read: set[str]) -> RawTable:
    """With a note, no column being an input, where others with numbers are left out."""
    inputs = [v.name for v in plant.inputs if not v.disturbance]
    others = [h for h in raw.columns if h not in read and has_numbers(raw, h)]
    if not inputs or not others:
        return raw
    note = (
        f"no column was read as an input ({', '.join(inputs)}), and {', '.join(map(repr, others))} "
        f"left out; if one was sent, give columns={{{inputs[0]!r}: {others[0]!r}}}"
    )
    return replace(raw, notes=(*raw.notes, note))


def _column(
    raw: RawTable, variable: Variable, header: str, plant: Plant | None, words: RecordArguments
) -> Column:
    """A column of use with its scale. Raises InputError."""
    base = unit(variable.unit) if plant is not None else None
    wanted = words.units.get(variable.name)
    scale = column_scale(raw, header, variable.name, base, wanted, words.ambient_pressure)
    if plant is not None:
        kind = kind_of(variable.name, variable.unit, told=True)
    else:
        measured = None if scale is None else display_of(scale)
        kind = kind_of(parse_header(header)[0], measured, told=False)
    known = variable if plant is not None else None
    return Column(header, variable.name, kind, scale, wanted is not None, known)


def _values(
    raw: RawTable, plant: Plant | None, columns: Sequence[Column]
) -> tuple[list[Variable], dict[str, Array]]:
    """Variables and their values in SI."""
    values: dict[str, Array] = {}
    variables = []
    for column in columns:
        header, variable = column.header, column.variable
        values[column.argument] = column.si(raw.numbers(header))
        if variable is not None:
            check_size(raw, header, variable, values[variable.name], column.scale)
        else:
            variable = Variable(column.argument, "output", unit=display_of(column.scale))
        variables.append(variable)
    return variables, values


def _doubts(raw: RawTable, columns: Sequence[Column], values: Mapping[str, Array]) -> list[Doubt]:
    """Doubts of the columns of a record, and of pressures beside their commands."""
    found = [doubt for c in columns for doubt in doubts_of(raw, c, values[c.argument])]
    for column in columns:
        part, _, last = column.argument.rpartition(".")
        if column.kind == "pressure" and last != "command" and not raw.own:
            command = values.get(f"{part}.command")
            found += above_ambient(column, values[column.argument], command)
    return found


def _even(record: Trajectory, step: float | str) -> Trajectory:
    """A record at even steps."""
    usual = float(np.median(np.diff(record.t))) if step == "even" else float(step)
    count = int(np.floor(record.duration / usual * (1 + 1e-12)))
    if count < 1:
        raise InputError(
            f"sample_time = {usual:g} s is longer than the record ({record.duration:g} s)"
        )
    return record.at(np.minimum(record.t[0] + usual * np.arange(count + 1), record.t[-1]))
