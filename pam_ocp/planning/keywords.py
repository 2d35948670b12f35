"""The keywords of all verbs that plan, typed once."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from ..judge.statement import StatementKeywords
from .arcs import Arcs
from .result import Plan
from .solvers.backend import SolverName
from .solvers.solver import Progress
from .transcription.mesh import Method

__all__ = ["SEARCH", "PlanKeywords", "SolveKeywords", "require_known"]

SEARCH = {"solver": "name", "compiled": "compiled", "options": "options", "progress": "progress"}
"""Keywords that say how a solution is searched, and the fields of Backend that hold them."""


class PlanKeywords(StatementKeywords, total=False):
    """What is asked, and how it is searched: the keywords of all verbs that plan."""

    method: Method | Arcs | None
    progress: Progress
    solver: SolverName
    compiled: bool
    options: Mapping[str, Any] | None


class SolveKeywords(PlanKeywords, total=False):
    """All keywords of :func:`plan`."""

    tolerance: float | None
    guess: Plan | None
    starts: int | None


def require_known(keywords: Mapping[str, Any]) -> None:
    """Raise a TypeError that names the nearest keyword."""
    known = (*StatementKeywords.__annotations__, *SEARCH, "method")
    for name in keywords:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"it knows {', '.join(known)}"
            raise TypeError(f"a planner takes no argument {name!r}; {hint}")
