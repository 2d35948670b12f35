"""Many simulations of which numbers are kept: a row a case, in memory or in Parquet files.

Batches of cases go to workers; what comes back is taken in the order of the cases, so that rows,
statistics and the place of an early stop are the same bits however many workers there are, and
however often the run was broken off.
"""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.cases import Loop
from ..core.digest import digest_of
from ..core.errors import InputError, UnknownNameError, require_positive
from ..core.progress import Bar, working
from ..core.shown import shown
from ..core.stores import Folder, Store, folder_of, write_bytes
from ..core.workers import Task
from .batches import BATCH, Batch, Case, Numbers, Rows, batches
from .reducers import Reduction
from .statistics import SobolCases, SobolIndices, Statistic
from .stored import (
    about_file,
    arrow,
    digest_held,
    file_of,
    files_of,
    frame_of,
    opened_folder,
    pandas,
    part_of,
    parts_of,
    read_table,
    revived,
    study_of,
    warn_of_doubts,
    write_study,
)

if TYPE_CHECKING:
    import pandas as pd

Array: TypeAlias = NDArray[np.float64]

FORMAT = "pam_ocp kept numbers 1"
ROWS = 100_000
"""Of a file."""
LEAST = 100
"""Cases before a mean's interval is believed."""


@shown
@dataclass(frozen=True, eq=False)
class KeptNumbers:
    """Numbers of many simulations, a row a case; ``numbers["x_end"]`` is one of them for all cases.

    A case that failed, and a number that is not there (a level that is never crossed), is NaN.

    Examples
    --------
    >>> cases = pam.simulation.sweep(mass=[5.0, 10.0])
    >>> many = pam.simulate_many(plant, cases, keep={"low": "min(x)"}, duration=0.1)
    >>> many.names, len(many["low"]), many["mass"].tolist()
    (('low',), 2, [5.0, 10.0])
    """

    names: tuple[str, ...]
    count: int
    """Cases."""
    statistics: Mapping[str, Statistic] = field(repr=False)
    """{name: mean, spread, quantiles}"""
    stopped: bool = False
    """Whether all intervals asked for were reached before the last case."""
    folder: Folder | None = None
    rows: Mapping[str, Array] | None = field(default=None, repr=False)
    """{column: (cases,)} in memory: parameters that the cases name, and the numbers. None where
    they are in a folder, or were not to be kept."""
    errors: Mapping[int, Exception] = field(default_factory=dict, repr=False)
    cases: SobolCases | None = field(default=None, repr=False)

    @classmethod
    def read(cls, folder: Store) -> KeptNumbers:
        """What ``simulate_many(keep=..., into=folder)`` wrote. Raises InputError.

        Examples
        --------
        >>> cases = pam.simulation.sweep(mass=[5.0, 10.0])
        >>> said = {"keep": {"x_end": "x.final"}, "duration": 0.1}
        >>> many = pam.simulate_many(plant, cases, into="numbers", **said)
        >>> len(pam.simulation.KeptNumbers.read("numbers"))
        2
        """
        place = folder_of("folder", folder)
        content = study_of(place, FORMAT)
        names, found = tuple(content["names"]), _Taken(content["names"], False)
        for part in parts_of(place, FORMAT):
            table = read_table(part, list(names))
            columns = {n: table.column(n).to_numpy() for n in names}
            for _ in found.count_all(columns):
                pass
        found.settle()
        return cls(names, found.count, found.statistics, bool(content.get("stopped")), place)

    @property
    def files(self) -> Folder | None:
        """The folder that holds Parquet files alone, one table of case, parameters and numbers."""
        return None if self.folder is None else files_of(self.folder)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, name: str) -> Array:
        """(cases,) of a number or of a parameter that the cases name."""
        if self.rows is not None and name in self.rows:
            return self.rows[name]
        if self.folder is None:
            if name in self.names:
                raise InputError(
                    f"{name!r} was not kept (rows=False): ask .statistics, or keep rows"
                )
            raise UnknownNameError("number that is kept", name, self.rows or self.names)
        parts = []
        for part in parts_of(self.folder, FORMAT):
            known = [n for n in about_file(part)["columns"] if n not in ("case", "error")]
            if name not in known:
                raise UnknownNameError("number that is kept", name, known)
            parts.append(read_table(part, [name]).column(name).to_numpy())
        return np.concatenate([np.empty(0), *parts])

    @property
    def failures(self) -> Mapping[int, Exception]:
        """The errors of the cases that failed, by number."""
        if self.folder is None:
            return self.errors
        failed: dict[int, Exception] = {}
        for part in parts_of(self.folder, FORMAT):
            if about_file(part)["failed"]:
                table = read_table(part, ["case", "error"])
                pairs = zip(
                    table.column("case").to_pylist(), table.column("error").to_pylist(), strict=True
                )
                failed |= {i: revived(e.split(": ", 1)) for i, e in pairs if e is not None}
        return failed

    def sobol(self, name: str) -> SobolIndices:
        """Sobol indices of a number, by SALib: the cases were a ``SobolCases``."""
        if self.cases is None:
            raise InputError("Sobol indices need the cases of pam.simulation.SobolCases(...)")
        return self.cases.indices(self[name])

    def frame(self) -> pd.DataFrame:
        """All rows as a DataFrame: case, parameters, numbers (and errors, from a folder)."""
        if self.folder is not None:
            return frame_of(parts_of(self.folder, FORMAT))
        found: pd.DataFrame = pandas().DataFrame(
            {"case": np.arange(self.count), **(self.rows or {})}
        )
        return found

    def __str__(self) -> str:
        where = "" if self.folder is None else f", in {self.folder}"
        failed = len(self.failures)
        lines = [f"{self.count - failed} of {self.count} simulations done{where}"]
        lines += [f"{name}: {found}" for name, found in self.statistics.items()]
        return "\n".join(lines)


