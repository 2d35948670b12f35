"""Is a planned motion right? Judged from the words of its task, by SciPy and nothing of a planner.

Of the plan are taken its first state, its input signals, its durations, its objective, and what it
says. The plant gives its equations as CasADi expressions. All else (what is at rest, what limits
hold, what the objective is) is read off the task and computed here: LSODA from the first state,
begun anew at every break of the inputs; rates and accelerations at the stops by finite differences
of that run and by differentiating the equations; the start by integrating it with its inputs held.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

Array = NDArray[np.float64]

TOLERANCE = 1.1e-3
"""In units of nominal: the default of plan, and a tenth for the errors of both integrations."""
COST = 1e-3
"""Of the objective, relative; objectives below ``LEAST`` are judged as if they were so large."""
LEAST = 1e-2
HELD = 4.0
"""So long the inputs before the first stop are held [s]."""
DRIFT = 5e-3
"""By which a state may move meanwhile, in units of nominal."""
WARMER = 0.3
"""By how much a temperature may differ from that of the surroundings at the start [K]."""
SAMPLES = 600
"""Along the whole motion, at least."""
RTOL = 1e-9, 1e-12
"""Of the integration; what is found wrong by the first is looked at by the second, which shows the
errors of neither: along an unstable motion they grow a hundred thousand times.
"""
DIFFERENCES = 2e-5 / 4.0 ** np.arange(6)
"""Steps of finite differences [s]: beside a stiff part a long one is not yet the derivative."""
PEAKS = 20
"""So many times more samples where a largest value counts: it may lie in a narrow spike."""
EDGE = 0.02
"""What a memory that has slid fully gives up at rest, as a part of it (docs/losses.md)."""
SETTLED = 1e5
"""Seconds in which a memory comes to where it stays."""


@dataclass(frozen=True)
class Answer:
    """What a planner answers: all that is taken from it."""

    t: Array
    states: Array
    breaks: Array
    coefficients: Array
    """(pieces, degree + 1, inputs): powers of the time since the piece began."""
    durations: tuple[float, ...]
    objective: float
    verdict: str = ""
    """Its words: what drifts from the start is right where it is named here."""

    @classmethod
    def of(cls, plan: Any) -> Answer:
        """Of a plan of pam_ocp."""
        motion, plant = plan.trajectory, plan.plant
        names = list(motion.named("input"))
        order = [names.index(v.name) for v in plant.inputs]
        return cls(
            np.asarray(motion.t, float),
            np.asarray(motion.array([v.name for v in plant.states]), float),
            np.asarray(motion.signals.breaks, float),
            np.asarray(motion.signals.coefficients, float)[:, :, order],
            tuple(float(d) for d in plan.durations),
            float(plan.objective),
            str(plan.verdict),
        )

    def names(self, variable: str) -> bool:
        """Whether the verdict speaks of a variable."""
        return bool(re.search(rf"(?<![\w.]){re.escape(variable)}(?![\w.])", self.verdict))

    def inputs(self, piece: int, t: Any) -> Array:
        """(inputs, times) in a piece, its end included."""
        since = np.atleast_1d(t) - self.breaks[piece]
        powers = since[None, :] ** np.arange(self.coefficients.shape[1])[:, None]
        return self.coefficients[piece].T @ powers


@dataclass(frozen=True)
class Finding:
    """Something wrong: what, and by how much of what is allowed."""

    kind: str
    what: str
    size: float

    def __str__(self) -> str:
        return f"{self.kind}: {self.what} ({self.size:.3g})"


@dataclass(eq=False)
class Model:
    """The equations of a plant, as functions of columns of states and inputs."""

    plant: Any
    rtol: float = RTOL[0]
    made: dict[str, ca.Function] = field(default_factory=dict)

    @cached_property
    def scales(self) -> tuple[Array, Array, Array]:
        """Nominals of states and of inputs; parameters."""
        plant = self.plant
        sizes = [np.array([v.nominal for v in group]) for group in (plant.states, plant.inputs)]
        return sizes[0], sizes[1], np.array([v.start for v in plant.parameters], float)

    @cached_property
    def rates(self) -> ca.SX:
        return ca.vertcat(*(self.plant.expression(f"der({v.name})") for v in self.plant.states))

    def function(self, key: str, expressions: Callable[[], Sequence[Any]]) -> ca.Function:
        """(x, u) -> column; built once."""
        if key not in self.made:
            plant = self.plant
            column = ca.densify(ca.vertcat(*expressions()))
            p = ca.DM(self.scales[2])
            column = ca.substitute(column, plant.p, p) if len(self.scales[2]) else column
            self.made[key] = ca.Function(
                "columns", [plant.x, plant.u], [column], {"allow_free": False}
            )
        return self.made[key]

    def values(self, key: str, expressions: Callable[[], Sequence[Any]], x: Any, u: Any) -> Array:
        """(rows, columns) along columns of states and inputs."""
        function = self.function(key, expressions)
        return np.atleast_2d(np.asarray(function(np.asarray(x), np.asarray(u)), float))

    def quick(self, key: str, expressions: Callable[[], Sequence[Any]]) -> Callable[..., Array]:
        """The same for one point, by a call that converts nothing (an integrator takes many)."""
        function = self.function(key, expressions)
        holder, call = function.buffer()
        x, u = (np.zeros(function.size1_in(i)) for i in (0, 1))
        found = np.zeros(function.size1_out(0))
        for i, array in enumerate((x, u)):
            holder.set_arg(i, memoryview(array))
        holder.set_res(0, memoryview(found))

        def called(state: Array, inputs: Array, _alive: Any = (function, holder)) -> Array:
            x[:], u[:] = state, inputs
            call()
            return found.copy()

        return called

    def derivative(self, expression: ca.SX) -> ca.SX:
        """Along the motion, while the inputs stand."""
        return ca.SX(ca.jtimes(expression, self.plant.x, self.rates))

    def set_at_once(self, expression: ca.SX) -> bool:
        """Whether an input that may be chosen changes it without delay."""
        free = [i for i, v in enumerate(self.plant.inputs) if not v.disturbance]
        return bool(free) and bool(ca.depends_on(expression, self.plant.u[free]))

    def solved(
        self,
        piece: Callable[[float], Array],
        x: Array,
        span: tuple[float, float],
        at: Array,
        costs: Sequence[ca.SX],
        free: Array | None = None,
    ) -> Array:
        """(states and integrals, times) by LSODA, or by Radau where that fails.

        free : 1 for each state that moves, 0 for what is kept; None: all move.
        """
        nominal, nx = self.scales[0], len(self.scales[0])
        slope = self.quick(f"slope{len(costs)}", lambda: [self.rates, *costs])
        size = np.concatenate([nominal, np.ones(len(costs))])
        moves = 1.0 / size if free is None else np.concatenate([free, np.ones(len(costs))]) / size

        def rate(t: float, z: Array) -> Array:
            return slope(z[:nx] * nominal, piece(t)) * moves

        for method in ("LSODA", "Radau"):
            found = solve_ivp(rate, span, x / size, method, at, rtol=self.rtol, atol=self.rtol / 10)
            if found.success and np.isfinite(found.y).all():
                return np.asarray(found.y * size[:, None])
        raise ArithmeticError(f"no integrator gets from {span[0]:g} to {span[1]:g} s")


@dataclass(frozen=True)
class Motion:
    """The run: samples, piece by piece, and the integrals at its end."""

    t: list[Array]
    x: list[Array]
    u: list[Array]
    integrals: Array

    def all(self) -> tuple[Array, Array]:
        return np.hstack(self.x), np.hstack(self.u)


@dataclass(eq=False)
class Check:
    """One answer to one task."""

    task: Any
    answer: Answer
    findings: list[Finding] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.model = Model(self.task.plant)
        self.plant = self.task.plant
        self.asked = self.task.arguments
        self.stops = [
            (
                dict(getattr(s, "values", s)) if not isinstance(s, Mapping) else dict(s),
                getattr(s, "rest", None) is not False,
                getattr(s, "dwell", 0.0),
                getattr(s, "within", 1e-3),
            )
            for s in self.task.stops
        ]

    def found(self) -> list[Finding]:
        """All that is wrong, the worst first."""
        for self.model.rtol in RTOL:
            self.findings = self.looked()
            if not self.findings:
                break
        return self.findings

    def looked(self) -> list[Finding]:
        self.findings = []
        try:
            self.motion = self.run()
        except ArithmeticError as error:
            return [Finding("replay", str(error), np.inf)]
        parts = (self.replay, self.times, self.at_stops, self.start, self.limits)
        for part in (*parts, self.closing, self.costs):
            part()
        return sorted(self.findings, key=lambda finding: -finding.size)

    def expect(self, kind: str, what: str, miss: float, allowed: float) -> None:
        if not miss <= allowed:
            self.findings.append(Finding(kind, what, float(miss / allowed)))

    # ---- the run -------------------------------------------------------------------------------
    def run(self) -> Motion:
        answer, model = self.answer, self.model
        nx = len(self.plant.states)
        running = list(self.running().values())
        x = np.concatenate([answer.states[0], np.zeros(len(running))])
        total = answer.breaks[-1] - answer.breaks[0]
        times, states, inputs = [], [], []
        samples = SAMPLES * (PEAKS if any(w.startswith("peak(") for w in self.weights) else 1)
        for k, (begin, end) in enumerate(pairwise(answer.breaks)):
            planned = answer.t[(answer.t > begin) & (answer.t < end)]
            count = max(9, int(samples * (end - begin) / total) + 2)
            at = np.unique(np.concatenate([np.linspace(begin, end, count), planned]))

            def piece(t: float, k: int = k) -> Array:
                return answer.inputs(k, t)[:, 0]

            found = model.solved(piece, x, (begin, end), at, running)
            times.append(at)
            states.append(found[:nx])
            inputs.append(answer.inputs(k, at))
            x = found[:, -1]
        return Motion(times, states, inputs, x[nx:])

    def replay(self) -> None:
        """The answer's states are those that its inputs bring about."""
        nominal, answer = self.model.scales[0], self.answer
        worst, where = 0.0, ""
        for at, found in zip(self.motion.t, self.motion.x, strict=True):
            rows = np.flatnonzero((answer.t >= at[0]) & (answer.t <= at[-1]))
            places = np.clip(np.searchsorted(at, answer.t[rows]), 0, len(at) - 1)
            same = np.abs(at[places] - answer.t[rows]) < 1e-9
            miss = np.abs(found[:, places[same]].T - answer.states[rows[same]]) / nominal
            if miss.size and miss.max() > worst:
                worst = float(miss.max())
                where = self.plant.states[int(miss.max(axis=0).argmax())].name
        self.expect("replay", f"{where} off", worst, TOLERANCE)

    # ---- times ---------------------------------------------------------------------------------
    @cached_property
    def nodes(self) -> list[tuple[int, float]]:
        """(stop, time) of all that the motion visits, in order; a stop with a dwell twice."""
        kinds, at = self.legs, float(self.answer.breaks[0])
        found = [(0, at)]
        for (stop, _), duration in zip(kinds, self.answer.durations, strict=False):
            at += duration
            found.append((stop, at))
        return found

    @cached_property
    def legs(self) -> list[tuple[int, Any]]:
        """(stop that a leg leads to, what its duration may be)."""
        wanted, found = self.asked.get("duration"), list[tuple[int, Any]]()
        route = list(range(len(self.stops)))
        if self.asked.get("cyclic") is True:
            route.append(0)
        for i, stop in enumerate(route):
            if i:
                found.append((stop, wanted))
            dwell = self.stops[stop][2]
            if dwell and not (i and stop == 0):
                found.append((stop, dwell))
        return found

    def times(self) -> None:
        answer = self.answer
        span = answer.breaks[-1] - answer.breaks[0]
        if len(answer.durations) != len(self.legs):
            counts = f"{len(answer.durations)} durations for {len(self.legs)} legs"
            self.findings.append(Finding("time", counts, np.inf))
            return
        self.expect("time", "sum of durations", abs(sum(answer.durations) - span), 1e-6 * span)
        for (stop, wanted), duration in zip(self.legs, answer.durations, strict=True):
            low, high = wanted if isinstance(wanted, tuple) else (wanted, wanted)
            low, high = 1e-3 if low is None else low, 10.0 if high is None else high
            beyond = max(low - duration, duration - high)
            self.expect("time", f"leg to stop {stop + 1}", beyond, 1e-6 * max(high, 1e-3))

    def sides(self, at: float) -> list[tuple[str, int, bool]]:
        """(words, piece, whether at its end) of the pieces that meet at a time."""
        breaks, near = self.answer.breaks, 1e-7
        before = [k for k in range(len(breaks) - 1) if abs(breaks[k + 1] - at) < near]
        after = [k for k in range(len(breaks) - 1) if abs(breaks[k] - at) < near]
        return [("before", k, True) for k in before[-1:]] + [("after", k, False) for k in after[:1]]

    # ---- stops ---------------------------------------------------------------------------------
    def at_stops(self) -> None:
        """Named values, and rest of all positions on both sides."""
        nodes = self.nodes
        for i, (stop, at) in enumerate(nodes):
            values, rest, _, within = self.stops[stop]
            sides = self.sides(at)
            if not sides:
                self.findings.append(Finding("stop", f"no input ends at stop {stop + 1}", np.inf))
                continue
            for words, piece, ends in sides:
                label = f"stop {stop + 1} {words}"
                self.named(label, values, piece, -1 if ends else 0)
                if rest:
                    self.rest(label, piece, ends)
            if i and nodes[i - 1][0] == stop:
                self.dwelt(stop, values, nodes[i - 1][1], at, within)

    def expressions(self, names: Sequence[str]) -> Callable[[], list[ca.SX]]:
        return lambda: [self.plant.expression(n) for n in names]

    def nominal(self, name: str) -> float:
        if name.startswith("der("):
            return 10.0 * float(self.plant.variable(name[4:-1]).nominal)
        return float(self.plant.variable(name).nominal)

    def along(self, names: Sequence[str], x: Array, u: Array) -> Array:
        return self.model.values(f"named {names}", self.expressions(names), x, u)

    def named(self, label: str, values: Mapping[str, Any], piece: int, row: int) -> None:
        names = list(values)
        x, u = self.motion.x[piece][:, [row]], self.motion.u[piece][:, [row]]
        for name, value in zip(names, self.along(names, x, u)[:, 0], strict=True):
            low, high = ends(values[name])
            beyond, allowed = max(low - value, value - high), TOLERANCE * self.nominal(name)
            self.expect("stop", f"{label}: {name} = {value:.6g}", beyond, allowed)

    def dwelt(
        self, stop: int, values: Mapping[str, Any], begin: float, end: float, within: float
    ) -> None:
        for at, x, u in zip(self.motion.t, self.motion.x, self.motion.u, strict=True):
            if at[0] < begin - 1e-9 or at[-1] > end + 1e-9:
                continue
            for name, row in zip(values, self.along(list(values), x, u), strict=True):
                low, high = ends(values[name])
                beyond = float(np.max(np.maximum(low - row, row - high))) / self.nominal(name)
                self.expect("dwell", f"stop {stop + 1}: {name} leaves", beyond, within + TOLERANCE)

    @cached_property
    def still(self) -> list[tuple[str, int, ca.SX, float]]:
        """(position, order, its derivative, size) of all that vanishes at rest."""
        found = []
        for name in self.task.positions:
            value = self.plant.expression(name)
            rate = self.model.derivative(value)
            size = 10.0 * self.nominal(name)
            for v in self.plant.states:  # where the rate is a state, it has its own size
                if ca.is_equal(rate, self.plant.expression(v.name)):
                    size = float(v.nominal)
            found.append((name, 1, rate, size))
            if not self.model.set_at_once(rate):
                found.append((name, 2, self.model.derivative(rate), 10.0 * size))
        return found

    def rest(self, label: str, piece: int, at_end: bool) -> None:
        """Rates and accelerations are zero: by the equations, and by differences of the run."""
        row = -1 if at_end else 0
        x, u = self.motion.x[piece][:, row], self.motion.u[piece][:, row]
        held = [each for each in self.still if self.model.set_at_once(each[2])]
        rates = self.model.values(
            "still", lambda: [each[2] for each in self.still], x[:, None], u[:, None]
        )[:, 0]
        for i, (name, order, expression, size) in enumerate(self.still):
            if self.model.set_at_once(expression):
                continue
            difference = self.difference(name, order, size, piece, row)
            kind = "speed" if order == 1 else "acceleration"
            what = f"{label}: {kind} of {name} {rates[i]:.4g}, by differences {difference:.4g}"
            miss = max(abs(rates[i]), abs(difference) - 2 * TOLERANCE * size)
            self.expect(kind, what, miss, TOLERANCE * size)
        if held:
            self.holdable(label, x, u, held)

    def difference(self, name: str, order: int, size: float, piece: int, row: int) -> float:
        """A derivative at an end of a piece by one-sided differences of a run from there, of a
        place (order 1) or its rate, over ever shorter steps until they agree.
        """
        nominal, at = self.model.scales[0], self.motion.t[piece][row]
        way, x = (-1.0 if row else 1.0), self.motion.x[piece][:, row]
        of = next(e for n, o, e, _ in self.still if (n, o) == (name, 1))
        of = self.plant.expression(name) if order == 1 else of
        slope = self.model.quick("slope0", lambda: [self.model.rates])
        found = np.inf
        for h in way * DIFFERENCES:
            run = solve_ivp(
                lambda t, z: slope(z * nominal, self.answer.inputs(piece, t)[:, 0]) / nominal,
                (at, at + 2 * h),
                x / nominal,
                "DOP853",
                [at, at + h, at + 2 * h],
                rtol=1e-13,
                atol=1e-15,
            )
            if not run.success:  # backwards what is stiff explodes, the less the shorter the step
                continue
            states, inputs = run.y * nominal[:, None], self.answer.inputs(piece, run.t)
            y = self.model.values(f"{name} {order}", lambda: [of], states, inputs)[0]
            before, found = found, float(-3 * y[0] + 4 * y[1] - y[2]) / (2 * h)
            if abs(found - before) < TOLERANCE * size / 4:
                break
        return found

    def holdable(self, label: str, x: Array, u: Array, held: Sequence[Any]) -> None:
        """Inputs within their limits would hold what an input sets at once."""
        rows = [expression / size for _, _, expression, size in held]
        miss, _ = self.held_inputs("holdable", lambda: rows, x, u)
        names = ", ".join(dict.fromkeys(name for name, *_ in held))
        self.expect("acceleration", f"{label}: no input holds {names}", miss, TOLERANCE)

    def held_inputs(
        self, key: str, rows: Callable[[], Sequence[Any]], x: Array, u: Array
    ) -> tuple[float, Array]:
        """(what is left, inputs within their limits that make rows vanish and keep the plant's
        constraints).
        """
        plant, nominal = self.plant, self.model.scales[1]
        limits = [(v.start, v.start) if v.disturbance else (v.min, v.max) for v in plant.inputs]
        for name, value in (self.asked.get("bounds") or {}).items():
            for i, v in enumerate(plant.inputs):
                if v.name == name:
                    low, high = ends(value)
                    limits[i] = max(low, limits[i][0]), min(high, limits[i][1])
        low, high = (np.array(side, float) / nominal for side in zip(*limits, strict=True))
        high = np.maximum(high, low + 1e-12)
        call = self.model.quick(key, rows)
        inside = self.model.quick(
            "constraints", self.expressions([c.name for c in plant.constraints])
        )
        least, most, size = (
            np.array([getattr(c, a) for c in plant.constraints]) for a in ("min", "max", "nominal")
        )

        def left(w: Array) -> Array:
            c = inside(x, w * nominal) if len(size) else np.zeros(0)
            beyond = np.maximum(np.maximum(least - c, c - most), 0.0) / size if len(size) else c
            return np.concatenate([call(x, w * nominal), beyond])

        middle = np.where(np.isfinite(low + high), (low + high) / 2, 0.0)
        starts = [u / nominal, np.array([v.start or 0.0 for v in plant.inputs]) / nominal, middle]
        starts += [self.following(x) / nominal]
        draw = np.random.default_rng(0)
        spans = np.clip(low, -1e2, 1e2), np.clip(high, -1e2, 1e2)
        starts += [draw.uniform(*spans) for _ in range(6)]
        best, chosen = np.inf, u
        for start in starts:
            tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 200}
            found = least_squares(left, np.clip(start, low, high), bounds=(low, high), **tight)
            miss = float(np.abs(found.fun).max(initial=0.0))
            if miss < best:
                best, chosen = miss, found.x * nominal
            if best < 1e-7:
                break
        return best, chosen

    def following(self, x: Array) -> Array:
        """Commands equal to the pressures that they ask for."""
        values = dict(zip([v.name for v in self.plant.states], x, strict=True))
        own = [
            values.get(f"{v.name.rpartition('.')[0]}.pressure", v.start)
            if v.unit == "Pa"
            else v.start
            for v in self.plant.inputs
        ]
        return np.array([0.0 if value is None else value for value in own], float)

    # ---- the start -----------------------------------------------------------------------------
    def start(self) -> None:
        """A state that the plant reaches and keeps: with inputs held nothing moves before it.

        A cycle begins where it ends; a first stop that is no rest begins in motion.
        """
        values, rest, *_ = self.stops[0]
        x = self.answer.states[0]
        known = dict(zip([v.name for v in self.plant.states], x, strict=True))
        self.supplies(values, known)
        if self.asked.get("cyclic") or not rest:
            return
        rates = [
            self.plant.expression(f"der({v.name})") / (10.0 * v.nominal)
            for v in self.plant.states
            if v.name not in self.sums
        ]
        first = self.answer.inputs(0, self.answer.breaks[0])[:, 0]
        _, u = self.held_inputs("at rest", lambda: rates, x, first)
        self.left_by_the_past(values, known, u)
        moving = self.moving(x, u)
        if moving:  # under the inputs that leave the fewest states to blame
            others = [np.array([v.start or 0.0 for v in self.plant.inputs]), self.following(x)]
            moving = min([moving, *(self.moving(x, each) for each in others)], key=len)
        for name, (drift, allowed) in moving.items():
            self.expect("start", f"{name} drifts before it", drift, allowed)

    @cached_property
    def at_edges(self) -> set[str]:
        """Memories that the task has at an end of their range: rounded, they give up some of it."""
        held = [v for v in self.plant.states if v.memory == "held"]
        return {v.name for v in held if self.remembered(v) in {v.min, v.max} - {v.start}}

    def moving(self, x: Array, u: Array) -> dict[str, tuple[float, float]]:
        """{state: (how far it moves, how far it may)} of those that do not stay while inputs stand,
        and that the verdict does not name: memories at their edges by themselves, all others while
        these keep what they hold.
        """
        edges = self.at_edges
        drifts = self.drifts(x, u)
        if edges:
            drifts = self.drifts(x, u, edges) | {n: drifts[n] for n in edges}
        allowed = dict.fromkeys(drifts, DRIFT)
        for name in edges:
            v = self.plant.variable(name)
            allowed[name] += EDGE * abs(self.remembered(v)) / v.nominal
        return {
            n: (d, allowed[n])
            for n, d in drifts.items()
            if not (d <= allowed[n] or self.answer.names(n))
        }

    @cached_property
    def sums(self) -> set[str]:
        """States that no equation needs, and that are no positions."""
        pattern = ca.jacobian(self.model.rates, self.plant.x).sparsity()
        used = {column for _, column in zip(*pattern.get_triplet(), strict=True)}
        names = [v.name for v in self.plant.states]
        return {n for i, n in enumerate(names) if i not in used and n not in self.task.positions}

    def drifts(self, x: Array, u: Array, kept: Collection[str] = ()) -> dict[str, float]:
        """By how much each state moves while inputs, and the states ``kept``, stand, in units of
        nominal.
        """
        free = np.array([v.name not in kept for v in self.plant.states], float)
        slopes = self.model.values(
            "slopes", lambda: [ca.vec(ca.jacobian(self.model.rates, self.plant.x))], x, u
        )
        matrix = free[:, None] * slopes.reshape(len(x), len(x), order="F")
        growth = float(np.linalg.eigvals(matrix).real.max()) if np.isfinite(matrix).all() else 0.0
        span = min(HELD, 6.0 / max(growth, 1e-3))  # what is unstable leaves its rest some time
        try:
            run = self.model.solved(lambda t: u, x, (0.0, span), np.linspace(0, span, 80), [], free)
        except ArithmeticError:
            return {v.name: np.inf for v in self.plant.states}
        moved = np.abs(run - x[:, None]).max(axis=1) / self.model.scales[0]
        names = [v.name for v in self.plant.states]
        return {n: float(m) for n, m in zip(names, moved, strict=True) if n not in self.sums}

    def left_by_the_past(
        self, values: Mapping[str, Any], known: Mapping[str, float], u: Array
    ) -> None:
        """Temperatures are those of the surroundings, held memories those that were given, or what
        these come to by themselves where the plant stands (a largest contraction so far is no less
        than the present one).
        """
        for v in self.plant.states:
            if v.name in values or self.answer.names(v.name):
                continue
            if v.unit == "K":
                warmer = abs(known[v.name] - v.start)
                self.expect("start", f"{v.name} = {known[v.name]:.1f} K", warmer, WARMER)
            if v.memory == "held":
                wanted = self.remembered(v)
                low, high = sorted((wanted, self.alone(v, wanted, u)))
                miss = max(low - known[v.name], known[v.name] - high) / v.nominal
                self.expect("start", f"memory {v.name} = {known[v.name]:.4g}", miss, TOLERANCE)

    def remembered(self, v: Any) -> float:
        """What the task says that a memory holds."""
        memory = self.asked.get("memory", "virgin")
        if isinstance(memory, Mapping):
            return float(memory.get(v.name, v.start))
        return float(v.start) if memory == "virgin" else self.slid(v, memory)

    def alone(self, memory: Any, value: float, u: Array) -> float:
        """Where a memory comes to from a value while all else stands as the answer begins."""
        x, i = self.answer.states[0].copy(), [v.name for v in self.plant.states].index(memory.name)
        slope = self.model.quick("slope0", lambda: [self.model.rates])

        def rate(t: float, z: Array) -> Array:
            x[i] = z[0]
            return slope(x, u)[[i]]

        run = solve_ivp(rate, (0.0, SETTLED), [value], "LSODA", rtol=1e-9, atol=1e-12)
        return float(run.y[0, -1])

    def slid(self, memory: Any, side: str) -> float:
        """A memory after all positions came from one side: the end to which they drive it; its
        start value where they do not (the play of a spool follows the spool alone).
        """
        plant, names = self.plant, [v.name for v in self.plant.states]
        standing = self.answer.states[0].copy()
        standing[names.index(memory.name)] = (memory.min + memory.max) / 2
        u = self.answer.inputs(0, self.answer.breaks[0])
        rising = standing.copy()
        for name in self.task.positions:
            rate = self.model.derivative(plant.expression(name))
            slopes = self.model.values(
                f"slopes of {name}",
                lambda rate=rate: [ca.jacobian(rate, plant.x).T],
                standing[:, None],
                u,
            )[:, 0]
            for i, v in enumerate(plant.states):  # each velocity that raises it
                if slopes[i] > 0 and v.memory == "":
                    rising[i] = v.nominal
        columns = np.column_stack([standing, rising])
        still, moving = self.along([f"der({memory.name})"], columns, np.repeat(u, 2, axis=1))[0]
        drive = (moving - still) * (1.0 if side == "below" else -1.0)
        return float(memory.start if drive == 0 else memory.max if drive > 0 else memory.min)

    def supplies(self, values: Mapping[str, Any], known: Mapping[str, float]) -> None:
        """No receiver holds more than its source brings about; an unfed one what it was given."""
        given = {v.name: v.start for v in self.plant.parameters}
        for name, value in known.items():
            if not name.endswith(".air_pressure") or name in values or self.answer.names(name):
                continue
            tank, nominal = name.removesuffix(".air_pressure"), self.nominal(name)
            tops = [given.get(f"{tank}.{k}") for k in ("full_pressure", "set_pressure")]
            top = next((t for t in tops if t is not None), None)
            start = float(self.plant.variable(name).start)
            if top is None:
                over, words = abs(value - start) / nominal, ", unfed"
            else:
                over, words = (value - max(top, 0.0)) / nominal, " above its source"
            self.expect("start", f"{name} = {value:.6g}{words}", over, DRIFT)

    # ---- limits --------------------------------------------------------------------------------
    def limits(self) -> None:
        """Bounds and constraints of the plant and of the user, forbidden regions, all along."""
        plant = self.plant
        ranges: dict[str, tuple[float, float]] = {}
        for v in (*plant.states, *plant.inputs, *plant.constraints):
            if v.memory != "held":
                ranges[v.name] = (v.start, v.start) if v.disturbance else (v.min, v.max)
        for name, value in (self.asked.get("bounds") or {}).items():
            low, high = ranges.get(name, (-np.inf, np.inf))
            least, most = ends(value)
            ranges[name] = max(low, least), min(high, most)
        x, u = self.motion.all()
        names = list(ranges)
        for name, row in zip(names, self.along(names, x, u), strict=True):
            low, high = ranges[name]
            beyond = float(np.max(np.maximum(low - row, row - high))) / self.nominal(name)
            self.expect("limit", f"{name} beyond its limits", beyond, TOLERANCE)
        for each in self.asked.get("constraints", ()):
            self.expect("limit", each.name, self.beyond(each, x, u), TOLERANCE)

    def beyond(self, each: Any, x: Array, u: Array) -> float:
        """By how much a forbidden region is entered, or a constraint of one's own is broken."""
        if hasattr(each, "region"):
            away = sum(
                ((row - each.region[name][0]) / each.region[name][1]) ** 2
                for name, row in zip(each.region, self.along(list(each.region), x, u), strict=True)
            )
            return float(1.0 - np.sqrt(np.min(away)))
        low, high = ends((each.low, each.high))
        row = self.model.values(f"own {each.name}", lambda: [each.expression], x, u)[0]
        return float(np.max(np.maximum(low - row, row - high)) / each.nominal)

    def closing(self) -> None:
        """A cycle ends where it began, or in the mirror image of that."""
        cyclic = self.asked.get("cyclic")
        if not cyclic:
            return
        first, last = self.motion.x[0][:, 0], self.motion.x[-1][:, -1]
        names = [v.name for v in self.plant.states]
        for i, v in enumerate(self.plant.states):
            if v.name in self.sums:
                continue
            sign, image = 1.0, v.name
            if cyclic == "mirrored":
                sign, image = self.plant.mirror_map.get(v.name, (1.0, v.name))
            miss = abs(last[i] - sign * first[names.index(image)]) / v.nominal
            self.expect("cycle", f"{v.name} does not close", miss, TOLERANCE)

    # ---- costs ---------------------------------------------------------------------------------
    @cached_property
    def weights(self) -> dict[str, float]:
        wanted = self.asked.get("minimise", "time")
        return {wanted: 1.0} if isinstance(wanted, str) else dict(wanted)

    def running(self) -> dict[str, ca.SX]:
        """{term: integrand [SI]} of all that the objective and the budgets integrate."""
        terms = [*self.weights, *(self.asked.get("budgets") or {})]
        found = {}
        for term in dict.fromkeys(terms):
            if (expression := self.integrand(term)) is not None:
                found[term] = expression
        for name, aim in (self.asked.get("track") or {}).items():
            error = (self.plant.expression(name) - aim) / self.nominal(name)
            found[f"track {name}"] = error**2
        return found

    def integrand(self, term: str) -> ca.SX | None:
        plant = self.plant
        inner = term[term.find("(") + 1 : -1] if "(" in term else ""
        if term == "effort":
            return ca.SX(ca.sumsqr(plant.u / ca.DM(self.model.scales[1])))
        if term in ("air", "exergy"):
            kind = {"air": ".supply_flow", "exergy": ".exergy_flow"}[term]
            flows = [plant.expression(v.name) for v in plant.outputs if v.name.endswith(kind)]
            return ca.SX(sum(flows[1:], flows[0]))
        if term == "work":
            total = ca.SX(0)
            for v in plant.outputs:
                muscle = v.name.removesuffix(".contraction")
                if muscle != v.name:  # force times speed of shortening
                    speed = self.model.derivative(plant.expression(v.name))
                    speed *= plant.expression(f"{muscle}.rest_length")
                    total += ca.fmax(plant.expression(f"{muscle}.force") * speed, 0)
            return total
        if term.startswith("square("):
            return ca.SX((plant.expression(inner) / self.nominal(inner)) ** 2)
        return ca.SX(plant.expression(inner)) if term.startswith("integral(") else None

    def costs(self) -> None:
        """The objective and the budgets, by quadrature along the run."""
        integrals = dict(zip(self.running(), self.motion.integrals, strict=True))
        total, x = 0.0, self.motion.all()
        span = sum(self.answer.durations)
        candidates = [0.0]
        for term, weight in self.weights.items():
            inner = term[term.find("(") + 1 : -1] if "(" in term else ""
            if term == "time":
                total += weight * span
            elif term == "rate":
                candidates = [weight * rate for rate in self.input_rates()]
            elif term.startswith("peak("):
                total += weight * float(self.along([inner], *x).max()) / self.nominal(inner)
            elif term.startswith("final("):
                total += weight * float(self.along([inner], *x)[0, -1]) / self.nominal(inner)
            else:
                unit = {"air": 1e-3, "exergy": 10.0}.get(term, 1.0)
                unit = self.nominal(inner) if term.startswith("integral(") else unit
                total += weight * integrals[term] / unit
        total += sum(integrals[k] for k in integrals if k.startswith("track "))
        said = self.answer.objective
        nearest = min((total + more for more in candidates), key=lambda value: abs(value - said))
        words = f"{said:.6g} where the motion has {nearest:.6g}"
        self.expect("objective", words, abs(said - nearest), COST * max(abs(nearest), LEAST))
        for term, value in (self.asked.get("budgets") or {}).items():
            spent, unit = (span, 1.0) if term == "time" else (integrals[term], 1.0)
            unit = {"air": 1e-3, "exergy": 10.0}.get(term, unit)
            low, high = ends(value if isinstance(value, tuple | list) else (None, value))
            beyond = max(low - spent, spent - high) / unit
            self.expect("budget", f"{term} = {spent:.6g}", beyond, TOLERANCE)

    def input_rates(self) -> list[float]:
        """Squared rates of the inputs: of lines their slope, of held ones their jumps by the mean
        length beside; neighbours with equal values may be one or two.
        """
        c, nominal = self.answer.coefficients, self.model.scales[1]
        lengths = np.diff(self.answer.breaks)
        if c.shape[1] > 1 and np.any(c[:, 1:]):
            total = 0.0
            for k, h in enumerate(lengths):
                s = np.linspace(0, h, 65)
                rates = polynomial.polyval(s, polynomial.polyder(c[k] / nominal))
                total += float(np.trapezoid(np.sum(rates**2, axis=0), s))
            return [total]
        found = []
        for merged in (False, True):
            values, spans = [c[0, 0]], [lengths[0]]
            for value, length in zip(c[1:, 0], lengths[1:], strict=True):
                if merged and np.array_equal(value, values[-1]):
                    spans[-1] += length
                else:
                    values.append(value)
                    spans.append(length)
            jumps = (np.diff(values, axis=0) / nominal) ** 2
            beside = (np.array(spans[:-1]) + np.array(spans[1:])) / 2
            found.append(float((jumps.sum(axis=1) / beside).sum()))
        return found


def ends(value: Any) -> tuple[float, float]:
    """(low, high) of a number or a pair with None for an open end."""
    if isinstance(value, tuple | list):
        low, high = value
        return -np.inf if low is None else float(low), np.inf if high is None else float(high)
    return float(value), float(value)


def wrong(task: Any, answer: Answer) -> list[Finding]:
    """All that is wrong with an answer to a task; empty where it is right."""
    return Check(task, answer).found()
