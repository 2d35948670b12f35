"""The least-squares problem of holds, and its optimum."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError, UnknownNameError, require_ends
from ...core.stop import check
from ..statistics import Array
from .hold_model import HoldModel
from .least_squares import BISQUARE, HUBER, Sums, Terms, spread
from .local_optimum import descend

__all__ = ["Holds", "settled"]

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
        self.own = [v.causality == "parameter" for v in self.variables]
        start = [
            float(v.start or 0.0) if p else 0.0
            for v, p in zip(self.variables, self.own, strict=True)
        ]
        self.start = np.array(start)
        self.nominal = np.array([v.nominal for v in self.variables])

    def limits(self, bounds: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
        """Lower and upper bounds of the estimates. Raises InputError, UnknownNameError."""
        pairs = zip(self.variables, self.own, strict=True)
        low, high = (
            list(e)
            for e in zip(
                *((v.min, v.max) if p else (-np.inf, np.inf) for v, p in pairs), strict=True
            )
        )
        for i, name in enumerate(self.names):
            low[i] = 0.0 if name.startswith("band.") else low[i]
        for name, ends in bounds.items():
            if name not in self.names:
                raise UnknownNameError("estimate in bounds", name, self.names)
            i = self.names.index(name)
            first, second = require_ends(f"bounds[{name!r}]", ends, self.variables[i].unit)
            low[i], high[i] = max(low[i], first), min(high[i], second)
        return np.array(low), np.array(high)

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
    """Least squares of residuals times ``factors`` (n, y) within bounds; ``moved`` (k,) estimates
    change, by default all.
    """
    free = np.ones(len(start), dtype=bool) if moved is None else moved
    squares = _Weighted(problem, factors, free)
    low, high = (end[None, free] for end in limits)
    ended = descend(squares, start[None], low, high)
    if not np.isfinite(ended.cost[0]):
        raise FitError(
            "the plant finds no rest at these pressures near the measured positions; give start "
            "values nearer to the truth (plant.with_values(...)) or bounds"
        )
    found: Array = ended.coefficients[0]
    return found


class _End(NamedTuple):
    """What estimates cost, and where the plant then rests (n, sought)."""

    cost: float
    estimates: Array
    z: Array | None


class _Nested:
    """Optima of a fit and of the poorer ones, which hold some estimates at the plant's values.

    A muscle that goes slack on the way makes several optima. Each fit is begun at the plant's
    values, over the linear model at the measured positions, which needs no rest to be found, and
    at the optima with one estimate fewer, which count themselves: a richer fit is never worse.
    """

    def __init__(self, problem: Holds, limits: tuple[Array, Array], factors: Array) -> None:
        self.problem, self.limits, self.factors = problem, limits, factors
        self.known: dict[tuple[bool, ...], list[_End]] = {}
        self.wrong = FitError("the plant finds no rest at these pressures")

    def best(self, moved: tuple[bool, ...]) -> list[_End]:
        """The optimum of the ``moved`` estimates; nothing where there is none."""
        if moved not in self.known:
            count, poorer = sum(moved), []
            if count > 1 and (count <= MOST_NESTED or all(moved)):
                for i in (i for i, free in enumerate(moved) if free):
                    poorer += self.best((*moved[:i], False, *moved[i + 1 :]))
            ends = [*poorer, *self._ends(np.array(moved), poorer)]
            self.known[moved] = sorted(ends, key=lambda end: end.cost)[:1]
        return self.known[moved]

    def _ends(self, free: NDArray[np.bool_], poorer: list[_End]) -> Iterator[_End]:
        problem, first = self.problem, self.problem.start
        problem.z = None
        linear = _minimised(problem, first, self.limits, self.factors, free)
        starts = [_End(0.0, first, None), _End(0.0, linear, None), *poorer]
        for start in starts:
            at = start.estimates
            problem.z = problem.model.anchored(at[: problem.inner]) if start.z is None else start.z
            try:
                found = _minimised(problem, at, self.limits, self.factors, free)
            except FitError as error:
                self.wrong = error
                continue
            cost = float(np.sum((problem(found)[0] * self.factors) ** 2))
            if np.isfinite(cost):
                yield _End(cost, found, problem.z)


def _begun(problem: Holds, limits: tuple[Array, Array], factors: Array) -> Array:
    """The best optimum that is found; the problem rests there."""
    nested = _Nested(problem, limits, factors)
    ends = nested.best((True,) * len(problem.names))
    if not ends:
        raise nested.wrong
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
