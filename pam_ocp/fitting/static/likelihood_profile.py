"""Profile likelihood: how far one coefficient goes until the others cannot make up for it.

Three ways, each for what the one before leaves over. Along each profile tau(value) = sign
sqrt(cost - least)/s is nearly straight (D. Bates, D. Watts, Nonlinear Regression Analysis, 1988,
6.1), so secant steps find tau = reach, the others following by Gauss-Newton (:func:`_together`).
With one nonlinear coefficient q the cost is for each q a parabola in every other one, so the ends
of all intervals are the extremes over q of ends in closed form: global, and a sweep over q sees
where nothing ends (:func:`swept`). Else the coefficient walks outwards, the others fitted anew from
step to step (:func:`profile_end`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.cases import Place, results_of
from ...core.errors import FitError
from ...core.executors import placed
from ..statistics import Array
from .descent import descend
from .least_squares import DECADES, LeastSquares, sizes
from .optimum import Optimum
from .search import minimise
from .sweep import Sweep

__all__ = ["Ends", "profile_end", "profile_ends", "profile_squares"]

ROUNDS = 12
"""Secant steps along a profile; 3 or 4 are usual, for the root of its cost is nearly straight."""
STEPS = 1
"""Gauss-Newton steps of the other coefficients after each: the rounds go on together with them."""
SETTLED = 1e-5
"""Relative error of the cost at which an end counts as found: 5e-6 of the interval's half width."""
SAME_COST = 1e-9
"""Relative fall of the cost at which the others count as fitted, where one of them walks."""
FARTHEST = 1e4
"""Standard errors (or, if more, values of the coefficient) within which an end is sought by
walking.
"""


@dataclass(frozen=True)
class Ends:
    """An interval; ``reason`` says in words why an end is infinite."""

    low: float
    high: float
    reason: str = ""


def profile_ends(
    fit: Optimum, names: Sequence[str], reach: float, executor: Place = None
) -> dict[str, Ends]:
    """Ends of the profile intervals of several coefficients, ``reach`` standard errors away.

    A standard error that is larger than that of independent errors widens the interval as much.

    executor : where coefficients walk. What is found together or by a sweep takes milliseconds for
        all of them, and is found here.
    """
    placed(executor)
    if not names:
        return {}
    plain = dict(zip(fit.free, fit.linearisation.independent.stderr().tolist(), strict=True))
    reaches = np.array([reach * fit.coefficients[n].stderr / plain[n] for n in names])
    found = np.full((len(names), 2), np.nan)
    simple = fit.terms.loss == "squares" and not fit.problem.censored
    edge = bool(fit.solver.at_bound)
    if simple and len(fit.free) > 1 and not edge:
        found = _together(fit, names, reaches)
    limits = fit.cost + (reaches * fit.sigma) ** 2
    sweep = Sweep.of(fit) if simple and not np.all(np.isfinite(found)) else None
    open_ends = [(i, j) for i, j in np.ndindex(found.shape) if not np.isfinite(found[i, j])]
    sides = (-1.0, 1.0)
    if sweep is not None:
        places = [(fit.free.index(names[i]), sides[j], float(limits[i])) for i, j in open_ends]
        answers = [sweep.end(*place) for place in places]
    else:
        walks = [
            (names[i], sides[j] * fit.coefficients[names[i]].stderr, float(limits[i]))
            for i, j in open_ends
        ]
        answers = results_of(_Walk(fit), walks, executor=executor, chunk=1, what="profiles")
    reasons: dict[str, list[str]] = {name: [] for name in names}
    for (i, j), (end, why) in zip(open_ends, answers, strict=True):
        found[i, j] = end
        reasons[names[i]] += [why] if why else []
    return {
        name: Ends(float(low), float(high), "; ".join(dict.fromkeys(reasons[name])))
        for name, (low, high) in zip(names, found, strict=True)
    }


