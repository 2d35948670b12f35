"""A preview: what was understood of a file, column by column, before anything is fitted."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.calibration import Scale
from ...core.errors import InputError
from .cells import LABELS, QUANTITIES, is_empty, is_stamp
from .clock import find_clock
from .dialect import Unsaid
from .doubts import Understood
from .force_table import ForceTable, TableArguments, table_of
from .raw import Doubt, RawTable, ReadingArguments
from .records import RecordArguments, loaded, record_parts
from .sources import is_source, naming, sources_of

if TYPE_CHECKING:
    from ...core.trajectory import Trajectory
    from ...plants.plant import Plant

__all__ = ["ColumnView", "Preview", "Previews", "look"]

LONG = 200
"""Rows from which on what holds less than a force table, and no clock, is probably a record."""
_TABLE_ONLY, _RECORD_ONLY = (*TableArguments.own(), "pivot"), RecordArguments.own()


@dataclass(frozen=True)
class ColumnView:
    """One column. header : in the file. meaning : quantity or variable; "" where it is left out.
    unit : in which it is read; low, high : in that unit (None without numbers). empty : cells.
    doubts : in words.
    """

    header: str
    meaning: str
    unit: str
    low: float | None
    high: float | None
    empty: int
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Preview:
    """What was understood of a source; ``print`` shows it.

    kind : "table" or "record". dialect, notes, doubts : in words. rows : of the source. result :
    the table, or the records, as they are read; None where they cannot yet, for which ``problem``
    says the reason and the remedy. call : Python that reads it so.

    Examples
    --------
    >>> seen = pam.fitting.look("DMSP-20-300_static.csv", rest_length=0.300)
    >>> seen.ok, seen.kind, seen.rows
    (True, 'table', 126)
    """

    source: str
    kind: str
    dialect: tuple[str, ...]
    rows: int
    columns: tuple[ColumnView, ...]
    clock: str
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    result: ForceTable | list[Trajectory] | None
    problem: str
    call: str

    @property
    def ok(self) -> bool:
        """Whether it can be read as it stands."""
        return not self.problem

    def to_dict(self) -> dict[str, Any]:
        """All but the numbers, for JSON."""
        found = {k: v for k, v in vars(self).items() if k not in ("result", "columns")}
        found["columns"] = [asdict(column) for column in self.columns]
        found["reads_as"] = self.reads_as
        return {k: list(v) if isinstance(v, tuple) else v for k, v in found.items()}

    @property
    def reads_as(self) -> str:
        """The result on one line."""
        if self.result is None:
            return ""
        if isinstance(self.result, ForceTable):
            return repr(self.result)
        sizes = [f"{len(r)} samples over {r.duration:.4g} s" for r in self.result[:3]]
        more = f", and {len(self.result) - 3} more" if len(self.result) > 3 else ""
        names = ", ".join(self.result[0].names)
        count = "a record" if len(self.result) == 1 else f"{len(self.result)} records"
        return f"{count} of {names}: {'; '.join(sizes)}{more}"

    def __str__(self) -> str:
        what = {"table": "a force table", "record": "a record in time"}[self.kind]
        lines = [f"{self.source}: " + (f"{what}, {self.rows} rows" if self.columns else "?")]
        if self.dialect:
            lines.append(f"  {', '.join(self.dialect)}")
        lines += ["", *_aligned(self.columns), ""] if self.columns else []
        for title, words in (
            ("clock", [self.clock] if self.clock else []),
            ("said", self.notes),
            ("doubt", self.doubts),
            ("reads as", [self.reads_as] if self.result is not None else []),
            ("NOT READ YET", [self.problem] if self.problem else []),
            ("call", [self.call] if self.ok else []),
        ):
            lines += [f"  {title}: {one}" for one in words]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def __repr__(self) -> str:
        state = self.reads_as if self.ok else f"not read yet: {self.problem}"
        return f"Preview({self.source}: {state})"


class Previews(tuple[Preview, ...]):
    """Previews of several sources."""

    @property
    def ok(self) -> bool:
        return all(p.ok for p in self)

    def _repr_html_(self) -> str:
        return "".join(p._repr_html_() for p in self)

    def __str__(self) -> str:
        return "\n\n".join(map(str, self))


def _aligned(columns: tuple[ColumnView, ...]) -> list[str]:
    rows = [("column", "is", "unit", "from", "to", "empty")]
    for c in columns:
        low, high = ("" if v is None else f"{v:.5g}" for v in (c.low, c.high))
        rows.append((repr(c.header), c.meaning or "-", c.unit, low, high, str(c.empty or "")))
    widths = [min(40, max(len(row[i]) for row in rows)) for i in range(6)]
    made = []
    for row in rows:
        left = "  ".join(f"{row[i]:<{widths[i]}}" for i in range(3))
        right = "  ".join(f"{row[i]:>{widths[i]}}" for i in range(3, 6))
        made.append(f"  {left}  {right}".rstrip())
    return made


def look(source: Any, plant: Plant | None = None, **options: Any) -> Preview | Previews:
    r"""What is understood of a file, before anything is fitted: ``print(look(path))``.

    source : as for :func:`read_table` and :func:`read_record`; a list, folder or pattern gives
        Previews. plant : whose variables name the columns of a record.
    options : those of :func:`read_table` or :func:`read_record`; ``kind="table"`` or "record" where
        it is taken for the other one.

    Raises InputError for a file that is damaged or none, or an option that cannot be meant; what
    must be said before it can be read is said in ``problem``.

    Examples
    --------
    >>> seen = pam.fitting.look("DMSP-20-300_static.csv", rest_length=0.300)
    >>> print("\n".join(str(seen).splitlines()[:2]))
    DMSP-20-300_static.csv: a force table, 126 rows
      cells between commas, names in line 1
    """
    if not is_source(source):
        return Previews(_look(one, plant, dict(options)) for one in sources_of(source))
    return _look(source, plant, dict(options))


def _look(source: Any, plant: Plant | None, options: dict[str, Any]) -> Preview:
    kind = options.pop("kind", None)
    if kind not in (None, "table", "record"):
        raise InputError(f"kind = {kind!r}: choose 'table' or 'record'")
    kind = kind or ("record" if plant is not None else None)
    for_table = {k: v for k, v in options.items() if k not in _RECORD_ONLY}
    for_record = {k: v for k, v in options.items() if k not in _TABLE_ONLY}
    general = {k: v for k, v in for_table.items() if k in for_record}
    if kind != "record" and "pivot" in options:
        general["pivot"] = options["pivot"]
    how = ReadingArguments.of(**general).how
    with naming(source), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            seen = Understood(loaded(source, how))
        except Unsaid as error:  # columns are not known before a keyword says more
            label = Path(source).name if isinstance(source, str | Path) else "source"
            nothing = Understood(RawTable(label, {}))
            return _preview(source, kind or "table", nothing, {}, None, (), str(error), options)
        kind = kind or _kind(seen.raw, options)
        if kind == "table":
            return _table(source, seen, TableArguments.of(**for_table), options)
        return _record(source, seen, plant, RecordArguments.of(**for_record), options)


def _kind(raw: RawTable, options: Mapping[str, Any]) -> str:
    """A record has a clock, and not all that a force table needs."""
    clocked = "time" in options or "sample_time" in options or find_clock(raw)[1] is not None
    if (not clocked and len(raw) < LONG) or any(k in options for k in _TABLE_ONLY):
        return "table"
    columns = options.get("columns")
    chosen = columns if isinstance(columns, Mapping) else {}
    found = set(chosen)
    for quantity, (_, names) in QUANTITIES.items():
        try:
            found |= {quantity} if raw.header(quantity, names, chosen) else set()
        except InputError:
            return "record"
    whole = {"pressure", "force"} <= found and found & {"length", "contraction"}
    return "table" if whole else "record"


# ---- tables --------------------------------------------------------------------------------------
def _table(
    source: Any, seen: Understood, words: TableArguments, options: dict[str, Any]
) -> Preview:
    problem, table = "", None
    try:
        table = table_of(seen.raw, words, seen)
    except InputError as error:
        problem = str(error)
    seen.meanings = seen.meanings or _named(seen.raw, words)
    for label, names in LABELS.items():
        header = seen.raw.header(label, names, words.columns)
        if header:
            seen.meanings[header] = (label, None)
    notes = table.notes if table else ()
    return _preview(source, "table", seen, QUANTITIES, table, notes, problem, options)


def _named(raw: RawTable, words: TableArguments) -> dict[str, tuple[str, Scale | None]]:
    """Which columns bear the name of a quantity, whatever their units say."""
    found: dict[str, tuple[str, Scale | None]] = {}
    for quantity, (_, names) in QUANTITIES.items():
        try:
            header = raw.header(quantity, names, words.columns)
        except InputError:
            continue
        if header is not None and header in raw.columns:
            found[header] = (quantity, None)
    return found


def _column(
    raw: RawTable, header: str, meaning: str, scale: Scale | None, known: Mapping[str, Any]
) -> ColumnView:
    """A column with its range and doubts."""
    empty = sum(is_empty(c) for c in raw.columns[header])
    said = raw.unit(header)
    if meaning in LABELS:
        words = list(dict.fromkeys(str(c) for c in raw.columns[header]))
        return ColumnView(header, meaning, ", ".join(words[:4]), None, None, empty)
    if any(is_stamp(c) for c in list(raw.columns[header])[:5]):
        return ColumnView(header, meaning, "dates or times", None, None, empty)
    try:
        values = raw.numbers(header)
    except InputError:
        return ColumnView(header, meaning, "text", None, None, empty)
    values = values[~np.isnan(values)]
    base = known[meaning][0] if meaning in known else None
    shown = said or ""
    if scale is not None:
        shown = scale.unit
        if scale.formula is not None:
            values = scale.si(values)
            shown = f"{base or 'SI'} by {scale.unit}"
    elif base is not None:
        shown = said or f"{base} (none named)"
    doubts = _saturated(header, values) if meaning and values.size >= 50 else []
    low, high = (float(values.min()), float(values.max())) if values.size else (None, None)
    return ColumnView(header, meaning, shown, low, high, empty, tuple(doubts))


def _saturated(header: str, values: Any) -> list[str]:
    from .ramps import floor_of

    top = floor_of(-values)
    if top is None or -top <= 0:
        return []
    count = int(np.sum(values == -top))
    return [f"{header!r} stands at its largest value, {-top:g}, in {count} rows: saturated?"]


# ---- records -------------------------------------------------------------------------------------
def _record(
    source: Any,
    seen: Understood,
    plant: Plant | None,
    words: RecordArguments,
    options: dict[str, Any],
) -> Preview:
    problem, records = "", None
    notes: Sequence[str] = ()
    try:
        records, notes = record_parts(seen.raw, plant, words, seen)
    except InputError as error:
        problem = str(error)
    known = {v.name: (v.unit,) for v in plant.variables} if plant is not None else {}
    return _preview(source, "record", seen, known, records, notes, problem, options, plant)


def _preview(
    source: Any,
    kind: str,
    seen: Understood,
    known: Mapping[str, Any],
    result: ForceTable | list[Trajectory] | None,
    notes: Sequence[str],
    problem: str,
    options: Mapping[str, Any],
    plant: Plant | None = None,
) -> Preview:
    """known : {quantity or variable: (SI unit, ...)}."""
    raw, named = seen.raw, isinstance(source, str | Path)
    columns = tuple(_column(raw, h, *seen.meanings.get(h, ("", None)), known) for h in raw.columns)
    told = notes or raw.notes
    several = isinstance(result, list) and len(result) > 1
    function = "read_table" if kind == "table" else "read_records" if several else "read_record"
    arguments = [
        repr(str(source)) if named else "source",
        *(["plant"] if plant is not None else []),
    ]
    arguments += [f"{k}={v!r}" for k, v in options.items() if v is not None]
    return Preview(
        source=str(source) if named else raw.label,
        kind=kind,
        dialect=raw.dialect,
        rows=len(raw),
        columns=columns,
        clock=seen.clock,
        notes=tuple(note for note in told if not isinstance(note, Doubt)),
        doubts=(
            *(note for note in told if isinstance(note, Doubt)),
            *(doubt for c in columns for doubt in c.doubts),
        ),
        result=result,
        problem=problem,
        call=f"pam.{function}({', '.join(arguments)})",
    )
