"""simulate: the motion of a plant under given inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import (
    InputError,
    SimulationError,
    require_count,
    require_names,
    require_numbers,
    require_positive,
    require_tolerance,
)
from ..core.signals import Inputs, Interpolation, PiecewisePolynomial, joined, signals
from ..core.stop import verb
from ..core.trajectory import Event, Trajectory
from ..muscles.validity import warn_outside
from ..plants.dead_time import DelayLine
from ..plants.plant import Given, Plant, Values, by_name, require_plant
from ..plants.undelayed import without_dead_times
from .integrate import Integration, Method, evaluated

Array: TypeAlias = NDArray[np.float64]
LEVEL = 1e-6
"""States along a line differ by at most this part of their nominal where it begins at one value."""


def exactly_delayed(
    plant: Plant, u: PiecewisePolynomial, times: Array, x0: Array
) -> tuple[Plant, PiecewisePolynomial, Array, Callable[[Array], Array]]:
    """(plant without delay lines, its inputs, its initial states, states of it -> of the plant).

    u : the plant's inputs. times : of the samples; before the first, commands stood at the start
    values of their lines. Raises InputError where a line does not begin at one value.
    """
    reduced = without_dead_times(plant)
    order = [v.name for v in plant.states]
    starts = dict(zip(order, x0.tolist(), strict=True))
    begins = {line.outlet: _level(plant, line, starts) for line in plant.delay_lines}
    sources = [v.name for v in plant.inputs]

    def effect(line: DelayLine, part: float) -> PiecewisePolynomial:
        own = PiecewisePolynomial(u.breaks, u.coefficients[:, :, [sources.index(line.source)]])
        shift = part * float(plant.variable(line.time).start or 0.0)
        return _later(own, shift, begins[line.outlet], float(times[0]))

    by_outlet = {line.outlet: line for line in plant.delay_lines}
    pieces = [
        effect(by_outlet[v.name], 1.0)
        if v.name in by_outlet
        else PiecewisePolynomial(u.breaks, u.coefficients[:, :, [sources.index(v.name)]])
        for v in reduced.inputs
    ]
    kept = [order.index(v.name) for v in reduced.states]

    def whole(states: Array) -> Array:
        found = np.empty((len(times), len(order)))
        found[:, kept] = states
        for line in plant.delay_lines:
            for name, part in zip(line.states, line.dead_time.places, strict=True):
                found[:, order.index(name)] = effect(line, float(part))(times)[:, 0]
        return found

    return reduced, joined(pieces, times), x0[kept], whole


def _level(plant: Plant, line: DelayLine, starts: dict[str, float]) -> float:
    values = np.array([starts[n] for n in line.states])
    if np.ptp(values) > LEVEL * plant.variable(line.outlet).nominal:
        raise InputError(
            f"start of {line.states[0]} .. {line.outlet} runs from {values.min():g} to "
            f"{values.max():g}: exact dead times begin with commands that stood; start all of them "
            "at one value"
        )
    return float(values[-1])


def _later(
    signal: PiecewisePolynomial, shift: float, before: float, start: float
) -> PiecewisePolynomial:
    """The signal a time later, ``before`` until its own start arrives."""
    if shift <= 0:
        return signal
    inside = signal.breaks > start
    breaks = np.concatenate([[start], signal.breaks[inside]])
    own = signal.shifted(breaks)
    first = np.zeros((1, *own.coefficients.shape[1:]))
    first[0, 0] = before
    # a piece behind the end holds the last value there
    last = np.zeros_like(first)
    last[0, 0] = own.final()
    return PiecewisePolynomial(
        np.concatenate([[start], breaks + shift, [breaks[-1] + 2 * shift]]),
        np.concatenate([first, own.coefficients, last]),
    )


TIME_TOLERANCE = 1e-11
"""A crossing is located to this [s]; the integrator's own error comes on top."""
MAX_EVENTS = 10_000


class _Crossings:
    """The watched expressions as functions of time and state."""

    def __init__(self, plant: Plant, names: tuple[str, ...], u: PiecewisePolynomial) -> None:
        self.plant, self.u = plant, u
        self.names = tuple(n if n.startswith("der(") else plant.variable(n).name for n in names)
        expressions = ca.vertcat(*(plant.expression(n) for n in self.names))
        self.function = ca.Function("events", [plant.x, plant.u, plant.p], [expressions])
        self.parameters = plant.vector("parameter")

    def __call__(self, t: Array, states: Array) -> Array:
        """Values (number of times, number of names)."""
        values = self.function(states.T, self.u(t).T, self.parameters)
        table: Array = np.asarray(values, dtype=float).reshape(len(self.names), len(t))
        return np.ascontiguousarray(table.T)


