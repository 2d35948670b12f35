"""Exact optimal designs: which rows of candidates shrink a covariance most.

Measurements with gradients f (rows, in units of their noise) add their information f f^T to what is
known: C = (M0 + sum f f^T)^-1. All criteria here are convex functions of the information, so the
gradient at a design bounds how far any other design could be better (V. Fedorov, Theory of Optimal
Experiments, 1972; A. Atkinson, A. Donev, R. Tobias, Optimum Experimental Designs, 2007, ch. 9-12).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...core.cases import results_of
from ...core.errors import InputError, UnknownNameError
from ...core.executors import Place
from ..statistics import Array

RIDGE = 1e-9
"""Information added in every direction while a design is sought from nothing, times that of the
candidates.
"""
BETTER = 1e-9
"""Relative improvement below which exchanging ends."""
STARTS = 8
"""Designs from which exchanging begins: one built up point by point, the others random."""


def chosen(free: Sequence[str], parameters: Sequence[str] | None, called: str) -> tuple[int, ...]:
    """Positions of the parameters whose intervals shall shrink, by default of all that are free."""
    wanted = free if parameters is None else parameters
    if isinstance(wanted, str) or not wanted:
        raise InputError(f"parameters = {parameters!r}: give a list of free {called}s")
    for name in wanted:
        if name not in free:
            raise UnknownNameError(f"free {called} in parameters", name, free)
    return tuple(free.index(n) for n in wanted)


@dataclass(frozen=True, eq=False)
class Criterion:
    """What a design makes small, as a function of the covariance C (k, k). chosen : positions of
    the parameters whose ln det C[chosen, chosen] counts (D- or D_s-optimal). weight : W (k, k) of
    the mean variance trace(W C) (A-, c- and I-optimal); then ``chosen`` does not count.
    """

    chosen: tuple[int, ...]
    weight: Array | None = None

    def value(self, covariance: Array) -> float:
        """The criterion; infinite for no covariance."""
        if not np.all(np.isfinite(covariance)):
            return float("inf")
        if self.weight is not None:
            return float(np.sum(self.weight * covariance))
        sign, logarithm = np.linalg.slogdet(covariance[np.ix_(self.chosen, self.chosen)])
        return float(logarithm) if sign > 0 else float("inf")

    def with_one_more(self, covariance: Array, rows: Array) -> Array:
        """The criterion after one more measurement, for each of the rows (m, k); shape (m,)."""
        moved = rows @ covariance
        spread = 1 + np.einsum("ij,ij->i", moved, rows)
        if self.weight is not None:
            gain = np.einsum("ij,jk,ik->i", moved, self.weight, moved) / spread
            return np.asarray(self.value(covariance) - gain)
        block = covariance[np.ix_(self.chosen, self.chosen)]
        part = moved[:, self.chosen]
        gain = np.einsum("ij,ij->i", part, np.linalg.solve(block, part.T).T) / spread
        return np.asarray(self.value(covariance) + np.log1p(-np.minimum(gain, 1 - 1e-15)))

    def slope(self, covariance: Array) -> Array:
        """G (k, k): the criterion falls by f^T G f for a small amount of the measurement f."""
        if self.weight is not None:
            return np.asarray(covariance @ self.weight @ covariance)
        columns = covariance[:, self.chosen]
        return np.asarray(columns @ np.linalg.solve(columns[list(self.chosen)], columns.T))

    def efficiency(self, value: float, least: float) -> float:
        """How good a design is against one of value ``least``: variances' ratio, 1 for the best."""
        if self.weight is not None:
            return float(np.clip(least / value, 0.0, 1.0))
        return float(np.clip(np.exp((least - value) / len(self.chosen)), 0.0, 1.0))

    def scaled(self, sizes: Array) -> Criterion:
        """The same for parameters multiplied by ``sizes``."""
        weight = None if self.weight is None else self.weight / np.outer(sizes, sizes)
        return replace(self, weight=weight)


@dataclass(frozen=True, eq=False)
class Selection:
    """n chosen rows. efficiency : at least this, against the best design of the same candidates."""

    indices: NDArray[np.intp]
    value: float
    efficiency: float


