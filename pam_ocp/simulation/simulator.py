"""simulate: the motion of a plant under given inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol

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
from ..core.signals import Inputs, Interpolation, PiecewisePolynomial, signals
from ..core.stop import verb
from ..core.trajectory import Event, Trajectory
from ..plants.plant import Given, Plant, Values, by_name, require_plant
from .dead_times import exactly_delayed
from .events import integrate_with_events
from .integrate import Integration, Method

__all__ = ["evaluated", "simulate", "start_of", "times_of"]

Array = NDArray[np.float64]


class Computes(Protocol):
    """A plant's outputs at many points, by other means than CasADi's."""

    def outputs(self, x: Array, u: Array, p: Array) -> Array:
        """(n, ny) at states (n, nx), inputs (n, nu) and parameters (np,)."""
        ...


COLUMNS = 10_000
"""Samples whose outputs are computed at once."""


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
    inputs : {name: number | samples at ``t`` | (times, samples) | function of time}, a Trajectory,
        or None for the inputs' start values.
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

    Jumps of the inputs are met exactly: no step crosses one.
    time_limit : [s]; OutOfTime when it is over before there is a result.

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
            raise InputError(f"parameters: {wrong[0]} is a {plant.variable(wrong[0]).causality}")
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
    return evaluated(plant, times, whole(run.at(times, states)), u, found, machine)


def evaluated(
    plant: Plant,
    t: Array,
    states: Array,
    inputs: PiecewisePolynomial,
    events: tuple[Event, ...] = (),
    machine: Computes | None = None,
) -> Trajectory:
    """The Trajectory of given states (n, nx) at times t under given inputs, outputs computed.

    machine : what computes them; None: CasADi.
    """
    u = inputs(t)
    p = plant.vector("parameter")
    if machine is not None:
        outputs = machine.outputs(states, u, p)
    else:
        parts_of = [  # CasADi's working memory grows with the columns of a call
            np.asarray(plant.function(states[i : i + COLUMNS].T, u[i : i + COLUMNS].T, p)[1]).T
            for i in range(0, len(t), COLUMNS)
        ]
        outputs = np.concatenate(parts_of)
    parts = {"state": states, "input": u, "output": outputs}
    variables = (*plant.states, *plant.inputs, *plant.outputs)
    data = np.concatenate([parts[c].reshape(len(t), -1) for c in parts], axis=1)
    columns = {v.name: data[:, i] for i, v in enumerate(variables)}
    between: Interpolation = "previous" if inputs.degree == 0 else "linear"
    return Trajectory(t, columns, variables, between, events, inputs)


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
