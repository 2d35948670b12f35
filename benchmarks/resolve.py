"""Planning again for other numbers: PAM-2DIR with another load or stroke, from a solved neighbour.

    python benchmarks/resolve.py [--only WORD ...]

The reference is plain CasADi and IPOPT, started cold, the usual careful way: the scaled program
with mapped stage functions, CasADi's own derivatives and IPOPT's defaults. Each figure is the best
of REPEATS in this one process, as a ratio to the reference: of the solver's time, and of the whole
call of the planner with its independent replay.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import casadi as ca
import harness
import numpy as np
import pam_2dir
from harness import took

import pam_ocp as pam
from pam_ocp.planning.transcription.guess import by_stops

N, REPEATS = 50, 5
CHANGES: dict[str, dict[str, Any]] = {
    "load +1 %": {"values": {"mass": 2.02}},
    "load +10 %": {"values": {"mass": 2.2}},
    "load +50 %": {"values": {"mass": 3.0}},
    "stroke -1 %": {"stops": [{"x": -0.01485}, {"x": 0.01485}]},
    "stroke -10 %": {"stops": [{"x": -0.0135}, {"x": 0.0135}]},
    "stroke -50 %": {"stops": [{"x": -0.0075}, {"x": 0.0075}]},
}
RADAU, SHOOTING = pam.Collocation(N, 3), pam.planning.Shooting(N, 2)
FEW = pam.Collocation(6, 9, "polynomial", guarded=False)
METHODS: dict[str, dict[str, Any]] = {
    "Radau 50 x 3": {"method": RADAU},
    "Radau 50 x 3, compiled": {"method": RADAU, "compiled": True},
    "Radau 6 x 9": {"method": FEW},
    "Radau 6 x 9, compiled": {"method": FEW, "compiled": True},
    "shooting 50 x 2": {"method": SHOOTING},
    "shooting 50 x 2, compiled": {"method": SHOOTING, "compiled": True},
}


def planner(case: str, **arguments: Any) -> pam.Planner:
    return pam.Planner(pam_2dir.plant(case), pam_2dir.STOPS, **arguments, **pam_2dir.WISHES[case])


@cache
def reference(case: str) -> float:
    """Seconds of the careful way, cold."""
    program = planner(case, method=RADAU)._program
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("careful", "ipopt", program.nlp, options)
    (lbx, ubx), (lbg, ubg) = program.bounds(), program.limits()
    guess = np.clip(by_stops(program.problem, program.mesh), lbx, ubx)
    bounds = {"lbx": lbx, "ubx": ubx, "lbg": lbg, "ubg": ubg}
    solve = partial(solver, x0=guess, p=program.parameters(), **bounds)
    return min(took(solve).clock for _ in range(REPEATS))


def again(case: str, method: str) -> harness.Row:
    """All changes by one method: a neighbour's plan, then this one, warm and cold."""
    again, base = planner(case, **METHODS[method]), reference(case)
    first, changes = again(), []
    for name, change in CHANGES.items():
        calls = [took(partial(again, guess=first, **change)) for _ in range(REPEATS)]
        solves = [call.result.statistics["solve_seconds"] for call in calls]
        plan, cold = calls[-1].result, again(**change)
        iterations = [each.statistics["iterations"] for each in (plan, cold)]
        quickest = min(call.clock for call in calls)
        off = plan.objective / cold.objective - 1
        changes.append([name, min(solves) / base, quickest / base, *iterations, off])
    lines = [
        f"{name:<14}solve {solve:.3f}, call {call:.3f}; {warm} iterations warm, {cold} cold; "
        f"objective {off:+.1e}"
        for name, solve, call, warm, cold, off in changes
    ]
    return {"verdict": plan.statistics["solver"], "why": lines, "changes": changes}


def cases(given: harness.Given) -> harness.Keyed:
    for case in pam_2dir.WISHES:
        for method in METHODS:
            yield f"({case}) {method}", partial(again, case, method)


if __name__ == "__main__":
    harness.main(__doc__, cases)
