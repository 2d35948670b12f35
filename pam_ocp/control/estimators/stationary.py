"""Kalman filter about a stop, and state feedback from its estimate (LQG)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, require_count, require_instance, require_positive
from ...core.stop import verb
from ...core.variables import Variable
from ...numerics.solvers import Buffered
from ...operating.linear import gramian, held, inside, linear_model
from ...operating.operating_point import Stuck
from ...operating.resting_point import OperatingPoint
from ...plants.inversion import Inversion
from ...plants.plant import Plant, Values, require_plant
from ..blocks.chain import chain
from ..blocks.draft import Draft, clipped, opened_by
from ..blocks.running import Running
from ..controller import Controller, Estimate, Measured, counted
from ..kinds import BLOCKS, LARGEST, Array, law_of


@dataclass(eq=False)
class StationaryFilter:
    """Estimate of all states from a few measured outputs, by the plant's linear model at a point.

    gain : (states and disturbances, measured), stationary. In each sample: ``correct(measured)``,
    then ``predict(inputs)`` to the next one. ``disturbance`` : {input: estimate} of those
    estimated.
    inversion : for a plant fed by valves, whose openings are the linear model's inputs: ``predict``
    takes commands (or openings), and an estimated offset is one of the opening.

    Examples
    --------
    >>> filter = pam.control.kalman(plant, point, measured={"x": 1e-4}, sample_time=0.01)
    >>> filter.reset()
    >>> estimate = filter.correct({"x": 0.041})
    >>> bool(estimate[0] > point["x"])
    True
    """

    point: OperatingPoint
    measured: list[str]
    gain: Array
    sample_time: float
    system: Any = field(repr=False)
    """python-control's sampled system, x[k+1] = A x[k] + B u[k]; disturbances are its last states.
    """
    disturbances: list[str] = field(default_factory=list)
    inversion: Inversion | None = field(default=None, repr=False)
    noise: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    """Standard deviations of what is measured [SI]."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    """Of states and disturbances after a correction [SI], stationary."""

    def __post_init__(self) -> None:
        plant = self.point.plant
        self._states = [v.name for v in plant.states]
        self._inputs = [(v.name, v.start or 0.0) for v in plant.inputs]
        self._x = self.point.x
        self._disturbed = {n: float(self.point[n]) for n in self.disturbances}
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).tolist()
        self._spread = dict(zip([*self._states, *self.disturbances], spread, strict=False))
        whole = self.inversion.plant.inputs if self.inversion else ()
        self._commands = [v.name for v in whole if not v.disturbance]
        self.reset()

    def reset(self) -> None:
        """Back to the point itself."""
        self.deviation: Array = np.zeros(len(self.system.A))
        self._u: Array = np.zeros(len(self._inputs))

    @property
    def plant(self) -> Plant:
        """Its model."""
        return self.point.plant

    @property
    def deviations(self) -> dict[str, float]:
        """{measured state or output: standard deviation of its noise [SI]}."""
        return dict(zip(self.measured, self.noise.tolist(), strict=True))

    @property
    def estimate(self) -> Estimate:
        """The present knowledge."""
        return Estimate(self.state, self.disturbance, dict(self._spread))

    @property
    def state(self) -> dict[str, float]:
        """The estimated states by name [SI]."""
        x = self._x + self.deviation[: len(self._x)]
        if self.inversion:
            x = self.inversion.inside(x, inwards=False)
        return dict(zip(self._states, x.tolist(), strict=True))

    def correct(self, measured: Measured, inputs: Mapping[str, float] | None = None) -> Array:
        """The estimated states (nx,) after a measurement; what is not named, NaN or infinite is
        missing, and corrects nothing.

        Inputs that act while it is measured are those of the last :meth:`predict`.
        """
        y = [measured.get(n, math.nan) for n in self.measured]
        self.deviation = self._correct(self.deviation, self._u, y)[0][:, 0].copy()
        return np.asarray(self._x + self.deviation[: len(self._x)])

    @property
    def disturbance(self) -> dict[str, float]:
        """The estimated disturbances by name [SI]."""
        drifted = self.deviation[len(self._x) :].tolist()
        return {n: u + d for (n, u), d in zip(self._disturbed.items(), drifted, strict=True)}

    def predict(self, inputs: Mapping[str, float] | None = None) -> None:
        """Go on to the next sample under inputs by name (kept within the plant's range)."""
        given, inversion = inputs or {}, self.inversion
        if inversion and all(n in given for n in self._commands):
            entry = self._entry
            if inversion.by_states:
                entry.measure(self.state)
            entry.tell({f"sent.{n}": given[n] for n in self._commands})
            acted = dict(zip(entry.outputs, entry.step().tolist(), strict=True))
            given = acted | {n: u for n, u in given.items() if n in acted}
        elif inversion:
            given = inversion.openings(given, measured=self.state)
        u = [given.get(n, start) for n, start in self._inputs]
        after, moved = self._predict(self.deviation, u)
        self.deviation, self._u = after[:, 0].copy(), moved[:, 0].copy()

    # ---- equations -------------------------------------------------------------------------------
    def correction(self) -> ca.Function:
        """(deviation, inputs' deviation, measured) -> deviation; what is missing has no row."""
        c, d = (ca.DM(np.asarray(getattr(self.system, n))) for n in "CD")
        x, u, y = (
            ca.SX.sym(n, k) for n, k in (("x", c.shape[1]), ("u", d.shape[1]), ("y", c.shape[0]))
        )
        good = ca.fabs(y) <= LARGEST
        expected = ca.DM([self.point[n] for n in self.measured]) + ca.mtimes(c, x) + ca.mtimes(d, u)
        error = ca.if_else(good, ca.if_else(good, y, 0) - expected, 0)
        return ca.Function("correct", [x, u, y], [x + ca.mtimes(ca.DM(self.gain), error)])

    def prediction(self) -> ca.Function:
        """(deviation, inputs) -> (deviation of the next sample, inputs' deviation), inputs within
        their range; those that are estimated are states."""
        variables, estimated = self.point.plant.inputs, self.disturbances
        a, b = (ca.DM(np.asarray(getattr(self.system, n))) for n in "AB")
        x, u = ca.SX.sym("x", a.shape[0]), ca.SX.sym("u", len(variables))
        low, high = ([getattr(v, end) for v in variables] for end in ("min", "max"))
        moved = clipped(u, low, high) - ca.DM(self.point.u)
        moved = moved * ca.DM([v.name not in estimated for v in variables])
        return ca.Function("predict", [x, u], [ca.mtimes(a, x) + ca.mtimes(b, moved), moved])

    @cached_property
    def _entry(self) -> Running:
        """From commands to the inputs of the linear model, openings among them."""
        assert self.inversion
        draft = Draft("entry", self.sample_time, "openings of commands")
        acted = opened_by(self.inversion, self.inversion.plant, draft)
        for v in self.point.plant.inputs:
            draft.output(Variable(v.name, "output"), acted.get(v.name, draft.kind(v.start or 0.0)))
        return Running(draft.block())

    @cached_property
    def _correct(self) -> Buffered:
        return Buffered(self.correction())

    @cached_property
    def _predict(self) -> Buffered:
        return Buffered(self.prediction())


@verb
def kalman(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    measured: Mapping[str, float],
    process: float | Mapping[str, float] = 1.0,
    disturbances: Mapping[str, float] | None = None,
    sample_time: float = 1e-3,
) -> StationaryFilter:
    """The stationary Kalman filter about an equilibrium, for a sampling time ``sample_time`` [s].

    measured : {state or output: standard deviation of its noise [SI]}, of each sample.
    process : what drives the states besides the inputs, scaled by nominals per sqrt(s): a number
        for all, or {state: value} (others 0). The mass not known well is noise on the velocity.
    disturbances : {input: drift [SI per sqrt(s)]} of inputs that are not known but estimated with
        the states, as constants that drift: an external force, or a command's unknown offset. At
        most as many as measured values. See :class:`OffsetFree`.

    By ``control.dlqe``'s Riccati equation on the system scaled by nominals; the inputs held and the
    noise between two samples are integrated exactly (van Loan 1978).
    Raises InputError when the states cannot be told from what is measured.

    Examples
    --------
    >>> observer = pam.control.kalman(plant, point, measured={"x": 1e-4}, sample_time=0.01)
    >>> observer.gain.shape
    (3, 1)
    """
    require_plant(plant)
    inversion, at = inside(plant, at)
    plant = at.plant
    sample_time = require_positive("sample_time", sample_time, "s")
    seen, noise = measurements(plant, measured)
    names, unknown = [v.name for v in seen], inversion.names(disturbances or {})
    # held memories stick to the motion about the point: estimated from it, as no pole tells of them
    follow, known = at.stuck, plant.vector("state", attribute="nominal")
    linear = linear_model(plant, at, outputs=names, stuck=True)
    states = known[follow.kept]
    a, b = held(linear.A, linear.B, states, sample_time)
    sampled = replace(linear, A=a, B=b, dt=sample_time).to_control()
    system = _with_disturbances(plant, sampled, list(unknown), states)
    sizes = [plant.variable(n).nominal for n in unknown]
    if isinstance(process, Mapping):
        given = deviations(plant, process, "process")
        drive = np.array([given.get(plant.states[i].name, 0.0) for i in follow.kept])
    else:
        drive = np.full(len(states), require_positive("process", process))
    drift = [
        require_positive(f"disturbances[{n!r}]", v) / size
        for (n, v), size in zip(unknown.items(), sizes, strict=True)
    ]
    nominal = np.concatenate([states, sizes])
    columns = [[v.name for v in plant.inputs].index(n) for n in unknown]
    moving = np.zeros((len(nominal), len(nominal)))  # the disturbances drift, and push
    moving[: len(states)] = np.hstack([linear.A, linear.B[:, columns]]) * nominal / states[:, None]
    added = gramian(moving, np.diag(np.concatenate([drive, drift])), sample_time)
    gain, covariance = _stationary(system, names, nominal, noise, added)
    lift = follow.lift(more=len(unknown))
    system = _of_all_states(plant, system, follow)
    return StationaryFilter(
        at,
        names,
        lift @ gain,
        sample_time,
        system,
        list(unknown),
        inversion if inversion else None,
        noise,
        lift @ covariance @ lift.T,
    )


def measurements(plant: Plant, measured: Mapping[str, float]) -> tuple[list[Variable], Array]:
    """The states and outputs that are measured, and the deviations of their noise [SI]."""
    require_instance("measured", measured, Mapping, "give {state or output: deviation}")
    if not measured:
        raise InputError("measured is empty: give {state or output: deviation of its noise}")
    found = [plant.variable(n) for n in measured]
    for v in found:
        if v.causality not in ("state", "output"):
            raise InputError(f"measured: {v.name} is {v.kind}; give states or outputs")
    pairs = zip(found, measured.items(), strict=True)
    return found, np.array([require_positive(f"measured[{n!r}]", s, v.unit) for v, (n, s) in pairs])


def deviations(plant: Plant, given: Mapping[str, float], argument: str) -> dict[str, float]:
    """{state: standard deviation}, checked."""
    found = {}
    for name, value in given.items():
        variable = plant.variable(name)
        if variable.causality != "state":
            raise InputError(f"{argument}: {variable.name} is {variable.kind}; give states")
        found[variable.name] = require_positive(f"{argument}[{name!r}]", value, zero=True)
    return found


def _of_all_states(plant: Plant, system: Any, follow: Stuck) -> Any:
    """The sampled system with held memories as states that follow the others."""
    import control

    if not len(follow.held):
        return system
    labels, more = system.state_labels, len(system.A) - len(follow.kept)
    lift, pick = follow.lift(more=more), follow.pick(more)
    names = [v.name.replace(".", "_") for v in plant.states]
    return control.ss(
        lift @ system.A @ pick,
        lift @ system.B,
        system.C @ pick,
        system.D,
        system.dt,
        states=[*names, *labels[len(labels) - more :]],
        inputs=system.input_labels,
        outputs=system.output_labels,
        name=system.name,
        remove_useless_states=False,
    )


def _with_disturbances(plant: Plant, system: Any, disturbances: list[str], x: Array) -> Any:
    """The sampled system with some of its inputs as further states that stay as they are.

    x : nominals of its states.

    Raises InputError when what is measured cannot tell them from the states (the condition of
    Pannocchia and Rawlings, AIChE Journal 49 (2003) 426-437).
    """
    import control

    if not disturbances:
        return system
    inputs = [v.name for v in plant.inputs]
    wrong = [n for n in disturbances if n not in inputs]
    if wrong:
        raise InputError(
            f"disturbances: {wrong[0]} is {plant.variable(wrong[0]).kind}; name inputs of "
            f"the plant ({', '.join(inputs)}), such as that of an ExternalForce"
        )
    columns = [inputs.index(n) for n in disturbances]
    a, b, c, d = (np.asarray(getattr(system, n)) for n in "ABCD")
    n, m = len(a), len(columns)
    y = np.abs(c).max(axis=1, initial=1e-300)
    u = np.array([plant.inputs[i].nominal for i in columns])
    pencil = np.block(
        [
            [(a - np.eye(n)) * x / x[:, None], b[:, columns] * u / x[:, None]],
            [c * x / y[:, None], d[:, columns] * u / y[:, None]],
        ]
    )
    pencil = pencil / np.maximum(np.abs(pencil).max(axis=0), 1e-300)
    if m > len(c) or np.linalg.matrix_rank(pencil, tol=1e-9) < n + m:
        raise InputError(
            f"disturbances: {', '.join(disturbances)} cannot be told from the states by "
            f"{len(c)} measured value(s); measure more, or estimate fewer"
        )
    whole = np.block([[a, b[:, columns]], [np.zeros((m, n)), np.eye(m)]])
    return control.ss(
        whole,
        np.vstack([b, np.zeros((m, b.shape[1]))]),
        np.hstack([c, d[:, columns]]),
        d,
        system.dt,
        inputs=system.input_labels,
        outputs=system.output_labels,
        name=system.name,
        states=[*system.state_labels, *(f"{n.replace('.', '_')}_unknown" for n in disturbances)],
    )


def _stationary(
    system: Any, names: list[str], nominal: Array, noise: Array, added: Array
) -> tuple[Array, Array]:
    """The gain that corrects the present estimate, and the covariance that this leaves, in SI.

    added : covariance that the process noise adds in a sample, scaled by nominals.
    """
    import control

    a = np.asarray(system.A) * nominal / nominal[:, None]
    c = np.asarray(system.C) * nominal / noise[:, None]
    try:
        gain, covariance, _ = control.dlqe(a, np.eye(len(a)), c, added, np.eye(len(noise)))
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError(
            f"kalman: the states cannot be told from {', '.join(names)} ({error}); measure more, "
            "or add process noise"
        ) from None
    if not np.all(np.isfinite(gain)):
        raise InputError(f"kalman: no stationary filter exists for {', '.join(names)}")
    # dlqe's gain corrects the prediction for the next sample; this one corrects the present one,
    # and leaves a covariance in Joseph's form, which rounding leaves symmetric and positive
    p = np.asarray(covariance)
    present = np.linalg.solve(c @ p @ c.T + np.eye(len(noise)), c @ p).T
    keep = np.eye(len(p)) - present @ c
    left = keep @ p @ keep.T + present @ present.T
    return present * nominal[:, None] / noise, left * nominal * nominal[:, None]


def require_one_sample_time(what: str, who: str, own: float, filter: float) -> None:
    """InputError where a controller and the filter that it sees through count other samples."""
    if not np.isclose(own, filter, rtol=1e-9):
        raise InputError(
            f"{what}: sample_time = {own:g} s of the {who}, {filter:g} s of the filter; design "
            "both for one"
        )


@dataclass
class WithEstimate:
    """A controller that sees the filter's estimate in place of the states, and what is measured.

    Outputs that the filter does not measure stay visible only if named in ``also``.
    delay : samples after which the inputs act; the filter predicts with those that act, at first
        with the plant's start values.

    Examples
    --------
    >>> filter = pam.control.kalman(plant, point, measured={"x": 1e-5})
    >>> law = pam.control.WithEstimate(pam.lqr(plant, point), filter)
    >>> start = {"x": 0.038, "muscle.pressure": point["muscle.pressure"]}
    >>> loop = pam.closed_loop(law, plant, duration=0.5, start=start)
    >>> bool(abs(loop["x"][-1] - 0.04) < 5e-4)
    True
    """

    controller: Controller
    filter: StationaryFilter
    also: Sequence[str] = ()
    delay: int = 0

    def __post_init__(self) -> None:
        require_instance("filter", self.filter, StationaryFilter, "give that of kalman()")
        require_count("delay", self.delay, 0)
        own = counted(self.controller) or self.sample_time
        require_one_sample_time("WithEstimate", "controller", own, self.sample_time)
        self._waiting: list[Mapping[str, float]] = []

    @property
    def sample_time(self) -> float:
        """That of the filter."""
        return self.filter.sample_time

    def reset(self) -> None:
        """See :class:`Controller`."""
        self.controller.reset()
        self.filter.reset()
        inversion = self.filter.inversion
        whole = inversion.plant.inputs if inversion else ()
        first = {v.name: v.start or 0.0 for v in whole if not v.disturbance}
        self._waiting = [first] * self.delay

    def aims(self, t: float) -> dict[str, float]:
        """Those of the controller."""
        told = getattr(self.controller, "aims", getattr(self.controller, "wanted", None))
        return dict(told(t)) if told else {}

    def __call__(self, t: float, measured: Measured) -> Mapping[str, float]:
        """See :class:`Controller`."""
        self.filter.correct(measured)
        seen = self.filter.state
        visible = [n for n in (*self.filter.measured, *self.also) if n not in seen]
        seen.update({n: measured[n] for n in visible})
        inputs = self.controller(t, seen)
        self._waiting.append(inputs)
        self.filter.predict(self._waiting.pop(0))
        return inputs


# ---- as blocks ----------------------------------------------------------------------------------
@BLOCKS.register("StationaryFilter")
def stationary_filter(filter: StationaryFilter, name: str = "filter") -> Block:
    """The estimate of states and disturbances, as :class:`StationaryFilter`.

    Inputs are what is measured (NaN where a value is missing: the others correct alone) and the
    commands sent since the last step; outputs ``estimate.NAME``.
    """
    point, draft = filter.point, Draft(name, filter.sample_time, "stationary Kalman filter")
    plant = point.plant
    whole = filter.inversion.plant if filter.inversion else plant
    names = [v.name for v in plant.states]
    estimated = [plant.variable(n) for n in (*names, *filter.disturbances)]
    deviation = draft.remembered("deviation", estimated, "x - x0")
    started = draft.started
    acted = opened_by(filter.inversion, whole, draft)
    u = ca.vertcat(*(acted.get(v.name, v.start or 0.0) for v in plant.inputs))
    predicted, moved = filter.prediction()(deviation, u)
    y = draft.measured([plant.variable(n) for n in filter.measured], missing=True)
    expected = ca.if_else(started, predicted, deviation)
    after = filter.correction()(expected, ca.if_else(started, moved, 0), y)
    estimate = ca.DM([point[v.name] for v in estimated]) + after
    if filter.inversion and not filter.inversion.exact:
        x = estimate[: len(names)]
        back = filter.inversion.entering(False)(x, whole.vector("parameter"))
        estimate = ca.vertcat(back, estimate[len(names) :])
    draft.next(f"deviation.{estimated[0].name}", after)
    for i, v in enumerate(estimated):
        draft.estimate(v, estimate[i])
    return draft.block()


@BLOCKS.register("WithEstimate")
def with_estimate(controller: WithEstimate, name: str = "with_estimate") -> Block:
    """A controller that sees the filter's estimate, as :class:`WithEstimate`."""
    parts = [stationary_filter(controller.filter), law_of(controller.controller)]
    return chain(parts, name=name, delay=controller.delay)