@dataclass(frozen=True, eq=False)
class _Walk:
    """A fit; called with a coefficient, a first step and a limit it gives the end there."""

    fit: Optimum

    def __call__(self, walk: tuple[str, float, float]) -> tuple[float, str]:
        return profile_end(self.fit, *walk)


def _together(fit: Optimum, names: Sequence[str], reaches: Array) -> Array:
    """(names, 2) ends; NaN where the iteration did not settle, or met a bound."""
    problem, free, sigma = fit.problem, list(fit.problem.free), fit.sigma
    least, reach = fit.cost, np.repeat(reaches, 2)
    above = (reach * sigma) ** 2
    covariance = fit.linearisation.independent.covariance
    place = np.repeat([fit.free.index(n) for n in names], 2)
    sign = np.tile([-1.0, 1.0], len(names))
    best = np.array([float(v) for v in fit.law.values.values()])
    # along the profile the others follow the column of the covariance
    stderr = np.sqrt(np.diag(covariance))
    direction = covariance[:, place].T / stderr[place][:, None]
    low = np.array([problem.variables[i].min for i in free])
    high = np.array([problem.variables[i].max for i in free])
    z = best[free] + (sign * reach)[:, None] * direction
    before, tau_before = np.zeros(place.size), np.zeros(place.size)
    rows = np.arange(place.size)
    for _ in range(ROUNDS):
        z, cost = _follow(problem, best, free, z, place)
        with np.errstate(all="ignore"):
            tau = sign * np.sqrt(np.maximum(cost - least, 0.0)) / sigma
            away = z[rows, place] - best[free][place]
            slope = (tau - tau_before) / (away - before)
            change = (sign * reach - tau) / slope
        done = np.abs(cost - least - above) <= SETTLED * above
        if np.all(done | ~np.isfinite(change)):
            break
        before, tau_before = away, tau
        step = np.where(
            done | ~np.isfinite(change), 0.0, np.clip(change, -np.abs(away), np.abs(away))
        )
        z = z + (step / stderr[place])[:, None] * direction
    inside = np.all((z > low) & (z < high), axis=1)
    # the others are where they belong only if another step of theirs changes nothing
    again = _follow(problem, best, free, z, place)[1]
    with np.errstate(invalid="ignore"):
        still = np.abs(again - cost) <= 10 * SETTLED * above
    settled = done & still & inside & np.isfinite(cost)
    return np.where(settled, z[rows, place], np.nan).reshape(-1, 2)


