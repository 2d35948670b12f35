"""What states with memory hold at rest: with hysteresis rest is a continuum,
and a point is chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, SimulationError
from ..plants.plant import Plant
from ..plants.stillness import settled_names, store_names
from ..simulation.simulator import simulate

Array: TypeAlias = NDArray[np.float64]
Memory: TypeAlias = 'Literal["virgin", "above", "below"] | Mapping[str, float]'

SIDES = {"above": -1.0, "below": 1.0}
"""Way in which the positions moved before they came to rest."""
SPANS = (300.0, 3e3, 3e4)
"""Seconds in which what settles by itself has settled: the longer ones where it still moves."""
PLACES = 41
"""Values of a state, all over its range, at which it is asked whether it would stay."""
APART = 0.05
"""Distance from where it came to, scaled by nominals, that counts as elsewhere."""
RELEASED = 5e-3
"""The same where it went there at once."""
IDLE = 1e-6
"""Rates [nominal/s] at which a plant stays."""
CREEPS = 1e-8
"""The same for what has settled: what still creeps moves others, which would not count as idle."""
QUICK, SLOW = 0.03, 0.02
"""Rates [nominal/s] of what relaxes at once, and of what has: rounded laws creep more slowly."""
FAR = 100.0
"""Distance in nominals to which it is asked."""
NOTHING = 1e-9
"""A slope below this part of the largest one of its row counts as zero."""


def held_names(plant: Plant) -> tuple[str, ...]:
    """The states that keep at rest whatever the past has left in them."""
    return tuple(v.name for v in plant.states if v.memory == "held")


def require_memory(plant: Plant, memory: Memory) -> str | dict[str, float]:
    """The word, or {state: value} by full names.

    Raises InputError for another word, a name that is no held memory, or a value out of its range.
    """
    if isinstance(memory, Mapping):
        found, known = dict[str, float](), held_names(plant)
        for name, value in memory.items():
            variable = plant.variable(name)
            if variable.name not in known:
                raise InputError(
                    f"memory: {name} is no state with a held memory; "
                    f"known: {', '.join(known) or 'none'}"
                )
            found[variable.name] = variable.check(value, "memory")
        return found
    if memory not in ("virgin", *SIDES):
        raise InputError(
            f"memory = {memory!r}: choose 'virgin', 'above', 'below', or give {{state: value}}"
        )
    return memory


def held(plant: Plant, memory: Memory = "virgin") -> dict[str, float]:
    """{state: value} of all held memories of a plant at rest.

    memory : "virgin" (start values: nothing has slid yet), "above" or "below" (the side from which
        all positions came, from afar: every element has slid fully), or {state: value}, the rest
        virgin. The way in which a position drives a memory is read off the plant's Jacobian at its
        start values, whatever coordinates it is written in.

    Raises InputError as :func:`require_memory`.
    """
    said = require_memory(plant, memory)
    variables = {name: plant.variable(name) for name in held_names(plant)}
    found = {name: float(v.start or 0.0) for name, v in variables.items()}
    if isinstance(said, dict):
        return found | said
    if said == "virgin" or not found:
        return found
    for name, drive in zip(found, _drives(plant) * SIDES[said], strict=True):
        if drive:
            found[name] = variables[name].max if drive > 0 else variables[name].min
    return found


def at_rest(
    plant: Plant, x: Array, memory: Mapping[str, float], u: Array | None = None
) -> dict[str, float]:
    """{held memory: value} that stay while all else stands still at x under the inputs u (by
    default their start values); those of ``memory`` where they do.

    The largest contraction of a muscle so far is no less than the one at which it stands; a play
    beyond an envelope that has narrowed there is at the envelope. Slow motion of a rounded law
    counts as none.
    """
    found = dict(memory)
    names, p = [v.name for v in plant.states], plant.vector("parameter")
    u = plant.vector("input") if u is None else u
    for name, value in memory.items():
        i, v = names.index(name), plant.variable(name)
        here = np.array(x, float)

        def rate(level: float) -> float:
            here[i] = level  # noqa: B023 - called before they change
            return float(plant.function(here, u, p)[0][i]) / v.nominal  # noqa: B023

        came = _came_to(rate, value, (v.min, v.max), v.nominal)
        apart = RELEASED if abs(rate(value)) >= QUICK else APART
        if abs(came - value) > apart * v.nominal:
            found[name] = came
    return found


def _came_to(
    rate: Callable[[float], float], value: float, ends: tuple[float, float], nominal: float
) -> float:
    """Where a state comes to from a value: all the way where an end of its range is still; from a
    quick motion to where it has become slow.
    """
    begin = rate(value)
    way, idle = ends[begin > 0], IDLE
    if abs(begin) <= IDLE or not np.isfinite(way):
        return value
    moving, still = value, way
    if abs(rate(way)) > IDLE:
        if abs(begin) < QUICK:
            return value
        idle = SLOW
        levels = np.linspace(value, way, PLACES)
        slow = [k for k, z in enumerate(levels) if rate(z) * np.sign(begin) <= idle]
        if not slow:
            return value
        moving, still = levels[slow[0] - 1], levels[slow[0]]
    while abs(still - moving) > 1e-9 * nominal:
        middle = (moving + still) / 2
        quicker = rate(middle) * np.sign(begin) > idle
        moving, still = (middle, still) if quicker else (moving, middle)
    return float(still)


def driven_names(plant: Plant) -> tuple[str, ...]:
    """The states that inputs or positions move, at once or by way of others: all but those that run
    by themselves.
    """
    count, depends = len(plant.states), _dependence(plant)
    chosen = {count + i for i, v in enumerate(plant.inputs) if not v.disturbance}
    places = {n for p in plant.resting() for n in (p.name, *p.velocities)}
    moved = {i for i, v in enumerate(plant.states) if v.name in places}
    while True:
        more = {i for i in range(count) if i not in moved and depends[i] & (chosen | moved)}
        if not more:
            return tuple(v.name for i, v in enumerate(plant.states) if i in moved)
        moved |= more


def surroundings(plant: Plant) -> dict[str, float]:
    """{state: value} of what settles by itself but could stand elsewhere as well: it is where the
    plant comes to from its start values with its inputs at theirs.

    A receiver above the pressure at which its compressor stops stays there, but nothing brings it
    there; air without heat transfer keeps any temperature.
    """
    key = ("surroundings", *(tuple(plant.vector(c)) for c in ("parameter", "state", "input")))
    found: dict[str, float] = plant.cached(key, lambda: _surroundings(plant))
    return found


def _surroundings(plant: Plant) -> dict[str, float]:
    places = {p.name for p in plant.resting()}
    marked = [n for n in settled_names(plant) if n not in places]
    if not marked:
        return {}
    names = [v.name for v in plant.states]
    u, p = plant.vector("input"), plant.vector("parameter")
    sizes = plant.vector("state", attribute="nominal")
    x = plant.vector("state")
    ends = [plant.vector("state", attribute=which) for which in ("min", "max")]
    own = [names.index(n) for n in marked]
    for span in SPANS:
        try:
            run = simulate(
                plant, start=dict(zip(names, map(float, x), strict=True)), t=[0.0, span], rtol=1e-8
            )
        except SimulationError:
            return {}
        # positions may have left their range meanwhile, and surroundings do not ask for them
        x = np.clip([run[n][-1] for n in names], *ends)
        still = np.asarray(plant.function(x, u, p)[0], float) / sizes[:, None]
        if np.abs(still[own]).max() <= CREEPS:
            break
    found = {}
    for name in marked:
        i, nominal = names.index(name), plant.states[names.index(name)].nominal
        low, high = plant.states[i].min, plant.states[i].max
        elsewhere = np.linspace(
            max(low, x[i] - FAR * nominal), min(high, x[i] + FAR * nominal), PLACES
        )
        elsewhere = elsewhere[np.abs(elsewhere - x[i]) > APART * nominal]
        columns = np.tile(x[:, None], len(elsewhere))
        columns[i] = elsewhere
        rates = np.asarray(plant.function(columns, u, p)[0], float) / sizes[:, None]
        moved = np.abs(rates - still).max(axis=0) + np.abs(rates[i])  # others may still creep
        if np.min(moved, initial=np.inf) <= IDLE:
            found[name] = float(x[i])
    # the air in a store is as warm as it stands there: what drains it would cool it
    stores = {n.rpartition(".")[0] for n in (*found, *store_names(plant))} - {""}
    return found | {n: float(x[names.index(n)]) for n in marked if n.rpartition(".")[0] in stores}


def carried(plant: Plant, x: Array, u: Array, state: str, offset: float) -> dict[str, float]:
    """{held memory: value} when a position has been moved slowly from x by ``offset`` [its unit].

    States without a velocity of their own carry nothing along.
    """
    from scipy.integrate import solve_ivp

    names = [v.name for v in plant.states]
    memories = [names.index(n) for n in held_names(plant)]
    velocity = plant.positions.get(state)
    if not memories or velocity is None:
        return {names[i]: float(x[i]) for i in memories}
    p, speed = plant.vector("parameter"), np.copysign(plant.variable(velocity).nominal, offset)
    here = np.array(x, dtype=float)
    here[names.index(velocity)] = speed

    def slope(s: float, z: Array) -> Array:
        here[names.index(state)] = x[names.index(state)] + s * offset
        here[memories] = z
        rates = np.asarray(plant.function(here, u, p)[0]).ravel()
        return np.asarray(rates[memories] * offset / speed)

    way = solve_ivp(
        slope, (0.0, 1.0), x[memories], method="LSODA", rtol=1e-9, atol=1e-11, max_step=0.02
    )
    return {
        names[i]: float(np.clip(z, plant.states[i].min, plant.states[i].max))
        for i, z in zip(memories, way.y[:, -1], strict=True)
    }


def _drives(plant: Plant) -> Array:
    """Sign of the rate of each held memory while all positions rise; 0 for one that they leave.

    A memory moves with velocities; a position is a state whose rate depends on these (and on
    itself) alone. So x' = v/2 or a momentum in place of the velocity do as well as x' = v.
    """
    names = [v.name for v in plant.states]
    memories = np.array([names.index(n) for n in held_names(plant)])
    x = plant.vector("state")
    for i in memories:
        x[i] = (plant.states[i].min + plant.states[i].max) / 2
    a, b = plant.jacobians(x, plant.vector("input"), plant.vector("parameter"))[:2]
    sizes = np.array([v.nominal for v in (*plant.states, *plant.inputs)])
    slopes = np.hstack([np.asarray(a), np.asarray(b)]) * sizes
    slopes[:, memories] = 0.0
    rates = np.abs(slopes[memories])
    velocities = np.flatnonzero(
        (rates > NOTHING * rates.max(axis=1, initial=0.0)[:, None]).any(axis=0)
    )
    positions = [
        i
        for i, depends in enumerate(_dependence(plant))
        if i not in {*velocities, *memories} and depends - {i} and depends <= {*velocities, i}
    ]
    if positions:
        rising = sizes[positions]
        moving = np.linalg.lstsq(slopes[positions][:, velocities], rising, rcond=None)[0]
    else:  # no position is a state: the velocities themselves say the way
        moving = np.ones(len(velocities))
    drives = slopes[memories][:, velocities] @ moving
    speeds = [names.index(v) for q in plant.resting() for v in q.velocities]
    if speeds:  # what they do not move (the play of a spool, a tank) is left as it was
        drives *= (rates[:, speeds] > NOTHING * rates.max(axis=1, initial=0.0)[:, None]).any(axis=1)
    return np.where(np.abs(drives) > NOTHING * np.abs(drives).max(initial=0.0), drives, 0.0)


def _dependence(plant: Plant) -> list[set[int]]:
    """For each state, the states and inputs (counted on) on which its rate depends."""
    xdot = ca.vertcat(*(plant.expression(f"der({v.name})") for v in plant.states))
    pattern = ca.jacobian(xdot, ca.vertcat(plant.x, plant.u)).sparsity()
    rows, columns = pattern.get_triplet()
    found: list[set[int]] = [set() for _ in plant.states]
    for row, column in zip(rows, columns, strict=True):
        found[row].add(column)
    return found
