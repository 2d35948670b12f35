"""Dead times: an input that takes effect later, as a delay line of states.

The line is the transport equation T w' = -dw/dxi on 0 < xi < 1, w(0) the input and w(1) what comes
out, discretised as an ODE would be: by collocation at Radau's points in each of some equal cells.
One cell of order n is Pade's approximation (n - 1, n) of exp(-s T), which follows a step without
jumping at once; n cells of order 1 are the chain of n lags T/n. Every state is the input as it was
some part of T ago, so at rest all of them equal it.

Source: the stability function of Radau IIA is this Pade approximation (E. Hairer, G. Wanner,
Solving Ordinary Differential Equations II, Springer 1996, IV.5); why (n - 1, n): M. Vajta, Some
remarks on Pade approximations, 3rd TEMPUS-INTCOM Symposium, 2000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count, require_positive
from ..core.system import Declares, Scope
from ..core.variables import Variable
from ..numerics.collocation import HIGHEST_DEGREE, collocation_matrices, collocation_points
from .kinds import DEAD_TIMES

Array: TypeAlias = NDArray[np.float64]


@DEAD_TIMES.register(units={"time": "s"})
@dataclass(frozen=True)
class DeadTime:
    """u(t - T), by one Pade approximation or a chain of lags, of chosen order.

    time : T [s], > 0; a parameter of the plant, ``<name>.dead_time``.
    order : of Pade's approximation in each cell, 1 .. 9.
    cells : equal pieces of the line; ``order=1`` makes them a chain of lags, which never overshoots
        but spreads a step over T/sqrt(cells).

    The motion with the exact dead time is that of ``simulate(..., dead_times="exact")``.

    Examples
    --------
    >>> late = pam.feeds.Regulator(lag=0.05, dead_time=pam.feeds.DeadTime(0.02, order=4))
    >>> [v.name for v in pam.HangingLoad(muscle, feed=late).states][-2:]
    ['muscle.delay3', 'muscle.delay4']
    """

    time: float
    order: int = 4
    cells: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", require_positive("DeadTime.time", self.time, "s"))
        for argument, most in (("order", HIGHEST_DEGREE), ("cells", None)):
            value = getattr(self, argument)
            whole = int(value) if isinstance(value, float) and value.is_integer() else value
            require_count(f"DeadTime.{argument}", whole, 1, most)
            object.__setattr__(self, argument, whole)  # files know no whole numbers

    @property
    def places(self) -> Array:
        """Where the states stand along the line, as parts of T (cells order,); the last is 1."""
        points = collocation_points("radau", self.order)
        return np.asarray((np.arange(self.cells)[:, None] + points).ravel() / self.cells)


@dataclass(frozen=True)
class DelayLine:
    """Which variables of a plant make a dead time; names only, so that it travels with the plant.

    source : the input. time : the parameter T. states : along the line, the last is what comes out.
    """

    source: str
    time: str
    states: tuple[str, ...]
    dead_time: DeadTime

    @property
    def outlet(self) -> str:
        """The state that the plant's equations see in place of the input."""
        return self.states[-1]


def as_dead_time(value: Any) -> DeadTime | None:
    """A DeadTime; a number is its time [s], None is none."""
    if value is None or isinstance(value, DeadTime):
        return value
    if isinstance(value, int | float | str):
        return DeadTime(cast(float, value))
    raise InputError(
        f"dead_time = {value!r}: give seconds, or DeadTime(seconds, order=..., cells=...)"
    )


def delay_line(
    plant: Declares, name: str, variable: Variable, source: ca.SX, dead_time: DeadTime
) -> tuple[ca.SX, DelayLine]:
    """Declare ``<name>.dead_time`` and the states ``<name>.delay1``, ...; give what comes out.

    variable, source : the input that is delayed, and its symbol.
    """
    scope = Scope(plant, name)
    time = scope.of("s", 0.01, min=1e-6).parameter(
        "dead_time", dead_time.time, f"dead time from {variable.name} to its effect"
    )
    places = dead_time.places
    states = [
        scope.of(
            variable.unit,
            variable.nominal,
            display_unit=variable.display_unit,
            start=float(variable.start or 0.0),
            memory="settling",
        ).state(f"delay{i}", f"{variable.name} as it was {part:.3g} dead times ago")
        for i, part in enumerate(places, start=1)
    ]
    slopes = collocation_matrices(collocation_points("radau", dead_time.order))[0]
    begin, order = source, dead_time.order
    for cell in range(dead_time.cells):
        own = states[cell * order : (cell + 1) * order]
        along = ca.horzcat(begin, *own) @ ca.DM(slopes)
        for state, slope in zip(own, ca.horzsplit(along), strict=True):
            plant.der(state, -slope * dead_time.cells / time)
        begin = own[-1]
    names = tuple(f"{name}.delay{i}" for i in range(1, len(states) + 1))
    return begin, DelayLine(variable.name, f"{name}.dead_time", names, dead_time)
