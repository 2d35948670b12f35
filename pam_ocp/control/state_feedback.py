"""State feedback about a stop (LQR, LQI), and the law that it shares with others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.block import Block
from ..core.errors import InputError
from ..core.variables import Variable
from ..operating.resting_point import OperatingPoint
from ..plants.inversion import Inversion
from .blocks.draft import Draft, Symbol, about, compensated, least_norm, opened_by
from .blocks.kinds import BLOCKS
from .blocks.running import SampledLaw
from .controller import Measured
from .references import Source

if TYPE_CHECKING:
    import control

__all__ = ["StateFeedback", "acting", "at_rest", "feedback_law"]

Array: TypeAlias = NDArray[np.float64]
Setpoint: TypeAlias = "Mapping[str, float] | Callable[[float], Mapping[str, float]] | None"


@dataclass
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
            self._check_setpoint(self.setpoint)

    def _check_setpoint(self, given: Mapping[str, float]) -> None:
        for name, value in given.items():
            variable = self.point.plant.variable(name)
            if variable.name not in self.integrated:
                raise InputError(
                    f"setpoint: {name} is not integrated, so the feedback holds it at its point; "
                    f"design lqr(..., integral={{{name!r}: weight}})"
                )
            variable.check(value, "setpoint")

    def wanted(self, t: float) -> dict[str, float]:
        """Values that the integrated outputs are to reach: the point's, or the set point's."""
        given = self.setpoint(t) if callable(self.setpoint) else (self.setpoint or {})
        known = self._at_point
        named = {
            n if n in known else self.point.plant.variable(n).name: v for n, v in given.items()
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
            if name not in self.integrated:
                raise InputError(
                    f"reference: {name} is not integrated, so the feedback holds it at its point; "
                    f"design lqr(..., integral={{{name!r}: weight}})"
                )
        return replace(self, setpoint=lambda t: {n: at(t) for n, at in reference.items()})

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        gains = np.concatenate([self.K.ravel(), self.Ki.ravel()])
        self._law.parameters[: len(gains)] = gains  # they may have been changed since
        return super().__call__(t, measured)

    def _augmented(self) -> tuple[Array, Array, Array]:
        """A, B with the integrals as last states, and all gains; continuous time, all states."""
        a, b = np.asarray(self.system.A), np.asarray(self.system.B)
        labels = [n.replace(".", "_") for n in self.integrated]
        c = np.asarray(self.system.C)[[self.system.output_labels.index(n) for n in labels]]
        n, k = len(a), len(c)
        a = np.block([[a, np.zeros((n, k))], [c, np.zeros((k, k))]])
        return a, np.vstack([b, np.zeros((k, b.shape[1]))]), np.hstack([self.K, self.Ki])

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

        a, b, k = self._augmented()
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
        a, b, k = self._stuck(*self._augmented())
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
        at_rest(draft, "x0", plant.states, point.x),
        at_rest(draft, "u0", chosen, [point[n] for n in controller.inputs]),
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

    states, chosen : x and u, beyond whose range the integrals are frozen. gains : K, Ki. about :
    x0, u0. tracked : what is integrated, and the values wanted of it.
    """
    (k, ki), (x0, u0), (integrated, wanted) = gains, about, tracked
    u = v = u0 - ca.mtimes(k, draft.states(inversion, states) - x0)
    integrals = Integrating(draft, [w.name for w in integrated])
    if integrated:
        short = acting(draft, inversion, chosen) - v
        u = v - ca.mtimes(ki, integrals.values(ki, short))
    errors = [draft.like(w) - goal for w, goal in zip(integrated, wanted, strict=True)]
    integrals.add(errors, u, chosen)
    draft.send(inversion, chosen, u)


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

    def add(self, errors: list[Symbol], u: Symbol, chosen: Sequence[Variable]) -> None:
        """Leave the errors, and the inputs as they were asked for, to the next step."""
        if not self.names:
            return
        beyond = self.draft.kind(0)
        for i, v in enumerate(chosen):
            beyond = ca.fmax(beyond, ca.logic_or(u[i] < v.min, u[i] > v.max))
        self.draft.next("frozen", beyond)
        for name, (here, left), error in zip(self.names, self._now, errors, strict=True):
            self.draft.next(f"integral.{name}", here)
            self.draft.next(f"carry.{name}", left)
            self.draft.next(f"error.{name}", error)


def acting(draft: Draft, inversion: Inversion | None, chosen: list[Variable]) -> Symbol:
    """The chosen inputs that acted since the last step, openings from the commands sent."""
    if not inversion:
        return draft.sent(chosen)
    acted = opened_by(inversion, inversion.plant, draft)
    return ca.vertcat(*(acted[v.name] for v in chosen))


def at_rest(draft: Draft, name: str, variables: Sequence[Variable], values: ArrayLike) -> Symbol:
    """Values at an equilibrium, each a parameter ``name.VARIABLE``."""
    return ca.vertcat(
        *(
            draft.parameter(
                f"{name}.{v.name}", float(value), **about(v, f"{v.name} at the equilibrium")
            )
            for v, value in zip(variables, np.asarray(values, dtype=float), strict=True)
        )
    )
