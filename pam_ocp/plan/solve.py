"""plan: state the problem, transcribe it, solve it by IPOPT, and check the motion by replay."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, PlanError, SimulationError, require_positive
from ..integrate import Integration
from ..plant.plant import Plant
from ..simulate import evaluated, simulate
from ..trajectory import Trajectory
from .guess import Unpacked
from .mesh import Collocation, Mesh, refined
from .problem import Condition, Cyclic, Problem, pose
from .transcription import Program, Row, transcribe

__all__ = ["Plan", "Replay", "plan"]

Array: TypeAlias = NDArray[np.float64]

MAX_REFINEMENTS = 8
REPLAY_TOLERANCE = 1e-11
"""Relative tolerance of the integrator that replays a plan."""
OVERSAMPLING = 8
"""Checked times between two samples of a plan."""

DEFAULTS: dict[str, Any] = {
    "tol": 1e-9,
    "constr_viol_tol": 1e-9,
    "acceptable_iter": 0,
    "max_iter": 500,
    "mu_init": 1e-1,
    "nlp_scaling_method": "none",  # the program is scaled by the plant's nominals already
    "mumps_pivtol": 1e-7,
}
"""IPOPT's options; ``plan(..., options=...)`` overrides them."""


@dataclass(frozen=True)
class Replay:
    """What an independent tight integration of the planned inputs says."""

    error: float
    """Largest deviation of a state from the plan at its samples, in units of nominal."""
    state: str
    """The state that deviates most."""
    violation: float
    """Largest violation of a bound or path constraint, between samples too, in units of nominal."""
    constraint: str
    """The bound that is violated most ("" when none is)."""
    trajectory: Trajectory = field(repr=False)


@dataclass(frozen=True)
class Plan:
    """A planned motion, or a failed attempt at one.

    A failed plan is sealed: ``trajectory`` raises PlanError; what the solver left is reached only
    by :meth:`unverified`.
    """

    plant: Plant
    success: bool
    status: str
    """IPOPT's return status."""
    objective: float
    durations: tuple[float, ...]
    """Of each phase [s]."""
    statistics: dict[str, Any]
    """iterations, seconds to build and to solve, size of the program."""
    replay: Replay | None
    meshes: tuple[Mesh, ...]
    """The mesh of each round of refinement; the last is the plan's."""
    _samples: Trajectory = field(repr=False)

    @property
    def duration(self) -> float:
        """Of the whole motion [s]."""
        return sum(self.durations)

    @property
    def trajectory(self) -> Trajectory:
        """The planned motion. Raises PlanError when the plan failed."""
        if not self.success:
            raise PlanError(
                f"this plan failed ({self.status}) and holds no solution; "
                "unverified() gives what the solver left",
                self,
            )
        return self._samples

    @property
    def replay_error(self) -> float:
        """Largest deviation of the replay from the plan, in units of nominal (NaN when failed)."""
        return self.replay.error if self.replay else float("nan")

    def unverified(self) -> Trajectory:
        """What the solver left, whether it is a solution or not."""
        return self._samples

    def __str__(self) -> str:
        s = self.statistics
        lines = [
            f"plan of {self.plant.name}: {self.status}",
            f"duration   {self.duration:.6g} s ({' + '.join(f'{d:.6g}' for d in self.durations)})",
            f"objective  {self.objective:.6g}",
            f"solver     IPOPT, {s['iterations']} iterations, {s['solve_seconds']:.3f} s "
            f"(built in {s['build_seconds']:.3f} s; {s['variables']} variables, "
            f"{s['constraints']} constraints)",
            f"mesh       {s['intervals']} intervals"
            + (f", refined {len(self.meshes) - 1} times" if len(self.meshes) > 1 else ""),
        ]
        if self.replay:
            worst = f" ({self.replay.constraint})" if self.replay.constraint else ""
            lines += [
                f"replay     error {self.replay.error:.2e} of nominal ({self.replay.state})",
                f"bounds     largest violation {self.replay.violation:.2e} of nominal{worst}",
            ]
        return "\n".join(lines)


