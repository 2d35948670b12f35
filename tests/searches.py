"""What tests of the planner begin with: programs, searches, SciPy's word."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.planning.candidate import Engine
from pam_ocp.planning.planner import Planner
from pam_ocp.planning.result import Solved
from pam_ocp.planning.search import Search
from pam_ocp.planning.stages import recorded


def by_scipy(plan: pam.planning.Plan) -> np.ndarray:
    """States in nominals where a plan's held inputs change, and at its end, from its own start:
    SciPy's Radau, of the plant's own function.
    """
    plant, motion = plan.plant, plan.trajectory
    nominal, p = plant.vector("state", attribute="nominal"), plant.vector("parameter")
    found = [motion.array([v.name for v in plant.states])[0] / nominal]
    breaks, held = motion.signals.breaks, motion.signals.coefficients[:, 0]
    for begin, end, u in zip(breaks[:-1], breaks[1:], held, strict=True):

        def rate(t: float, z: np.ndarray, u: np.ndarray = u) -> np.ndarray:
            return np.asarray(plant.function(z * nominal, u, p)[0]).ravel() / nominal

        run = solve_ivp(rate, (begin, end), found[-1], "Radau", rtol=1e-8, atol=1e-8)
        found.append(run.y[:, -1])
    return np.array(found)


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
