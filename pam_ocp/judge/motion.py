"""The judge of a planned motion: it drives the plant by the planned inputs, looks at what the
statement asked for, and says in one sentence whether the plan can be trusted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, SimulationError, kind_of, require_positive
from ..core.shown import shown
from ..core.signals import Inputs, PiecewisePolynomial, signals
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..plants.plant import Given, Plant, require_plant
from ..plants.stillness import totals
from .asked import Asked, Goal, Limit, Point, Span, asked
from .driven import Driven, driven, roughly
from .rest import begun, end_at, rest_at, rows_of
from .statement import Profile, Statement

Array: TypeAlias = NDArray[np.float64]
ROUNDING = 1e-9
"""A smaller violation, scaled by nominals, is nothing to tell people."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What a plant is driven by. start : (nx,) states; inputs : over the whole motion, from time 0;
    durations : of each leg between two stops, dwells among them [s].

    Examples
    --------
    >>> own = plan.motion
    >>> len(own.durations), own.start.shape
    (1, (4,))
    """

    start: Array
    inputs: PiecewisePolynomial
    durations: tuple[float, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.inputs, PiecewisePolynomial):
            raise InputError(
                f"inputs of the motion is {kind_of(self.inputs)}: Motion.of(plant, start, "
                "inputs, durations) takes what simulate does"
            )

    @classmethod
    def of(cls, plant: Plant, start: Given, inputs: Inputs, durations: Sequence[float]) -> Motion:
        """A motion from elsewhere.

        start : states by name, or a point; start values for what is not named. inputs : as
        :func:`pam_ocp.simulate` takes them, such as {name: (times, values)}, held, or a Trajectory.
        durations : of the legs [s].

        Examples
        --------
        >>> times = ([0.0, 0.1], [3e5, 3e5])
        >>> held = {"muscle1.command": times, "muscle2.command": times}
        >>> own = pam.judge.Motion.of(slide, {"x": 0.0}, held, [0.1])
        >>> own.inputs(0.05).tolist()
        [[300000.0, 300000.0]]
        """
        require_plant(plant)
        each = [require_positive(f"durations[{i}]", d, "s") for i, d in enumerate(durations)]
        if not each:
            raise InputError("durations is empty; give the seconds of each leg, such as [0.5, 0.5]")
        driving = signals(plant, inputs, np.array([0.0, sum(each)]))
        return cls(plant.vector("state", start), driving, tuple(each))


@dataclass(frozen=True)
class Finding:
    """Something asked for that the motion does not keep. by : scaled by nominals.

    Examples
    --------
    >>> late = pam.judge.Statement([{"x": -0.01}, {"x": 0.02}])
    >>> pam.judge.judge(slide, late, plan.motion).findings[0].label
    'stop 2: x'
    """

    label: str
    by: float
    said: bool = False
    """Whether the statement itself says so: then it is told, and counts for nothing."""


@dataclass(frozen=True)
class Judgement:
    """What a tight integration of the inputs says of all that was asked for.

    Examples
    --------
    >>> plan.judgement.violation < 1e-3, bool(abs(plan.judgement.objective - plan.duration) < 1e-12)
    (True, True)
    """

    findings: tuple[Finding, ...]
    """What is not kept, the worst first."""
    objective: float
    """Of the motion, in the statement's words."""
    trajectory: Trajectory | None = field(repr=False)
    stopped: str = ""
    """Where the integration could not go on."""
    error: float = float("nan")
    """Largest deviation of a state from the motion that was claimed, scaled by nominals."""
    state: str = ""
    """The state that deviates most."""
    apart: float = 0.0
    """By how much an ordinary integration parts from the tight one, scaled by nominals: large for
    a motion along which errors grow."""

    def __str__(self) -> str:
        lines = [
            f"objective {self.objective:.6g}, largest violation {self.violation:.3g} of nominal"
            + (f" ({self.constraint})" if self.constraint else "")
        ]
        told = (f for f in self.findings if f.by > ROUNDING)
        lines += [f"  {f.label}: {f.by:.3g}" + " (as stated)" * f.said for f in told]
        return "\n".join(lines)

    @property
    def violation(self) -> float:
        """The worst that counts, scaled by nominals."""
        return float("inf") if self.stopped else max((f.by for f in self._counted), default=0.0)

    @property
    def constraint(self) -> str:
        """What is violated most ("" when nothing is)."""
        if self.stopped:
            return self.stopped
        worst = max(self._counted, key=lambda f: f.by, default=None)
        return worst.label if worst else ""

    @property
    def said(self) -> tuple[Finding, ...]:
        """What differs from rest at the start because the statement says so."""
        return tuple(f for f in self.findings if f.said)

    @property
    def _counted(self) -> list[Finding]:
        return [f for f in self.findings if not f.said]


