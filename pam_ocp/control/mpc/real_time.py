"""A model predictive controller's call as one Function: no heap, no clock, a bounded worst case.

Real-time iteration (M. Diehl, H. G. Bock, J. P. Schloeder, SIAM J. Control Optim. 43, 2005): the
last solution one step on, at most so many SQP steps from there, and its first inputs; what is
carried from call to call is the solution itself.
"""

from __future__ import annotations

import math
from time import perf_counter

import casadi as ca
import numpy as np

from ...export.machine import quick
from ...numerics.bounded_loop import inlined, repeated
from ...numerics.portable import portable
from ...numerics.solvers import Buffered
from ..kinds import Array
from .riccati import ITERATIONS, RiccatiQp
from .shooting import TrackingPoint, TrackingProgram, bounds_of, sides_of
from .sqp import DAMPING, MISS, PROXIMAL, SqpOutcome

LARGEST = 1e300
"""What is not below it is no number."""
PATIENCE = 10
"""Calls in a row whose quadratic programs may fail before the fallback is sent."""
FACTS = (
    "status",
    "iterations",
    "work",
    "last_step",
    "converged",
    "active",
    "violation",
    "missing",
    "failures",
)
"""What a call tells of itself, see RealTimeIteration."""
SOLVED, UNFINISHED, SHIFTED, SAFE = range(4)