# ---- the run -------------------------------------------------------------------------------------
def keep_numbers(
    run: Loop,
    cases: Iterable[Case],
    folder: Folder | None,
    chunk: int | None,
    progress: Callable[[int, int | None], None] | None,
    rows: bool,
    until: Mapping[str, float],
    drawn: SobolCases | None,
) -> KeptNumbers:
    """Run the cases and keep their numbers. See :func:`simulate_many`."""
    work = run.work
    assert isinstance(work, Numbers)
    for name, width in until.items():
        if name not in work.keep:
            raise UnknownNameError("name in until (a number that is kept)", name, work.keep)
        until = {**until, name: require_positive(f"until[{name!r}]", width)}
    simulation = work.simulation
    told = digest_of(
        [simulation.plant.__getstate__(), dict(simulation.common), _said_of(work), dict(until)]
    )
    here = folder is None  # else they are read from there, those of earlier runs too
    taken = _Taken(list(work.keep), here and rows, here and drawn is not None)
    if folder is not None:
        arrow()
    place = (
        nullcontext(chunk or ROWS)
        if folder is None
        else opened_folder(folder, FORMAT, told.text, chunk, ROWS)
    )
    with place as size, working("simulations", run.count) as bar:
        known = f"{told.text} {uuid.uuid4().hex}" if told.doubts else told.text
        going = _Going(run, folder, known, size, taken, until, progress, bar)
        going(cases)
        taken.settle()
        if folder is not None:
            more = {"names": list(work.keep), "stopped": going.stopped}
            write_study(folder, FORMAT, told.text, size, going.parts, **more)
    if folder is not None:
        warn_of_doubts(folder, dict.fromkeys([*told.doubts, *going.doubts]))
    return KeptNumbers(
        tuple(work.keep),
        taken.count,
        taken.statistics,
        going.stopped,
        folder,
        taken.rows,
        taken.errors,
        drawn,
    )


def _said_of(work: Numbers) -> list[tuple[str, Any]]:
    """What is kept, for a digest."""
    return [(n, k.text if isinstance(k, Reduction) else k) for n, k in work.keep.items()]


