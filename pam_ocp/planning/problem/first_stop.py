"""The first stop: what the past left there, in states that nobody sets."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, PlanWarning
from ...core.plausible import outside
from ...judge.costs import COSTS
from ...judge.statement import Statement, Stop, subject
from ...operating.held import at_rest, driven_names, held, held_names, surroundings
from ...plants.plant import Plant
from ...plants.stillness import Position, settled_names, totals
from ..transcription.guess import rest_point
from .limits import range_of
from .problem import Condition, Problem, Range

__all__ = ["left_by_the_past", "settled_before", "with_given_pressures"]


def left_by_the_past(
    plant: Plant, statement: Statement, first: Stop, bounds: Mapping[str, Range]
) -> list[Condition]:
    """What the past left at the first stop, of states that nobody could set: memories, totals, what
    keeps whatever its surroundings left there; without rest, lags that have settled.
    """

    def condition(name: str, words: str, low: float, high: float) -> Condition:
        variable, expression = subject(plant, name)
        return Condition(
            f"stop 1: {name} {words}", expression, low, high, variable.nominal, variable
        )

    sums = [n for n in totals(plant) if n not in first.values]
    starts = {n: float(plant.variable(n).start or 0.0) for n in sums}
    conditions = [condition(n, "at its start", value, value) for n, value in starts.items()]
    if statement.cyclic:  # the cycle itself says what they hold
        if statement.memory != "virgin":
            raise InputError(
                f"memory = {statement.memory!r}: a cyclic motion closes its memories by "
                "itself; leave it out"
            )
        kept = [n for n in held_names(plant) if n not in first.values]
        ranges = {n: (plant.variable(n).min, plant.variable(n).max) for n in kept}
        return conditions + [condition(n, "in its range", *ends) for n, ends in ranges.items()]
    memory = _memory(plant, statement, first)
    left = {n: v for n, v in surroundings(plant).items() if n not in plant.copies}
    memory |= {n: v for n, v in left.items() if n not in first.values}
    conditions += [condition(n, "held", value, value) for n, value in memory.items()]
    if first.rest:
        return conditions
    settled = [n for n in settled_names(plant) if n not in {*first.values, *memory}]
    return conditions + [condition(f"der({n})", "settled", 0.0, 0.0) for n in settled]


def _memory(plant: Plant, statement: Statement, first: Stop) -> dict[str, float]:
    """What held memories hold at the first stop, but for those that it names."""
    memory = {n: v for n, v in held(plant, statement.memory).items() if n not in first.values}
    if isinstance(statement.memory, Mapping):
        return memory
    return at_rest(plant, _named_states(plant, first), memory)


def _named_states(plant: Plant, stop: Stop) -> NDArray[np.float64]:
    """The states' start values, with those that a stop names."""
    ends = {n: range_of(n, v, plant.variable(n)) for n, v in stop.values.items() if "(" not in n}
    known = {n: sum(pair) / 2 for n, pair in ends.items()}
    start = plant.vector("state")
    for i, variable in enumerate(plant.states):
        if np.isfinite(known.get(variable.name, np.nan)):
            start[i] = known[variable.name]
    return start


def settled_before(plant: Plant, first: Stop, positions: tuple[Position, ...]) -> list[Condition]:
    """What stands still besides the positions where a plant has rested before a motion: pressures,
    temperatures, spools, lags, all that inputs or positions move. What the first stop names of
    those that settle by themselves is as it says, and so is what it names the rate of.
    """
    places = {n for p in positions for n in (p.name, *p.velocities)}
    kept = {*places, *totals(plant), *held_names(plant), *surroundings(plant), *plant.copies}
    own = {n for n in settled_names(plant) if n in first.values}
    moved = [n for n in driven_names(plant) if n not in kept and n not in own]
    rates = [f"der({n})" for n in moved if f"der({n})" not in first.values]
    return [
        Condition(f"stop 1: {rate} settled", expression, 0.0, 0.0, variable.nominal, variable)
        for rate in rates
        for variable, expression in [subject(plant, rate)]
    ]


def with_given_pressures(
    problem: Problem, statement: Statement, first: Stop, positions: tuple[Position, ...]
) -> Problem:
    """Pressures at the first stop are no gift where the supply's air counts.

    A motion that may choose them is made by venting what it was given. Where neither the cycle nor
    the first stop says what they are, they are those at rest there, nearest to their start values.
    """
    plant = problem.plant
    weights = statement.weights
    asked = [n for n in weights if weights[n] and n in COSTS and COSTS[n].from_supply]
    if not asked or statement.cyclic:
        return problem
    places = {n for p in positions for n in (p.name, *p.velocities)}
    known = {*places, *settled_names(plant), *totals(plant), *first.values}
    free = [v.name for v in plant.states if v.name not in known and not v.memory]
    spoken = ca.vertcat(*(subject(plant, n)[1] for n in first.values))
    symbols = ca.vertcat(*(plant.expression(n) for n in free))
    if not free or ca.depends_on(spoken, symbols):
        return problem
    x = rest_point(problem, problem.stops[0] | _memory(plant, statement, first))
    if x is None:
        return problem
    values = {v.name: float(x[i]) for i, v in enumerate(plant.states) if v.name in free}
    shown = ", ".join(f"{n} = {plant.variable(n).shown(value)}" for n, value in values.items())
    warnings.warn(
        f"minimise = {asked[0]!r} leaves no pressure to choose at the first stop, or the motion "
        f"would vent what it begins with: it begins at rest with {shown}. Name other values in "
        "the first stop, or give cyclic=True",
        PlanWarning,
        stacklevel=outside(),
    )
    given = [
        Condition(
            f"stop 1: {n} given",
            plant.expression(n),
            value,
            value,
            plant.variable(n).nominal,
            plant.variable(n),
        )
        for n, value in values.items()
    ]
    # with pressures at rest forces balance by themselves: they would be said twice
    fixed = {*free, *places, *first.values}
    open_ = [
        s for v, s in zip(plant.states, ca.vertsplit(plant.x), strict=True) if v.name not in fixed
    ]
    unknown = ca.vertcat(*open_, plant.u, problem.m)

    def follows(c: Condition) -> bool:
        if c.label.endswith("settled"):
            return not ca.depends_on(c.expression, unknown)
        return c.label.endswith("at rest") and bool(ca.depends_on(c.expression, symbols))

    node = (*(c for c in problem.nodes[0] if not follows(c)), *given)
    return replace(problem, nodes=(node, *problem.nodes[1:]))
