"""What was understood of a file, column by column, before anything is fitted; and of all files of a
folder in one call, with a table of what was read how.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.calibration import Scale
from ...core.errors import InputError, UnknownNameError
from ...core.files import require_local
from ...core.quantities import outside
from .cells import LABELS, QUANTITIES, is_empty, is_stamp
from .clock import find_clock
from .dialect import Unsaid
from .doubts import Understood
from .force_table import ForceTable, TableArguments, joined_tables, table_of
from .raw import (
    Doubt,
    RawTable,
    Reading,
    ReadingWarning,
    glob_of,
    labels_of,
    require_pattern,
)
from .records import RecordArguments, loaded, record_parts
from .sources import is_readable, is_source, naming, sources_of

if TYPE_CHECKING:
    import pandas as pd

    from ...core.trajectory import Trajectory
    from ...plants.plant import Plant

LONG = 200
"""Rows from which on what holds less than a force table, and no clock, is probably a record."""
WIDEST = 40
"""Cell of a text, below which the others are aligned."""
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
        cells = _aligned(_rows(self.columns), 3) if self.columns else []
        lines += ["", *(f"  {line}" for line in cells), ""] if cells else []
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


def _rows(columns: tuple[ColumnView, ...]) -> Sequence[Sequence[str]]:
    rows = [("column", "is", "unit", "from", "to", "empty")]
    for c in columns:
        low, high = ("" if v is None else f"{v:.5g}" for v in (c.low, c.high))
        rows.append((repr(c.header), c.meaning or "-", c.unit, low, high, str(c.empty or "")))
    return rows


def _aligned(rows: Sequence[Sequence[str]], numbers: int = 0) -> list[str]:
    """Cells below each other, the last so many of each row to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = "<" * (len(widths) - numbers) + ">" * numbers
    form = [f"{side}{min(w, WIDEST)}" for side, w in zip(sides, widths, strict=True)]
    return ["  ".join(map(format, row, form)).rstrip() for row in rows]


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
    how = Reading(**general)
    result: ForceTable | list[Trajectory] | None = None
    notes: Sequence[str] = ()
    problem = ""
    with naming(source), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            seen = Understood(loaded(source, how))
        except Unsaid as error:  # columns are not known before a keyword says more
            label = Path(source).name if isinstance(source, str | Path) else "source"
            nothing = Understood(RawTable(label, {}))
            return _preview(source, kind or "table", nothing, None, None, (), str(error), options)
        kind = kind or _kind(seen.raw, options)
        words: TableArguments | RecordArguments = (
            TableArguments(**for_table) if kind == "table" else RecordArguments(**for_record)
        )
        try:
            if isinstance(words, TableArguments):
                result = table_of(seen.raw, words, seen)
                notes = result.notes
            else:
                result, notes = record_parts(seen.raw, plant, words, seen)
        except InputError as error:
            problem = str(error)
        if kind == "table":
            _name_columns(seen, words.columns)
            plant = None
        return _preview(source, kind, seen, plant, result, notes, problem, options)


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


def _name_columns(seen: Understood, columns: Mapping[str, str]) -> None:
    """Which columns bear the name of a label, or (where none is known yet) of a quantity."""
    quantities = {q: names for q, (_, names) in QUANTITIES.items() if not seen.meanings}
    for meaning, names in (*quantities.items(), *LABELS.items()):
        with suppress(InputError):
            header = seen.raw.header(meaning, names, columns)
            if header:
                seen.meanings[header] = (meaning, None)


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


def _preview(
    source: Any,
    kind: str,
    seen: Understood,
    plant: Plant | None,
    result: ForceTable | list[Trajectory] | None,
    notes: Sequence[str],
    problem: str,
    options: Mapping[str, Any],
) -> Preview:
    known: Mapping[str, Any] = QUANTITIES if kind == "table" else {}
    if plant is not None:
        known = {v.name: (v.unit,) for v in plant.variables}
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


# ---- a folder in one call ------------------------------------------------------------------------
@dataclass(frozen=True)
class FileRead:
    """One file. labels : what its name says, as {"muscle": "M1", "contraction [%]": 5.0}. view :
    what was understood of it, with the result; None where it is no file of measurements, for which
    ``problem`` says the reason.
    """

    path: Path
    labels: dict[str, Any]
    view: Preview | None
    problem: str

    @property
    def result(self) -> ForceTable | list[Trajectory] | None:
        return None if self.view is None else self.view.result


