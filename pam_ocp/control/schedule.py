"""Gain scheduling: LQR or LQI at every point of a grid, gains interpolated in between."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.block import Block
from ..core.errors import require_positive
from ..core.stop import verb
from ..operating.linear import LinearGrid, linearize_grid
from ..plants.inversion import Inversion
from ..plants.plant import Plant, Values, require_plant
from .blocks.draft import Draft, Symbol, about
from .blocks.kinds import BLOCKS
from .blocks.running import SampledLaw
from .linear_quadratic import lqr
from .state_feedback import feedback_law

__all__ = ["ScheduledFeedback", "scheduled_lqr"]

Array: TypeAlias = NDArray[np.float64]


@dataclass
class ScheduledFeedback(SampledLaw):
    """u = u0(s) - K(s) (x - x0(s)) - Ki(s) integral(y - y(s)): a Controller, s the place in the
    grid.

    place : t -> {axis: value}, where the plant is to be (position and stiffness, say): it chooses
    the equilibrium and the gains. Values beyond the grid are taken at its border. For a plant fed
    by valves u stands for the openings; the commands that give them are sent.
    """

    family: LinearGrid
    K: Array = field(repr=False)
    Ki: Array = field(repr=False)
    integrated: list[str]
    place: Callable[[float], Mapping[str, float]]
    sample_time: float
    inversion: Inversion | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        names = [v.name for v in self.family.plant.inputs]
        self._columns = [names.index(n) for n in self.family.inputs]
        self._goals = np.array(
            [[p[n] for n in self.integrated] for p in self.family.points.ravel()]
        ).reshape(*self.family.points.shape, len(self.integrated))

    def where(self, t: float) -> dict[str, float]:
        """The place in the grid at a time [s], within its borders."""
        plant = self.family.plant
        given = {plant.variable(n).name: v for n, v in self.place(t).items()}
        return {
            n: float(np.clip(given[n], axis[0], axis[-1])) if n in given else float(axis[0])
            for n, axis in self.family.axes.items()
        }

    def aims(self, t: float) -> dict[str, float]:
        """The positions among the axes at a time [s]."""
        positions = {p.name for p in self.family.plant.resting()}
        return {n: v for n, v in self.where(t).items() if n in positions}

    def _references(self, t: float) -> dict[str, float]:
        return {f"place.{n}": value for n, value in self.where(t).items()}


@verb
def scheduled_lqr(
    plant: Plant,
    axes: Mapping[str, ArrayLike],
    place: Callable[[float], Mapping[str, float]],
    conditions: Values | None = None,
    *,
    weights: Mapping[str, float] | None = None,
    effort: float | Mapping[str, float] = 1.0,
    integral: Mapping[str, float] | None = None,
    sample_time: float = 1e-3,
) -> ScheduledFeedback:
    """LQR (LQI with ``integral``) at each equilibrium of a grid, interpolated by ``place``.

    axes, conditions : see :func:`linearize_grid`, such as positions and stiffnesses.
    place : t [s] -> {axis: value}. weights, effort, integral : see :class:`Weighting`.
    sample_time : sampling time [s] of the controller.

    Examples
    --------
    >>> place = lambda t: {"x": 0.03 + 0.01 * t}
    >>> law = pam.control.scheduled_lqr(plant, {"x": [0.03, 0.05]}, place)
    >>> loop = pam.closed_loop(law, plant, duration=0.5, start=plant.equilibrium(x=0.03))
    >>> print(f"{loop['x'][-1]:.3f}")
    0.035
    """
    inversion = Inversion(require_plant(plant))
    inner = inversion.inner
    if isinstance(effort, Mapping):
        effort = inversion.names(effort)
    inputs = [v.name for v in inner.inputs if not v.disturbance]
    family = linearize_grid(inner, axes, inversion.conditions(conditions), inputs=inputs)
    designs = [
        lqr(p.plant, p, weights=weights, effort=effort, integral=integral, sample_time=sample_time)
        for p in family.points.ravel()
    ]
    shape = family.points.shape
    k = np.array([d.K for d in designs]).reshape(*shape, *designs[0].K.shape)
    ki = np.array([d.Ki for d in designs]).reshape(*shape, *designs[0].Ki.shape)
    return ScheduledFeedback(
        family,
        k,
        ki,
        designs[0].integrated,
        place,
        require_positive("sample_time", sample_time, "s"),
        inversion if inversion else None,
    )


# ---- as a block ---------------------------------------------------------------------------------
@BLOCKS.register("ScheduledFeedback")
def scheduled_feedback(controller: ScheduledFeedback, name: str = "scheduled") -> Block:
    """u = u0(s) - K(s) (x - x0(s)) - Ki(s) integral(y - y(s)), as :class:`ScheduledFeedback`.

    The place s in the grid are the inputs ``place.AXIS``, kept within its borders.
    """
    c, family = controller, controller.family
    plant = family.plant
    draft = Draft(name, c.sample_time, "scheduled state feedback", ca.MX)
    start = c.where(0.0)
    places = []
    for n, axis in family.axes.items():
        v = plant.variable(n)
        words = about(v, "where the plant is to be: it chooses the gains")
        s = draft.input(f"place.{n}", start[n], **words)
        places.append(ca.fmin(ca.fmax(s, float(axis[0])), float(axis[-1])))
    at = ca.vertcat(*places)
    axes = [np.asarray(axis, dtype=float).tolist() for axis in family.axes.values()]
    chosen = [plant.variable(n) for n in family.inputs]
    integrated = [plant.variable(n) for n in c.integrated]
    nu, nx, ni = len(chosen), len(plant.states), len(integrated)

    def table(name: str, values: Array) -> Symbol:
        if not values.size:
            return draft.kind.zeros(0, 1)
        return _interpolated(name, axes, values, len(family.axes))(at)

    x0, u0 = table("x0", family.x), table("u0", family.u[..., c._columns])
    k = ca.reshape(table("gains", np.swapaxes(c.K, -1, -2)), nu, nx)
    ki = ca.reshape(table("integral_gains", np.swapaxes(c.Ki, -1, -2)), nu, ni)
    goals = ca.vertsplit(table("goals", c._goals)) if integrated else []
    tracked = integrated, goals
    feedback_law(draft, c.inversion, plant.states, chosen, (k, ki), (x0, u0), tracked)
    return draft.block()


def _interpolated(name: str, axes: list[list[float]], values: Array, depth: int) -> ca.Function:
    """place -> values, linear along each axis; entries of an array run along its last axes."""
    flat = values.reshape(*values.shape[:depth], -1)
    order = np.moveaxis(flat, -1, 0).reshape(flat.shape[-1], -1, order="F")
    return ca.interpolant(name, "linear", axes, order.T.ravel().tolist())
