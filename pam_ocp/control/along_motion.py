"""Time-varying LQR along a planned motion: the Riccati differential equation, backwards.

As blocks, what follows a clock (feedback, inputs alone, motions as sources) has the values of every
sample in a table: it counts its samples while it is active, and stays at the last one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core.block import Block
from ..core.errors import InputError, kind_of, require_positive
from ..core.stop import turns, verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..operating.linear import LinearAlong, held, linearize_along, no_influence
from ..operating.operating_point import Stuck
from ..plants.inversion import Inversion
from ..plants.plant import Plant, require_plant
from .blocks.draft import Draft, Symbol, about, as_output
from .blocks.running import ByBlock, Running
from .controller import Measured
from .kinds import BLOCKS, Array
from .linear_quadratic import Weighting, require_quick, stationary
from .state_feedback import feedback_law

LONGEST = 2**24
"""Samples of a motion: single precision counts so far."""


class OpenLoop:
    """A Controller that plays the inputs of a motion, whatever happens (for comparison).

    Examples
    --------
    >>> law = pam.control.OpenLoop(slide, plan.trajectory, sample_time=1e-3)
    >>> start = {v.name: plan.trajectory[v.name][0] for v in slide.states}
    >>> loop = pam.closed_loop(law, slide, duration=plan.duration, start=start)
    >>> bool(abs(loop["x"][-1] - 0.01) < 2e-3)
    True
    """

    def __init__(self, plant: Plant, motion: Trajectory, sample_time: float) -> None:
        self.plant, self.motion = plant, motion
        self.sample_time = require_positive("sample_time", sample_time, "s")
        self.inputs = [v.name for v in plant.inputs if not v.disturbance]
        self._all = list(motion.named("input"))

    def reset(self) -> None:
        """See :class:`Controller`."""

    def planned(self, t: float) -> Array:
        """The inputs to hold over the sample from t on: those of its middle."""
        middle = float(np.clip(t + self.sample_time / 2, self.motion.t[0], self.motion.t[-1]))
        if self.motion.signals is not None:
            row = self.motion.signals(middle)[0]
            return np.array([row[self._all.index(n)] for n in self.inputs])
        return np.array([np.interp(middle, self.motion.t, self.motion[n]) for n in self.inputs])

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        return dict(zip(self.inputs, self.planned(t).tolist(), strict=True))


@dataclass(eq=False)
class TrajectoryFeedback(ByBlock):
    """u = u(t) - K(t) (x - x(t)) - Ki(t) integral(y - y(t)): a Controller along a motion.

    t : (n,) [s]; K : (n, inputs, states), Ki : (n, inputs, integrated), SI units; P : (n, N, N),
    the solution of the Riccati equation scaled by nominals (cost to go = z' P z, z in nominals).
    For a plant fed by valves u stands for the openings (``inputs``); commands are sent.
    """

    plant: Plant
    motion: Trajectory = field(repr=False)
    t: Array
    K: Array = field(repr=False)
    Ki: Array = field(repr=False)
    P: Array = field(repr=False)
    integrated: list[str]
    sample_time: float

    def __post_init__(self) -> None:
        self._open = OpenLoop(self.plant, self.motion, self.sample_time)
        self._inversion = Inversion(self.plant)
        inner = self._inversion.inner
        self.inputs = [v.name for v in inner.inputs if not v.disturbance]
        self._states = [v.name for v in self.plant.states]
        self._x = self._inversion.inside(self.motion.array(self._states))
        self._y = self.motion.array(self.integrated)

    @property
    def inversion(self) -> Inversion:
        """Of the dead zones of its commands."""
        return self._inversion

    def aims(self, t: float) -> dict[str, float]:
        """The motion's positions at a time [s]; its last ones afterwards."""
        names = [p.name for p in self.plant.resting()]
        row = _between(self.motion.t, self.motion.array(names), t)
        return dict(zip(names, row.tolist(), strict=True))

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        law = self._law
        law.measure(measured)
        row = self._rows(t)
        law.inputs[self._told : self._told + len(row)] = row
        return law.commands()

    @turns
    def _running(self) -> Running:
        """The law of the block, told its row at a time in place of that of a sample."""
        draft = Draft("feedback", self.sample_time, "state feedback about a row")
        size = len(self._rows(float(self.t[0])))
        row = ca.vertcat(*(draft.input(f"ahead.r{i}") for i in range(size)))
        _enter_law(draft, self, row)
        law = Running(draft.block())
        self._told = law.places["ahead.r0"]
        return law

    def _rows(self, t: float) -> Array:
        """What the law needs at a time [s]: u(t), x(t), y(t), K(t), Ki(t), column by column."""
        x, y = (_between(self.motion.t, values, t) for values in (self._x, self._y))
        k, ki = (_between(self.t, values, t) for values in (self.K, self.Ki))
        return np.concatenate([self._planned(t), x, y, k.T.ravel(), ki.T.ravel()])

    def _planned(self, t: float) -> Array:
        """The motion's inputs, commands as the openings that they give."""
        planned = self._open.planned(t)
        if not self._inversion:
            return planned
        named = dict(zip(self._open.inputs, planned.tolist(), strict=True))
        x = _between(self.motion.t, self.motion.array(self._states), t)
        seen = dict(zip(self._states, x.tolist(), strict=True))
        inner = self._inversion.openings(named, measured=seen)
        return np.array([inner[n] for n in self.inputs])


@verb
def tvlqr(
    plant: Plant,
    motion: Trajectory,
    *,
    weights: Mapping[str, float] | None = None,
    effort: float | Mapping[str, float] = 1.0,
    integral: Mapping[str, float] | None = None,
    final: ArrayLike | None = None,
    t: ArrayLike | None = None,
    sample_time: float = 1e-3,
    sampled: bool = False,
    rtol: float = 1e-8,
) -> TrajectoryFeedback:
    """Time-varying LQR along a motion of the plant (a plan's trajectory or its replay).

    -P' = A'P + P A - P B R^-1 B'P + Q, P(end) = ``final``, solved backwards by SciPy along exact
    A(t), B(t); K = R^-1 B'P.

    weights, effort, integral : see :class:`Weighting`, scaled by nominals.
    final : P at the end (scaled by nominals); by default that of the stationary LQR there, so that
        the plant can be held where the motion ends.
    A plant fed by valves is controlled by its openings, which leave no stretch without influence;
    the motion holds its commands, as a plan does.

    t : times at which A, B and K are taken; by default the motion's samples.
    sample_time : sampling time [s] of the controller. sampled : design for inputs held over it (the
        recursion of the samples, gains at them) instead of the differential equation above.

    Raises InputError for a motion without the plant's states and inputs, or when no stationary LQR
    exists at the end (give ``final``).

    Examples
    --------
    >>> law = pam.control.tvlqr(slide, plan.replay.trajectory)
    >>> start = {v.name: plan.trajectory[v.name][0] for v in slide.states}
    >>> late = {"duration": plan.duration, "start": start, "parameters": {"mass": 2.05}}
    >>> loop = pam.closed_loop(law, slide, **late)
    >>> bool(abs(loop["x"][-1] - 0.01) < 2e-3)
    True
    """
    require_plant(plant)
    if not isinstance(motion, Trajectory):
        raise InputError(
            f"motion is {kind_of(motion)}, not a Trajectory of the plant, such as plan.trajectory"
        )
    sample_time = require_positive("sample_time", sample_time, "s")
    if sample_time >= motion.duration:
        raise InputError(
            f"tvlqr: sample_time = {sample_time:g} s is no shorter than the motion, which takes "
            f"{motion.duration:g} s: give a fraction of that"
        )
    inversion = Inversion(plant)
    if isinstance(effort, Mapping):
        effort = inversion.names(effort)
    outputs = [v.name for v in (*plant.states, *plant.outputs)]
    given = motion if t is None else motion.at(t)
    if inversion:
        given = in_openings(inversion, given)
    inner = inversion.inner
    controls = [v.name for v in inner.inputs if not v.disturbance]
    along = linearize_along(inner, given, inputs=controls)
    x, u = (given.array([v.name for v in kind])[-1] for kind in (inner.states, inner.inputs))
    weighting = Weighting.about(inner, x, u, weights, effort, integral)
    no_influence("tvlqr", inner, along.A, along.B, controls)
    a, b, q, r, cross = _along(weighting, along, outputs)
    follow = Stuck.of(along.plant, along.A[-1], along.B[-1], along.inputs)
    nominal, more = along.plant.vector("state", attribute="nominal"), len(weighting.integrated)
    stuck = follow.lift(nominal, more), follow.pick(more)
    held_over = sample_time if sampled else None
    cost = q[-1], r[-1], cross[-1]
    end, least = _final(final, a[-1], b[-1], cost, stuck, len(follow.kept), held_over)
    problem = along.t, a, b, q + least, r, cross
    if sampled:
        times, p, k = _recursion(*problem, end, sample_time)
    else:
        times, (p, k) = along.t, _riccati(*problem, end, rtol)
    if final is None:
        kept = stuck[1] @ a[-1] @ stuck[0], stuck[1] @ b[-1], k[-1] @ stuck[0]
        require_quick("tvlqr", plant, kept, sample_time, sampled)
    gains = [weighting.unscaled(kt) for kt in k]
    return TrajectoryFeedback(
        plant,
        motion,
        times,
        np.array([k for k, _ in gains]),
        np.array([k for _, k in gains]),
        p,
        weighting.integrated,
        sample_time,
    )


def _between(t: Array, values: Array, at: float) -> Array:
    """Rows (vectors, matrices) given at times, in between; beyond them the first or the last."""
    i = int(np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2))
    share = float(np.clip((at - t[i]) / (t[i + 1] - t[i]), 0.0, 1.0))
    return np.asarray(values[i] + share * (values[i + 1] - values[i]))


