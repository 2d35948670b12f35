"""The statement of a planning problem: what a user says, typed once for all verbs that plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypedDict

import casadi as ca

from ...core.errors import require_flag, require_instance
from ...operating.held import Memory
from .wording import Avoid, Constraint, Phase, Stop

__all__ = ["Cyclic", "Statement", "StatementKeywords"]

Cyclic: TypeAlias = 'bool | Literal["mirrored"]'


class StatementKeywords(TypedDict, total=False):
    """The keywords of :func:`pam_ocp.plan` that say what is asked of the motion; see there."""

    cyclic: Cyclic
    duration: Any
    minimise: str | Mapping[str, float]
    bounds: Mapping[str, Any] | None
    rest: bool
    memory: Memory
    phases: Sequence[Phase | None] | None
    constraints: Sequence[Constraint | Avoid]
    track: Mapping[str, Any] | None
    budgets: Mapping[str, Any] | None
    design: Mapping[str, tuple[float, float]] | None
    integrand: ca.SX | None
    final: ca.SX | None


@dataclass(frozen=True)
class Statement:
    """What is asked of a motion: the arguments of :func:`pam_ocp.plan` that say it; see there."""

    stops: Sequence[Mapping[str, Any] | Stop]
    cyclic: Cyclic = False
    duration: Any = None
    minimise: str | Mapping[str, float] = "time"
    bounds: Mapping[str, Any] | None = None
    rest: bool = True
    memory: Memory = "virgin"
    jumps: bool = True
    """Whether inputs may jump at the stops."""
    phases: Sequence[Phase | None] | None = None
    constraints: Sequence[Constraint | Avoid] = ()
    track: Mapping[str, Any] | None = None
    budgets: Mapping[str, Any] | None = None
    design: Mapping[str, tuple[float, float]] | None = None
    integrand: ca.SX | None = None
    final: ca.SX | None = None

    def __post_init__(self) -> None:
        lists = (list, tuple)
        shown = 'give a list of mappings, such as [{"x": 0.0}, {"x": 0.02}]'
        require_instance("stops", self.stops, (*lists, Mapping), shown)
        require_instance(
            "minimise", self.minimise, (str, Mapping), "give a term, or {term: weight}"
        )
        require_flag("rest", self.rest)
        for argument in ("bounds", "track", "budgets", "design"):
            value = getattr(self, argument)
            require_instance(argument, value, Mapping, "give a mapping by name", none=True)
        require_instance("phases", self.phases, lists, "give a list of Phase or None", none=True)
        for i, phase in enumerate(self.phases or ()):
            require_instance(f"phases[{i}]", phase, Phase, "give a Phase or None", none=True)
        remedy = "give a list of Constraint and Avoid"
        require_instance("constraints", self.constraints, lists, remedy)

    @property
    def weights(self) -> Mapping[str, float]:
        """The terms of the objective by name."""
        return {self.minimise: 1.0} if isinstance(self.minimise, str) else self.minimise

    @property
    def inputs_jump(self) -> bool:
        """Whether inputs may jump: linear ones cannot, and where their rate costs they better do
        not.
        """
        return self.jumps and "rate" not in self.weights
