"""A plant run freely through whole records, with sensitivities.

A run knows the inputs of its record and where the measured states began; nothing measured after
that. What is not measured begins at rest under the first inputs. With free starts, where positions,
velocities and pressures begin is unknown in each record, too, and sought from there on. Steps are
those of ROS2 (see :mod:`pam_ocp.numerics.rosenbrock`). Sensitivities go through its stages with the
same matrix, which is of second order, too, and far smaller than the derivative of the step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.signals import signals
from ...core.trajectory import Trajectory
from ...numerics.rosenbrock import GAMMA
from ...plants.plant import Plant
from ...plants.undelayed import without_dead_times
from ..statistics import Array
from .experiment import ParameterGroup

__all__ = ["WholeRuns", "scaled", "usual_steps"]

SETTLING = np.concatenate([2e-3 * 2.0 ** np.arange(12), np.full(8, 0.5)])
"""Steps [s] in which a plant comes to rest before a record begins: 12 s in all."""
NEWTON = 8
"""Steps of Newton's method from one sample's point of rest to the next, in static runs."""
STEP = 1.25e-3
"""Longest step [s] where no number of steps is given."""
ASTRAY = 1e3
"""Stands for an error, in spreads, that is no number or beyond: a run that diverged."""
WILD = 1e4
"""A sensitivity, in spreads per unit of a scaled unknown, from which on a run steers no step."""


@dataclass(frozen=True, eq=False)
class _Course:
    """One record as steps: lengths (n,), inputs at their begins and ends (nu, n), which of them end
    at a sample (K,), how many settle; measured (K, ny); states set after settling, by position.
    """

    h: Array
    begin: Array
    end: Array
    sample: NDArray[np.intp]
    settling: int
    measured: Array
    known: dict[int, float]
    number: int
    """Of its record."""


class WholeRuns:
    """Runs of a plant along records, as functions of scaled unknowns z.

    unknowns : parameter groups. steps : in each sampling interval. static : each sample shows the
    plant at rest under its inputs. spread : units of errors, by default what was measured spreads.
    free_starts : behind the groups z holds, record by record, how far ``own`` states begin from
    where they would, in their nominals. begun : the same where it is known.
    """

    def __init__(
        self,
        plant: Plant,
        records: Sequence[Trajectory],
        outputs: Sequence[str],
        unknowns: Sequence[ParameterGroup] = (),
        *,
        steps: int | None = None,
        static: bool = False,
        spread: Array | None = None,
        free_starts: bool = False,
        begun: Array | None = None,
    ) -> None:
        self._time = None if static else _common_dead_time(plant, unknowns)
        lines, plant = plant.delay_lines, plant if self._time is None else without_dead_times(plant)
        driven = {} if self._time is None else {line.outlet: line.source for line in lines}
        self.outputs, self._nx, self._nz = tuple(outputs), len(plant.states), len(unknowns)
        steps = steps or usual_steps(records)
        self._courses = [
            _course(plant, r, outputs, steps, static, driven, i) for i, r in enumerate(records)
        ]
        self.measured = [c.measured for c in self._courses]
        self.spread = _spread(plant, outputs, self.measured) if spread is None else spread
        self._begin = np.clip(
            *(plant.vector("state", attribute=a) for a in ("start", "min", "max"))
        )
        self._pressures = [i for i, v in enumerate(plant.states) if v.unit == "Pa"]
        self._static = static
        known = {k for c in self._courses for k in c.known}
        own = [] if static else sorted(known | {*self._pressures})
        self.own, self._begun = np.array(own, dtype=np.intp), begun
        self._free = len(own) if free_starts else 0
        self._nominal = np.asarray(plant.vector("state", attribute="nominal"))
        self._dead_time = float(plant.variable(lines[0].time).start or 0.0) if lines else 0.0
        self._move, self._tangent, self._read, self._slope = _functions(
            plant, outputs, unknowns, self._time, self._free
        )
        self._rest, self._rest_tangent = _resting(plant, unknowns)
        self._whole: dict[tuple[str, int], ca.Function] = {}

    @property
    def starts(self) -> int:
        """Unknowns behind those of the groups."""
        return self._free * len(self._courses)

    def predicted(self, z: Array) -> list[Array]:
        """(K, ny) of each record, in SI."""
        found = []
        for c in self._courses:
            x = self._rolled(self._move, c, z, 0)
            seen = self._moments(c, x, z)
            found.append(np.asarray(self._read.map(len(seen[2]))(*seen, z[: self._nz])).T)
        return found

    def errors(self, z: Array) -> list[Array]:
        """Predicted less measured, in spreads, (K, ny) of each record."""
        return [
            np.clip(
                np.nan_to_num((p - m) / self.spread, nan=ASTRAY, posinf=ASTRAY, neginf=-ASTRAY),
                -ASTRAY,
                ASTRAY,
            )
            for p, m in zip(self.predicted(z), self.measured, strict=True)
        ]

    def slopes(self, z: Array) -> list[Array]:
        """d(errors)/dz, (K, ny, len(z)) of each record."""
        found, ny, local = [], len(self.outputs), self._nz + self._free
        for c in self._courses:
            both = self._rolled(self._move if self._static else self._tangent, c, z, local)
            if self._static:
                tangent = self._rest_tangent.map(both.shape[1])(both, c.end, z)
                both = np.vstack([both, np.asarray(tangent)])
            seen = self._moments(c, both, z)
            rows = self._slope.map(len(seen[2]))(*seen, z[: self._nz])
            slope = np.asarray(rows).T.reshape(-1, local, ny).transpose(0, 2, 1)
            slope = slope / self.spread[:, None]
            wild = ~(np.abs(slope).max(axis=(1, 2), initial=0.0) < WILD)
            slope[int(np.argmax(wild)) if wild.any() else len(slope) :] = 0.0
            every = np.zeros((*slope.shape[:2], len(z)))
            every[..., : self._nz] = slope[..., : self._nz]
            if self._free:
                every[..., self._places(c)] = slope[..., self._nz :]
            found.append(every)
        return found

    def _places(self, course: _Course) -> NDArray[np.intp]:
        """Of the starts of a record in z."""
        return np.asarray(self._nz + course.number * len(self.own) + np.arange(len(self.own)))

    def fastest_pressure(self, z: Array) -> float:
        """The largest rate of a pressure from sample to sample [Pa/s]; 0 where there is none."""
        rates = [0.0]
        for c in self._courses:
            x = self._rolled(self._move, c, z, 0)[self._pressures][:, c.sample]
            times = np.cumsum(c.h)[c.sample]
            rates.append(float(np.abs(np.diff(x) / np.diff(times)).max(initial=0.0)))
        return max(rates)

    def _rolled(self, step: ca.Function, course: _Course, z: Array, tangents: int) -> Array:
        """The states (with sensitivities) at the ends of all steps of a record."""
        x = self._begin if self._static else np.pad(self._begin, (0, self._nx * tangents))
        off = np.zeros(len(self.own))
        if self._free:
            off = z[self._places(course)]
        elif self._begun is not None and self._begun.size:
            off = self._begun.reshape(-1, len(self.own))[course.number]
        first, second = slice(0, course.settling), slice(course.settling, None)
        parts = []
        for part in (first, second):
            n = len(course.h[part])
            along = self._accumulated(self._rest if self._static and part is second else step, n)
            states = np.asarray(
                along(
                    x,
                    course.begin[:, part],
                    course.end[:, part],
                    course.h[part][None],
                    z[: self._nz],
                )
            )
            if part is first:
                x = states[:, -1]
                for place, value in course.known.items():
                    x[place] = value
                    x[self._nx + place :: self._nx] = 0.0
                x[self.own] += off * self._nominal[self.own]
                if tangents and self._free:
                    column = self._nx * (1 + self._nz + np.arange(len(self.own)))
                    x[column + self.own] = self._nominal[self.own]
            parts.append(states)
        # a first sample at the end of the settling, which was set to what was measured
        parts[0][:, -1] = x
        return np.asarray(np.hstack(parts))

    def _moments(self, course: _Course, x: Array, z: Array) -> tuple[Array, ...]:
        """What is read at each sample: the step in which the motion that it shows lies (states at
        its begin and end, inputs, length) and the part of it that is over.

        With a dead time that is the motion so much earlier: nothing depends on time but the inputs.
        """
        late = self._dead_time
        if self._time is not None and self._time[0] is not None:
            late = float(z[self._time[0]] * self._time[1])
        elif self._time is None:
            late = 0.0
        ends = np.cumsum(course.h)
        first = course.settling  # the first step of the record itself
        at = np.maximum(ends[course.sample] - late, ends[first - 1])
        step = np.searchsorted(ends, at - 1e-12, side="left")
        step = np.maximum(step, min(first, len(ends) - 1))
        part = np.clip(1 - (ends[step] - at) / course.h[step], 0.0, 1.0)
        if not late and self._time is None:
            step, part = course.sample, np.ones(len(course.sample))
        before = np.maximum(step - 1, 0)
        inputs = course.begin[:, step], course.end[:, step]
        moving = at > ends[first - 1]  # before that a sample shows the start, whatever the delay
        return x[:, before], x[:, step], *inputs, course.h[step][None], part[None], moving[None]

    def _accumulated(self, step: ca.Function, n: int) -> ca.Function:
        key = (step.name(), n)
        if key not in self._whole:
            self._whole[key] = step.mapaccum(n)
        return self._whole[key]


def _common_dead_time(
    plant: Plant, unknowns: Sequence[ParameterGroup]
) -> tuple[int | None, float] | None:
    """(position among the unknowns or None, its scale) of the dead time that all inputs have in
    common; None where they have none, or different ones: then delay lines are integrated.
    """
    lines = plant.delay_lines
    late = {line.source for line in lines}
    if not lines or late != {v.name for v in plant.inputs}:
        return None
    order = [v.name for v in plant.parameters]
    members = {order.index(line.time) for line in lines}
    values = {float(plant.variable(line.time).start or 0.0) for line in lines}
    of = [j for j, g in enumerate(unknowns) if members & set(g.members)]
    if len(values) > 1 or len(of) > 1 or (of and not members <= set(unknowns[of[0]].members)):
        return None
    return (of[0], unknowns[of[0]].scale) if of else (None, 1.0)


def _course(
    plant: Plant,
    record: Trajectory,
    outputs: Sequence[str],
    steps: int,
    static: bool,
    driven: Mapping[str, str],
    number: int,
) -> _Course:
    """driven : {input: whose column of the record it takes} where that is another."""
    source = {v.name: driven.get(v.name, v.name) for v in plant.inputs}
    missing = [source[v.name] for v in plant.inputs if source[v.name] not in record]
    missing = [n for n in missing if not plant.variable(n).disturbance]
    if missing:
        raise InputError(f"a record has no column for the input {missing[0]}")
    held = record.interpolation == "previous"
    given = {
        v.name: record[source[v.name]] if source[v.name] in record else float(v.start or 0.0)
        for v in plant.inputs
    }
    u = signals(plant, given, record.t, record.interpolation)
    at = u(record.t).T
    for i, v in enumerate(plant.inputs):
        if source[v.name] in record:  # held signals end before their last sample
            at[i, -1] = record[source[v.name]][-1]
    settle = [np.repeat(at[:, :1], len(SETTLING), axis=1)] * 2
    if static:
        begin, end = (np.hstack([s, np.repeat(at, NEWTON, axis=1)]) for s in settle)
        h = np.concatenate([SETTLING, np.ones(NEWTON * at.shape[1])])
        sample = len(SETTLING) - 1 + NEWTON * np.arange(1, at.shape[1] + 1)
        return _Course(h, begin, end, sample, len(SETTLING), record.array(outputs), {}, number)
    span = np.diff(record.t)
    part = np.arange(steps + 1) / steps
    slope = np.zeros((at.shape[0], len(span))) if held else np.diff(at, axis=1)
    edges = at[:, :-1, None] + slope[:, :, None] * part
    begin, end = (
        np.hstack([s, e.reshape(len(at), -1)])
        for s, e in zip(settle, (edges[:, :, :-1], edges[:, :, 1:]), strict=True)
    )
    h = np.concatenate([SETTLING, np.repeat(span / steps, steps)])
    sample = len(SETTLING) - 1 + steps * np.arange(len(record.t))
    known = _known(plant, record, outputs)
    return _Course(h, begin, end, sample, len(SETTLING), record.array(outputs), known, number)


def _known(plant: Plant, record: Trajectory, outputs: Sequence[str]) -> dict[int, float]:
    """Where measured states begin: as measured, velocities by the first three samples."""
    order = [v.name for v in plant.states]
    found = {}
    for position, velocity in plant.positions.items():
        if position in outputs:
            t, x = record.t[:3] - record.t[:3].mean(), record[position][:3]
            found[order.index(velocity)] = float(t @ x / (t @ t))
    for name in outputs:
        if name in order:
            found[order.index(name)] = float(record[name][0])
    return found


def _spread(plant: Plant, outputs: Sequence[str], measured: Sequence[Array]) -> Array:
    spread = np.concatenate(list(measured)).std(axis=0)
    nominal = np.array([plant.variable(n).nominal for n in outputs])
    return np.where(spread > 1e-9 * nominal, spread, nominal)


def _functions(
    plant: Plant,
    outputs: Sequence[str],
    unknowns: Sequence[ParameterGroup],
    time: tuple[int | None, float] | None,
    own: int,
) -> tuple[ca.Function, ca.Function, ca.Function, ca.Function]:
    """One step; one with sensitivities; what is measured inside of it; its sensitivities.

    time : position and scale of the unknown dead time by which samples are late. own : starts of a
    record that are unknown.
    """
    nx, nu, nz = len(plant.states), len(plant.inputs), len(unknowns)
    z, x, h = ca.SX.sym("z", nz), ca.SX.sym("x", nx), ca.SX.sym("h")
    s = ca.SX.sym("s", nx, nz + own)
    early, late = ca.SX.sym("early", nu), ca.SX.sym("late", nu)
    p = _parameters(plant, unknowns, z)

    def rates(at: ca.SX, u: ca.SX) -> ca.SX:
        return plant.function(at, u, p)[0]

    def over_z(value: ca.SX) -> ca.SX:
        return ca.horzcat(ca.jacobian(value, z), ca.SX(value.numel(), own))

    first = rates(x, early)
    a = ca.jacobian(first, x)
    matrix = ca.SX.eye(nx) - GAMMA * h * a
    k1 = ca.solve(matrix, first)
    middle = x + h * k1
    k2 = ca.solve(matrix, rates(middle, late) - 2 * k1)
    after = x + 1.5 * h * k1 + 0.5 * h * k2
    m = ca.SX.sym("m", nx)
    second = rates(m, late)
    slope = ca.Function("second", [m, late, z], [ca.jacobian(second, m), over_z(second)])
    a2, b2 = slope(middle, late, z)
    s1 = ca.solve(matrix, a @ s + over_z(first))
    s2 = ca.solve(matrix, a2 @ (s + h * s1) + b2 - 2 * s1)
    moved = s + 1.5 * h * s1 + 0.5 * h * s2
    # read inside of a step: the cubic through the states and their rates at its ends
    begin, part, moving = ca.SX.sym("begin", nx), ca.SX.sym("part"), ca.SX.sym("moving")
    s_begin = ca.SX.sym("s_begin", nx, nz + own)
    u = early + part * (late - early)
    inside = _cubic(begin, x, h * rates(begin, early), h * rates(x, late), part)
    seen = ca.vertcat(*(plant.expression(name) for name in outputs))
    show = ca.Function("seen", [plant.x, plant.u, plant.p], [seen])
    y = show(inside, u, p)
    y_slopes = ca.jacobian(y, x) @ s + ca.jacobian(y, begin) @ s_begin + over_z(y)
    if time is not None and time[0] is not None:
        y_slopes[:, time[0]] -= moving * ca.jacobian(y, part) * time[1] / h
    column = ca.vec(s)
    both = ca.vertcat(begin, ca.vec(s_begin)), ca.vertcat(x, column)
    return (
        ca.Function("move", [x, early, late, h, z], [after], {"cse": True}),
        ca.Function(
            "tangent",
            [ca.vertcat(x, column), early, late, h, z],
            [ca.vertcat(after, ca.vec(moved))],
            {"cse": True},
        ),
        ca.Function("read", [begin, x, early, late, h, part, moving, z], [y], {"cse": True}),
        ca.Function(
            "slope",
            [*both, early, late, h, part, moving, z],
            [ca.densify(ca.vec(y_slopes))],
            {"cse": True},
        ),
    )


def _cubic(a: ca.SX, b: ca.SX, da: ca.SX, db: ca.SX, part: ca.SX) -> ca.SX:
    """Hermite's polynomial from a with slope da to b with slope db, at a part of the way."""
    rest = 1 - part
    return ca.SX(
        a * (1 + 2 * part) * rest**2
        + b * part**2 * (3 - 2 * part)
        + part * rest * (da * rest - db * part)
    )