def _riccati(
    t: Array, a: Array, b: Array, q: Array, r: Array, cross: Array, end: Array, rtol: float
) -> tuple[Array, Array]:
    """(P, gains) at the times ``t``: the differential equation, backwards from ``end``."""
    from scipy.integrate import solve_ivp

    size = a.shape[-1]

    def riccati(time: float, flat: Any) -> Any:
        at, bt, qt, rt, nt = (_between(t, m, time) for m in (a, b, q, r, cross))
        p = flat.reshape(size, size)
        pb = p @ bt + nt
        return -(at.T @ p + p @ at - pb @ np.linalg.solve(rt, pb.T) + qt).ravel()

    # entries differ by decades; the largest at the end, or what Q piles up, says what is small
    large = max(float(np.abs(end).max()), float(np.abs(q).max() * (t[-1] - t[0])), 1e-300)
    solution = solve_ivp(
        riccati,
        (t[-1], t[0]),
        end.ravel(),
        method="LSODA",
        t_eval=t[::-1],
        rtol=rtol,
        atol=1e-3 * rtol * large,
    )
    if not solution.success:
        raise InputError(
            f"tvlqr: the Riccati equation could not be integrated ({solution.message})"
        )
    p = solution.y.T[::-1].reshape(-1, size, size)
    p = (p + p.swapaxes(1, 2)) / 2
    return p, np.linalg.solve(r, b.swapaxes(1, 2) @ p + cross.swapaxes(1, 2))