class _Taken:
    """What was taken in so far, in the order of the cases."""

    def __init__(self, names: Sequence[str], keeps: bool, drawn: bool = False) -> None:
        self.statistics = {n: Statistic() for n in names}
        self.count = 0
        self.errors: dict[int, Exception] = {}
        self._keeps, self._drawn = keeps, drawn
        self._columns: dict[str, list[tuple[int, Array]]] = {}
        self._waiting: dict[str, list[Array]] = {n: [] for n in names}

    def count_in(self, numbers: Mapping[str, Array]) -> None:
        """Into the statistics, ``BATCH`` at a time, so that parts of any length give the same bits.

        The numbers go to the next multiple of it at most.
        """
        for name, waiting in self._waiting.items():
            waiting.append(numbers[name])
        self.count += len(next(iter(numbers.values())))
        if self.count % BATCH == 0:
            self.settle()

    def count_all(self, columns: Mapping[str, Array]) -> Iterator[None]:
        """Any number of them; stops after each time that the statistics are up to date."""
        begin, end = 0, len(next(iter(columns.values())))
        while begin < end:
            more = BATCH - self.count % BATCH
            self.count_in({n: c[begin : begin + more] for n, c in columns.items()})
            begin += more
            yield

    def settle(self) -> None:
        """Take into the statistics what waits."""
        for name, waiting in self._waiting.items():
            if waiting:
                self.statistics[name].add(np.concatenate(waiting))
                waiting.clear()

    def take(self, rows: Rows) -> None:
        """Into statistics and memory."""
        first = self.count
        self.count_in(rows.numbers)
        if self._keeps:
            self.errors |= {first + i: e for i, e in rows.errors.items()}
        kept = {**rows.batch.parameters, **rows.numbers} if self._keeps else rows.numbers
        for name, column in kept.items() if self._keeps or self._drawn else ():
            self._columns.setdefault(name, []).append((first, column))

    @property
    def rows(self) -> dict[str, Array] | None:
        """The columns; NaN where a case does not name a parameter."""
        if not self._columns:
            return None
        found = {}
        for name, parts in self._columns.items():
            found[name] = np.full(self.count, np.nan)
            for first, column in parts:
                found[name][first : first + len(column)] = column
        return found


@dataclass
class _Waiting:
    """A batch on its way (rows is None till it is back), a part that a folder holds, or the end of
    a part that is to be written.
    """

    rows: Rows | None = None
    held: Sequence[Batch] = ()
    index: int | None = None