@verb
def judge(
    plant: Plant, statement: Statement, motion: Motion, claimed: Trajectory | None = None
) -> Judgement:
    """Drive a plant by a motion's inputs, and look at all that the statement asks for.

    Stops (values; rates and accelerations of all positions), the start (a state that the plant
    comes to and keeps while its inputs are held), ranges, bounds, constraints and forbidden regions
    between all points and on both sides of jumps, durations, the closing of a cycle, budgets, the
    objective.

    statement : stops and keywords as :func:`pam_ocp.plan` takes them.
    claimed : states that the motion is said to run through.

    Raises InputError where the statement means nothing for the plant or the motion has other legs.

    Examples
    --------
    >>> said = pam.judge.Statement([{"x": -0.01}, {"x": 0.01}])
    >>> pam.judge.judge(slide, said, plan.motion).violation < 1e-3
    True
    """
    require_plant(plant)
    wanted = asked(plant, statement, motion.durations)
    _require_a_whole(plant, motion)
    ends = [point.time for point in wanted.points]
    times = [ends[0], *sorted([*ends[1:-1], *wanted.knots]), ends[-1]]
    try:
        further = None if claimed is None else claimed.t
        run, states = driven(plant, motion.start, motion.inputs, times, further)
    except SimulationError as error:
        part = error.trajectory
        words = f"the integration of its inputs stops at t = {error.time:g} s"
        return Judgement((), float("nan"), part, words, float("inf"), words)
    found = [Finding(label, by) for label, by in _kept(run, wanted)]
    found += [Finding(label, by) for label, by in _stops(run, statement, wanted)]
    found += [Finding(label, by) for label, by in _closed(run, statement)]
    found += _start(run, statement, wanted)
    found = [Finding(f.label, float(f.by), bool(f.said)) for f in found]
    ordered = sorted((f for f in found if not f.by <= 0.0), key=lambda f: -f.by)
    objective = _objective(run, wanted.goal)
    deviation = _deviation(run, motion, states, claimed)
    return Judgement(tuple(ordered), objective, run.trajectory, "", *deviation)


def _require_a_whole(plant: Plant, motion: Motion) -> None:
    """InputError where a start or inputs are another plant's, or inputs end before the legs."""
    breaks, sizes = motion.inputs.breaks, (len(plant.states), len(plant.inputs))
    given = np.size(motion.start), motion.inputs.coefficients.shape[-1]
    if given != sizes:
        raise InputError(
            f"the motion has {given[0]} states and {given[1]} inputs; {plant.name} has {sizes[0]} "
            f"and {sizes[1]}"
        )
    end, near = sum(motion.durations), 1e-6 * sum(motion.durations)
    if abs(breaks[0]) > near or breaks[-1] < end - near:
        raise InputError(
            f"inputs of the motion are given from {breaks[0]:g} to {breaks[-1]:g} s, and its legs "
            f"last from 0 to {end:g} s; give inputs over the whole motion"
        )


