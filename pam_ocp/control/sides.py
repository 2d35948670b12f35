"""The real side of a closed loop: a plant, or an FMU, between two samples."""

from __future__ import annotations

import math
import os
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..core.errors import (
    InputError,
    SimulationError,
    UnknownNameError,
    kind_of,
    require_count,
    require_instance,
    require_positive,
)
from ..core.signals import PiecewisePolynomial
from ..core.trajectory import Trajectory
from ..core.variables import Causality, Variable
from ..plants.inversion import Inversion
from ..plants.plant import Given, Plant, Values, by_name
from ..simulation.instruments import Instrument, readers_of
from ..simulation.integrate import evaluated
from ..simulation.sampled import SampledPlant
from .controller import Observer
from .kinds import Array
from .references import Source, source

ASTRAY = 10.0
"""A state this many times beyond all that is usual for it tells of an unstable loop."""


class Side(ABC):
    """Values by name, inputs to set, time to pass, and at last the motion.

    name : for messages. variables : its states, inputs and outputs. inputs : those that act now,
    at first its start values; to be changed by who runs the loop.
    """

    name: str
    variables: tuple[Variable, ...]
    inputs: dict[str, float]
    measured = False
    """Whether its values are measurements already, to which no noise is added."""

    def __init__(self) -> None:
        self._held_open = ExitStack()
        """What is let go of at the end."""

    def __enter__(self) -> Side:
        return self

    def __exit__(self, *raised: Any) -> None:
        self._held_open.__exit__(*raised)

    @abstractmethod
    def values(self) -> dict[str, float]:
        """States, inputs and outputs at this moment, under the present inputs."""

    @abstractmethod
    def step(self, time: float) -> None:
        """Go from ``time`` [s] one sample on, the inputs held. Raises SimulationError."""

    @abstractmethod
    def trajectory(self) -> Trajectory:
        """The motion so far, with the inputs as they acted."""

    def failure(self, time: float, values: Mapping[str, float], cause: str) -> SimulationError:
        """What happened, where, and why; the controller is blamed only where states went astray."""
        states = [v for v in self.variables if v.causality == "state"]
        at = ", ".join(f"{v.name} = {v.shown(values[v.name])}" for v in states)
        astray = [v.name for v in states if not abs(values[v.name]) <= _farthest(v)]
        verdict = (
            f"{astray[0]} has left its range by far: the closed loop is unstable, change the "
            "controller"
            if astray
            else "the states are still within reach, so look at the cause before the controller"
        )
        reason = " ".join(cause.split())
        return SimulationError(
            f"the closed loop of {self.name!r} cannot be integrated from t = {time:.6g} s on, at "
            f"{at}; {verdict}. Cause: {reason[-300:]}",
            time,
        )


@runtime_checkable
class HasSide(Protocol):
    """What makes a side of its own: a rig."""

    def side(self, sample_time: float, start: Given | None = None) -> Side:
        """The side of one run. start : what it is to begin at, as far as that can be done."""


def side_of(
    real: Plant | HasSide | str | os.PathLike[str],
    model: Plant | None,
    sample_time: float,
    parts: int,
    *,
    parameters: Values | None,
    start: Given | None,
    rtol: float,
) -> Side:
    """The side that a user named: a Plant, the path of an FMU, or what makes its own (a rig).

    model : plant that says of an FMU's variables what they are (None: its own description does).
    parameters, start : that differ from its own. Raises InputError for invalid input.
    """
    remedy = "give a Plant, the path of an FMU, or a Rig"
    require_instance("side", real, (Plant, HasSide, str, os.PathLike), remedy)
    if isinstance(real, HasSide):
        if parameters or parts != 1:
            what = "parameters" if parameters else "parts"
            raise InputError(f"{what}: what is real has none to be set; leave {what} out")
        return real.side(sample_time, start)
    sampling = (sample_time, parts, rtol)
    if isinstance(real, Plant):
        return PlantSide(real, parameters, start, sampling)
    return FmuSide(Path(real), model, parameters, start, sampling)


