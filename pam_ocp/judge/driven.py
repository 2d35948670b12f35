"""A plant driven by given inputs: integrated tightly, looked at densely, on both sides of jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import SimulationError
from ..core.signals import PiecewisePolynomial, merged
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from ..simulation.integrate import Integration, evaluated
from ..simulation.simulator import simulate
from .statement import TIME

Array: TypeAlias = NDArray[np.float64]

TOLERANCE = 1e-11
"""Of the integrator, relative to states and their nominals."""
ROUGH = 1e-7
"""Of another integration: where it parts from the first, errors grow so much along the motion that
no integrator or plant without feedback runs along it.
"""
PARTS = 100
"""Parts of a motion, at least, each with the points of Lobatto's rule."""
LEAST = 2
"""Parts of a piece of the inputs, at least."""
FINE = 65
"""Points of a cell at which a largest value is looked for."""
NEAR = 2.0
"""Half widths from the middle of a forbidden region at which one looks closely."""
_TAUS = np.array([0.0, (1 - np.sqrt(3 / 7)) / 2, 0.5, (1 + np.sqrt(3 / 7)) / 2, 1.0])
_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180.0
"""Lobatto's rule with five points, exact to degree 7."""
_SIMPSON = np.array([1.0, 0.0, 4.0, 0.0, 1.0]) / 6.0
EXACT, LITTLE = 1e-4, 1e-3
"""Part of an integral that cells may be off by, all together; and of what it would be without
signs, below which it counts as that.
"""
_POWERS = np.vander(_TAUS, increasing=True)
_SLOPES = np.column_stack([np.zeros(5), _POWERS[:, :4] * np.arange(1, 5)]) @ np.linalg.inv(_POWERS)
"""(points, points) from values at the points to slopes of the polynomial through them, by tau."""
RESOLVED = 3e-4
"""What slopes of the polynomial through a cell's states may miss their rates by, times the length
of the cell, in nominals: beyond, the cell is split, or what swings inside would be overlooked.
"""
SPLITS = 4
"""Times that cells are split, at most: what is quicker is over before it counts."""