class RealTimeIteration:
    """(memory, x, applied, references, q, bounds, safe) -> (memory, inputs, facts).

    x : measured state [SI]; an entry that is not finite is replaced by the model's prediction.
    references (tracked, horizon + 1), q : [SI]. bounds : of :attr:`bounds`, [SI]. safe : inputs
    to apply where nothing else is left [SI]. inputs : to apply [SI].

    facts : see FACTS. ``status`` is 0 where the tolerance was met, 1 where the SQP steps or their
    ``work`` were used up before, 2 where a quadratic program failed and the plan of the call before
    is followed, 3 where more than ``patience`` failed in a row: the safe inputs. After a failure
    the next call begins anew, from the state and the inputs as they are. ``active`` counts the
    limits that hold the plan back, ``violation`` is the largest by which a soft one gives way, in
    units of nominal.

    applied : inputs that act now [SI]. Memory holds the solution (states and inputs, node after
    node, scaled), the state expected at the next call, and whether there is a solution, how many
    calls in a row missed a measurement, how many failed.
    """

    def __init__(
        self,
        program: TrackingProgram,
        *,
        iterations: int,
        work: float,
        tolerance: float,
        delay: int,
        patience: int,
    ) -> None:
        self.program, self.delay, self.patience = program, delay, patience
        self.iterations, self.work, self.tolerance = iterations, work, tolerance
        p = program
        self.bounds = bounds_of(p)
        values = ca.SX.sym("bounds", len(self.bounds))
        self._nominal = np.array([b.limit.variable.nominal for b in self.bounds])
        self.qp = RiccatiQp(p, values, *sides_of(p, self.bounds))
        after = [p.step.expression(p.given, p.x, p.u, p.q)]
        self._advance = portable(ca.Function("advance", [p.x, p.u, p.q], after))
        n, nx, nu = p.horizon, p.nx, p.nu
        self.sizes = {
            "states": nx * (n + 1),
            "inputs": nu * n,
            "expected": nx,
            "counts": 3,
        }
        self.step = self._step()

    @property
    def worst_work(self) -> int:
        """Iterations of the interior-point method in one call: never more."""
        most = self.iterations * ITERATIONS
        return int(min(most, self.work - 1 + ITERATIONS))

    def start(self, x: Array) -> Array:
        """The memory before the first call, from a state [SI]."""
        memory: Array = np.zeros(sum(self.sizes.values()))
        memory[self.places()["expected"]] = x / self.program.x_nominal
        return memory

    def places(self) -> dict[str, slice]:
        """Where each part stands in the memory."""
        ends = np.cumsum([0, *self.sizes.values()]).tolist()
        return {n: slice(a, b) for n, a, b in zip(self.sizes, ends[:-1], ends[1:], strict=True)}

    # ---- one call -------------------------------------------------------------------------------
    def _step(self) -> ca.Function:
        p, n = self.program, self.program.horizon
        memory = ca.MX.sym("memory", sum(self.sizes.values()))
        x_si, safe_si = ca.MX.sym("x", p.nx), ca.MX.sym("safe", p.nu)
        applied_si = ca.MX.sym("applied", p.nu)
        references = ca.MX.sym("references", len(p.penalties), n + 1)
        q, bounds_si = ca.MX.sym("q", p.q.numel()), ca.MX.sym("bounds", len(self.bounds))
        bounds, safe = bounds_si / self._nominal, safe_si / p.u_nominal
        part = {name: memory[at] for name, at in self.places().items()}
        before, applied = ca.reshape(part["states"], p.nx, n + 1), applied_si / p.u_nominal
        warm, missing, failures = ca.vertsplit(part["counts"])

        present = ca.fabs(x_si) <= LARGEST
        now = ca.if_else(present, x_si / p.x_nominal, part["expected"])
        missing = ca.if_else(ca.sum1(present) == p.nx, 0, missing + 1)
        start = self._advance(now, applied, q) if self.delay else now
        states, inputs = self._guess()(
            before, ca.reshape(part["inputs"], p.nu, n), start, applied, warm, q
        )
        begun = ca.DM([PROXIMAL, math.inf, 0, 0, 0, 0, 0, 0, 0])
        given = [states, inputs, begun, start, applied, references, q, bounds]
        found, chosen, told = inlined(self._sqp(), given)
        # begun: damping, step, work, iterations, finished, usable, active, violation, converged
        usable, converged = told[5], told[8]
        failures = ca.if_else(usable, 0, failures + 1)
        lost = failures > self.patience
        states = ca.if_else(usable, found, states)
        inputs = ca.if_else(usable, chosen, inputs)
        first = ca.if_else(lost, safe, self._held(inputs[:, 0], bounds))
        after = self._advance(now, applied if self.delay else first, q)
        expected = ca.if_else(ca.fabs(after) <= LARGEST, after, now)
        counts = ca.vertcat(usable, missing, failures)
        status = ca.if_else(converged, SOLVED, UNFINISHED)
        status = ca.if_else(lost, SAFE, ca.if_else(usable, status, SHIFTED))
        facts = [status, told[3], told[2], told[1], converged, told[6], told[7], missing, failures]
        return ca.Function(
            "mpc",
            [memory, x_si, applied_si, references, q, bounds_si, safe_si],
            [
                ca.vertcat(ca.vec(states), ca.vec(inputs), expected, counts),
                first * p.u_nominal,
                ca.vertcat(*facts),
            ],
            ["memory", "x", "applied", "references", "q", "bounds", "safe"],
            ["memory_next", "inputs", "facts"],
        )

    def _guess(self) -> ca.Function:
        """The last solution one step on; at first the state and the inputs as they are."""
        p, n = self.program, self.program.horizon
        states, inputs = ca.MX.sym("states", p.nx, n + 1), ca.MX.sym("inputs", p.nu, n)
        start, applied = ca.MX.sym("start", p.nx), ca.MX.sym("applied", p.nu)
        warm, q = ca.MX.sym("warm"), ca.MX.sym("q", p.q.numel())
        end, last = states[:, n], inputs[:, n - 1]
        after = self._advance(end, last, q)
        after = ca.if_else(ca.fabs(after) <= LARGEST, after, end)
        shifted = ca.if_else(warm, ca.horzcat(states[:, 2:], after), ca.repmat(start, 1, n))
        chosen = ca.if_else(warm, ca.horzcat(inputs[:, 1:], last), ca.repmat(applied, 1, n))
        return ca.Function(
            "guess",
            [states, inputs, start, applied, warm, q],
            [ca.horzcat(start, shifted), chosen],
        )

    def _sqp(self) -> ca.Function:
        """Gauss-Newton steps: (states, inputs, told, given...) -> (states, inputs, told)."""
        p, n, qp = self.program, self.program.horizon, self.qp
        states, inputs = ca.MX.sym("states", p.nx, n + 1), ca.MX.sym("inputs", p.nu, n)
        told = ca.MX.sym("told", 9)
        start, applied = ca.MX.sym("start", p.nx), ca.MX.sym("applied", p.nu)
        references = ca.MX.sym("references", len(p.penalties), n + 1)
        q, bounds = ca.MX.sym("q", p.q.numel()), ca.MX.sym("bounds", len(self.bounds))
        damping, before, done, count = (told[i] for i in range(4))
        rated = ca.horzcat(applied, inputs[:, : n - 1])[p.rated, :] if p.rated else ca.MX(0, n)
        y = ca.vertcat(states[:, :n], rated, inputs)
        data = qp.write(y, states[:, n], references, q, bounds, damping)
        dy, dy_end, facts = inlined(qp.solve, [*data, ITERATIONS])
        share, miss, size = facts[0], facts[3], facts[6]
        finite = ca.sum1(ca.sum2(ca.fabs(dy))) + ca.sum1(ca.fabs(dy_end)) <= LARGEST
        usable = ca.logic_and(finite, ca.fmax(miss, share) <= MISS)
        moved = ca.horzcat(states[:, :n] + dy[: p.nx, :], states[:, n] + dy_end)
        chosen = inputs + dy[p.nx + len(p.rated) :, :]
        done, small = done + facts[2], size <= self.tolerance
        converged = ca.logic_and(usable, small)
        finished = ca.logic_or(ca.logic_or(converged, done >= self.work), ca.logic_not(usable))
        grown = ca.fmin(ca.fmax(4 * damping, DAMPING[0]), DAMPING[1])
        damping = ca.if_else(size > before, grown, damping)
        after = [damping, size, done, count + 1, finished, usable, facts[4], facts[5], converged]
        given = [start, applied, references, q, bounds]
        body = ca.Function(
            "sqp", [states, inputs, told, *given], [moved, chosen, ca.vertcat(*after)]
        )
        if self.iterations == 1:
            return body
        return repeated(body, 3, self.iterations, ca.logic_not(told[4]), [states, inputs, told])

    def _held(self, inputs: ca.MX, bounds: ca.MX) -> ca.MX:
        """Inputs kept to their bounds against rounding."""
        names = [v.name for v in self.program.given.controls]
        rows = [inputs[i] for i in range(len(names))]
        for k, bound in enumerate(self.bounds):
            if bound.limit.variable.name in names and not bound.limit.soft:
                i = names.index(bound.limit.variable.name)
                rows[i] = (ca.fmin if bound.high else ca.fmax)(rows[i], bounds[k])
        return ca.MX(ca.vertcat(*rows))