def _resting(plant: Plant, unknowns: Sequence[ParameterGroup]) -> tuple[ca.Function, ca.Function]:
    """A step of Newton's method towards rest; how the point of rest depends on the unknowns."""
    nx, nu, nz = len(plant.states), len(plant.inputs), len(unknowns)
    z, x, h = ca.SX.sym("z", nz), ca.SX.sym("x", nx), ca.SX.sym("h")
    early, late = ca.SX.sym("early", nu), ca.SX.sym("late", nu)
    rates = plant.function(x, late, _parameters(plant, unknowns, z))[0]
    a = ca.jacobian(rates, x)
    slopes = -ca.solve(a, ca.jacobian(rates, z)) if nz else ca.SX(nx, 0)
    return (
        ca.Function("rest", [x, early, late, h, z], [x - ca.solve(a, rates)]),
        ca.Function("rest_tangent", [x, late, z], [ca.densify(ca.vec(slopes))]),
    )


def _parameters(plant: Plant, unknowns: Sequence[ParameterGroup], z: ca.SX) -> ca.SX:
    p = ca.SX(plant.vector("parameter"))
    for j, group in enumerate(unknowns):
        for member in group.members:
            p[member] = z[j] * group.scale
    return p


def usual_steps(records: Sequence[Trajectory]) -> int:
    """Steps in each sampling interval where none are given."""
    usual = min(float(np.median(np.diff(r.t))) for r in records)
    return max(1, int(np.ceil(usual / STEP - 1e-6)))


def scaled(unknowns: Sequence[ParameterGroup]) -> tuple[Array, Array, Array]:
    """(start, low, high) of z."""
    found: list[Any] = [
        np.array([getattr(g, a) / g.scale for g in unknowns]) for a in ("value", "low", "high")
    ]
    return found[0], found[1], found[2]
