"""State feedback without offset as a block: filter and feedback in a chain."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ...core.block import Block
from ..offset_free import OffsetFree
from .chain import chain
from .draft import Draft
from .filters import stationary_filter
from .kinds import BLOCKS

__all__ = ["offset_free"]


@BLOCKS.register("OffsetFree")
def offset_free(controller: OffsetFree, name: str = "offset_free") -> Block:
    """u = u0 + u_d - K (estimate - x0 - x_d), as :class:`OffsetFree`.

    Inputs are what its filter measures, and ``wanted.NAME`` of what is held.
    """
    return chain([stationary_filter(controller.filter), _feedback(controller)], name=name)


def _feedback(controller: OffsetFree) -> Block:
    feedback, point = controller.feedback, controller.feedback.point
    plant = point.plant
    draft = Draft("feedback", feedback.sample_time, "state feedback to the rest without offset")
    chosen = [plant.variable(n) for n in feedback.inputs]
    estimate = draft.states(feedback.inversion, plant.states)
    unknown = [plant.variable(n) for n in controller.filter.disturbances]
    found = [draft.like(v) - float(point[v.name]) for v in unknown]
    wanted = []
    for name in controller._held:
        v, goal = plant.variable(name), controller._goal.get(name, point[name])
        here = draft.input(
            f"wanted.{name}",
            goal,
            unit=v.unit,
            nominal=v.nominal,
            description=f"to be reached: {v.description}",
        )
        wanted.append(here - float(point[name]))
    k = draft.matrix("K", feedback.K, chosen, plant.states)
    rest = ca.mtimes(ca.DM(controller._to_goal), ca.vertcat(*wanted))
    rest = rest + ca.mtimes(ca.DM(controller._to_disturbance), ca.vertcat(*found))
    n = len(plant.states)
    x_rest, u_rest = ca.vertsplit(rest, [0, n, rest.numel()])
    u = ca.DM(point.u[controller._chosen]) + u_rest
    u = u - ca.mtimes(k, estimate - ca.DM(point.x) - x_rest)
    kept = []
    for i, (low, high) in enumerate(zip(controller._low, controller._high, strict=True)):
        value = ca.fmax(u[i], float(low)) if np.isfinite(low) else u[i]
        kept.append(ca.fmin(value, float(high)) if np.isfinite(high) else value)
    draft.send(feedback.inversion, chosen, ca.vertcat(*kept))
    return draft.block()
