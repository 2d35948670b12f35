"""A step of the SQP as one Function of machine code: evaluation and QP in a single call."""

from __future__ import annotations

from time import perf_counter
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...export.machine import machine_function
from ...numerics.buffered import Buffered
from .limit_sides import bounds_of, sides_of
from .riccati import ITERATIONS, RiccatiQp
from .shooting import TrackingPoint, TrackingProgram

__all__ = ["MachineStep", "machine_step"]

Array: TypeAlias = NDArray[np.float64]

GAP = 1e-8
"""Mean complementarity that ends a quadratic program: leaves 1e-5 of nominal in the step, below
what SQP looks at."""
SHARE, WORK, MISS, CHANGE = 0, 2, 3, 6
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
        miss = max(told[SHARE], told[MISS]) + 0.0 * float(np.sum(self._direction))
        return miss, told[CHANGE], int(told[WORK]), perf_counter() - begin


def machine_step(program: TrackingProgram, compiled: bool | None) -> ca.Function | None:
    """(y, end, references, q, bounds, damping, most iterations) -> (dy, dy at the end, facts), see
    RiccatiQp.

    compiled : True: built if need be; None: None where it is not in the cache. Raises InputError
    where it is to be built and cannot be.
    """
    return None if compiled is False else machine_function(_step(program), build=bool(compiled))


def _step(program: TrackingProgram) -> ca.Function:
    p, n = program, program.horizon
    count = len(bounds_of(p))
    values = ca.SX.sym("bounds", count)
    qp = RiccatiQp(p, values, *sides_of(p, bounds_of(p)), gap=GAP)
    y, end = ca.MX.sym("y", p.nx + len(p.rated) + p.nu, n), ca.MX.sym("end", p.nx)
    references = ca.MX.sym("references", len(p.penalties), n + 1)
    q, bounds = ca.MX.sym("q", p.q.numel()), ca.MX.sym("bounds", count)
    damping = ca.MX.sym("damping")
    given, most = [y, end, references, q, bounds, damping], ca.MX.sym("most")
    found = qp.solve(*qp.write(*given), most)
    return ca.Function("sqp_step", [*given, most], list(found))
