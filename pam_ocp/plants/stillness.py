"""What must vanish where a plant stands still, read off the structure of its equations.

Coordinates are a matter of taste: velocities may be states in other units, momenta, combinations
(x' = v + w) or functions (x' = T(q) w, x' = sinh(v)). What tells a position from a lag, a pressure
or a velocity is this: where its rate vanishes, the rate stays zero whatever the position is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from random import Random  # NumPy's take 8 ms to load
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core import units
from ..core.system import System
from ..numerics.newton import iterate, least_squares

__all__ = ["Position", "rate_of", "rest_rows", "resting", "settled_names", "totals"]

Array: TypeAlias = NDArray[np.float64]

POINTS = 3
"""Points of rest at which slopes are looked at: what vanishes at all of them vanishes."""
STEPS = 30
"""Of Newton's method towards such a point."""
NONE = 1e-7
"""Slopes below this part of the largest of their row count as zero."""


@dataclass(frozen=True)
class Position:
    """A state that can stand anywhere. velocities : the states that its rate depends on at rest.

    driven : its rate depends on an input, so it has no acceleration to speak of (x' = u).
    """

    name: str
    velocities: tuple[str, ...]
    driven: bool = False


@dataclass(frozen=True)
class _Rates:
    """The equations of some states: values and slopes in units of nominals."""

    plant: System

    @cached_property
    def scale(self) -> tuple[Array, Array]:
        """(nominals of states, those of the inputs that a controller chooses)."""
        plant = self.plant
        chosen = np.array([not v.disturbance for v in plant.inputs], bool)
        u = plant.vector("input", attribute="nominal")
        return plant.vector("state", attribute="nominal"), np.where(chosen, u, 0.0)

    @cached_property
    def _evaluated(self) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
        """(x, u) -> (rates, slopes by states, slopes by inputs), by a call that converts nothing:
        Newton's method takes some fifty.
        """
        plant, p = self.plant, self.plant.vector("parameter")
        nx, nu = len(plant.states), len(plant.inputs)

        def build() -> ca.Function:
            arguments = [plant.x, plant.u, plant.p]
            slopes = plant.jacobians(*arguments)[:2]
            rates = plant.function(*arguments)[0]
            dense = [ca.densify(each) for each in (rates, *slopes)]
            return ca.Function("rates_and_slopes", arguments, dense)

        function = plant.cached("rates and slopes", build)
        holder, call = function.buffer()
        given = np.zeros(nx), np.zeros(nu), np.array(p, float)
        found = np.zeros(nx), np.zeros((nx, nx), order="F"), np.zeros((nx, nu), order="F")
        for i, array in enumerate(given):
            holder.set_arg(i, memoryview(array))  # type: ignore[arg-type]
        for i, array in enumerate(found):
            holder.set_res(i, memoryview(array.ravel(order="K")))  # type: ignore[arg-type]

        def evaluated(
            x: Array, u: Array, _alive: tuple[Any, ...] = (function, holder)
        ) -> tuple[Array, Array, Array]:
            given[0][:], given[1][:] = x, u
            call()
            return found

        return evaluated

    def at(self, x: Array, u: Array) -> tuple[Array, Array]:
        """(rates (nx,), slopes (nx, nx + nu)) in nominals per second."""
        rates, a, b = self._evaluated(x, u)
        nominal, inputs = self.scale
        slopes = np.hstack([a * nominal, b * inputs])
        return rates / nominal, slopes / nominal[:, None]

    def still(self, chosen: list[int], seed: int) -> tuple[Array, Array, Array]:
        """(slopes, typical slopes, rates left) at a point where the chosen rates vanish
        (Gauss-Newton).
        """
        plant, (nominal, inputs) = self.plant, self.scale
        draw = Random(seed)
        states, controls = plant.states, plant.inputs
        x = np.array([_somewhere(v, draw) for v in states])
        u = np.array([v.start if v.disturbance else _somewhere(v, draw) for v in controls], float)
        typical = np.zeros(len(x))

        def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            nonlocal typical
            rates, slopes = self.at(*place(w))
            if np.isfinite(slopes).all():
                typical = np.maximum(typical, np.abs(slopes).max(axis=1, initial=0.0))
            return rates[chosen], least_squares(slopes[chosen], rcond=1e-10)

        def place(w: Array) -> tuple[Array, Array]:
            return x + w[: len(x)] * nominal, u + w[len(x) :] * inputs

        start = np.zeros(len(x) + len(u))
        root = iterate(equations, start, tolerance=1e-12, steps=STEPS, halvings=0)
        rates, slopes = self.at(*place(root.w))
        return slopes, typical, rates


def _somewhere(variable: object, draw: Random) -> float:
    """Near the start value, inside the range."""
    v = variable
    wide = v.start + v.nominal * draw.uniform(-0.3, 0.3)  # type: ignore[attr-defined]
    return float(min(max(wide, v.min), v.max))  # type: ignore[attr-defined]


