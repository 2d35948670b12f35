"""Planning again for other numbers: PAM-2DIR with another load or other stops, from a solved
neighbour.

Two references, both of plain CasADi and IPOPT, started cold: ``Opti`` as its users write it
(unscaled; case (a) alone, see plan.py), and the usual careful way: the scaled program with mapped
stage functions, CasADi's own derivatives and IPOPT's defaults. Each figure is the best of
``REPEATS`` in this one process; ratios are those of the solver's time to the careful way's, and to
Opti's in brackets. "call" is the whole call of the planner, with its independent replay.

Run:  python benchmarks/resolve.py
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

import pam_ocp as pam

sys.path.insert(0, str(Path(__file__).parent))
from pam_2dir import commanded, slide
from plan import N, opti

from pam_ocp.planning.transcription.guess import by_stops

REPEATS = 5
STOPS = [{"x": -0.015}, {"x": 0.015}]
CHANGES: dict[str, dict[str, Any]] = {
    "load +1 %": {"values": {"mass": 2.02}},
    "load +10 %": {"values": {"mass": 2.2}},
    "load +50 %": {"values": {"mass": 3.0}},
    "stroke -1 %": {"stops": [{"x": -0.01485}, {"x": 0.01485}]},
    "stroke -10 %": {"stops": [{"x": -0.0135}, {"x": 0.0135}]},
    "stroke -50 %": {"stops": [{"x": -0.0075}, {"x": 0.0075}]},
}
METHODS = {
    "Radau 50 x 3": {"method": pam.Collocation(N, 3)},
    "Radau 50 x 3, compiled": {"method": pam.Collocation(N, 3), "compiled": True},
    "Radau 6 x 9": {"method": pam.Collocation(6, 9, "polynomial", guarded=False)},
    "Radau 6 x 9, compiled": {
        "method": pam.Collocation(6, 9, "polynomial", guarded=False),
        "compiled": True,
    },
    "shooting 50 x 2": {"method": pam.planning.Shooting(N, 2)},
    "shooting 50 x 2, compiled": {"method": pam.planning.Shooting(N, 2), "compiled": True},
}


@dataclass
class Case:
    name: str
    plant: pam.Plant
    wish: dict[str, Any]
    opti: float | None
    """Seconds of Opti's solve; None where it is not stated."""


def best(run: Callable[[], float]) -> float:
    return min(run() for _ in range(REPEATS))


def careful(case: Case) -> tuple[float, int]:
    """(seconds, iterations) of the scaled program, differentiated by CasADi, IPOPT's defaults,
    cold.
    """
    planner = pam.Planner(case.plant, STOPS, method=pam.Collocation(N, 3), **case.wish)
    program = planner._program
    solver = ca.nlpsol(
        "careful",
        "ipopt",
        program.nlp,
        {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}},
    )
    (lbx, ubx), (lbg, ubg) = program.bounds(), program.limits()
    guess = np.clip(by_stops(program.problem, program.mesh), lbx, ubx)

    def run() -> float:
        begin = perf_counter()
        solver(x0=guess, p=program.parameters(), lbx=lbx, ubx=ubx, lbg=lbg, ubg=ubg)
        return perf_counter() - begin

    return best(run), int(solver.stats()["iter_count"])


def again(case: Case, arguments: Mapping[str, Any], reference: float) -> None:
    """One line per change: a neighbour's plan, then this one, warm."""
    planner = pam.Planner(case.plant, STOPS, **arguments, **case.wish)
    first = planner()
    for name, change in CHANGES.items():
        calls = []

        def run(change: Mapping[str, Any] = change, calls: list[float] = calls) -> float:
            begin = perf_counter()
            plan = planner(guess=first, **change)
            calls.append(perf_counter() - begin)
            run.plan = plan  # type: ignore[attr-defined]
            return float(plan.statistics["solve_seconds"])

        seconds = best(run)
        plan = run.plan  # type: ignore[attr-defined]
        cold = planner(**change)
        beside = f"({seconds / case.opti:.3f})" if case.opti else ""
        print(
            f"    {name:<14}{seconds / reference:>7.3f} {beside:<8}"
            f"{min(calls) / reference:>9.3f}{plan.statistics['iterations']:>6} warm"
            f"{cold.statistics['iterations']:>5} cold{plan.objective / cold.objective - 1:>11.1e}"
            f"  {plan.statistics['solver']}"
        )


def main() -> None:
    plain = min(opti(slide()).solve for _ in range(2))
    cases = [
        Case("(a) minimum time", slide(), {"cyclic": "mirrored"}, plain),
        Case(
            "(b) least rate of command",
            commanded(),
            {"cyclic": "mirrored", "duration": 0.15, "minimise": {"effort": 1e-2}},
            None,
        ),
    ]
    print(f"{'':<18}{'solve':>7} (Opti){'call':>8}{'iterations':>16}{'objective':>13}")
    for case in cases:
        reference, iterations = careful(case)
        print(
            f"{case.name}: plain CasADi, scaled, cold: {reference:.3f} s, {iterations} iterations"
            + (f" (Opti: {case.opti:.3f} s)" if case.opti else "")
        )
        for name, arguments in METHODS.items():
            print(f"  {name}")
            again(case, arguments, reference)


if __name__ == "__main__":
    main()
