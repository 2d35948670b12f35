"""Which limits a solution touches, point by point, and the arcs of its motion that follow.

An arc is a part of a leg along which the same limits are active: a command at its most, a rate at
its bound, a state that runs along its stop; or none ("interior", or singular). Activity is read off
the multipliers, which tell a limit that is pressed from one that is only near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..judge.statement import TIME
from .problem.problem import Condition, Leg, Problem
from .transcription.solution import Places
from .transcription.stage import nominals

if TYPE_CHECKING:
    from .result import Solved

Array: TypeAlias = NDArray[np.float64]

NEAR = 1e-4
"""A limit is active within this part of nominal of it, if its multiplier outweighs the distance."""
ON = 1e-7
"""A state lies on its limit within this part of nominal, whatever the multiplier: along an arc of
second order it is zero but at the ends.
"""
HIGHEST_ORDER = 4
"""Derivatives of a limit until an input appears; beyond, it is left as an inequality."""
PRESSED = 1e-9
"""Least multiplier of a limit that is pressed."""
INDEPENDENT = 1e-6
"""Least part of an input's influence on a limit that is left when others have taken theirs."""


class Touch(NamedTuple):
    """One side of one of a leg's :func:`limits_of`."""

    place: int
    high: bool


def limits_of(problem: Problem, leg: Leg) -> list[Condition]:
    """All that a leg limits, in a fixed order: states, inputs, path conditions."""
    plant = problem.plant
    found = []
    for v in (*plant.states, *plant.inputs):
        low, high = leg.bounds[v.name]
        found.append(Condition(v.name, plant.expression(v.name), low, high, v.nominal, v))
    return [*found, *leg.path]


@dataclass(frozen=True, eq=False)
class Chain:
    """A limit and its derivatives along the motion until inputs appear (its index reduced).

    The last of ``values`` depends on inputs; the limit holds along an arc where that is zero and
    the others are at its entry (Bryson, Denham, Dreyfus, AIAA J. 1, 1963).
    """

    values: tuple[ca.SX, ...]
    """The expression itself, then its time derivatives."""

    @property
    def order(self) -> int:
        return len(self.values) - 1

    def influence(self, inputs: ca.SX) -> NDArray[np.bool_]:
        """(nu,) which inputs change it."""
        return np.array([ca.depends_on(self.values[-1], u) for u in ca.vertsplit(inputs)])


