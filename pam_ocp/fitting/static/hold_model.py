"""Where a plant rests, at many holds side by side, with derivatives in what is to be estimated.

Per hold some inputs and states are given (a measured pressure, say); the others follow from the
rates that vanish. Held memories (hysteresis) have the value that they take on the way to the hold,
dry friction its full size against that way. Their distances from what was measured are a
least-squares problem, whose optimum among several is found here, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError, InputError, UnknownNameError, require_ends
from ...core.stop import check
from ...numerics.elementwise import Elementwise
from ...operating.held import held
from ...plants.plant import Plant
from ..statistics import Array
from .least_squares import BISQUARE, HUBER, Sums, Terms, spread
from .local_optimum import descend

CREEP, SHARP = 1e-9, 1e-11
"""Speed [m/s, rad/s] at which a position creeps into rest, and below which friction is rounded off:
far below all damping, so that friction is what it is on the way.
"""
STEPS, HALVINGS = 40, 8
SETTLED = 1e-11
"""Step, in nominal sizes, at which an equilibrium counts as found."""
BLOCK = 4096
"""Holds that are computed at a time; the results of all operations take memory for so many."""


@dataclass(frozen=True, eq=False)
class HoldModel:
    """The equilibria of n holds as functions of k parameters. given : values (n,) of inputs and
    states. measured : what is compared. parameters : of the plant, to be estimated. zeroed : given
    variables whose sensor may have a zero, in the order of the estimates behind the parameters.
    side : (n,), the way in which each hold was come to. start : (n, states that are sought), where
    Newton's method begins.
    """

    plant: Plant
    given: Mapping[str, Array]
    measured: Sequence[str]
    parameters: Sequence[str]
    zeroed: Sequence[str]
    side: Array
    sought: Sequence[str]
    function: Elementwise
    constants: tuple[Array, ...]
    start: Array
    nominal: Array

    @classmethod
    def of(
        cls,
        plant: Plant,
        given: Mapping[str, Array],
        measured: Sequence[str],
        parameters: Sequence[str],
        zeroed: Sequence[str],
        side: Array,
        near: Mapping[str, Array],
    ) -> HoldModel:
        """near : measured values of states that are sought, where to begin."""
        velocities = {v: x for x, v in plant.positions.items() if x not in given}
        memories = [v.name for v in plant.states if v.memory == "held" and v.name not in given]
        sought = [
            v.name
            for v in plant.states
            if v.name not in given and v.name not in memories and v.name not in velocities
        ]
        rows = [plant.positions.get(n, n) for n in sought]
        symbols = _Symbols(plant)
        unknown, told = symbols.take(sought), symbols.take(list(given))
        moving, kept = symbols.take(list(velocities)), symbols.take(memories)
        free, zeros = symbols.take(list(parameters)), [ca.SX.sym(f"zero {n}") for n in zeroed]
        for name, zero in zip(zeroed, zeros, strict=True):
            symbols.shift(name, zero)
        unit = [plant.variable(r).nominal for r in rows]
        equations = [
            symbols.put(plant.expression(f"der({r})")) / u for r, u in zip(rows, unit, strict=True)
        ]
        compared = [symbols.put(plant.expression(n)) for n in measured]
        _require_told(plant, ca.vertcat(*equations, *compared), symbols)
        estimates = ca.vertcat(*free, *zeros)
        residual, y, z = ca.vertcat(*equations), ca.vertcat(*compared), ca.vertcat(*unknown)
        found = [residual, ca.jacobian(residual, z), ca.jacobian(residual, estimates)]
        found += [y, ca.jacobian(y, z), ca.jacobian(y, estimates)]
        arguments = [z, estimates, ca.vertcat(*told), ca.vertcat(*moving), ca.vertcat(*kept)]
        function = ca.Function("holds", arguments, [ca.densify(ca.SX(f)) for f in found])
        start = [
            np.broadcast_to(near.get(n, plant.variable(n).start or 0.0), side.shape) for n in sought
        ]
        return cls(
            plant,
            given,
            measured,
            parameters,
            zeroed,
            side,
            sought,
            Elementwise(function),
            (*given.values(), *[CREEP * side for _ in velocities], *_kept(plant, memories, side)),
            np.stack(start, axis=1),
            np.array([plant.variable(n).nominal for n in sought]),
        )

    def at(self, z: Array, estimates: Array) -> list[Array]:
        """Residuals, their derivatives in z and estimates; the same of what is measured."""
        blocks = [
            self._at(slice(low, low + BLOCK), z[low : low + BLOCK], estimates)
            for low in range(0, max(len(z), 1), BLOCK)
        ]
        return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]

    def _at(self, part: slice, z: Array, estimates: Array) -> list[Array]:
        n, m, k, y = len(z), len(self.sought), len(estimates), len(self.measured)
        flat = self.function(*z.T, *estimates, *(c[part] for c in self.constants))
        sizes = [(m,), (m, m), (m, k), (y,), (y, m), (y, k)]
        found, first = [], 0
        for size in sizes:
            count = int(np.prod(size))
            parts = [np.broadcast_to(v, (n,)) for v in flat[first : first + count]]
            first += count
            block = np.stack(parts, axis=1) if parts else np.empty((n, 0))
            # CasADi counts down the columns
            found.append(block if len(size) == 1 else block.reshape(n, *size[::-1]).swapaxes(1, 2))
        return found

    def solved(
        self, estimates: Array, start: Array, moved: Sequence[int] | None = None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Where the plant rests (n, sought), and which holds were found; only states ``moved`` are
        free.
        """
        places = list(range(len(self.sought)) if moved is None else moved)
        z, part, nominal = start.copy(), np.ones(len(start)), self.nominal[places]

        def newton(z: Array) -> tuple[Array, Array]:
            """The step (n, moved), and its length in nominal sizes."""
            residual, slopes, *_ = self.at(z, estimates)
            with np.errstate(all="ignore"):
                inverse = _inverted(slopes[:, places][:, :, places])
                step = -np.einsum("nij,nj->ni", inverse, residual[:, places])
                return step, np.max(np.abs(step) / nominal, axis=1)

        step, size = newton(z)
        done = np.zeros(len(z), dtype=bool)
        for _ in range(STEPS):
            trial = z.copy()
            trial[:, places] += part[:, None] * np.where(done[:, None], 0.0, step)
            new, length = newton(trial)
            # a shorter step that the next one does not undo (natural monotonicity, P. Deuflhard)
            better = (length <= (1 - part / 4) * size) | (length < SETTLED) | (part < 0.5**HALVINGS)
            better &= np.isfinite(length) & ~done
            z[better], step[better], size[better] = trial[better], new[better], length[better]
            part = np.where(better, np.minimum(2 * part, 1.0), part / 2)
            done |= size < SETTLED
            if done.all():
                break
        return z, done

    def anchored(self, estimates: Array) -> Array:
        """The start (n, sought), with what was not measured at rest at the measured positions."""
        other = [i for i, n in enumerate(self.sought) if n not in self.measured]
        return self.solved(estimates, self.start, other)[0] if other else self.start.copy()

    def predicted(self, estimates: Array, start: Array | None) -> tuple[Array, Array, Array]:
        """Measured variables (n, y) as they should be, their derivatives (n, y, k), and z. Without
        a ``start``, and where Newton's method finds no rest, by the linear model at the measured
        positions.
        """
        z = self.anchored(estimates) if start is None else self.solved(estimates, start)[0]
        residual, slopes, by, y, y_z, y_by = self.at(z, estimates)
        inverse = _inverted(slopes)
        moved = -np.einsum("nij,nj->ni", inverse, residual)
        value = y + np.einsum("nyi,ni->ny", y_z, moved)
        return np.asarray(value), np.asarray(y_by - y_z @ inverse @ by), z


