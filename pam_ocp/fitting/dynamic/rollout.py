"""Free runs as a function of a plant's parameters and of its rig, with exact sensitivities."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError, InputError
from ...core.stop import check, native
from ...numerics.rosenbrock import ros2, ros2_with_slopes
from ...numerics.solvers import Buffered
from ...plants.plant import Plant
from ..statistics import Array
from .rig import Rig, RunUnknowns
from .runs import Runs, RunSteps

T = TypeVar("T")

WILD = 1e2
"""Sensitivity (spreads per unit of a scaled unknown; of a start, per what may move it) from which a
sample's row is damped: beside a parting of the ways (stick or slide), or where the plant is
unstable, a slope holds for changes far smaller than any step, and would outweigh all other runs.
Its row keeps its direction, its length is limited to this; its error counts in full.
"""
ASTRAY = 1e6
"""Stands for a residual that is no number: a motion that diverged is a bad one."""
MEMORY = 3e7
"""Bytes that the states and sensitivities of the runs of one call may take."""
MANY = 4_000
"""Steps of all runs from which the step is compiled, where there is a compiler. Whatever the plant,
this pays in some tens of evaluations: both times grow with the number of its instructions (1e-3 s
to compile one, 1e-8 s to interpret it, a sixth of that compiled).
"""
KEPT = 100
"""Points of a search at which the sums of squares are kept."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Runs that are computed together: their places, and how many samples they last."""

    rows: NDArray[np.intp]
    samples: int


