"""State feedback about a stop (LQR, LQI) as a block."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.variables import Variable
from ...plants.inversion import Inversion
from ..linear_quadratic import StateFeedback
from .draft import Draft, Symbol, compensated, least_norm, opened_by
from .kinds import BLOCKS

__all__ = ["Integrating", "acting", "at_rest", "state_feedback"]


class Integrating:
    """The integrals of a feedback u = v - Ki integral: frozen at limits, following while off.

    Each step begins with what the one before has left: its error, and whether an input was asked
    for beyond its range. So the guard can tell what became of the commands.
    """

    def __init__(self, draft: Draft, names: list[str]) -> None:
        self.draft, self.names = draft, names
        if names:
            self.frozen = draft.memory("frozen", description="an input was beyond its range")
        self._kept = [
            [
                draft.memory(f"{part}.{n}", description=words)
                for part, words in (
                    ("integral", "integral of the error"),
                    ("carry", "what rounding took from the integral"),
                    ("error", "error of the last step"),
                )
            ]
            for n in names
        ]

    def values(self, ki: Symbol, short: Symbol) -> Symbol:
        """The integrals now. short : what the feedback without integrals lacks to the inputs that
        acted (u_sent - v), which the integrals follow while something else is sent."""
        draft = self.draft
        self._now = []
        if not self.names:
            return draft.kind.zeros(0, 1)
        limited = ca.logic_or(self.frozen, draft.limited)
        follow = least_norm(ki, -short)
        for i, (total, carry, error) in enumerate(self._kept):
            more = ca.if_else(limited, 0, draft.sample_time * error)
            added, left = compensated(total, carry, more)
            added, left = (ca.if_else(limited, a, b) for a, b in ((total, added), (carry, left)))
            here = ca.if_else(draft.active, added, follow[i])
            self._now.append((here, ca.if_else(draft.active, left, 0)))
        return ca.vertcat(*(here for here, _ in self._now))

    def add(self, errors: list[Symbol], u: Symbol, low: np.ndarray, high: np.ndarray) -> None:
        """Leave the errors, and the inputs as they were asked for, to the next step."""
        if not self.names:
            return
        beyond = self.draft.kind(0)
        for i in range(len(low)):
            beyond = ca.fmax(beyond, ca.logic_or(u[i] < float(low[i]), u[i] > float(high[i])))
        self.draft.next("frozen", beyond)
        for name, (here, left), error in zip(self.names, self._now, errors, strict=True):
            self.draft.next(f"integral.{name}", here)
            self.draft.next(f"carry.{name}", left)
            self.draft.next(f"error.{name}", error)


@BLOCKS.register("StateFeedback")
def state_feedback(controller: StateFeedback, name: str = "state_feedback") -> Block:
    """u = u0 - K (x - x0) - Ki integral(y - wanted), as :class:`StateFeedback`.

    Inputs are the states, what is integrated, and ``wanted.NAME`` for it; gains are parameters.
    """
    point, draft = controller.point, Draft(name, controller.sample_time, "state feedback")
    plant = point.plant
    chosen = [plant.variable(n) for n in controller.inputs]
    integrated = [plant.variable(n) for n in controller.integrated]
    x = draft.states(controller.inversion, plant.states)
    k = draft.matrix("K", controller.K, chosen, plant.states)
    ki = draft.matrix("Ki", controller.Ki, chosen, integrated, "s")
    x0 = at_rest(draft, "x0", plant.states, point.x)
    u0 = at_rest(draft, "u0", chosen, point.u[controller._columns])
    v = u0 - ca.mtimes(k, x - x0)
    integrals = Integrating(draft, controller.integrated)
    if integrated:
        values = integrals.values(ki, acting(draft, controller.inversion, chosen) - v)
        u = v - ca.mtimes(ki, values)
    else:
        u = v
    goals = controller.wanted(0.0) if not callable(controller.setpoint) else {}
    errors = []
    for variable in integrated:
        goal = goals.get(variable.name, point[variable.name])
        wanted = draft.input(
            f"wanted.{variable.name}",
            goal,
            unit=variable.unit,
            nominal=variable.nominal,
            description=f"to be reached: {variable.description}",
        )
        errors.append(draft.like(variable) - wanted)
    integrals.add(errors, u, controller._low, controller._high)
    draft.send(controller.inversion, chosen, u)
    return draft.block()


def acting(draft: Draft, inversion: Inversion | None, chosen: list[Variable]) -> Symbol:
    """The chosen inputs that acted since the last step, openings from the commands sent."""
    if not inversion:
        return draft.sent(chosen)
    found = opened_by(inversion, inversion.plant, draft)
    return ca.vertcat(*(found[v.name] for v in chosen))


def at_rest(
    draft: Draft, name: str, variables: tuple[Variable, ...] | list[Variable], values: np.ndarray
) -> Symbol:
    """Values at a point of rest, each a parameter ``name.VARIABLE``."""
    return ca.vertcat(
        *(
            draft.parameter(
                f"{name}.{v.name}",
                float(value),
                unit=v.unit,
                nominal=v.nominal,
                description=f"{v.name} at the point of rest",
            )
            for v, value in zip(variables, values, strict=True)
        )
    )
