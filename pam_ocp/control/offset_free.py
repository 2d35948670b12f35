"""State feedback without offset: the disturbance is estimated and made good for (no integrals)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_instance
from ..operating.linear import chosen_signals, linearize
from .controller import Measured
from .estimators.stationary import StationaryFilter
from .linear_quadratic import StateFeedback, sent

__all__ = ["OffsetFree"]

Array: TypeAlias = NDArray[np.float64]


@dataclass
class OffsetFree:
    """u = u0 + u_d - K (estimate - x0 - x_d): a Controller for :func:`closed_loop`.

    feedback : from ``lqr`` without integrals. filter : from ``kalman(..., disturbances=...)``.
    hold : states or outputs to keep at ``goal`` (by default the point's values), at most as many as
        inputs that the feedback chooses.

    x_d, u_d is the rest of the linear model under the estimated disturbance at which the held
    values are met (of least norm in units of nominal, where there is a choice). When all that is
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
        self._states = [v.name for v in plant.states]
        every = [v.name for v in plant.inputs]
        self._chosen, unknown = (
            [every.index(n) for n in names]
            for names in (self.feedback.inputs, self.filter.disturbances)
        )
        self._to_goal, self._to_disturbance = self._rest(unknown)
        self._low, self._high = (
            plant.vector("input", attribute=end)[self._chosen] for end in ("min", "max")
        )

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

        [A B; C D] (x_d, u_d) = (-B_d d, goal - D_d d), solved in units of nominal.
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
        point, feedback = self.feedback.point, self.feedback
        estimate = self.filter.correct(measured)
        unknown = np.array([v - point[n] for n, v in self.filter.disturbance.items()])
        wanted = np.array([self._goal.get(n, point[n]) - point[n] for n in self._held])
        rest = self._to_goal @ wanted + self._to_disturbance @ unknown
        n = len(self._states)
        u = point.u[self._chosen] + rest[n:] - feedback.K @ (estimate - point.x - rest[:n])
        u = np.clip(u, self._low, self._high)
        self.filter.predict(dict(zip(feedback.inputs, u.tolist(), strict=True)))
        return sent(feedback.inversion, feedback.inputs, u, self.filter.estimate.state)
