"""Records made ready for a dynamic fit: mesh, inputs, measurements, and guesses of the states.

Where a record does not say how its inputs ran between samples, both ways are fitted, and the
likelier stays (:func:`decided`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.errors import (
    FitError,
    InputError,
    OutOfTime,
    PamError,
    UnknownNameError,
    kind_of,
    require_ends,
    require_instance,
    require_names,
    with_article,
)
from ...core.signals import Interpolation, merged, signals
from ...core.stop import TimeIsUp
from ...core.trajectory import Trajectory
from ...core.variables import Variable
from ...plants.plant import Plant
from ...simulation.simulator import simulate
from ..statistics import Array


@dataclass(frozen=True)
class ParameterGroup:
    """One unknown: a parameter of the plant, or several (``members``) that are to be equal."""

    name: str
    members: tuple[int, ...]
    value: float
    scale: float
    low: float
    high: float
    unit: str
    description: str


@dataclass(frozen=True, eq=False)
class InputErrors:
    """What unknown errors of samples add to the inputs' coefficients (n, degree + 1, nu). rows :
    positions in these, flat. columns : numbers of the errors, ``count`` in all. values : factors
    [unit of the input per standard deviation].
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    values: Array
    count: int

    @classmethod
    def of(
        cls, plant: Plant, record: Trajectory, mesh: Array, noise: Mapping[str, float]
    ) -> InputErrors:
        """Errors of every sample of the inputs in ``noise``, which run as the inputs themselves."""
        held, nu = record.interpolation == "previous", len(plant.inputs)
        degree = 0 if held else 1
        sample = np.clip(
            np.searchsorted(record.t, mesh[:-1] + 1e-12, side="right") - 1, 0, len(record) - 2
        )
        span, since = np.diff(record.t)[sample], mesh[:-1] - record.t[sample]
        rows, columns, values = [], [], []
        for number, (name, size) in enumerate(noise.items()):
            place = [v.name for v in plant.inputs].index(name)
            first = (np.arange(len(mesh) - 1) * (degree + 1)) * nu + place
            own = number * len(record) + sample
            parts = [(0, 0, np.ones(len(span)))]
            if not held:
                part = since / span
                parts = [(0, 0, 1 - part), (0, 1, part), (1, 0, -1 / span), (1, 1, 1 / span)]
            for power, later, factor in parts:
                rows.append(first + power * nu)
                columns.append(own + later)
                values.append(size * factor)
        return cls(
            np.concatenate(rows),
            np.concatenate(columns),
            np.concatenate(values),
            len(noise) * len(record),
        )

    def added(self, coefficients: Array, errors: Array) -> Array:
        """The coefficients with these errors (count,)."""
        found = coefficients.ravel().copy()
        np.add.at(found, self.rows, self.values * errors[self.columns])
        return np.asarray(found.reshape(coefficients.shape))


@dataclass(frozen=True, eq=False)
class Experiment:
    """One record, its clock that of the inputs. t, measured : times (K,) and samples (K, ny) that
    are compared. mesh : (n + 1,) times; the inputs are polynomials of ``coefficients`` (n, degree +
    1, nu) between them. states : a guess (n + 1, nx) at the mesh. errors : how errors of the
    inputs' samples change the coefficients; None where the samples are exact.
    """

    record: Trajectory
    t: Array
    measured: Array
    mesh: Array
    coefficients: Array
    states: Array
    errors: InputErrors | None = None


