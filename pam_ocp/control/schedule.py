"""Gain scheduling: LQR or LQI at every point of a grid, gains interpolated in between."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import require_positive
from ..core.stop import verb
from ..operating.linear import LinearGrid, linearize_grid
from ..plants.inversion import Inversion
from ..plants.plant import Plant, Values, require_plant
from .controller import Measured
from .linear_quadratic import Integrals, lqr, saturated, sent, states_of

__all__ = ["ScheduledFeedback", "scheduled_lqr"]

Array: TypeAlias = NDArray[np.float64]


@dataclass
class ScheduledFeedback:
    """u = u0(s) - K(s) (x - x0(s)) - Ki(s) integral(y - y(s)): a Controller, s the place in the
    grid.

    place : t -> {axis: value}, where the plant is to be (position and stiffness, say): it chooses
    the point of rest and the gains. Values beyond the grid are taken at its border. For a plant fed
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
        plant = self.family.plant
        names = [v.name for v in plant.inputs]
        self._columns = [names.index(n) for n in self.family.inputs]
        self._states = [v.name for v in plant.states]
        self._low, self._high = (
            plant.vector("input", attribute=a)[self._columns] for a in ("min", "max")
        )
        self._goals = np.array(
            [[p[n] for n in self.integrated] for p in self.family.points.ravel()]
        ).reshape(*self.family.points.shape, len(self.integrated))
        self._integrals = Integrals(self.integrated)

    def reset(self) -> None:
        """See :class:`Controller`."""
        self._integrals.reset()

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

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        where = self.where(t)
        x0, u0, k, ki, goals = (
            self.family.interpolated(m, where)
            for m in (self.family.x, self.family.u, self.K, self.Ki, self._goals)
        )
        x = states_of(self.inversion, self._states, measured)
        u = u0[self._columns] - k @ (x - x0) - ki @ self._integrals.values
        if self.integrated:
            error = np.array([measured[n] for n in self.integrated]) - goals
            self._integrals.add(error, self.sample_time, saturated(u, self._low, self._high))
        return sent(self.inversion, list(self.family.inputs), u, measured)


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
    """LQR (LQI with ``integral``) at each point of rest of a grid, interpolated by ``place``.

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
