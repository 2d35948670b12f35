"""simulate: the motion of a plant under given inputs, by CasADi's integrators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, SimulationError, require_positive
from .plant.plant import Plant, Values
from .signals import Inputs, Interpolation, PiecewisePolynomial, merged, signals
from .trajectory import Trajectory

__all__ = ["evaluated", "simulate"]

Array = NDArray[np.float64]


def simulate(
    plant: Plant,
    inputs: Inputs = None,
    *,
    duration: float | None = None,
    t: ArrayLike | None = None,
    start: Values | None = None,
    parameters: Values | None = None,
    interpolation: Interpolation = "previous",
    rtol: float = 1e-10,
    max_steps: int = 100_000,
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
        that holds all states, else the states' start values.
    parameters : parameter values for this run only.
    interpolation : how samples run: "previous" (held) or "linear"; a Trajectory knows its own.
    rtol : relative tolerance per step; absolute ones are rtol times nominal.
    max_steps : of the integrator between two output times.

    Method: CasADi's ``rosenbrock`` (order 5, L-stable, dense output of order 4). Jumps of the
    inputs are met exactly: no step crosses one.

    Raises InputError for bad arguments, SimulationError (with the time reached and the part
    computed so far) when the integrator cannot go on.
    """
    if parameters:
        wrong = [n for n in parameters if plant.variable(n).causality != "parameter"]
        if wrong:
            raise InputError(f"parameters: {wrong[0]} is a {plant.variable(wrong[0]).causality}")
        plant = plant.with_values(parameters)
    times = _times(inputs, duration, t)
    require_positive("rtol", rtol)
    x0 = plant.vector("state", _start(plant, inputs, start))
    u = signals(plant, inputs, times, interpolation)
    states = _integrate(plant, u, times, x0, rtol, max_steps)
    return evaluated(plant, times, states, u(times), "previous" if u.degree == 0 else "linear")


def evaluated(
    plant: Plant, t: Array, states: Array, inputs: Array, interpolation: Interpolation
) -> Trajectory:
    """The Trajectory of given states (n, nx) and inputs (n, nu), outputs computed."""
    outputs = plant.function(states.T, inputs.T, plant.vector("parameter"))[1]
    parts = {"state": states, "input": inputs, "output": np.asarray(outputs).T}
    variables = (*plant.states, *plant.inputs, *plant.outputs)
    data = np.concatenate([parts[c].reshape(len(t), -1) for c in parts], axis=1)
    columns = {v.name: data[:, i] for i, v in enumerate(variables)}
    return Trajectory(t, columns, variables, interpolation)


def _times(inputs: Inputs, duration: float | None, t: ArrayLike | None) -> Array:
    if t is not None:
        if duration is not None:
            raise InputError("give duration or t, not both")
        times = np.array(t, dtype=float)
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


def _start(plant: Plant, inputs: Inputs, start: Values | None) -> dict[str, Any]:
    first: dict[str, Any] = {}
    if isinstance(inputs, Trajectory) and all(v.name in inputs for v in plant.states):
        # a record may leave the range by rounding; start values are held to it elsewhere
        first = {v.name: float(np.clip(inputs[v.name][0], v.min, v.max)) for v in plant.states}
    given = {plant.variable(n).name: value for n, value in (start or {}).items()}
    return {**first, **given}


def _integrate(
    plant: Plant, u: PiecewisePolynomial, times: Array, x0: Array, rtol: float, max_steps: int
) -> Array:
    """States (n, nx) at ``times``."""
    inside = u.breaks[(u.breaks > times[0]) & (u.breaks < times[-1])]
    grid = merged(np.concatenate([times, inside]))
    groups = merged(np.concatenate([times[[0, -1]], inside]))
    on_groups = u.shifted(groups)
    run = _Run(plant, on_groups, grid, x0, rtol, max_steps)
    n = len(grid) - 1
    states = run(n)
    if states is None:
        done, beyond = 0, n  # the longest part that works, by bisection
        while beyond - done > 1:
            middle = (done + beyond) // 2
            done, beyond = (middle, beyond) if run(middle) is not None else (done, middle)
        raise _failure(plant, run, u, grid, done)
    return states[np.searchsorted(grid, times - 1e-12 * (1 + np.abs(times)))]