def groups(
    plant: Plant,
    free: Sequence[str | Sequence[str]],
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> list[ParameterGroup]:
    """The unknown parameters, from names, patterns (``muscle*.a1``: equal) and tuples (equal)."""
    require_instance("plant", plant, Plant, "give a Plant, such as HangingLoad(...)")
    ends = bounds_of(bounds)
    places = {v.name: i for i, v in enumerate(plant.parameters)}
    entries = list(free) if isinstance(free, Iterable) and not isinstance(free, str) else [free]
    for entry in entries:
        require_names("free", entry)
    found = [_group(plant, entry, places, ends) for entry in entries]
    labels = [g.name for g in found]
    members = [m for g in found for m in g.members]
    if len(set(members)) < len(members):
        raise InputError(f"free names a parameter twice: {', '.join(labels)}")
    for name in ends:
        if name not in labels:
            raise UnknownNameError("parameter in bounds that is not free:", name, labels)
    return found


def bounds_of(bounds: Mapping[str, tuple[float, float]] | None) -> dict[str, tuple[float, float]]:
    """{free parameter: (low, high)}, or an InputError."""
    require_instance("bounds", bounds, Mapping, "give {free parameter: (low, high)}", none=True)
    return dict(bounds or {})


def _group(
    plant: Plant,
    entry: str | Sequence[str],
    places: Mapping[str, int],
    bounds: Mapping[str, tuple[float, float]],
) -> ParameterGroup:
    """The unknown that one entry of ``free`` names, at the plant's value, within its bounds."""
    if isinstance(entry, str) and "*" in entry:
        label, names = entry, [n for n in places if fnmatchcase(n, entry)]
        if not names:
            raise UnknownNameError("pattern in free", entry, places)
    else:
        names = [plant.variable(n).name for n in ([entry] if isinstance(entry, str) else entry)]
        label = " = ".join(names)
    for name in names:
        if name not in places:
            raise InputError(
                f"free: {name} is {plant.variable(name).kind}; only parameters are "
                "fitted (initial states are unknown anyway)"
            )
    variables = [plant.variable(n) for n in names]
    one, values = variables[0], [float(v.start or 0.0) for v in variables]
    if max(values) - min(values) > 1e-9 * one.nominal:
        raise InputError(
            f"free: {label} are to be equal but start from {min(values):g} .. {max(values):g}; "
            "set them equal with plant.with_values(...)"
        )
    low = max(v.min for v in variables)
    high = min(v.max for v in variables)
    if label in bounds:
        given = require_ends(f"bounds[{label!r}]", bounds[label], one.unit)
        low, high = max(low, given[0]), min(high, given[1])
    if not low <= values[0] <= high:
        raise InputError(
            f"{label} starts at {values[0]:g}, outside its bounds {low:g} .. {high:g}; start "
            "elsewhere with plant.with_values(...)"
        )
    return ParameterGroup(
        label,
        tuple(places[n] for n in names),
        values[0],
        abs(values[0]) if abs(values[0]) > 1e-3 * one.nominal else one.nominal,
        low,
        high,
        one.unit,
        one.description,
    )


def recorded(records: Trajectory | Sequence[Trajectory]) -> list[Trajectory]:
    """One record or several as a list; what is no record is named."""
    kinds = (Trajectory, list, tuple)
    require_instance(
        "records", records, kinds, "give a Trajectory (of read_record), or a list of them"
    )
    return [records] if isinstance(records, Trajectory) else list(records)


def named(argument: str, name: str, plant: Plant, kind: Literal["state", "input"]) -> Variable:
    """The state or input of the plant that an argument names."""
    variable = plant.variable(name)
    if variable.causality != kind:
        wanted = with_article(kind)
        raise InputError(f"{argument}: {variable.name} is {variable.kind}, not {wanted}")
    return variable


def with_inputs(plant: Plant, record: Trajectory, values: Mapping[str, Any]) -> Trajectory:
    """The record with these columns, and the disturbances' own values, where it has none."""
    still = {v.name: v.start or 0.0 for v in plant.inputs if v.disturbance}
    missing = {n: v for n, v in (still | dict(values)).items() if n not in record}
    every = {n: np.broadcast_to(np.asarray(v, float), len(record)) for n, v in missing.items()}
    return with_columns(record, every)


def with_columns(record: Trajectory, more: Mapping[str, Array]) -> Trajectory:
    """The record with these columns, too, or in place of its own; itself where there are none."""
    if not more:
        return record
    columns = {n: record[n] for n in record.names} | dict(more)
    return Trajectory(record.t, columns, interpolation=record.interpolation)


def measured_names(
    plant: Plant, records: Sequence[Trajectory], outputs: Sequence[str] | None
) -> list[str]:
    """The states and outputs of the plant that all records hold, or those that are asked for."""
    require_instance("plant", plant, Plant, "give a Plant, such as HangingLoad(...)")
    if not records:
        raise InputError("records is empty: give at least one Trajectory (see read_record)")
    for i, record in enumerate(records):
        if not isinstance(record, Trajectory):
            raise InputError(f"record {i + 1} is {kind_of(record)}; give Trajectories")
    known = [v.name for v in (*plant.states, *plant.outputs)]
    if outputs is not None:
        several = [outputs] if isinstance(outputs, str) else outputs
        names = [plant.variable(n).name for n in several]
        wrong = [n for n in names if n not in known]
        if wrong:
            raise InputError(f"outputs: {wrong[0]} is neither a state nor an output of the plant")
    else:
        names = [n for n in known if all(n in record for record in records)]
    if not names:
        raise InputError(
            "no state or output of the plant is a column of every record; rename the columns "
            f"(known: {', '.join(known)})"
        )
    for i, record in enumerate(records):
        for name in names:
            bad = np.nonzero(~np.isfinite(record[name]))[0]
            if bad.size:
                raise InputError(
                    f"record {i + 1}: {name} = {record[name][bad[0]]} at t = {record.t[bad[0]]:g} "
                    "s; take the sample out or cut the record there"
                )
    return names


def prepare(
    plant: Plant,
    record: Trajectory,
    names: Sequence[str],
    longest_delay: float,
    step: float | None,
    constant: Mapping[str, float],
    input_noise: Mapping[str, float] | None = None,
) -> Experiment:
    """On a mesh: breaks of the inputs, refined to steps of at most ``step``; states are guessed."""
    whole = with_inputs(plant, record, constant)
    missing = [v.name for v in plant.inputs if v.name not in whole]
    if missing:
        raise InputError(
            f"the record has no column for the input {missing[0]}; give one, or "
            f"inputs={{{missing[0]!r}: value}} if it was constant"
        )
    keep = record.t >= record.t[0] + longest_delay - 1e-12
    if keep.sum() < 2:
        raise InputError(
            f"a record of {record.duration:g} s is too short for delays of up to "
            f"{longest_delay:g} s"
        )
    exact = record.signals is not None and all(v.name in record for v in plant.inputs)
    exact = exact and not input_noise
    for name in input_noise or {}:
        if name not in record:
            raise InputError(f"input_noise: {name} is no column of the record")
    inputs = {v.name: (record.t, whole[v.name]) for v in plant.inputs}
    u = signals(plant, record if exact else inputs, record.t, record.interpolation)
    times = merged(np.concatenate([record.t, u.breaks]))
    if step is not None:
        parts = np.maximum(np.ceil(np.diff(times) / step * (1 - 1e-9)).astype(int), 1)
        times = np.concatenate(
            [
                a + (b - a) * np.arange(n) / n
                for a, b, n in zip(times[:-1], times[1:], parts, strict=True)
            ]
            + [times[-1:]]
        )
    coefficients = u.shifted(times).coefficients
    errors = None
    if input_noise:
        if record.interpolation == "linear" and coefficients.shape[1] < 2:
            coefficients = np.concatenate([coefficients, np.zeros_like(coefficients)], axis=1)
        errors = InputErrors.of(plant, record, times, input_noise)
    return Experiment(
        record,
        record.t[keep],
        record.array(names)[keep],
        times,
        coefficients,
        _guess(plant, whole, times),
        errors,
    )


def _guess(plant: Plant, record: Trajectory, times: Array) -> Array:
    """Measured states where there are, velocities from positions, a simulation for the others."""
    seen, states = visited(plant, record), np.empty((len(times), len(plant.states)))
    for i, v in enumerate(plant.states):
        # what cannot be simulated stays constant; the solver has to do without
        known = v.name in seen
        states[:, i] = np.interp(times, seen.t, seen[v.name]) if known else float(v.start or 0.0)
    if not np.all(np.isfinite(states)):
        raise FitError("the plant's start values give no finite motion; set them with with_values")
    return states


def visited(
    plant: Plant, record: Trajectory, start: Mapping[str, float] | None = None
) -> Trajectory:
    """A record with all states: measured, velocities from positions, simulated for the rest."""
    states = [v.name for v in plant.states]
    columns = {n: record[n] for n in record.names}
    for position, velocity in plant.positions.items():
        if position in columns and velocity not in columns and len(record) > 1:
            columns[velocity] = np.gradient(columns[position], record.t)
    if any(n not in columns for n in states):
        begin = {n: float(columns[n][0]) for n in states if n in columns} | dict(start or {})
        try:
            run = played(plant, record, begin, 1e-5)
            every = [v.name for v in (*plant.states, *plant.outputs)]
            columns |= {n: run[n] for n in every if n not in columns}
        except OutOfTime:
            raise
        except PamError:
            pass  # what was not measured stays unknown
    return with_columns(record, columns)


def played(plant: Plant, motion: Trajectory, start: Mapping[str, float], rtol: float) -> Trajectory:
    """The plant under the inputs of a motion, from a start that is brought within its bounds."""
    inputs = {v.name: (motion.t, motion[v.name]) for v in plant.inputs if v.name in motion}
    begin = {}
    for name, value in start.items():
        v = plant.variable(name)
        begin[v.name] = float(np.clip(value, v.min, v.max))
    between = motion.interpolation
    return simulate(plant, inputs, t=motion.t, start=begin, rtol=rtol, interpolation=between)


Result = TypeVar("Result")
WAYS: tuple[Interpolation, Interpolation] = ("previous", "linear")
WORDS = {"previous": "held", "linear": "joined by lines"}
TOLD = 6.0
"""Difference of -2 ln(likelihood) from which a record tells which of both it was."""


def deviance(residuals: Array, noise: Array | None = None) -> float:
    """-2 ln(likelihood) of normal residuals (n, ny), up to a constant; of unknown size without
    ``noise``.
    """
    if noise is not None:
        return float(np.sum((residuals / noise) ** 2))
    squares = np.maximum(np.mean(residuals**2, axis=0), 1e-300)
    return float(len(residuals) * np.sum(np.log(squares)))


def running(records: Sequence[Trajectory], between: Interpolation) -> list[Trajectory]:
    """The records, their inputs running so where they do not say how."""
    return [r if r.interpolation_known else r.running(between) for r in records]


def decided(
    plant: Plant,
    records: Sequence[Trajectory],
    fitted: Callable[[Sequence[Trajectory]], tuple[Result, float]],
) -> tuple[Result, Interpolation, str]:
    """A fit, how inputs count as having run where that was not known, and what decided it, in
    words. fitted : records to a fit and its deviance; called once where no input's way is open.
    """
    if all(r.interpolation_known or not _moves(plant, r) for r in records):
        return fitted(records)[0], "linear", ""
    found: dict[Interpolation, tuple[Result, float]] = {}
    failed: FitError | None = None
    for way in WAYS:
        try:
            found[way] = fitted(running(records, way))
        except FitError as error:
            failed = error
        except TimeIsUp:
            if not found:
                raise
            break
    if not found:
        assert failed is not None
        raise failed
    best = min(found, key=lambda way: found[way][1])
    if len(found) == 1:
        return found[best][0], best, f"inputs count as {WORDS[best]}: the other way gave no fit"
    other = next(way for way in WAYS if way != best)
    gap = found[other][1] - found[best][1]
    words = (
        f"inputs count as {WORDS[best]} between samples, which the records do not say: -2 "
        f"ln(likelihood) is {gap:.4g} less than {WORDS[other]}"
    )
    if not gap > TOLD:
        words += "; that hardly tells, so say it: read_record(..., inputs='held' or 'linear')"
    return found[best][0], best, words


def _moves(plant: Plant, record: Trajectory) -> bool:
    inputs = [record[v.name] for v in plant.inputs if v.name in record]
    return any(np.ptp(u) > 1e-9 * np.abs(u).max(initial=1.0) for u in inputs)