def integrate_with_events(
    run: Integration, names: tuple[str, ...]
) -> tuple[Array | None, tuple[Event, ...], int]:
    """States over the grid of ``run``, the crossings of ``names``, and the intervals that
    succeeded.

    The states are None when the integrator gave up; the number then says how far it came.
    """
    crossings = _Crossings(run.plant, names, run.u)
    grid = run.grid
    rows = [run.x0[None, :]]
    events: list[Event] = []
    start, x, k = float(grid[0]), run.x0, 0  # integrating from ``start`` inside interval k
    sign = np.sign(crossings(grid[:1], x[None, :])[0])
    while k < len(grid) - 1:
        times = np.concatenate([[start], grid[k + 1 :]])
        ahead = run.u.breaks > start + 1e-12 * (1 + abs(start))
        part = replace(
            run, grid=times, x0=x, u=run.u.shifted(np.append(start, run.u.breaks[ahead]))
        )
        states = part()
        usable = states if states is not None else part(part.longest)
        assert usable is not None
        values = crossings(times[: len(usable)], usable)
        unsure = sign == 0  # a start on the border: the side it leaves to
        sign = np.where(unsure & (len(values) > 1), np.sign(values[min(1, len(values) - 1)]), sign)
        changed = (np.sign(values[1:]) * sign < 0).any(axis=1)
        first = int(np.argmax(changed)) if changed.any() else len(usable) - 1
        rows.append(usable[1 : first + 1])
        k += first
        if not changed.any():
            return (None if states is None else np.vstack(rows)), tuple(events), k
        start, x, which = _located(crossings, part, times, usable, first, sign)
        for i in which:
            events.append(Event(start, crossings.names[i], bool(sign[i] < 0)))
            sign[i] = -sign[i]
        if len(events) > MAX_EVENTS:
            return None, tuple(events), k
    return np.vstack(rows), tuple(events), k


def _located(
    crossings: _Crossings, part: Integration, times: Array, states: Array, k: int, sign: Array
) -> tuple[float, Array, list[int]]:
    """Time and state just behind the first crossing in (times[k], times[k + 1]],
    and which crossed.
    """
    low, a, b = float(times[k]), float(times[k]), float(times[k + 1])
    x_b = states[k + 1]
    while b - a > TIME_TOLERANCE:
        middle = (a + b) / 2
        x = part.advance(low, states[k], middle)
        if (crossings(np.array([middle]), x[None, :])[0] * sign < 0).any():
            b, x_b = middle, x
        else:
            a = middle
    value = crossings(np.array([b]), x_b[None, :])[0]
    return b, x_b, [int(i) for i in np.flatnonzero(value * sign < 0)]


@verb
def simulate(
    plant: Plant,
    inputs: Inputs = None,
    *,
    duration: float | None = None,
    t: ArrayLike | None = None,
    start: Given | None = None,
    parameters: Values | None = None,
    interpolation: Interpolation = "previous",
    rtol: float = 1e-10,
    method: Method = "rosenbrock",
    step: float | None = None,
    events: str | Sequence[str] = (),
    max_steps: int = 100_000,
    dead_times: Literal["line", "exact"] = "line",
    compiled: bool | None = False,
    time_limit: float | None = None,
) -> Trajectory:
    """Integrate x' = f(x, u(t), p) and return states, inputs and outputs over time.

    Parameters
    ----------
    plant : any Plant.
    inputs : {name: number | samples at ``t`` | (times, samples) | pandas Series over time |
        function of time}, a Trajectory, or None for the inputs' start values.
    duration, t : how long [s] (201 samples), or the output times [s] themselves. By default those
        of the Trajectory given as ``inputs``.
    start : initial states by name; by default the first row of a Trajectory given as ``inputs``
        that holds all states, else the states' start values. Or an operating point: its states, and
        its inputs in place of the inputs' start values.
    parameters : parameter values for this run only.
    interpolation : how samples run: "previous" (held) or "linear"; a Trajectory knows its own.
    rtol : relative tolerance per step, 1e-14 .. 1; absolute ones are rtol times nominal.
    method : "rosenbrock" (order 5, L-stable; the default, for all plants), "cvodes"
        (SUNDIALS BDF, another family for comparison), "rk4" (explicit, with ``step``; for plants
        that are not stiff).
    step : length of equal steps [s] for "rk4", or for "rosenbrock" instead of adaptive ones.
    events : names of variables or path constraints whose zero crossings are located (to 1e-9 s and
        better) and at which the integration starts anew; see ``trajectory.events``. With a small
        ``slack_width`` and ``events=["muscle.tension"]`` the clamp at zero force is exact in
        effect. Two crossings between neighbouring output times stay unseen: choose ``t`` fine.
    max_steps : of the integrator between two output times, in the mean.
    dead_times : of feeds that have them (see :class:`pam_ocp.feeds.DeadTime`): by their delay
        "line", which is the model of plans, fits and FMUs; or "exact", by shifting the commands,
        which before the start stood at the start values of the line.
    compiled : by machine code of the plant (the C solver of the FMUs: order 5, L-stable), many
        times as quick. True: built if need be, some seconds for each structure of plants, once;
        kept in the cache. None: where it is there. False: never, so that equal calls give equal
        bits, whatever was compiled before. Results differ within ``rtol``.

    Jumps of the inputs are met exactly: no step crosses one. Functions of time are looked at 2000
    times in a run or more; pulses between are not seen: give those as ``(times, samples)``.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Warns (ValidityWarning, once for each plant) of a position that goes beyond its range, that of
    the measured contractions, by more than a tenth of it: nothing stops it there.

    Raises InputError for bad arguments, SimulationError (with the time reached and the part
    computed so far) when the integrator cannot go on.

    Examples
    --------
    >>> motion = pam.simulate(plant, {"muscle.command": 3e5}, duration=2.0)
    >>> print(f"{motion['x'][-1]:.3f}")
    0.045
    >>> rest = plant.equilibrium({"muscle.command": 3e5})
    >>> bool(abs(motion["x"][-1] - rest["x"]) < 1e-4)
    True
    """
    require_plant(plant)
    if parameters is not None:
        parameters = by_name("parameters", parameters)
        wrong = [n for n in parameters if plant.variable(n).causality != "parameter"]
        if wrong:
            raise InputError(f"parameters: {wrong[0]} is {plant.variable(wrong[0]).kind}")
        plant = plant.with_values(parameters)
    if start is not None and not isinstance(start, Mapping):
        plant = plant.with_values(by_name("start", start, "input"))
    times = times_of(inputs, duration, t)
    rtol, step = _check_numerics(rtol, step, max_steps)
    events = tuple(require_names("events", events))
    x0 = plant.vector("state", start_of(plant, inputs, start))
    u = signals(plant, inputs, times, interpolation)
    if dead_times not in ("line", "exact"):
        raise InputError(f"dead_times = {dead_times!r}: choose 'line' or 'exact'")
    moved, driven, begin = plant, u, x0
    whole: Callable[[Array], Array] = np.asarray
    if dead_times == "exact" and plant.delay_lines:
        moved, driven, begin, whole = exactly_delayed(plant, u, times, x0)
    run = Integration.over(
        moved,
        driven,
        times,
        begin,
        method=method,
        rtol=rtol,
        step=step,
        max_steps=max_steps,
        compiled=compiled,
    )
    found: tuple[Event, ...] = ()
    if events:
        states, found, done = integrate_with_events(run, events)
    else:
        states, done = run(), 0
    if states is None:
        part = run(done or run.longest)
        assert part is not None
        raise _failure(moved, run, part)
    machine = run.machine if moved is plant else None
    motion = evaluated(plant, times, whole(run.at(times, states)), u, found, machine)
    for name in plant.load_positions:
        warn_outside(f"simulate: {plant.name}", plant.variable(name), motion[name], times)
    return motion