class _Run:
    """The integration over the first k intervals of a grid, k chosen at the call."""

    def __init__(
        self,
        plant: Plant,
        u: PiecewisePolynomial,
        grid: Array,
        x0: Array,
        rtol: float,
        max_steps: int,
    ) -> None:
        self.grid, self.x0, self.u = grid, x0, u
        self.options = {"reltol": rtol, "abstol": rtol, "max_num_steps": max_steps}
        self.nominal = plant.vector("state", attribute="nominal")
        self.parameters = plant.vector("parameter")
        self.dae = _dae(plant, u.degree, self.nominal)

    def __call__(self, intervals: int) -> Array | None:
        """States (k + 1, nx) at the grid, or None when the integrator gave up."""
        if intervals == 0:
            return self.x0[None, :]
        end = self.grid[intervals]
        breaks = np.append(self.u.breaks[:-1][self.u.breaks[:-1] < end], end)
        size = np.diff(np.searchsorted(self.grid, breaks - 1e-12 * (1 + np.abs(breaks))))
        control = np.concatenate(
            [
                self.u.breaks[:-1][None, :],
                self.u.coefficients.transpose(1, 2, 0).reshape(-1, len(self.u.breaks) - 1),
            ]
        )[:, : len(size)]
        integrator = ca.integrator(
            "simulate", "rosenbrock", self.dae, self.grid[0], self.grid[1 : intervals + 1].tolist(),
            {**self.options, "control_group_size": size.tolist()},
        )  # fmt: skip
        try:
            result = integrator(x0=self.x0 / self.nominal, p=self.parameters, u=control)["xf"]
        except RuntimeError:
            return None
        states = np.vstack([self.x0, np.asarray(result).T * self.nominal])
        return states if np.all(np.isfinite(states)) else None


def _dae(plant: Plant, degree: int, nominal: Array) -> dict[str, ca.SX]:
    """The plant in scaled states x/nominal, inputs as polynomials of t - (start of the group)."""
    t = ca.SX.sym("t")
    scaled = ca.SX.sym("x", len(nominal))
    control = ca.SX.sym("control", 1 + (degree + 1) * len(plant.inputs))
    coefficients = ca.reshape(control[1:], len(plant.inputs), degree + 1)
    powers = ca.vertcat(*((t - control[0]) ** j for j in range(degree + 1)))
    p = ca.SX.sym("p", len(plant.parameters))
    xdot = plant.function(scaled * nominal, coefficients @ powers, p)[0]
    return {"t": t, "x": scaled, "u": control, "p": p, "ode": xdot / nominal}


def _failure(
    plant: Plant, run: _Run, u: PiecewisePolynomial, grid: Array, done: int
) -> SimulationError:
    states = run(done)
    assert states is not None
    time = float(grid[done])
    at_failure: Mapping[str, float] = dict(
        zip([v.name for v in plant.states], states[-1], strict=True)
    )
    inputs = dict(zip([v.name for v in plant.inputs], u(time)[0], strict=True))
    shown = ", ".join(
        f"{n} = {plant.variable(n).shown(v)}" for n, v in {**at_failure, **inputs}.items()
    )
    part = None
    if done:
        t = grid[: done + 1]
        part = evaluated(plant, t, states, u(t), "previous" if u.degree == 0 else "linear")
    return SimulationError(
        f"the integrator gave up behind t = {time:.6g} s of {grid[-1]:.6g} s, at {shown}; the error's "
        "trajectory holds the part computed so far. Check the inputs and parameters, or allow a "
        "larger rtol or max_steps",
        time,
        part,
    )
