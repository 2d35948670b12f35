"""The choice of a solver by its name; fatrop with IPOPT behind it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_flag
from ..stages import written
from ..transcription.transcription import Program
from .ipopt_options import Start
from .solver import SOLVERS, Ipopt, Outcome, Progress, Solver

if TYPE_CHECKING:
    from .fatrop import Fatrop

__all__ = ["Backend", "Solver", "SolverName"]

Array: TypeAlias = NDArray[np.float64]
SolverName: TypeAlias = 'Literal["ipopt", "fatrop"] | str'
"""Of those in ``SOLVERS``; these two come with the library."""

RESIDUAL = 1e-6
"""Of the optimality conditions of fatrop's solution: beyond it IPOPT goes on from there."""
KEPT = 8
"""Solvers that are kept at a time."""


@dataclass(frozen=True)
class Backend:
    """Which solver, and how; :meth:`build` makes it for a program."""

    name: SolverName = "ipopt"
    compiled: bool = False
    options: Mapping[str, Any] | None = None
    progress: Progress = False
    keeps: bool = False
    """Whether the solvers built last are kept: neighbours are solved on one finer mesh many times.
    """
    kept: dict[int, tuple[Program, Solver]] = field(default_factory=dict, repr=False, compare=False)
    """These with their programs, by the identity of the expressions."""

    def __post_init__(self) -> None:
        if self.name not in SOLVERS:
            raise InputError(f"solver = {self.name!r}: choose one of {', '.join(SOLVERS)}")
        require_flag("compiled", self.compiled)
        if self.compiled and "compiled" not in SOLVERS.arguments(self.name):
            able = [repr(n) for n in SOLVERS if "compiled" in SOLVERS.arguments(n)]
            raise InputError(
                f"compiled = True goes with solver = {' or '.join(able)}, not {self.name!r}"
            )

    @property
    def ipopt_options(self) -> Mapping[str, Any] | None:
        """The user's options where they are IPOPT's."""
        return self.options if self.name == "ipopt" else None

    def near(self) -> Backend:
        """What solves a finer mesh: IPOPT, not compiled; not every solver can start near."""
        near = replace(self, name="ipopt", compiled=False, options=self.ipopt_options)
        return replace(near, keeps=True)

    def build(self, program: Program) -> Solver:
        """A solver for this program, and for others of the same expressions."""
        key = id(program.nlp)
        if self.keeps and key in self.kept:
            return self.kept[key][1]
        compiled = {"compiled": True} if self.compiled else {}
        solver = SOLVERS[self.name](program, self.options, self.progress, **compiled)
        if self.keeps:
            while len(self.kept) >= KEPT:
                del self.kept[next(iter(self.kept))]
            self.kept[key] = program, solver
        return solver

    @property
    def programs(self) -> tuple[Program, ...]:
        """Those whose solvers are kept."""
        return tuple(program for program, _ in self.kept.values())


@SOLVERS.register("fatrop")
def fatrop_first(
    program: Program, options: Mapping[str, Any] | None = None, progress: Progress = False
) -> Solver:
    """fatrop, a stage-wise interior-point solver, in a separate process; IPOPT where it gives no
    solution."""
    from .fatrop import Fatrop  # with the order of stages, which nobody else needs

    return _FatropFirst(Fatrop(program, options), Ipopt(program, progress=progress))


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
        written(program, start, found, found.seconds)
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
