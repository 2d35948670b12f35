"""Trajectory: named time series with units.

What a simulation, a plan and an FMU's replay return, and what a measured record is.
"""

from __future__ import annotations

import csv
import io
import json
import os
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import courtesy
from . import units
from .errors import InputError, UnknownNameError, require_count, require_numbers
from .files import (
    MOST_NAME,
    atomic_path,
    content_of,
    json_of,
    read_npz,
    reading,
    require_file,
    require_size,
    write_npz,
)
from .foreign import frame, read_frame
from .shown import shown
from .signals import Interpolation, PiecewisePolynomial
from .variables import Causality, Variable, require_causality, variable_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

Array: TypeAlias = NDArray[np.float64]


HELD = "inputs_held"
"""Column of a CSV file that says how its inputs ran: 1 held from sample to sample, 0 joined by
lines.
"""


def interpolation_of(held: Array, label: str) -> Interpolation:
    """What the column ``inputs_held`` of a file says. Raises InputError for other values than 0 or
    1.
    """
    if np.all(held == 1):
        return "previous"
    if np.all(held == 0):
        return "linear"
    raise InputError(
        f"{label}: column {HELD!r} must hold 1 (inputs held from sample to sample) or 0 (joined "
        "by lines) in all rows"
    )


@dataclass(frozen=True)
class Event:
    """A zero crossing of the variable ``name`` at ``time`` [s]; ``rising`` when it grows."""

    time: float
    name: str
    rising: bool