class RealTimeCalls:
    """Calls of a RealTimeIteration in turn, with the memory between them."""

    def __init__(self, core: RealTimeIteration, compiled: bool | None = False) -> None:
        """compiled : the call as machine code (None: where it is there)."""
        self.core, self._step = core, Buffered(quick(core.step, compiled))
        self._bounds = np.array([b.value for b in core.bounds])
        self._places = core.places()

    def reset(self, x: Array, safe: Array) -> None:
        """Forget the solution; ``x`` [SI] stands in for what was never measured."""
        self._memory, self._safe = self.core.start(x), safe

    def __call__(self, point: TrackingPoint, x: Array, applied: Array) -> SqpOutcome:
        """One call from a state, under inputs [SI]; leaves its solution in ``point``."""
        p = self.core.program
        begin = perf_counter()
        memory, _, told = self._step(
            self._memory,
            x,
            applied,
            point.references.ravel(),
            point.given,
            self._bounds,
            self._safe,
        )
        spent = perf_counter() - begin
        self._memory = memory[:, 0].copy()
        states, inputs = (
            self._memory[self._places[n]].reshape(-1, size)
            for n, size in (("states", p.nx), ("inputs", p.nu))
        )
        before = np.vstack([applied / p.u_nominal, inputs[:-1]])[:, p.rated]
        point.unknowns[p.at[: p.nx + len(p.rated) + p.nu]] = np.hstack(
            [states[:-1], before, inputs]
        ).T
        point.unknowns[p.at_last[: p.nx]] = states[-1]
        facts = dict(zip(FACTS, told[:, 0].tolist(), strict=True))
        return SqpOutcome(
            facts["status"] <= UNFINISHED,
            bool(facts["converged"]),
            int(facts["iterations"]),
            facts["last_step"],
            spent,
            int(facts["work"]),
        )