def plan(
    plant: Plant,
    stops: Sequence[Mapping[str, Any]],
    *,
    cyclic: Cyclic = False,
    duration: Any = None,
    minimise: str | Mapping[str, float] = "time",
    bounds: Mapping[str, Any] | None = None,
    rest: bool = True,
    integrand: ca.SX | None = None,
    method: Collocation | None = None,
    tolerance: float | None = None,
    options: Mapping[str, Any] | None = None,
) -> Plan:
    """The optimal motion of a plant that visits ``stops`` in order.

    Parameters
    ----------
    stops : at least two mappings {variable: value or (low, high)} of states, inputs or outputs.
    cyclic : True returns to the first stop and closes the cycle in all states; "mirrored" plans half
        a cycle between two stops whose second half is its mirror image (equal muscles).
    duration : None (free), seconds for every phase, (shortest, longest), or a list with one of these
        per phase.
    minimise : "time", "effort" (integral of the squared inputs in units of nominal), or a mapping of
        weights, {"time": 1.0, "effort": 1e-3}.
    bounds : {NAME or "der(NAME)": value or (low, high)}, None for an open end; narrows the plant's own
        bounds. Path constraints of the plant (never slack, pressure rates) always hold.
    rest : positions have zero velocity and acceleration at each stop.
    integrand : further running cost, a CasADi expression of the plant's symbols
        (``plant.expression("v") ** 2``, say); its integral is added to the objective.
    method : ``Collocation(intervals=50, degree=3, control="constant")`` per phase.
    tolerance : refine the mesh (degrees first, then intervals) until every interval, integrated
        tightly, meets its planned end to this part of nominal in all; None for one mesh only.
    options : of IPOPT, over DEFAULTS.

    Raises InputError for a problem that cannot be meant, PlanError when no solution was found: the
    message names the most violated constraint, ``error.plan`` is the sealed plan.
    """
    begin = time.perf_counter()
    problem = pose(
        plant, stops, cyclic=cyclic, duration=duration, minimise=minimise, bounds=bounds, rest=rest,
        integrand=integrand,
    )  # fmt: skip
    if tolerance is not None:
        require_positive("tolerance", tolerance)
    meshes = [(method or Collocation()).mesh(len(problem.durations))]
    attempt = _attempt(problem, meshes[-1], None, options)
    iterations = attempt.iterations
    while tolerance is not None and attempt.success and len(meshes) <= MAX_REFINEMENTS:
        errors = _interval_errors(problem, attempt.solution)
        # local errors add up over the intervals
        finer = refined(meshes[-1], errors, tolerance / len(errors))
        if finer == meshes[-1]:
            break
        following = _attempt(problem, finer, attempt.solution, options)
        iterations += following.iterations
        if not following.success:  # the coarser plan stands, with its replay error
            break
        attempt = following
        meshes.append(finer)
    return _plan(problem, attempt, meshes, iterations, time.perf_counter() - begin, options)


@dataclass(frozen=True)
class _Attempt:
    """One program and what IPOPT made of it."""

    program: Program
    solution: Unpacked
    objective: float
    status: str
    success: bool
    iterations: int
    build_seconds: float
    solve_seconds: float


def _attempt(
    problem: Problem, mesh: Mesh, previous: Unpacked | None, options: Mapping[str, Any] | None
) -> _Attempt:
    begin = time.perf_counter()
    program = transcribe(problem, mesh, previous)
    solver = _solver(program, options)
    built = time.perf_counter()
    result = _solve(solver, program)
    solved = time.perf_counter()
    stats = solver.stats()
    return _Attempt(
        program, program.unpack(np.asarray(result["x"], dtype=float).ravel()), float(result["f"]),
        str(stats["return_status"]), bool(stats["success"]), int(stats["iter_count"]),
        built - begin, solved - built,
    )  # fmt: skip


