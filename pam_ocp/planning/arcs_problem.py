"""A problem with its arcs as legs: how long each takes is an unknown, its active limits are
equations.

So interval ends lie on switches, wherever these are, and an interval in between sees a smooth
motion. What comes out is a motion of the problem itself, on a mesh whose intervals are the arcs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..judge.statement import TIME
from .arcs_found import Chains, Section, Touch, limits_of
from .problem.problem import Condition, Leg, Problem
from .transcription.mesh import FORM, Interval, Mesh
from .transcription.solution import Solution

Array: TypeAlias = NDArray[np.float64]

SHORTEST, LONGEST = 0.02, 50.0
"""Of the estimate of an arc's duration: its bounds."""
INSIDE = 0.05
"""A leg's duration that lies so far inside its bounds is not asked to keep them."""
RANK = 1e-7
SLIGHT = 1e-5
"""Of the objective: what inputs near their limits cost more than those in the middle."""
SIZE = 10.0
"""Of the objective with that cost: a solver ends at a gradient that must be small beside it."""
SOFT = 0.1
"""By which part of their half range limits lie outside where that cost has its poles."""


@dataclass(frozen=True)
class Divided:
    """A problem whose legs are ``sections`` of those of ``original``."""

    original: Problem
    sections: tuple[Section, ...]
    problem: Problem

    def first(self, leg: int) -> int:
        """The first section of a leg of the original."""
        return sum(s.leg < leg for s in self.sections)

    def mesh(self, degrees: Sequence[int]) -> Mesh:
        """One interval for each arc."""
        return Mesh(tuple(Interval(k, 1.0, d) for k, d in enumerate(degrees)), FORM)

    def onto(self, mesh: Mesh, durations: Array) -> Mesh:
        """The mesh of arcs as one of the original's legs."""
        total = self.durations(durations)
        intervals = []
        for each in mesh.intervals:
            leg = self.sections[each.leg].leg
            fraction = float(each.fraction * durations[each.leg] / total[leg])
            intervals.append(replace(each, leg=leg, fraction=fraction))
        return Mesh(tuple(intervals), FORM)

    def durations(self, durations: Array) -> Array:
        """Of the original's legs."""
        legs = np.array([s.leg for s in self.sections])
        total = np.bincount(legs, weights=durations, minlength=len(self.original.legs))
        return np.asarray(total, float)

    def back(self, solution: Solution) -> Solution:
        """A solution as one of the original."""
        peaks = solution.peaks[: self.original.m.numel()]
        return replace(solution, durations=self.durations(solution.durations), peaks=peaks)

    def there(self, solution: Solution) -> Solution:
        """A solution of the original as a guess."""
        estimates = np.array([s.duration for s in self.sections])
        more = np.ones(self.problem.m.numel() - self.original.m.numel())
        peaks = np.concatenate([solution.peaks, more])
        return replace(solution, durations=estimates, peaks=peaks)


def by_sections(
    problem: Problem, found: Sequence[Section], chains: Chains, states: Sequence[Array]
) -> Divided:
    """The problem with these sections as legs; ``states`` where each section begins."""
    sections = tuple(found)
    timing = _Timing(problem, sections)
    known: dict[tuple[int, frozenset[Touch]], tuple[Condition, ...]] = {}
    legs: list[Leg] = []
    nodes: list[tuple[Condition, ...]] = []
    last = len(problem.legs)
    for k, section in enumerate(sections):
        leg = problem.legs[section.leg]
        divided = sum(s.leg == section.leg for s in sections) > 1
        begins = k == 0 or sections[k - 1].leg != section.leg
        here = problem.nodes[section.leg] if begins else ()
        before = frozenset() if k == 0 or begins else sections[k - 1].active
        own = [*here, *(timing.at(section.leg) if begins else ())]
        total = sum(s.duration for s in sections if s.leg == section.leg)
        own += _entries(problem, leg, section, before, chains, total, (here, states[k]))
        nodes.append(tuple(own))
        key = (section.leg, section.active)
        if key not in known:
            known[key] = _path(problem, leg, section, chains, total)
        bounds = _bounds(problem, leg, section)
        duration = leg.duration
        if divided:
            duration = SHORTEST * section.duration, LONGEST * section.duration
        legs.append(Leg(duration, known[key], bounds, leg.dwell))
    nodes.append((*problem.nodes[last], *timing.at(last)))
    goal = problem.objective
    more = timing.symbols
    if more:
        goal = replace(
            goal, peaks=(*(goal.peaks or (0.0,) * problem.m.numel()), *[0.0] * len(more))
        )
    made = replace(
        problem,
        stops=({},) * len(nodes),
        nodes=tuple(nodes),
        legs=tuple(legs),
        objective=goal,
        m=ca.vertcat(problem.m, *more),
        typical=None,
    )
    return Divided(problem, sections, made)


def centred(problem: Problem, size: float, duration: float) -> Problem:
    """The problem with a slight preference for inputs in the middle of their limits.

    Where the objective does not tell inputs apart (singular arcs; an input that has time to spare)
    it chooses one that is smooth. Of an objective of this size; its own optimum moves by the square
    of so little.
    """
    goal, u = problem.objective, problem.plant.u
    known = ca.hessian(goal.integrand, u)[0].nnz() if u.numel() else 1
    if known or goal.rate:
        return problem
    limits = limits_of(problem, problem.legs[0])
    terms = []
    for c in limits:
        finite = np.isfinite([c.low, c.high]).all() and c.low < c.high
        if finite and ca.depends_on(c.expression, u):
            terms.append((2 * c.expression - c.low - c.high) / (c.high - c.low))
    room = [ca.log(ca.fmax(1 + SOFT - z**2, SOFT / 2)) for z in terms]
    scale = SIZE / max(abs(size), 1e-9)
    middle = SIZE * SLIGHT / duration * ca.sum1(ca.vertcat(ca.SX(0, 1), *room))
    goal = replace(
        goal,
        time=scale * goal.time,
        integrand=scale * goal.integrand - middle,
        final=scale * goal.final,
        peaks=tuple(scale * weight for weight in goal.peaks),
    )
    return replace(problem, objective=goal)


