"""Profile likelihood: how far one coefficient goes until the others cannot make up for it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .problem import DECADES, Problem
from .search import minimise

if TYPE_CHECKING:
    from .force_fit import ForceFit

__all__ = ["profile_end", "profile_squares"]


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
