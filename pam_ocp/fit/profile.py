"""Profile likelihood: how far one coefficient goes until the others cannot make up for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .problem import DECADES, Problem
from .search import minimise
from .statistics import Array

if TYPE_CHECKING:
    from .force_fit import ForceFit

__all__ = ["profile_end", "profile_ends", "profile_squares"]

ROUNDS = 12
"""Secant steps along a profile; 3 or 4 are usual, for the root of its cost is nearly straight."""
STEPS = 1
"""Gauss-Newton steps of the other coefficients after each: the rounds go on together with them."""
SETTLED = 1e-5
"""Relative error of the cost at which an end counts as found: 5e-6 of the interval's half width."""


def profile_ends(
    fit: ForceFit, names: Sequence[str], reach: float
) -> dict[str, tuple[float, float]]:
    """Ends of the profile intervals of several coefficients, ``reach`` standard errors away.

    All ends at once: along each profile tau(value) = sign sqrt(cost - least)/s is nearly straight
    (D. Bates, D. Watts, Nonlinear Regression Analysis, 1988, 6.1), so secant steps find tau = reach,
    the others following by Gauss-Newton. What does not come to rest is sought by :func:`profile_end`.
    """
    limit = fit.cost + (reach * fit.sigma) ** 2
    steps = {n: (-fit.coefficients[n].stderr, fit.coefficients[n].stderr) for n in names}
    found = np.full((len(names), 2), np.nan)
    simple = fit.problem.plain or (fit.terms.loss == "squares" and not fit.problem.censored)
    if simple and len(fit.free) > 1:
        found = _together(fit, names, reach, limit - (reach * fit.sigma) ** 2)
    ends = {}
    for row, name in zip(found, names, strict=True):
        low, high = (
            float(end) if np.isfinite(end) else profile_end(fit, name, step, limit)
            for end, step in zip(row, steps[name], strict=True)
        )
        ends[name] = (low, high)
    return ends


def _together(fit: ForceFit, names: Sequence[str], reach: float, least: float) -> Array:
    """(names, 2) ends; NaN where the iteration did not settle, or met a bound."""
    problem, free, sigma = fit.problem, list(fit.problem.free), fit.sigma
    above = (reach * sigma) ** 2
    k, covariance = len(free), fit.covariance
    place = np.repeat([fit.free.index(n) for n in names], 2)
    sign = np.tile([-1.0, 1.0], len(names))
    best = np.array([float(v) for v in fit.law.values.values()])
    # along the profile the others follow the column of the covariance
    stderr = np.sqrt(np.diag(covariance))
    direction = covariance[:, place].T / stderr[place][:, None]
    others = np.array([[i for i in range(k) if i != j] for j in place])
    low = np.array([problem.variables[i].min for i in free])
    high = np.array([problem.variables[i].max for i in free])
    z = best[free] + (sign * reach)[:, None] * direction
    before, tau_before = np.zeros(place.size), np.zeros(place.size)
    rows = np.arange(place.size)
    for _ in range(ROUNDS):
        z, cost = _follow(problem, best, free, z, others)
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
    settled = done & inside & np.isfinite(cost)
    return np.where(settled, z[rows, place], np.nan).reshape(-1, 2)


def _follow(
    problem: Problem, best: Array, free: list[int], z: Array, others: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Gauss-Newton steps of all unknowns but one in each row of z; costs that they come to."""
    keep = others[:, None, :]
    for last in range(STEPS + 1):
        c = np.tile(best, (len(z), 1))
        c[:, free] = z
        with np.errstate(all="ignore"):
            rest, slopes = problem.with_priors(c)
            cost = np.sum(rest**2, axis=1)
        if last == STEPS:
            return z, cost
        good = np.isfinite(cost) & np.isfinite(slopes).all(axis=(1, 2))
        slopes = np.where(good[:, None, None], slopes, 0.0)[:, :, free]
        rest = np.where(good[:, None], rest, 0.0)
        inner = np.take_along_axis(slopes, keep, axis=2)  # fmt: skip
        norms = np.maximum(np.linalg.norm(inner, axis=1), 1e-300)
        inner = inner / norms[:, None, :]
        normal = np.einsum("mni,mnj->mij", inner, inner) + 1e-14 * np.eye(others.shape[1])
        step = np.linalg.solve(normal, np.einsum("mni,mn->mi", inner, rest)[:, :, None])[:, :, 0]
        z = z.copy()
        np.put_along_axis(z, others, np.take_along_axis(z, others, 1) + step / norms, axis=1)
    raise AssertionError("the loop returns")


def profile_squares(fit: ForceFit, name: str, value: float) -> float:
    """Least cost (weighted sum of squares, priors included) with coefficient ``name`` held at ``value``."""
    held = {n: fit.law.values[n] for n in fit.held} | {name: value}
    if len(fit.free) == 1:
        return replace(fit, law=replace(fit.law, **{name: value})).cost
    problem = Problem.of(type(fit.law), fit.table, held, fit.root_weights, fit.terms)
    if not problem.nonlinear and problem.plain and not problem.limited:
        return float(problem.project(np.zeros((1, 0)))[0][0])
    return minimise(problem).cost


def profile_end(fit: ForceFit, name: str, step: float, limit: float) -> float:
    """Value of ``name``, on the side of ``step``, at which the profiled squares reach ``limit``.

    Infinite (or the law's bound) when they stay below it: the data leave this side open.
    """
    variable = {v.name: v for v in fit.law.coefficient_variables()}[name]
    best = float(fit.law.values[name])
    inside = value = best
    bound = variable.max if step > 0 else variable.min
    reach = max(abs(best), variable.nominal) * 10.0 ** DECADES[1]
    while True:
        value = float(np.clip(value + step, variable.min, variable.max))
        if profile_squares(fit, name, value) > limit:
            break
        if value == bound or abs(value - best) > reach:
            return bound
        inside, step = value, 1.6 * step
    outside = value
    while abs(outside - inside) > 1e-6 * max(abs(outside - best), 1e-12 * variable.nominal):
        middle = (inside + outside) / 2
        if profile_squares(fit, name, middle) > limit:
            outside = middle
        else:
            inside = middle
    return (inside + outside) / 2