class _Symbols:
    """A plant's symbols, some replaced by one's own, the rest by the plant's values."""

    def __init__(self, plant: Plant) -> None:
        self.names = [v.name for v in (*plant.states, *plant.inputs, *plant.parameters)]
        self.old = ca.vertcat(plant.x, plant.u, plant.p)
        self.new: dict[str, Any] = {}
        self.plant = plant
        for v in plant.parameters:
            sharp = v.widest > 0 and v.unit in ("m/s", "rad/s")
            self.new[v.name] = SHARP if sharp else v.start

    def take(self, names: Sequence[str]) -> list[ca.SX]:
        for name in names:
            self.new[name] = ca.SX.sym(name)
        return [self.new[n] for n in names]

    def shift(self, name: str, zero: ca.SX) -> None:
        self.new[name] = self.new[name] - zero

    def open(self) -> list[str]:
        return [n for n in self.names if n not in self.new]

    def put(self, expression: ca.SX) -> ca.SX:
        symbols = ca.vertsplit(self.old)
        new = [ca.SX(self.new.get(n, s)) for n, s in zip(self.names, symbols, strict=True)]
        return ca.SX(ca.substitute([expression], [self.old], [ca.vertcat(*new)])[0])


def _require_told(plant: Plant, expressions: ca.SX, symbols: _Symbols) -> None:
    left = {s.name() for s in ca.symvar(expressions)}
    own = dict(zip(symbols.names, ca.vertsplit(symbols.old), strict=True))
    for name in symbols.open():
        if own[name].name() in left and ca.depends_on(expressions, own[name]):
            raise InputError(
                f"the rest of {plant.name!r} depends on {name}: give it in a column, or as a "
                f"constant, inputs={{{name!r}: ...}}"
            )


