"""A program in the order of its stages, as solvers that exploit this structure want it.

The unknowns are z = (X_0, U_0, X_1, U_1, ..., X_N), the constraints (X_1 - F_0, g_0, X_2 - F_1,
g_1, ..., g_N), and F_k, g_k and the cost of stage k depend on X_k and U_k alone (Vanroye et al.,
FATROP, IROS 2023). What holds for the whole motion is therefore carried along in the state X_k:
durations, design parameters, peaks, the first state (for closing a cycle), the input at the end of
the interval before, budgets spent. All of z are the program's own unknowns, or follow from them,
and all of its constraints stand here once: solutions and multipliers are exchanged by permutation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .transcription import Program

__all__ = ["NONE", "Staged"]

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]

NONE = -1
"""In place of an index: nothing of the program corresponds."""


@dataclass(frozen=True)
class Staged:
    """The stage-ordered form of a program.

    sizes : "N", and "nx", "nu", "ng" of each stage, under the names of CasADi's options.
    unknown : (z,) which unknown of the program each entry is.
    row : (g,) which constraint of the program each row is; sign : (g,) by which factor.
    spent, before : (k, 2) pairs (entry of z, its gap's row): budgets spent, inputs before.
    """

    program: Program
    nlp: dict[str, ca.MX]
    sizes: dict[str, Any]
    unknown: Index
    row: Index
    sign: Array
    spent: Index
    before: Index

    @cached_property
    def _constraints(self) -> ca.Function:
        return ca.Function("g", [self.nlp["x"], self.nlp["p"]], [self.nlp["g"]])

    @cached_property
    def first(self) -> Index:
        """Where each unknown of the program stands first in z."""
        values, at = np.unique(self.unknown, return_index=True)
        return np.asarray(at[values != NONE], dtype=np.intp)

    @cached_property
    def _held(self) -> Index:
        """Where each constraint of the program stands among the rows here."""
        values, at = np.unique(self.row, return_index=True)
        return np.asarray(at[values != NONE], dtype=np.intp)

    def bounds(self, program: Program) -> tuple[Array, Array]:
        """(low, high) of z: each unknown is bounded once, where it stands first."""
        both = []
        for limit, open_end in zip(program.bounds(), (-np.inf, np.inf), strict=True):
            z = np.full(len(self.unknown), open_end)
            z[self.first] = limit
            both.append(z)
        return both[0], both[1]

    def limits(self, program: Program) -> tuple[Array, Array]:
        """(low, high) of the rows."""
        both = []
        for limit in program.limits():
            g = np.zeros(len(self.row))
            g[self._held] = limit[self.row[self._held]]
            both.append(g)
        return both[0], both[1]

    def lifted(self, w: Array, parameters: Array) -> Array:
        """z of the program's unknowns: with it all gaps of what is carried are closed."""
        z = np.where(self.unknown == NONE, 0.0, w[self.unknown])
        if len(self.spent) or len(self.before):
            gaps = np.asarray(self._constraints(z, parameters), float).ravel()
            z[self.before[:, 0]] = -gaps[self.before[:, 1]]
            budgets = len(self.program.problem.budgets)
            each = -gaps[self.spent[:, 1]].reshape(-1, budgets) if budgets else np.zeros((0, 0))
            z[self.spent[:, 0]] = np.cumsum(each, axis=0).ravel()
        return z

    def lowered(self, z: Array) -> Array:
        """The program's unknowns."""
        return z[self.first]

    def lowered_multipliers(self, g: Array, x: Array) -> tuple[Array, Array]:
        """The program's (lam_g, lam_x) from those of rows and bounds.

        Where the gaps of what is carried are closed, z is a function of the program's unknowns and
        drops out of the Lagrangian: the other multipliers are the program's own.
        """
        return self.sign[self._held] * g[self._held], x[self.first]