def _recursion(
    t: Array,
    a: Array,
    b: Array,
    q: Array,
    r: Array,
    cross: Array,
    end: Array,
    sample_time: float,
) -> tuple[Array, Array, Array]:
    """(times, P, gains) at the samples, for inputs held over each, backwards from ``end``."""
    count = max(1, round((t[-1] - t[0]) / sample_time))
    times = t[-1] - sample_time * np.arange(float(count), -1.0, -1.0)
    p, after, gains = [end], end, []
    for time in times[::-1]:  # of the sample that begins at each time
        middle = float(np.clip(time + sample_time / 2, t[0], t[-1]))
        at, bt, qt, rt, nt = (_between(t, m, middle) for m in (a, b, q, r, cross))
        ad, bd = held(at, bt, np.ones(len(at)), sample_time)
        both = bd.T @ after @ ad + nt.T * sample_time
        k = np.linalg.solve(rt * sample_time + bd.T @ after @ bd, both)
        gains.append(k)
        if time < times[-1]:
            after = ad.T @ after @ ad - both.T @ k + qt * sample_time
            after = (after + after.T) / 2
            p.append(after)
    return times, np.array(p[::-1]), np.array(gains[::-1])


def in_openings(inversion: Inversion, motion: Trajectory) -> Trajectory:
    """A motion with the openings that its commands give, in place of the commands."""
    names = [v.name for v in inversion.plant.inputs]
    missing = [n for n in names if n not in motion]
    if missing:
        raise InputError(
            f"the motion holds no column {missing[0]!r} of plant {inversion.plant.name!r}"
        )
    states = [v.name for v in inversion.plant.states if v.name in motion]
    columns, x = {n: motion[n] for n in states}, None
    if not inversion.exact and len(states) == len(inversion.plant.states):
        x = motion.array(states)
        columns = dict(zip(states, inversion.inside(x).T, strict=True))
    rows = inversion.rows(motion.array(names), x=x)
    columns |= {v.name: rows[:, i] for i, v in enumerate(inversion.inner.inputs)}
    return Trajectory(motion.t, columns, [inversion.inner.variable(n) for n in columns])


def _along(weighting: Weighting, along: LinearAlong, outputs: list[str]) -> tuple[Array, ...]:
    """A, B with integrals, Q, R, N over time, scaled by nominals (weighted outputs bend them)."""
    rows = zip(along.A, along.B, along.C, along.D, strict=True)
    found = zip(*(weighting.scaled(row, outputs) for row in rows), strict=True)
    return tuple(np.array(m) for m in found)


