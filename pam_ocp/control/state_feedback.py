"""State feedback about a stop (LQR, LQI), and the law that it shares with others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.block import Block
from ..core.errors import InputError, require_instance
from ..core.stop import turns
from ..core.variables import Variable
from ..operating.linear import chosen_signals, linearize
from ..operating.resting_point import OperatingPoint
from ..plants.inversion import Inversion
from .blocks.chain import chain
from .blocks.draft import Draft, Symbol, clipped, compensated, least_norm, opened_by
from .blocks.guard import ROUNDING
from .blocks.running import ByBlock, Running, SampledLaw
from .controller import Measured
from .estimators.stationary import StationaryFilter, require_one_sample_time, stationary_filter
from .kinds import BLOCKS, ESTIMATE, Array
from .references import Source

if TYPE_CHECKING:
    import control

Setpoint: TypeAlias = "Mapping[str, float] | Callable[[float], Mapping[str, float]] | None"
REST = "at the equilibrium"


@dataclass(eq=False)
class StateFeedback(SampledLaw):
    """u = u0 - K (x - x0) - Ki integral(y - wanted): a Controller for :func:`closed_loop`.

    K : (inputs, states), Ki : (inputs, integrated outputs), SI units. ``closed`` : python-control's
    system of the closed loop (linear), ``loop`` : the loop broken at the inputs, for margins.
    inversion : for a plant fed by valves, whose openings are u (then ``point`` and ``inputs`` speak
    of them): the commands that give these openings are sent.
    """

    point: OperatingPoint
    inputs: list[str]
    K: Array
    Ki: Array
    integrated: list[str]
    sample_time: float
    setpoint: Setpoint = None
    system: Any = field(default=None, repr=False)
    inversion: Inversion | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._at_point = {n: self.point[n] for n in self.integrated}
        if isinstance(self.setpoint, Mapping):
            named = {self._integrated("setpoint", n): v for n, v in self.setpoint.items()}
            self.setpoint = {v.name: v.check(value, "setpoint") for v, value in named.items()}

    def _integrated(self, argument: str, name: str) -> Variable:
        """What is to be reached. InputError where it is not integrated."""
        variable = self.point.plant.variable(name)
        if variable.name not in self.integrated:
            raise InputError(
                f"{argument}: {name} is not integrated, so the feedback holds it at its point; "
                f"design lqr(..., integral={{{name!r}: weight}})"
            )
        return variable

    def wanted(self, t: float) -> dict[str, float]:
        """Values that the integrated outputs are to reach: the point's, or the set point's."""
        given = self.setpoint(t) if callable(self.setpoint) else (self.setpoint or {})
        known = self._at_point
        named = {
            n if n in known else self._integrated("setpoint", n).name: v for n, v in given.items()
        }
        return {n: named.get(n, value) for n, value in known.items()}

    def aims(self, t: float) -> dict[str, float]:
        """What is to arrive: what is integrated, or else the positions at the point."""
        if self.integrated:
            return self.wanted(t)
        return {p.name: self.point[p.name] for p in self.point.plant.resting()}

    def tracking(
        self, reference: Mapping[str, Source], inputs: Mapping[str, float], preview: bool
    ) -> StateFeedback:
        """The Controller that takes what it integrates to ``reference``; see :class:`Tracking`."""
        for name in reference:
            self._integrated("reference", name)
        return replace(
            self, setpoint=lambda t: self.wanted(t) | {n: at(t) for n, at in reference.items()}
        )

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        gains = np.concatenate([self.K.ravel(), self.Ki.ravel()])
        self._law.parameters[: len(gains)] = gains  # they may have been changed since
        return super().__call__(t, measured)

    def augmented(self) -> tuple[Array, Array, Array]:
        """A, B with the integrals as last states, and all gains; continuous time, all states."""
        a, b = np.asarray(self.system.A), np.asarray(self.system.B)
        labels = [n.replace(".", "_") for n in self.integrated]
        rows = [self.system.output_labels.index(n) for n in labels]
        c, d = (np.asarray(m)[rows] for m in (self.system.C, self.system.D))
        n, k = len(a), len(c)
        a = np.block([[a, np.zeros((n, k))], [c, np.zeros((k, k))]])
        return a, np.vstack([b, d]), np.hstack([self.K, self.Ki])

    def _stuck(
        self, a: Array, b: Array, k: Array, nominal: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """A, B and gains without held memories, which stick to the other states."""
        more = len(self.integrated)
        lift, pick = self.point.stuck.lift(nominal, more), self.point.stuck.pick(more)
        return pick @ a @ lift, pick @ b, k @ lift

    @property
    def loop(self) -> control.StateSpace:
        """K (s I - A)^-1 B, in units of the inputs' nominals: the loop broken at the inputs."""
        import control

        a, b, k = self.augmented()
        plant = self.point.plant
        effort = np.array([plant.variable(n).nominal for n in self.inputs])
        states = np.concatenate(
            [plant.vector("state", attribute="nominal")]
            + [[plant.variable(n).nominal] for n in self.integrated]
        )
        a, b = a * states / states[:, None], b * effort / states[:, None]
        k = k * states / effort[:, None]
        a, b, k = self._stuck(a, b, k, self.point.plant.vector("state", attribute="nominal"))
        labels = [n.replace(".", "_") for n in self.inputs]
        return control.ss(
            a,
            b,
            k,
            np.zeros((len(k), len(k))),
            inputs=labels,
            outputs=[f"{n}_fed" for n in labels],
            name="loop",
        )

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Of the closed loop [1/s], sorted by falling real part."""
        a, b, k = self._stuck(*self.augmented())
        poles = np.linalg.eigvals(a - b @ k)
        return np.asarray(poles[np.argsort(-poles.real)], dtype=np.complex128)


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("StateFeedback")
def state_feedback(controller: StateFeedback, name: str = "state_feedback") -> Block:
    """u = u0 - K (x - x0) - Ki integral(y - wanted), as :class:`StateFeedback`.

    Inputs are the states, what is integrated, and ``wanted.NAME`` for it; gains are parameters.
    """
    point, draft = controller.point, Draft(name, controller.sample_time, "state feedback")
    plant = point.plant
    chosen = [plant.variable(n) for n in controller.inputs]
    integrated = [plant.variable(n) for n in controller.integrated]
    gains = (
        draft.matrix("K", controller.K, chosen, plant.states),
        draft.matrix("Ki", controller.Ki, chosen, integrated, "s"),
    )
    about = (
        draft.parameters("x0", plant.states, point.x, REST),
        draft.parameters("u0", chosen, [point[n] for n in controller.inputs], REST),
    )
    goals = controller._at_point if callable(controller.setpoint) else controller.wanted(0.0)
    wanted = [draft.wanted(v, goals[v.name]) for v in integrated]
    tracked = integrated, wanted
    feedback_law(draft, controller.inversion, plant.states, chosen, gains, about, tracked)
    return draft.block()


def feedback_law(
    draft: Draft,
    inversion: Inversion | None,
    states: Sequence[Variable],
    chosen: list[Variable],
    gains: tuple[Symbol, Symbol],
    about: tuple[Symbol, Symbol],
    tracked: tuple[list[Variable], Sequence[Symbol]],
) -> None:
    """Enter u = u0 - K (x - x0) - Ki integral(y - wanted), and its commands.

    states, chosen : x and u, beyond whose range no integral drives them further. gains : K, Ki.
    about : x0, u0. tracked : what is integrated, and the values wanted of it.

    Each step begins with what the one before has left: its errors, and the inputs asked for. So the
    guard can tell what became of the commands; while something else is sent, the integrals follow
    the inputs that acted.
    """
    (k, ki), (x0, u0), (integrated, wanted) = gains, about, tracked
    u = u0 - ca.mtimes(k, draft.states(inversion, states) - x0)
    if not integrated:
        draft.send(inversion, chosen, u)
        return
    total, carry, error = (
        draft.remembered(part, integrated, words, plain=True)
        for part, words in (
            ("integral", "integral of the error"),
            ("carry", "what rounding took from the integral"),
            ("error", "error of the last step"),
        )
    )
    asked = draft.remembered("asked", chosen, "input asked for in the last step")
    acted = acting(draft, inversion, chosen)
    had = clipped(asked, [v.min for v in chosen], [v.max for v in chosen])
    beyond = asked - ca.if_else(draft.held_back, acted, had)
    beyond = beyond * (ca.fabs(beyond) > ROUNDING * ca.DM([v.nominal for v in chosen]))
    frozen = ca.vertcat(
        *(ca.mmin(beyond * ki[:, j] * error[j]) < 0 for j in range(len(integrated)))
    )
    added, left = compensated(total, carry, draft.sample_time * error)
    added, left = (ca.if_else(frozen, a, b) for a, b in ((total, added), (carry, left)))
    now = ca.if_else(draft.active, added, least_norm(ki, u - acted))
    u = u - ca.mtimes(ki, now)
    errors = [draft.like(v) - goal for v, goal in zip(integrated, wanted, strict=True)]
    first = integrated[0].name
    draft.next(f"asked.{chosen[0].name}", u)
    draft.next(f"integral.{first}", now)
    draft.next(f"carry.{first}", ca.if_else(draft.active, left, 0))
    draft.next(f"error.{first}", ca.vertcat(*errors))
    draft.send(inversion, chosen, u)


def acting(draft: Draft, inversion: Inversion | None, chosen: list[Variable]) -> Symbol:
    """The chosen inputs that acted since the last step, openings from the commands sent."""
    if not inversion:
        return draft.sent(chosen)
    acted = opened_by(inversion, inversion.plant, draft)
    return ca.vertcat(*(acted[v.name] for v in chosen))


# ---- without offset: the disturbance is estimated and made good for (no integrals) ---------------
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
        own = self.feedback.sample_time
        require_one_sample_time("OffsetFree", "feedback", own, self.sample_time)
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

    @property
    def sample_time(self) -> float:
        """That of the filter."""
        return self.filter.sample_time

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
        unknown = {ESTIMATE + n: value for n, value in filter.disturbance.items()}
        law.measure(filter.state | unknown)
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
    disturbed = [draft.like(v, ESTIMATE) - float(point[v.name]) for v in unknown]
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