class FolderRead(Sequence[FileRead]):
    """What was read of a folder; ``print`` shows a row for each file.

    Examples
    --------
    >>> _ = record.save("day1_run1.csv"), record.save("day1_run2.csv")
    >>> found = pam.read_folder(pattern="day1_run{run}.csv")
    >>> [(one.path.name, one.labels["run"]) for one in found]
    [('day1_run1.csv', '1'), ('day1_run2.csv', '2')]
    >>> len(found.records)
    2
    """

    def __init__(self, files: Sequence[FileRead]) -> None:
        self._files = tuple(files)

    def __getitem__(self, index: Any) -> Any:
        return FolderRead(self._files[index]) if isinstance(index, slice) else self._files[index]

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[FileRead]:
        return iter(self._files)

    @property
    def ok(self) -> bool:
        """Whether all files were read."""
        return not self.problems

    @property
    def problems(self) -> dict[str, str]:
        """{file: what must be said before it can be read}."""
        return {str(one.path): one.problem for one in self if one.problem}

    @property
    def records(self) -> list[Trajectory]:
        """All records in time, file after file."""
        return [r for one in self if isinstance(one.result, list) for r in one.result]

    @property
    def table(self) -> ForceTable:
        """All force tables as one. Raises InputError where there is none."""
        tables = [one.result for one in self if isinstance(one.result, ForceTable)]
        if not tables:
            raise InputError("no file of the folder was read as a force table; see problems")
        return joined_tables(tables)

    def by(self, label: str) -> dict[str, FolderRead]:
        """The files by a label of their names: ``found.by("muscle")["M1"].table``."""
        known = list(dict.fromkeys(name for one in self for name in one.labels))
        if label not in known:
            raise UnknownNameError("label of the files' names", label, known)
        values = dict.fromkeys(str(one.labels.get(label, "")) for one in self)
        return {
            v: FolderRead([one for one in self if str(one.labels.get(label, "")) == v])
            for v in values
        }

    def rows(self) -> list[dict[str, Any]]:
        """What was read how, a row for each file."""
        empty = {"kind": "", "rows": 0, "how": "", "columns": "", "said": ""}
        return [
            {
                "file": one.path.name,
                **one.labels,
                **(empty if one.view is None else _understood(one.view)),
                "problem": one.problem,
            }
            for one in self
        ]

    def to_pandas(self) -> pd.DataFrame:
        """:meth:`rows` as a DataFrame. Raises InputError where pandas is missing."""
        from ...core.foreign import frame

        rows = self.rows()
        heads = list(dict.fromkeys(name for row in rows for name in row))
        return frame([[row.get(h, "") for h in heads] for row in rows], heads, range(len(rows)), "")

    def __str__(self) -> str:
        rows = [
            {k: v for k, v in row.items() if k not in ("columns", "said", "problem")}
            for row in self.rows()
        ]
        heads = list(dict.fromkeys(name for row in rows for name in row))
        lines = _aligned([heads, *([str(row.get(h, "")) for h in heads] for row in rows)])
        for row in self.rows():
            lines += [f"{row['file']}: {row['said']}"] if row["said"] else []
            lines += [f"{row['file']} NOT READ: {row['problem']}"] if row["problem"] else []
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"FolderRead({len(self)} files, {len(self.problems)} not read)"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def _understood(view: Preview) -> dict[str, Any]:
    used = (f"{c.meaning}={c.header!r}" for c in view.columns if c.meaning)
    return {
        "kind": view.kind,
        "rows": view.rows,
        "how": ", ".join(view.dialect),
        "columns": ", ".join(used),
        "said": "; ".join((*view.notes, *(f"doubt: {d}" for d in view.doubts))),
    }


def read_folder(
    folder: str | Path = ".", plant: Plant | None = None, *, pattern: str = "*", **options: Any
) -> FolderRead:
    """Read all files of a folder, each as a force table or as a record; a file that cannot be read
    stands in :attr:`FolderRead.problems` with the sentence that helps, and in a ReadingWarning.

    Parameters
    ----------
    folder : where they are.
    plant : whose variables name the columns of records.
    pattern : which files, and what their names say: ``"*.csv"``, or with headers in braces
        ``"{muscle}_{contraction [%]}pct_run{run}.csv"``, which become columns of one value (see
        ``constants`` of :func:`read_table`) and labels for :meth:`FolderRead.by`. Folders may be
        part of it; braces stand in the name only.
    options : of :func:`read_table` or :func:`read_record`, for all files; ``kind="table"`` or
        "record" where they are taken for the other one.

    Raises InputError (a folder without such files, a pattern or an option that is invalid).

    Examples
    --------
    >>> _ = record.save("day1_run1.csv"), record.save("day1_run2.csv")
    >>> pam.read_folder(pattern="day1_run{run}.csv")
    FolderRead(2 files, 0 not read)
    """
    require_local(folder)
    require_pattern(pattern)
    base = Path(folder)
    if not base.is_dir():
        raise InputError(
            f"folder = {str(folder)!r} is no folder; give the one that holds the files"
        )
    named = "{" in pattern
    if "{" in str(Path(pattern).parent):
        raise InputError(f"pattern = {pattern!r}: braces stand in the file's name, not in folders")
    if Path(pattern).is_absolute():
        raise InputError(f"pattern = {pattern!r}: give it relative to folder={str(folder)!r}")
    paths = sorted(p for p in base.glob(glob_of(pattern)) if _wanted(p, pattern))
    if not paths:
        raise InputError(f"no file of {str(base)!r} that can be read fits pattern = {pattern!r}")
    files = [_file(path, plant, pattern if named else None, options) for path in paths]
    found = FolderRead(files)
    if found.problems:
        first, sentence = next(iter(found.problems.items()))
        warnings.warn(
            f"{len(found.problems)} of {len(found)} files not read; {Path(first).name}: {sentence}",
            ReadingWarning,
            stacklevel=outside(),
        )
    return found


def _wanted(path: Path, pattern: str) -> bool:
    """Files by their ending; of any ending where the pattern names it."""
    if path.name.startswith("."):
        return False
    named = Path(pattern).suffix and "*" not in Path(pattern).suffix
    return is_readable(path) or (bool(named) and path.is_file())


def _file(
    path: Path, plant: Plant | None, pattern: str | None, options: dict[str, Any]
) -> FileRead:
    labels: dict[str, Any] = {}
    try:
        labels = labels_of(path.name, pattern)
        more = {} if pattern is None else {"pattern": Path(pattern).name}
        view = look(path, plant, **options, **more)
    except InputError as error:
        return FileRead(path, labels, None, str(error))
    assert isinstance(view, Preview)
    return FileRead(path, labels, view, view.problem)
