"""Closed loop: any sampled controller, with an estimator if there is one, against a real side."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from .. import courtesy
from ..core.errors import (
    InputError,
    SimulationError,
    UnknownNameError,
    kind_of,
    require_count,
    require_instance,
    require_positive,
    require_tolerance,
)
from ..core.files import read_npz, reading, require_format, write_npz
from ..core.quantities import outside
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..judge.loop import LoopVerdict, judge_loop
from ..plants.plant import Given, Plant, Values
from ..plants.plant_data import SYSTEM, carried, plant_of_data
from ..simulation.instruments import Instrument
from .controller import Controller, Estimate, Measured, Observer, Tracking, counted
from .kinds import Array
from .mpc_statistics import MpcStatistics, MpcStep
from .references import Source, source
from .sides import Actuators, HasSide, PlantSide, Sensors, Side, side_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Law: TypeAlias = "Controller | Tracking | Callable[[float, Measured], Mapping[str, float]]"

SAMPLE_TIME = 1e-3
"""[s], for a controller that has none of its own."""
MOST_SAMPLES = 100_000_000
"""Of a run; a duration of more is a slip."""
LOOKS = 10
"""Samples, evenly spread, whose prediction is compared with a finer integration."""
FORMAT = "pam_ocp closed loop 1"
PARTS = ("seen", "reference", "estimate")
"""Trajectories in the file of a loop, besides its motion."""


@shown
@dataclass(frozen=True)
class ClosedLoop:
    """What happened in a closed loop. ``loop["x"]`` and ``loop.t`` are those of its trajectory.

    Examples
    --------
    >>> law = pam.lqr(plant, point, integral={"x": 100.0})
    >>> loop = pam.closed_loop(law, plant, {"x": 0.042}, duration=1.0, start=point)
    >>> abs(loop.steady_error("x", 0.9)) < 1e-5
    False
    """

    trajectory: Trajectory
    """The real side: states, inputs as they were applied, outputs."""
    seen: Trajectory
    """What the controller was given at each sample, and at the end."""
    reference: Trajectory | None
    """What was to be reached, at the times of ``trajectory``; None where the loop is not told."""
    estimate: Trajectory | None
    """Estimated states and unknowns, and their ``deviation.NAME``; None without an estimator."""
    statistics: MpcStatistics | None
    """Times and iterations of the controller, how often it failed, and how often it did not
    converge; None for controllers that keep none.
    """
    prediction_error: float | None
    """Largest :meth:`Mpc.prediction_error` of the samples looked at, ``LOOKS`` of them at most."""
    verdict: LoopVerdict = field(default_factory=LoopVerdict)
    """Whether it did what it was asked: ``bool(loop.verdict)``, and in words."""
    plant: Plant | None = None
    """The real side with its values, where that is a plant."""
    delay: int = 0
    """Samples from measuring to acting."""
    designed_delay: int = 0
    """Those that the controller is designed for."""

    def __getitem__(self, name: str) -> Array:
        return self.trajectory[name]

    @property
    def t(self) -> Array:
        """Times of the trajectory [s]."""
        return self.trajectory.t

    def steady_error(self, name: str, window: float) -> float:
        """Largest |real - reference| of a variable over the last ``window`` seconds [its unit].

        Raises InputError where the loop was not told what is to be reached.
        """
        window = require_positive("window", window, "s")
        if self.reference is None:
            raise InputError("steady_error: the loop knows no reference; give closed_loop one")
        late = self.t >= self.t[-1] - window
        return float(np.max(np.abs(self[name][late] - self.reference[name][late])))

    def plot(self, title: str = "") -> Figure:
        """Tracked variables and their error, inputs, unknowns found, and step times."""
        return courtesy.plot_closed_loop(self, title)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all of it to ``.npz``, or the trajectory alone to ``.csv`` or ``.parquet``.

        See :meth:`Trajectory.save`; :meth:`Trajectory.load` reads the motion from each of them.
        """
        if Path(path).suffix.lower() != ".npz":
            return self.trajectory.save(path)
        content, arrays = self.trajectory._packed()  # so that it is a file of the motion, too
        content |= {"format": FORMAT, "prediction_error": self.prediction_error, "parts": {}}
        content |= carried(self.plant)
        content["verdict"] = asdict(self.verdict)
        content["late"] = [self.delay, self.designed_delay]
        steps = None if self.statistics is None else [asdict(s) for s in self.statistics.steps]
        content["steps"] = steps
        content["dropped"] = {} if self.statistics is None else dict(self.statistics.dropped)
        for name in PARTS:
            part: Trajectory | None = getattr(self, name)
            if part is not None:
                content["parts"][name], columns = part._packed()
                arrays |= {f"{name}_{key}": array for key, array in columns.items()}
        return write_npz(path, content, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ClosedLoop:
        """Read what :meth:`save` wrote to ``.npz``. Raises InputError for any other file."""
        kind = "a closed loop"
        content, arrays = read_npz(path, kind)
        require_format(path, content, kind, FORMAT, "ClosedLoop.save() writes one")
        with reading(path, kind, "give one that ClosedLoop.save() wrote"):
            parts: dict[str, Any] = dict.fromkeys(PARTS)
            for name, part in content["parts"].items():
                data = arrays[f"{name}_t"], arrays[f"{name}_data"]
                parts[name] = Trajectory._from_meta(part, *data)
            steps, dropped = content["steps"], content.get("dropped", {})
            delay, designed = content.get("late", (0, 0))
            # files of 0.2 and before have no verdict
            verdict: dict[str, Any] = {
                n: tuple(v) if isinstance(v, list) else v
                for n, v in content.get("verdict", {}).items()
            }
            return cls(
                Trajectory._from_meta(content, arrays["t"], arrays["data"]),
                **parts,
                statistics=steps and MpcStatistics(tuple(MpcStep(**s) for s in steps), dropped),
                prediction_error=content["prediction_error"],
                verdict=LoopVerdict(**verdict),
                plant=plant_of_data(content[SYSTEM]) if SYSTEM in content else None,
                delay=delay,
                designed_delay=designed,
            )

    def __str__(self) -> str:
        said = [f"closed loop over {self.trajectory.duration:g} s, {self.verdict}"]
        if self.statistics is not None:
            said.append(f"controller: {self.statistics}")
        if self.delay or self.designed_delay:
            said.append(_lateness(self.delay, self.designed_delay, self.seen.t[1]))
        if self.prediction_error is not None:
            said.append(
                f"its predictions are within {self.prediction_error:.1e} (scaled by nominals) of "
                "a finer integration"
            )
        return "; ".join(said)


@verb
def closed_loop(
    controller: Law,
    side: Plant | HasSide | str | os.PathLike[str],
    reference: Mapping[str, Any] | None = None,
    *,
    duration: float,
    sample_time: float | None = None,
    estimator: Observer | None = None,
    start: Given | None = None,
    parameters: Values | None = None,
    disturbances: Mapping[str, Any] | None = None,
    noise: Mapping[str, float] | None = None,
    sensors: Mapping[str, Instrument] | None = None,
    seed: int = 0,
    delay: int | None = None,
    parts: int = 1,
    preview: bool = True,
    plant: Plant | None = None,
    rtol: float = 1e-9,
    time_limit: float | None = None,
) -> ClosedLoop:
    """Run a sampled controller against the real side, which it may not know well.

    Parameters
    ----------
    controller : a Controller (``lqr``, ``tvlqr``, ``PositionController``, ``Mpc``, ...), or a
        function (t, measured) -> inputs. Called at each sample; its inputs are held until the next
        and kept within the side's range (the result shows them as they act).
    side : a Plant, or the path of an FMU (Co-Simulation by FMPy), which may differ from the
        controller's model; or a :class:`pam_ocp.Rig`, on which it then runs in real time.
    reference : {name: number, function of time [s], or {"stops": [...], "dwell": ...}} for
        controllers that are told what to reach (Mpc; lqr for what it integrates); others have
        theirs. ``preview`` False: of it they know only the present value.
    duration : [s]; a whole number of samples is run.
    sample_time : [s]; by default the controller's own, or the estimator's, or 1 ms.
    estimator : a KalmanFilter, a MovingHorizonEstimator, or what ``kalman`` gives, with the same
        sample time. The controller is given its states and unknowns, and what is measured besides.
        Without one it is given all states and outputs.
    start : initial states and inputs by name, or an operating point; by default the side's own. A
        rig is brought to its inputs softly.
    parameters : of the real side, where they differ from its own; the controller is not told.
    disturbances : {input of the side: number, function of time, or (value, from when on [s])}, held
        over each sample; the controller is not told.
    noise : {measured name: standard deviation [SI]}, normal and white, from ``seed``. By default
        what the estimator expects, or none; none of a rig, which has its own.
    sensors : {measured name: Instrument}: bias, drift, steps, filter, sample and hold, delay. Its
        noise takes the place of what the estimator expects; ``noise`` comes on top.
    delay : samples between measuring and acting (computing time); before the first, start values.
        By default what the controller is designed for (``Mpc(delay=1)``), or 0. 1 is that of
        a system of :func:`pam_ocp.export.export_ssp`.
    parts : samples recorded per ``sample_time``.
    plant : model that says of an FMU's variables what they are (ranges, openings of valves); by
        default the controller's. Without one the FMU's own description does.
    rtol : relative tolerance of the side's integrator, per nominal; FMUs are asked for it.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError for invalid input, SimulationError when the side cannot go on. Warns
    once, in the words of ``loop.verdict``, where the loop did not do what it was asked: set points
    missed by over 1 % of the stroke and 0.2 % of nominal (over the last tenth of the run), limits
    broken, over 20 % of a solver's calls not converged or any failed, predictions over a sample
    that miss over 25 % of its changes, inputs without influence; and where ``delay`` is not what
    the controller is designed for, with the distance from a run (not on a rig) with that delay.

    Examples
    --------
    >>> law = pam.lqr(plant, point, integral={"x": 100.0})
    >>> loop = pam.closed_loop(law, plant, {"x": 0.042}, duration=1.0, start=point)
    >>> print(f"{loop['x'][-1]:.4f}")
    0.0420
    >>> bool(loop.verdict)
    True
    """
    _require_controller(controller, plant)
    if estimator is not None and not hasattr(estimator, "deviations"):
        raise InputError(
            f"estimator is {kind_of(estimator)}: give an estimator, such as a KalmanFilter"
        )
    own = getattr(side, "sample_time", None) if isinstance(side, HasSide) else None
    sample_time = _sample_time(controller, estimator, sample_time, own)
    samples = round(require_positive("duration", duration, "s") / sample_time)
    require_count("parts", parts)
    designed = getattr(controller, "delay", 0)
    waits = require_count("delay", designed if delay is None else delay, 0)
    if samples > MOST_SAMPLES:
        raise InputError(
            f"duration = {duration:g} s is {samples:.3g} samples of {sample_time:g} s: give at "
            f"most {MOST_SAMPLES:g}"
        )
    if samples < 1:
        raise InputError(
            f"duration = {duration:g} s is shorter than a sample of {sample_time:g} s: give at "
            "least one sample"
        )
    require_tolerance("rtol", rtol)
    model = plant or getattr(controller, "plant", None)

    def run_with(late: int) -> ClosedLoop:
        chosen = side_of(
            side, model, sample_time, parts, parameters=parameters, start=start, rtol=rtol
        )
        with chosen as real:
            inputs = Actuators(real, chosen.plant if isinstance(chosen, PlantSide) else model)
            told = {}
            for name, value in (reference or {}).items():
                variable = inputs.known(name)
                told[variable.name] = at = source(f"reference[{name!r}]", value, variable.unit)
                if not callable(value):
                    variable.check(at(0.0), "reference")
            run = _Run(
                _told(controller, told, real, preview),
                estimator,
                real,
                inputs,
                Sensors(real, estimator, noise, seed, sensors),
                inputs.disturbances(disturbances or {}),
                [dict(real.inputs)] * late,
            )
            for k in range(samples):
                run.sample(k * sample_time, look=k % max(1, samples // LOOKS) == 0)
                real.step(k * sample_time)
            run.measure(samples * sample_time)
            return replace(run.result(sample_time, told), delay=late, designed_delay=designed)

    mismatch = waits != getattr(controller, "delay", waits)
    try:  # first, since the controller is left as the run that was asked for leaves it
        other = None if isinstance(side, HasSide) or not mismatch else run_with(designed)
    except SimulationError:
        other = None
    found = run_with(waits)
    if mismatch:
        cost = "" if other is None else f" ({_cost(found, other)})"
        warnings.warn(
            f"closed loop: {_lateness(waits, designed, sample_time)}{cost}; design it for "
            f"delay = {waits}, or run it with delay = {designed}",
            stacklevel=outside(),
        )
    if not found.verdict:
        warnings.warn(f"closed loop: {found.verdict}", stacklevel=outside())
    return found


def _lateness(delay: int, designed: int, sample_time: float) -> str:
    if not delay:
        return f"inputs act at once, but the controller is designed for a delay of {designed}"
    samples = f"{delay} sample{'s' * (delay > 1)} ({1e3 * delay * sample_time:g} ms)"
    known = "as" if delay == designed else f"not {designed} as"
    return f"inputs act {samples} after the measurement, {known} the controller is designed for"


def _cost(found: ClosedLoop, other: ClosedLoop) -> str:
    """What lateness moves most of what has a reference, else of all, scaled by nominals."""
    names = other.reference.names if other.reference is not None else found.trajectory.names
    variables = [found.trajectory.variable(n) for n in names]
    off = [float(np.max(np.abs(found[v.name] - other[v.name]))) for v in variables]
    worst = int(np.argmax([d / v.nominal for d, v in zip(off, variables, strict=True)]))
    name, most = variables[worst].name, variables[worst].shown
    return f"{name} is up to {most(off[worst])} from where it would be without that mismatch"


def _require_controller(controller: Any, plant: Any) -> None:
    if isinstance(controller, Plant):
        raise InputError(
            "controller is a Plant: the controller comes first, closed_loop(controller, side)"
        )
    if not callable(controller) and not isinstance(controller, Tracking):
        raise InputError(
            f"controller is {kind_of(controller)}, which is not called with (t, measured); "
            "give a controller, or a function"
        )
    require_instance("plant", plant, Plant, "give the Plant that the FMU is of", none=True)


def _sample_time(
    controller: Any, estimator: Any, given: float | None, usual: float | None = None
) -> float:
    """The loop's. InputError where somebody in it counts another one."""
    own = getattr(controller, "sample_time", None)
    other = getattr(estimator, "sample_time", None)
    first = next((t for t in (given, own, other) if t is not None), usual or SAMPLE_TIME)
    chosen = require_positive("sample_time", first, "s")
    for who, time in {"estimator": other, "controller": counted(controller)}.items():
        if time is not None and abs(time - chosen) > 1e-9 * chosen:
            raise InputError(
                f"the {who}'s sample_time is {time:g} s, the loop's {chosen:g} s: make both equal"
            )
    return chosen


def _told(controller: Any, told: Mapping[str, Source], side: Side, preview: bool) -> Any:
    """The controller of this run, which knows what to reach."""
    if isinstance(controller, Tracking) and (told or not callable(controller)):
        return controller.tracking(told, side.inputs, preview)
    if told:
        raise InputError(
            f"reference: {kind_of(controller)} is not told by the loop what to reach; give "
            "its reference to it"
        )
    return controller


@dataclass
class _Run:
    """One closed loop under way."""

    controller: Any
    estimator: Observer | None
    side: Side
    inputs: Actuators
    sensors: Sensors
    disturbances: Mapping[str, Source]
    waiting: list[dict[str, float]]

    def __post_init__(self) -> None:
        self.seen: list[dict[str, float]] = []
        self.known: list[Estimate] = []
        self.predicted: list[float] = []
        self.expected: list[Mapping[str, float]] = []
        self._controls = dict(self.side.inputs)
        if hasattr(self.controller, "reset"):  # a function has none
            self.controller.reset()
        if self.estimator is not None:
            self.estimator.reset()

    def measure(self, t: float) -> dict[str, float]:
        """What the controller is given at this moment, the inputs before still acting."""
        for name, acts in self.disturbances.items():
            self.side.inputs[name] = acts(t)
        measured = self.sensors(t, self.side.values())
        if self.estimator is not None:
            names = self.estimator.deviations
            self.estimator.correct({n: measured[n] for n in names}, self._controls)
            estimate = self.estimator.estimate
            self.known.append(estimate)
            measured = {n: measured[n] for n in names} | estimate.values | estimate.state
        self.seen.append(measured)
        return measured

    def sample(self, t: float, look: bool) -> None:
        """Measure, estimate, control; and leave the inputs of the coming sample with the side."""
        measured = self.measure(t)
        try:
            wanted = self.controller(t, measured)
        except KeyError as error:
            name = error.args[0] if error.args else None
            if not isinstance(name, str) or name in measured:
                raise
            raise UnknownNameError(
                "measurement that the controller asks for", name, measured
            ) from error
        asked = self.inputs(t, wanted)
        if hasattr(self.controller, "expected"):
            self.expected.append(self.controller.expected())
        self.waiting.append(asked)
        self._controls = self.waiting.pop(0)
        disturbed = {n: self.side.inputs[n] for n in self.disturbances}
        self.side.inputs.update({**self._controls, **disturbed})
        if self.estimator is not None:
            self.estimator.predict(self._controls)
        if look and hasattr(self.controller, "prediction_error"):
            self.predicted.append(self.controller.prediction_error())

    def result(self, sample_time: float, told: Mapping[str, Source]) -> ClosedLoop:
        motion = self.side.trajectory()
        t = sample_time * np.arange(float(len(self.seen)))
        model = () if self.estimator is None else self.estimator.plant.variables
        variables = {v.name: v for v in (*model, *self.side.variables)}
        reference = self._told(motion, getattr(self.controller, "wanted", None))
        return ClosedLoop(
            motion,
            _seen(t, self.seen, variables),
            reference,
            self._estimates(t, variables) if self.known else None,
            getattr(self.controller, "statistics", None),
            max(self.predicted) if self.predicted else None,
            self._verdict(motion, reference, sample_time),
            getattr(self.side, "plant", None),
        )

    def _told(self, motion: Trajectory, wanted: Any) -> Trajectory | None:
        """What a controller says that is to be reached, at the times of the motion."""
        if wanted is None or not wanted(0.0):
            return None
        rows = [wanted(float(t)) for t in motion.t]
        return Trajectory(motion.t, _columns(rows), [self.inputs.known(n) for n in rows[0]])

    def _verdict(
        self, motion: Trajectory, reference: Trajectory | None, sample_time: float
    ) -> LoopVerdict:
        aims = getattr(self.controller, "aims", None)
        wanted = reference if aims is None else self._told(motion, aims)
        noise = dict(self.sensors.noise)
        for name in self.known[0].deviation if self.known else ():
            noise[name] = max(float(np.mean([e.deviation[name] for e in self.known])), 0.0)
        statistics = getattr(self.controller, "statistics", None)
        names = [n for n in (self.expected[0] if self.expected else ()) if n in motion]
        return judge_loop(
            motion,
            wanted=wanted,
            inputs=[n for n in self._controls if n not in self.disturbances],
            limits={
                n: ends for n, ends in getattr(self.controller, "limits", {}).items() if n in motion
            },
            noise=noise,
            calls=None if statistics is None else statistics.counts,
            predicted={n: [row[n] for row in self.expected] for n in names},
            sample_time=sample_time,
            idle=getattr(self.controller, "idle", ()),
            behind=_behind(self.controller),
        )

    def _estimates(self, t: Array, known: Mapping[str, Variable]) -> Trajectory:
        columns, variables = {}, []
        for name in self.known[0].deviation:
            offset = name.startswith("der(")
            kind = known.get(name[4:-1] if offset else name)
            plain = _plain(name)
            unit = "1" if offset or kind is None else kind.unit
            nominal = 1.0 if kind is None else kind.nominal
            values = [{**e.state, **e.values}[name] for e in self.known]
            deviations = [e.deviation[name] for e in self.known]
            for label, column in ((plain, values), (f"deviation.{plain}", deviations)):
                variables.append(Variable(label, "output", unit=unit, nominal=nominal))
                columns[label] = column
        return Trajectory(t, columns, variables)


def _behind(controller: Any) -> list[str]:
    """Commands that a controller sends through a dead zone behind something that moves."""
    inversion = getattr(controller, "inversion", None)
    if inversion is None or inversion.exact:
        return []
    return [n for o in inversion.plant.openings if o.carried for n in o.commands]


def _columns(rows: list[dict[str, float]]) -> dict[str, list[float]]:
    return {n: [row[n] for row in rows] for n in rows[0]}


def _plain(name: str) -> str:
    """A name for a column: an estimated offset, der(STATE), is offset.STATE."""
    return f"offset.{name[4:-1]}" if name.startswith("der(") else name


def _seen(t: Array, rows: list[dict[str, float]], known: Mapping[str, Variable]) -> Trajectory:
    variables = [known.get(n) or Variable(_plain(n), "output") for n in rows[0]]
    columns = {_plain(n): column for n, column in _columns(rows).items()}
    return Trajectory(t, columns, variables, "previous")
