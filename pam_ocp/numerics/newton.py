"""Newton's method, with an honest reason when it fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import PamError
from ..core.stop import check

Array: TypeAlias = NDArray[np.float64]
Equations: TypeAlias = Callable[[Array], tuple[Array, Callable[[Array], Array]]]
"""w -> (residual, solver): solver(right) is the step with Jacobian . step = right."""

HALVINGS = 11
"""How often a step is halved, at most, to lessen the residual."""


class NewtonError(PamError):
    """Newton's method found no root; says why.

    ``last`` : the unknowns where it gave up, or None.
    """

    def __init__(self, message: str, last: Array | None = None) -> None:
        super().__init__(message)
        self.last = last


@dataclass(frozen=True)
class Root:
    """Where Newton's method ended."""

    w: Array
    size: float
    """Largest residual there; infinite where it is no number."""
    reason: str = ""
    """Why it is no root; "" when it is one."""


def newton(
    equations: Equations, w: Array, *, tolerance: float = 1e-12, steps: int = 30
) -> tuple[Array, float]:
    """Solve equations(w) = 0 by damped steps; ``equations`` gives residual and Jacobian's solver.

    Steps are halved while they do not lessen the residual. Ends when the residual is below
    ``tolerance``, or at the level of rounding (below 100 times it, and no step helps any more).
    Returns (w, largest residual); NewtonError with the reason otherwise.
    """
    root = iterate(equations, w, tolerance=tolerance, steps=steps)
    if root.reason:
        raise NewtonError(root.reason, root.w)
    return root.w, root.size


def iterate(
    equations: Equations,
    w: Array,
    *,
    tolerance: float = np.inf,
    settled: float = np.inf,
    steps: int = 30,
    halvings: int = HALVINGS,
    longest: float = np.inf,
    within: tuple[Array, Array] | None = None,
) -> Root:
    """Newton's method wherever it leads: for searches that go on from the last point themselves.

    tolerance, settled : a root has no larger residual, and the next step moves no unknown by more;
        one of the two is finite.
    steps : at most. halvings : of a step that does not lessen the residual; with 0 all steps are
        full, whatever the residual does.
    longest : a step's largest entry; longer ones are shortened. within : (lowest, highest) values
        of the unknowns, which every step keeps.
    """
    residual, solve = equations(w)
    size = _largest(residual)
    if not np.isfinite(size):
        return Root(w, size, "the equations give no finite numbers at the starting guess")
    for count in range(steps):
        check()
        if size <= tolerance and settled == np.inf:
            return Root(w, size)
        try:
            step = solve(residual)
        except (RuntimeError, np.linalg.LinAlgError):
            return Root(w, size, f"the Jacobian is singular at Newton step {count + 1}")
        step = step * min(1.0, longest / max(_largest(step), 1e-300))
        if size <= tolerance and _largest(_moved(w, step, within) - w) <= settled:
            return Root(w, size)
        for halving in range(halvings + 1):
            trial = _moved(w, step * 0.5**halving, within)
            trial_residual, trial_solve = equations(trial)
            trial_size = _largest(trial_residual)
            if trial_size < size or not halvings:
                break
        else:
            break
        w, residual, solve, size = trial, trial_residual, trial_solve, trial_size
        if not np.isfinite(size):
            return Root(w, size, f"no finite numbers are left at Newton step {count + 1}")
    if size <= 100 * tolerance and settled == np.inf:
        return Root(w, size)
    above = f", above {tolerance:.0e}" if np.isfinite(tolerance) else ""
    return Root(
        w,
        size,
        f"Newton's method stops at a residual of {size:.1e} (scaled by nominals){above}",
    )


def _moved(w: Array, step: Array, within: tuple[Array, Array] | None) -> Array:
    return w - step if within is None else np.clip(w - step, *within)


def casadi_equations(function: ca.Function, *constants: Any) -> Equations:
    """Equations for :func:`newton` of a function (w, *constants) -> (residual, Jacobian in w)."""

    def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
        residual, jacobian = (np.asarray(m) for m in function(w, *constants))
        return residual.ravel(), lambda right: np.linalg.solve(jacobian, right)

    return equations


def least_squares(jacobian: Array, rcond: float | None = None) -> Callable[[Array], Array]:
    """The solver of a Jacobian of any shape or rank: shortest steps of least squares."""

    def solve(right: Array) -> Array:
        if not np.isfinite(jacobian).all():
            raise np.linalg.LinAlgError("the Jacobian is not finite")
        return np.asarray(np.linalg.lstsq(jacobian, right, rcond=rcond)[0], dtype=float)

    return solve


def _largest(residual: Array) -> float:
    size = np.max(np.abs(residual), initial=0.0)
    return float(size) if np.isfinite(size) else float("inf")
