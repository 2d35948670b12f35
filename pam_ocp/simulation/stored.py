"""Many simulations in a folder of Parquet files, one for each task: written once, read lazily.

A file says in its metadata from which cases and arguments it was made (a digest of both, and of all
code that they lead to), so that a run that was broken off goes on where it stood. Rows hold the
case's number, the time and all variables; the inputs between the samples are not kept.
"""

from __future__ import annotations

import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.cases import Loop
from ..core.digest import Digest, digest_of
from ..core.errors import InputError
from ..core.progress import working
from ..core.shown import shown
from ..core.stores import Folder, folder_of, write_bytes
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..core.workers import Task, split
from .folder import (
    about_file,
    arrow,
    digest_held,
    files_of,
    metadata,
    opened_folder,
    part_of,
    read_table,
    revived,
    said,
    study_of,
    write_study,
)
from .running import Case, Result, Simulation

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["StoredSimulations", "store", "warn_of_doubts"]

FORMAT = "pam_ocp simulations 1"
CHUNK = 100
"""Cases per file."""
MOST_DOUBTS = 5
"""That a warning names."""


def store(
    run: Loop,
    cases: Iterable[Case],
    folder: Folder,
    chunk: int | None,
    progress: Callable[[int, int | None], None] | None = None,
) -> StoredSimulations:
    """Run the cases that ``folder`` does not hold yet. See :func:`simulate_many`."""
    arrow()
    work = run.work
    assert isinstance(work, Simulation)
    plant = work.plant
    told = digest_of([plant.__getstate__(), dict(work.common)])
    # what cannot be told from something else is as no other
    arguments = f"{told.text} {uuid.uuid4().hex}" if told.doubts else told.text
    columns = [v.name for v in (*plant.states, *plant.inputs, *plant.outputs)]
    run = replace(run, finish=_Encoded(arguments, columns))
    parts = done = 0
    doubts = dict.fromkeys(told.doubts)

    def report(more: int) -> None:
        nonlocal done
        done += more
        bar.step(more)
        if progress is not None:
            progress(done, run.count)

    def missing() -> Iterator[Task]:
        nonlocal parts
        for task in split(iter(cases), size):
            parts = task.index + 1
            held, found = digest_held(part_of(folder, task.index)), _of_task(arguments, task)
            doubts.update(dict.fromkeys(found.doubts))
            if held is not None and held == found.text and not found.doubts:
                report(len(task.cases))
            else:
                yield task

    with (
        opened_folder(folder, FORMAT, told.text, chunk, CHUNK) as size,
        working("simulations", run.count) as bar,
        closing(run(missing())) as ended,
    ):
        for task, content in ended:
            if isinstance(content, Exception):
                raise content
            write_bytes(part_of(folder, task.index), content)
            report(len(task.cases))
        write_study(folder, FORMAT, told.text, size, parts)
    warn_of_doubts(folder, doubts)
    return StoredSimulations(folder)


def warn_of_doubts(folder: Folder, doubts: Iterable[str]) -> None:
    """Say what was computed anew since it cannot be told from something else."""
    named = [*doubts][:MOST_DOUBTS]
    if named:
        warnings.warn(
            f"into = {said(folder)}: what cannot be told from something else was computed anew, "
            f"and will be again: {'; '.join(named)}",
            stacklevel=5,
        )


