"""PID as a block."""

from __future__ import annotations

import casadi as ca

from ...core.block import Block
from ...core.variables import Variable
from ...plants.plant import Plant
from ..pid import PID
from .draft import Draft, Symbol, as_output, compensated
from .kinds import BLOCKS

__all__ = ["pid", "pid_law"]


@BLOCKS.register("PID")
def pid(
    controller: PID,
    name: str = "pid",
    *,
    sample_time: float = 1e-3,
    measured: str = "measured",
    command: str = "command",
    plant: Plant | None = None,
) -> Block:
    """command = PID(wanted - measured), as :class:`PID`, on one measured value.

    sample_time : [s]. measured, command : names; of a ``plant``, which then says their units.
    """
    draft = Draft(name, sample_time, "PID controller")
    if plant is None:
        seen, sent = Variable(measured, "output"), Variable(command, "input")
    else:
        seen, sent = plant.variable(measured), plant.variable(command)
    error = draft.like(seen, "wanted.") - draft.like(seen)
    unit = draft.sent([sent])[0]
    value = pid_law(draft, controller, error, draft.limited, unit)
    draft.output(as_output(sent), value, command=True)
    return draft.block()


def pid_law(
    draft: Draft, controller: PID, error: Symbol, saturated: Symbol, sent: Symbol | None = None
) -> Symbol:
    """The PID's output for an error; ``saturated`` is what became of its last one.

    sent : the output that acted in its place while something else was sent; the integral follows
    it. None: the integral is empty then.
    """
    kp, ki, kd = (
        draft.parameter(n, getattr(controller, n), description=words)
        for n, words in (("kp", "proportional"), ("ki", "integral"), ("kd", "derivative gain"))
    )
    filter_time = draft.parameter(
        "filter_time", controller.filter_time, unit="s", min=0.0, description="of the derivative"
    )
    time = draft.sample_time
    integral = draft.memory("integral", description="integral of the error")
    carry = draft.memory("carry", description="what rounding took from the integral")
    slope = draft.memory("slope", description="filtered derivative of the error")
    last = draft.memory("last_error", description="error of the last step")
    started = draft.memory("started", description="1 after the first step")
    share = filter_time / (filter_time + time)
    turned = share * slope + (1 - share) * (error - last) / time
    slope_now = ca.if_else(started, turned, slope)
    frozen = ca.logic_and(saturated, error * integral > 0)
    added, left = compensated(integral, carry, error * time)
    added, left = (ca.if_else(frozen, a, b) for a, b in ((integral, added), (carry, left)))
    follow = draft.kind(0)
    if sent is not None:
        acts = ca.fabs(ki) > 0
        rest = sent - kp * error - kd * slope_now
        follow = ca.if_else(acts, rest / ca.if_else(acts, ki, 1), 0)
    now = ca.if_else(draft.active, added, follow)
    draft.next("integral", now)
    draft.next("carry", ca.if_else(draft.active, left, 0))
    draft.next("slope", slope_now)
    draft.next("last_error", error)
    draft.next("started", draft.kind(1))
    return kp * error + ki * now + kd * slope_now
