"""The global optimum of a static fit: a scan over the nonlinear coefficients, then descents.

The scan takes both signs and several decades of the nonlinear coefficients only, the others
projected out; of a large table it looks at some cells from everywhere. The best are followed over
all coefficients and cells, with exact derivatives.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...core.errors import FitError
from ..statistics import Array
from .high_breakdown import SUBSETS, robust_start
from .least_squares import LeastSquares
from .local_optimum import STATIONARY, Minimum, Problem, by_ipopt, local_optima

__all__ = ["NEAR", "WIDE", "Effort", "minimise"]


class Effort(NamedTuple):
    """points : of the scan with two or more nonlinear unknowns (always the same ones). followed :
    how many local minima of it are followed up.
    """

    points: int
    followed: int


WIDE = Effort(400, 60)
NEAR = Effort(100, 6)
"""With a start that is known to be near."""
POLISHED_ALONE = 3
"""As many for a law with one nonlinear coefficient."""
FLAT = 1e-7
"""Part of the cost by which a point that is not stationary must be better to be looked at at all.
"""
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
    found = [o for o in local_optima(problem, starts, scanned) if np.isfinite(o.cost)]
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
    """A point at which Newton steps did not end, followed by IPOPT; accepted with a doubt, if need
    be.
    """
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
    if not scales:
        return problem.project(np.zeros((1, 0)))[1], 1
    if len(scales) == 1:
        points = np.sort(scales[0])[:, None]
    else:
        random = np.random.default_rng(20150101)
        points = np.stack([random.choice(s, effort.points) for s in scales], axis=1)
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
    chosen: list[int] = []
    for i in np.argsort(squares):
        here = coefficients[i, nonlinear]
        gaps = [np.max(np.abs(here / coefficients[j, nonlinear] - 1)) for j in chosen]
        if np.isfinite(squares[i]) and all(gap > 0.25 for gap in gaps):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return coefficients[chosen]
