"""LQR and LQI about a stop, by python-control's solvers with the plant's nominals as scales."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core.block import Block
from ..core.errors import InputError, require_instance, require_positive
from ..core.quantities import outside
from ..core.stop import verb
from ..operating.linear import LinearGrid, held, inside, linearize, linearize_grid, no_influence
from ..operating.resting_point import OperatingPoint
from ..plants.inversion import Inversion
from ..plants.plant import Plant, Values, require_plant
from .blocks.draft import Draft, Symbol, about
from .blocks.running import SampledLaw
from .kinds import BLOCKS, CONTROLLERS, Array
from .state_feedback import Setpoint, StateFeedback, feedback_law

HALVINGS = 6
"""From a nominal value down: steps of an input that are looked at, and as many up."""
FLAT = 1.2
"""An input whose step of twice the size does less than this much more has gone far enough."""
SEEN = 2.0
"""Times nominal: a direction in which an input has less room is not asked."""
SHARE = 0.2
"""Of what an input reaches: the step that counts as one in a weight, see Weighting."""


def effort_units(plant: Plant, x: Array, u: Array, inputs: list[str]) -> Array:
    """The step of each input [SI] that a weight of one is for: its nominal value, or ``SHARE`` of
    the step from which on more of it does no more, where that is less.

    A servo valve is fully open at an error of half a bar, and a slew rate at its end; a feedback
    that asks for more than these give swings. The ends of an input's own range are not meant, nor
    what ends in one direction alone (a muscle that goes slack).
    """
    names = [v.name for v in plant.inputs]
    units = []
    for name in inputs:
        variable = plant.variable(name)
        at = names.index(name)
        room = {-1.0: u[at] - variable.min, 1.0: variable.max - u[at]}
        wide = [s for s, r in room.items() if r >= SEEN * variable.nominal]
        reach = max(_reach(plant, x, u, at, s) for s in wide or [max(room, key=lambda s: room[s])])
        units.append(min(variable.nominal, SHARE * reach))
    return np.array(units)


def _reach(plant: Plant, x: Array, u: Array, at: int, sign: float) -> float:
    """The least step of an input in one direction that a step twice as large does not surpass."""
    variable, p = plant.inputs[at], plant.vector("parameter")
    room = variable.max - u[at] if sign > 0 else u[at] - variable.min
    steps = variable.nominal * 2.0 ** np.arange(-HALVINGS, HALVINGS + 1)
    steps = steps[steps <= room]
    if len(steps) < 2:
        return np.inf
    columns = np.tile(u[:, None], len(steps) + 1)
    columns[at, 1:] += sign * steps
    here = np.tile(x[:, None], len(steps) + 1)
    rates = np.asarray(plant.function(here, columns, p)[0], dtype=float)
    sizes = plant.vector("state", attribute="nominal")[:, None]
    effect = np.linalg.norm((rates[:, 1:] - rates[:, :1]) / sizes, axis=0)
    flat = (effect[1:] < FLAT * effect[:-1]) & (effect[:-1] > 0)
    return float(steps[int(np.argmax(flat))]) if flat.any() else np.inf


LEAST_WEIGHT = 0.3
"""Of each state [per nominal] where the weights given leave a motion without cost and decay."""
SHORTEST = 1e-6
"""Of a sample time that is too long: shorter ones are not looked for."""
OVER = 5.0
"""Time constants after which a motion is over."""
DECAY = 1e-8
"""A pole of the closed loop slower than this part of the fastest rate counts as none."""


@dataclass(frozen=True)
class Weighting:
    """The cost: the sum of (weight value / nominal)^2 over states, outputs and inputs, per second.

    weights : {state or output: weight}; by default 10 for each position, 1 for each velocity. Where
        these leave a motion that neither decays nor costs anything (the co-contraction of a pair on
        closed valves), every state gets ``LEAST_WEIGHT`` besides.
    effort : weight of each input, a number or {input: weight}.
    integral : {state or output: weight of its integrated error [per s]}.
    units : what an effort of 1 is per, of each input [SI], see :func:`effort_units`.
    """

    plant: Plant
    weights: Mapping[str, float] | None
    effort: float | Mapping[str, float]
    integral: Mapping[str, float]
    units: Array

    @classmethod
    def about(
        cls,
        plant: Plant,
        x: Array,
        u: Array,
        weights: Mapping[str, float] | None,
        effort: float | Mapping[str, float],
        integral: Mapping[str, float] | None,
    ) -> Weighting:
        """A weighting whose efforts are per what the inputs reach at a state, under inputs."""
        chosen = [v.name for v in plant.inputs if not v.disturbance]
        return cls(plant, weights, effort, integral or {}, effort_units(plant, x, u, chosen))

    @property
    def inputs(self) -> list[str]:
        """The inputs that a controller chooses: all but disturbances."""
        return [v.name for v in self.plant.inputs if not v.disturbance]

    @property
    def integrated(self) -> list[str]:
        return [self.plant.variable(n).name for n in self.integral]

    def scales(self, names: list[str]) -> Array:
        return np.array([self.plant.variable(n).nominal for n in names])

    def __post_init__(self) -> None:
        for name in ("weights", "integral"):
            given, words = getattr(self, name), "give {state or output: weight}"
            require_instance(name, given, Mapping, words, none=name == "weights")

    def checked(self) -> tuple[dict[str, float], Array]:
        """{weighted state or output: weight} and R, scaled by nominals."""
        given = self.weights
        if given is None:
            moved = self.plant.load_positions.items()  # a spool is to move as it likes
            given = {n: w for p, v in moved for n, w in ((p, 10.0), (v, 1.0))}
        rows = {
            self.plant.variable(n).name: require_positive(f"weights[{n!r}]", w, zero=True)
            for n, w in given.items()
        }
        for n, w in self.integral.items():
            require_positive(f"integral[{n!r}]", w)
        allowed = {v.name for v in (*self.plant.states, *self.plant.outputs)}
        for name in [*rows, *self.integrated]:
            if name not in allowed:
                raise InputError(
                    f"weights: {name} is no state or output but of kind "
                    f"{self.plant.variable(name).causality}; weigh states and outputs, and inputs "
                    "by effort"
                )
        if isinstance(self.effort, Mapping):
            named = {self.plant.variable(n).name: w for n, w in self.effort.items()}
            missing = [n for n in self.inputs if n not in named]
            if missing:
                raise InputError(f"effort: no weight for the input {missing[0]}")
            efforts = [require_positive(f"effort[{n!r}]", named[n]) for n in self.inputs]
        else:
            efforts = [require_positive("effort", self.effort)] * len(self.inputs)
        steps = self.scales(self.inputs) / self.units
        return rows, np.diag(np.square(np.multiply(efforts, steps)))

    def scaled(
        self, model: Iterable[Array], all_outputs: list[str]
    ) -> tuple[Array, Array, Array, Array, Array]:
        """A, B, Q, R, N scaled by nominals, with the integrals of the errors as last states: the
        cost is x'Q x + u'R u + 2 x'N u.

        model : A, B and, of ``all_outputs``, C and D.
        """
        (rows, r), (a, b, c, d) = self.checked(), model
        nominal = self.plant.vector("state", attribute="nominal")
        a = a * nominal / nominal[:, None]
        b = b * self.scales(self.inputs) / nominal[:, None]
        sizes = self.scales(all_outputs)[:, None]
        c, d = c * nominal / sizes, d * self.scales(self.inputs) / sizes
        at, weights = [all_outputs.index(n) for n in rows], np.array([*rows.values()])[:, None]
        weighted, direct = c[at] * weights, d[at] * weights
        at = [all_outputs.index(n) for n in self.integrated]
        n, k = len(a), len(at)
        a = np.block([[a, np.zeros((n, k))], [c[at], np.zeros((k, k))]])
        b = np.vstack([b, d[at]])
        q, cross = np.zeros((n + k, n + k)), np.zeros(b.shape)
        q[:n, :n], cross[:n] = weighted.T @ weighted, weighted.T @ direct
        q[n:, n:] = np.diag(np.square([float(self.integral[m]) for m in self.integral]))
        return a, b, q, r + direct.T @ direct, cross

    def unscaled(self, k: Array) -> tuple[Array, Array]:
        """Gains (over states, over integrals) in SI, of gains scaled by nominals."""
        n = len(self.plant.states)
        effort = self.scales(self.inputs)[:, None]
        return (
            k[:, :n] * effort / self.plant.vector("state", attribute="nominal"),
            k[:, n:] * effort / self.scales(self.integrated),
        )


def stationary(
    a: Array,
    b: Array,
    q: Array,
    r: Array,
    cross: Array,
    states: int,
    sample_time: float | None = None,
) -> tuple[Array, Array, Array]:
    """Gains, solution P of the Riccati equation and Q of a feedback that is seen to stabilise.

    The first ``states`` get the least weight where without it none is found. sample_time : of a
    sampled design, inputs held; None: continuous. Raises ValueError when none is found.
    """
    import control

    least = np.zeros_like(q)
    least[:states, :states] = LEAST_WEIGHT**2 * np.eye(states)
    reason: object = "a pole stays on the imaginary axis"
    for used in (q, q + least):
        try:
            if sample_time is None:
                k, p, poles = control.lqr(a, b, used, r, cross)
                decay = -np.real(poles)
            else:
                ad, bd = held(a, b, np.ones(len(a)), sample_time)
                k, p, poles = control.dlqr(ad, bd, *(w * sample_time for w in (used, r, cross)))
                decay = -np.log(np.maximum(np.abs(poles), 1e-300)) / sample_time
        except (ValueError, np.linalg.LinAlgError, control.ControlArgument) as error:
            reason = error
            continue
        # the solver's own residual is not looked at by python-control: its poles tell
        fastest = max(float(np.abs(decay).max()), float(np.abs(a).max()))
        if np.all(np.isfinite(k)) and decay.min() > DECAY * fastest:
            return np.asarray(k), np.asarray(p), used
    raise ValueError(reason)


def require_quick(
    verb: str,
    plant: Plant,
    loop: tuple[Array, Array, Array],
    sample_time: float,
    sampled: bool | None = None,
) -> None:
    """InputError where the feedback, its inputs held over a sample, does not stabilise; a warning
    where all motions of the plant are over within a sample, so that it never acts on one.

    loop : A, B and the gains, scaled by nominals. sampled : whether they were designed for held
    inputs; None: that cannot be chosen.
    """
    a, b, k = loop

    def radius(time: float) -> float:
        ad, bd = held(a, b, np.ones(len(a)), time)
        found = float(np.abs(np.linalg.eigvals(ad - bd @ k)).max())
        return found if np.isfinite(found) else np.inf

    if not sampled and not (largest := radius(sample_time)) < 1:
        time = sample_time
        while not radius(time) < 1 and time > SHORTEST * sample_time:
            time /= 2
        other = ", or sampled=True, which designs for held inputs" if sampled is not None else ""
        raise InputError(
            f"{verb}: sample_time = {sample_time:g} s is too long for {plant.name!r}: with inputs "
            f"held so long the closed loop is unstable (a pole at {largest:.3g}, outside the unit "
            f"circle); give at most {time:.2g} s{other}"
        )
    decay = -np.linalg.eigvals(a).real
    slowest = float(np.min(decay, initial=np.inf))
    if slowest * sample_time > OVER:
        warnings.warn(
            f"{verb}: sample_time = {sample_time:g} s is far too long for {plant.name!r}: its "
            f"slowest motion decays with {1 / slowest:.2g} s and is over within a sample, so the "
            "feedback never acts on it",
            stacklevel=outside(),
        )


@CONTROLLERS.register("lqr", units={"sample_time": "s"})
@verb
def lqr(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    weights: Mapping[str, float] | None = None,
    effort: float | Mapping[str, float] = 1.0,
    integral: Mapping[str, float] | None = None,
    setpoint: Setpoint = None,
    sample_time: float = 1e-3,
    sampled: bool = False,
) -> StateFeedback:
    """The linear-quadratic regulator about an equilibrium; with ``integral``, LQI.

    A plant fed by valves is controlled by its openings (``plant.in_openings()``), from closed rest
    too; the commands that give them are sent. ``effort`` may name either. Held memories
    (hysteresis) stick to the motion about the point: K has zeros for them.

    at : the equilibrium; weights, effort, integral : see :class:`Weighting`, scaled by nominals;
        an input that has its full effect sooner (a servo valve that is open, a slew rate) is
        weighed per a fifth of that.
    setpoint : {integrated output: value} to reach, or a function of time giving one.
    sample_time : of the controller [s]. sampled : design for inputs held over it
        (``control.dlqr``, exact sampling) instead of the continuous ``control.lqr``.

    Raises InputError when no input has an influence on a position at the point, when the sample
    time is too long (inputs held over it, the closed loop is unstable), or when no stabilising
    feedback exists (a state that is a pure integral, such as the totals of a gas feed, or an
    integrated output that the inputs cannot move).

    Examples
    --------
    >>> feedback = pam.lqr(plant, point)
    >>> inputs = feedback(0.0, {**point.values, "x": 0.035})  # too low: more pressure
    >>> inputs["muscle.command"] > point["muscle.command"]
    True
    """
    require_plant(plant)
    sample_time = require_positive("sample_time", sample_time, "s")
    inversion, at = inside(plant, at)
    plant = at.plant
    if isinstance(effort, Mapping):
        effort = inversion.names(effort)
    weighting = Weighting.about(plant, at.x, at.u, weights, effort, integral)
    outputs = [v.name for v in (*plant.states, *plant.outputs)]
    system = linearize(plant, at, inputs=weighting.inputs)
    no_influence("lqr", plant, np.asarray(system.A), np.asarray(system.B), weighting.inputs)
    model = (np.asarray(getattr(system, m)) for m in "ABCD")
    a, b, q, r, cross = weighting.scaled(model, outputs)
    # held memories stick: no input reaches them, and nothing is fed back from them
    nominal, more = plant.vector("state", attribute="nominal"), len(weighting.integrated)
    lift, pick = at.stuck.lift(nominal, more), at.stuck.pick(more)
    a, b, q, cross = pick @ a @ lift, pick @ b, lift.T @ q @ lift, lift.T @ cross
    try:
        held_over = sample_time if sampled else None
        k = stationary(a, b, q, r, cross, len(at.stuck.kept), held_over)[0]
    except ValueError as error:
        raise InputError(
            f"lqr: no feedback stabilises {plant.name!r} under these weights ({error}); leave out "
            "integrals that the inputs cannot move, and totals of gas feeds"
        ) from None
    require_quick("lqr", plant, (a, b, k), sample_time, sampled)
    gains = weighting.unscaled(k @ pick)
    return StateFeedback(
        at,
        weighting.inputs,
        *gains,
        weighting.integrated,
        sample_time,
        setpoint,
        system,
        inversion if inversion else None,
    )


# ---- scheduled: gains at every point of a grid, interpolated in between --------------------------
@dataclass(eq=False)
class ScheduledFeedback(SampledLaw):
    """u = u0(s) - K(s) (x - x0(s)) - Ki(s) integral(y - y(s)): a Controller, s the place in the
    grid.

    place : t -> {axis: value}, where the plant is to be (position and stiffness, say): it chooses
    the equilibrium and the gains. Values beyond the grid are taken at its border. For a plant fed
    by valves u stands for the openings; the commands that give them are sent.
    """

    family: LinearGrid
    K: Array = field(repr=False)
    Ki: Array = field(repr=False)
    integrated: list[str]
    place: Callable[[float], Mapping[str, float]]
    sample_time: float
    inversion: Inversion | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        names = [v.name for v in self.family.plant.inputs]
        self._columns = [names.index(n) for n in self.family.inputs]
        self._goals = np.array(
            [[p[n] for n in self.integrated] for p in self.family.points.ravel()]
        ).reshape(*self.family.points.shape, len(self.integrated))

    def where(self, t: float) -> dict[str, float]:
        """The place in the grid at a time [s], within its borders."""
        plant = self.family.plant
        given = {plant.variable(n).name: v for n, v in self.place(t).items()}
        return {
            n: float(np.clip(given[n], axis[0], axis[-1])) if n in given else float(axis[0])
            for n, axis in self.family.axes.items()
        }

    def aims(self, t: float) -> dict[str, float]:
        """The positions among the axes at a time [s]."""
        positions = {p.name for p in self.family.plant.resting()}
        return {n: v for n, v in self.where(t).items() if n in positions}

    def _references(self, t: float) -> dict[str, float]:
        return {f"place.{n}": value for n, value in self.where(t).items()}


@verb
def scheduled_lqr(
    plant: Plant,
    axes: Mapping[str, ArrayLike],
    place: Callable[[float], Mapping[str, float]],
    conditions: Values | None = None,
    *,
    weights: Mapping[str, float] | None = None,
    effort: float | Mapping[str, float] = 1.0,
    integral: Mapping[str, float] | None = None,
    sample_time: float = 1e-3,
) -> ScheduledFeedback:
    """LQR (LQI with ``integral``) at each equilibrium of a grid, interpolated by ``place``.

    axes, conditions : see :func:`linearize_grid`, such as positions and stiffnesses.
    place : t [s] -> {axis: value}. weights, effort, integral : see :class:`Weighting`.
    sample_time : sampling time [s] of the controller.

    Examples
    --------
    >>> place = lambda t: {"x": 0.03 + 0.01 * t}
    >>> law = pam.control.scheduled_lqr(plant, {"x": [0.03, 0.05]}, place)
    >>> loop = pam.closed_loop(law, plant, duration=0.5, start=plant.equilibrium(x=0.03))
    >>> print(f"{loop['x'][-1]:.3f}")
    0.035
    """
    inversion = Inversion(require_plant(plant))
    inner = inversion.inner
    if isinstance(effort, Mapping):
        effort = inversion.names(effort)
    inputs = [v.name for v in inner.inputs if not v.disturbance]
    family = linearize_grid(inner, axes, inversion.conditions(conditions), inputs=inputs)
    designs = [
        lqr(p.plant, p, weights=weights, effort=effort, integral=integral, sample_time=sample_time)
        for p in family.points.ravel()
    ]
    shape = family.points.shape
    k = np.array([d.K for d in designs]).reshape(*shape, *designs[0].K.shape)
    ki = np.array([d.Ki for d in designs]).reshape(*shape, *designs[0].Ki.shape)
    return ScheduledFeedback(
        family,
        k,
        ki,
        designs[0].integrated,
        place,
        require_positive("sample_time", sample_time, "s"),
        inversion if inversion else None,
    )


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("ScheduledFeedback")
def scheduled_feedback(controller: ScheduledFeedback, name: str = "scheduled") -> Block:
    """u = u0(s) - K(s) (x - x0(s)) - Ki(s) integral(y - y(s)), as :class:`ScheduledFeedback`.

    The place s in the grid are the inputs ``place.AXIS``, kept within its borders.
    """
    c, family = controller, controller.family
    plant = family.plant
    draft = Draft(name, c.sample_time, "scheduled state feedback", ca.MX)
    start = c.where(0.0)
    places = []
    for n, axis in family.axes.items():
        v = plant.variable(n)
        words = about(v, "where the plant is to be: it chooses the gains")
        s = draft.input(f"place.{n}", start[n], **words)
        places.append(ca.fmin(ca.fmax(s, float(axis[0])), float(axis[-1])))
    at = ca.vertcat(*places)
    axes = [np.asarray(axis, dtype=float).tolist() for axis in family.axes.values()]
    chosen = [plant.variable(n) for n in family.inputs]
    integrated = [plant.variable(n) for n in c.integrated]
    nu, nx, ni = len(chosen), len(plant.states), len(integrated)

    def table(name: str, values: Array) -> Symbol:
        """Values at the place, linear along each axis; their entries run along the last axes."""
        if not values.size:
            return draft.kind.zeros(0, 1)
        flat = values.reshape(*values.shape[: len(axes)], -1)
        order = np.moveaxis(flat, -1, 0).reshape(flat.shape[-1], -1, order="F")
        return ca.interpolant(name, "linear", axes, order.T.ravel().tolist())(at)

    x0, u0 = table("x0", family.x), table("u0", family.u[..., c._columns])
    k = ca.reshape(table("gains", np.swapaxes(c.K, -1, -2)), nu, nx)
    ki = ca.reshape(table("integral_gains", np.swapaxes(c.Ki, -1, -2)), nu, ni)
    goals = ca.vertsplit(table("goals", c._goals)) if integrated else []
    tracked = integrated, goals
    feedback_law(draft, c.inversion, plant.states, chosen, (k, ki), (x0, u0), tracked)
    return draft.block()