@dataclass(frozen=True, eq=False)
class Driven:
    """A motion in cells between jumps; the points of a cell hold its ends, seen from inside.

    t : (cells, 5) times [s]. x : (nx, cells, 5) states. u : (nu, cells, 5) inputs.
    """

    plant: Plant
    trajectory: Trajectory
    t: Array
    x: Array
    u: Array
    inputs: PiecewisePolynomial

    @cached_property
    def _arguments(self) -> list[ca.SX]:
        return [self.plant.x, self.plant.u, self.plant.p, TIME]

    def values(self, expressions: Sequence[ca.SX]) -> Array:
        """(expressions, cells, 5) values of expressions of the plant's symbols and TIME."""
        column = ca.densify(ca.vertcat(*expressions))
        function = ca.Function("along", self._arguments, [column])
        p = self.plant.vector("parameter")
        flat = (part.reshape(len(part), self.t.size) for part in (self.x, self.u))
        found = np.asarray(function(*flat, p, self.t.reshape(1, -1)), float)
        return found.reshape(len(expressions), *self.t.shape)

    def integral(self, integrands: Sequence[ca.SX]) -> Array:
        """(integrands,) over the whole motion.

        Cells in which Simpson's rule says otherwise are split and run again: a flow that turns
        round between the points is a small part of what flows, and may be all that is left of it.
        """
        run = self
        for splits in range(SPLITS + 1):
            values = run.values(integrands)
            found, h = run.summed(values), run.t[:, -1] - run.t[:, 0]
            rough = h * np.abs(values @ (_WEIGHTS - _SIMPSON))
            size = np.maximum(np.abs(found), LITTLE * run.summed(np.abs(values)))
            if splits == SPLITS or np.all(rough.sum(axis=1) <= EXACT * size):
                break
            beyond = np.any(rough > EXACT * size[:, None] / len(h), axis=0)
            finer = run._run(_points(_quartered(run.ends, beyond)))
            if finer is None:
                break
            run = finer
        return found

    @property
    def ends(self) -> Array:
        """(cells + 1,) where cells begin and end [s]."""
        return np.append(self.t[:, 0], self.t[-1, -1])

    def _run(self, t: Array) -> Driven | None:
        """The motion once more, in cells with points at these times (cells, points)."""
        every = _every(t)
        run = Integration.over(self.plant, self.inputs, every, self.x[:, 0, 0], rtol=TOLERANCE)
        states = run()
        if states is None:
            return None
        x = _by_cells(run.at(every, states), len(t))
        return Driven(self.plant, self.trajectory, t, x, _inputs(self.inputs, t), self.inputs)

    def summed(self, values: Array) -> Array:
        """(n,) integrals of values (n, cells, 5)."""
        h = self.t[:, -1] - self.t[:, 0]
        return np.asarray(np.einsum("nck,k,c->n", values, _WEIGHTS, h))

    def largest(self, expression: ca.SX) -> float:
        """Largest value of an expression: the motion is run again with points close together, for
        a peak is as narrow as a jump of an input makes it.
        """
        return float(self._fine.values([expression]).max())

    @cached_property
    def _fine(self) -> Driven:
        """The motion with FINE points in each cell; this one where only that has come through."""
        ends = self.t[:, [0, -1]]
        fine = self._run(ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * np.linspace(0.0, 1.0, FINE))
        return fine or self

    def nearest(self, axes: Sequence[ca.SX], cells: NDArray[np.bool_]) -> float:
        """How near a point with these coordinates comes to their origin in some cells, on straight
        lines between points that lie close together where it comes near.
        """
        for run in (self, self._fine):
            at = run.values(axes)[:, cells]
            way = np.diff(at)
            at, square = at[..., :-1], np.sum(way**2, axis=0)
            along = -np.sum(at * way, axis=0) / np.where(square, square, 1.0)
            lines = at + np.clip(along, 0.0, 1.0) * way
            distance = float(np.sqrt(np.sum(lines**2, axis=0)).min(initial=np.inf))
            if distance > NEAR:
                break
        return distance

    def sides(self, time: float) -> list[tuple[Array, Array]]:
        """(states, inputs) at the ends of the cells that meet at a time."""
        near = 1e-9 * max(float(self.t[-1, -1]), 1e-9)
        found = []
        for place in (-1, 0):
            for cell in np.flatnonzero(np.abs(self.t[:, place] - time) <= near):
                at = (slice(None), cell, place)
                found.append((self.x[at], self.u[at]))
        return found


def driven(
    plant: Plant,
    start: Array,
    inputs: PiecewisePolynomial,
    times: Sequence[float],
    further: Array | None = None,
) -> tuple[Driven, Array]:
    """Integrate a plant from ``start`` under ``inputs``; ``times`` [s] stand among the ends of
    cells, the first and the last are those of the motion. And its states at ``further`` times.

    Raises SimulationError (with the time reached) where the integrator gives up.
    """
    begin, end = times[0], times[-1]
    inside = inputs.breaks[(inputs.breaks > begin) & (inputs.breaks < end)]
    near = 1e-9 * (end - begin)
    ends = np.array([begin])
    for left, right in pairwise(_apart(np.sort(np.concatenate([times, inside])), near)):
        count = max(LEAST, int(np.ceil(PARTS * (right - left) / (end - begin))))
        ends = np.append(ends, np.linspace(left, right, count + 1)[1:])
    asked = np.zeros(0) if further is None else np.clip(further, begin, end)
    for splits in range(SPLITS + 1):
        t = _points(ends)
        if splits % 2 == 0:  # with the points of all quarters: it is steps that cost
            quarters = _quartered(ends, np.ones(len(t), bool))
            others = np.concatenate([asked, _points(quarters).ravel()])
            run, known = _integrated(plant, start, inputs, _every(t), others)
        states = run.at(_every(t), known)
        x = _by_cells(states, len(t))
        u = _inputs(inputs, t)
        rough = _unresolved(plant, t, x, u)
        if splits == SPLITS or not rough.any():
            break
        ends = _quartered(ends, rough)
    trajectory = evaluated(plant, _every(t), states, inputs)
    return Driven(plant, trajectory, t, x, u, inputs), run.at(asked, known)