class Chains:
    """Chains of a problem's limits, and the influence of inputs on them; each made once."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._known: dict[int, tuple[ca.SX, Chain | None]] = {}

    @cached_property
    def _rates(self) -> ca.SX:
        plant = self.problem.plant
        rates: ca.SX = plant.function(plant.x, plant.u, plant.p)[0]
        return rates

    def __call__(self, condition: Condition) -> Chain | None:
        """None where no input appears, or the limit follows a table over time."""
        key = id(condition.expression)
        if key not in self._known:
            self._known[key] = (condition.expression, self._made(condition.expression))
        return self._known[key][1]

    def _made(self, expression: ca.SX) -> Chain | None:
        problem, plant = self.problem, self.problem.plant
        if problem.r.numel() and ca.depends_on(expression, problem.r):
            return None
        values = [expression]
        for _ in range(HIGHEST_ORDER + 1):
            if plant.u.numel() and ca.depends_on(values[-1], plant.u):
                return Chain(tuple(values))
            along = ca.jtimes(values[-1], plant.x, self._rates)
            values.append(ca.simplify(along + ca.jacobian(values[-1], TIME)))
        return None

    def independent(
        self, conditions: Sequence[Condition], at: tuple[Array, ...], pressed: Sequence[float]
    ) -> list[int]:
        """Of these limits those that can be held at once by the inputs, most pressed first.

        at : arguments of a Problem's function somewhere on the arc.
        """
        plant = self.problem.plant
        u_nominal = nominals(self.problem)[1]
        kept: list[int] = []
        basis: list[Array] = []
        for i in np.argsort(-np.asarray(pressed)):
            chain = self(conditions[i])
            if chain is None:
                continue
            slope = ca.vec(ca.jacobian(chain.values[-1], plant.u))
            row = np.asarray(self.problem.function("slope", [slope])(*at), float).ravel()
            row = row * u_nominal
            size = float(np.linalg.norm(row))
            if not (np.isfinite(size) and size > 0):
                continue
            rest = row / size
            for each in basis:
                rest = rest - (rest @ each) * each
            if np.linalg.norm(rest) > INDEPENDENT:
                basis.append(rest / np.linalg.norm(rest))
                kept.append(int(i))
        return sorted(kept)


@dataclass(frozen=True)
class Section:
    """An arc to be: a part of a leg with its active limits. ``duration`` [s], an estimate."""

    leg: int
    duration: float
    active: frozenset[Touch]
    points: int = 0
    """Of the solution that it was read off."""


@dataclass(frozen=True)
class _Point:
    leg: int
    t: float
    active: dict[Touch, float]
    """What is touched, and by how much it presses."""
    column: int
    """Among all points of the solution."""


def _points(found: Solved) -> list[_Point]:
    """The points of a solution by Radau's points with polynomial inputs, not guarded."""
    program, outcome = found.program, found.outcome
    problem, mesh = program.problem, program.mesh
    places, path = Places.of(problem, mesh), _path_rows(found)
    nx, nu = places.nx, places.nu
    points: list[_Point] = []
    begin, column = 0.0, 1
    low, high = program.bounds()
    for k, interval in enumerate(mesh.intervals):
        h = float(found.solution.durations[interval.leg] * interval.fraction)
        taus = mesh.form.state_taus(interval.degree)
        at, inputs = places.states(k).start, places.inputs(k).start
        leg = problem.legs[interval.leg]
        for j, tau in enumerate(taus):
            own = np.r_[at + nx * j : at + nx * (j + 1), inputs + nu * j : inputs + nu * (j + 1)]
            values, pushes = outcome.w[own], outcome.lam_x[own]
            lows, highs = low[own], high[own]
            if leg.path:
                more = path[k][:, j]
                values, pushes = np.append(values, more[0]), np.append(pushes, more[1])
                lows, highs = np.append(lows, more[2]), np.append(highs, more[3])
            points.append(
                _Point(
                    interval.leg,
                    begin + h * float(tau),
                    _touched(values, pushes, lows, highs),
                    column,
                )
            )
            column += 1
        begin += h
    return points


def _touched(values: Array, pushes: Array, lows: Array, highs: Array) -> dict[Touch, float]:
    """{touch: how much it presses}; what is given (both sides the same) is no touch."""
    found = {}
    for i in np.flatnonzero(lows < highs):
        for is_high, distance, push in (
            (False, values[i] - lows[i], -pushes[i]),
            (True, highs[i] - values[i], pushes[i]),
        ):
            pressed = distance < NEAR and push > max(distance, 0.0) and push > PRESSED
            if pressed or distance < ON:
                found[Touch(int(i), is_high)] = float(push) if pressed else 0.0
    return found


def _path_rows(found: Solved) -> dict[int, Array]:
    """{interval: (4, points, conditions) values, multipliers, low, high} of path conditions."""
    program = found.program
    nlp = program.nlp
    if not any(row.kind == "path" for row in program.rows):
        return {}
    values = ca.Function("g", [nlp["x"], nlp["p"]], [nlp["g"]])
    g = np.asarray(values(found.outcome.w, program.parameters()), float).ravel()
    low, high = program.limits()
    every = np.array([g, found.outcome.lam_g, low, high])
    result = {}
    for row, own in program.placed():
        if row.kind == "path":
            block = every[:, own].reshape(4, len(row.members), -1)
            for i, k in enumerate(row.members):
                interval = program.mesh.intervals[k]
                size = len(program.problem.legs[interval.leg].path)
                points = len(program.mesh.form.state_taus(interval.degree))
                result[k] = block[:, i, : size * points].reshape(4, points, size)
    return result