def _final(
    final: ArrayLike | None,
    a: Array,
    b: Array,
    cost: tuple[Array, Array, Array],
    stuck: tuple[Array, Array],
    states: int,
    sample_time: float | None,
) -> tuple[Array, Array]:
    """P at the end, and what the stationary LQR there needed of weight besides Q.

    cost : Q, R and N. stuck : (lift, pick) of Stuck, by which held memories are left out of the
    ``states``.
    """
    q, r, cross = cost
    if final is not None:
        given = np.asarray(final, float)
        if given.shape != a.shape:
            raise InputError(f"final has shape {given.shape}; the Riccati matrix has {a.shape}")
        if not np.all(np.isfinite(given)):
            raise InputError(
                "final holds entries that are not finite; give the solution P at the end"
            )
        return given, np.zeros_like(q)
    try:
        lift, pick = stuck
        weights = lift.T @ q @ lift
        matrices = pick @ a @ lift, pick @ b, weights, r, lift.T @ cross
        _, p, used = stationary(*matrices, states, sample_time)
    except ValueError as error:
        raise InputError(
            f"tvlqr: no stationary LQR at the end of the motion ({error}); give final"
        ) from None
    return pick.T @ p @ pick, pick.T @ (used - weights) @ pick


# ---- as blocks ----------------------------------------------------------------------------------
def _samples(end: float, sample_time: float) -> int:
    """Samples until a motion that ends at ``end`` [s] stays as it is."""
    count = math.ceil(max(end, 0.0) / sample_time - 1e-9) + 2
    if count >= LONGEST:
        raise InputError(
            f"the motion of {end:g} s has {count} samples of {sample_time:g} s; give it in parts "
            f"of less than {LONGEST}"
        )
    return count


def _row(draft: Draft, table: Array) -> Symbol:
    """The row of this sample, as a column; the count goes on while the block is active."""
    count = draft.memory("sample", description="samples since the beginning")
    last = len(table) - 1
    here = ca.fmin(ca.fmax(count, 0), last)
    # what was sent a sample ago decides whether that sample counts
    now = ca.if_else(draft.started, ca.fmin(here + draft.active, last), here)
    draft.next("sample", now)
    return ca.MX(ca.DM(table.T))[:, now]


@BLOCKS.register("TrajectoryFeedback")
def trajectory_feedback(controller: TrajectoryFeedback, name: str = "tvlqr") -> Block:
    """u = u(t) - K(t) (x - x(t)) - Ki(t) integral(y - y(t)), as :class:`TrajectoryFeedback`."""
    c = controller
    draft = Draft(name, c.sample_time, "time-varying state feedback along a motion", ca.MX)
    times = c.sample_time * np.arange(_samples(float(c.motion.t[-1]), c.sample_time))
    _enter_law(draft, c, _row(draft, np.array([c._rows(t) for t in times])))
    return draft.block()


def _enter_law(draft: Draft, c: TrajectoryFeedback, row: Symbol) -> None:
    plant, inversion = c.plant, c._inversion if c._inversion else None
    chosen = [c._inversion.inner.variable(n) for n in c.inputs]
    integrated = [plant.variable(n) for n in c.integrated]
    nu, nx, ni = len(chosen), len(plant.states), len(integrated)
    ends = np.cumsum([0, nu, nx, ni, nu * nx, nu * ni]).tolist()
    u0, x0, y0, k, ki = ca.vertsplit(row, ends)
    gains, goals = (ca.reshape(k, nu, nx), ca.reshape(ki, nu, ni)), [y0[i] for i in range(ni)]
    tracked = integrated, goals
    feedback_law(draft, inversion, plant.states, chosen, gains, (x0, u0), tracked)


@BLOCKS.register("OpenLoop")
def open_loop(controller: OpenLoop, name: str = "open_loop") -> Block:
    """The inputs of a motion, without feedback, as :class:`OpenLoop`."""
    c, plant = controller, controller.plant
    draft = Draft(name, c.sample_time, "inputs of a motion", ca.MX)
    times = c.sample_time * np.arange(_samples(float(c.motion.t[-1]), c.sample_time))
    row = _row(draft, np.array([c.planned(t) for t in times]))
    for i, n in enumerate(c.inputs):
        draft.output(as_output(plant.variable(n)), row[i], command=True)
    return draft.block()


@BLOCKS.register("Trajectory")
def source(
    motion: Trajectory,
    name: str = "motion",
    *,
    sample_time: float = 1e-3,
    names: list[str] | None = None,
) -> Block:
    """A motion as a source of references ``wanted.NAME``; the last ones are held.

    names : of its columns; by default all. sample_time : [s].
    """
    draft = Draft(name, require_positive("sample_time", sample_time, "s"), "a motion", ca.MX)
    wanted = list(names or motion.names)
    begin, end = float(motion.t[0]), float(motion.t[-1])
    times = np.clip(sample_time * np.arange(_samples(end, sample_time)), begin, end)
    distinct, sample = np.unique(times, return_inverse=True)
    table = motion.at(distinct).array(wanted)[sample]
    row = _row(draft, table)
    for i, n in enumerate(wanted):
        v = motion.variable(n)
        words = about(v, f"planned: {v.description}")
        start = float(table[0, i])
        draft.output(Variable(f"wanted.{n}", "output", start=start, **words), row[i])
    return draft.block()
