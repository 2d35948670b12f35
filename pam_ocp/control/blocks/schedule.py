"""Gain scheduling as a block: the tables of the grid, interpolated where the place says."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ...core.block import Block
from ..schedule import ScheduledFeedback
from .draft import Array, Draft, Symbol
from .feedback import Integrating, acting
from .kinds import BLOCKS

__all__ = ["scheduled_feedback"]


@BLOCKS.register("ScheduledFeedback")
def scheduled_feedback(controller: ScheduledFeedback, name: str = "scheduled") -> Block:
    """u = u0(s) - K(s) (x - x0(s)) - Ki(s) integral(y - y(s)), as :class:`ScheduledFeedback`.

    The place s in the grid are the inputs ``place.AXIS``, kept within its borders.
    """
    c, family = controller, controller.family
    plant = family.plant
    draft = Draft(name, c.sample_time, "scheduled state feedback", ca.MX)
    start = c.where(0.0)
    place = []
    for n, axis in family.axes.items():
        v = plant.variable(n)
        s = draft.input(
            f"place.{n}",
            start[n],
            unit=v.unit,
            nominal=v.nominal,
            description="where the plant is to be: it chooses the gains",
        )
        place.append(ca.fmin(ca.fmax(s, float(axis[0])), float(axis[-1])))
    at = ca.vertcat(*place)
    axes = [np.asarray(axis, dtype=float).tolist() for axis in family.axes.values()]
    chosen = [plant.variable(n) for n in family.inputs]
    integrated = [plant.variable(n) for n in c.integrated]
    nu, nx, ni = len(chosen), len(plant.states), len(integrated)

    def table(name: str, values: Array) -> Symbol:
        return _interpolated(name, axes, values, len(family.axes))(at)

    x0, u0 = table("x0", family.x), table("u0", family.u[..., c._columns])
    k = ca.reshape(table("gains", np.swapaxes(c.K, -1, -2)), nu, nx)
    v = u0 - ca.mtimes(k, draft.states(c.inversion, plant.states) - x0)
    integrals = Integrating(draft, c.integrated)
    u, errors = v, []
    if integrated:
        ki = ca.reshape(table("integral_gains", np.swapaxes(c.Ki, -1, -2)), nu, ni)
        goals = table("goals", c._goals)
        u = v - ca.mtimes(ki, integrals.values(ki, acting(draft, c.inversion, chosen) - v))
        errors = [draft.like(w) - goals[i] for i, w in enumerate(integrated)]
    integrals.add(errors, u, c._low, c._high)
    draft.send(c.inversion, chosen, u)
    return draft.block()


def _interpolated(name: str, axes: list[list[float]], values: Array, depth: int) -> ca.Function:
    """place -> values, linear along each axis; entries of an array run along its last axes."""
    flat = values.reshape(*values.shape[:depth], -1)
    order = np.moveaxis(flat, -1, 0).reshape(flat.shape[-1], -1, order="F")
    return ca.interpolant(name, "linear", axes, order.T.ravel().tolist())