@shown
class Trajectory:
    """Time series of named variables on common times.

    Parameters
    ----------
    t : (n,) times [s], rising.
    columns : {name: (n,) values in SI}.
    variables : what the columns are (unit, causality, nominal, description), in order of display.
    interpolation : how inputs ran between samples: "previous" (held) or "linear". None: not known;
        they count as linear, and ``interpolation_known`` is False, so that a fit tries both. Files
        keep it: .csv in a column ``inputs_held`` (1 or 0) beside those of the inputs.
    events : zero crossings that a simulation located (they are not saved to files).
    signals : the inputs (in the order of their columns) exactly as they ran, also between samples;
        None when all that is known are the samples. Kept in .npz and .parquet; of lines that jump
        at a sample, .csv has it twice, with the values before and after.

    ``trajectory["x"]`` gives the samples of one variable; ``_`` may stand for ``.`` in names.

    Examples
    --------
    >>> run = pam.Trajectory([0.0, 0.1, 0.2], {"x": [0.0, 1e-3, 3e-3]})
    >>> float(run["x"][-1]), run.duration
    (0.003, 0.2)
    >>> path = motion.save("motion.csv")
    >>> pam.Trajectory.load(path).compare(motion).largest < 1e-6
    True
    """

    def __init__(
        self,
        t: ArrayLike,
        columns: Mapping[str, ArrayLike],
        variables: Sequence[Variable] | None = None,
        interpolation: Interpolation | None = None,
        events: Sequence[Event] = (),
        signals: PiecewisePolynomial | None = None,
    ) -> None:
        self.signals = signals
        self.events: tuple[Event, ...] = tuple(events)
        self.t: Array = _column("t", t, "s")
        if self.t.ndim != 1 or self.t.size == 0:
            raise InputError(f"t has shape {self.t.shape}; give a row of at least one time")
        if not np.all(np.isfinite(self.t)):
            raise InputError("t holds times that are not finite; give times in seconds")
        if not np.all(np.diff(self.t) > 0):
            row = int(np.argmax(~(np.diff(self.t) > 0))) + 1
            raise InputError(f"t must rise from sample to sample; it does not at sample {row}")
        if interpolation not in ("previous", "linear", None):
            raise InputError(f"interpolation = {interpolation!r}: choose 'previous' or 'linear'")
        self.interpolation_known = interpolation is not None or signals is not None
        self.interpolation: Interpolation = interpolation or "linear"
        if not isinstance(columns, Mapping):
            raise InputError(f"columns = {reprlib.repr(columns)}: give a mapping {{name: samples}}")
        if variables is None:
            variables = [Variable(name, "output") for name in columns]
        self.variables: tuple[Variable, ...] = tuple(variables)
        self._columns: dict[str, Array] = {}
        for variable in self.variables:
            if variable.name not in columns:
                raise UnknownNameError("column", variable.name, columns)
            if variable.name in self._columns:
                raise InputError(f"two columns are named {variable.name!r}; rename one")
            column = _column(variable.name, columns[variable.name], variable.unit)
            if column.shape != self.t.shape:
                raise InputError(
                    f"column {variable.name!r} has shape {column.shape}, the times {self.t.shape}"
                )
            # samples of an input that is known in between must not drift from it
            column.setflags(write=signals is None or variable.causality != "input")
            self._columns[variable.name] = column

    # ---- reading ----------------------------------------------------------------------------
    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._columns)

    def variable(self, name: str) -> Variable:
        """The variable of this name, in which "_" may stand for "." (as in tables of others).

        Raises UnknownNameError with the nearest names.
        """
        if not isinstance(name, str):
            raise InputError(f"{name!r} names no column; other times: at(t), a sample: row(index)")
        if name in self._columns:
            return next(v for v in self.variables if v.name == name)
        for variable in self.variables:
            if _plain(name) == _plain(variable.name):
                return variable
        raise UnknownNameError("column of the trajectory", name, self.names)

    def __getitem__(self, name: str) -> Array:
        return self._columns[self.variable(name).name]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and any(_plain(name) == _plain(n) for n in self._columns)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    def named(self, causality: Causality) -> tuple[str, ...]:
        """Names of all columns of a causality ("state", "input", "output")."""
        require_causality(causality)
        return tuple(v.name for v in self.variables if v.causality == causality)

    def array(self, names: Sequence[str]) -> Array:
        """The columns of these names, side by side: (n, len(names))."""
        return np.column_stack([self[n] for n in names]) if names else np.empty((len(self), 0))

    def row(self, index: int) -> dict[str, float]:
        """All values at one sample, by name; negative ones count from the end."""
        index = require_count("index", index, -len(self), len(self) - 1)
        return {name: float(column[index]) for name, column in self._columns.items()}

    def at(self, t: ArrayLike) -> Trajectory:
        """The same variables at other times [s] inside the record.

        Inputs follow ``signals`` or else ``interpolation``; all else is joined by straight lines.
        """
        times = np.ravel(require_numbers("t", t, "s"))
        if not times.size:
            raise InputError("t is empty; give at least one time")
        slack = 1e-9 * (1 + abs(self.t[-1]))
        if times.min() < self.t[0] - slack or times.max() > self.t[-1] + slack:
            raise InputError(
                f"t = {times.min():g} .. {times.max():g} s leaves the record "
                f"{self.t[0]:g} .. {self.t[-1]:g} s"
            )
        held = np.clip(np.searchsorted(self.t, times + slack, side="right") - 1, 0, len(self) - 1)
        exact = (
            dict(zip(self.named("input"), self.signals(times).T, strict=True))
            if self.signals
            else {}
        )
        columns = {
            v.name: exact[v.name]
            if v.name in exact
            else self._columns[v.name][held]
            if v.causality == "input" and self.interpolation == "previous"
            else np.interp(times, self.t, self._columns[v.name])
            for v in self.variables
        }
        return Trajectory(times, columns, self.variables, self._between, (), self.signals)

    @property
    def _between(self) -> Interpolation | None:
        """As the constructor takes it."""
        return self.interpolation if self.interpolation_known else None

    def running(self, interpolation: Interpolation) -> Trajectory:
        """The same samples, the inputs known to have run so between them ("previous" or
        "linear").
        """
        return Trajectory(self.t, self._columns, self.variables, interpolation, self.events)

    def __getattr__(self, name: str) -> Array:
        """``trajectory.muscle1_pressure``: the samples of one variable, for completion by tab."""
        columns = self.__dict__.get("_columns", {})
        for column in columns:
            if column.replace(".", "_") == name:
                found: Array = columns[column]
                return found
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *(n.replace(".", "_") for n in self.names)})

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.names)

    def __repr__(self) -> str:
        return (
            f"<Trajectory {self.t[0]:g} .. {self.t[-1]:g} s, {len(self)} samples of "
            f"{', '.join(self.names)}>"
        )

    # ---- comparing --------------------------------------------------------------------------
    def compare(self, other: Trajectory, names: Sequence[str] | None = None) -> Comparison:
        """How far ``other`` is from this trajectory, variable by variable, at this one's times."""
        shared = [n for n in self.names if n in other] if names is None else list(names)
        if not shared:
            raise InputError("the two trajectories have no column in common")
        sampled = other if np.array_equal(self.t, other.t) else other.at(self.t)
        rows = []
        for name in shared:
            variable, unit = self.variable(name), other.variable(name).unit
            said = {variable.unit, unit} - {"1"}  # which stands for a unit that nobody gave, too
            if len({units.unit(u).exponents for u in said}) > 1:
                raise InputError(
                    f"{name} is in {variable.unit} here and in {unit} there; name what to compare"
                )
            difference = sampled[name] - self[name]
            rows.append(
                Deviation(
                    variable,
                    largest=float(np.max(np.abs(difference))),
                    time=float(self.t[int(np.argmax(np.abs(difference)))]),
                    rms=float(np.sqrt(np.mean(difference**2))),
                )
            )
        return Comparison(tuple(rows))

    # ---- saving -----------------------------------------------------------------------------
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write to ``.csv`` (name and unit as header), ``.npz`` (everything) or ``.parquet``.

        Raises InputError for another ending. An existing file is replaced only when all is written.
        """
        target = Path(path)
        if target.suffix.lower() == ".npz":
            return write_npz(target, *self._packed())
        writers = {
            ".csv": self._write_csv,
            ".parquet": self._write_parquet,
        }
        writer = writers.get(target.suffix.lower())
        if writer is None:
            raise InputError(f"{target.name}: save as one of .csv, .npz, .parquet")
        with atomic_path(target) as temporary:
            writer(temporary)
        return target

    def _write_csv(self, path: Path) -> None:
        marked = self.interpolation_known and bool(self.named("input"))
        mark = [HELD] if marked else []
        held = np.full((len(self), len(mark)), float(self.interpolation == "previous"))
        rows = np.column_stack([self.t, self.array(self.names), held])
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time [s]", *(f"{v.name} [{v.unit}]" for v in self.variables), *mark])
            writer.writerows([repr(float(c)) for c in line] for line in self._with_both_sides(rows))

    def _with_both_sides(self, rows: Array) -> Array:
        """Rows of a table; where inputs that are joined by lines jump, the row before it, too."""
        if self.signals is None or self.interpolation == "previous":
            return rows
        inputs = [1 + self.names.index(name) for name in self.named("input")]
        before = rows.copy()
        before[:, inputs] = self.signals.before(self.t)
        scale = np.max(np.abs(rows[:, inputs]), axis=0, initial=0.0)
        jumps = np.any(np.abs(before - rows)[:, inputs] > 1e-9 * scale, axis=1)
        jumps[[0, -1]] = False
        return np.insert(rows, np.flatnonzero(jumps), before[jumps], axis=0)

    def _packed(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """What :func:`write_npz` writes."""
        return self._meta(), {"t": self.t, "data": self.array(self.names)}

    def _meta(self) -> dict[str, Any]:
        content: dict[str, Any] = {
            "interpolation": self._between,
            "variables": [asdict(v) for v in self.variables],
        }
        if self.signals is not None:
            content["signals"] = [self.signals.breaks.tolist(), self.signals.coefficients.tolist()]
        return content

    def _write_parquet(self, path: Path) -> None:
        frame = self.to_pandas()
        frame.attrs = {"pam_ocp": json.dumps(self._meta())}
        frame.to_parquet(path)

    def to_pandas(self) -> pd.DataFrame:
        """A DataFrame with one column per variable, indexed by time [s]."""
        table = np.column_stack(list(self._columns.values()))
        return frame(table, list(self._columns), self.t, "time")  # type: ignore[arg-type]

    def to_excel(self, path: str | os.PathLike[str]) -> Path:
        """Write a workbook (.xlsx): all columns in display units, a chart per unit.

        Raises InputError for more rows than a sheet has.
        """
        return courtesy.write_motion_book(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read what :meth:`save` wrote. Columns of a CSV are outputs; units that are not of SI are
        converted, such as ``[bar]``.
        """
        source = require_file(path)
        readers = {".csv": cls._read_csv, ".npz": cls._read_npz, ".parquet": cls._read_parquet}
        reader = readers.get(source.suffix.lower())
        if reader is None:
            raise InputError(f"{source.name}: load from one of {', '.join(readers)}")
        with reading(path, "a trajectory", "give one that Trajectory.save() wrote"):
            return reader(source)

    @classmethod
    def _read_csv(cls, path: Path) -> Trajectory:
        text = content_of(path).decode("utf-8-sig")
        try:
            header, *lines = csv.reader(io.StringIO(text, newline=""))
        except csv.Error as error:
            raise InputError(f"{path.name}: {error}; save it as CSV anew") from None
        require_size(path.name, len(lines), len(header))
        if any(len(head) > MOST_NAME for head in header):
            raise InputError(f"{path.name}: a header has more than {MOST_NAME} characters")
        if not header or header[0].partition(" [")[0] != "time":
            seen = str(header[:1])[:MOST_NAME]
            raise InputError(f"{path.name}: the first column is {seen}, it must be 'time [s]'")
        if not lines or any(len(line) != len(header) for line in lines):
            raise InputError(f"{path.name}: the rows do not all have {len(header)} cells")
        try:
            data = np.array([[float(c) for c in line] for line in lines])
        except ValueError as error:
            raise InputError(f"{path.name}: {error}; every cell must be a number") from None
        variables, between = [], None
        if HELD in header:
            between = interpolation_of(data[:, header.index(HELD)], path.name)
            data = np.delete(data, header.index(HELD), axis=1)
            header.remove(HELD)
        for i, head in enumerate(header):
            name, _, said = head.partition(" [")
            measured = units.unit(said.strip().removesuffix("]") or ("1" if i else "s"))
            if i == 0 and not measured.compatible(units.unit("s")):
                raise InputError(f"{path.name}: the first column is {head!r}, it must be a time")
            data[:, i] *= measured.factor
            if i:
                variables.append(Variable(name, "output", unit=units.si_unit(measured.name)))
        if np.any(np.diff(data[:, 0]) == 0.0):
            return cls._with_jumps(data, variables)
        columns = {v.name: data[:, i + 1] for i, v in enumerate(variables)}
        return cls(data[:, 0], columns, variables, between)

    @classmethod
    def _with_jumps(cls, data: Array, variables: Sequence[Variable]) -> Trajectory:
        """Inputs as FMI tools take them: lines between rows, jumps where a time stands twice."""
        t, first = np.unique(data[:, 0], return_index=True)
        if np.any(np.diff(first, append=len(data)) > 2) or np.any(np.diff(data[:, 0]) < 0):
            raise InputError("times must rise, or stand twice where values jump")
        last = np.append(first[1:], len(data)) - 1
        rows = data[last, 1:]
        slopes = (data[first[1:], 1:] - rows[:-1]) / np.diff(t)[:, None]
        played = PiecewisePolynomial(t, np.stack([rows[:-1], slopes], axis=1))
        inputs = [replace(v, causality="input") for v in variables]
        columns = {v.name: rows[:, i] for i, v in enumerate(inputs)}
        return cls(t, columns, inputs, None, (), played)

    @classmethod
    def _read_npz(cls, path: Path) -> Trajectory:
        content, arrays = read_npz(path, "a trajectory")
        if "data" not in arrays and "states" in arrays:
            return cls._of_former_plan(content, arrays)
        return cls._from_meta(content, arrays["t"], arrays["data"])

    @classmethod
    def _of_former_plan(cls, content: Mapping[str, Any], arrays: Mapping[str, Array]) -> Trajectory:
        """States and inputs of a plan of versions 0.1 and 0.2, which kept SI without its units."""
        played = PiecewisePolynomial(arrays["breaks"], arrays["coefficients"])
        states = [Variable(name, "state") for name in content["states"]]
        inputs = [Variable(name, "input") for name in content["inputs"]]
        values = np.column_stack([arrays["states"], played(arrays["t"])])
        columns = {v.name: c for v, c in zip(states + inputs, values.T, strict=True)}
        return cls(arrays["t"], columns, states + inputs, None, (), played)

    @classmethod
    def _read_parquet(cls, path: Path) -> Trajectory:
        frame = read_frame(path)
        said, t, data = frame.attrs["pam_ocp"], frame.index.to_numpy(), frame.to_numpy()
        return cls._from_meta(json_of(said.encode(), infinite=True), t, data)

    @classmethod
    def _from_meta(cls, content: Mapping[str, Any], t: Array, data: Array) -> Trajectory:
        variables = [variable_of(v) for v in content["variables"]]
        if np.shape(data) != (len(t), len(variables)):
            raise InputError(
                f"data has shape {np.shape(data)}, times and variables say "
                f"{(len(t), len(variables))}"
            )
        if np.iscomplexobj(t) or np.iscomplexobj(data):
            raise InputError("times and data must be real numbers; they are complex")
        columns = {v.name: data[:, i] for i, v in enumerate(variables)}
        signals = None
        if "signals" in content:
            breaks, coefficients = (np.array(part, dtype=float) for part in content["signals"])
            signals = PiecewisePolynomial(breaks, coefficients)
            signals.require(sum(v.causality == "input" for v in variables))
        return cls(t, columns, variables, content["interpolation"], (), signals)

    # ---- looking ----------------------------------------------------------------------------
    def plot(
        self,
        names: Sequence[str] | None = None,
        *,
        ax: Axes | None = None,
        interactive: bool = False,
    ) -> Any:
        """A figure with one panel per unit, over time. Returns the matplotlib Figure.

        ax : draw into this panel instead; the names must be of one unit.
        interactive : a plotly figure instead (needs the extra ``interactive``).
        """
        return courtesy.plot_trajectory(self, names, ax=ax, interactive=interactive)


