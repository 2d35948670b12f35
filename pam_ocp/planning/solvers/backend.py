"""The choice of a solver by its name."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from ...core.errors import InputError, require_flag
from ...core.plausible import outside
from ..transcription.transcription import Program
from .solver import SOLVERS, Progress, Solver

SolverName: TypeAlias = 'Literal["ipopt"] | str'
"""Of those in ``SOLVERS``; this one comes with the library."""

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
        if self.name == "fatrop" and self.name not in SOLVERS:
            warnings.warn(
                "solver = 'fatrop' is solver = 'ipopt' since version 0.3, which is as quick from "
                "another solution and several times quicker from a guess; its options are not used",
                DeprecationWarning,
                stacklevel=outside(),
            )
            object.__setattr__(self, "name", "ipopt")
            object.__setattr__(self, "options", None)
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