@shown
@dataclass(frozen=True)
class StoredSimulations:
    """Simulations in a folder, read part by part: memory holds one file at a time.

    Iteration gives (number of the case, Trajectory | error) in the order of the cases. Failures
    that are read back have the class and the sentence of the error, not what else it held.
    A run that was broken off can be read too: what is there.

    ``files`` is what others read: ``pandas.read_parquet``, ``polars.scan_parquet`` and
    ``dask.dataframe.read_parquet`` take that folder as one table of case, time and all variables.
    """

    folder: Folder

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", folder_of("folder", self.folder))
        study_of(self.folder, FORMAT)

    @property
    def files(self) -> Folder:
        """The folder that holds Parquet files alone."""
        return files_of(self.folder)

    @property
    def parts(self) -> tuple[Folder, ...]:
        """The files, in the order of their cases."""
        count = study_of(self.folder, FORMAT)["parts"]
        if count is None:
            return tuple(sorted(files_of(self.folder).rglob("part-*.parquet"), key=str))
        return tuple(part_of(self.folder, i) for i in range(count))

    def __len__(self) -> int:
        return sum(about_file(p)["count"] for p in self.parts)

    @property
    def failures(self) -> dict[int, Exception]:
        """The errors of cases without a simulation, by number; reads no simulation."""
        return {
            int(n): revived(e) for p in self.parts for n, e in about_file(p)["failures"].items()
        }

    @property
    def parameters(self) -> Iterator[tuple[int, dict[str, float]]]:
        """(number, the parameters that the case named), case by case."""
        for part in self.parts:
            about = about_file(part)
            for offset, values in enumerate(about["parameters"]):
                yield about["first"] + offset, values

    def __iter__(self) -> Iterator[tuple[int, Result]]:
        for path in self.parts:
            table, about = read_table(path), about_file(path)
            columns = {n: table.column(n).to_numpy() for n in table.column_names}
            variables = [Variable(**v) for v in about["variables"]]
            for number in range(about["first"], about["first"] + about["count"]):
                if str(number) in about["failures"]:
                    yield number, revived(about["failures"][str(number)])
                    continue
                rows = slice(*np.searchsorted(columns["case"], [number, number + 1]))
                data = {v.name: columns[v.name][rows] for v in variables}
                yield (
                    number,
                    Trajectory(columns["time"][rows], data, variables, about["interpolation"]),
                )

    def frame(self, names: Sequence[str] | None = None) -> pd.DataFrame:
        """All simulations as one DataFrame: case, time [s], and the variables named (all).

        This does hold everything in memory; name few variables of a large study.
        """
        try:
            import pandas as pd
        except ImportError:
            raise InputError("frame needs pandas: pip install pam_ocp[studies]") from None
        columns = None if names is None else ["case", "time", *names]
        frames = [read_table(p, columns).to_pandas() for p in self.parts]
        filled = [f for f in frames if len(f)]
        return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()

    def __str__(self) -> str:
        failures = self.failures
        lines = [f"{len(self) - len(failures)} of {len(self)} simulations done, in {self.folder}"]
        return "\n".join([*lines, *(f"case {i}: {error}" for i, error in failures.items())])


# ---- one file -----------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Encoded:
    """Makes a file of a task's results, in the worker: what travels is small, and only written.

    columns : names of a simulation's variables, which a file without any has too.
    """

    arguments: str
    columns: Sequence[str]

    def __call__(self, task: Task, results: Sequence[Result]) -> bytes:
        import pyarrow as pa

        done = [(task.first + i, r) for i, r in enumerate(results) if isinstance(r, Trajectory)]
        lengths = [len(t.t) for _, t in done]
        data = {"case": np.repeat(np.array([i for i, _ in done], dtype=np.int64), lengths)}
        data["time"] = _stacked([t.t for _, t in done])
        data |= {n: _stacked([t[n] for _, t in done]) for n in self.columns}
        about = {
            "digest": _of_task(self.arguments, task).text,
            "first": task.first,
            "count": len(task.cases),
            "failures": {
                str(task.first + i): [type(r).__name__, str(r)]
                for i, r in enumerate(results)
                if isinstance(r, Exception)
            },
            "parameters": [_plain(case.get("parameters")) for case in task.cases],
            "variables": [asdict(v) for v in done[0][1].variables] if done else [],
            "interpolation": done[0][1].interpolation if done else "previous",
        }
        # pa.table(data) would load pandas, in each worker anew: as much as a dozen simulations
        columns = [
            pa.Array.from_buffers(pa.from_numpy_dtype(c.dtype), len(c), [None, pa.py_buffer(c)])
            for c in data.values()
        ]
        table = pa.Table.from_arrays(columns, names=list(data), metadata=metadata(about))
        content = pa.BufferOutputStream()
        arrow().write_table(table, content)
        return bytes(content.getvalue())


def _stacked(columns: Sequence[Any]) -> Any:
    return np.concatenate([np.empty(0), *columns])


def _plain(parameters: Any) -> dict[str, float]:
    numbers = parameters if isinstance(parameters, Mapping) else {}
    return {str(n): float(v) for n, v in numbers.items() if isinstance(v, (int, float, np.number))}


def _of_task(arguments: str, task: Task) -> Digest:
    return digest_of([arguments, task.first, list(task.cases)])
