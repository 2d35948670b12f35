"""Limits of a planned motion over time, and where the motion touches them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..plants.plant import Plant
from .arcs_found import Chains, limits_of
from .problem.limits import common_limits
from .problem.problem import Condition, Leg, Symbols
from .replay import values_along
from .transcription.mesh import INTERIOR, Arc

if TYPE_CHECKING:
    from .result import Plan

Array: TypeAlias = NDArray[np.float64]

ACTIVE = 1e-4
"""A limit is active where the motion is within this part of nominal of it, or beyond."""


@dataclass(frozen=True, eq=False)
class Limit:
    """A lower or upper limit along one leg, at the samples of the plan's replay there."""

    label: str
    column: str | None
    """The column of the trajectory that it limits; None for an expression of its own."""
    t: Array
    limit: Array
    """(n,) the limit over time, in the unit of the column."""
    distance: Array
    """(n,) from the limit in units of nominal, >= 0 where it is kept."""

    @property
    def active(self) -> NDArray[np.bool_]:
        """Where the motion touches it."""
        return self.distance <= ACTIVE


def limits_along(plan: Plan) -> list[Limit]:
    """Finite limits of each leg: bounds of states and inputs, and path conditions.

    Equalities (a disturbance held at its value, a path to follow) and the hold of a dwell are left
    out. Of a copy in another process that lost its problem, the plant's own limits.
    """
    assert plan.replay is not None  # of a plan that succeeded
    motion = plan.replay.trajectory
    ends = np.concatenate([[0.0], np.cumsum(plan.durations)])
    legs = plan._problem.legs if plan._problem else (_own(plan.plant, plan.duration),)
    found: list[Limit] = []
    for i, leg in enumerate(legs):
        end = ends[i + 1] if plan._problem else ends[-1]
        rows = np.flatnonzero((motion.t >= ends[i] - 1e-12) & (motion.t <= end + 1e-12))
        if not rows.size:
            continue
        for name, (low, high) in leg.bounds.items():
            nominal = plan.plant.variable(name).nominal
            found += _sides(name, name, motion.t[rows], motion[name][rows], (low, high), nominal)
        path = [c for c in leg.path if not c.label.startswith("dwell at ")]
        for condition, values in zip(path, _values(plan, path, rows), strict=True):
            found += _of(plan, condition, values, rows)
    return found


def _own(plant: Plant, duration: float) -> Leg:
    limits = common_limits(plant, {}, Symbols())
    return Leg((duration, duration), tuple(limits.path), limits.variables)


def _sides(
    label: str,
    column: str | None,
    t: Array,
    value: Array,
    pair: tuple[float, float],
    nominal: float,
) -> list[Limit]:
    """The finite sides of low <= value <= high."""
    low, high = pair
    if low == high:
        return []
    return [
        Limit(
            f"{label} {side}", column, t, np.full(len(t), bound), sign * (value - bound) / nominal
        )
        for bound, sign, side in ((low, 1, "min"), (high, -1, "max"))
        if np.isfinite(bound)
    ]


def _values(plan: Plan, path: list[Condition], rows: NDArray[np.intp]) -> Array:
    """(conditions, rows) values of path conditions, in SI."""
    assert plan.replay is not None  # of a plan that succeeded
    motion, plant, problem = plan.replay.trajectory, plan.plant, plan._problem
    if not path:
        return np.zeros((0, len(rows)))
    x = motion.array(motion.named("state")).T[:, rows]
    signals = motion.signals
    assert signals is not None  # a plan's inputs are known in between
    u = signals(
        motion.t[rows] + 1e-9 * plan.duration
    ).T  # behind a jump, however its time is rounded
    if problem is None:
        names = [v.name for v in plant.constraints]
        values = np.asarray(plant.function(x, u, plant.vector("parameter"))[2], float)
        return values[[names.index(c.label) for c in path]]
    given = problem.arguments(plant, motion.t[rows], x, u, np.array(plan._peaks))
    return values_along(problem, plant, [c.expression for c in path], given)


def _of(plan: Plan, condition: Condition, values: Array, rows: NDArray[np.intp]) -> list[Limit]:
    """The limits of a condition; one beside a profile is drawn where the profile runs."""
    assert plan.replay is not None  # of a plan that succeeded
    motion, name = plan.replay.trajectory, condition.shown.name
    pair, t = (condition.low, condition.high), motion.t[rows]
    column = name if name in motion and condition.label.startswith(name) else None
    found = _sides(condition.label, column, t, values, pair, condition.nominal)
    if column is not None and condition.label != name:
        beside = motion[name][rows] - values
        found = [Limit(condition.label, column, t, beside + f.limit, f.distance) for f in found]
    return found


MOSTLY = 0.9
"""Part of an interval along which a limit is active that leads there: its ends may be off it."""


def arcs_along(plan: Plan) -> tuple[Arc, ...]:
    """The arcs of a plan's inputs, input by input, in the order of time.

    A limit leads an input along an interval of the mesh where it is active all along (of a held
    input: somewhere) and the input can change it, its own bounds before others.
    """
    assert plan.replay is not None  # of a plan that succeeded
    problem, mesh = plan._problem, plan.meshes[-1]
    names = [v.name for v in plan.plant.inputs if not v.disturbance]
    if problem is None or not names:
        return ()
    breaks = _breaks(plan)
    every = limits_along(plan)
    led = [_leading(plan, every, k, breaks) for k in range(len(mesh.intervals))]
    found: list[Arc] = []
    for name in names:
        own: list[Arc] = []
        for k, labels in enumerate(led):
            active = labels.get(name, INTERIOR)
            if own and own[-1].active == active:
                own[-1] = replace(own[-1], end=breaks[k + 1])
            else:
                own.append(Arc(name, breaks[k], breaks[k + 1], active))
        found += own
    return tuple(found)


def _breaks(plan: Plan) -> list[float]:
    """Where the intervals of the mesh begin and end [s]."""
    lengths = [plan.durations[i.leg] * i.fraction for i in plan.meshes[-1].intervals]
    return [0.0, *np.cumsum(lengths).tolist()]


def _leading(plan: Plan, every: list[Limit], k: int, breaks: list[float]) -> dict[str, str]:
    """{input: the limit that leads it} along an interval."""
    assert plan._problem is not None
    problem, plant, mesh = plan._problem, plan.plant, plan.meshes[-1]
    chains = Chains(problem)
    leg = problem.legs[mesh.intervals[k].leg]
    known = {c.label: c for c in limits_of(problem, leg)}
    begin, end = breaks[k], breaks[k + 1]
    room = 1e-9 * breaks[-1]
    held = mesh.form.control != "polynomial"
    found: dict[str, str] = {}
    ranked: list[tuple[int, str, NDArray[np.bool_]]] = []
    for limit in every:
        inside = (limit.t >= begin - room) & (limit.t < end - room)
        touches = limit.active[inside]
        if not touches.size or not (touches.any() if held else touches.mean() > MOSTLY):
            continue
        condition = known.get(limit.label.rsplit(" ", 1)[0])
        chain = chains(condition) if condition is not None else None
        if chain is None:
            continue
        depends = chain.influence(plant.u)
        ranked.append((chain.order + int(depends.sum() > 1), limit.label, depends))
    inputs = [v.name for v in plant.inputs]
    for _, label, depends in sorted(ranked, key=lambda each: each[:2]):
        free = [n for n, does in zip(inputs, depends, strict=True) if does and n not in found]
        found |= dict.fromkeys(free, label)
    return found