class _Going:
    """A run on its way."""

    def __init__(
        self,
        run: Loop,
        folder: Folder | None,
        arguments: str,
        size: int,
        taken: _Taken,
        until: Mapping[str, float],
        progress: Callable[[int, int | None], None] | None,
        bar: Bar,
    ) -> None:
        self.run, self.folder, self.arguments, self.size = run, folder, arguments, size
        self.taken, self.until, self.progress, self.bar = taken, until, progress, bar
        self.stopped, self.parts = False, 0
        self.doubts: dict[str, None] = {}
        self._order: deque[_Waiting] = deque()
        self._asked: dict[int, _Waiting] = {}
        self._written: list[Rows] = []

    def __call__(self, cases: Iterable[Case]) -> None:
        """Until the last case, or until all intervals are reached."""
        with closing(self.run(self._tasks(iter(cases)))) as ended:
            for task, answer in ended:
                entry = self._asked.pop(task.index)
                entry.rows = self._sound(task.cases[0], answer)
                self._take()
                if self.stopped:
                    break
        if not self.stopped:
            self._take()
        if self.stopped and self._written:
            self._write(self.parts)

    def _tasks(self, cases: Iterator[Case]) -> Iterator[Task]:
        """The batches that are not there yet."""
        number = first = 0
        for index in range(10**9):
            part = batches(islice(cases, self.size), first)
            try:
                part = chain([next(part)], part)
            except StopIteration:
                return
            if self.folder is not None and part_of(self.folder, index).is_file():
                known = list(part)
                part = iter(known)
                if self._holds(index, known):
                    first += sum(map(len, known))
                    self._order.append(_Waiting(held=known, index=index))
                    self._take()
                    if self.stopped:
                        return
                    continue
            for batch in part:
                entry = self._asked[number] = _Waiting()
                self._order.append(entry)
                yield Task(number, number, (batch,))
                number, first = number + 1, first + len(batch)
            self._order.append(_Waiting(index=index))

    def _holds(self, index: int, known: Sequence[Batch]) -> bool:
        """Whether the folder has this part; an early stop may have cut it."""
        assert self.folder is not None
        path = part_of(self.folder, index)
        there = digest_held(path)
        if there is None:
            return False
        count, own = about_file(path)["count"], []
        for batch in known:
            if count > 0:
                own.append(batch)
            count -= len(batch)
        return self._digest(own if self.until else known) == there

    def _digest(self, known: Sequence[Batch]) -> str:
        found = digest_of([self.arguments, [b.told() for b in known]])
        self.doubts.update(dict.fromkeys(found.doubts))
        return f"{found.text} {uuid.uuid4().hex}" if found.doubts else found.text

    def _sound(self, batch: Batch, answer: Any) -> Rows:
        """The rows of a batch; where it took its workers with it, of each case alone."""
        found = answer if isinstance(answer, Exception) else answer[0]
        if isinstance(found, Rows):
            return found
        nothing = {n: np.full(1, np.nan) for n in self.taken.statistics}
        if len(batch) == 1:
            return Rows(batch, nothing, {0: found})
        singles = [Task(i, batch.first + i, (b,)) for i, b in enumerate(batch.singles())]
        rows: dict[int, Rows] = {}
        for task, single in self.run(iter(singles)):
            rows[task.index] = self._sound(task.cases[0], single)
        numbers = {
            n: np.concatenate([rows[i].numbers[n] for i in range(len(batch))]) for n in nothing
        }
        return Rows(batch, numbers, {i: r.errors[0] for i, r in rows.items() if r.errors})

    # ---- in the order of the cases ---------------------------------------------------------------
    def _take(self) -> None:
        while self._order and not self.stopped:
            entry = self._order[0]
            if entry.rows is None and entry.index is None:
                return
            self._order.popleft()
            if entry.rows is not None:
                self._took(entry.rows)
            elif entry.held:
                self._took_held(entry)
            elif entry.index is not None:
                self._write(entry.index)

    def _took(self, rows: Rows) -> None:
        self.taken.take(rows)
        if self.folder is not None:
            self._written.append(rows)
        self._tell(len(rows.batch))
        self._look()

    def _took_held(self, entry: _Waiting) -> None:
        assert self.folder is not None
        assert entry.index is not None
        table = read_table(part_of(self.folder, entry.index), list(self.taken.statistics))
        columns = {n: table.column(n).to_numpy() for n in self.taken.statistics}
        for _ in self.taken.count_all(columns):
            self._look()
        self.parts = entry.index + 1
        self._tell(len(table))

    def _look(self) -> None:
        """Whether all intervals are as narrow as asked for."""
        if self.until and self.taken.count >= LEAST and self.taken.count % BATCH == 0:
            found = self.taken.statistics
            self.stopped = all(found[n].half_width <= w for n, w in self.until.items())

    def _tell(self, more: int) -> None:
        self.bar.step(more)
        if self.progress is not None:
            self.progress(self.taken.count, self.run.count)

    def _write(self, index: int) -> None:
        if self.folder is not None:
            rows, self._written = self._written, []
            digest = self._digest([r.batch for r in rows])
            write_bytes(part_of(self.folder, index), _file(rows, digest))
        self.parts = index + 1


def _file(parts: Sequence[Rows], digest: str) -> bytes:
    """Rows as a Parquet file."""
    count = sum(len(r.batch) for r in parts)
    first = parts[0].batch.first
    taken = _Taken(list(parts[0].numbers), True)
    for rows in parts:
        taken.take(rows)
    columns: dict[str, Any] = {"case": np.arange(first, first + count)}
    columns |= taken.rows or {}
    told: list[str | None] = [None] * count
    for i, error in taken.errors.items():
        told[i] = f"{type(error).__name__}: {error}"
    about = {"digest": digest, "first": first, "count": count, "failed": len(taken.errors)}
    about["columns"] = [*columns, "error"]
    return file_of(
        columns,
        about,
        {"error": told},
        compression="zstd",
        use_dictionary=[n for n in columns if n != "case"],
        column_encoding={"case": "DELTA_BINARY_PACKED"},
    )