class PlantSide(Side):
    """A plant, integrated tightly from sample to sample."""

    def __init__(
        self,
        plant: Plant,
        parameters: Values | None,
        start: Given | None,
        sampling: tuple[float, int, float],
    ) -> None:
        super().__init__()
        given = by_name("parameters", parameters)
        wrong = [n for n in given if plant.variable(n).causality != "parameter"]
        if wrong:
            raise InputError(f"parameters: {wrong[0]} is {plant.variable(wrong[0]).kind}")
        self.plant = plant.with_values({**given, **start_values(plant, start)})
        self.name = plant.name
        self.variables = (*plant.states, *plant.inputs, *plant.outputs)
        self.inputs = {v.name: float(v.start or 0.0) for v in self.plant.inputs}
        sample_time, parts, rtol = sampling
        self._sampled = SampledPlant(self.plant, sample_time, rtol, parts)
        self._x, self._p = self.plant.vector("state"), self.plant.vector("parameter")
        self._rows: list[Array] = [self._x[None, :]]
        self._held: list[Array] = []

    def values(self) -> dict[str, float]:
        u = np.array([*self.inputs.values()])
        y = np.asarray(self.plant.function(self._x, u, self._p)[1], dtype=float).ravel()
        numbers = np.concatenate([self._x, u, y]).tolist()
        return {v.name: n for v, n in zip(self.variables, numbers, strict=True)}

    def step(self, time: float) -> None:
        u = np.array([*self.inputs.values()])
        try:
            rows = self._sampled(self._x, u, self._p)
        except RuntimeError as error:
            raise self.failure(time, self.values(), str(error)) from error
        if not np.all(np.isfinite(rows)):
            raise self.failure(time, self.values(), "its states are not finite any more")
        self._rows.append(rows)
        self._held.append(u)
        self._x = rows[-1]

    def trajectory(self) -> Trajectory:
        n, parts, sample_time = len(self._held), self._sampled.parts, self._sampled.sample_time
        breaks = np.asarray(sample_time * np.arange(n + 1))
        inputs = PiecewisePolynomial(breaks, np.array(self._held)[:, None, :])
        grid = np.linspace(0.0, n * sample_time, n * parts + 1)
        return evaluated(self.plant, grid, np.concatenate(self._rows), inputs)


class FmuSide(Side):
    """An FMU in Co-Simulation, which keeps its own states."""

    def __init__(
        self,
        path: Path,
        model: Plant | None,
        parameters: Values | None,
        start: Given | None,
        sampling: tuple[float, int, float],
    ) -> None:
        from ..export.runner import Runner, UnpackedFmu  # FMPy is loaded only when it is needed

        super().__init__()
        if not os.path.isfile(path):
            raise InputError(f"{path}: no such FMU")
        self.name, (self._sample_time, self._parts, rtol) = path.stem, sampling
        self._rows: list[Array] = []
        with ExitStack() as opened:
            folder = opened.enter_context(tempfile.TemporaryDirectory(prefix="pam_ocp_"))
            fmu = UnpackedFmu(path, Path(folder))
            inputs = fmu.names("input")
            self._names = list(dict.fromkeys([*fmu.states, *inputs, *fmu.names("output")]))
            self.variables = tuple(_described(fmu, n, model) for n in self._names)
            needed = () if model is None else (*model.states, *model.inputs)
            for v in needed:
                if v.name not in self._names and not v.disturbance:
                    raise UnknownNameError("variable of the FMU", v.name, self._names)
            self._runner: Any = opened.enter_context(Runner(fmu, "CoSimulation"))
            given = {**by_name("parameters", parameters), **by_name("start", start)}
            if not (start is None or isinstance(start, Mapping)):  # of a point what the FMU has
                given = {n: v for n, v in given.items() if n in {*fmu.states, *inputs}}
            self._runner.initialize({n: float(v) for n, v in given.items()}, 0.0, rtol)
            read = self._runner.get(inputs)
            self.inputs = {n: float(v) for n, v in zip(inputs, read, strict=True)}
            self._held_open = opened.pop_all()

    def values(self) -> dict[str, float]:
        self._runner.set(self.inputs)
        return dict(zip(self._names, self._runner.get(self._names).tolist(), strict=True))

    def step(self, time: float) -> None:
        begin = self.values()
        size = self._sample_time / self._parts
        rows = [np.array([*begin.values()])]
        try:
            for i in range(self._parts):
                self._runner.step(time + i * size, size)
                rows.append(self._runner.get(self._names))
        except Exception as error:  # FMPy raises plain Exceptions
            cause = str(self._runner.failure(error))
            raise self.failure(time, begin, cause) from None
        if not np.all(np.isfinite(rows[-1])):
            raise self.failure(time, begin, "its values are not finite any more")
        self._rows[-1:] = rows  # the first one: this moment under the inputs that act from now on

    def trajectory(self) -> Trajectory:
        data = np.array(self._rows)
        grid = self._sample_time / self._parts * np.arange(len(data))
        columns = {n: data[:, i] for i, n in enumerate(self._names)}
        return Trajectory(grid, columns, self.variables, "previous")


def start_values(plant: Plant, start: Given | None) -> dict[str, Any]:
    """Start values of states and inputs; of an operating point those that the plant has."""
    given = by_name("start", start)
    own = {v.name for v in (*plant.states, *plant.inputs)}
    if start is not None and not isinstance(start, Mapping):
        return {n: v for n, v in given.items() if n in own}
    for name in given:
        variable = plant.variable(name)
        if variable.name not in own:
            raise InputError(f"start: {variable.name} is {variable.kind}; give states and inputs")
    return given


def _described(fmu: Any, name: str, model: Plant | None) -> Variable:
    """A variable as the model has it, or else as the FMU describes it."""
    if model is not None and name in {v.name for v in model.variables}:
        return model.variable(name)
    read = fmu.variables[name]
    causality: Causality = "input" if read.causality == "input" else "output"
    if name in fmu.states:
        causality = "state"
    options: dict[str, Any] = {
        attribute: default if getattr(read, attribute) is None else float(getattr(read, attribute))
        for attribute, default in (("min", -math.inf), ("max", math.inf), ("nominal", 1.0))
    }
    options["description"] = read.description or ""
    try:
        return Variable(name, causality, unit=read.unit or "1", **options)
    except InputError:  # a unit that is not known here is not converted: values stay as they are
        return Variable(name, causality, **options)