def exchange(
    rows: Array,
    n: int,
    criterion: Criterion,
    information: Array,
    *,
    repeats: int,
    seed: int = 0,
    executor: Place = None,
) -> Selection:
    """The n of the candidates' ``rows`` (m, k) that make the criterion smallest, given M0. Every
    point is exchanged against the best of all candidates until no exchange helps (modified Fedorov
    algorithm: R. Cook, C. Nachtsheim, Technometrics 22 (1980) 315-324), from several starts.
    repeats : how often one candidate may be chosen. Raises InputError for too few candidates, or
    where no n of them determine the parameters.
    """
    if len(rows) * repeats < n:
        raise InputError(
            f"n = {n} points from {len(rows)} candidates, each at most {repeats} times: there are "
            "too few; widen the ranges or allow more repeats"
        )
    sizes = np.sqrt(np.diag(information) + np.mean(rows**2, axis=0))
    if np.any(sizes == 0):
        raise InputError(
            f"no candidate depends on parameter {int(np.argmin(sizes)) + 1}: hold it, or widen the "
            "ranges"
        )
    rows, known = rows / sizes, information / np.outer(sizes, sizes)
    scaled = criterion.scaled(sizes)
    base = known + RIDGE * np.eye(len(known))
    random = np.random.default_rng(seed)
    stock = np.repeat(np.arange(len(rows)), min(repeats, n))
    starts = [_built_up(rows, n, scaled, base, repeats)]
    starts += [random.choice(stock, n, replace=False) for _ in range(STARTS - 1)]
    work = partial(_exchanged, rows, scaled, base, repeats)
    found = results_of(work, starts, executor=executor, chunk=1, what="designs")
    value, indices = min(found, key=lambda pair: pair[0])
    covariance = _inverse(known + rows[indices].T @ rows[indices])
    if covariance is None:
        raise InputError(
            f"{n} points do not determine {rows.shape[1]} parameters with what is known so far: "
            "ask for more points, or hold parameters"
        )
    value = scaled.value(covariance)
    gains = np.einsum("ij,jk,ik->i", rows, scaled.slope(covariance), rows)
    best = float(np.sum(np.sort(np.repeat(gains, min(repeats, n)))[-n:]))
    least = value - max(best - float(np.sum(gains[indices])), 0.0)
    # back to the parameters' own units
    own = 0.0 if criterion.weight is not None else np.sum(np.log(sizes[list(criterion.chosen)]))
    return Selection(np.sort(indices), value - 2 * float(own), scaled.efficiency(value, least))


def _inverse(information: Array) -> Array | None:
    """Covariance, or None where the information is lacking in some direction."""
    values, vectors = np.linalg.eigh(information)
    if values[0] <= 1e-13 * values[-1]:
        return None
    return np.asarray(vectors / values @ vectors.T)


def _one_more(
    rows: Array, criterion: Criterion, base: Array, repeats: int, chosen: NDArray[np.intp]
) -> Array:
    """The criterion with each row beside the chosen ones; infinite where there are enough."""
    covariance = np.linalg.inv(base + rows[chosen].T @ rows[chosen])
    values = criterion.with_one_more(covariance, rows)
    values[np.bincount(chosen, minlength=len(rows)) >= repeats] = np.inf
    return values


def _built_up(
    rows: Array, n: int, criterion: Criterion, base: Array, repeats: int
) -> NDArray[np.intp]:
    chosen = np.empty(0, dtype=np.intp)
    for _ in range(n):
        chosen = np.append(chosen, np.argmin(_one_more(rows, criterion, base, repeats, chosen)))
    return chosen


def _exchanged(
    rows: Array, criterion: Criterion, base: Array, repeats: int, begun: NDArray[np.intp]
) -> tuple[float, NDArray[np.intp]]:
    chosen = begun.copy()
    value = criterion.value(np.linalg.inv(base + rows[chosen].T @ rows[chosen]))
    while True:
        before = value
        for place in range(chosen.size):
            values = _one_more(rows, criterion, base, repeats, np.delete(chosen, place))
            best = int(np.argmin(values))
            if values[best] < value - BETTER * abs(value):
                chosen[place], value = best, float(values[best])
        if not value < before - BETTER * abs(before):
            return value, chosen


def refine(
    points: Array,
    steps: Array,
    gradient: Callable[[Array], Array],
    criterion: Criterion,
    information: Array,
    halvings: int = 7,
) -> Array:
    """Points (n, d) moved off the grid of candidates, to where the criterion is smallest: each in
    turn to the best of a grid of 5^d around it, whose width begins with ``steps`` (d,) and is
    halved when no point moves. ``gradient`` gives rows at points, NaN where nobody may measure.
    """
    points, width = points.copy(), steps.astype(float)
    sizes = np.sqrt(np.diag(information) + np.sum(gradient(points) ** 2, axis=0))
    rows, known = gradient(points) / sizes, information / np.outer(sizes, sizes)
    scaled = criterion.scaled(sizes)
    around = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * points.shape[1]), -1)
    around = around.reshape(-1, points.shape[1])
    for _ in range(halvings):
        for _ in range(20):
            moved = False
            for place in range(len(points)):
                others = np.delete(rows, place, axis=0)
                covariance = np.linalg.inv(known + RIDGE * np.eye(len(known)) + others.T @ others)
                near = points[place] + around * width
                found = gradient(near) / sizes
                good = np.all(np.isfinite(found), axis=1)
                values = np.full(len(near), np.inf)
                values[good] = scaled.with_one_more(covariance, found[good])
                best, here = int(np.argmin(values)), float(values[len(near) // 2])
                if values[best] < here - BETTER * abs(here):
                    points[place], rows[place], moved = near[best], found[best], True
            if not moved:
                break
        width /= 2
    return points
