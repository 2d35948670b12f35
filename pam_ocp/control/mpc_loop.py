"""closed_loop: a controller, and an estimator if there is one, against the real side,
step by step.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, UnknownNameError, require_instance, require_positive
from ..core.signals import PiecewisePolynomial
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant, Values
from ..simulation.integrate import Integration
from .estimators.extended_kalman import Estimate, Estimator
from .mpc.mpc import Mpc, MpcStatistics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["ClosedLoop", "closed_loop"]

Array: TypeAlias = NDArray[np.float64]
Real: TypeAlias = "Plant | str | os.PathLike[str]"

LOOKS = 10
"""Steps, evenly spread, whose prediction is compared with a finer integration."""


@dataclass(frozen=True)
class ClosedLoop:
    """What happened in a closed loop, sampled at the controller's steps."""

    trajectory: Trajectory
    """The real side: states, inputs as they were applied, outputs."""
    reference: Trajectory
    """What was to be tracked."""
    estimate: Trajectory | None
    """Estimated states and unknowns, and their ``deviation.NAME``; None without an estimator."""
    statistics: MpcStatistics
    """Times and iterations of the controller, how often it failed, and how often it did not
    converge.
    """
    prediction_error: float
    """Largest :meth:`Mpc.prediction_error` of the steps looked at, ``LOOKS`` of them at most."""

    def steady_error(self, name: str, window: float) -> float:
        """Largest |real - reference| of a variable over the last ``window`` seconds [its unit]."""
        require_positive("window", window, "s")
        t = self.trajectory.t
        late = t >= t[-1] - window
        return float(np.max(np.abs(self.trajectory[name][late] - self.reference[name][late])))

    def plot(self, title: str = "") -> Figure:
        """Tracked variables and their error, inputs, unknowns found, and step times."""
        return courtesy.plot_closed_loop(self, title)

    def __str__(self) -> str:
        return (
            f"closed loop over {self.trajectory.duration:g} s; controller: {self.statistics}; its "
            f"predictions are within {self.prediction_error:.1e} of nominal of a finer integration"
        )