def _farthest(state: Variable) -> float:
    """A size that a state never has in use: far beyond its range, its start and its nominal."""
    sizes = (state.nominal, state.start or 0.0, state.min, state.max)
    return ASTRAY * max(abs(s) for s in sizes if math.isfinite(s))


# ---- what acts on the side, and what is measured of it -----------------------------------------
class Actuators:
    """A controller's answer as the side's inputs, within their range."""

    def __init__(self, side: Side, model: Plant | None) -> None:
        self._side = side
        self._known = {v.name: v for v in side.variables}
        self._alias = {n.replace(".", "_"): n for n in self._known}
        self._range = {n: self._known[n] for n in side.inputs}
        self._start = dict(side.inputs)
        inversion = None
        if model is not None and all(v.name in self._range for v in model.inputs):
            inversion = Inversion(model)
        self._inversion = inversion or None

    def known(self, name: str) -> Variable:
        """A variable of the side. Raises UnknownNameError."""
        if self._inversion and (opening := self._inversion.opening_of(name)):
            return self._inversion.inner.variable(opening)
        full = name if name in self._known else self._alias.get(name, name)
        if full not in self._known:
            raise UnknownNameError("variable of the real side", name, self._known)
        return self._known[full]

    def _input(self, name: str) -> Variable:
        variable = self.known(name)
        if variable.name not in self._range:
            raise InputError(
                f"{variable.name} is {variable.kind} of the plant, not an input; its inputs "
                f"are {', '.join(self._range)}"
            )
        return variable

    def disturbances(self, given: Mapping[str, Any]) -> dict[str, Source]:
        """{input: function of time}."""
        found: dict[str, Source] = {}
        for name, value in given.items():
            variable = self._input(name)
            pair = isinstance(value, list | tuple)
            if not callable(value) and not isinstance(value, Mapping):
                size = value[0] if pair and len(value) else value
                variable.check(size, "disturbance")
            before = self._start[variable.name]
            found[variable.name] = source(f"disturbances[{name!r}]", value, variable.unit, before)
        return found

    def __call__(self, t: float, answer: Mapping[str, float]) -> dict[str, float]:
        if not isinstance(answer, Mapping):
            raise InputError(
                f"the controller's answer at t = {t:g} s is {kind_of(answer)}: give "
                f"inputs by name, such as {{{next(iter(self._range), 'name')!r}: 3e5}}"
            )
        if self._inversion:
            seen = None if self._inversion.exact else self._side.values()
            answer = self._inversion.commands(answer, measured=seen)
        found = dict(self._start)
        for name, value in answer.items():
            variable = self._range.get(name) or self._input(name)
            try:
                number = float(value)
            except (TypeError, ValueError):
                raise InputError(
                    f"the controller's answer at t = {t:g} s: {name} = {value!r} is not a number"
                ) from None
            if not np.isfinite(number):
                raise InputError(
                    f"the controller's answer at t = {t:g} s is not finite: {dict(answer)}"
                )
            found[variable.name] = min(max(number, variable.min), variable.max)
        return found


class Sensors:
    """What is measured of the side: all states and outputs by name, by instruments, with noise."""

    def __init__(
        self,
        side: Side,
        estimator: Observer | None,
        noise: Mapping[str, float] | None,
        seed: int,
        instruments: Mapping[str, Instrument] | None = None,
    ) -> None:
        known = {v.name: v for v in side.variables if v.causality in ("state", "output")}
        self.names = [*known]
        alias = {n.replace(".", "_"): n for n in self.names}
        expected = estimator.deviations if estimator is not None else {}
        for name in expected:
            if name not in self.names:
                raise UnknownNameError("measured variable of the real side", name, self.names)
        given = noise if noise is not None else {} if side.measured else expected
        unknown = [n for n in given if alias.get(n, n) not in known]
        if unknown:
            raise InputError(f"noise: {unknown[0]} is not measured; name states or outputs")
        known |= {n: known[full] for n, full in alias.items()}
        self.noise = {
            alias.get(n, n): require_positive(f"noise[{n!r}]", s, known[n].unit, zero=True)
            for n, s in given.items()
        }
        self._random = np.random.default_rng(require_count("seed", seed, 0))
        for name in instruments or {}:
            if name not in known:
                raise UnknownNameError("measured variable of the real side", name, self.names)
        self._readers = readers_of(instruments, known, seed)
        if noise is None:  # an instrument has its own
            self.noise = {n: s for n, s in self.noise.items() if n not in self._readers}

    def __call__(self, t: float, values: Mapping[str, float]) -> dict[str, float]:
        seen = {n: values[n] for n in self.names}
        for name, reader in self._readers.items():
            reader.tell(t, values[name])
            seen[name] = reader.read(t)
        for name, deviation in self.noise.items():
            seen[name] += deviation * float(self._random.standard_normal())
        return seen
