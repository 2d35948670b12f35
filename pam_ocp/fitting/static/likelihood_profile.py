"""Profile likelihood: how far one coefficient goes until the others cannot make up for it.

Three ways, each for what the one before leaves over. Along each profile tau(value) = sign
sqrt(cost - least)/s is nearly straight (D. Bates, D. Watts, Nonlinear Regression Analysis, 1988,
6.1), so secant steps find tau = reach, the others following by Gauss-Newton (:func:`_together`).
With one nonlinear coefficient q the cost is for each q a parabola in every other one, so the ends
of all intervals are the extremes over q of ends in closed form: global, and a sweep over q sees
where nothing ends (:class:`Sweep`). Else the coefficient walks outwards, the others fitted anew
from step to step (:func:`walked`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...core.cases import Place, results_of
from ...core.errors import FitError
from ...core.executors import placed
from ...core.plausible import UnitWarning
from ..statistics import Array
from ..tables.force_table import ForceTable
from .least_squares import DECADES, LeastSquares, least_squares, sizes
from .local_optimum import descend
from .optimum import Optimum
from .search import minimise

__all__ = ["Ends", "Sweep", "profile_end", "profile_ends", "walked"]

ROUNDS = 12
"""Secant steps along a profile; 3 or 4 are usual, for the root of its cost is nearly straight."""
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
    simple, edge = fit.problem.smooth, bool(fit.solver.at_bound)
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
        answers = results_of(partial(_end, fit), walks, executor=executor, chunk=1, what="profiles")
    reasons: dict[str, list[str]] = {name: [] for name in names}
    for (i, j), (end, why) in zip(open_ends, answers, strict=True):
        found[i, j] = end
        reasons[names[i]] += [why] if why else []
    return {
        name: Ends(float(low), float(high), "; ".join(dict.fromkeys(reasons[name])))
        for name, (low, high) in zip(names, found, strict=True)
    }


def _end(fit: Optimum, walk: tuple[str, float, float]) -> tuple[float, str]:
    """Of a walk: a coefficient, a first step, and a limit."""
    return profile_end(fit, *walk)


def _together(fit: Optimum, names: Sequence[str], reaches: Array) -> Array:
    """(names, 2) ends; NaN where the iteration did not settle, or met a bound."""
    problem, free, sigma = fit.problem, list(fit.problem.free), fit.sigma
    least, reach = fit.cost, np.repeat(reaches, 2)
    above = (reach * sigma) ** 2
    covariance = fit.linearisation.independent.covariance
    place = np.repeat([fit.free.index(n) for n in names], 2)
    sign = np.tile([-1.0, 1.0], len(names))
    best = fit.vector
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
    """A Gauss-Newton step of all unknowns but ``place`` in each row of z, and the costs that it
    comes to; the rounds of secant steps go on together with it.
    """
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
    """Value of ``name``, on the side of ``step``, at which the profiled cost reaches ``limit``, or
    why there is none; see :func:`walked`. A nonlinear coefficient is followed as far as it is
    sought.
    """
    place, problem = list(fit.law.values).index(name), fit.problem
    variable, best = problem.variables[place], float(fit.law.values[name])
    others = [i for i in problem.free if i != place]
    reach = max(FARTHEST * abs(step), max(abs(best), variable.nominal) * 10.0 ** DECADES[1])
    if place in problem.nonlinear:
        reach = min(reach, float(np.max(np.abs(sizes(variable) - best))))
    end = walked(
        lambda trial: _others(fit, name, trial, others),
        fit.vector,
        place,
        step,
        limit,
        (variable.min, variable.max),
        reach,
    )
    return (end[0], end[1].format(name=name))


def walked(
    others: Callable[[Array], tuple[Array, float]],
    start: Array,
    place: int,
    step: float,
    limit: float,
    bounds: tuple[float, float],
    reach: float,
) -> tuple[float, str]:
    """Value of unknown number ``place``, on the side of ``step``, at which the cost reaches
    ``limit``, the others fitted anew from step to step.

    others : the best of the others near given unknowns, and what they cost. bounds : of the
    unknown, which may come first. reach : how far it is followed. Infinite, with the reason, where
    the cost stays below the limit or cannot be computed.
    """
    best, far_out = float(start[place]), float(np.copysign(np.inf, step))
    bound, inside, near = bounds[step > 0], start, 1e-9 * abs(step)
    while True:
        trial = inside.copy()
        trial[place] = np.clip(inside[place] + step, *bounds)
        outside, cost = others(trial)
        if not np.isfinite(cost):
            return far_out, "the law gives no finite force further out"
        if cost > limit:
            break
        if trial[place] == bound:
            return float(bound), "" if np.isfinite(bound) else "the others make up for it"
        if abs(trial[place] - best) > reach:
            return far_out, (
                f"at {{name}} = {trial[place]:.3g} the other coefficients still make up for it"
            )
        inside, step = outside, 1.6 * step
    far = float(outside[place])
    while abs(far - inside[place]) > max(1e-6 * abs(far - best), near):
        trial = inside.copy()
        trial[place] = middle = (inside[place] + far) / 2
        found, cost = others(trial)
        if cost > limit:
            far = middle
        else:
            inside = found
    return float((inside[place] + far) / 2), ""


# ---- by a sweep ----------------------------------------------------------------------------------
TRIED = np.concatenate([-np.geomspace(8, 0.05, 24), [0.0], np.geomspace(0.05, 8, 24)])
"""Standard errors from the optimum at which the nonlinear coefficient is tried, beside its scan."""
ZOOMS = 5
POINTS = 13


@dataclass(frozen=True, eq=False)
class Sweep:
    """Profile intervals and bands of a law with one nonlinear coefficient q, over its whole range:
    costs and ends of all linear coefficients over values of q.

    For a given q the cost is least + (c - best)^2/variance in each linear coefficient c.
    """

    problem: LeastSquares
    place: int
    best: float
    values: Array
    results: tuple[Array, Array, Array]
    """Costs (m,), best linear coefficients (m, k) and roots of their covariances (m, k, k) at
    ``values``.
    """

    @classmethod
    def of(cls, fit: Optimum) -> Sweep | None:
        """None for laws with other than one nonlinear coefficient, or bounds of linear ones."""
        problem = fit.problem
        if len(problem.nonlinear) != 1 or problem.limited or fit.terms.loss != "squares":
            return None
        if any(
            np.isfinite([problem.variables[i].min, problem.variables[i].max]).any()
            for i in problem.linear
        ):
            return None
        place = problem.nonlinear[0]
        name, variable = problem.names[place], problem.variables[place]
        best, error = float(fit.law.values[name]), fit.coefficients[name].stderr
        near = best + (error if np.isfinite(error) else 0.1 * abs(best)) * TRIED
        wide = sizes(variable)
        reach = np.abs(wide)
        if not np.isfinite(variable.max - variable.min):
            near = near[(np.abs(near) >= reach.min()) & (np.abs(near) <= reach.max())]
        near = near[(near >= variable.min) & (near <= variable.max)]
        values = np.unique(np.concatenate([near, wide, [best]]))
        return cls(problem, place, best, values, _projected(problem, values))

    def end(self, free: int, side: float, limit: float) -> tuple[float, str]:
        """End of the interval of the coefficient ``problem.free[free]``, and why it is infinite."""
        i = self.problem.free[free]
        if i == self.place:
            return self._own_end(side, limit)
        column = self.problem.linear.index(i)
        values, results = self.values, self.results
        for _ in range(ZOOMS):
            reached = _reached(results, column, side, limit)
            j = int(np.argmax(reached))
            if values is self.values and self._at_edge(j):
                return side * np.inf, self._open_words()
            low, high = values[max(j - 1, 0)], values[min(j + 1, len(values) - 1)]
            values = np.linspace(low, high, POINTS)
            results = _projected(self.problem, values)
        reached = _reached(results, column, side, limit)
        return float(side * reached.max()), ""

    def band(self, p: Array, kappa: Array, limits: Array) -> tuple[Array, Array]:
        """Lowest and highest force (n,) at places (n,) over all laws that cost no more than
        ``limits`` (n,).
        """
        cost, best, root = self.results
        kept = cost <= max(float(limits.max()), float(cost.min()))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnitWarning)  # said where the places came in
            cells = ForceTable(p, kappa, np.zeros(p.size))
        there = replace(self.problem, cells=cells, weights=np.ones(p.size))
        _, target, columns, good = there.linear_in(self.values[kept][:, None], there.evaluate)
        force = np.einsum("mnk,mk->mn", columns, best[kept]) - target
        along = np.einsum("mnk,mkl->mnl", columns, root[kept])
        room = limits - cost[kept][:, None]
        half = np.sqrt(np.maximum(room, 0.0) * np.sum(along**2, axis=2))
        inside = (room >= 0) & good[:, None]
        low, high = np.where(inside, force - half, np.inf), np.where(inside, force + half, -np.inf)
        return np.asarray(low.min(axis=0)), np.asarray(high.max(axis=0))

    def _own_end(self, side: float, limit: float) -> tuple[float, str]:
        inside = np.nonzero(self.results[0] <= limit)[0]
        last = (
            int(inside[-1 if side > 0 else 0]) if inside.size else int(np.argmin(self.results[0]))
        )
        beyond = last + int(side)
        if not 0 <= beyond < len(self.values):
            variable = self.problem.variables[self.place]
            bound = variable.max if side > 0 else variable.min
            return float(bound), "" if np.isfinite(bound) else self._open_words()
        low, high = self.values[last], self.values[beyond]
        for _ in range(40):
            middle = (low + high) / 2
            cost = _projected(self.problem, np.array([middle]))[0][0]
            low, high = (middle, high) if cost <= limit else (low, middle)
            if abs(high - low) <= 1e-6 * abs(high - self.best):
                break
        return float((low + high) / 2), ""

    def _at_edge(self, j: int) -> bool:
        """Whether the law degenerates at this value: the ends of the scan, and where it passes
        zero.
        """
        if j in (0, len(self.values) - 1):
            return True
        variable = self.problem.variables[self.place]
        smallest = np.abs(sizes(variable)).min()
        unlimited = not np.isfinite(variable.max - variable.min)
        return bool(unlimited and abs(self.values[j]) <= 1.001 * smallest)

    def _open_words(self) -> str:
        name, reach = self.problem.names[self.place], np.abs(self.values)
        return (
            f"the data allow {name} at an end of the range in which it is sought "
            f"(of size {reach.min():.3g} to {reach.max():.3g}), where the law degenerates"
        )


def _reached(results: tuple[Array, Array, Array], column: int, side: float, limit: float) -> Array:
    """How far to a side the coefficient of ``column`` may go at each value (m,); -inf where the
    cost is too high.
    """
    cost, best, root = results
    room, variance = limit - cost, np.sum(root**2, axis=2)
    with np.errstate(invalid="ignore"):
        far = side * best[:, column] + np.sqrt(np.maximum(room, 0.0) * variance[:, column])
    return np.where((room >= 0) & np.isfinite(far), far, -np.inf)


def _projected(problem: LeastSquares, values: Array) -> tuple[Array, Array, Array]:
    _, whole, good = problem.triangles(values[:, None])
    columns, target = whole[:, :, :-1], whole[:, :, -1]
    best, root = least_squares(columns, target)
    rest = target - np.einsum("mnk,mk->mn", columns, best)
    return np.where(good, np.sum(rest**2, axis=1), np.inf), best, root
