"""State feedback without offset: the disturbance is estimated and made good for (no integrals)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.block import Block
from ..core.errors import InputError, require_instance
from ..core.stop import turns
from ..operating.linear import chosen_signals, linearize
from .blocks.chain import chain
from .blocks.draft import Draft, clipped
from .blocks.kinds import BLOCKS
from .blocks.running import ByBlock, Running
from .controller import Measured
from .estimators.stationary import StationaryFilter, stationary_filter
from .state_feedback import StateFeedback

__all__ = ["OffsetFree"]

Array: TypeAlias = NDArray[np.float64]


@dataclass
class OffsetFree(ByBlock):
    """u = u0 + u_d - K (estimate - x0 - x_d): a Controller for :func:`closed_loop`.

    feedback : from ``lqr`` without integrals. filter : from ``kalman(..., disturbances=...)``.
    hold : states or outputs to keep at ``goal`` (by default the point's values), at most as many as
        inputs that the feedback chooses.

    x_d, u_d is the rest of the linear model under the estimated disturbance at which the held
    values are met (of least norm scaled by nominals, where there is a choice). When all that is
    held is measured, and as many disturbances are estimated as values measured, nothing is left at
    rest, whatever the true disturbance is: a wrong load, friction, a wrong force law (K. R. Muske
    and T. A. Badgwell, Journal of Process Control 12 (2002) 617-632). It follows a change of the
    goal without the overshoot of an integral.

    Examples
    --------
    >>> push = pam.loads.ExternalForce("push")
    >>> pushed = pam.AntagonisticSlide(muscle, 2.0, loads=push)
    >>> rest = pushed.equilibrium(x=0.0, stiffness=2e4)
    >>> drift = {"push": 100.0}  # [N/sqrt(s)]
    >>> filter = pam.control.kalman(pushed, rest, measured={"x": 1e-5}, disturbances=drift)
    >>> law = pam.control.OffsetFree(pam.lqr(pushed, rest), filter, hold=["x"])
    >>> loop = pam.closed_loop(law, pushed, duration=0.5, start=rest, disturbances={"push": 20.0})
    >>> bool(abs(loop["x"][-1]) < 1e-4)
    True
    """

    feedback: StateFeedback
    filter: StationaryFilter
    hold: Sequence[str]
    goal: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._check()
        plant = self.feedback.point.plant
        self._goal = {plant.variable(n).name: float(v) for n, v in self.goal.items()}
        every = [v.name for v in plant.inputs]
        self._chosen, unknown = (
            [every.index(n) for n in names]
            for names in (self.feedback.inputs, self.filter.disturbances)
        )
        self._to_goal, self._to_disturbance = self._rest(unknown)

    def _check(self) -> None:
        require_instance("OffsetFree: feedback", self.feedback, StateFeedback, "give that of lqr()")
        require_instance(
            "OffsetFree: filter", self.filter, StationaryFilter, "give that of kalman()"
        )
        if self.feedback.integrated:
            raise InputError(
                f"OffsetFree: the feedback integrates {self.feedback.integrated[0]}; design it "
                "without integral, the estimate does that work"
            )
        if not self.filter.disturbances:
            raise InputError(
                "OffsetFree: the filter estimates no disturbance; give kalman(..., "
                "disturbances=...)"
            )
        if not np.isclose(self.feedback.sample_time, self.filter.sample_time, rtol=1e-9):
            raise InputError(
                f"OffsetFree: sample_time = {self.feedback.sample_time:g} s of the feedback, "
                f"{self.filter.sample_time:g} s of the filter; design both for one"
            )
        plant = self.feedback.point.plant
        self._held = chosen_signals("hold", plant, self.hold, ("state", "output"))
        if not 1 <= len(self._held) <= len(self.feedback.inputs):
            raise InputError(
                f"hold names {len(self._held)} value(s); give 1 .. {len(self.feedback.inputs)}, as "
                "many as there are inputs to choose"
            )

    def _rest(self, unknown: list[int]) -> tuple[Array, Array]:
        """How the rest (x_d, u_d) moves with the goal, and with the disturbances [SI].

        [A B; C D] (x_d, u_d) = (-B_d d, goal - D_d d), scaled by nominals.
        """
        plant, chosen = self.feedback.point.plant, self._chosen
        system = linearize(plant, self.feedback.point, outputs=self._held, stuck=True)
        follow = self.feedback.point.stuck  # held memories follow the other states
        a, b, c, d = (np.asarray(getattr(system, n)) for n in "ABCD")
        x, u = (plant.vector(kind, attribute="nominal") for kind in ("state", "input"))
        x = x[follow.kept]
        y = np.array([plant.variable(n).nominal for n in self._held])
        size = np.concatenate([x, u[chosen]])
        matrix = np.block([[a, b[:, chosen]], [c, d[:, chosen]]])
        matrix = matrix * size / np.concatenate([x, y])[:, None]
        if np.linalg.matrix_rank(matrix) < len(matrix):
            raise InputError(
                f"OffsetFree: {', '.join(self._held)} cannot be held by "
                f"{', '.join(self.feedback.inputs)}"
            )
        moved = follow.lift(more=len(chosen)) @ (size[:, None] * np.linalg.pinv(matrix))
        push = np.vstack([b[:, unknown] / x[:, None], d[:, unknown] / y[:, None]])
        return moved[:, len(a) :] / y, -moved @ push

    def reset(self) -> None:
        """See :class:`Controller`."""
        self.filter.reset()

    def aims(self, t: float) -> dict[str, float]:
        """What is held, and where."""
        return {n: self._goal.get(n, self.feedback.point[n]) for n in self._held}

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        law, filter = self._law, self.filter
        filter.correct(measured)
        law.measure({**filter.state, **filter.disturbance})
        sent = law.commands()
        filter.predict(sent)
        return sent

    @turns
    def _running(self) -> Running:
        return Running(_feedback(self))


# ---- as a block ---------------------------------------------------------------------------------
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
    disturbed = [draft.like(v) - float(point[v.name]) for v in unknown]
    held = ((plant.variable(n), float(point[n])) for n in controller._held)
    wanted = [draft.wanted(v, controller._goal.get(v.name, at)) - at for v, at in held]
    k = draft.matrix("K", feedback.K, chosen, plant.states)
    rest = ca.mtimes(ca.DM(controller._to_goal), ca.vertcat(*wanted))
    rest = rest + ca.mtimes(ca.DM(controller._to_disturbance), ca.vertcat(*disturbed))
    x_rest, u_rest = ca.vertsplit(rest, [0, len(plant.states), rest.numel()])
    u = ca.DM(point.u[controller._chosen]) + u_rest
    u = u - ca.mtimes(k, estimate - ca.DM(point.x) - x_rest)
    sent = clipped(u, [v.min for v in chosen], [v.max for v in chosen])
    draft.send(feedback.inversion, chosen, sent)
    return draft.block()
