"""How far a point is from the optimality conditions, by the program's assembled derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...numerics.buffered import Buffered

__all__ = ["Optimality"]

Array: TypeAlias = NDArray[np.float64]


class Optimality:
    """Of one program's expressions: the judge of what a solver calls an optimum.

    gradient : (w, p) -> (f, gradient of f); jacobian : (w, p) -> (g, slopes of g).
    """

    def __init__(self, gradient: ca.Function, jacobian: ca.Function) -> None:
        self._gradient, self._jacobian = Buffered(gradient), _slopes(jacobian)
        rows, columns = jacobian.sparsity_out(1).get_triplet()
        self._rows, self._columns = np.array(rows, np.intp), np.array(columns, np.intp)

    def __call__(
        self, numbers: Mapping[str, Array], w: Array, lam_g: Array, lam_x: Array
    ) -> tuple[float, float, float]:
        """Largest (residual of stationarity, violation of rows and bounds, product of a multiplier
        and the distance from its limit), in units of nominals. NaN where one is none.

        numbers : parameters and limits, by CasADi's names ("p", "lbx", "ubx", "lbg", "ubg").
        """
        p = numbers["p"]
        gradient = self._gradient(w, p)[1].ravel()
        g, slopes = (each.ravel() for each in self._jacobian(w, p))
        pulls = np.bincount(self._columns, slopes * lam_g[self._rows], len(w))
        dual = float(np.max(np.abs(gradient + pulls + lam_x)))
        miss = gap = 0.0
        for values, lam, kind in ((g, lam_g, "g"), (w, lam_x, "x")):
            low, high = numbers[f"lb{kind}"], numbers[f"ub{kind}"]
            beyond = np.maximum(low - values, values - high)
            miss = max(miss, float(np.max(beyond, initial=0.0)))
            pressed = (low < high) & (lam != 0)
            far = np.where(lam > 0, high, low)[pressed] - values[pressed]
            gap = max(gap, float(np.max(np.abs(lam[pressed] * far), initial=0.0)))
        return dual, miss, gap


def _slopes(jacobian: ca.Function) -> Buffered:
    """The values, and the slopes' entries as a column."""
    w, p = (ca.MX.sym("v", jacobian.size1_in(i)) for i in range(2))
    g, slopes = jacobian(w, p)
    entries = slopes.nz[:] if slopes.nnz() else ca.MX(0, 1)
    return Buffered(ca.Function("slopes", [w, p], [ca.densify(g), entries]))