def _plan(
    problem: Problem,
    attempt: _Attempt,
    meshes: Sequence[Mesh],
    iterations: int,
    seconds: float,
    options: Mapping[str, Any] | None,
) -> Plan:
    """The Plan of the last attempt; raises PlanError when it failed."""
    samples = _samples(problem, attempt)
    statistics = {
        "iterations": iterations,
        "build_seconds": attempt.build_seconds,
        "solve_seconds": attempt.solve_seconds,
        "seconds": seconds,
        "variables": len(attempt.program.guess),
        "constraints": sum(row.size for row in attempt.program.rows),
        "intervals": len(attempt.program.mesh.intervals),
    }
    result = Plan(
        problem.plant, attempt.success, attempt.status, attempt.objective,
        tuple(float(d) for d in attempt.solution[3]), statistics,
        _replay(problem, samples) if attempt.success else None, tuple(meshes), samples,
    )  # fmt: skip
    if not attempt.success:
        raise PlanError(_reason(attempt.program, result, options), result)
    return result


def _solver(program: Program, options: Mapping[str, Any] | None) -> ca.Function:
    ipopt = {"print_level": 0, "sb": "yes", **DEFAULTS, **(options or {})}
    try:
        return ca.nlpsol("plan", "ipopt", program.nlp, {"print_time": False, "ipopt": ipopt})
    except RuntimeError as error:
        raise InputError(
            f"options = {dict(options or {})}: {str(error).splitlines()[-1]}"
        ) from None


def _solve(solver: ca.Function, program: Program) -> dict[str, ca.DM]:
    return dict(
        solver(
            x0=program.guess, p=program.problem.plant.vector("parameter"),
            lbx=program.w_low, ubx=program.w_high,
            lbg=np.concatenate([r.low for r in program.rows]),
            ubg=np.concatenate([r.high for r in program.rows]),
        )
    )  # fmt: skip


def _samples(problem: Problem, attempt: _Attempt) -> Trajectory:
    """The solution as a Trajectory at all collocation points, with its inputs as they are between."""
    t, states, signals, _ = attempt.solution
    return evaluated(problem.plant, t, states, signals)


def _interval_errors(problem: Problem, solution: Unpacked) -> list[float]:
    """For each interval: how far a tight integration from its start leaves its planned points."""
    plant = problem.plant
    times, states, signals, _ = solution
    nominal = plant.vector("state", attribute="nominal")
    ends = np.searchsorted(times, signals.breaks - 1e-12 * (1 + np.abs(signals.breaks)))
    errors = []
    for a, b in pairwise(ends):
        part = slice(a, b + 1)
        found = Integration.over(plant, signals, times[part], states[a], rtol=REPLAY_TOLERANCE)()
        if found is None:
            errors.append(float("inf"))
        else:
            errors.append(float(np.max(np.abs(found - states[part]) / nominal)))
    return errors


def _replay(problem: Problem, samples: Trajectory) -> Replay:
    """Integrate the planned inputs tightly, and look at the bounds between the samples too."""
    plant = problem.plant
    fine = np.linspace(samples.t[:-1], samples.t[1:], OVERSAMPLING, endpoint=False).T.ravel()
    fine = np.append(fine, samples.t[-1])
    try:
        motion = simulate(plant, samples, t=fine, rtol=REPLAY_TOLERANCE)
    except SimulationError as error:
        part = error.trajectory or samples
        return Replay(
            float("inf"), f"the replay stops at t = {error.time:g} s", float("inf"), "", part
        )
    names = samples.named("state")
    nominal = plant.vector("state", attribute="nominal")
    deviation = np.abs(motion.array(names)[::OVERSAMPLING] - samples.array(names)) / nominal
    violation, constraint = _violation(problem, motion)
    worst = names[int(np.argmax(deviation.max(axis=0)))]
    return Replay(float(deviation.max()), worst, violation, constraint, motion)


