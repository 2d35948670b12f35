"""The planner on PAM-2DIR (a), minimum time: ours and other ways to state the same problem.

An antagonistic pair of DMSP-20-200N on a slide moves 30 mm from rest to rest, half a cycle whose
second half is its mirror image; 50 intervals of constant input. Every way runs in this one process,
the best of ``REPEATS``; figures are ratios to plain CasADi (Opti, Radau of degree 3, unscaled). The
error is that of the inputs found, integrated by SciPy's DOP853 at 1e-11, over (0.03, 1, 6e5, 6e5).

Other optimal-control tools, each in its own process and environment: benchmarks/peers/run.py.

Run:  python benchmarks/plan.py
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from pam_2dir import BAR, slide
from scipy.integrate import solve_ivp

import pam_ocp as pam

N, DEGREE, REPEATS = 50, 3, 3
SCALE = np.array([0.03, 1.0, 6 * BAR, 6 * BAR])


@dataclass
class Result:
    name: str
    duration: float
    first: float
    """Seconds of the first call: statement, transcription and solve."""
    solve: float
    """Seconds of the solver alone, the best."""
    iterations: int
    states: np.ndarray
    inputs: np.ndarray
    """(N, 2), held."""

    def error(self, plant: pam.Plant) -> float:
        p, h, x = plant.vector("parameter"), self.duration / N, self.states[0]
        worst = 0.0
        for k in range(N):
            run = solve_ivp(
                lambda t, z, k=k: (
                    np.asarray(plant.function(z * SCALE, self.inputs[k], p)[0]).ravel() / SCALE
                ),
                (0, h),
                x / SCALE,
                method="DOP853",
                rtol=1e-11,
                atol=1e-11,
            )
            x = run.y[:, -1] * SCALE
            worst = max(worst, float(np.max(np.abs(x - self.states[k + 1]) / SCALE)))
        return worst


def ours(plant: pam.Plant, method: pam.Collocation, name: str) -> Result:
    begin = perf_counter()
    plan = pam.plan(plant, [{"x": -0.015}, {"x": 0.015}], cyclic="mirrored", method=method)
    first = perf_counter() - begin
    solves = [plan.statistics["solve_seconds"]]
    for _ in range(REPEATS - 1):
        again = pam.plan(plant, [{"x": -0.015}, {"x": 0.015}], cyclic="mirrored", method=method)
        solves.append(again.statistics["solve_seconds"])
    t = plan.trajectory
    step = method.degree
    states, inputs = t.array(t.named("state"))[::step], t.array(t.named("input"))[:-1:step]
    return Result(
        name, plan.duration, first, min(solves), plan.statistics["iterations"], states, inputs
    )


def opti(plant: pam.Plant) -> Result:
    """Plain CasADi as its users write it: Opti, direct collocation, IPOPT with its defaults."""
    firsts, solves = [], []
    for _ in range(REPEATS):
        begin = perf_counter()
        problem, variables = _opti(plant)
        problem.solver("ipopt")
        solver = ca.nlpsol(
            "plain",
            "ipopt",
            {"x": problem.x, "f": problem.f, "g": problem.g},
            {"print_time": False, "expand": True, "ipopt": {"print_level": 0, "sb": "yes"}},
        )
        start = problem.debug.value(problem.x, problem.initial())
        limits = (problem.debug.value(b) for b in (problem.lbg, problem.ubg))
        low, high = limits
        ready = perf_counter()
        w = solver(x0=start, lbg=low, ubg=high)["x"]
        done = perf_counter()
        firsts.append(done - begin)
        solves.append(done - ready)
    value = ca.Function("value", [problem.x], list(variables))
    x, u, duration = (np.asarray(v) for v in value(w))
    x[2:] *= BAR
    u *= BAR
    return Result(
        "plain CasADi: Opti, Radau 3, expanded",
        float(duration.item()),
        firsts[0],
        min(solves),
        solver.stats()["iter_count"],
        np.asarray(x).T,
        np.asarray(u).T,
    )


def _opti(plant: pam.Plant) -> tuple[ca.Opti, tuple[Any, Any, Any]]:
    p, units = plant.vector("parameter"), np.array([1, 1, BAR, BAR])  # pressures in bar
    z, v = ca.SX.sym("z", 4), ca.SX.sym("v", 2)
    xdot = plant.function(z * units, v * BAR, p)[0] / units
    pulls = ca.Function(
        "pulls",
        [plant.x, plant.u, plant.p],
        [ca.vertcat(*(plant.expression(f"muscle{i}.tension") for i in (1, 2)))],
    )(z * units, v * BAR, p)
    model, tensions = ca.Function("model", [z, v], [xdot]), ca.Function("tensions", [z, v], [pulls])
    opti = ca.Opti()
    duration = opti.variable()
    opti.subject_to(opti.bounded(0.02, duration, 1.0))
    opti.set_initial(duration, 0.15)
    x, u = opti.variable(4, N + 1), opti.variable(2, N)
    c, d, _ = ca.collocation_coeff(ca.collocation_points(DEGREE, "radau"))
    h = duration / N
    for k in range(N):
        points = opti.variable(4, DEGREE)
        stage = ca.horzcat(x[:, k], points)
        slopes = stage @ c
        for j in range(DEGREE):
            f = model(points[:, j], u[:, k])
            opti.subject_to(slopes[:, j] == h * f)
            opti.subject_to(tensions(points[:, j], u[:, k]) >= 0)
            opti.subject_to(opti.bounded(-40, (u[:, k] - points[2:, j]) / 0.05, 40))
            opti.subject_to(opti.bounded(-0.016, points[0, j], 0.016))
            opti.subject_to(opti.bounded(0, points[2:, j], 6))
        opti.subject_to(opti.bounded(-40, (u[:, k] - x[2:, k]) / 0.05, 40))
        opti.subject_to(opti.bounded(0, u[:, k], 6))
        opti.subject_to(x[:, k + 1] == stage @ d)
        opti.set_initial(points, np.array([[0], [0.2], [3], [3]]) @ np.ones((1, DEGREE)))
    force = model(x[:, 0], u[:, 0])[1]
    opti.subject_to(x[0, 0] == -0.015)
    opti.subject_to(x[1, 0] == 0)
    opti.subject_to(force == 0)
    opti.subject_to(x[:, N] == ca.vertcat(-x[0, 0], -x[1, 0], x[3, 0], x[2, 0]))
    opti.set_initial(
        x,
        np.vstack([np.linspace(-0.015, 0.015, N + 1), np.full(N + 1, 0.2), np.full((2, N + 1), 3)]),
    )
    opti.set_initial(u, 3)
    opti.minimize(duration)
    return opti, (x, u, duration)


def main() -> None:
    plant = slide()
    ways: list[Callable[[], Result]] = [
        lambda: opti(plant),
        lambda: ours(plant, pam.Collocation(N, DEGREE), "pam_ocp: 50 x 3, constant input"),
        lambda: ours(plant, pam.Collocation(N, 4), "pam_ocp: 50 x 4, constant input"),
    ]
    results = [way() for way in ways]
    reference = results[0]
    print(f"{'way':<42}{'T [s]':>10}{'first':>8}{'solve':>8}{'iterations':>12}{'error':>10}")
    for r in results:
        print(
            f"{r.name:<42}{r.duration:>10.6f}"
            f"{r.first / reference.first:>8.2f}{r.solve / reference.solve:>8.2f}"
            f"{r.iterations:>12}{r.error(plant):>10.1e}"
        )
    few = pam.plan(
        plant,
        [{"x": -0.015}, {"x": 0.015}],
        cyclic="mirrored",
        method=pam.Collocation(6, 9, "polynomial"),
    )
    ratio = few.statistics["solve_seconds"] / reference.solve
    print(f"pam_ocp: 6 x 9, input at the points: {few.duration:.6f} s, solve {ratio:.2f}")
    print(
        f"(plain CasADi: first {reference.first:.2f} s, solve {reference.solve:.2f} s, Python "
        f"{sys.version.split()[0]})"
    )


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    main()
