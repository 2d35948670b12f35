"""The global optimum of a static fit: a scan over the nonlinear coefficients, then descents.

The scan takes both signs and several decades of the nonlinear coefficients only, the others
projected out; of a large table it looks at some cells from everywhere. The best are followed over
all coefficients and cells, with exact derivatives.

A loss that counts cells far off no more begins where wrong cells cannot pull, at least trimmed
squares: the cells with the largest residuals are left out, up to 15 % of all, and the coefficients
sought whose other cells fit best (P. Rousseeuw, K. van Driessen, Computing LTS regression for large
data sets, Data Min. Knowl. Disc. 12 (2006) 29-45). At most half of a contraction level may be left
out: a law that misses a whole level does not bend far enough, which is no error of measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError
from ..statistics import Array
from .least_squares import BISQUARE, LeastSquares, least_squares
from .local_optimum import (
    STATIONARY,
    Minimum,
    Problem,
    by_ipopt,
    descend,
    local_optima,
    optima_of_each,
)

TRIMMED = 0.15
"""Part of the cells that may be wrong."""
SUBSETS = 400
"""Random subsets in all."""
NONLINEAR = (20, 60)
"""Values of one nonlinear coefficient that they are spread over; of several together."""
FOLLOWED = 6
"""How many of the best are followed to the end."""
STEPS = 40


def robust_start(problem: LeastSquares) -> tuple[Array, float]:
    """Coefficients (all) from which to seek the optimum of a bisquare, and where it ends [N].
    Twice: what lies beyond the end at first is taken out before scale and start are found again, so
    that wrong cells do not change how many of the others are left out. Raises FitError.
    """
    least = 1e-9 * problem.size
    within = replace(problem, terms=replace(problem.terms, loss="bisquare"))
    for _ in range(2):
        starts, scale = trimmed_start(within)
        edge = BISQUARE * max(scale, least)
        terms = replace(problem.terms, threshold=edge)
        found = local_optima(replace(within, terms=terms), starts[:1], SUBSETS)[0].coefficients
        near = np.abs(problem.evaluate(found[None])[0][0]) < edge
        if near.all() or int(near.sum()) <= len(problem.free):
            break
        within = replace(within, cells=problem.cells.subset(near), weights=problem.weights[near])
    return found, edge


def trimmed_start(problem: LeastSquares) -> tuple[Array, float]:
    """Coefficients (m, all), the best first, and the standard deviation of the cells kept [N]: that
    of normal errors whose largest were left out. Raises FitError where no law is finite.
    """
    trim = _Trim.of(problem)
    followed = [_followed(problem, c, trim) for c in _candidates(problem, trim)]
    followed.sort(key=lambda pair: pair[1])
    kept = len(problem.cells) - trim.count
    freedom = max(kept - len(problem.free), 1)
    return np.array([c for c, _ in followed]), float(
        np.sqrt(followed[0][1] / freedom) * _normal_factor(trim.count / len(problem.cells))
    )


def _normal_factor(share: float) -> float:
    """Standard deviation of normal errors over that of those without the largest ``share``."""
    from scipy.special import ndtri

    if not share:
        return 1.0
    q = float(ndtri(1 - share / 2))
    density = float(np.exp(-(q**2) / 2) / np.sqrt(2 * np.pi))
    return float((1 - 2 * q * density / (1 - share)) ** -0.5)


@dataclass(frozen=True, eq=False)
class _Trim:
    """Which cells are left out: the ``count`` largest residuals, at most half of a level."""

    count: int
    groups: tuple[NDArray[np.intp], ...]

    @classmethod
    def of(cls, problem: LeastSquares) -> _Trim:
        level = problem.cells.levels()
        groups = tuple(np.nonzero(level == i)[0] for i in range(level.max() + 1))
        spare = max(len(problem.cells) - len(problem.free) - 1, 0)
        allowed = sum(g.size // 2 for g in groups)
        return cls(min(int(TRIMMED * len(problem.cells)), spare, allowed), groups)

    def kept(self, residuals: Array) -> NDArray[np.bool_]:
        """For each row (m, n) of residuals."""
        size = np.abs(residuals)
        open_ = np.zeros_like(size)
        for group in self.groups:
            here = size[:, group]
            rank = np.argsort(np.argsort(-here, axis=1), axis=1)
            open_[:, group] = np.where(rank < group.size // 2, here, -1.0)
        order = np.argsort(-open_, axis=1, kind="stable")[:, : self.count]
        result = np.ones(size.shape, dtype=bool)
        np.put_along_axis(result, order, False, axis=1)
        return result

    def cost(self, residuals: Array) -> Array:
        """Sum of squares (m,) of the cells kept."""
        with np.errstate(over="ignore"):
            squares = np.where(self.kept(residuals), residuals, 0.0) ** 2
            return np.asarray(np.sum(squares, axis=1))


def _candidates(problem: LeastSquares, trim: _Trim) -> Array:
    """The best coefficients (FOLLOWED, all) through random subsets, after two improvements."""
    random = np.random.default_rng(19840701)
    values = _points(problem, NONLINEAR[1], random)
    if len(problem.scales) == 1:
        values = values[np.linspace(0, len(values) - 1, NONLINEAR[0]).astype(int)]
    c, target, columns, good = problem.linear_in(values, problem.evaluate)
    if not good.any():
        raise FitError(f"the {problem.law.name} law gives no finite force anywhere in the scan")
    per = max(SUBSETS // int(good.sum()), 10)
    n, k = len(problem.cells), max(len(problem.linear), 1)
    found, costs = [], []
    for row, y, a in zip(c[good], target[good], columns[good], strict=True):
        drawn = np.argsort(random.random((per, n)), axis=1)[:, :k]
        parts, _ = least_squares(a[drawn], y[drawn])
        for _ in range(3):
            weights = trim.kept(y - parts @ a.T).astype(float)
            parts, _ = least_squares(a * weights[:, :, None], y * weights)
        cost = trim.cost(y - parts @ a.T)
        best = int(np.argmin(cost))
        whole = row.copy()
        whole[problem.linear] = parts[best]
        found.append(whole)
        costs.append(cost[best])
    return np.array(found)[np.argsort(costs)[:FOLLOWED]]


def _points(problem: Problem, count: int, random: np.random.Generator) -> Array:
    """Places (m, k) of the nonlinear coefficients: the scale of one, random ones of several."""
    scales = problem.scales
    if len(scales) == 1:
        return np.sort(scales[0])[:, None]
    if not scales:
        return np.zeros((1, 0))
    return np.stack([random.choice(s, count) for s in scales], axis=1)


def _followed(problem: LeastSquares, start: Array, trim: _Trim) -> tuple[Array, float]:
    """The least squares of the cells kept, and which are kept, in turns, as long as they fall."""
    low, high = (end[None] for end in problem.bounds())
    c, cost = start, np.inf
    for _ in range(STEPS):
        kept = trim.kept(problem.residuals(c[None]))[0]
        part = replace(problem, cells=problem.cells.subset(kept), weights=problem.weights[kept])
        found = descend(part, c[None], low, high).coefficients
        least = float(trim.cost(problem.residuals(found))[0])
        if not least < cost * (1 - 1e-10):
            break
        c, cost = found[0], least
    return c, cost


class Effort(NamedTuple):
    """points : of the scan with several nonlinear unknowns. followed : local minima of it."""

    points: int
    followed: int


WIDE = Effort(400, 60)
NEAR = Effort(100, 6)
"""With a start that is known to be near."""
BETTER = 1.5
"""Times the cost at that start, up to which places of a scan of one coefficient are followed."""
POLISHED_ALONE = 3
"""As many for a law with one nonlinear coefficient."""
FLAT = 1e-7
"""Part of the cost by which a point that is not stationary must be better to count at all."""
DOUBT = (
    "the optimum is so flat, or so near to where the law degenerates, that the solver came to no "
    "stationary point: other coefficients may fit as well (see condition and rank)"
)


def minimise(
    problem: Problem,
    start: Array | None = None,
    begin: Array | None = None,
    effort: Effort = WIDE,
) -> Minimum:
    """The global optimum: scan, follow up the best few.

    Tukey's bisquare, which counts cells far off no more, has an optimum for every choice of those:
    what is sought is the one next to ``begin`` (all coefficients), a start that wrong cells cannot
    pull; it is found anew where it is not given.

    start : values (m, k) of the nonlinear coefficients to try beside the scan. effort : of the
    scan; NEAR where these are those of almost the same table.
    """
    if isinstance(problem, LeastSquares) and problem.terms.loss == "bisquare":
        begin = robust_start(problem)[0] if begin is None else begin
        starts, scanned = begin[None], SUBSETS
    else:
        starts, scanned = _scan(problem.thinned(), start, effort)
    return _best(problem, local_optima(problem, starts, scanned))


def minimise_near(
    problems: Sequence[LeastSquares], start: Array | None
) -> list[Minimum | FitError]:
    """The global optima of fits of one law to tables that are almost the same, or why none.
    start : nonlinear coefficients (1, k) of the optimum of such a table.
    """
    found: list[Minimum | FitError] = [FitError("")] * len(problems)
    begun: dict[int, tuple[Array, int]] = {}
    for i, problem in enumerate(problems):
        try:
            if problem.terms.loss == "bisquare":
                found[i] = minimise(problem)
            else:
                begun[i] = _starts_near(problem, start)
        except FitError as error:
            found[i] = error
    followed = optima_of_each([problems[i] for i in begun], list(begun.values()))
    for i, optima in zip(begun, followed, strict=True):
        try:
            found[i] = _best(problems[i], optima)
        except FitError as error:
            found[i] = error
    return found


def _starts_near(problem: LeastSquares, start: Array | None) -> tuple[Array, int]:
    """Of one coefficient a thin scan suffices, and of it what may lead to less; of several no place
    of a scan tells where its descent ends.
    """
    if start is None or len(problem.scales) != 1:
        return _scan(problem.thinned(), start, NEAR)
    points = np.concatenate([start, np.sort(problem.scales[0])[::3, None]])
    squares, coefficients = problem.thinned().project(points)
    if not np.isfinite(squares[0]):
        return _scan(problem.thinned(), start, WIDE)
    low = np.where(squares <= BETTER * squares[0], squares, np.inf)
    return _distinct(coefficients, low, list(problem.nonlinear), NEAR.followed), len(points)


def _best(problem: Problem, optima: list[Minimum]) -> Minimum:
    """The least of local optima that is stationary; raises FitError where none is finite."""
    found = [o for o in optima if np.isfinite(o.cost)]
    if not found:
        raise FitError(
            f"the {problem.law.name} law gives no finite force near any point of the scan; hold "
            "the nonlinear coefficients with fixed=... "
            f"({', '.join(problem.names[i] for i in problem.nonlinear)}) and look at the residuals"
        )
    floor = 1e-20 * problem.size**2
    best = min(found, key=lambda o: o.cost)
    stationary = [o for o in found if o.solver.gradient <= STATIONARY]
    least = min((o.cost for o in stationary), default=np.inf)
    if least > best.cost * (1 + FLAT) + floor:
        settled = _settled(problem, best)
        if settled.solver.gradient > STATIONARY:
            return settled
        stationary.append(settled)
        least = min(least, settled.cost)
    equal = [o for o in stationary if o.cost <= least * (1 + 1e-9) + floor]
    # A law may have mirror optima (alpha0 and -alpha0): take the one with fewest negative signs
    return min(equal, key=lambda o: int(np.sum(o.coefficients[list(problem.nonlinear)] < 0)))


def _settled(problem: Problem, found: Minimum) -> Minimum:
    """A point at which Newton steps did not end, followed by IPOPT; if need be, with a doubt."""
    if isinstance(problem, LeastSquares) and problem.smooth:
        again = by_ipopt(problem, found.coefficients, found.solver.scanned)
        if again.cost <= found.cost * (1 + FLAT):
            found = again
        if found.solver.gradient <= STATIONARY:
            return found
    return replace(found, solver=replace(found.solver, doubt=DOUBT))


def _scan(problem: Problem, start: Array | None, effort: Effort) -> tuple[Array, int]:
    """Coefficients (m, all) from which the optimum is to be sought, best first; points scanned."""
    scales = problem.scales
    points = _points(problem, effort.points, np.random.default_rng(20150101))
    if not scales:
        return problem.project(points)[1], 1
    if len(scales) > 1:
        points[0] = [s[0] for s in scales]
    if start is not None:
        points = np.concatenate([points, start])
    squares, coefficients = problem.project(points)
    if not np.any(np.isfinite(squares)):
        raise FitError(
            f"the {problem.law.name} law gives no finite force anywhere in the scan of "
            f"{', '.join(problem.names[i] for i in problem.nonlinear)}; check the table and "
            "fixed=..."
        )
    if len(scales) == 1:
        return _zoomed(problem, points[:, 0], squares), len(points)
    return _distinct(coefficients, squares, list(problem.nonlinear), effort.followed), len(points)


def _zoomed(problem: Problem, values: Array, squares: Array) -> Array:
    """The best local minima along one coefficient, each bracket narrowed twice."""
    order = np.argsort(values)
    values, squares = values[order], squares[order]
    padded = np.concatenate([[np.inf], squares, [np.inf]])
    local = np.nonzero((squares <= padded[:-2]) & (squares < padded[2:]) & np.isfinite(squares))[0]
    local = local[np.argsort(squares[local])][:POLISHED_ALONE]
    low = values[np.maximum(local - 1, 0)]
    high = values[np.minimum(local + 1, len(values) - 1)]
    fractions = np.linspace(0.0, 1.0, 11)
    smallest = float(np.min(np.abs(values)))  # the scan leaves out where a law degenerates
    for _ in range(2):
        inner = low[:, None] + (high - low)[:, None] * fractions
        inner = np.where(np.abs(inner) < smallest, np.copysign(smallest, inner), inner)
        # the ends of brackets may lie beyond what can be computed; inf then, and never best
        found = problem.project(inner.reshape(-1, 1))[0].reshape(inner.shape)
        best = np.argmin(found, axis=1)
        rows = np.arange(len(local))
        low = inner[rows, np.maximum(best - 1, 0)]
        high = inner[rows, np.minimum(best + 1, fractions.size - 1)]
    squares, coefficients = problem.project(inner[rows, best][:, None])
    ranked = np.argsort(squares)
    # 1e-3 of a bracket's width is left, so a worse one cannot overtake by polishing; with
    # inequalities, of which the scan knows nothing, it can
    near = [i for i in ranked if squares[i] <= 1.2 * squares[ranked[0]] or problem.limited]
    return coefficients[near]


def _distinct(coefficients: Array, squares: Array, nonlinear: list[int], count: int) -> Array:
    """The best scan points that do not lie next to a better one."""
    order = np.argsort(squares)
    left = coefficients[order[np.isfinite(squares[order])]]
    chosen: list[Array] = []
    while len(left) and len(chosen) < count:
        chosen.append(left[0])
        apart = np.abs(left[:, nonlinear] / left[0, nonlinear] - 1).max(axis=1)
        apart[0] = 0.0
        left = left[apart > 0.25]
    return np.array(chosen)
