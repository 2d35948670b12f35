"""Many simulations in a folder of Parquet files, one for each task: written once, read lazily.

A file says in its metadata from which cases and arguments it was made (a digest of both, and of all
code that they lead to), so that a run that was broken off goes on where it stood. Rows hold the
case's number, the time and all variables; the inputs between the samples are not kept. The folder
may be one of this machine or in an object store.
"""

from __future__ import annotations

import json
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core import exceptions
from ..core.atomic import in_use
from ..core.cases import Loop
from ..core.digest import Digest, built_with, digest_of, own_digest
from ..core.errors import InputError, PamError, WriteError
from ..core.files import json_of, read_json, reading, require_format, spelled, write_json
from ..core.progress import working
from ..core.shown import shown
from ..core.stores import Folder, Remote, folder_of, opened, write_bytes
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..core.workers import Task, split
from .batches import Case, Result, Simulation

if TYPE_CHECKING:
    import pandas as pd

FORMAT = "pam_ocp simulations 1"
CHUNK, FILES_OF_FEW, LEAST = 100, 24, 10
"""Cases per file; of few cases so many files, so that workers end at about the same time, but not
of fewer cases than this."""
MOST_DOUBTS = 5
"""That a warning names."""
STUDY = "study.json"
FILES = "cases"
BLOCK = 1000
"""Files per folder."""
SOURCES = "files of pam_ocp"
REMEDY = "give an empty folder, or one that simulate_many(into=...) wrote"


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

    few = CHUNK if run.count is None else max(LEAST, run.count // FILES_OF_FEW)
    with (
        opened_folder(folder, FORMAT, told.text, chunk, min(CHUNK, few)) as size,
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
        return parts_of(self.folder, FORMAT)

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
        return frame_of(self.parts, None if names is None else ["case", "time", *names])

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
        return file_of(data, about)


def _stacked(columns: Sequence[Any]) -> Any:
    return np.concatenate([np.empty(0), *columns])


def _plain(parameters: Any) -> dict[str, float]:
    numbers = parameters if isinstance(parameters, Mapping) else {}
    return {str(n): float(v) for n, v in numbers.items() if isinstance(v, (int, float, np.number))}


def _of_task(arguments: str, task: Task) -> Digest:
    return digest_of([arguments, task.first, list(task.cases)])


# ---- the folder ----------------------------------------------------------------------------------
def files_of(folder: Folder) -> Folder:
    """Where the Parquet files are: alone, as readers want them (once they lay beside the study)."""
    apart = folder / FILES
    return apart if isinstance(apart, Remote) or apart.is_dir() else folder


def part_of(folder: Folder, index: int) -> Folder:
    """The file of a part."""
    files = files_of(folder)
    name = f"part-{index:06d}.parquet"
    return files / name if files == folder else files / f"block-{index // BLOCK:04d}" / name


def parts_of(folder: Folder, form: str) -> tuple[Folder, ...]:
    """The files, in the order of their cases; of a run that was broken off, those there are."""
    count = study_of(folder, form)["parts"]
    if count is None:
        return tuple(sorted(files_of(folder).rglob("part-*.parquet"), key=str))
    return tuple(part_of(folder, i) for i in range(count))


def study_of(folder: Folder, form: str) -> dict[str, Any]:
    """What study.json says. Raises InputError where it is none of this form."""
    path, kind = folder / STUDY, "a folder of simulations"
    if isinstance(path, Path):
        return read_json(path, kind, form, REMEDY)
    with reading(str(path), kind, REMEDY):
        content = json_of(path.read_bytes())
    return require_format(str(path), content, kind, form, REMEDY)


def said(folder: Folder) -> str:
    """For a message."""
    return spelled(folder) if isinstance(folder, Path) else str(folder)


@contextmanager
def opened_folder(
    folder: Folder, form: str, arguments: str, chunk: int | None, usual: int
) -> Iterator[int]:
    """Make the folder, or see that it holds this study: cases per file (None: as before).

    While it is open no other process of this machine may work on it. Raises InputError.
    """
    if not (folder / STUDY).exists():
        _made(folder)
    with in_use(folder) if isinstance(folder, Path) else nullcontext():
        if not (folder / STUDY).exists():
            write_study(folder, form, arguments, chunk or usual, None)
            yield chunk or usual
            return
        content = study_of(folder, form)
        other = _changed(content.get("program") or {}, _program())
        if other:
            raise InputError(
                f"into = {said(folder)} holds simulations of another program ({other}); give "
                "another folder, or delete this one"
            )
        if content["arguments"] != arguments:
            raise InputError(
                f"into = {said(folder)} holds simulations of another plant or with other "
                "arguments; give another folder, or delete this one"
            )
        chunk = chunk or int(content["chunk"])
        write_study(folder, form, arguments, chunk, None)
        yield chunk


def _made(folder: Folder) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        empty = not any(p for p in folder.iterdir() if not p.name.startswith("."))
        if empty:
            (folder / FILES).mkdir(exist_ok=True)
    except WriteError:
        raise
    except OSError as error:
        raise InputError(f"into = {said(folder)}: {error.strerror}; {REMEDY}") from None
    if not empty:
        raise InputError(f"into = {said(folder)} holds other files; {REMEDY}")


def write_study(
    folder: Folder, form: str, arguments: str, chunk: int, parts: int | None, **more: Any
) -> None:
    """Write study.json; ``parts`` is None until all are there."""
    content = {"format": form, "arguments": arguments, "chunk": chunk, "parts": parts, **more}
    content["program"] = _program()
    path = folder / STUDY
    if isinstance(path, Path):
        write_json(path, content)
        return
    write_bytes(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False).encode())


# ---- one file -----------------------------------------------------------------------------------
def arrow(what: str = "simulate_many(into=...)") -> Any:
    """pyarrow's Parquet. Raises InputError where it is not installed."""
    try:
        import pyarrow.parquet
    except ImportError:
        raise InputError(f"{what} needs pyarrow: pip install pam_ocp[studies]") from None
    return pyarrow.parquet


def read_table(path: Folder, columns: Sequence[str] | None = None) -> Any:
    """A file as a table of pyarrow's, or columns of it."""
    with opened(path) as file:
        return arrow().read_table(file, columns=columns)


def frame_of(parts: Sequence[Folder], columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Files as one DataFrame, or columns of them."""
    pd = pandas()
    frames = [read_table(p, columns).to_pandas() for p in parts]
    filled = [f for f in frames if len(f)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()


def pandas() -> Any:
    """Raises InputError where it is not installed."""
    try:
        import pandas
    except ImportError:
        raise InputError("frame needs pandas: pip install pam_ocp[studies]") from None
    return pandas


def file_of(
    columns: Mapping[str, Any],
    about: Mapping[str, Any],
    texts: Mapping[str, Sequence[str | None]] | None = None,
    **options: Any,
) -> bytes:
    """NumPy's columns, then texts, as a Parquet file that says ``about`` of itself; ``options``: of
    pyarrow's write_table.
    """
    import pyarrow as pa

    # pa.table(columns) would load pandas, in each worker anew: as much as a dozen simulations
    arrays = [
        pa.Array.from_buffers(pa.from_numpy_dtype(c.dtype), len(c), [None, pa.py_buffer(c)])
        for c in columns.values()
    ]
    texts = texts or {}
    table = pa.Table.from_arrays(
        [*arrays, *(pa.array(t, pa.string()) for t in texts.values())],
        names=[*columns, *texts],
        metadata={b"pam_ocp": json.dumps(about).encode()},
    )
    content = pa.BufferOutputStream()
    arrow().write_table(table, content, **options)
    return bytes(content.getvalue())


def about_file(path: Folder) -> dict[str, Any]:
    """What a file says about itself. Raises InputError when it is none of ours."""
    try:
        with opened(path) as file:
            content = json.loads(arrow().read_schema(file).metadata[b"pam_ocp"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} cannot be read ({error}); delete it and run the same simulate_many again"
        ) from None
    return dict(content)


def digest_held(path: Folder) -> str | None:
    """The digest of a whole file; None where there is none or it is damaged."""
    try:
        if not path.is_file():
            return None
        read_table(path)  # a damaged page shows only when it is read
        return str(about_file(path)["digest"])
    except (InputError, OSError, ValueError):
        return None


def revived(error: Sequence[str]) -> Exception:
    """The error of a case, by its class and its sentence."""
    kind, message = error
    known = getattr(exceptions, kind, None)
    if known in (InputError, exceptions.SimulationError):
        return known(message)  # type: ignore[no-any-return]
    return PamError(message if known is not None else f"{kind}: {message}")


# ---- digests ------------------------------------------------------------------------------------
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