def _deviation(
    run: Driven, motion: Motion, states: Array, claimed: Trajectory | None
) -> tuple[float, str, float]:
    """(largest deviation of the motion from the claimed one in nominals, of which state, by how
    much an ordinary integration parts from it).
    """
    if claimed is None:
        return float("nan"), "", 0.0
    names = [v.name for v in run.plant.states]
    nominal = run.plant.vector("state", attribute="nominal")
    worst = np.max(np.abs(states - claimed.array(names)) / nominal, axis=0)
    i = int(np.argmax(worst))
    rough = roughly(run.plant, motion.start, motion.inputs, claimed.t)
    apart = 0.0 if rough is None else float(np.max(np.abs(rough - states) / nominal))
    return float(worst[i]), names[i], apart


def _kept(run: Driven, wanted: Asked) -> Iterator[tuple[str, float]]:
    """Limits along the motion, budgets, durations, design."""
    for span in wanted.spans:
        yield from _along(run, span)
    if wanted.sums:
        spent = run.integral([s.integrand for s in wanted.sums])
        for each, value in zip(wanted.sums, spent, strict=True):
            yield each.label, _excess(value, each.low, each.high) / each.nominal
    for label, (value, low, high) in wanted.times.items():
        yield label, _excess(value, low, high) / max(value, 1e-3)
    for name, (low, high) in wanted.design.items():
        variable = run.plant.variable(name)
        by = _excess(float(variable.start or 0.0), low, high)
        yield f"design: {name}", by / variable.nominal


def _along(run: Driven, span: Span) -> Iterator[tuple[str, float]]:
    """What is limited from one stop to the next, at all points of the cells between."""
    middle = run.t.mean(axis=1)
    own = (middle > span.begin) & (middle < span.end)
    values = run.values([limit.expression for limit in span.limits])[:, own]
    t = run.t[own]
    for limit, value in zip(span.limits, values, strict=True):
        low, high = (e(t) if isinstance(e, Profile) else e for e in (limit.low, limit.high))
        yield limit.label, _excess(value, low, high) / limit.nominal
        if limit.axes:  # a thin region may lie between two points
            yield limit.label, 1.0 - run.nearest(limit.axes, own)


def _excess(value: Array | float, low: Array | float, high: Array | float) -> float:
    """By how much a value is outside, at most; infinite where it is no number."""
    beyond = np.maximum(np.maximum(low - value, value - high), 0.0)
    worst = float(np.max(beyond, initial=0.0))
    return float("inf") if np.isnan(worst) else worst


def _stops(run: Driven, statement: Statement, wanted: Asked) -> Iterator[tuple[str, float]]:
    """Values at the stops, and rest there."""
    for point in wanted.points:
        sides = run.sides(point.time)
        plant, p = run.plant, run.plant.vector("parameter")
        column = ca.vertcat(*(limit.expression for limit in point.limits))
        function = ca.Function("stop", [plant.x, plant.u, plant.p], [column])
        for x, u in sides[:1] if point.left else sides[-1:]:
            values = np.asarray(function(x, u, p), float).ravel()
            for limit, value in zip(point.limits, values, strict=True):
                yield limit.label, _at(limit, value, point.time)
        if point.rest:
            names = {_key(plant, n) for n in point.stop.values}
            rows = rows_of(plant, wanted.points, dict.fromkeys(names))
            yield from rest_at(run, point, rows, _of_inputs(run, wanted, point))


def _key(plant: Plant, name: str) -> str:
    return name if name.startswith("der(") else plant.variable(name).name


def _at(limit: Limit, value: float, time: float) -> float:
    return _excess(value, end_at(limit.low, time), end_at(limit.high, time)) / limit.nominal


def _of_inputs(run: Driven, wanted: Asked, point: Point) -> list[Limit]:
    """What admissible inputs keep at a stop: their own ranges, and what depends on them, of the
    plant, of the whole motion and of what the stop names.
    """
    limits = (*wanted.always, *point.limits)
    return [c for c in limits if ca.depends_on(c.expression, run.plant.u)]


