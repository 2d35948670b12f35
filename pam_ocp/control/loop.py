"""Closed loop: a sampled controller and the nonlinear plant, or the plant's FMU,
between samples.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, SimulationError, require_count, require_positive
from ..core.signals import PiecewisePolynomial
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.inversion import Inversion
from ..plants.plant import Given, Plant, Values, require_plant
from ..simulation.simulate import evaluated

__all__ = ["Controller", "Measured", "closed_loop"]

ASTRAY = 10.0
"""A state this many times beyond all that is usual for it tells of an unstable loop."""

Array: TypeAlias = NDArray[np.float64]
Measured: TypeAlias = Mapping[str, float]
Stepper: TypeAlias = Callable[[Array, Array], Array]
"""(states, inputs held over the sample) -> states at the end of each part of the sample."""


class Controller(Protocol):
    """What decides the inputs at each sample."""

    def reset(self) -> None:
        """Forget the past: called once before each run."""

    def __call__(self, t: float, measured: Measured) -> Mapping[str, float]:
        """Inputs by name [SI] to hold from t [s] on; those left out stay at their start value.
        Openings of valves (``muscle.opening``) may be answered in place of their commands.

        ``measured`` gives every state and output of the plant by name, with noise where asked for.
        """


def closed_loop(
    plant: Plant,
    controller: Controller | Callable[[float, Measured], Mapping[str, float]],
    *,
    duration: float,
    dt: float = 1e-3,
    start: Given | None = None,
    parameters: Values | None = None,
    disturbances: Mapping[str, Any] | None = None,
    noise: Mapping[str, float] | None = None,
    seed: int = 0,
    delay: int = 0,
    parts: int = 1,
    fmu: str | os.PathLike[str] | None = None,
    rtol: float = 1e-9,
) -> Trajectory:
    """Simulate the nonlinear plant under a sampled controller.

    Parameters
    ----------
    controller : a Controller, or a function (t, measured) -> inputs; called every ``dt`` seconds;
        its inputs are held until the next call and kept within the plant's range (the result shows
        them as the plant gets them).
    start : initial states by name; by default the states' start values.
    parameters : of the true plant, which the controller does not know.
    disturbances : {input: number | function of time}, held over each sample as all inputs are.
    noise : {measured name: standard deviation [SI]}, normal and white, from ``seed``.
    delay : samples between measuring and acting (computing time); before the first, start values.
    parts : samples recorded per ``dt``.
    fmu : path of the plant's FMU (:func:`pam_ocp.export_fmu`) to be the plant instead, by
        co-simulation; outputs are still those of the plant at the FMU's states.
    rtol : relative tolerance of the integrator (CasADi's Rosenbrock), per nominal; the FMU has its
        own, of which ``rtol`` is asked for.

    Raises InputError for bad arguments, SimulationError where the plant cannot be integrated.
    """
    require_plant(plant)
    samples = _samples(controller, duration, dt, parts, delay)
    true = _true_plant(plant, parameters)
    acting = _Inputs(true, disturbances or {})
    sense = _Sensors(true, noise or {}, seed)
    x = true.vector("state", start)
    u = acting(0.0, {})
    waiting = [u] * delay
    rows, held = [x[None, :]], []
    if hasattr(controller, "reset"):
        controller.reset()
    with _stepper(true, x, dt, parts, fmu, rtol) as step:
        for k in range(samples):
            t = k * dt
            asked = acting(t, controller(t, sense(x, u)))
            waiting.append(asked)
            u = acting.disturbed(t, waiting.pop(0))
            try:
                new = step(x, u)
            except RuntimeError as error:
                raise _failure(true, t, x, str(error)) from error
            if not np.all(np.isfinite(new)):
                raise _failure(true, t, x, "its states are not finite any more")
            rows.append(new)
            held.append(u)
            x = new[-1]
    inputs = PiecewisePolynomial(
        np.asarray(dt * np.arange(samples + 1)), np.array(held)[:, None, :]
    )
    grid = np.linspace(0.0, samples * dt, samples * parts + 1)
    return evaluated(true, grid, np.concatenate(rows), inputs)


def _samples(controller: Any, duration: float, dt: float, parts: int, delay: int) -> int:
    """How many there are; InputError for arguments that cannot be."""
    if not callable(controller):
        raise InputError(
            f"controller is a {type(controller).__name__}, which is not called with (t, "
            "measured); an "
            "Mpc has its own loop, mpc.closed_loop(...)"
        )
    require_positive("dt", dt, "s")
    samples = round(require_positive("duration", duration, "s") / dt)
    require_count("parts", parts)
    require_count("delay", delay, 0)
    if samples < 1:
        raise InputError(f"duration = {duration:g} s: give at least one sample of dt = {dt:g} s")
    return samples


def _true_plant(plant: Plant, parameters: Values | None) -> Plant:
    wrong = [n for n in parameters or {} if plant.variable(n).causality != "parameter"]
    if wrong:
        raise InputError(f"parameters: {wrong[0]} is a {plant.variable(wrong[0]).causality}")
    return plant.with_values(parameters or {})


def _failure(plant: Plant, t: float, x: Array, cause: str) -> SimulationError:
    """What happened, where, and why; the controller is blamed only where the states went astray."""
    at = ", ".join(f"{v.name} = {v.shown(n)}" for v, n in zip(plant.states, x, strict=True))
    astray = [v.name for v, n in zip(plant.states, x, strict=True) if abs(n) > _farthest(v)]
    verdict = (
        f"{astray[0]} has left its range by far: the closed loop is unstable, change the controller"
        if astray
        else "the states are still within reach, so look at the cause before the controller"
    )
    reason = " ".join(cause.split())
    return SimulationError(
        f"the closed loop of {plant.name!r} cannot be integrated from t = {t:.6g} s on, at {at}; "
        f"{verdict}. Cause: {reason[-300:]}",
        t,
    )


def _farthest(state: Variable) -> float:
    """A size that a state never has in use: far beyond its range, its start and its nominal."""
    sizes = (state.nominal, state.start or 0.0, state.min, state.max)
    return ASTRAY * max(abs(s) for s in sizes if math.isfinite(s))


class _Inputs:
    """A controller's answer as the vector of the plant's inputs, within their range."""

    def __init__(self, plant: Plant, disturbances: Mapping[str, Any]) -> None:
        self.plant = plant
        self.start, self.low, self.high = (
            plant.vector("input", attribute=a) for a in ("start", "min", "max")
        )
        self.index = {v.name: i for i, v in enumerate(plant.inputs)}
        self.inversion = Inversion(plant)
        self.disturbances = [
            (self._position(n), v if callable(v) else plant.variable(n).check(v, "disturbance"))
            for n, v in disturbances.items()
        ]

    def _position(self, name: str) -> int:
        variable = self.plant.variable(name)
        if variable.name not in self.index:
            raise InputError(
                f"{variable.name} is a {variable.causality} of the plant, not an input; its inputs "
                f"are {', '.join(self.index)}"
            )
        return self.index[variable.name]

    def __call__(self, t: float, answer: Mapping[str, float]) -> Array:
        u = self.start.copy()
        if not isinstance(answer, Mapping):
            raise InputError(
                f"the controller's answer at t = {t:g} s is a {type(answer).__name__}: give "
                "inputs by "
                f"name, such as {{{next(iter(self.index), 'name')!r}: 3e5}}"
            )
        if self.inversion:
            answer = self.inversion.commands(answer)
        for name, value in answer.items():
            i = self.index[name] if name in self.index else self._position(name)
            try:
                u[i] = value
            except (TypeError, ValueError):
                raise InputError(
                    f"the controller's answer at t = {t:g} s: {name} = {value!r} is not a number"
                ) from None
        if not np.all(np.isfinite(u)):
            raise InputError(
                f"the controller's answer at t = {t:g} s is not finite: {dict(answer)}"
            )
        return np.asarray(np.clip(u, self.low, self.high))

    def disturbed(self, t: float, u: Array) -> Array:
        u = u.copy()
        for i, value in self.disturbances:
            u[i] = value(t) if callable(value) else value
        return u


class _Sensors:
    """All states and outputs by name, with noise."""

    def __init__(self, plant: Plant, noise: Mapping[str, float], seed: int) -> None:
        self.plant, self.p = plant, plant.vector("parameter")
        self.names = [v.name for v in (*plant.states, *plant.outputs)]
        named = {
            plant.variable(n).name: require_positive(f"noise[{n!r}]", s, zero=True)
            for n, s in noise.items()
        }
        unknown = [n for n in named if n not in self.names]
        if unknown:
            raise InputError(f"noise: {unknown[0]} is not measured; name states or outputs")
        self.sigma = np.array([named.get(n, 0.0) for n in self.names])
        self.random = np.random.default_rng(seed)

    def __call__(self, x: Array, u: Array) -> Measured:
        y = np.asarray(self.plant.function(x, u, self.p)[1], dtype=float).ravel()
        values = np.concatenate([x, y])
        if self.sigma.any():
            values = values + self.sigma * self.random.standard_normal(len(values))
        return dict(zip(self.names, values.tolist(), strict=True))


# ---- the plant between two samples --------------------------------------------------------------
def _stepper(
    plant: Plant, x: Array, dt: float, parts: int, fmu: str | os.PathLike[str] | None, rtol: float
) -> AbstractContextManager[Stepper]:
    if fmu is not None:
        return _fmu(plant, x, Path(fmu), dt, parts, rtol)
    return _integrator(plant, dt, parts, rtol)


@contextmanager
def _integrator(plant: Plant, dt: float, parts: int, rtol: float) -> Iterator[Stepper]:
    """CasADi's Rosenbrock over one sample, in states scaled by nominals."""
    nominal, p = plant.vector("state", attribute="nominal"), plant.vector("parameter")

    def build() -> ca.Function:
        x = ca.SX.sym("x", len(nominal))
        u, parameters = ca.SX.sym("u", len(plant.inputs)), ca.SX.sym("p", len(p))
        ode = plant.function(x * nominal, u, parameters)[0] / nominal
        options = {"reltol": rtol, "abstol": rtol}
        dae = {"x": x, "p": ca.vertcat(parameters, u), "ode": ode}
        times = [dt * (i + 1) / parts for i in range(parts)]
        return ca.integrator("sample", "rosenbrock", dae, 0.0, times, options)

    integrator = plant.cached(("closed loop", dt, parts, rtol, nominal.tobytes()), build)

    def step(x: Array, u: Array) -> Array:
        end = integrator(x0=x / nominal, p=np.concatenate([p, u]))["xf"]
        return np.asarray(np.asarray(end).T * nominal)

    yield step


@contextmanager
def _fmu(
    plant: Plant, x: Array, path: Path, dt: float, parts: int, rtol: float
) -> Iterator[Stepper]:
    """Co-simulation of the plant's FMU, which keeps its own states."""
    from ..export.runner import Runner, UnpackedFmu

    states, inputs = [v.name for v in plant.states], [v.name for v in plant.inputs]
    time = 0.0
    with tempfile.TemporaryDirectory() as folder:
        unpacked = UnpackedFmu(path, Path(folder))
        with Runner(unpacked, "CoSimulation") as run:
            values = {v.name: float(v.start or 0.0) for v in plant.parameters}
            run.initialize({**values, **dict(zip(states, x.tolist(), strict=True))}, time, rtol)

            def step(x: Array, u: Array) -> Array:
                nonlocal time
                run.set(dict(zip(inputs, u.tolist(), strict=True)))
                rows = []
                for _ in range(parts):
                    run.step(time, dt / parts)
                    time += dt / parts
                    rows.append(run.get(states))
                return np.array(rows)

            yield step
