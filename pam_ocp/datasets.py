"""Measured data sets with fixed splits, and a score: results that anyone can compare.

What is fitted and what is predicted stands in ``data/datasets.toml``; scores of the same digest are
of the same task. As at nonlinearbenchmark.org (M. Schoukens, J.-P. Noël, IFAC-PapersOnLine 50(1),
2017, 446-451) a dynamic model is given the past of a window (state initialisation), then the inputs
alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files as resources
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from . import __version__
from .core.digest import file_digest
from .core.errors import InputError, UnknownNameError, require_instance, with_kinds
from .core.files import read_json, read_toml, reading, require_file, write_json
from .core.lazy import load as module
from .core.quantities import outside
from .core.trajectory import Trajectory
from .core.variables import Variable
from .export.cache import cache_folder
from .fitting.tables.force_table import read_table

__all__ = ["DATASETS", "Dataset", "Part", "Score", "Split", "compare", "load", "score", "show"]

Array: TypeAlias = NDArray[np.float64]
Predict: TypeAlias = Callable[[Any, Any], Any]
Numbers: TypeAlias = "Sequence[float] | str"

BUNDLED = Path(str(resources("pam_ocp.data")))


# ---- sets ----------------------------------------------------------------------------------------
@with_kinds
@dataclass(frozen=True)
class Dataset:
    """What was measured, where it lies, and how it is split.

    Parameters
    ----------
    name, measured : a word; a sentence. licence, citation, doi : for whoever uses it.
    columns : {header: unit} of its CSV files. Static: length_m, pressure_Pa (gauge), force_N.
        Dynamic: number of the record, time [s], then signals, named by their headers without what
        follows the last "_".
    place : "bundled", "folder" (the user's), or a URL, to which the names of files are appended.
    files : {name: {"sha256": ..., "records": the records in it}}.
    splits : {name: {"train": records, "test": records}}. Records are numbers, also as "0..47"; of
        a static set levels of contraction, to three digits.
    rest_length : l0 [m] of the muscle of a static set; None: it is dynamic.
    outputs : signals to be predicted; the others are inputs. past, every, horizons : samples of
        the state initialisation, from window to window, and over which errors are averaged.

    Examples
    --------
    >>> pam.datasets.DATASETS["DMSP-10-250"].licence
    'CC BY 4.0'
    """

    name: str
    measured: str
    columns: Mapping[str, str]
    licence: str
    citation: str
    doi: str
    place: str
    files: Mapping[str, Mapping[str, Any]]
    splits: Mapping[str, Mapping[str, Numbers]]
    rest_length: float | None = None
    outputs: Sequence[str] = ()
    past: int = 1
    every: int = 1
    horizons: Sequence[int] = (1,)

    def records(self, split: str) -> tuple[list[float], list[float]]:
        """The records of a split: to fit, and to predict."""
        if split not in self.splits:
            raise UnknownNameError(f"split of {self.name}", split, self.splits)
        return _numbers(self.splits[split]["train"]), _numbers(self.splits[split]["test"])

    def needed(self, split: str) -> dict[str, str]:
        """{name: SHA-256} of the files that a split is made of."""
        wanted = {n for part in self.records(split) for n in part}
        return {
            name: str(said["sha256"])
            for name, said in self.files.items()
            if wanted.intersection(_numbers(said["records"]))
        }

    def __str__(self) -> str:
        columns = ", ".join(f"{head} [{unit}]" for head, unit in self.columns.items())
        return (
            f"{self.name}: {self.measured}\n  columns  {columns}\n"
            f"  files    {', '.join(self.files)} ({self.place})\n"
            f"  splits   {', '.join(self.splits)}\n  licence  {self.licence}\n"
            f"  cite     {self.citation}, doi {self.doi}"
        )


def _numbers(said: Numbers) -> list[float]:
    if not isinstance(said, str):
        return [float(n) for n in said]
    first, last = said.split("..")
    return [float(n) for n in range(int(first), int(last) + 1)]


DATASETS: dict[str, Dataset] = {
    name: Dataset(name, **said) for name, said in read_toml(BUNDLED / "datasets.toml").items()
}
"""{name: Dataset}."""


@with_kinds
@dataclass(frozen=True, eq=False, repr=False)
class Split:
    """What to fit and what to predict: ForceTables of a static set, else tuples of Trajectories.

    Examples
    --------
    >>> split = pam.datasets.load("DMSP-20-300", "extrapolation")
    >>> len(split.train), len(split.test)
    (105, 21)
    """

    dataset: Dataset
    name: str
    train: Any
    test: Any

    @property
    def digest(self) -> str:
        """Of files, records and windows: equal where scores may be compared."""
        info = self.dataset
        windows = [*info.outputs, info.past, info.every, *info.horizons]
        task = [info.name, self.name, info.needed(self.name), info.records(self.name), windows]
        return hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:12]

    def __str__(self) -> str:
        what = "records" if self.dataset.rest_length is None else "cells"
        sizes = f"{len(self.train)} {what} to fit, {len(self.test)} to predict"
        return f"{self.dataset}\n  split    {self.name}: {sizes}, digest {self.digest}"

    __repr__ = __str__


@with_kinds
def show(name: str | None = None) -> None:
    """Print a data set with its licence and citation, or all of them. Raises UnknownNameError.

    Examples
    --------
    >>> pam.datasets.show("DMSP-10-250")
    DMSP-10-250: force of a Festo muscle, 10 mm x 250 mm, over length and pressure, quasi-static
    ...
    """
    print("\n\n".join(map(str, DATASETS.values() if name is None else [_named(name)])))


def _named(name: str) -> Dataset:
    if name not in DATASETS:
        raise UnknownNameError("data set", name, DATASETS)
    return DATASETS[name]


# ---- loading -------------------------------------------------------------------------------------
@with_kinds
def load(
    name: str | Dataset,
    split: str = "interpolation",
    *,
    folder: str | os.PathLike[str] | None = None,
) -> Split:
    """Read a data set, check its files, and split it as written down.

    name : in ``DATASETS``, or a Dataset of your own. folder : where files lie that are not bundled;
    by default $PAM_OCP_DATA. A set with a URL is downloaded into the cache ($PAM_OCP_CACHE) by
    pooch (extra ``data``) where no folder is given; a warning then tells the licence.

    Raises UnknownNameError, and InputError for a missing file, another checksum, no download.

    Examples
    --------
    >>> pam.datasets.load("DMSP-20-300").train
    ForceTable(84 cells, 36 taut: p 0.35..6.75 bar, kappa 1.333..26 %, F up to ...)
    """
    info = name if isinstance(name, Dataset) else _named(name)
    train, test = info.records(split)
    paths = [_found(info, file, sha, folder) for file, sha in info.needed(split).items()]
    if not paths:
        _require_held(info, split, ())
    if info.rest_length is None:
        records = {n: record for path in paths for n, record in _records(info, path)}
        _require_held(info, split, records)
        return Split(info, split, *(tuple(records[n] for n in part) for part in (train, test)))
    table = read_table([str(path) for path in paths], rest_length=info.rest_length)
    level = np.round(table.contraction, 3)
    _require_held(info, split, level.tolist())
    return Split(info, split, *(table.subset(np.isin(level, part)) for part in (train, test)))


def _require_held(info: Dataset, split: str, held: Iterable[float]) -> None:
    """InputError for records (or levels) of a split that its files do not hold."""
    lost = sorted({n for part in info.records(split) for n in part}.difference(held))
    if lost:
        told, there = (", ".join(f"{n:g}" for n in some) for some in (lost, sorted({*held})))
        raise InputError(
            f"{info.name}, {split}: its files do not hold {told}; they hold {there or 'none'}"
        )


def _found(info: Dataset, file: str, sha: str, folder: str | os.PathLike[str] | None) -> Path:
    """The path of a file whose checksum is right."""
    if info.place not in ("bundled", "folder") and folder is None:
        return _downloaded(info, file, sha)
    home = BUNDLED if info.place == "bundled" else folder or os.environ.get("PAM_OCP_DATA")
    if not home:
        raise InputError(
            f"{info.name} is not bundled: give folder=, or set PAM_OCP_DATA, to where {file} lies"
        )
    path = require_file(Path(home) / file)
    found = file_digest(path)
    if found != sha:
        raise InputError(
            f"{path} is not the file of {info.name}: its SHA-256 is {found}, expected is {sha}; "
            "get it anew"
        )
    return path


def _downloaded(info: Dataset, file: str, sha: str) -> Path:
    """The path of a file in the cache, which has its name there once it is whole and right."""
    try:
        pooch = module("pooch")
    except ImportError:
        raise InputError(
            f"downloading {info.name} needs pooch, which is not installed: pip install "
            f"'pam_ocp[data]', or give folder= with {file}"
        ) from None
    path = cache_folder() / "datasets" / info.name / file
    there = path.is_file() and file_digest(path) == sha
    try:
        pooch.retrieve(info.place + file, f"sha256:{sha}", file, path.parent)
    except Exception as error:  # of pooch, requests and the system
        raise InputError(
            f"{info.place}{file} was not downloaded: {error}; try again, or give folder="
        ) from error
    if not there:
        told = f"{info.name} was downloaded. Licence: {info.licence}. Cite {info.citation}"
        warnings.warn(f"{told}, doi {info.doi}", stacklevel=outside())
    return path


def _records(info: Dataset, path: Path) -> Iterator[tuple[float, Trajectory]]:
    """(number, record) of a file, whose rows are in the order of records and times."""
    with path.open(encoding="utf-8") as file:
        heads = file.readline().strip().split(",")
        if heads != list(info.columns):
            raise InputError(f"{path}: its columns are {heads}; say so in columns of the Dataset")
        rows = np.loadtxt(file, delimiter=",", ndmin=2)
    names = [head.rpartition("_")[0] for head in heads[2:]]
    variables = [
        Variable(name, "output" if name in info.outputs else "input", unit=info.columns[head])
        for name, head in zip(names, heads[2:], strict=True)
    ]
    for part in np.split(rows, np.flatnonzero(np.diff(rows[:, 0])) + 1):
        columns = dict(zip(names, part[:, 2:].T, strict=True))
        yield float(part[0, 0]), Trajectory(part[:, 1], columns, variables)


# ---- scores --------------------------------------------------------------------------------------
@with_kinds
@dataclass(frozen=True)
class Part:
    """The error of one output over a horizon [s] (None: static).

    rmse : in its unit; low, high : its 95 % interval (None with fewer than two records). nrmse : in
    standard deviations of the output in the test set. count : of windows, or of cells.

    Examples
    --------
    >>> pam.datasets.Part("q1", "rad", 0.5, 0.02, 0.1, 0.015, 0.027, 80).label
    'q1 [rad], 0.5 s'
    """

    output: str
    unit: str
    horizon: float | None
    rmse: float
    nrmse: float
    low: float | None
    high: float | None
    count: int

    @property
    def label(self) -> str:
        over = "" if self.horizon is None else f", {self.horizon:g} s"
        return f"{self.output} [{self.unit}]{over}"


@with_kinds
@dataclass(frozen=True, repr=False)
class Score:
    """How well a model (its name) predicts the test part of a split; ``print`` it for a table.

    Examples
    --------
    >>> law = pam.muscle("DMSP-20-300").law
    >>> found = pam.datasets.score("DMSP-20-300", lambda kappa, p: law.tension(p, kappa))
    >>> path = found.save("score.json")  # what is submitted
    >>> pam.datasets.Score.load(path) == found
    True
    """

    dataset: str
    split: str
    digest: str
    model: str
    version: str
    parts: tuple[Part, ...]

    def __str__(self) -> str:
        task = f"{self.dataset}, {self.split} {self.digest}"
        head = f"{'':<20}{'RMSE':>10}{'95 % interval':>24}{'NRMSE':>8}{'count':>7}"
        lines = [f"{self.model} on {task} (pam_ocp {self.version})", head]
        for p in self.parts:
            ends = "" if p.low is None else f"{p.low:.4g} .. {p.high:.4g}"
            lines.append(f"{p.label:<20}{p.rmse:>10.4g}{ends:>24}{p.nrmse:>8.3f}{p.count:>7}")
        return "\n".join(lines)

    __repr__ = __str__

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write it as JSON. Returns the path."""
        return write_json(path, {"format": "pam_ocp score", **asdict(self)})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Score:
        """Read what :meth:`save` wrote. Raises InputError."""
        kind, remedy = "a score", "give a file that Score.save() wrote"
        said = read_json(path, kind, "pam_ocp score", remedy)
        with reading(path, kind, remedy):
            said["parts"] = tuple(Part(**part) for part in said["parts"])
            return cls(**{name: value for name, value in said.items() if name != "format"})


@with_kinds
def score(task: Split | str, predict: Predict, *, model: str = "") -> Score:
    """Predict the test part of a split, and measure the error.

    Parameters
    ----------
    task : from :func:`load`, or the name of a set, for its interpolation.
    predict : static: (contraction, pressure [Pa]) -> force [N], each of shape (n,). Taut cells
        count by their error; slack ones, in a line of their own, by what is predicted above zero
        (they are censored: the law may lie anywhere below).
        Dynamic: (past, inputs) -> outputs. ``past`` is a Trajectory of all columns that ends at
        t = 0, ``inputs`` one of the inputs from there to the end of the window. Outputs at its
        times, as a Trajectory or as an array (n, outputs); the row of t = 0 is not judged. Errors
        are averaged over all samples up to each horizon.
    model : its name; by default that of ``predict``.

    Returns
    -------
    Score. Intervals take records as independent: Student's t for the logarithm of the mean square,
    a ratio of sums over records (W. Cochran, Sampling Techniques, 1977, 6.4).

    Raises InputError for predictions of another shape, or that are not finite.

    Examples
    --------
    >>> law = pam.muscle("DMSP-20-300").law
    >>> found = pam.datasets.score("DMSP-20-300", lambda kappa, p: law.tension(p, kappa))
    >>> [part.output for part in found.parts]
    ['force', 'slack force']
    """
    split = load(task) if isinstance(task, str) else task
    require_instance("task", split, Split, "give the name of a set, or what load() returns")
    judged = _dynamic if split.dataset.rest_length is None else _static
    name = model or getattr(predict, "__name__", type(predict).__name__)
    parts = tuple(judged(split, predict))
    return Score(split.dataset.name, split.name, split.digest, name, __version__, parts)


def _static(split: Split, predict: Predict) -> Iterator[Part]:
    table, slack = split.test, split.test.slack
    force = _checked(predict(table.contraction, table.pressure), table.force.shape)
    size = float(np.std(table.force[~slack]))
    errors = {"force": (force - table.force)[~slack], "slack force": np.maximum(force[slack], 0)}
    for name, error in errors.items():
        if error.size:
            rmse = float(np.sqrt(np.mean(error**2)))
            yield Part(name, "N", None, rmse, rmse / size, None, None, error.size)


def _dynamic(split: Split, predict: Predict) -> Iterator[Part]:
    info, first = split.dataset, split.test[0]
    size = np.std(np.concatenate([r.array(info.outputs) for r in split.test]), axis=0)
    squares = [np.array(list(_squares(info, record, predict))) for record in split.test]
    squares = [record for record in squares if record.size]  # long enough for a window
    if not squares:
        raise InputError(
            f"{info.name}: no record to predict is as long as past = {info.past} and horizons = "
            f"{max(info.horizons)} samples; give shorter ones to the Dataset"
        )
    count, sampling = sum(map(len, squares)), np.median(np.diff(first.t))
    for k, name in enumerate(info.outputs):
        for i, horizon in enumerate(info.horizons):
            rmse, low, high = _interval([record[:, i, k] for record in squares])
            unit, seconds = first.variable(name).unit, round(float(horizon * sampling), 9)
            yield Part(name, unit, seconds, rmse, rmse / float(size[k]), low, high, count)


def _squares(info: Dataset, record: Trajectory, predict: Predict) -> Iterator[Array]:
    """Mean squared errors of each window: (horizons, outputs)."""
    length, outputs = max(info.horizons), list(info.outputs)
    inputs = [name for name in record.names if name not in outputs]
    for now in range(info.past - 1, len(record) - length, info.every):
        past = _cut(record, now + 1 - info.past, now + 1, now, record.names)
        ahead = _cut(record, now, now + length + 1, now, inputs)
        said = predict(past, ahead)
        if isinstance(said, Trajectory):
            said = said.at(ahead.t).array(outputs)
        measured = record.array(outputs)[now : now + length + 1]
        error = (_checked(said, measured.shape) - measured)[1:]
        yield np.array([np.mean(error[:h] ** 2, axis=0) for h in info.horizons])


def _cut(record: Trajectory, first: int, last: int, now: int, names: Sequence[str]) -> Trajectory:
    """Samples first .. last - 1 of some columns, with times from sample ``now``."""
    columns = {name: record[name][first:last] for name in names}
    variables = [record.variable(name) for name in names]
    return Trajectory(record.t[first:last] - record.t[now], columns, variables)


def _checked(said: Any, shape: tuple[int, ...]) -> Array:
    array = np.asarray(said, dtype=float)
    if array.shape != shape or not np.all(np.isfinite(array)):
        finite = "" if np.all(np.isfinite(array)) else ", not all of them finite"
        raise InputError(
            f"predict returned numbers of shape {array.shape}{finite}: return {shape}, and limit "
            "what diverges"
        )
    return array


def _interval(squares: Sequence[Array]) -> tuple[float, float | None, float | None]:
    """(RMSE, ends of its 95 % interval) of squared errors, record by record."""
    from scipy.stats import t

    many, total = len(squares), sum(map(len, squares))
    mean = sum(float(record.sum()) for record in squares) / total
    rmse = float(np.sqrt(mean))
    if many < 2 or mean == 0:
        return rmse, None, None
    off = np.array([np.sum(record - mean) for record in squares])
    error = np.sqrt(many / (many - 1) * np.sum(off**2)) / total
    factor = float(np.exp(t.ppf(0.975, many - 1) * error / (2 * mean)))
    return rmse, rmse / factor, rmse * factor


@with_kinds
def compare(scores: Iterable[Score | str | os.PathLike[str]]) -> str:
    """A table of the RMSE of several models at one task, from scores or files of them.

    Raises InputError for scores of different tasks.

    Examples
    --------
    >>> none = pam.datasets.score("DMSP-20-300", lambda kappa, p: 0 * p, model="none")
    >>> print(pam.datasets.compare([none, none]))
    RMSE on DMSP-20-300, interpolation ...
    """
    found = [one if isinstance(one, Score) else Score.load(one) for one in scores]
    tasks = sorted({f"{one.dataset}, {one.split} {one.digest}" for one in found})
    if len(tasks) != 1:
        told = "; ".join(tasks) or "none"
        raise InputError(f"scores are of {len(tasks)} tasks ({told}): give those of one")
    wide = [max(12, 2 + len(one.model)) for one in found]
    lines = [f"RMSE on {tasks[0]}"]
    lines.append(" " * 20 + "".join(f"{s.model:>{w}}" for s, w in zip(found, wide, strict=True)))
    for i, part in enumerate(found[0].parts):
        cells = zip((one.parts[i].rmse for one in found), wide, strict=True)
        lines.append(f"{part.label:<20}" + "".join(f"{rmse:>{w}.4g}" for rmse, w in cells))
    return "\n".join(lines)