def _closed(run: Driven, statement: Statement) -> Iterator[tuple[str, float]]:
    """A cycle ends where it began, or in its mirror image."""
    if not statement.cyclic:
        return
    plant = run.plant
    names = [v.name for v in plant.states]
    mirror = (plant.mirror_map or {}) if statement.cyclic == "mirrored" else {}
    first, last = run.x[:, 0, 0], run.x[:, -1, -1]
    for i, variable in enumerate(plant.states):
        if variable.name in totals(plant):
            continue
        sign, image = mirror.get(variable.name, (1.0, variable.name))
        gap = abs(float(last[i] - sign * first[names.index(image)]))
        yield f"closing of the cycle: {variable.name}", gap / variable.nominal


def _start(run: Driven, statement: Statement, wanted: Asked) -> list[Finding]:
    """What the plant had not come to before the motion."""
    if statement.cyclic:
        return []
    first = wanted.points[0]
    found = begun(run, first, statement.memory, _of_inputs(run, wanted, first))
    return [Finding(label, by, said) for label, by, said in found]


# ---- the objective ------------------------------------------------------------------------------
def objectives(plant: Plant, statements: Sequence[Statement], motion: Motion) -> list[float]:
    """What several statements minimise, of one motion; NaN where its integration stops.

    Raises InputError as :func:`judge`.
    """
    wanted = [asked(plant, statement, motion.durations) for statement in statements]
    times = [point.time for point in wanted[0].points]
    try:
        run, _ = driven(plant, motion.start, motion.inputs, times)
    except SimulationError:
        return [float("nan")] * len(wanted)
    return [_objective(run, each.goal) for each in wanted]


def _objective(run: Driven, goal: Goal) -> float:
    total = goal.time * float(run.t[-1, -1] - run.t[0, 0])
    if not goal.integrand.is_zero():
        total += float(run.integral([goal.integrand])[0])
    if not goal.final.is_zero():
        total += float(run.values([goal.final])[0, -1, -1])
    for weight, value in goal.peaks:
        total += weight * run.largest(value)
    for weight, value, aim in goal.tracked:
        wanted = aim(run.t) if isinstance(aim, Profile) else aim
        total += weight * float(run.summed((run.values([value]) - wanted) ** 2)[0])
    return total + goal.rate * _rate(run.plant, run.inputs) if goal.rate else total


def _rate(plant: Plant, inputs: PiecewisePolynomial) -> float:
    """Integral of the squared rate of the inputs in nominals; a jump is one over the mean length of
    the pieces beside it (of held inputs, the lines that join the middles of their pieces).
    """
    nominal = plant.vector("input", attribute="nominal")
    h = np.diff(inputs.breaks)
    c, j = inputs.coefficients / nominal, np.arange(inputs.degree + 1)
    ends = np.einsum("kj,kji->ki", h[:, None] ** j, c)
    jumps = np.sum((c[1:, 0] - ends[:-1]) ** 2, axis=1)
    total = float(np.sum(jumps / ((h[:-1] + h[1:]) / 2)))
    taus, weights = np.polynomial.legendre.leggauss(inputs.degree + 1)
    for tau, weight in zip((taus + 1) / 2, weights / 2, strict=True):
        slopes = np.einsum("kj,kji->ki", j[1:] * (tau * h)[:, None] ** j[:-1], c[:, 1:])
        total += weight * float(np.sum(h * np.sum(slopes**2, axis=1)))
    return total


# ---- the verdict ---------------------------------------------------------------------------------
TOLERANCE = 1e-3
"""What a plan is judged by where nothing else is asked for, scaled by nominals."""


GROWTH = 1e3
"""Times by which errors grow along a motion that is called unstable."""