def _kept(plant: Plant, memories: Sequence[str], side: Array) -> list[Array]:
    """Values (n,) of the held memories, slid fully on the way; those of a virgin without one."""
    below, above, virgin = (held(plant, m) for m in ("below", "above", "virgin"))
    return [np.where(side > 0, below[n], np.where(side < 0, above[n], virgin[n])) for n in memories]


def _inverted(matrices: Array) -> Array:
    good = np.isfinite(matrices).all(axis=(1, 2))
    safe = np.where(np.asarray(good)[:, None, None], matrices, np.eye(matrices.shape[1]))
    try:
        found = np.linalg.inv(safe)
    except np.linalg.LinAlgError:
        found = np.linalg.pinv(safe)
    return np.where(np.asarray(good)[:, None, None], found, np.nan)


ROUNDS = 30
MOST_NESTED = 3
"""Estimates up to which all poorer fits are found first; of more, those with one fewer."""


class Holds:
    """Residuals (n, y) of holds over estimates (k,): the model's, then outer zeros and bands."""

    def __init__(self, model: HoldModel, y: Array, names: list[str], way: Array) -> None:
        self.model, self.y, self.names, self.way = model, y, names, way
        self.inner = len(model.parameters) + len(model.zeroed)
        self.z: Array | None = None  # at first the linear model at the measured positions
        plant = model.plant
        self.variables = [
            plant.variable(n.removeprefix("zero.").removeprefix("band.")) for n in names
        ]
        self.own = np.array([v.causality == "parameter" for v in self.variables])
        self.start = np.where(self.own, [float(v.start or 0.0) for v in self.variables], 0.0)
        self.nominal = np.array([v.nominal for v in self.variables])

    def limits(self, bounds: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
        """Lower and upper bounds of the estimates. Raises InputError, UnknownNameError."""
        low = np.where(self.own, [v.min for v in self.variables], -np.inf)
        high = np.where(self.own, [v.max for v in self.variables], np.inf)
        low[[n.startswith("band.") for n in self.names]] = 0.0
        for name, ends in bounds.items():
            if name not in self.names:
                raise UnknownNameError("estimate in bounds", name, self.names)
            i = self.names.index(name)
            first, second = require_ends(f"bounds[{name!r}]", ends, self.variables[i].unit)
            low[i], high[i] = max(low[i], first), min(high[i], second)
        return low, high

    def __call__(self, estimates: Array) -> tuple[Array, Array]:
        """Measured less predicted (n, y), and its derivatives (n, y, k)."""
        check()
        value, slopes, z = self.model.predicted(estimates[: self.inner], self.z)
        if self.z is not None and np.isfinite(value).all():
            self.z = z
        rest = self.y - value
        outer = np.zeros((*rest.shape, len(self.names) - self.inner))
        for i, name in enumerate(self.names[self.inner :]):
            kind, _, variable = name.partition(".")
            column = list(self.model.measured).index(variable)
            effect = np.ones(len(rest)) if kind == "zero" else -self.way
            rest[:, column] -= effect * estimates[self.inner + i]
            outer[:, column, i] = -effect
        return rest, np.concatenate([-slopes, outer], axis=2)


class _Weighted:
    """The squares of residuals times ``factors`` (n, y), of which the ``free`` estimates move."""

    def __init__(self, problem: Holds, factors: Array, free: NDArray[np.bool_]) -> None:
        self.problem, self.factors = problem, factors
        self.free = np.nonzero(free)[0].tolist()
        self.size = float(np.linalg.norm(problem.y * factors))

    def sums(self, coefficients: Array, second: bool = False) -> Sums:
        """The quadratic model at estimates (m, k), without second derivatives."""
        m, k = coefficients.shape
        found = Sums(np.empty(m), np.empty((m, k)), np.empty((m, k, k)), np.zeros((m, k, k)))
        for row, estimates in enumerate(coefficients):
            rest, slopes = self.problem(estimates)
            r = (rest * self.factors).ravel()
            jacobian = -(slopes * self.factors[:, :, None]).reshape(-1, k)
            found.cost[row], found.right[row] = r @ r, jacobian.T @ r
            found.normal[row] = jacobian.T @ jacobian
        return found


def _minimised(
    problem: Holds,
    start: Array,
    limits: tuple[Array, Array],
    factors: Array,
    moved: NDArray[np.bool_] | None = None,
) -> Array:
    """Least squares of residuals times ``factors`` (n, y) within bounds; ``moved`` : or all."""
    free = np.ones(len(start), dtype=bool) if moved is None else moved
    squares = _Weighted(problem, factors, free)
    low, high = (end[None, free] for end in limits)
    ended = descend(squares, start[None], low, high)
    if not np.isfinite(ended.cost[0]):
        raise FitError(
            "the plant finds no rest at these pressures near the measured positions; give start "
            "values nearer to the truth (plant.with_values(...)) or bounds"
        )
    return np.asarray(ended.coefficients[0])


class _End(NamedTuple):
    """What estimates cost, and where the plant then rests (n, sought)."""

    cost: float
    estimates: Array
    z: Array | None


def _begun(problem: Holds, limits: tuple[Array, Array], factors: Array) -> Array:
    """The best optimum that is found; the problem rests there. A muscle that goes slack on the way
    makes several optima. Begun at the plant's values, over the linear model at the measured
    positions, and at the optima of the poorer fits, which count themselves: a richer fit is never
    worse.
    """
    model, first = problem.model, problem.start
    wrong: list[FitError] = []

    def followed(free: NDArray[np.bool_], poorer: list[_End]) -> Iterator[_End]:
        problem.z = None
        linear = _minimised(problem, first, limits, factors, free)
        for start in [_End(0.0, first, None), _End(0.0, linear, None), *poorer]:
            at = start.estimates
            problem.z = model.anchored(at[: problem.inner]) if start.z is None else start.z
            try:
                found = _minimised(problem, at, limits, factors, free)
            except FitError as error:
                wrong.append(error)
                continue
            cost = float(np.sum((problem(found)[0] * factors) ** 2))
            if np.isfinite(cost):
                yield _End(cost, found, problem.z)

    @cache
    def best(moved: tuple[bool, ...]) -> list[_End]:
        """The optimum of the ``moved`` estimates; nothing where there is none."""
        count, poorer = sum(moved), []
        if count > 1 and (count <= MOST_NESTED or all(moved)):
            for i in (i for i, free in enumerate(moved) if free):
                poorer += best((*moved[:i], False, *moved[i + 1 :]))
        return sorted([*poorer, *followed(np.array(moved), poorer)], key=lambda end: end.cost)[:1]

    ends = best((True,) * len(problem.names))
    if not ends:
        raise wrong[-1] if wrong else FitError("the plant finds no rest at these pressures")
    problem.z = ends[0].z
    return ends[0].estimates


def settled(
    problem: Holds,
    limits: tuple[Array, Array],
    sizes: Array,
    noise: Any,
    compared: Sequence[str],
    loss: str,
) -> tuple[Array, Array, Array, Terms]:
    """Estimates, the size of errors of each variable, robust factors (n, y), and the loss."""
    weights = np.ones_like(problem.y)
    if noise is None and len(compared) > 1:
        sizes = np.array([problem.model.plant.variable(n).nominal for n in compared])
    found = _begun(problem, limits, weights / sizes)
    k = len(problem.names)
    for _ in range(ROUNDS if noise is None and len(compared) > 1 else 0):
        new = np.sqrt(np.mean(problem(found)[0] ** 2, axis=0))
        new = np.maximum(new, 1e-9 * np.abs(problem.y).max(axis=0))
        change = np.abs(np.log(new / sizes)).max()
        sizes = new
        found = _minimised(problem, found, limits, weights / sizes)
        if change < 1e-6:
            break
    terms = Terms()
    for kind, edge in {
        "squares": [],
        "huber": [("huber", HUBER)],
        "bisquare": [("huber", HUBER), ("bisquare", BISQUARE)],
    }[loss]:
        for _ in range(ROUNDS):
            rest = (problem(found)[0] / sizes).ravel()
            if kind == "huber" or terms.loss != kind:
                terms = Terms(kind, edge * max(spread(rest, k), 1e-12))  # type: ignore[arg-type]
            weights = terms.reweighting(rest, 0.0).reshape(problem.y.shape)
            before, found = found, _minimised(problem, found, limits, weights / sizes)
            if np.max(np.abs(found - before) / problem.nominal) < 1e-9:
                break
    return found, sizes, weights, terms