def _measures(plant: System, name: str) -> int:
    """0 for a length or an angle, 1 for a pure number, 2 for anything else."""
    exponents = units.unit(plant.variable(name).unit).base_exponents
    return 0 if exponents in ({"m": 1}, {"rad": 1}) else 2 if exponents else 1


def resting(plant: System, named: Collection[str] = ()) -> tuple[Position, ...]:
    """The positions of a plant, whose rates and accelerations vanish where it rests.

    Pressures, lags and states with memory are none. Where the equations leave open which of two
    states is the position (x' = v, v' = -x), or where one integrates the other, ``named`` ones come
    first: those that a motion's stops speak of. Units decide next: lengths and angles are
    positions; states in other units are only where there is nothing else.
    """
    key = ("resting", tuple(sorted(named)), tuple(plant.vector("parameter")))
    found: tuple[Position, ...] = plant.cached(key, lambda: _resting(plant, named))
    return found


def _resting(plant: System, named: Collection[str]) -> tuple[Position, ...]:
    names = [v.name for v in plant.states]
    key = ("neutral", tuple(plant.vector("parameter")))
    neutral, slopes = plant.cached(key, lambda: _neutral(plant))
    nx = len(names)
    driven = set(neutral) & _dependent(plant)[1]
    undriven = [i for i in neutral if i not in driven]
    uses = {i: [j for j in range(nx) if j != i and slopes[i, j]] for i in neutral}
    for worst in (1, 2):  # lengths, angles and numbers; then anything
        pool = [i for i in undriven if uses[i] and _measures(plant, names[i]) <= worst]
        pool.sort(
            key=lambda i: (names[i] not in named, _measures(plant, names[i]), len(uses[i]), i)
        )
        chosen = _heads(pool, uses)
        wide = 1 if not chosen and worst == 1 else 0 if worst == 1 else 2
        moved = {j for i in chosen for j in uses[i]}
        chosen += [
            i for i in sorted(driven) if i not in moved and _measures(plant, names[i]) <= wide
        ]
        if chosen:
            return tuple(
                Position(names[i], tuple(names[j] for j in uses[i]), i in driven)
                for i in sorted(chosen)
            )
    return ()


def _heads(pool: list[int], uses: dict[int, list[int]]) -> list[int]:
    """Of chains x' = v, v' = a the first links: no velocity of another, no integral of one."""
    chosen: list[int] = []
    velocities: set[int] = set()
    for i in pool:
        if i not in velocities and not set(uses[i]) & set(chosen):
            chosen.append(i)
            velocities |= set(uses[i])
    return chosen


def _dependent(plant: System) -> tuple[frozenset[int], frozenset[int]]:
    """(states whose rates depend on anything; those whose rates depend on what controls set), by
    their expressions.
    """

    def build() -> tuple[frozenset[int], frozenset[int]]:
        rates = [plant.expression(f"der({v.name})") for v in plant.states]
        controls = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
        everything, set_by = ca.vertcat(plant.x, plant.u), plant.u[controls]
        moving = frozenset(i for i, rate in enumerate(rates) if ca.depends_on(rate, everything))
        if not controls:
            return moving, frozenset()
        return moving, frozenset(i for i, rate in enumerate(rates) if ca.depends_on(rate, set_by))

    found: tuple[frozenset[int], frozenset[int]] = plant.cached(("dependent rates",), build)
    return found


def _neutral(plant: System) -> tuple[list[int], NDArray[np.bool_]]:
    """States whose rates, where they vanish, do not depend on themselves; and what they depend on
    there.
    """
    rates = _Rates(plant)
    moving, _ = _dependent(plant)
    chosen = [i for i, v in enumerate(plant.states) if not v.memory and i in moving]
    nx, nu = len(plant.states), len(plant.inputs)
    while True:
        lost, pattern = set(), np.zeros((nx, nx + nu), bool)
        for seed in range(POINTS):
            slopes, typical, left = rates.still(chosen, seed)
            size = np.maximum(typical, 1e-300)[:, None]
            seen = ~(np.abs(slopes) <= NONE * size)
            pattern |= seen
            lost |= {i for i in chosen if seen[i, i]}
            if not lost:
                missed = {i: abs(left[i]) for i in chosen if not abs(left[i]) <= 1e-6 * size[i, 0]}
                if missed:
                    lost.add(max(missed, key=lambda i: missed[i]))
        if not lost:
            return chosen, pattern
        chosen = [i for i in chosen if i not in lost]


def rate_of(plant: System, name: str) -> ca.SX:
    """The rate of a state, or of an output while the inputs stand."""
    if plant.variable(name).causality == "state":
        return plant.expression(f"der({name})")
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    return ca.SX(ca.jtimes(plant.expression(name), plant.x, xdot))


