"""MAPTOR: Legendre-Gauss-Radau, input free at the points (it knows no held input), fixed mesh."""

import sys

import casadi as ca
import equations as e
import maptor
import numpy as np

MESHES = {"low": (50, 3), "high": (6, 9)}
OPTIONS = {"expand": True, "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}


def state_problem(intervals, degree):
    """The problem in the tool's words; it scales nothing by itself."""
    problem = maptor.Problem("PAM-2DIR")
    phase = problem.set_phase(1)
    time = phase.time(initial=0.0, final=(0.02, 1.0))
    x = phase.state("x", initial=-e.STOP, final=e.STOP, boundary=(-e.STROKE, e.STROKE))
    v = phase.state("v", initial=0.0, final=0.0)
    p1, p2 = (phase.state(n, boundary=(0, e.LARGEST)) for n in ("p1", "p2"))
    u1, u2 = (phase.control(n, boundary=(0, e.LARGEST)) for n in ("u1", "u2"))
    slopes = e.slopes(x, v, p1, p2, u1, u2, exp=ca.exp)
    phase.dynamics(dict(zip((x, v, p1, p2), slopes, strict=True)))
    for force in e.forces(x, p1, p2, exp=ca.exp):
        phase.path_constraints(force >= 0)
    for u, p in ((u1, p1), (u2, p2)):
        phase.path_constraints((u - p) / e.LAG <= e.RATE, (u - p) / e.LAG >= -e.RATE)
    f1, f2 = e.forces(x.initial, p1.initial, p2.initial, exp=ca.exp)
    phase.event_constraints(p1.final == p2.initial, p2.final == p1.initial, f1 == f2)
    problem.minimize(time.final)
    breaks = np.linspace(-1, 1, intervals + 1)
    phase.mesh([degree] * intervals, breaks)
    share = (breaks[:-1, None] + 1) / 2 + np.linspace(0, 1, degree + 1) / intervals
    rest = [[0.2], [3.0], [3.0]] @ np.ones((1, degree + 1))
    phase.guess(
        states=[np.vstack([e.STOP * (2 * s - 1), rest]) for s in share],
        controls=[np.full((2, degree), 3.0)] * intervals,
        initial_time=0.0,
        terminal_time=e.GUESS,
    )
    return problem


def main():
    intervals, degree = MESHES[sys.argv[1] if len(sys.argv) > 1 else "low"]
    begin = e.clock()
    problem = state_problem(intervals, degree)
    found = maptor.solve_fixed_mesh(problem, nlp_options=OPTIONS, show_summary=False)
    first = e.clock(), e.clock() - begin
    if not found.status["success"]:
        raise SystemExit(found.status["message"])
    opti = found.opti
    start = opti.debug.value(opti.x, opti.initial())
    guess = lambda: opti.set_initial(opti.x, start)  # noqa: E731
    _, best, again = e.repeated(opti.solve_limited, begin, prepare=guess)
    duration = found.phases[1]["times"]["duration"]
    breaks = np.linspace(0, duration, intervals + 1)
    index = [int(np.argmin(np.abs(found["time_states"] - b))) for b in breaks]
    states = np.array([found[n][index] for n in ("x", "v", "p1", "p2")])
    points = found["time_controls"][:degree] / breaks[1]
    inputs = np.array([found[n][: intervals * degree] for n in ("u1", "u2")])
    inputs = inputs.reshape(2, intervals, degree).transpose(1, 0, 2)
    name, count = f"maptor: LGR {intervals} x {degree}", again.stats()["iter_count"]
    name += ", input at the points"
    e.report(name, first, best, count, duration, states, inputs, points=points)


main()
