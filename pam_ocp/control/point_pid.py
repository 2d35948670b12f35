"""PID on a position about an equilibrium: the plain loop that most rigs begin with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.block import Block
from ..core.errors import InputError, kind_of, require_finite, require_positive
from ..operating.linear import inside, linearize, no_influence
from ..operating.resting_point import OperatingPoint
from ..plants.plant import Plant, Values, require_plant
from .blocks.draft import Draft, Symbol, clipped
from .blocks.running import SampledLaw
from .kinds import BLOCKS, CONTROLLERS
from .pid import PID, pid_law
from .references import Source
from .state_feedback import REST, acting

if TYPE_CHECKING:
    import control


@CONTROLLERS.register("pid", units={"filter_time": "s", "sample_time": "s"})
@dataclass
class PointPid(SampledLaw):
    """u = u0 + weight (P e + I + D), e = wanted - position: a Controller for :func:`closed_loop`.

    plant : the model. at : the equilibrium (an OperatingPoint, or conditions of one), at whose
        position the loop holds until it is told another (``reference`` of ``closed_loop``).
    proportional, integral, derivative : gains [unit of the inputs per unit of position, per s,
        times s]; of a plant fed by valves, whose openings are the inputs, per opening.
    weights : {input: how it takes part}; by default 1 or -1 for each, as it moves the position.
    filter_time : of the derivative [s]. sample_time : of the loop [s].

    ``position`` is what it moves, ``shares`` are the weights of the inputs that it moves.
    ``loop`` is python-control's L(s), broken at the error, ``poles`` are those of the closed loop
    (continuous, linear). Raises InputError where no input moves the position.

    Examples
    --------
    >>> pid = pam.control.PointPid(plant, point, proportional=1e6, integral=2e7, sample_time=2e-3)
    >>> loop = pam.closed_loop(pid, plant, {"x": 0.042}, duration=2.0, start=point)
    >>> print(f"{loop['x'][-1]:.4f}")
    0.0420
    """

    plant: Plant
    at: OperatingPoint | Values
    proportional: float
    integral: float = 0.0
    derivative: float = 0.0
    weights: Mapping[str, float] | None = None
    filter_time: float = 5e-3
    sample_time: float = 1e-3
    goal: Source | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        require_plant(self.plant)
        if not isinstance(self.at, OperatingPoint | Mapping):
            raise InputError(
                f"PointPid: at is {kind_of(self.at)}; give an equilibrium, or conditions "
                "by name such as {'x': 0.04}"
            )
        for name in ("proportional", "integral", "derivative"):
            setattr(self, name, require_finite(f"PointPid.{name}", getattr(self, name)))
        for name in ("filter_time", "sample_time"):
            setattr(self, name, require_positive(f"PointPid.{name}", getattr(self, name), "s"))
        if len(self.plant.load_positions) != 1:
            raise InputError(
                f"PointPid needs a plant with one position; {self.plant.name!r} has "
                f"{', '.join(self.plant.load_positions) or 'none'}"
            )
        self.position = next(iter(self.plant.load_positions))
        self.inversion, self.point = inside(self.plant, self.at)
        inner = self.point.plant
        inputs = [v.name for v in inner.inputs if not v.disturbance]
        self.system = linearize(inner, self.point, inputs=inputs, outputs=[self.position])
        matrices = np.asarray(self.system.A), np.asarray(self.system.B)
        no_influence("PointPid", inner, *matrices, inputs)
        self.shares = self._signs(inputs) if self.weights is None else dict(self.weights)
        unknown = [n for n in self.shares if n not in inputs]
        if unknown:
            raise InputError(f"PointPid.weights: {unknown[0]} is none of {', '.join(inputs)}")
        self.pid = PID(self.proportional, self.integral, self.derivative, self.filter_time)
        self._at_point = float(self.point[self.position])

    def _signs(self, inputs: list[str]) -> dict[str, float]:
        """Which way each input first moves the position: of the first Markov parameter there is."""
        a, b, c = (np.asarray(getattr(self.system, n)) for n in ("A", "B", "C"))
        size = np.abs(c @ b).max()
        for _ in range(len(a)):
            if size > 0:
                break
            b = a @ b
            size = np.abs(c @ b).max()
        moved = (c @ b).ravel()
        return {n: float(np.sign(v)) for n, v in zip(inputs, moved, strict=True) if v}

    # ---- the loop --------------------------------------------------------------------------------
    @cached_property
    def loop(self) -> control.StateSpace:
        """L(s) from the error to the position, the derivative filtered."""
        import control

        column = np.zeros((self.system.ninputs, 1))
        labels = list(self.system.input_labels)
        for name, weight in self.shares.items():
            column[labels.index(name.replace(".", "_"))] = weight
        single = control.ss(
            self.system.A, np.asarray(self.system.B) @ column, self.system.C, np.zeros((1, 1))
        )
        t, p, i, d = self.filter_time, self.proportional, self.integral, self.derivative
        # P + I/s + D s/(t s + 1), the integral and the filtered error as states
        made = control.ss(
            np.array([[0.0, 0.0], [0.0, -1 / t]]),
            np.array([[1.0], [1.0]]),
            np.array([[i, -d / t**2]]),
            np.array([[p + d / t]]),
        )
        if not i:
            made = control.ss([[-1 / t]], [[1.0]], [[-d / t**2]], [[p + d / t]])
        return control.series(made, single)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Of the closed loop [1/s], sorted by falling real part."""
        a, b, c = (np.asarray(getattr(self.loop, n)) for n in ("A", "B", "C"))
        poles = np.linalg.eigvals(a - b @ c)
        return np.asarray(poles[np.argsort(-poles.real)], dtype=np.complex128)

    # ---- a Controller ----------------------------------------------------------------------------
    def wanted(self, t: float) -> dict[str, float]:
        """The position to be reached at a time [s]."""
        return {self.position: self._at_point if self.goal is None else self.goal(t)}

    def tracking(
        self, reference: Mapping[str, Source], inputs: Mapping[str, float], preview: bool
    ) -> PointPid:
        """The Controller that takes the position to ``reference``; see :class:`Tracking`."""
        for name in reference:
            if name != self.position:
                raise InputError(f"reference: {name} is not followed, only {self.position}")
        return replace(self, at=self.point, plant=self.plant, goal=reference.get(self.position))

    def _needed(self) -> set[str]:
        return {self.position}


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("PointPid")
def point_pid(controller: PointPid, name: str = "pid") -> Block:
    """u = u0 + weight PID(wanted - position), as :class:`PointPid`.

    Inputs are the position and ``wanted.POSITION``; gains, weights and the point are parameters.
    Of a plant with valves the other openings are held where they rest.
    """
    point, inversion = controller.point, controller.inversion
    draft = Draft(name, controller.sample_time, "PID about an equilibrium")
    weights = controller.shares
    chosen = [
        v
        for v in point.plant.inputs
        if v.name in weights or (inversion and not v.disturbance)  # all openings are sent
    ]
    position = controller.plant.variable(controller.position)
    wanted = draft.wanted(position, controller.wanted(0.0)[position.name])
    u0 = draft.parameters("u0", chosen, [point[v.name] for v in chosen], REST)
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
    error = wanted - draft.like(position)
    saturated = draft.memory("saturated", description="all inputs that it moves beyond their range")
    held_back = draft.held_back

    def beyond(last: Symbol) -> Symbol:
        return saturated * last + held_back * (last - acted)

    u = u0 + w * pid_law(draft, controller.pid, error, beyond, acted)
    sent = clipped(u, [v.min for v in chosen], [v.max for v in chosen])
    draft.next("saturated", ca.mmin(ca.logic_or(sent != u, w == 0)))
    draft.send(inversion, chosen, sent)
    return draft.block()
