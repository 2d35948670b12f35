"""Least squares of dynamic fits: damped Gauss-Newton (Levenberg, Marquardt) from normal equations,
within bounds; IPOPT where the plant's states are unknown, too.

For residuals too many to be held: what comes in is their sum of squares, its gradient and the
normal matrix (J. Nocedal, S. Wright, Numerical Optimization, 2006, 10.3). The best that was seen is
kept, whatever ends the search.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from ...core.errors import FitError, InputError
from ...core.stop import TimeIsUp, check, spared
from ...numerics.solvers import nlpsol, quiet_ipopt
from ..statistics import Array
from .transcribe import FitProgram, Program

Result = TypeVar("Result")
GRACE = 20.0
"""For what is told of a fit that a time limit ended [s]."""
LEAST, MOST = 1e-8, 1e8
"""Of the damping, in parts of the normal matrix' diagonal."""
FIRST = 1e-3
"""The same of the first step."""
ENOUGH = 1e-5
"""Relative gain of a step below which the search ends."""
FEWER = 6
"""Fits with one unknown less that are tried as starts, at most."""
TRIES = 8
"""Steps from one point, each damped more, before the search ends there."""


class Normal(Protocol):
    """A sum of squares: ``cost(z)``, and ``normal(z)`` = (cost, J^T r, J^T J, rows damped)."""

    def cost(self, z: Array, /) -> float: ...

    def normal(self, z: Array, /) -> tuple[float, Array, Array, int]: ...


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the search ended, and why. damped : of the last point, see :class:`Normal`."""

    z: Array
    cost: float
    evaluations: int
    status: str
    converged: bool
    damped: int
    timed: bool = False
    """Whether a time limit ended the search."""


def descend(
    problem: Normal,
    z: Array,
    low: Array,
    high: Array,
    evaluations: int,
    *,
    enough: float = ENOUGH,
    damping: float = FIRST,
    progress: Callable[[int, float, Array], None] | None = None,
) -> Descent:
    """Least squares from z; at most so many ``evaluations`` of the normal matrix. enough : relative
    gain of a step below which the search ends. damping : of the first step, in parts of the normal
    matrix' diagonal. progress : called with (evaluations, cost, z) at new points. A time limit does
    not raise when there is a point to show.
    """
    z, growth = np.clip(z, low, high), 4.0
    best, count, damped = (problem.cost(z), z), 0, 0
    timed = False
    status, converged = f"stopped after {evaluations} evaluations", False
    try:
        while count < evaluations:
            cost, gradient, square, damped = problem.normal(z)
            count += 1
            if progress is not None:
                progress(count, cost, z)
            accepted = False
            for _ in range(TRIES):
                check()
                step = _step(z, gradient, square, damping, low, high)
                expected = -(gradient @ step + step @ square @ step / 2)
                if not expected > 1e-3 * enough * cost:
                    break
                trial = np.clip(z + step, low, high)
                found = problem.cost(trial)
                if np.isfinite(found) and found < cost:
                    accepted, growth = True, 4.0
                    share = (cost - found) / (2 * expected)
                    damping = max(LEAST, damping * max(1 / 9, float(1 - (2 * share - 1) ** 3)))
                    break
                damping = min(MOST, damping * growth)
                growth *= 2
            if not accepted:
                status, converged = "no step leads further down", True
                break
            gain, z = (cost - found) / max(cost, 1e-300), trial
            best = (found, z)
            if gain < enough:
                status, converged = f"a step gains less than {enough:g} of the cost", True
                break
    except TimeIsUp:
        if not count:
            raise
        status = "the time limit ended the search; the best until then is kept"
        timed = True
    return Descent(best[1], best[0], count, status, converged, damped, timed)


def from_fewer(
    best: Result,
    cost: Callable[[Result], float],
    places: Sequence[int],
    without: Callable[[int], Result],
    again: Callable[[Result], Result],
) -> Result:
    """The best, or what is found from where a better fit with one unknown less leads: no freedom
    makes a fit worse. without : that fit, by place; again : with all unknowns, from there.
    """
    for place in list(places)[-FEWER:]:
        try:
            poorer = without(place)
            if cost(poorer) < cost(best):
                best = min(best, again(poorer), key=cost)
        except FitError:
            continue
        except TimeIsUp:
            break
    return best


def _step(
    z: Array, gradient: Array, square: Array, damping: float, low: Array, high: Array
) -> Array:
    """Minimiser of the damped model within the bounds; unknowns held back are taken out."""
    scale = np.sqrt(np.maximum(np.diag(square), 1e-12 * np.diag(square).max(initial=1e-300)))
    matrix = square / np.outer(scale, scale) + damping * np.eye(len(z))
    step, free = np.zeros(len(z)), np.ones(len(z), dtype=bool)
    lower, upper = (low - z) * scale, (high - z) * scale
    right = -gradient / scale
    for _ in range(len(z) + 1):
        inner = right[free] - matrix[np.ix_(free, ~free)] @ step[~free]
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], inner)
        out = free & ((step < lower) | (step > upper))
        if not out.any():
            break
        step[out] = np.clip(step[out], lower[out], upper[out])
        free &= ~out
    return np.asarray(step / scale)


LOG = logging.getLogger(__name__)
Report: TypeAlias = Callable[[str, int, float], Any]
"""Called with the stage, its iterations until now, and the cost."""
Progress: TypeAlias = "bool | Report"


def reporter(progress: Progress) -> Report:
    """What to call: nothing for False, a line on stderr for True, or the user's function."""
    if callable(progress):
        return progress
    if not isinstance(progress, bool):
        raise InputError(
            f"progress = {progress!r}: give True to print, or a function (stage, iteration, cost)"
        )
    return _printed if progress else _logged


