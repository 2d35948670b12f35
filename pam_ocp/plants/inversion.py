"""Effective openings: what stands in for commands with a dead zone, and the way back to the
commands.

A command in its dead zone has no slope, so neither a linear model nor a solver sees what it could
do.
The opening does: it is zero where the valve closes and moves the flow at once. A controller chooses
openings, and the commands that give exactly these are sent (dead-zone inversion: G. Tao and
P. V. Kokotovic, IEEE Trans. Automat. Control 39 (1994) 59-68). Behind a spool that moves the dead
zone is taken to the command: inside, the spool follows the opening linearly, and its states are
counted without what they travel within the dead zone. That is exact but for the time in which a
dead zone is crossed.
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

Array: TypeAlias = NDArray[np.float64]


@dataclass
class Inversion:
    """Between a plant's inputs as they are sent and as a controller chooses them.

    plant : with commands. inner : the same with openings (the plant itself where it declares none).
    exact : both move alike; not so where a dead zone stands behind what moves (a spool). There the
        states x of the plant are to be given as well, and :meth:`entering` makes those inside of
        them.

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
        self.carried = {c.name: c for o in self.plant.openings for c in o.carried}
        self.exact = not self.carried

    @cached_property
    def by_states(self) -> bool:
        """Whether openings and commands tell each other only with the states beside them."""
        x = self.plant.x
        return any(ca.depends_on(ca.vertcat(o.forward, *o.inverse), x) for o in self.plant.openings)

    def __reduce__(self) -> tuple[Any, ...]:  # symbols do not travel; the plant makes them anew
        return type(self), (self.plant,)

    @cached_property
    def _p(self) -> Array:
        return self.plant.vector("parameter")

    def __bool__(self) -> bool:
        """Whether anything differs."""
        return bool(self._of)

    @cached_property
    def _x(self) -> Array:
        return self.plant.vector("state")

    def _function(self, opening: Opening, forward: bool) -> ca.Function:
        """(commands, p, x) -> opening, or (opening, p, x) -> commands."""

        def build() -> ca.Function:
            known = [self.plant.p, self.plant.x]
            commands = ca.vertcat(*(self.plant.expression(n) for n in opening.commands))
            if forward:
                return ca.Function("forward", [commands, *known], [opening.forward])
            results = [ca.vertcat(*opening.inverse)]
            return ca.Function("inverse", [opening.symbol, *known], results)

        return self.plant.cached(("opening", opening.name, forward), build)  # type: ignore[no-any-return]

    def forward(self, opening: str) -> ca.Function:
        """(its commands, parameters of the plant, its states) -> the opening that they give."""
        return self._function(self._of[opening], True)

    def inverse(self, opening: str) -> ca.Function:
        """(opening, parameters of the plant, its states) -> the commands that give it."""
        return self._function(self._of[opening], False)

    def entering(self, inwards: bool = True) -> ca.Function:
        """(states of the plant, its parameters) -> states inside; the way back if not inwards."""

        def build() -> ca.Function:
            moved = {n: c.entered if inwards else c.left for n, c in self.carried.items()}
            states = [moved.get(v.name, self.plant.expression(v.name)) for v in self.plant.states]
            return ca.Function("states", [self.plant.x, self.plant.p], [ca.vertcat(*states)])

        return self.plant.cached(("states in openings", inwards), build)  # type: ignore[no-any-return]

    def inside(self, x: Array, p: Array | None = None, inwards: bool = True) -> Array:
        """States (nx,) or (n, nx) inside, of those of the plant; the way back if not inwards."""
        if self.exact:
            return x
        moved = self.entering(inwards)(np.transpose(x), self._p if p is None else p)
        found: Array = np.asarray(moved, dtype=float).T.reshape(np.shape(x))
        return found

    def states(self, measured: Mapping[str, float] | None) -> Array:
        """The plant's states (nx,) of values by name; start values for what is not there."""
        names = (v.name for v in self.plant.states)
        known = measured or {}
        values = (known.get(n, s) for n, s in zip(names, self._x.tolist(), strict=True))
        found: Array = np.array([*values], dtype=float)
        return found

    def entry(self, measured: Mapping[str, float]) -> Mapping[str, float]:
        """Values by name, with the states as they are inside."""
        if self.exact:
            return measured
        x = self.inside(self.states(measured))
        names = (v.name for v in self.plant.states)
        moved = {n: v for n, v in zip(names, x.tolist(), strict=True) if n in self.carried}
        return {**measured, **moved}

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

    def commands(
        self,
        values: Mapping[str, float],
        p: Array | None = None,
        measured: Mapping[str, float] | None = None,
    ) -> dict[str, float]:
        """Openings among values by name replaced by the commands that give them.

        measured : values by name, the states of a plant whose dead zones move among them.
        """
        found: dict[str, float] = {}
        x = self._x if self.exact else self.states(measured)
        for name, value in values.items():
            opening = self._of.get(self.opening_of(name) or "")
            if opening is None:
                found[name] = value
                continue
            sent = np.asarray(
                self._function(opening, False)(value, self._p if p is None else p, x)
            ).ravel()
            found.update(zip(opening.commands, sent.tolist(), strict=True))
        return found

    def openings(
        self,
        values: Mapping[str, float],
        p: Array | None = None,
        measured: Mapping[str, float] | None = None,
    ) -> dict[str, float]:
        """Commands among values by name replaced by the openings that they give."""
        x = self._x if self.exact else self.states(measured)
        found = {n: v for n, v in values.items() if n not in self._for}
        for opening in self._of.values():
            if opening.name in found or not any(c in values for c in opening.commands):
                continue
            sent = [values.get(c, self.plant.variable(c).start or 0.0) for c in opening.commands]
            known = self._p if p is None else p
            found[opening.name] = float(self._function(opening, True)(sent, known, x))
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
        """Whether there are openings, and no condition names a command that they stand in for, or
        a state between the two.
        """
        names = {self.opening_of(n) or self.plant.variable(n).name for n in conditions}
        return bool(self) and not names & {*self._for, *self.carried}

    def entered(self, point: OperatingPoint) -> OperatingPoint:
        """A point of the plant, with openings."""
        if [v.name for v in point.plant.inputs] == [v.name for v in self.inner.inputs]:
            return point
        own = Inversion(point.plant)
        u = own.rows(point.u[None, :], x=point.x[None, :])[0]
        return replace(point, plant=own.inner, x=own.inside(point.x), u=u)

    def left(self, point: OperatingPoint) -> OperatingPoint:
        """A point of the plant inside, with commands."""
        own = Inversion(self.carrying(point))
        x = own.inside(point.x, inwards=False)
        return replace(point, plant=own.plant, x=x, u=own.sent(point.u[None, :], x=x[None, :])[0])

    def carrying(self, point: OperatingPoint) -> Plant:
        """The plant with the parameters and start values that the point's plant has."""
        other = {v.name: v for v in point.plant.variables if v.name not in self.carried}
        moved = self.plant.with_values()
        moved._variables = {n: other.get(n, v) for n, v in moved._variables.items()}
        return moved

    def rows(self, commands: Array, p: Array | None = None, x: Array | None = None) -> Array:
        """Openings (n, inner inputs) of commands (n, inputs) in the plants' orders.

        x : states (n, nx) of the plant, where it is not :attr:`exact`.
        """
        states = self._x if x is None else x.T
        names = [v.name for v in self.plant.inputs]
        known = self._p if p is None else p
        columns = []
        for variable in self.inner.inputs:
            opening = self._of.get(variable.name)
            if opening is None:
                columns.append(commands[:, names.index(variable.name)])
                continue
            sent = commands[:, [names.index(c) for c in opening.commands]].T
            columns.append(np.asarray(self._function(opening, True)(sent, known, states)).ravel())
        return np.column_stack(columns) if columns else commands[:, :0]

    def sent(self, openings: Array, p: Array | None = None, x: Array | None = None) -> Array:
        """Commands (n, inputs) of openings (n, inner inputs) in the plants' orders; x as in
        :meth:`rows`.
        """
        states = self._x if x is None else x.T
        inner = [v.name for v in self.inner.inputs]
        known = self._p if p is None else p
        columns = {n: openings[:, i] for i, n in enumerate(inner)}
        for name, opening in self._of.items():
            row = openings[:, [inner.index(name)]].T
            found = np.asarray(self._function(opening, False)(row, known, states))
            columns.update(zip(opening.commands, found, strict=True))
        return np.column_stack([columns[v.name] for v in self.plant.inputs])


def in_dead_zone(plant: Plant, u: Array, x: Array | None = None) -> bool:
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
        known = [plant.u, plant.p, plant.x]
        return ca.Function("slopes", known, [ca.mmin(ca.vertcat(*least))])

    states = plant.vector("state") if x is None else x.T
    slope = plant.cached("slopes of the openings", build)(u.T, plant.vector("parameter"), states)
    return float(ca.mmin(slope)) < 0.99
