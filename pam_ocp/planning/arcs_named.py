"""Arcs of any plan by the limits that lead its inputs: what ``plan.arcs`` shows."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .active import Limit, limits_along
from .arcs import INTERIOR, Arc
from .arcs_found import Chains, limits_of

if TYPE_CHECKING:
    from .result import Plan

__all__ = ["arcs_along"]

MOSTLY = 0.9
"""Part of an interval along which a limit is active that leads there: its ends may be off it."""


def arcs_along(plan: Plan) -> tuple[Arc, ...]:
    """The arcs of a plan's inputs, input by input, in the order of time.

    A limit leads an input along an interval of the mesh where it is active all along (of a held
    input: somewhere) and the input can change it, its own bounds before others.
    """
    assert plan.replay is not None  # of a plan that succeeded
    problem, mesh = plan._problem, plan.meshes[-1]
    names = [v.name for v in plan.plant.inputs if not v.disturbance]
    if problem is None or not names:
        return ()
    breaks = _breaks(plan)
    every = limits_along(plan)
    led = [_leading(plan, every, k, breaks) for k in range(len(mesh.intervals))]
    found: list[Arc] = []
    for name in names:
        own: list[Arc] = []
        for k, labels in enumerate(led):
            active = labels.get(name, INTERIOR)
            if own and own[-1].active == active:
                own[-1] = replace(own[-1], end=breaks[k + 1])
            else:
                own.append(Arc(name, breaks[k], breaks[k + 1], active))
        found += own
    return tuple(found)


def _breaks(plan: Plan) -> list[float]:
    """Where the intervals of the mesh begin and end [s]."""
    lengths = [plan.durations[i.leg] * i.fraction for i in plan.meshes[-1].intervals]
    return [0.0, *np.cumsum(lengths).tolist()]


def _leading(plan: Plan, every: list[Limit], k: int, breaks: list[float]) -> dict[str, str]:
    """{input: the limit that leads it} along an interval."""
    assert plan._problem is not None
    problem, plant, mesh = plan._problem, plan.plant, plan.meshes[-1]
    chains = Chains(problem)
    leg = problem.legs[mesh.intervals[k].leg]
    known = {c.label: c for c in limits_of(problem, leg)}
    begin, end = breaks[k], breaks[k + 1]
    room = 1e-9 * breaks[-1]
    held = mesh.form.control != "polynomial"
    found: dict[str, str] = {}
    ranked: list[tuple[int, str, NDArray[np.bool_]]] = []
    for limit in every:
        inside = (limit.t >= begin - room) & (limit.t < end - room)
        touches = limit.active[inside]
        if not touches.size or not (touches.any() if held else touches.mean() > MOSTLY):
            continue
        condition = known.get(limit.label.rsplit(" ", 1)[0])
        chain = chains(condition) if condition is not None else None
        if chain is None:
            continue
        depends = chain.influence(plant.u)
        ranked.append((chain.order + int(depends.sum() > 1), limit.label, depends))
    inputs = [v.name for v in plant.inputs]
    for _, label, depends in sorted(ranked, key=lambda each: each[:2]):
        free = [n for n, does in zip(inputs, depends, strict=True) if does and n not in found]
        found |= dict.fromkeys(free, label)
    return found