def _logged(stage: str, count: int, cost: float) -> None:
    LOG.debug("%s, iteration %d: cost %.6g", stage, count, cost)


def _printed(stage: str, count: int, cost: float) -> None:
    print(f"{stage:<28} {count:>5}  {cost:.6g}", file=sys.stderr, flush=True)


# ---- damped Gauss-Newton -------------------------------------------------------------------------
LEVENBERG = 1e-6
"""Added to the diagonal of the Hessian: directions that no residual sees stay where they are."""
DONE = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
TIMED = "Time_Limit"
"""Status of a search that a time limit ended with something to show."""
CAREFUL = 1.0
"""Damping of the first step of a search through kinks, where long steps lead to other minima."""
EXACT = 1e-9
"""Relative gain of a step below which a search without defects ends."""
LOST = 1e6
"""Stands for an error, in nominals, that is no number: a motion that diverged is a bad one."""
DEFECT = 1e3
"""Weight of the largest defect (in nominals) against the cost, where iterates are compared."""


@dataclass(frozen=True, eq=False)
class GaussNewtonResult:
    """Scaled unknowns w, residuals without weights (K, ny) in nominals, and the solver's account.
    jumps : of disturbed states, in their standard deviations.
    """

    w: Array
    residuals: Array
    status: str
    iterations: int
    jumps: Array

    @property
    def found(self) -> bool:
        return self.status in DONE

    @property
    def timed(self) -> bool:
        """Whether a time limit ended it: the best until then."""
        return self.status == TIMED


def solve(
    program: Program,
    weights: Array,
    guess: Array,
    iterations: int | None = None,
    report: Report | None = None,
    stage: str = "fit",
) -> GaussNewtonResult:
    """Least squares from a guess; with a limit of ``iterations`` only as far as these lead. Without
    states among the unknowns by :func:`descend`, else by IPOPT: first without the residuals'
    curvature (Gauss-Newton), and where that does not settle with the exact Hessian. report : called
    with ``stage``, iterations and cost. A time limit ends with the best that was seen.
    """
    if isinstance(program, FitProgram) and program.defects.numel():
        seen = _Seen(report, stage)
        first = _interior_point(program, weights, guess, False, iterations or 150, seen)
        if first.found or first.timed or iterations is not None:
            return first
        seen = _Seen(report, stage + ", curved")
        return _interior_point(program, weights, guess, True, 100, seen)

    def told(count: int, cost: float, _: Array) -> None:
        if report is not None:
            report(stage, count, cost / 2)

    found = descend(
        _Squares(program, weights),
        guess,
        program.low,
        program.high,
        iterations or 300,
        enough=EXACT,
        damping=CAREFUL,
        progress=told,
    )
    if found.timed:
        with spared(GRACE):
            return _solution(program, found.z, TIMED, found.evaluations)
    status = DONE[0] if found.converged else "Maximum_Iterations_Exceeded"
    return _solution(program, found.z, status, found.evaluations)