def rest_rows(plant: System, positions: tuple[Position, ...]) -> list[tuple[Position, int, ca.SX]]:
    """[(position, order, expression)]: rates (order 1) and accelerations (2), without repetitions.

    What follows from the rows before it (a wheel that counts the same motion) is left out.
    """
    if not positions:
        return []
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    rows: list[tuple[Position, int, ca.SX]] = []
    for position in positions:
        rate = rate_of(plant, position.name)
        rows.append((position, 1, rate))
        if not position.driven:
            rows.append((position, 2, ca.jtimes(rate, plant.x, xdot)))
    rows.sort(key=lambda row: row[1])
    z = ca.vertcat(plant.x, plant.u)
    values = ca.vertcat(*(row[2] for row in rows))
    slopes = ca.Function("rest", [z, plant.p], [values, ca.jacobian(values, z)])
    nominal = np.concatenate(
        [plant.vector("state", attribute="nominal"), plant.vector("input", attribute="nominal")]
    )
    kept = _independent(plant, slopes, nominal)
    order = {p.name: i for i, p in enumerate(positions)}
    chosen = [row for i, row in enumerate(rows) if i in kept]
    return sorted(chosen, key=lambda row: (order[row[0].name], row[1]))


def _independent(plant: System, slopes: ca.Function, nominal: Array) -> set[int]:
    """Rows that say something new at a point where all vanish."""
    draw, p = Random(0), plant.vector("parameter")
    z = np.array([_somewhere(v, draw) for v in (*plant.states, *plant.inputs)])
    jacobian = np.zeros((0, len(z)))
    typical = np.zeros(1)

    def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
        nonlocal jacobian, typical
        value, slope = (np.asarray(e, float) for e in slopes(z + w * nominal, p))
        jacobian = slope * nominal
        typical = np.maximum(typical, np.abs(jacobian).max(axis=1))
        return value.ravel(), least_squares(jacobian, rcond=1e-10)

    iterate(equations, np.zeros(len(z)), settled=1e-14, steps=STEPS, halvings=0)
    if not np.isfinite(jacobian).all():
        return set(range(len(jacobian)))
    kept: set[int] = set()
    basis = np.zeros((0, len(z)))
    for i, row in enumerate(jacobian / np.maximum(typical, 1e-300)[:, None]):
        rest = row - basis.T @ (basis @ row)
        if np.linalg.norm(rest) > 1e-6 * max(1.0, float(np.linalg.norm(row))):
            kept.add(i)
            basis = np.vstack([basis, rest / np.linalg.norm(rest)])
    return kept


def _structure(plant: System) -> tuple[list[str], NDArray[np.bool_], NDArray[np.bool_]]:
    """(states, what each rate depends on: states, inputs that are chosen)."""
    found = plant.cached("what rates depend on", lambda: _dependencies(plant))
    names, a, b = found
    return list(names), a.copy(), b.copy()


def _dependencies(plant: System) -> tuple[list[str], NDArray[np.bool_], NDArray[np.bool_]]:
    names = [v.name for v in plant.states]
    xdot = plant.function(plant.x, plant.u, plant.p)[0]
    a = np.array(ca.DM(ca.jacobian(xdot, plant.x).sparsity(), 1)).astype(bool)
    chosen = [i for i, v in enumerate(plant.inputs) if not v.disturbance]
    b = np.array(ca.DM(ca.jacobian(xdot, plant.u).sparsity(), 1)).astype(bool)
    return names, a, b.reshape(len(names), len(plant.inputs))[:, chosen]


def totals(plant: System) -> tuple[str, ...]:
    """States that only sum up (air drawn, work done): no equation, not even their own,
    needs them.
    """
    names, a, _ = _structure(plant)
    positions = {p.name for p in resting(plant)}
    return tuple(
        n
        for i, n in enumerate(names)
        if not a[:, i].any() and n not in positions and not plant.variable(n).memory
    )


def settled_names(plant: System) -> tuple[str, ...]:
    """States that a long rest brings to their place: marked as settling, and lags of positions.

    A lag of positions (a sensor's filter) follows positions, velocities and its like only: no
    pressure, no input.
    """
    names, a, b = _structure(plant)
    positions = resting(plant)
    moving = {n for p in positions for n in (p.name, *p.velocities)}
    allowed = [i for i, n in enumerate(names) if n in moving]
    memory = {v.name for v in plant.states if v.memory}
    lags = {
        i
        for i, n in enumerate(names)
        if n not in moving and n not in memory and not b[i].any() and a[i, i]
    }
    while True:
        kept = {i for i in lags if set(np.flatnonzero(a[i])) <= {*allowed, *lags}}
        if kept == lags:
            break
        lags = kept
    marked = {v.name for v in plant.states if v.memory == "settling"}
    return tuple(n for i, n in enumerate(names) if n in marked or i in lags)