def _plain(name: object) -> str:
    return str(name).replace(".", "_")


@dataclass(frozen=True)
class Deviation:
    """Difference of two trajectories in one variable [its unit]."""

    variable: Variable
    largest: float
    time: float
    rms: float

    @property
    def relative(self) -> float:
        """Largest difference in units of the variable's nominal."""
        return self.largest / self.variable.nominal


@shown
@dataclass(frozen=True)
class Comparison:
    """Differences of two trajectories, one Deviation per shared variable.

    Examples
    --------
    >>> found = motion.compare(motion)
    >>> found.largest
    0.0
    """

    deviations: tuple[Deviation, ...]

    @property
    def largest(self) -> float:
        """The largest difference of all, scaled by nominals."""
        return float(np.max([d.relative for d in self.deviations]))  # NaN, where one is

    def __getitem__(self, name: str) -> Deviation:
        for deviation in self.deviations:
            if deviation.variable.name == name:
                return deviation
        raise UnknownNameError("compared column", name, [d.variable.name for d in self.deviations])

    def __str__(self) -> str:
        lines = [f"{'variable':<22}{'largest':>17}{'rms':>17}{'/ nominal':>11}{'at t [s]':>12}"]
        lines += [
            f"{d.variable.name:<22} {d.variable.shown(d.largest):>16} {d.variable.shown(d.rms):>16}"
            f"{d.relative:>11.2e}{d.time:>12.5g}"
            for d in self.deviations
        ]
        return "\n".join(lines)


def _column(name: str, values: Any, unit: str) -> Array:
    """A copy of numbers, gaps (NaN) among them; texts with units are numbers, too."""
    try:
        if np.asarray(values).dtype.kind in "mM":  # NumPy makes nanoseconds of dates, or others
            raise TypeError
        return np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.array(require_numbers(name, values, unit))