def _follow(
    problem: LeastSquares, best: Array, free: list[int], z: Array, place: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Gauss-Newton steps of all unknowns but ``place`` in each row of z; costs that they come
    to.
    """
    for _ in range(STEPS):
        sums = problem.sums(_rows(best, free, z))
        right, normal = sums.right[:, free], sums.normal[:, free][:, :, free]
        good = np.isfinite(right).all(axis=1) & np.isfinite(normal).all(axis=(1, 2))
        normal[~good], right[~good] = 0.0, 0.0
        norms = np.maximum(np.sqrt(np.einsum("mii->mi", normal)), 1e-300)
        stays: Array = np.zeros_like(norms)
        np.put_along_axis(stays, place[:, None], 1.0, axis=1)
        normal = normal / norms[:, :, None] / norms[:, None, :]
        normal = normal * (1 - stays)[:, :, None] * (1 - stays)[:, None, :]
        normal += np.eye(len(free)) * np.maximum(stays, 1e-14)[:, :, None]
        right = ((1 - stays) * right / norms)[:, :, None]
        try:
            step = np.linalg.solve(normal, right)[:, :, 0]
        except np.linalg.LinAlgError:  # somewhere the others are not determined
            step = (np.linalg.pinv(normal, hermitian=True) @ right)[:, :, 0]
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is not good
            z = z + step / norms
    return z, problem.squares(_rows(best, free, z))


def _rows(best: Array, free: list[int], z: Array) -> Array:
    c = np.tile(best, (len(z), 1))
    c[:, free] = z
    return c


def profile_squares(fit: Optimum, name: str, value: float) -> float:
    """Least cost (weighted sum of squares, priors included) with coefficient ``name`` held at
    ``value``.
    """
    if len(fit.free) == 1:
        return replace(fit, law=replace(fit.law, **{name: value})).cost
    problem = _held(fit, name, value)
    if not problem.nonlinear and fit.terms.loss == "squares" and not problem.limited:
        return float(problem.project(np.zeros((1, 0)))[0][0])
    return minimise(problem).cost


def _held(fit: Optimum, name: str, value: float) -> LeastSquares:
    """The problem of the others, with coefficient ``name`` held at ``value``."""
    held = {n: fit.law.values[n] for n in fit.held} | {name: value}
    return LeastSquares.of(type(fit.law), fit.table, held, fit.root_weights, fit.terms)


def _others(fit: Optimum, name: str, start: Array, moved: list[int]) -> tuple[Array, float]:
    """The best of the ``moved`` coefficients, near ``start``, and what they cost.

    Inequalities make several optima, so censored cells ask for a whole fit. Where the law cannot
    be slack there, the place is out of reach: it costs more than any limit (but a finite sum).
    """
    if not fit.problem.censored:
        free = fit.problem.free
        low = np.array([fit.problem.variables[i].min if i in moved else start[i] for i in free])
        high = np.array([fit.problem.variables[i].max if i in moved else start[i] for i in free])
        ended = descend(fit.problem, start[None], low[None], high[None], SAME_COST)
        return ended.coefficients[0], float(ended.cost[0])
    beyond = float(np.finfo(float).max)
    if not moved:
        best, cost = start, fit.problem.cost(start)
    else:
        try:
            found = minimise(_held(fit, name, float(start[list(fit.law.values).index(name)])))
        except FitError:
            return start, beyond
        best, cost = found.coefficients, found.cost
    pull = fit.problem.tension_where_slack(best)[0]
    return best, cost if np.all(pull <= 1.001 * fit.problem.slack_tolerance) else beyond


def profile_end(fit: Optimum, name: str, step: float, limit: float) -> tuple[float, str]:
    """Value of ``name``, on the side of ``step``, at which the profiled cost reaches ``limit``.

    Infinite, with the reason, where the cost stays below it or cannot be computed. The law's bound
    where that comes first. A nonlinear coefficient is followed as far as it is sought.
    """
    place, problem = list(fit.law.values).index(name), fit.problem
    variable, best = problem.variables[place], float(fit.law.values[name])
    others = [i for i in problem.free if i != place]
    bound = variable.max if step > 0 else variable.min
    reach = max(FARTHEST * abs(step), max(abs(best), variable.nominal) * 10.0 ** DECADES[1])
    if place in problem.nonlinear:
        reach = min(reach, float(np.max(np.abs(sizes(variable) - best))))
    inside = start = np.array([float(v) for v in fit.law.values.values()])
    while True:
        start = inside.copy()
        start[place] = np.clip(inside[place] + step, variable.min, variable.max)
        outside, cost = _others(fit, name, start, others)
        if not np.isfinite(cost):
            return float(np.copysign(np.inf, step)), "the law gives no finite force further out"
        if cost > limit:
            break
        if start[place] == bound:
            return float(bound), "" if np.isfinite(bound) else "the others make up for it"
        if abs(start[place] - best) > reach:
            return float(np.copysign(np.inf, step)), (
                f"at {name} = {start[place]:.3g} the other coefficients still make up for it"
            )
        inside, step = outside, 1.6 * step
    far = outside[place]
    while abs(far - inside[place]) > 1e-6 * max(abs(far - best), 1e-12 * variable.nominal):
        start = inside.copy()
        start[place] = middle = (inside[place] + far) / 2
        found, cost = _others(fit, name, start, others)
        if cost > limit:
            far = middle
        else:
            inside = found
    return float((inside[place] + far) / 2), ""