def _violation(problem: Problem, motion: Trajectory) -> tuple[float, str]:
    """Largest violation of bounds and path conditions along a motion, in units of nominal."""
    plant = problem.plant
    x, u = (motion.array(motion.named(c)).T for c in ("state", "input"))
    found = [(0.0, "")]
    for name, (low, high) in problem.bounds.items():
        variable = plant.variable(name)
        excess = max(float(np.max(low - motion[name])), float(np.max(motion[name] - high)))
        found.append((excess / variable.nominal, name))
    for condition in problem.path:
        function = ca.Function("path", [plant.x, plant.u, plant.p], [condition.expression])
        values = np.asarray(function(x, u, plant.vector("parameter"))).ravel()
        excess = max(float(np.max(condition.low - values)), float(np.max(values - condition.high)))
        found.append((excess / condition.nominal, condition.label))
    return max(found)


def _reason(program: Program, failed: Plan, options: Mapping[str, Any] | None) -> str:
    """Why there is no plan: the constraint that an elastic re-solve has to violate most."""
    opening = f"no plan found for {failed.plant.name} ({failed.status}). "
    slack, row, index = _elastic(program, options)
    if slack < 1e-6:
        return opening + (
            "A motion that meets all constraints seems to exist, but the solver did not converge; "
            "try another method=Collocation(...), other bounds of duration, or more "
            "options={'max_iter': ...}"
        )
    if not row.conditions:
        return (
            opening + f"The most violated constraint is the {row.label} (by {slack:.3g} of nominal)"
        )
    condition = row.conditions[index]
    amount = condition.shown.shown(slack * condition.nominal)
    where = f" {row.where[index]}" if row.where else ""
    return opening + (
        f"The most violated constraint is {condition.label} "
        f"({_bound_text(condition)}), by {amount}{where}; relax it, or allow more time or pressure"
    )


def _bound_text(condition: Condition) -> str:
    shown = condition.shown.shown
    if condition.low == condition.high:
        return f"= {shown(condition.low)}"
    return f"{shown(condition.low)} .. {shown(condition.high)}"


def _elastic(program: Program, options: Mapping[str, Any] | None) -> tuple[float, Row, int]:
    """Least total violation of stops, path and closing, dynamics kept: (largest, row, index in it)."""
    soft = [np.full(r.size, r.kind != "defect") for r in program.rows]
    chosen = np.flatnonzero(np.concatenate(soft))
    g = program.nlp["g"]
    above, below = ca.MX.sym("above", len(chosen)), ca.MX.sym("below", len(chosen))
    pick = ca.DM(
        ca.Sparsity.triplet(g.numel(), len(chosen), chosen.tolist(), list(range(len(chosen)))), 1.0
    )
    relaxed = g + ca.mtimes(pick, below - above)
    nlp = {
        "x": ca.vertcat(program.nlp["x"], above, below), "p": program.nlp["p"],
        "f": ca.sum1(above) + ca.sum1(below), "g": relaxed,
    }  # fmt: skip
    ipopt = {
        "print_level": 0,
        "sb": "yes",
        **DEFAULTS,
        "tol": 1e-7,
        "max_iter": 1000,
        **(options or {}),
    }
    solver = ca.nlpsol("elastic", "ipopt", nlp, {"print_time": False, "ipopt": ipopt})
    zero = np.zeros(2 * len(chosen))
    result = solver(
        x0=np.concatenate([program.guess, zero + 0.1]), p=program.problem.plant.vector("parameter"),
        lbx=np.concatenate([program.w_low, zero]),
        ubx=np.concatenate([program.w_high, zero + np.inf]),
        lbg=np.concatenate([r.low for r in program.rows]),
        ubg=np.concatenate([r.high for r in program.rows]),
    )  # fmt: skip
    slack = np.asarray(result["x"]).ravel()[len(program.guess) :].reshape(2, -1).max(axis=0)
    worst = int(np.argmax(slack))
    position, begin = int(chosen[worst]), 0
    for row in program.rows:
        if position < begin + row.size:
            return float(slack[worst]), row, position - begin
        begin += row.size
    raise AssertionError("a chosen row lies outside the program")
