"""Many simulations in a folder of Parquet files, one for each task: written once, read lazily.

A file says in its metadata from which cases and arguments it was made (a digest of both, and of all
code that they lead to), so that a run that was broken off goes on where it stood. Rows hold the
case's number, the time and all variables; the inputs between the samples are not kept.
"""

from __future__ import annotations

import json
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core import exceptions
from ..core.cases import Loop
from ..core.digest import Digest, built_with, digest_of, own_digest
from ..core.errors import InputError, PamError
from ..core.files import atomic_path, read_json, spelled, write_json
from ..core.progress import working
from ..core.shown import shown
from ..core.tasks import Task, split
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from .running import Case, Result, Simulation

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["StoredSimulations", "store"]

FORMAT = "pam_ocp simulations 1"
STUDY = "study.json"
FILES = "cases"
CHUNK = 100
"""Cases per file."""
BLOCK = 1000
"""Files per folder."""
MOST_DOUBTS = 5
"""That a warning names."""
SOURCES = "files of pam_ocp"
REMEDY = "give an empty folder, or one that simulate_many(into=...) wrote"


def store(
    run: Loop,
    cases: Iterable[Case],
    folder: Path,
    chunk: int | None,
    progress: Callable[[int, int | None], None] | None = None,
) -> StoredSimulations:
    """Run the cases that ``folder`` does not hold yet. See :func:`simulate_many`."""
    _arrow()
    work = run.work
    assert isinstance(work, Simulation)
    plant = work.plant
    told = digest_of([plant.__getstate__(), dict(work.common)])
    chunk = _opened(folder, told.text, chunk)
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
        for task in split(iter(cases), chunk):
            parts = task.index + 1
            held, found = _held(_part(folder, task.index)), _of_task(arguments, task)
            doubts.update(dict.fromkeys(found.doubts))
            if held is not None and held == found.text and not found.doubts:
                report(len(task.cases))
            else:
                yield task

    with working("simulations", run.count) as bar, closing(run(missing())) as ended:
        for task, content in ended:
            if isinstance(content, Exception):
                raise content
            path = _part(folder, task.index)
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                temporary.write_bytes(content)
            report(len(task.cases))
    _write_study(folder, told.text, chunk, parts)
    if doubts:
        warnings.warn(
            f"into = {spelled(folder)}: what cannot be told from something else was computed anew, "
            f"and will be again: {'; '.join([*doubts][:MOST_DOUBTS])}",
            stacklevel=4,
        )
    return StoredSimulations(folder)


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

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))
        _study(self.folder)

    @property
    def files(self) -> Path:
        """The folder that holds Parquet files alone."""
        return _within(self.folder)

    @property
    def parts(self) -> tuple[Path, ...]:
        """The files, in the order of their cases."""
        count = _study(self.folder)["parts"]
        if count is None:
            return tuple(sorted(_within(self.folder).rglob("part-*.parquet")))
        return tuple(_part(self.folder, i) for i in range(count))

    def __len__(self) -> int:
        return sum(_about(p)["count"] for p in self.parts)

    @property
    def failures(self) -> dict[int, Exception]:
        """The errors of cases without a simulation, by number; reads no simulation."""
        return {int(n): _revived(e) for p in self.parts for n, e in _about(p)["failures"].items()}

    @property
    def parameters(self) -> Iterator[tuple[int, dict[str, float]]]:
        """(number, the parameters that the case named), case by case."""
        for part in self.parts:
            about = _about(part)
            for offset, values in enumerate(about["parameters"]):
                yield about["first"] + offset, values

    def __iter__(self) -> Iterator[tuple[int, Result]]:
        for path in self.parts:
            table, about = _arrow().read_table(path), _about(path)
            columns = {n: table.column(n).to_numpy() for n in table.column_names}
            variables = [Variable(**v) for v in about["variables"]]
            for number in range(about["first"], about["first"] + about["count"]):
                if str(number) in about["failures"]:
                    yield number, _revived(about["failures"][str(number)])
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
        frames = [_arrow().read_table(p, columns=columns).to_pandas() for p in self.parts]
        filled = [f for f in frames if len(f)]
        return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()

    def __str__(self) -> str:
        failures = self.failures
        lines = [f"{len(self) - len(failures)} of {len(self)} simulations done, in {self.folder}"]
        return "\n".join([*lines, *(f"case {i}: {error}" for i, error in failures.items())])


