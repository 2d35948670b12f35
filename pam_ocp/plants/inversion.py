"""Effective openings: what stands in for commands with a dead zone, and the way back to the
commands.

A command in its dead zone has no slope, so neither a linear model nor a solver sees what it could
do.
The opening does: it is zero where the valve closes and moves the flow at once. A controller chooses
openings, and the commands that give exactly these are sent (dead-zone inversion: G. Tao and
P. V. Kokotovic, IEEE Trans. Automat. Control 39 (1994) 59-68).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.variables import Variable
from .opening import Opening
from .plant import Plant, Values

if TYPE_CHECKING:
    from ..courtesy import OperatingPoint

__all__ = ["Inversion", "in_dead_zone"]

Array: TypeAlias = NDArray[np.float64]


@dataclass
class Inversion:
    """Between a plant's inputs as they are sent and as a controller chooses them.

    plant : with commands. inner : the same with openings (the plant itself where it declares none).

    Examples
    --------
    >>> valves = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.SpoolValve())
    >>> inversion = pam.plants.Inversion(valves)
    >>> [v.name for v in inversion.inner.inputs]
    ['muscle.opening']
    """

    plant: Plant
    inner: Plant = field(init=False)

    def __post_init__(self) -> None:
        self.inner = self.plant.in_openings()
        self._of = {o.name: o for o in self.plant.openings}
        self._for = {c: o for o in self.plant.openings for c in o.commands}

    def __reduce__(self) -> tuple[Any, ...]:  # symbols do not travel; the plant makes them anew
        return type(self), (self.plant,)

    @cached_property
    def _p(self) -> Array:
        return self.plant.vector("parameter")

    def __bool__(self) -> bool:
        """Whether anything differs."""
        return bool(self._of)

    def _function(self, opening: Opening, forward: bool) -> ca.Function:
        """(commands, p) -> opening, or (opening, p) -> commands."""

        def build() -> ca.Function:
            commands = ca.vertcat(*(self.plant.expression(n) for n in opening.commands))
            if forward:
                return ca.Function("forward", [commands, self.plant.p], [opening.forward])
            results = [ca.vertcat(*opening.inverse)]
            return ca.Function("inverse", [opening.symbol, self.plant.p], results)

        return self.plant.cached(("opening", opening.name, forward), build)  # type: ignore[no-any-return]

    def forward(self, opening: str) -> ca.Function:
        """(its commands, parameters of the plant) -> the opening that they give."""
        return self._function(self._of[opening], True)

    def inverse(self, opening: str) -> ca.Function:
        """(opening, parameters of the plant) -> the commands that give it."""
        return self._function(self._of[opening], False)

    def commands_of(self, opening: str) -> tuple[str, ...]:
        """The commands that an opening stands in for."""
        return self._of[opening].commands

    def name(self, name: str) -> str:
        """What a variable of the plant is called inside: for a command the name of its opening."""
        opening = self.opening_of(name)
        if opening is not None:
            return opening
        full = self.plant.variable(name).name
        return self._for[full].name if full in self._for else full

    def alone(self, name: str) -> str:
        """The opening of a command that has one to itself; any other name as it is."""
        opening = self._for.get(name)
        return opening.name if opening is not None and len(opening.commands) == 1 else name

    def variable(self, name: str) -> Variable:
        """The variable of this name, an opening or one of the plant."""
        opening = self.opening_of(name)
        return self._of[opening].variable if opening else self.plant.variable(name)

    def names(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values by inner name, as weights: where commands share an opening the largest holds."""
        found: dict[str, float] = {}
        for name, value in values.items():
            inner = self.name(name)
            found[inner] = value if inner not in found else max(found[inner], value)
        return found

    def commands(self, values: Mapping[str, float], p: Array | None = None) -> dict[str, float]:
        """Openings among values by name replaced by the commands that give them."""
        found: dict[str, float] = {}
        for name, value in values.items():
            opening = self._of.get(self.opening_of(name) or "")
            if opening is None:
                found[name] = value
                continue
            sent = np.asarray(
                self._function(opening, False)(value, self._p if p is None else p)
            ).ravel()
            found.update(zip(opening.commands, sent.tolist(), strict=True))
        return found

    def openings(self, values: Mapping[str, float], p: Array | None = None) -> dict[str, float]:
        """Commands among values by name replaced by the openings that they give."""
        found = {n: v for n, v in values.items() if n not in self._for}
        for opening in self._of.values():
            if opening.name in found or not any(c in values for c in opening.commands):
                continue
            sent = [values.get(c, self.plant.variable(c).start or 0.0) for c in opening.commands]
            known = self._p if p is None else p
            found[opening.name] = float(self._function(opening, True)(sent, known))
        return found

    def conditions(self, values: Values | None) -> dict[str, float]:
        """Conditions of rest or start values, said of the plant inside."""
        named = {
            self.opening_of(n) or self.plant.variable(n).name: v for n, v in (values or {}).items()
        }
        return self.openings(named)

    def opening_of(self, name: str) -> str | None:
        """The full name of an opening (``_`` may stand for ``.``); None for any other name."""
        return next((o for o in self._of if name in (o, o.replace(".", "_"))), None)

    def references(self, values: Mapping[str, Any], count: int) -> dict[str, Any]:
        """Values (or ``count`` of them) by name,
        those of commands as the openings that they give.
        """
        named = {self.opening_of(n) or self.plant.variable(n).name: v for n, v in values.items()}
        sent = [n for n in named if n in self._for]
        found = {n: v for n, v in named.items() if n not in self._for}
        columns = [np.broadcast_to(np.asarray(named[n], dtype=float), (count,)) for n in sent]
        rows = [self.openings(dict(zip(sent, row, strict=True))) for row in np.transpose(columns)]
        return found | {n: np.array([row[n] for row in rows]) for n in (rows[0] if rows else ())}

    def bounds(self, bounds: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        """Bounds by name, those of commands as the openings at them;
        an end at the range's is none.
        """
        found: dict[str, tuple[float, float]] = {}
        for name, ends in bounds.items():
            inner, pair = name, ends
            if name in self._for:
                inner, pair = self._for[name].name, self._bound(name, ends)
            low, high = found.get(inner, (-np.inf, np.inf))
            found[inner] = (max(low, pair[0]), min(high, pair[1]))
        return found

    def _bound(self, command: str, ends: tuple[float, float]) -> tuple[float, float]:
        """The range of an opening under bounds of one of its commands (it is monotonic in each)."""
        variable, opening = self.plant.variable(command), self._for[command].name
        first, last = (
            self.openings({command: end})[opening] for end in (variable.min, variable.max)
        )
        found = [-np.inf, np.inf]
        for i, end in enumerate(ends):
            if variable.min < end < variable.max:
                found[i if last > first else 1 - i] = self.openings({command: end})[opening]
        return found[0], found[1]

    def all_free(self, conditions: Values) -> bool:
        """Whether there are openings, and no condition names a command that they stand in for."""
        return bool(self) and not any(
            self.opening_of(n) is None and self.plant.variable(n).name in self._for
            for n in conditions
        )

    def entered(self, point: OperatingPoint) -> OperatingPoint:
        """A point of the plant, with openings."""
        if [v.name for v in point.plant.inputs] == [v.name for v in self.inner.inputs]:
            return point
        own = Inversion(point.plant)
        return replace(point, plant=own.inner, u=own.rows(point.u[None, :])[0])

    def left(self, point: OperatingPoint) -> OperatingPoint:
        """A point of the plant inside, with commands."""
        moved = self.carrying(point)
        sent = Inversion(moved).sent(point.u[None, :])[0]
        return replace(point, plant=moved, u=sent)

    def carrying(self, point: OperatingPoint) -> Plant:
        """The plant with the parameters and start values that the point's plant has."""
        other = {v.name: v for v in point.plant.variables}
        moved = self.plant.with_values()
        moved._variables = {n: other.get(n, v) for n, v in moved._variables.items()}
        return moved

    def rows(self, commands: Array, p: Array | None = None) -> Array:
        """Openings (n, inner inputs) of commands (n, inputs) in the plants' orders."""
        names = [v.name for v in self.plant.inputs]
        known = self._p if p is None else p
        columns = []
        for variable in self.inner.inputs:
            opening = self._of.get(variable.name)
            if opening is None:
                columns.append(commands[:, names.index(variable.name)])
                continue
            sent = commands[:, [names.index(c) for c in opening.commands]].T
            columns.append(np.asarray(self._function(opening, True)(sent, known)).ravel())
        return np.column_stack(columns) if columns else commands[:, :0]

    def sent(self, openings: Array, p: Array | None = None) -> Array:
        """Commands (n, inputs) of openings (n, inner inputs) in the plants' orders."""
        inner = [v.name for v in self.inner.inputs]
        known = self._p if p is None else p
        columns = {n: openings[:, i] for i, n in enumerate(inner)}
        for name, opening in self._of.items():
            row = openings[:, [inner.index(name)]].T
            found = np.asarray(self._function(opening, False)(row, known))
            columns.update(zip(opening.commands, found, strict=True))
        return np.column_stack([columns[v.name] for v in self.plant.inputs])


def in_dead_zone(plant: Plant, u: Array) -> bool:
    """Whether a command (of u (n, inputs)) stands where its slope is less than beyond its dead
    zone.
    """
    if not plant.openings:
        return False

    def build() -> ca.Function:
        slopes = [
            ca.jacobian(o.forward, ca.vertcat(*(plant.expression(c) for c in o.commands)))
            for o in plant.openings
        ]
        least = [ca.mmin(ca.fabs(ca.densify(s))) for s in slopes]
        return ca.Function("slopes", [plant.u, plant.p], [ca.mmin(ca.vertcat(*least))])

    slope = plant.cached("slopes of the openings", build)(u.T, plant.vector("parameter"))
    return float(ca.mmin(slope)) < 0.99
