"""PID on a position about a point of rest as a block."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ...core.block import Block
from ..point_pid import PointPid
from .draft import Draft
from .feedback import acting, at_rest
from .kinds import BLOCKS
from .pid import pid_law

__all__ = ["point_pid"]


@BLOCKS.register("PointPid")
def point_pid(controller: PointPid, name: str = "pid") -> Block:
    """u = u0 + weight PID(wanted - position), as :class:`PointPid`.

    Inputs are the position and ``wanted.POSITION``; gains, weights and the point are parameters.
    Of a plant with valves the other openings are held where they rest.
    """
    point, inversion = controller.point, controller.inversion
    draft = Draft(name, controller.sample_time, "PID about a point of rest")
    weights = controller.shares
    chosen = [
        v
        for v in point.plant.inputs
        if v.name in weights or (inversion and not v.disturbance)  # all openings are sent
    ]
    position = controller.plant.variable(controller.position)
    wanted = draft.input(
        f"wanted.{position.name}",
        controller.wanted(0.0)[position.name],
        unit=position.unit,
        nominal=position.nominal,
        description=f"to be reached: {position.description}",
    )
    u0 = at_rest(draft, "u0", chosen, np.array([point[v.name] for v in chosen]))
    w = ca.vertcat(
        *(
            draft.parameter(
                f"weight.{v.name}", weights[v.name], description=f"part of {v.name} in the loop"
            )
            if v.name in weights
            else 0.0
            for v in chosen
        )
    )
    size = ca.sumsqr(w)
    acted = ca.dot(w, acting(draft, inversion, chosen) - u0) / ca.if_else(size > 0, size, 1)
    saturated = draft.memory("saturated", description="all inputs were beyond their ranges")
    error = wanted - draft.like(position)
    frozen = ca.logic_or(saturated, draft.held_back)
    u = u0 + w * pid_law(draft, controller.pid, error, frozen, acted)
    beyond = draft.kind(1)
    held = []
    for i, variable in enumerate(chosen):
        within, ends = u[i], draft.kind(0)
        if np.isfinite(variable.min):
            ends, within = u[i] < variable.min, ca.fmax(within, variable.min)
        if np.isfinite(variable.max):
            ends = ca.logic_or(ends, u[i] > variable.max)
            within = ca.fmin(within, variable.max)
        held.append(within)
        if variable.name in weights:
            beyond = ca.logic_and(beyond, ends)
    draft.next("saturated", beyond)
    draft.send(inversion, chosen, ca.vertcat(*held))
    return draft.block()