# ---- the folder ---------------------------------------------------------------------------------
def _within(folder: Path) -> Path:
    """Where the Parquet files are: alone, as readers want them (once they lay beside the study)."""
    apart = folder / FILES
    return apart if apart.is_dir() else folder


def _part(folder: Path, index: int) -> Path:
    files = _within(folder)
    name = f"part-{index:06d}.parquet"
    return files / name if files == folder else files / f"block-{index // BLOCK:04d}" / name


def _study(folder: Path) -> dict[str, Any]:
    return read_json(folder / STUDY, "a folder of simulations", FORMAT, REMEDY)


def _opened(folder: Path, arguments: str, chunk: int | None) -> int:
    """Make the folder, or see that it holds this study; cases per file."""
    if not (folder / STUDY).exists():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            empty = not any(p for p in folder.iterdir() if not p.name.startswith("."))
        except OSError as error:
            raise InputError(f"into = {spelled(folder)}: {error.strerror}; {REMEDY}") from None
        if not empty:
            raise InputError(f"into = {spelled(folder)} holds other files; {REMEDY}")
        (folder / FILES).mkdir()
        _write_study(folder, arguments, chunk or CHUNK, None)
        return chunk or CHUNK
    study = _study(folder)
    other = _changed(study.get("program") or {}, _program())
    if other:
        raise InputError(
            f"into = {spelled(folder)} holds simulations of another program ({other}); give "
            "another folder, or delete this one"
        )
    if study["arguments"] != arguments:
        raise InputError(
            f"into = {spelled(folder)} holds simulations of another plant or with other arguments; "
            "give another folder, or delete this one"
        )
    chunk = chunk or int(study["chunk"])
    _write_study(folder, arguments, chunk, None)
    return chunk


def _write_study(folder: Path, arguments: str, chunk: int, parts: int | None) -> None:
    content = {"format": FORMAT, "arguments": arguments, "chunk": chunk, "parts": parts}
    write_json(folder / STUDY, {**content, "program": _program()})


# ---- one file -----------------------------------------------------------------------------------
def _arrow() -> Any:
    try:
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            "simulate_many(into=...) needs pyarrow: pip install pam_ocp[studies]"
        ) from None
    return pyarrow.parquet


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
        metadata = {b"pam_ocp": json.dumps(about).encode()}
        table = pa.Table.from_arrays(columns, names=list(data), metadata=metadata)
        content = pa.BufferOutputStream()
        _arrow().write_table(table, content)
        return bytes(content.getvalue())


def _stacked(columns: Sequence[Any]) -> Any:
    return np.concatenate([np.empty(0), *columns])


def _plain(parameters: Any) -> dict[str, float]:
    numbers = parameters if isinstance(parameters, Mapping) else {}
    return {str(n): float(v) for n, v in numbers.items() if isinstance(v, (int, float, np.number))}


def _about(path: Path) -> dict[str, Any]:
    """What a file says about itself. Raises InputError when it is none of ours."""
    try:
        about = json.loads(_arrow().read_schema(path).metadata[b"pam_ocp"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} cannot be read ({error}); delete it and run the same simulate_many again"
        ) from None
    return dict(about)


def _held(path: Path) -> str | None:
    """The digest of a whole file; None where there is none or it is damaged."""
    try:
        if not path.is_file():
            return None
        _arrow().read_table(path)  # a damaged page shows only when it is read
        return str(_about(path)["digest"])
    except (InputError, OSError, ValueError):
        return None


def _revived(error: Sequence[str]) -> Exception:
    kind, message = error
    known = getattr(exceptions, kind, None)
    if known in (InputError, exceptions.SimulationError):
        return known(message)  # type: ignore[no-any-return]
    return PamError(message if known is not None else f"{kind}: {message}")


# ---- digests ------------------------------------------------------------------------------------
def _of_task(arguments: str, task: Task) -> Digest:
    return digest_of([arguments, task.first, list(task.cases)])


def _program() -> dict[str, str]:
    """What computes: packages by version, pam_ocp by the content of its files, too."""
    return {**built_with("casadi", "numpy", "scipy"), SOURCES: own_digest()}


def _changed(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """In what a program differs from this one; empty where it does not."""
    return ", ".join(
        n if n == SOURCES else f"{n} {before.get(n, 'of an unknown version')}, not {now[n]}"
        for n in now
        if before.get(n) != now[n]
    )