class _Timing:
    """Conditions on the time at nodes that hold the durations of divided legs.

    The time at a node from which a duration counts is a further unknown where it is not known.
    """

    def __init__(self, problem: Problem, sections: Sequence[Section]) -> None:
        self.symbols: list[ca.SX] = []
        self._at: dict[int, list[Condition]] = {}
        shown = problem.plant.variables[0] if not problem.plant.states else problem.plant.states[0]
        known: float | None = 0.0
        for i, leg in enumerate(problem.legs):
            low, high = leg.duration
            own = [s for s in sections if s.leg == i]
            now = sum(s.duration for s in own)
            loose = low * (1 + INSIDE) < now < high * (1 - INSIDE)
            if len(own) > 1 and not loose:
                since = TIME if known is None else TIME - known
                if known is None:
                    begin = ca.SX.sym(f"begin{i}")
                    self.symbols.append(begin)
                    nominal = sum(s.duration for s in sections if s.leg < i)
                    held = TIME - begin * nominal
                    label = f"time at node {i + 1}"
                    self._add(i, Condition(label, held, 0.0, 0.0, now, shown))
                    since = held
                label = f"duration of leg {i + 1}"
                self._add(i + 1, Condition(label, since, low, high, now, shown))
            known = known + low if known is not None and low == high else None

    def _add(self, node: int, condition: Condition) -> None:
        self._at.setdefault(node, []).append(condition)

    def at(self, node: int) -> list[Condition]:
        return self._at.get(node, [])


def _bounds(problem: Problem, leg: Leg, section: Section) -> dict[str, tuple[float, float]]:
    """A leg's bounds: inputs on theirs are given, states along theirs are held by an equation."""
    plant, bounds = problem.plant, dict(leg.bounds)
    names = [v.name for v in (*plant.states, *plant.inputs)]
    for touch in section.active:
        if touch.place >= len(names):
            continue
        name = names[touch.place]
        low, high = bounds[name]
        if touch.place >= len(plant.states):
            bounds[name] = (high, high) if touch.high else (low, low)
        else:
            bounds[name] = (low, np.inf) if touch.high else (-np.inf, high)
    return bounds


def _path(
    problem: Problem, leg: Leg, section: Section, chains: Chains, total: float
) -> tuple[Condition, ...]:
    """A leg's path conditions, the active ones as equations."""
    plant = problem.plant
    ahead = len(plant.states) + len(plant.inputs)
    limits = limits_of(problem, leg)
    path = list(leg.path)
    for touch in sorted(section.active):
        condition = limits[touch.place]
        chain = chains(condition)
        if chain is None or len(plant.states) <= touch.place < ahead:
            continue
        limit = condition.high if touch.high else condition.low
        if chain.order == 0:
            held = replace(condition, low=limit, high=limit)
        else:
            nominal = condition.nominal / total**chain.order
            label = f"along {condition.label}"
            held = Condition(label, chain.values[-1], 0.0, 0.0, nominal, condition.shown)
        if touch.place >= ahead:
            path[touch.place - ahead] = held
        else:
            path.append(held)
    return tuple(path)


def _entries(
    problem: Problem,
    leg: Leg,
    section: Section,
    before: frozenset[Touch],
    chains: Chains,
    total: float,
    node: tuple[Sequence[Condition], Array],
) -> list[Condition]:
    """What holds where an arc along the limit of a state begins: the limit and its derivatives that
    no input changes, as far as the stop there does not say it already.
    """
    limits = limits_of(problem, leg)
    asked: list[Condition] = []
    for touch in sorted(section.active - before):
        condition = limits[touch.place]
        chain = chains(condition)
        for j in range(chain.order if chain else 0):
            assert chain is not None
            limit = 0.0
            if j == 0:
                limit = condition.high if touch.high else condition.low
            nominal = condition.nominal / total**j
            label = f"entry of {condition.label}"
            value = chain.values[j]
            asked.append(Condition(label, value, limit, limit, nominal, condition.shown))
    held, state = node
    return _new(problem, [c for c in held if c.low == c.high], asked, state) if asked else []


def _new(
    problem: Problem, held: Sequence[Condition], asked: Sequence[Condition], state: Array
) -> list[Condition]:
    """Of conditions on a state those that others do not imply."""
    if not held:
        return list(asked)
    plant = problem.plant
    every = ca.vertcat(*(c.expression / c.nominal for c in (*held, *asked)))
    slopes = ca.densify(ca.jacobian(every, plant.x)) @ ca.diag(
        ca.DM(plant.vector("state", attribute="nominal"))
    )
    values = [plant.u, plant.p, TIME, problem.r, problem.q, problem.m]
    at: list[Array] = [
        plant.vector("input"),
        plant.vector("parameter"),
        np.zeros(1),
        np.zeros(problem.r.numel()),
        np.array(problem.aims),
        np.ones(problem.m.numel()),
    ]
    function = ca.Function("slopes", [plant.x, *values], [slopes])
    rows = np.asarray(function(state, *at), float)
    kept: list[Condition] = []
    use = list(rows[: len(held)])
    rank = np.linalg.matrix_rank(np.array(use), tol=RANK)
    for condition, row in zip(asked, rows[len(held) :], strict=True):
        more = np.linalg.matrix_rank(np.array([*use, row]), tol=RANK)
        if more > rank:
            kept.append(condition)
            use.append(row)
            rank = more
    return kept
