"""Sequential quadratic programming with the Gauss-Newton Hessian, on the program of shooting."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from ...core.errors import InputError, require_flag
from ...core.registry import Registry
from ...export.machine import machine_function
from ...numerics.solvers import Buffered, nlpsol, quiet_ipopt
from ...numerics.solvers import conic as qp_solver
from ..kinds import Array
from .riccati import ITERATIONS, RiccatiQp
from .shooting import UNBOUNDED, TrackingPoint, TrackingProgram, bounds_of, sides_of
from .stage_qp import StageQp, available

QpSolver: TypeAlias = 'Literal["hpipm", "piqp"] | str'
"""Of those in ``QP_SOLVERS``; these two come with the library."""

HPIPM: dict[str, Any] = {"mode": "speed_abs", "iter_max": 60, "res_m_max": 1e-6}
"""For CasADi's interface, used where StageQp is not available: its barriers at the open ends of
bounds make the matrices ill-conditioned, and steps less exact again when the complementarity gap is
smaller.
"""
MISS = 1e-3
"""Largest violation of a QP's rows by its solution, scaled by nominals, that still counts as
solved.
"""
OVER = 1.5
"""Times the work of a call after which begun quadratic programs are cut off."""
DAMPING = (1e-2, 1e-1)
"""Of Levenberg and Marquardt: first and largest; grows by 4 when a step is longer than the one
before.
"""
PROXIMAL = 1e-6
"""Damping of every step, which moves no solution: inputs that the errors do not feel (late in the
horizon, or more of them than is tracked) stay, where barriers would push them about at each step.
"""


@dataclass(frozen=True)
class SqpOutcome:
    """How a solve ended. ``step``: what the last iteration found to change, see QpStep."""

    usable: bool
    converged: bool
    iterations: int
    step: float
    qp_seconds: float
    work: int = 0
    """Iterations of the interior-point method in all quadratic programs, where known."""


GAP = 1e-8
"""Mean complementarity that ends a quadratic program: leaves 1e-5 (scaled) in the step, below
what SQP looks at."""
LEFT, WORK, BROKEN, CHANGE = 0, 2, 3, 6
"""Places among the facts of a quadratic program: defects left, iterations, largest violation, how
much the step changes.
"""


class MachineStep:
    """The step from ``point.unknowns``, left in ``direction``; slacks stay where they are, as the
    Riccati interior point finds them anew.

    A call, with the damping added to the Hessian's diagonal and the most iterations that the
    interior point may take, returns (largest violation of limits and defects by the step, in units
    of nominal; how much it changes, see QpStep; its iterations; seconds).
    """

    def __init__(self, point: TrackingPoint, direction: Array, step: ca.Function) -> None:
        """step : of :func:`machine_step`."""
        self._point, p = point, point.program
        moved = p.nx + len(p.rated) + p.nu
        self._at = np.ascontiguousarray(p.at[:moved].T).ravel()
        self._end = p.at_last[: p.nx]
        self._step = Buffered(step)
        self._step.arguments[4][:] = [b.value / b.limit.variable.nominal for b in bounds_of(p)]
        # the given start stands behind the unknowns, and its step, which is 0, behind theirs
        self._direction, self._whole = direction, np.zeros(len(point.unknowns))

    def __call__(self, damping: float, most: float) -> tuple[float, float, int, float]:
        begin = perf_counter()
        point, step = self._point, self._step
        y, end, references, q, _, more, iterations = step.arguments
        np.take(point.unknowns, self._at, out=y)
        np.take(point.unknowns, self._end, out=end)
        references[:], q[:], more[:] = point.references.ravel(), point.given, damping
        iterations[:] = min(max(most, 1), ITERATIONS)
        step.call()
        dy, dy_end, facts = step.results
        self._whole[self._at] = dy.T.ravel()
        self._whole[self._end] = dy_end[:, 0]
        self._direction[:] = self._whole[: len(self._direction)]
        told = facts[:, 0].tolist()
        # a sum shows what is no number, which a maximum may hide
        miss = max(told[LEFT], told[BROKEN]) + 0.0 * float(np.sum(self._direction))
        return miss, told[CHANGE], int(told[WORK]), perf_counter() - begin


def machine_step(program: TrackingProgram) -> ca.Function:
    """(y, end, references, q, bounds, damping, most iterations) -> (dy, dy at the end, facts), see
    RiccatiQp.
    """
    p, n, ends = program, program.horizon, bounds_of(program)
    qp = RiccatiQp(p, ca.SX.sym("bounds", len(ends)), *sides_of(p, ends), gap=GAP)
    y, end = ca.MX.sym("y", p.nx + len(p.rated) + p.nu, n), ca.MX.sym("end", p.nx)
    references = ca.MX.sym("references", len(p.penalties), n + 1)
    q, bounds = ca.MX.sym("q", p.q.numel()), ca.MX.sym("bounds", len(ends))
    damping = ca.MX.sym("damping")
    given, most = [y, end, references, q, bounds, damping], ca.MX.sym("most")
    found = qp.solve(*qp.write(*given), most)
    return ca.Function("sqp_step", [*given, most], list(found))


QP_SOLVERS: Registry[Callable[[TrackingProgram], ca.Function]] = Registry("QP solver", __package__)
"""What solves the quadratic programs: a Function (h, gradient, a, lba, uba, lbx, ubx) -> x, ..."""


@QP_SOLVERS.register("piqp")
def piqp(program: TrackingProgram) -> ca.Function:
    """PIQP, a proximal interior-point method, through CasADi."""
    return conic(program, "piqp")


@QP_SOLVERS.register("hpipm")
def hpipm(program: TrackingProgram) -> ca.Function:
    """HPIPM, stage by stage: called directly if its library is present, else through CasADi."""
    return conic(program, "hpipm", {**program.dimensions, "hpipm": HPIPM})


def conic(
    program: TrackingProgram, plugin: str, options: dict[str, Any] | None = None
) -> ca.Function:
    """A QP solver of CasADi. Wrapped: a bare one overwrites the pointers that a buffer keeps."""
    p = program
    chosen: dict[str, Any] = {"error_on_fail": False, "print_time": False, **(options or {})}
    solver = qp_solver("qp", plugin, {"h": p.h_sparsity, "a": p.a_sparsity}, chosen)
    rows = len(p.a_low)
    h, a = ca.MX.sym("h", p.h_sparsity), ca.MX.sym("a", p.a_sparsity)
    g, lba, uba, lbx, ubx = (ca.MX.sym("v", n) for n in (p.size, rows, rows, p.size, p.size))
    out = solver(h=h, g=g, a=a, lba=lba, uba=uba, lbx=lbx, ubx=ubx)
    # HPIPM's interface writes its multipliers even where nobody asks for them
    results = [out["x"], out["lam_a"], out["lam_x"]]
    return ca.Function("step", [h, g, a, lba, uba, lbx, ubx], results)


class QpStep:
    """The step from ``point.unknowns`` by evaluating there and solving the quadratic program.

    A call, with the damping added to the Hessian's diagonal, leaves ``direction`` and returns
    (largest violation of rows by it, scaled by nominals: solvers disagree on how they report
    failure; how much it changes; iterations of the interior point, where known; seconds in the
    solver). How many of them it may take was settled when the solver was made.

    How much it changes is the largest of three, scaled by nominals: the weighted errors that the
    program minimises (root mean square over the horizon), the inputs at the first node, which are
    applied, and the rows' violations that it takes away. Inputs late in the horizon that these do
    not feel have no place of their own, and wander without end.
    """

    def __init__(self, point: TrackingPoint, direction: Array, solver: str) -> None:
        self._point, self._direction = point, direction
        rows, columns = point.program.h_entries
        self._diagonal = np.flatnonzero(rows == columns)
        self._of_errors = np.flatnonzero(~np.isin(columns, point.program.slacks))
        self._h_rows, self._h_columns = rows[self._of_errors], columns[self._of_errors]
        self._first = point.program.first_inputs
        self._stages: StageQp | None = None
        if solver == "hpipm" and available():
            self._stages = self._call = StageQp(point, direction)
            return
        self._buffer, self._call = QP_SOLVERS[solver](point.program).buffer()
        for i, argument in enumerate(
            (point.h, point.gradient, point.a, point.a_low, point.a_high, point.w_low, point.w_high)
        ):
            self._buffer.set_arg(i, memoryview(argument))  # type: ignore
        self._buffer.set_res(0, memoryview(direction))  # type: ignore

    def __call__(self, damping: float, most: float) -> tuple[float, float, int, float]:
        self._point()
        self._point.h[self._diagonal] += damping
        begin = perf_counter()
        self._call()
        spent = perf_counter() - begin
        self._point.h[self._diagonal] -= damping
        count = self._stages.iterations if self._stages else 0
        return self._miss(), self._change(), count, spent

    def _change(self) -> float:
        point, p, d = self._point, self._point.program, self._direction
        square = float(np.dot(point.h[self._of_errors] * d[self._h_rows], d[self._h_columns]))
        violated = max(np.max(point.a_low, initial=0.0), np.max(-point.a_high, initial=0.0))
        first = np.max(np.abs(d[self._first]))
        return float(max(math.sqrt(max(square, 0.0) / p.error_scale), first, violated))

    def _miss(self) -> float:
        p, point = self._point.program, self._point
        rows = np.bincount(p.a_rows, point.a * self._direction[p.a_columns], minlength=len(p.a_low))
        # np.max of a NaN is one
        return float(np.maximum(np.max(point.a_low - rows), np.max(rows - point.a_high)))


class Sqp:
    """Full Gauss-Newton steps from where ``point`` stands, a QP each, until they change little.

    The Gauss-Newton Hessian leaves out the curvature of the constraints; where that makes steps
    cycle, damping is added, which slows them down and does not move the solution.
    """

    def __init__(
        self,
        program: TrackingProgram,
        solver: QpSolver | None,
        tolerance: float,
        compiled: bool | None = False,
    ) -> None:
        """solver : None: "hpipm", or the step as one Function of machine code, see ``compiled``."""
        if solver is not None and solver not in QP_SOLVERS:
            names = ", ".join(repr(name) for name in QP_SOLVERS)
            raise InputError(f"solver = {solver!r}: choose {names}, 'riccati' or 'ipopt'")
        require_flag("compiled", compiled, "where it is in the cache")
        self.tolerance = tolerance
        self.direction = np.zeros(program.size)
        whole = None
        if solver is None and compiled is not False:
            whole = machine_function(machine_step(program), build=bool(compiled))
        self.point = TrackingPoint(program, compiled if whole is None else False)
        self._step: Callable[[float, float], tuple[float, float, int, float]]
        if whole is None:
            self._step = QpStep(self.point, self.direction, solver or "hpipm")
        else:
            self._step = MachineStep(self.point, self.direction, whole)

    def solve(self, iterations: int, work: float = np.inf) -> SqpOutcome:
        """At most so many steps from ``point.unknowns``, which is left at the solution.

        No further step is begun after ``work`` iterations of the interior-point method in all; one
        that is cut off at ``OVER`` times that, where it can be, before it was solved is not taken.
        Where a later program has no solution, the point at which least was left to change is.
        """
        point, spent, before, damping, done = self.point, 0.0, np.inf, PROXIMAL, 0
        best = np.inf, point.w
        for k in range(1, iterations + 1):
            most = math.inf if k == 1 else OVER * work - done
            miss, size, count, seconds = self._step(damping, most)
            spent += seconds
            done += count
            if not miss <= MISS and k > 1 and done >= OVER * work:
                return SqpOutcome(True, False, k - 1, before, spent, done)
            if not miss <= MISS and best[0] < np.inf:
                point.w[:] = best[1]
                return SqpOutcome(True, False, k - 1, best[0], spent, done)
            if not miss <= MISS:  # NaN, too
                return SqpOutcome(False, False, k, np.inf, spent, done)
            if k > 1 and size < best[0]:
                best = size, point.w.copy()
            point.w += self.direction
            if size <= self.tolerance:
                return SqpOutcome(True, True, k, size, spent, done)
            if done >= work:
                break
            if size > before:
                damping = min(max(4 * damping, DAMPING[0]), DAMPING[1])
            before = size
        return SqpOutcome(True, False, k, size, spent, done)


def _infinite(bounds: Array) -> Array:
    """Bounds of the QP with its stand-in for infinity taken back."""
    open_ends: Array = np.copysign(np.inf, bounds)
    return np.where(np.abs(bounds) >= UNBOUNDED, open_ends, bounds)


LONGEST = 2.0
"""Processor seconds of one solve by IPOPT; a controller that waits longer has lost its plant."""


class TrackingIpopt:
    """The same program by IPOPT with exact Hessian: slower, and sure. Made at its first use."""

    def __init__(self, program: TrackingProgram) -> None:
        self.program = p = program
        n, inner, last = p.horizon, p.inner, p.last
        w, start = ca.MX.sym("w", p.size), ca.MX.sym("start", p.nx + len(p.rated))
        references = ca.MX.sym("r", len(p.penalties), n + 1)
        q = ca.MX.sym("q", len(p.given.names))
        everything = ca.vertcat(w, start, 0)
        y = ca.reshape(everything[p.at.T.ravel().tolist()], p.y_size, n)
        values = inner.values.map(n)(y, references[:, :n], ca.repmat(q, 1, n))
        end = last.values(everything[p.at_last.tolist()], references[:, n], q)
        split, size, end_size = inner.size * n, values.shape[0], end.shape[0]
        results = ca.vertcat(ca.vec(values), end, 0)
        at = np.where(
            p.value_at < split,
            p.value_at // inner.size * size + p.value_at % inner.size,
            size * n + np.minimum(p.value_at - split, end_size),
        )
        nlp: dict[str, Any] = {
            "x": w,
            "p": ca.veccat(start, references, q),
            "f": ca.sum2(values[size - 1, :]) + end[end_size - 1],
            "g": results[at.tolist()] - everything[p.other_at.tolist()],
        }
        ipopt: dict[str, Any] = {"tol": 1e-6, "max_iter": 200, "mu_init": 1e-2}
        options = quiet_ipopt({"expand": True}, **ipopt, max_cpu_time=LONGEST)
        self._solver = nlpsol("mpc", "ipopt", nlp, options)
        self._bounds = {
            "lbx": _infinite(p.w_low),
            "ubx": _infinite(p.w_high),
            "lbg": _infinite(p.a_low),
            "ubg": _infinite(p.a_high),
        }

    def solve(self, point: TrackingPoint) -> SqpOutcome:
        """From ``point.unknowns``, which is left at the solution when there is one."""
        begin = perf_counter()
        guess = np.where(np.isfinite(point.w), point.w, 0.0)
        p = np.concatenate([point.start, point.references.ravel(), point.given])
        result = self._solver(x0=guess, p=p, **self._bounds)
        stats = self._solver.stats()
        if stats["success"]:
            point.w[:] = np.asarray(result["x"]).ravel()
        spent = perf_counter() - begin
        return SqpOutcome(
            bool(stats["success"]), bool(stats["success"]), int(stats["iter_count"]), 0.0, spent
        )