def _check_numerics(rtol: float, step: float | None, max_steps: int) -> tuple[float, float | None]:
    """The step [s]; InputError where one of these is none."""
    rtol = require_tolerance("rtol", rtol)
    require_count("max_steps", max_steps)
    return rtol, None if step is None else require_positive("step", step, "s")


def times_of(inputs: Inputs, duration: float | None, t: ArrayLike | None) -> Array:
    """The output times [s] that these arguments of simulate mean."""
    if t is not None:
        if duration is not None:
            raise InputError("give duration or t, not both")
        times = np.atleast_1d(require_numbers("t", t, "s"))
        if times.ndim != 1 or times.size < 2 or not np.all(np.diff(times) > 0):
            raise InputError("t must hold at least two times that rise from sample to sample")
        return times
    if duration is not None:
        return np.linspace(0.0, require_positive("duration", duration, "s"), 201)
    if isinstance(inputs, Trajectory):
        return inputs.t
    if isinstance(inputs, PiecewisePolynomial):
        return inputs.breaks
    raise InputError(
        "give duration (seconds) or t (output times); only a Trajectory brings its own"
    )


def start_of(plant: Plant, inputs: Inputs, start: Given | None) -> dict[str, Any]:
    """States at the start, as far as inputs and start say them."""
    first: dict[str, Any] = {}
    if isinstance(inputs, Trajectory) and all(v.name in inputs for v in plant.states):
        # a record may leave the range by rounding; start values are held to it elsewhere
        first = {v.name: float(np.clip(inputs[v.name][0], v.min, v.max)) for v in plant.states}
    given = {plant.variable(n).name: v for n, v in by_name("start", start, "state").items()}
    return {**first, **given}


def _failure(plant: Plant, run: Integration, states: Array) -> SimulationError:
    done = len(states) - 1
    t, u = run.grid[: done + 1], run.u
    names = [v.name for v in (*plant.states, *plant.inputs)]
    values = np.concatenate([states[-1], u(t[-1])[0]])
    shown = ", ".join(
        f"{n} = {plant.variable(n).shown(v)}" for n, v in zip(names, values, strict=True)
    )
    return SimulationError(
        f"the integrator gave up behind t = {t[-1]:.6g} s of {run.grid[-1]:.6g} s, at {shown}; the "
        "error's trajectory holds the part computed so far. Check the inputs and parameters, or "
        "allow a larger rtol or max_steps",
        float(t[-1]),
        evaluated(plant, t, states, u) if done else None,
    )