def roughly(plant: Plant, start: Array, inputs: PiecewisePolynomial, times: Array) -> Array | None:
    """States at ``times`` [s], the first that of ``start``, as an ordinary integration has them;
    None where it gives up.
    """
    run = Integration.over(plant, inputs, times, np.asarray(start, float), rtol=ROUGH)
    states = run()
    return None if states is None else run.at(times, states)


def _integrated(
    plant: Plant, start: Array, inputs: PiecewisePolynomial, every: Array, asked: Array
) -> tuple[Integration, Array]:
    """The motion at these times and those asked for besides: states for ``Integration.at``."""
    both = merged(np.concatenate([every, asked]))
    run = Integration.over(plant, inputs, both, np.asarray(start, float), rtol=TOLERANCE)
    states = run()
    if states is None:
        names = [v.name for v in plant.states]
        at = dict(zip(names, np.asarray(start, float), strict=True))
        simulate(plant, inputs, t=every, rtol=TOLERANCE, start=at)
        raise SimulationError("the integrator gave up", float(every[0]), None)
    return run, states


def _unresolved(plant: Plant, t: Array, x: Array, u: Array) -> NDArray[np.bool_]:
    """(cells,) where states swing between the points."""
    flat = (part.reshape(len(part), t.size) for part in (x, u))
    rates = plant.function(*flat, plant.vector("parameter"))[0]
    known = np.asarray(rates, float).reshape(x.shape)
    h = (t[:, -1] - t[:, 0])[:, None]
    nominal = plant.vector("state", attribute="nominal")[:, None, None]
    missed = np.abs(x @ _SLOPES.T - h * known) / nominal
    return np.asarray(missed.max(axis=(0, 2)) > RESOLVED)


def _points(ends: Array) -> Array:
    """(cells, 5) times of the points of cells."""
    return np.asarray(ends[:-1, None] + np.diff(ends)[:, None] * _TAUS)


def _every(t: Array) -> Array:
    """The times of cells that follow each other, each once."""
    return np.append(t[:, :-1].ravel(), t[-1, -1])


def _quartered(ends: Array, rough: NDArray[np.bool_]) -> Array:
    """The ends, with rough cells in four: points cost less than to integrate again."""
    quarters = np.linspace(ends[:-1][rough], ends[1:][rough], 5)[1:4]
    return np.sort(np.append(ends, quarters))


def _by_cells(states: Array, cells: int) -> Array:
    """(nx, cells, points) of states (times, nx) that follow each other, each cell with its ends."""
    points = (len(states) - 1) // cells
    inner = states[:-1].reshape(cells, points, -1)
    whole = np.concatenate([inner, states[points::points, None]], axis=1)
    return np.asarray(whole.transpose(2, 0, 1))


def _apart(times: Array, near: float) -> Array:
    """Rising times, without those that another one stands for."""
    kept = [float(times[0])]
    for time in times[1:]:
        if time - kept[-1] > near:
            kept.append(float(time))
    kept[-1] = float(times[-1])
    return np.array(kept)


def _inputs(inputs: PiecewisePolynomial, t: Array) -> Array:
    """(nu, cells, 5) values of each cell's own piece of the inputs."""
    piece = np.searchsorted(inputs.breaks, t.mean(axis=1), side="right") - 1
    piece = np.clip(piece, 0, len(inputs.breaks) - 2)
    since = (t - inputs.breaks[piece][:, None])[..., None]
    powers = since ** np.arange(inputs.degree + 1)
    return np.asarray(np.einsum("cpj,cji->icp", powers, inputs.coefficients[piece]))