class Rollout:
    """Runs, residuals and their exact Jacobian in the scaled unknowns z. A residual is an error in
    units of the variable's spread times the root of its sample's weight, so their sum of squares is
    the mean squared error. weigh : factors of the measured variables on top of that. static : the
    plant counts as at rest under its inputs at each sample. wild : in place of WILD.
    """

    def __init__(
        self,
        plant: Plant,
        runs: Runs,
        unknowns: RunUnknowns | None = None,
        rig: Rig | None = None,
        *,
        weigh: Array | None = None,
        static: bool = False,
        wild: float = WILD,
    ) -> None:
        unknowns = unknowns or RunUnknowns()
        self._plant, self.runs, self.unknowns, self._rig = plant, runs, unknowns, rig or Rig()
        self.spread = spreads(plant, runs.names, runs.measured)
        every = np.ones(len(runs.names)) if weigh is None else weigh
        self.weights = np.sqrt(runs.weights / len(runs.names))[..., None] * every
        self._whole: dict[Any, ca.Function] = {}
        self._seen: dict[bytes, tuple[float, float]] = {}
        self._normal: dict[bytes, tuple[float, Array, Array, int]] = {}
        self._steps: tuple[bytes, list[Array]] = (b"", [])
        self._late = _late(plant, runs, unknowns, self._rig)
        self._count = runs.steps + len(self._late)
        self._local = unknowns.shared + len(unknowns.own_starts)
        self._scale = unknowns.scale[: self._local]
        self._reach = self._reaches()
        self._static, self._wild = static, wild
        self._parts = {deep: self._cut(deep) for deep in (False, True)}

    def finer(self) -> Rollout:
        """With steps of half the length."""
        halved = replace(self.runs, steps=2 * self.runs.steps)
        return Rollout(self._plant, halved, self.unknowns, self._rig)

    def weighed(self, weigh: Array) -> Rollout:
        """The same runs with other factors of the measured variables."""
        found = copy(self)
        found.weights = np.sqrt(self.runs.weights / len(weigh))[..., None] * weigh
        found._seen, found._normal = {}, {}
        return found

    # ---- what is asked for --------------------------------------------------------------------
    def predicted(self, z: Array) -> Array:
        """(n, K, ny) in SI; NaN behind the end of a run."""
        found = np.full(self.runs.measured.shape, np.nan)
        for part, y, _ in self.computed(z, False):
            found[part.rows, : part.samples] = y
        return np.asarray(np.where(np.isnan(self.runs.measured), np.nan, found))

    def errors(self, predicted: Array) -> Array:
        """Residuals (n, K, ny) of a prediction; zero behind the end of a run."""
        return self._error(np.arange(len(predicted)), predicted)

    def residuals(self, z: Array) -> Array:
        """All of them in one row."""
        return self.errors(self.predicted(z)).ravel()

    def cost(self, z: Array) -> float:
        """Mean squared error, in parts of the measured variables' variance."""
        return self._judged(z)[0]

    def largest(self, z: Array) -> float:
        """Of the residuals' sizes."""
        return self._judged(z)[1]

    def _judged(self, z: Array) -> tuple[float, float]:
        def judged() -> tuple[float, float]:
            found = self.residuals(z)
            return float(np.sum(found**2)), float(np.max(np.abs(found), initial=0.0))

        return _known(self._seen, z, judged)

    def jacobian(self, z: Array, damped: bool = True) -> Array:
        """d(residuals)/dz, a row for each of ``residuals``."""
        n, k, ny = self.runs.measured.shape
        found = np.zeros((n, k * ny, len(z)))
        for rows, _, slopes, _ in self.blocks(z, damped):
            for own, columns in self.by_record(rows):
                found[rows[own, None], : slopes.shape[1], columns] = slopes[own].swapaxes(1, 2)
        return np.asarray(found.reshape(n * k * ny, -1))

    def normal(self, z: Array, other: Array | None = None) -> tuple[float, Array, Array, int]:
        """(cost, J^T r, J^T J, number of runs with damped rows); ``other`` residuals (n, K, ny) in
        place of those at z, or several (n, K, ny, c), whose J^T r are columns.
        """
        if other is not None:
            return self._normal_of(z, other)
        return _known(self._normal, z, lambda: self._normal_of(z, None))

    def _normal_of(self, z: Array, other: Array | None) -> tuple[float, Array, Array, int]:
        several = (1,) if other is None else other.shape[3:]
        gradient, square = np.zeros((len(z), *several)), np.zeros((len(z), len(z)))
        cost, damped = 0.0, 0
        for rows, errors, slopes, wild in self.blocks(z):
            if other is not None:
                errors = other[rows, : slopes.shape[1] // other.shape[2]]
            cost += float(np.sum(errors**2))
            damped += int(wild.sum())
            for own, columns in self.by_record(rows):
                flat = slopes[own].reshape(-1, slopes.shape[2])
                gradient[columns] += flat.T @ errors[own].reshape(len(flat), *several)
                square[np.ix_(columns, columns)] += flat.T @ flat
        return cost, gradient if other is not None else gradient[:, 0], square, damped

    def blocks(
        self, z: Array, damped: bool = True
    ) -> Iterator[tuple[NDArray[np.intp], Array, Array, NDArray[np.bool_]]]:
        """In parts: (runs, residuals (m, K ny), their slopes (m, K ny, unknowns of all runs and of
        the record), which are damped).
        """
        for part, y, slopes in self.computed(z, True):
            m, k, ny = y.shape
            errors = self._error(part.rows, y).reshape(m, k * ny)
            per_spread = slopes / self.spread[:, None]
            size = np.abs(per_spread * self._reach).max(axis=3, initial=0.0)
            size[np.isnan(self.runs.measured[part.rows, :k])] = 0.0
            wild = ~(size <= self._wild)
            if damped:
                with np.errstate(invalid="ignore", divide="ignore"):
                    per_spread *= np.where(wild, self._wild / size, 1.0)[..., None]
            weight = self.weights[part.rows, :k, :, None]
            rows = np.nan_to_num(per_spread * weight, nan=0.0, posinf=0.0, neginf=0.0)
            rows[np.isnan(self.runs.measured[part.rows, :k])] = 0.0
            yield part.rows, errors, rows.reshape(m, k * ny, -1), wild.any(axis=(1, 2))

    def by_record(
        self, rows: NDArray[np.intp]
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Which of some runs depend on the same unknowns, and the places of these in z."""
        shared, own = np.arange(self.unknowns.shared), len(self.unknowns.own_starts)
        record = self.runs.record[rows] * bool(own)
        for r in np.unique(record):
            columns = np.concatenate([shared, len(shared) + r * own + np.arange(own)])
            yield np.flatnonzero(record == r), columns

    # ---- how it is computed -------------------------------------------------------------------
    def _error(self, rows: NDArray[np.intp], predicted: Array) -> Array:
        measured = self.runs.measured[rows, : predicted.shape[1]]
        with np.errstate(over="ignore", invalid="ignore"):
            error = (predicted - measured) / self.spread
        error = np.nan_to_num(error, nan=ASTRAY, posinf=ASTRAY, neginf=-ASTRAY)
        error = np.clip(error, -ASTRAY, ASTRAY)
        error[np.isnan(measured)] = 0.0
        return np.asarray(error * self.weights[rows, : predicted.shape[1]])

    def _reaches(self) -> Array:
        """How far local unknowns may move, in their scales, for WILD: a start by its nominal or, of
        a motion that is smaller, by that, or every row of it would be called wild.
        """
        u, found = self.unknowns, np.ones(self._local)
        order = [v.name for v in self._plant.states]
        velocity = self._plant.positions
        for name, spread in zip(self.runs.names, self.spread, strict=True):
            if name not in order:
                continue
            part = min(1.0, float(spread) / self._plant.variable(name).nominal)
            own = {order.index(n) for n in (name, velocity.get(name, name))}
            places = [j for j, i in u.of("starts") if i in own]
            places += [u.shared + k for k, i in enumerate(u.own_starts) if i in own]
            found[places] = part
        return found

    def _cut(self, deep: bool) -> list[_Part]:
        """Parts of runs of like length that do not take too much memory."""
        runs = self.runs
        width = len(self._plant.states) * (1 + (self._local if deep else 0))
        width += self._count * (5 * len(self._plant.inputs) + 1)
        order = np.argsort(-runs.length, kind="stable")
        parts, first = [], 0
        while first < len(order):
            samples = int(runs.length[order[first]])
            count = max(1, int(MEMORY / (8 * width * (samples + runs.warm))))
            parts.append(_Part(order[first : first + count], samples))
            first += count
        return parts

    def computed(self, z: Array, deep: bool) -> Iterator[tuple[_Part, Array, Array]]:
        """(part, outputs (m, K, ny), slopes (m, K, ny, unknowns of all runs and of the record))."""
        ny = len(self.runs.names)
        for part, _, both in self._run(z, deep):
            slopes = both[..., ny:].reshape(*both.shape[:2], self._local if deep else 0, ny)
            scaled = slopes.transpose(0, 1, 3, 2) * (self._scale if deep else 1.0)
            yield part, both[..., :ny], scaled

    def states(self, z: Array) -> Iterator[tuple[_Part, Array]]:
        """(part, states (m, K, nx)) at the samples."""
        for part, x, _ in self._run(z, False, every=True):
            yield part, x

    def _run(
        self, z: Array, deep: bool, every: bool = False
    ) -> Iterator[tuple[_Part, Array, Array]]:
        """(part, states (m, K, .), outputs (m, K, .)), each with its sensitivities behind it."""
        runs, ny = self.runs, len(self.runs.names)
        driven, delays = self._driven(z)
        x0, s0 = self._begun(z)
        self._came_to(z, x0, s0, deep, every)
        given = self._given(z, delays)
        for part in self._parts[deep]:
            check()
            m, total = len(part.rows), runs.warm + part.samples
            start = x0[part.rows].T
            if deep:
                own = s0[part.rows] / self._scale
                start = np.vstack([start, own.transpose(2, 1, 0).reshape(-1, m)])
            u = _windows(driven, runs, part.rows, total)
            y = np.zeros((ny + 1, m, total))  # what was measured, and whether it corrects
            y[:ny, :, : runs.warm] = runs.seen[part.rows].transpose(2, 0, 1)
            y[ny, :, : runs.warm] = 1.0
            along = self._along(deep, total, m, every)
            x, both = (
                found.reshape(m, total, -1)[:, runs.warm :]
                for found in _computed(along, start, u, y.reshape(ny + 1, -1), given)
            )
            yield part, x, both

    def _along(self, deep: bool, samples: int, count: int, every: bool) -> ca.Function:
        key = (deep, samples, count, every)
        if key not in self._whole:
            self._whole[key] = self._one(deep, every).mapaccum(samples).map(count)
        return self._whole[key]

    def _one(self, deep: bool, every: bool) -> ca.Function:
        """From sample to sample, with sensitivities where it is ``deep``; made when it is used,
        once for all values that a plant may have.
        """
        runs, u, rig = self.runs, self.unknowns, self._rig
        many = self._count * (runs.length + runs.warm).sum() > MANY
        sought = [(r.kind, r.key.members if r.kind == "groups" else r.key) for r in u.rows]
        known = (tuple(d.items()) for d in (rig.gains, rig.offsets, rig.corrections))
        asked = runs.names, bool(runs.warm), tuple(sought[: self._local]), u.shared, *known

        def made() -> ca.Function:
            step, read = _functions(self, deep, every)
            return _sampled(_compiled(step) if many else step, read, self._count)

        key = ("rollout", *asked, self._static, deep, every, many, self._count)
        found: ca.Function = self._plant.cached(key, made)
        return found

    def _given(self, z: Array, delays: Array) -> Array:
        """On what all steps depend: what is sought, in its units, dead times, parameters."""
        shared = self.unknowns.shared
        own = z[:shared] * self._scale[:shared]
        return np.concatenate([own, delays, self._plant.vector("parameter")])

    def _driven(self, z: Array) -> tuple[list[Array], Array]:
        """What drives the steps of all records at the dead times of z, and these [s]."""
        u = self.unknowns
        inputs = [v.name for v in self._plant.inputs]
        delays = np.array([self._rig.delays.get(n, 0.0) for n in inputs])
        for place, members in u.of("delays"):
            delays[list(members)] = z[place] * u.scale[place]
        if self._steps[0] != delays.tobytes() or not self._steps[1]:
            found = [e.steps(delays, self._late, self._count) for e in self.runs.inputs]
            self._steps = delays.tobytes(), [_numbers(f, bool(u.of("delays"))) for f in found]
        return self._steps[1], delays

    def _begun(self, z: Array) -> tuple[Array, Array]:
        """States (n, nx) where runs begin, and their slopes (n, nx, local unknowns)."""
        u, runs, plant = self.unknowns, self.runs, self._plant
        order = [v.name for v in plant.states]
        x0, slopes = runs.x0.copy(), np.zeros((*runs.x0.shape, self._local))
        for name, value in self._rig.starts.items():
            x0[:, order.index(name)] = value
        velocity = plant.positions
        gain, offset = u.sensors(runs.names, self._rig, z)
        for i, name in enumerate(runs.names):
            if name not in order:
                continue
            place = order.index(name)
            x0[:, place] = (x0[:, place] - offset[i]) / gain[i]
            rate = velocity.get(name)
            late = [order.index(rate)] if rate is not None and rate not in runs.names else []
            x0[:, late] /= gain[i]
            for j in (j for j, k in u.of("offsets") if k == i):
                slopes[:, place, j] = -u.scale[j] / gain[i]
            for j in (j for j, k in u.of("gains") if k == i):
                slopes[:, [place, *late], j] = -x0[:, [place, *late]] * u.scale[j] / gain[i]
        for j, place in u.of("starts"):
            x0[:, place] = z[j] * u.scale[j]
            slopes[:, place, j] = u.scale[j]
        own = len(u.own_starts)
        for k, place in enumerate(u.own_starts):
            columns = u.shared + runs.record * own + k
            x0[:, place] = z[columns] * u.scale[columns]
            slopes[:, place, u.shared + k] = u.scale[u.shared + k]
        return x0, slopes

    def _came_to(self, z: Array, x0: Array, slopes: Array, deep: bool, every: bool) -> None:
        """Puts hidden states of runs in the middle of a record to where the plant has come by then:
        from start to start along the inputs, all other states set anew at each of them.
        """
        runs, hidden = self.runs, list(self.unknowns.along)
        driven, delays = self._driven(z)
        given = self._given(z, delays)
        order = np.lexsort((runs.first, runs.record))
        for before, row in pairwise(order if hidden else ()):
            count = int(runs.first[row] - runs.first[before])
            if runs.record[row] != runs.record[before]:
                continue
            start = x0[before]
            if deep:
                start = np.concatenate([start, (slopes[before] / self._scale).T.ravel()])
            u = _windows(driven, runs, np.array([before]), count)
            nothing = np.zeros((len(runs.names) + 1, count))
            last = _computed(self._along(deep, count, 1, every), start, u, nothing, given)[0][-1]
            nx = x0.shape[1]
            x0[row, hidden] = last[hidden]
            if deep:
                slopes[row, hidden] = last[nx:].reshape(-1, nx).T[hidden] * self._scale


def _known(kept: dict[bytes, T], z: Array, found: Callable[[], T]) -> T:
    """What was found at these unknowns: searches from one point ask for the same again."""
    key = z.tobytes()
    if key not in kept:
        value = found()
        if len(kept) >= KEPT:
            del kept[next(iter(kept))]
        kept[key] = value
    return kept[key]


def followed(rollout: Rollout, z: Array) -> bool:
    """Whether no run goes beyond what can be searched from."""
    return bool(rollout.largest(z) < 1e-3 * ASTRAY * np.max(rollout.weights))


def require_followed(rollout: Rollout, z: Array) -> None:
    """FitError where runs go beyond what can be searched from."""
    if not followed(rollout, z):
        raise FitError(
            "the free runs diverge at the plant's values; start elsewhere with "
            "plant.with_values(...), or raise steps"
        )


def spreads(plant: Plant, names: Sequence[str], measured: Array) -> Array:
    """Units in which errors count: the standard deviation of what was measured, or nominals."""
    spread = np.nanstd(measured.reshape(-1, len(names)), axis=0)
    nominal = np.array([plant.variable(v).nominal for v in names])
    return np.asarray(np.where(spread > 1e-9 * nominal, spread, nominal))


def gaps(one: Array, other: Array) -> Array:
    """Root mean square of what runs (n, K, ny) differ by, of each variable (ny,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.nanmean((one - other) ** 2, axis=(0, 1))))


def _late(plant: Plant, runs: Runs, unknowns: RunUnknowns, rig: Rig) -> tuple[tuple[int, ...], ...]:
    """Inputs whose jumps lie between samples, those of one dead time together."""
    samplings = np.array([np.ptp(e.t) / (len(e.t) - 1) for e in runs.inputs if e.held])
    if not samplings.size:
        return ()
    sought = [members for _, members in unknowns.of("delays")]
    free = {i for members in sought for i in members}
    known: dict[float, list[int]] = {}
    for i, v in enumerate(plant.inputs):
        part = (rig.delays.get(v.name, 0.0) / samplings) % 1.0
        if i not in free and np.any((part > 1e-9) & (part < 1 - 1e-9)):
            known.setdefault(rig.delays[v.name], []).append(i)
    return (*sought, *(tuple(members) for members in known.values()))


def _numbers(steps: RunSteps, free: bool) -> Array:
    """(samples, steps, numbers of a step): inputs at its begin and end, its length, and, where dead
    times are sought, what these three gain per second of them.
    """
    shape = steps.begin.shape
    found = [steps.begin, steps.end, steps.length[..., None]]
    if free:
        slope = np.broadcast_to(steps.length_slope, shape)
        found += [steps.begin_slope, steps.end_slope, slope]
    return np.concatenate(found, axis=2)


def _windows(driven: Sequence[Array], runs: Runs, rows: NDArray[np.intp], samples: int) -> Array:
    """Numbers of all steps of a part, (of one sample, runs times samples); the last one holds."""
    found = np.empty((len(rows), samples, *driven[0].shape[1:]))
    for record in np.unique(runs.record[rows]):
        own, mine = driven[int(record)], np.flatnonzero(runs.record[rows] == record)
        place = runs.first[rows[mine], None] + np.arange(samples)
        found[mine] = own[np.minimum(place, len(own) - 1)]
    return np.asarray(found.reshape(len(rows) * samples, -1).T)


def _computed(function: ca.Function, *arguments: Array) -> list[Array]:
    """Its results, transposed: a row for each column. A vector that all columns share is repeated.
    CasADi's matrices would be copied number by number.
    """
    made = Buffered(function)
    for own, given in zip(made.arguments, arguments, strict=True):
        if given.size:
            own.reshape(-1, given.size)[:] = given.ravel(order="F")
    native(made.call)
    return [found.T for found in made.results]


# ---- expressions --------------------------------------------------------------------------
def _functions(rollout: Rollout, deep: bool, every: bool) -> tuple[ca.Function, ca.Function]:
    """Without or with sensitivities, a step: (state, inputs, given) -> (state), and what is read at
    a sample: (state, inputs, (measured, whether it corrects), given) -> (state, outputs).

    What drives a step are inputs at its begin and end, its length, and, where a dead time is
    sought, what these gain per second of it. given : what is sought, in its units; the dead times
    at which the values hold; the plant's parameters, of which those that are sought do not count.
    So the functions are the same, and compiled once, whatever the values.
    """
    plant, runs, static = rollout._plant, rollout.runs, rollout._static
    unknowns, rig = rollout.unknowns.natural, rollout._rig
    nx, nu, ny = len(plant.states), len(plant.inputs), len(runs.names)
    nz = unknowns.shared
    local = nz + len(unknowns.own_starts)
    per_step = nu * (5 if unknowns.of("delays") else 2) + 1
    z, x, s = ca.SX.sym("z", nz), ca.SX.sym("x", nx), ca.SX.sym("s", nx, local)
    at = ca.SX.sym("at", nu)
    u = ca.SX.sym("u", per_step)
    base = ca.SX.sym("base", len(plant.parameters))
    p, more = unknowns.vector(plant, z, base), local - nz
    early, late, h = _driving(unknowns, z, at, u)

    def along(value: ca.SX) -> ca.SX:
        own = ca.horzcat(ca.jacobian(value, z), ca.SX.zeros(value.numel(), more))
        return ca.jacobian(value, x) @ s + own

    wanted = range(nx) if every or static else _needed(plant, runs.names)
    rows = [i if i in wanted else nx for i in range(nx)]

    def rates(q: ca.SX, inputs: ca.SX) -> ca.SX:
        return ca.vertcat(plant.function(q, inputs, p)[0], ca.SX(1, 1))[rows]

    if static:  # a step of Newton's method towards rest
        slope = ca.jacobian(rates(x, late), x)
        after = x - ca.solve(slope, rates(x, late))
        over_z = ca.solve(slope, ca.jacobian(rates(x, late), z)) if nz else ca.SX(nx, 0)
        after_slopes = ca.horzcat(-over_z, ca.SX.zeros(nx, more))
    elif deep:
        first = rates(x, early)
        after, after_slopes = ros2_with_slopes(
            first, lambda q: rates(q, late), (x, s), (z, more), h
        )
    else:
        first = rates(x, early)
        begin = first, ca.jacobian(first, x)
        after = ros2(lambda _: begin, lambda q: rates(q, late), x, h)
    seen = ca.vertcat(*(plant.expression(name) for name in runs.names))
    y = ca.Function("seen", [plant.x, plant.u, plant.p], [seen])(x, late, p)
    gain, offset = (ca.vertcat(*c) for c in unknowns.sensors(runs.names, rig, z))
    y = ca.densify(y * gain + offset)
    measured = ca.SX.sym("measured", ny + 1)
    behind = (measured[:ny] - y) * measured[ny]
    corrected = x + _gains(plant, runs, unknowns, rig, z) @ behind if runs.warm else x
    given, state = ca.vertcat(z, at, base), x
    if deep:
        slopes = along(corrected) if runs.warm else s
        state, after = ca.vertcat(x, ca.vec(s)), ca.vertcat(after, ca.vec(after_slopes))
        y = ca.vertcat(y, ca.vec(ca.densify(along(y))))
        corrected = ca.vertcat(corrected, ca.vec(slopes))
    step = ca.Function("step", [state, u, given], [after], {"cse": True})
    read = ca.Function("read", [state, u, measured, given], [corrected, y])
    return step, read


def _driving(unknowns: RunUnknowns, z: ca.SX, at: ca.SX, u: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Inputs at the begin and end of a step and its length, at the dead times of z; ``u`` holds
    them at the dead times ``at``, with their slopes where some are sought.
    """
    nu = at.numel()
    early, late, h = u[:nu], u[nu : 2 * nu], u[2 * nu]
    if not unknowns.of("delays"):
        return early, late, h
    shift = ca.SX.zeros(nu)
    for place, members in unknowns.of("delays"):
        for i in members:
            shift[i] = z[place] * unknowns.scale[place] - at[i]
    gained = ca.reshape(u[2 * nu + 1 :], nu, 3)
    moved = early + gained[:, 0] * shift, late + gained[:, 1] * shift
    return *moved, h + ca.dot(gained[:, 2], shift)


def _needed(plant: Plant, names: Sequence[str]) -> set[int]:
    """The states that these variables depend on, directly or through others' rates."""
    seen = ca.vertcat(*(plant.expression(name) for name in names))
    rates = plant.function(plant.x, plant.u, plant.p)[0]
    direct = np.array(ca.DM(ca.jacobian(seen, plant.x).sparsity(), 1), dtype=bool)
    over = np.array(ca.DM(ca.jacobian(rates, plant.x).sparsity(), 1), dtype=bool)
    found = set(np.flatnonzero(direct.any(axis=0)).tolist())
    while more := set(np.flatnonzero(over[sorted(found)].any(axis=0)).tolist()) - found:
        found |= more
    return found


def _compiled(step: ca.Function) -> ca.Function:
    """As machine code; itself where there is no compiler."""
    from ...export.machine import machine_function  # loaded where runs are long

    try:
        return machine_function(step, build=True) or step
    except InputError:
        return step


def _sampled(step: ca.Function, read: ca.Function, steps: int) -> ca.Function:
    """All steps of one sampling interval, then what is measured at its end."""
    per_step = step.size1_in(1)
    x = ca.MX.sym("x", step.size1_in(0))
    u = ca.MX.sym("u", per_step * steps)
    measured, given = ca.MX.sym("measured", read.size1_in(2)), ca.MX.sym("given", step.size1_in(2))
    columns = ca.reshape(u, per_step, steps)
    end = step.fold(steps)(x, columns, given) if steps > 1 else step(x, columns, given)
    after, y = read(end, columns[:, steps - 1], measured, given)
    found = [ca.densify(after), ca.densify(y)]
    return ca.Function("sampled", [x, u, measured, given], found)


def _gains(plant: Plant, runs: Runs, unknowns: RunUnknowns, rig: Rig, z: ca.SX) -> ca.SX:
    """What each state gains per error of each measured variable (nx, ny)."""
    order = [v.name for v in plant.states]
    found = ca.SX(len(order), len(runs.names))
    for (state, name), value in rig.corrections.items():
        found[order.index(state), runs.names.index(name)] = value
    for place, (i, k) in unknowns.of("corrections"):
        found[i, k] = z[place] * unknowns.scale[place]
    return found