class _Seen:
    """The best of a search's iterates: least cost, with a price on what violates the equations."""

    def __init__(self, report: Report | None, stage: str) -> None:
        self._report, self._stage, self._count = report, stage, 0
        self._merit, self.w = np.inf, np.empty(0)

    def __call__(self, w: Any, cost: Any, defects: Any) -> None:
        self._count += 1
        gaps = np.abs(np.asarray(defects, dtype=float)).max(initial=0.0)
        value = float(cost)
        merit = value + DEFECT * float(gaps)
        if merit < self._merit:
            self._merit, self.w = merit, np.array(w, dtype=float).ravel()
        if self._report is not None:
            self._report(self._stage, self._count, value)

    def kept(self, program: Program) -> GaussNewtonResult:
        """The best until a time limit; TimeIsUp where there is none."""
        if not self.w.size:
            raise TimeIsUp
        with spared(GRACE):
            return _solution(program, self.w, TIMED, self._count)


def _interior_point(
    program: FitProgram, weights: Array, guess: Array, exact: bool, iterations: int, seen: _Seen
) -> GaussNewtonResult:
    key = (exact, iterations)
    if key not in program.solvers:
        program.solvers[key] = _ipopt(program, exact, iterations)
    solver, tell = program.solvers[key]
    tell.append(seen)
    try:
        answer = solver(x0=guess, p=weights, lbx=program.low, ubx=program.high, lbg=0.0, ubg=0.0)
    except TimeIsUp:
        return seen.kept(program)
    finally:
        tell.clear()
    statistics = solver.stats()
    return _solution(
        program,
        np.asarray(answer["x"]).ravel(),
        str(statistics["return_status"]),
        int(statistics["iter_count"]),
    )


def _ipopt(program: FitProgram, exact: bool, iterations: int) -> tuple[Any, list[_Seen]]:
    """A solver of the program, and whom it tells of its iterates (the last)."""
    tell: list[_Seen] = []
    w, residuals = program.w, program.residuals
    options = quiet_ipopt(
        tol=1e-8, max_iter=iterations, mu_strategy="adaptive", honor_original_bounds="yes"
    )
    if not exact:
        jacobian = program.slopes[0]
        factor, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", program.defects.numel())
        hessian = jacobian.T @ jacobian + LEVENBERG * ca.DM.eye(w.numel())
        options["hess_lag"] = ca.Function(
            "gauss_newton",
            [w, program.weights, factor, multipliers],
            [ca.triu(factor * hessian)],
            ["x", "p", "lam_f", "lam_g"],
            ["hess_gamma_x_x"],
        )
    nlp: Any = {"x": w, "p": program.weights, "f": ca.sumsqr(residuals) / 2, "g": program.defects}
    solver = nlpsol("fit", "ipopt", nlp, options, report=lambda x, f, g: tell[-1](x, f, g))
    return solver, tell


class _Squares:
    """The sum of squares of a program without defects, for :func:`descend`."""

    def __init__(self, program: Program, weights: Array) -> None:
        self._program, self._weights = program, weights

    def _errors(self, z: Array) -> Array:
        found = self._program.errors(z)[0]
        return np.where(np.isfinite(found), found, LOST)

    def cost(self, z: Array, /) -> float:
        return float(np.sum((self._errors(z) * self._weights) ** 2))

    def normal(self, z: Array, /) -> tuple[float, Array, Array, int]:
        errors = self._errors(z)
        r = (errors * self._weights).ravel()
        slope = np.nan_to_num(self._program.jacobian(self._weights, z, errors))
        return float(r @ r), slope.T @ r, slope.T @ slope, 0


def _solution(program: Program, found: Array, status: str, iterations: int) -> GaussNewtonResult:
    if not np.all(np.isfinite(found)):
        raise FitError("the fit left all finite numbers; start nearer with plant.with_values(...)")
    errors, jumps = program.errors(found)
    return GaussNewtonResult(found, errors, status, iterations, jumps)
