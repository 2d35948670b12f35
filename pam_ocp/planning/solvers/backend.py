"""The choice of a solver: IPOPT, or fatrop with IPOPT behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ..transcription.transcription import Program
from .fatrop import Fatrop
from .solver import Ipopt, Outcome, Progress, Start

__all__ = ["Backend", "Solver", "SolverName"]

Array: TypeAlias = NDArray[np.float64]
SolverName: TypeAlias = Literal["ipopt", "fatrop"]

RESIDUAL = 1e-6
"""Of the optimality conditions of fatrop's solution: beyond it IPOPT goes on from there."""


@dataclass(frozen=True)
class Backend:
    """Which solver, and how; :meth:`build` makes it for a program."""

    name: SolverName = "ipopt"
    compiled: bool = False
    options: Mapping[str, Any] | None = None
    progress: Progress = False

    def __post_init__(self) -> None:
        names = get_args(SolverName)
        if self.name not in names:
            raise InputError(f"solver = {self.name!r}: choose one of {', '.join(names)}")
        if self.compiled and self.name != "ipopt":
            raise InputError(f"compiled = True goes with solver = 'ipopt', not {self.name!r}")

    @property
    def ipopt_options(self) -> Mapping[str, Any] | None:
        """The user's options where they are IPOPT's."""
        return self.options if self.name == "ipopt" else None

    def near(self) -> Backend:
        """What solves a finer mesh once: not compiled, and not fatrop, which cannot start near."""
        return replace(self, name="ipopt", compiled=False, options=self.ipopt_options)

    def build(self, program: Program) -> Solver:
        """A solver for this program, and for others of the same expressions."""
        if self.name == "fatrop":
            ipopt = Ipopt(program, progress=self.progress)
            return _FatropFirst(Fatrop(program, self.options), ipopt)
        return Ipopt(program, self.options, self.progress, self.compiled)


class _FatropFirst:
    """fatrop, checked; IPOPT where it gives no solution."""

    def __init__(self, fatrop: Fatrop, ipopt: Ipopt) -> None:
        self._fatrop, self._ipopt = fatrop, ipopt

    def __call__(
        self, program: Program, guess: Array, start: Start = "cold", warm: Outcome | None = None
    ) -> Outcome:
        """As :class:`Ipopt`; fatrop takes no multipliers, and has no other barrier strategy."""
        if start == "adaptive":
            return self._ipopt(program, guess, start)
        found = self._fatrop(program, guess)
        if not found.success:
            instead = self._ipopt(program, guess, start, warm)
            warning = f"{found.status}; solved by IPOPT instead"
            return replace(instead, warning=warning, seconds=instead.seconds + found.seconds)
        residual = self._ipopt.residual(program, found)
        if residual <= RESIDUAL:
            return found
        found_by_ipopt = self._ipopt(program, found.w, "warm", found)
        warning = f"fatrop left a residual of {residual:.1e}; IPOPT went on from there"
        return replace(
            found_by_ipopt,
            warning=warning,
            seconds=found_by_ipopt.seconds + found.seconds,
            iterations=found_by_ipopt.iterations + found.iterations,
        )


Solver: TypeAlias = "Ipopt | _FatropFirst"