@shown
@dataclass(frozen=True)
class Verdict:
    """What the solver and an independent replay say of a plan, against one tolerance.

    ``print(verdict)`` is one sentence.

    Examples
    --------
    >>> plan.verdict.verified, plan.verdict.tolerance
    (True, 0.001)
    >>> print(str(plan.verdict).split(":")[0])
    verified
    """

    status: str
    """The solver's return status."""
    solved: bool
    """Whether the solver converged."""
    error: float
    """Largest deviation of the replay from the plan at its points, scaled by nominals."""
    state: str
    """The state that deviates most."""
    violation: float
    """Largest violation along the replay of bounds and path constraints (between the points too),
    of the stops' conditions, the closing of a cycle and budgets, scaled by nominals.
    """
    constraint: str
    """What is violated most ("" when nothing is)."""
    tolerance: float
    """Of the error and of the violation, scaled by nominals."""
    ended: str = ""
    """What broke off the search for a better plan: then none is verified."""
    local: float = float("nan")
    """What the replays of all intervals, each from its own planned start, deviate by in all, in
    units of nominal; known where the error exceeds the tolerance.
    """
    corrected: bool = False
    """Whether the equations of the mesh hold but for the defects that a tight integration leaves in
    them (iterated defect correction, where kinks are resolved slowly): then the motion is the
    plant's, on a mesh that would not resolve it, and is optimal as that mesh knows the plant.
    """
    begins: tuple[str, ...] = ()
    """What differs from rest at the start because the statement says so."""
    apart: float = 0.0
    """By how much an ordinary integration of the inputs parts from the tight one, scaled by
    nominals."""

    @property
    def verified(self) -> bool:
        """Whether the solver converged, and the replay agrees and keeps all limits, to the
        tolerance; and whether an ordinary integration confirms it.
        """
        # written so that a NaN fails
        kept = self.solved and not self.ended and not self._parts
        return kept and self.error <= self.tolerance and self.violation <= self.tolerance

    @property
    def _parts(self) -> bool:
        """Whether errors of an integrator grow beyond what plans are judged by."""
        return self.apart > max(self.tolerance, TOLERANCE)

    @property
    def growth(self) -> float:
        """How many times larger the error is than the deviations of the intervals that it grew
        from; large for an unstable motion.
        """
        return self.error / self.local if self.local > 0 else float("nan")

    @property
    def unstable(self) -> bool:
        """Whether the plan agrees interval by interval, and fails only as small errors grow."""
        return self.solved and self.local <= self.tolerance and self.growth > GROWTH

    def __bool__(self) -> bool:
        return self.verified

    def __str__(self) -> str:
        if not self.solved:
            return f"not verified: the solver did not converge ({self.status})"
        within = f"{self.tolerance:.0e}".replace("e-0", "e-")
        failed = []
        if not self.error <= self.tolerance:
            failed.append(
                f"its replay deviates by {self.error:.2g} (scaled by nominal values) in "
                f"{self.state}"
            )
        if not self.violation <= self.tolerance:
            failed.append(
                f"its replay violates {self.constraint} by {self.violation:.2g} "
                "(scaled by nominal values)"
            )
        if self._parts and not self.unstable:
            failed.append(
                f"an ordinary integration parts from its replay by {self.apart:.2g}: the motion is "
                "unstable, so run it with feedback (control.tvlqr)"
            )
            return f"not verified: {' and '.join(failed)}"
        if self.ended:
            failed.insert(0, f"{self.ended} before the search was done")
            return f"not verified: {' and '.join(failed)}"
        if failed:
            return f"not verified: {' and '.join(failed)}, more than {within}{self._growing()}"
        more = "; the mesh's defects were corrected" if self.corrected else ""
        if self.begins:
            more += f"; it does not begin at rest, as was said ({', '.join(self.begins)})"
        return (
            f"verified: its replay agrees to {self.error:.1e} (scaled by nominal values) and keeps "
            "all limits to "
            f"{self.violation:.1e}, within {within}{more}"
        )

    def _growing(self) -> str:
        if not self.unstable:
            return ""
        return (
            f"; the motion is unstable: its intervals agree to {self.local:.1e}, but errors grow "
            f"{self.growth:.0e} times along it, so run it with feedback (control.tvlqr)"
        )