def sections(found: Solved, chains: Chains) -> list[Section]:
    """The arcs of a solution (Radau's points, polynomial inputs, not guarded)."""
    problem, solution = found.program.problem, found.solution
    durations = np.asarray(solution.durations, float)
    ends = np.concatenate([[0.0], np.cumsum(durations)])
    every = _points(found)
    result: list[Section] = []
    for leg in range(len(problem.legs)):
        points = [p for p in every if p.leg == leg]
        if problem.legs[leg].dwell or not points:
            result.append(Section(leg, durations[leg], frozenset(), len(points)))
            continue
        limits = limits_of(problem, problem.legs[leg])
        runs = _cleaned(_runs(points, limits, chains))
        begin = float(ends[leg])
        for i, run in enumerate(runs):
            last = i == len(runs) - 1
            end = ends[leg + 1] if last else (run[-1].t + runs[i + 1][0].t) / 2
            active = _held(problem, found, run, limits, chains)
            duration = float(end) - begin
            result.append(Section(leg, duration, active, len(run)))
            begin = float(end)
    return merged(result)


def merged(found: Sequence[Section]) -> list[Section]:
    """Neighbours on a leg with the same active limits made one."""
    result: list[Section] = []
    for each in found:
        last = result[-1] if result else None
        if last is not None and (last.leg, last.active) == (each.leg, each.active):
            both = last.duration + each.duration
            result[-1] = replace(last, duration=both, points=last.points + each.points)
        else:
            result.append(each)
    return result


def _runs(points: list[_Point], limits: list[Condition], chains: Chains) -> list[list[_Point]]:
    """Neighbours that touch the same; what no input can hold is left out."""
    runs: list[list[_Point]] = []
    for point in points:
        kept = {
            t: push
            for t, push in point.active.items()
            if (chain := chains(limits[t.place])) is not None and (push > 0 or chain.order)
        }
        point = replace(point, active=kept)
        if runs and runs[-1][-1].active.keys() == point.active.keys():
            runs[-1].append(point)
        else:
            runs.append([point])
    return runs


def _cleaned(runs: list[list[_Point]]) -> list[list[_Point]]:
    """Without single points that touch less than what is beside them, or lie between two that touch
    the same: a polynomial that jumps swings there.
    """
    found: list[list[_Point]] = []
    for i, run in enumerate(runs):
        here = set(run[0].active)
        beside = [set(runs[j][0].active) for j in (i - 1, i + 1) if 0 <= j < len(runs)]
        swinging = any(here < other for other in beside)
        swinging = swinging or (len(beside) == 2 and beside[0] == beside[1])
        if len(run) == 1 and swinging:
            continue
        if found and found[-1][0].active.keys() == run[0].active.keys():
            found[-1] = [*found[-1], *run]
        else:
            found.append(run)
    return found


def _held(
    problem: Problem, found: Solved, run: list[_Point], limits: list[Condition], chains: Chains
) -> frozenset[Touch]:
    """What a run touches and its inputs can hold at once; a state's limit that is touched at one
    point is no arc.
    """
    touches = sorted(run[0].active)
    if len(run) == 1:
        touches = [t for t in touches if (c := chains(limits[t.place])) and c.order == 0]
    if not touches:
        return frozenset()
    pressed = [sum(p.active.get(t, 0.0) for p in run) for t in touches]
    middle, solution = run[len(run) // 2], found.solution
    time, states = np.array([middle.t]), solution.states[middle.column]
    at = problem.arguments(problem.plant, time, states, solution.inputs(time)[0], solution.peaks)
    kept = chains.independent([limits[t.place] for t in touches], at, pressed)
    return frozenset(touches[i] for i in kept)
