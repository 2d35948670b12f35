"""A folder of measurements in one call, and a table of what was read how."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import InputError, UnknownNameError
from ...core.files import require_local
from ...core.plausible import outside
from .force_table import ForceTable, joined_tables
from .preview import Preview, look
from .raw import ReadingWarning, glob_of, labels_of, require_pattern
from .sources import is_readable

if TYPE_CHECKING:
    import pandas as pd

    from ...core.trajectory import Trajectory
    from ...plants.plant import Plant

__all__ = ["FileRead", "FolderRead", "read_folder"]


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
        cells = [heads, *([str(row.get(h, "")) for h in heads] for row in rows)]
        widths = [max(len(line[i]) for line in cells) for i in range(len(heads))]
        lines = ["  ".join(f"{c:<{w}}" for c, w in zip(x, widths, strict=True)) for x in cells]
        lines = [line.rstrip() for line in lines]
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

    Raises
    ------
    InputError : a folder without such files, a pattern or an option that is invalid.

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
    try:
        labels = labels_of(path.name, pattern)
    except InputError as error:
        return FileRead(path, {}, None, str(error))
    more = {} if pattern is None else {"pattern": Path(pattern).name}
    try:
        view = look(path, plant, **options, **more)
    except InputError as error:
        return FileRead(path, labels, None, str(error))
    assert isinstance(view, Preview)
    return FileRead(path, labels, view, view.problem)
