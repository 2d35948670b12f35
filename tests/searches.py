"""What tests of the planner's search begin with."""

from __future__ import annotations

from typing import Any

from pam_ocp.planning.candidate import Engine
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.result import Solved
from pam_ocp.planning.search import Search
from pam_ocp.planning.stages import recorded


def engine_of(planner: Planner) -> Engine:
    """Of a planner's program; its solves are recorded within ``recorded()``."""
    return Engine(planner._program, planner._solver, planner._backend, [])


def solved(planner: Planner) -> Solved:
    """The solution on the mesh that was asked for, from the usual guess."""
    engine = engine_of(planner)
    best = Search(engine, planner._statement, 1, None).best().best
    assert best is not None
    return best.solved


def refined(planner: Planner, coarse: Solved, mesh: Any) -> Solved:
    """The solution on another mesh."""
    engine = engine_of(planner)
    return engine.onto(engine.program(mesh), coarse, 1.0, ("mesh", "a test"))


def search_of(
    planner: Planner, starts: int | None = None, tolerance: float | None = 1e-3
) -> Search:
    """With a record of its own stages."""
    with recorded() as stages:
        engine = Engine(planner._program, planner._solver, planner._backend, stages)
    return Search(engine, planner._statement, None, tolerance)