def closed_loop(
    controller: Mpc,
    real: Real,
    reference: Mapping[str, Any],
    duration: float,
    *,
    estimator: Estimator | None = None,
    disturbances: Mapping[str, Any] | None = None,
    noise: Mapping[str, float] | None = None,
    parameters: Values | None = None,
    start: Values | None = None,
    seed: int = 0,
    preview: bool = True,
) -> ClosedLoop:
    """Run a controller against the real side.

    Parameters
    ----------
    controller : an Mpc; it is reset, with the real side's start inputs as those applied before.
    real : a Plant (integrated to 1e-9 between samples), which may differ from the controller's
        model, or the path of an FMU (stepped by FMPy in Co-Simulation); states, inputs and measured
        outputs must have the model's names.
    reference : {tracked name: number or function of time [s]}.
    duration : [s]; a whole number of steps is run.
    estimator : a KalmanFilter or MovingHorizonEstimator with the controller's step; its states and
        unknowns are what the controller is given. Without one the controller sees the true states.
    disturbances : {disturbance input of the real side: number or function of time}; the controller
        is not told.
    noise : {measured variable: standard deviation}; by default what the estimator expects. Normal,
        from ``seed``. Without an estimator it is added to the states.
    parameters, start : parameters, and initial states and inputs, of the real side that differ from
        its own.
    preview : the controller knows the reference over its horizon; False: only its present value.

    Raises InputError for what cannot be meant, SimulationError when the real side stops.
    """
    require_instance("controller", controller, Mpc, "give an Mpc; others are pam.closed_loop's")
    require_instance("real", real, (Plant, str, os.PathLike), "give a Plant, or the path of an FMU")
    require_instance("reference", reference, Mapping, "give {tracked name: number or function}")
    steps = round(require_positive("duration", duration, "s") / controller.step)
    if steps < 1:
        raise InputError(
            f"duration = {duration:g} s is shorter than a step of {controller.step:g} s"
        )
    if estimator is not None and abs(estimator.step - controller.step) > 1e-12:
        raise InputError(
            f"the estimator's step is {estimator.step:g} s, the controller's {controller.step:g} s"
        )
    plant = controller.plant
    sources = {plant.variable(n).name: v for n, v in reference.items()}
    with ExitStack() as stack:
        opened: AbstractContextManager[Any] = (
            _PlantSide(real, parameters, start)
            if isinstance(real, Plant)
            else _FmuSide(Path(real), plant, parameters, start)
        )
        side: _Side = stack.enter_context(opened)
        run = _Run(controller, estimator, side, sources, disturbances or {}, preview)
        run.noise = _noise(plant, estimator, noise)
        run.random = np.random.default_rng(seed)
        controls = set(controller.commands)
        controller.reset({n: v for n, v in side.inputs.items() if n in controls})
        run.applied = {n: v for n, v in side.inputs.items() if n in controls}
        for k in range(steps + 1):
            run.sample(k)
            if k % max(1, steps // LOOKS) == 0:
                run.predicted.append(controller.prediction_error())
            if k < steps:
                side.step(k * controller.step, controller.step)
        return run.result()


class _Side(Protocol):
    """The real side: values by name, inputs to set, and time to pass."""

    variables: tuple[Variable, ...]
    inputs: dict[str, float]

    def values(self) -> dict[str, float]: ...

    def step(self, time: float, size: float) -> None: ...


class _PlantSide:
    """A plant, integrated tightly from sample to sample."""

    def __init__(self, plant: Plant, parameters: Values | None, start: Values | None) -> None:
        self.plant = plant.with_values({**(parameters or {}), **(start or {})})
        self.x = self.plant.vector("state")
        self.inputs = {v.name: float(v.start or 0.0) for v in plant.inputs}
        self.variables = (*plant.states, *plant.inputs, *plant.outputs)

    def __enter__(self) -> _PlantSide:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        pass

    def values(self) -> dict[str, float]:
        u = np.array(list(self.inputs.values()))
        y = np.asarray(self.plant.function(self.x, u, self.plant.vector("parameter"))[1]).ravel()
        numbers = np.concatenate([self.x, u, y])
        return {v.name: float(n) for v, n in zip(self.variables, numbers, strict=True)}

    def step(self, time: float, size: float) -> None:
        u = np.array(list(self.inputs.values()))
        grid = np.array([time, time + size])
        held = PiecewisePolynomial(grid, u[None, None, :])
        run = Integration(self.plant, held, grid, self.x, rtol=1e-9)
        self.x = run.advance(time, self.x, time + size)


class _FmuSide:
    """An FMU in Co-Simulation."""

    def __init__(
        self, path: Path, plant: Plant, parameters: Values | None, start: Values | None
    ) -> None:
        from ..export.runner import Runner, UnpackedFmu  # FMPy is loaded only when it is needed

        if not path.is_file():
            raise InputError(f"{path}: no such FMU")
        self._folder = tempfile.TemporaryDirectory(prefix="pam_ocp_")
        self.fmu = UnpackedFmu(path, Path(self._folder.name))
        inputs = self.fmu.names("input")
        described = {v.name: v for v in plant.variables}
        names = [*self.fmu.states, *inputs, *self.fmu.names("output")]
        self._names = list(dict.fromkeys(names))
        for variable in (*plant.states, *(v for v in plant.inputs if not v.disturbance)):
            if variable.name not in self._names:
                raise UnknownNameError("variable of the FMU", variable.name, self._names)
        self.variables = tuple(
            described.get(n, Variable(n, "input" if n in inputs else "output")) for n in self._names
        )
        self._runner: Any = Runner(self.fmu, "CoSimulation")
        given = {**(parameters or {}), **(start or {})}
        self._runner.initialize({n: float(v) for n, v in given.items()}, 0.0, None)
        read = self._runner.get(inputs)
        self.inputs = {n: float(v) for n, v in zip(inputs, read, strict=True)}

    def __enter__(self) -> _FmuSide:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._runner.__exit__(kind, error, trace)
        self._folder.cleanup()

    def values(self) -> dict[str, float]:
        self._runner.set(self.inputs)
        read = self._runner.get(self._names)
        return {n: float(v) for n, v in zip(self._names, read, strict=True)}

    def step(self, time: float, size: float) -> None:
        self._runner.set(self.inputs)
        try:
            self._runner.step(time, size)
        except Exception as error:  # FMPy raises plain Exceptions
            raise self._runner.failure(error) from None


class _Run:
    """One closed loop under way."""

    noise: dict[str, float]
    random: np.random.Generator
    applied: dict[str, float]

    def __init__(
        self,
        controller: Mpc,
        estimator: Estimator | None,
        side: _Side,
        sources: Mapping[str, Any],
        disturbances: Mapping[str, Any],
        preview: bool,
    ) -> None:
        self.controller, self.estimator, self.side = controller, estimator, side
        self.sources, self.disturbances, self.preview = sources, disturbances, preview
        for name in disturbances:
            if name not in side.inputs:
                raise UnknownNameError("input of the real side", name, side.inputs)
        self.rows: list[dict[str, float]] = []
        self.wanted: list[dict[str, float]] = []
        self.known: list[Estimate] = []
        self.predicted: list[float] = []
        self._names = [v.name for v in controller.plant.states]

    def sample(self, k: int) -> None:
        """Measure, estimate, control; and leave the inputs of the coming step with the
        real side.
        """
        control, now = self.controller, k * self.controller.step
        for name, source in self.disturbances.items():
            self.side.inputs[name] = _at(source, now)
        self.side.inputs.update(self.applied)
        seen = self.side.values()
        state, values = self._known(seen)
        ahead = now + control.step * (control.delay + np.arange(control.horizon + 1))
        if not self.preview:
            ahead = np.full_like(ahead, now)
        reference = {
            n: np.array([_at(s, t) for t in ahead]) if callable(s) else s
            for n, s in self.sources.items()
        }
        chosen = control.control(state, reference, values)
        if not control.delay:
            self.side.inputs.update(chosen)
            seen = self.side.values()
        self.rows.append(seen)
        self.wanted.append({n: _at(s, now) for n, s in self.sources.items()})
        if self.estimator is not None:
            current = chosen if not control.delay else self.applied
            self.estimator.predict(current)
        self.applied = chosen

    def _known(self, seen: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
        """States and unknowns as the controller may know them."""
        noisy = {n: seen[n] + s * self.random.standard_normal() for n, s in self.noise.items()}
        if self.estimator is None:
            return {n: noisy.get(n, seen[n]) for n in self._names}, {}
        measurement = {v.name: noisy.get(v.name, seen[v.name]) for v in self.estimator.measured}
        estimate = self.estimator.correct(measurement, self.applied)
        self.known.append(estimate)
        return estimate.state, estimate.values

    def result(self) -> ClosedLoop:
        t: Array = self.controller.step * np.arange(float(len(self.rows)))
        columns = {v.name: [row[v.name] for row in self.rows] for v in self.side.variables}
        wanted = {n: [row[n] for row in self.wanted] for n in self.sources}
        kinds = [self.controller.plant.variable(n) for n in self.sources]
        return ClosedLoop(
            Trajectory(t, columns, self.side.variables, "previous"),
            Trajectory(t, wanted, kinds, "previous"),
            self._estimates(t) if self.known else None,
            self.controller.statistics,
            max(self.predicted),
        )

    def _estimates(self, t: Array) -> Trajectory:
        plant, variables, columns = self.controller.plant, [], {}
        for name in self.known[0].deviation:
            offset = name.startswith("der(")
            kind = plant.variable(name[4:-1] if offset else name)
            plain = f"offset.{kind.name}" if offset else name
            unit = {"unit": "1" if offset else kind.unit, "nominal": kind.nominal}
            values = [{**e.state, **e.values}[name] for e in self.known]
            for label, column in (
                (plain, values),
                (f"deviation.{plain}", [e.deviation[name] for e in self.known]),
            ):
                variables.append(Variable(label, "output", **unit))  # type: ignore[arg-type]
                columns[label] = column
        return Trajectory(t, columns, variables)


def _at(source: Any, time: float) -> float:
    return float(source(float(time))) if callable(source) else float(source)


def _noise(
    plant: Plant, estimator: Estimator | None, noise: Mapping[str, float] | None
) -> dict[str, float]:
    if noise is None:
        if estimator is None:
            return {}
        spread = zip(estimator.measured, estimator.noise, strict=True)
        return {v.name: float(s) for v, s in spread}
    return {
        plant.variable(n).name: require_positive(f"noise[{n!r}]", s, zero=True)
        for n, s in noise.items()
    }
