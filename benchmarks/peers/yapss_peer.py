"""YAPSS: Legendre-Gauss-Radau, input free at the points (it knows no held input)."""

import sys

import equations as e
import numpy as np
from yapss import Problem
from yapss.math import exp

MESHES = {"low": (50, 3), "high": (6, 9)}


def state_problem(intervals, degree):
    """The problem, scaled as the tool offers."""
    ocp = Problem(name="PAM-2DIR", nx=[4], nu=[2], nh=[4], nd=5)

    def objective(arg):
        arg.objective = arg.phase[0].final_time

    def continuous(arg):
        x, v, p1, p2 = arg.phase[0].state
        u1, u2 = arg.phase[0].control
        arg.phase[0].dynamics[:] = e.slopes(x, v, p1, p2, u1, u2, exp=exp)
        f1, f2 = e.forces(x, p1, p2, exp=exp)
        arg.phase[0].path[:] = f1, f2, (u1 - p1) / e.LAG, (u2 - p2) / e.LAG

    def discrete(arg):
        start, end = arg.phase[0].initial_state, arg.phase[0].final_state
        f1, f2 = e.forces(start[0], start[2], start[3], exp=exp)
        arg.discrete[:] = (
            end[0] + start[0],
            end[1] + start[1],
            end[2] - start[3],
            end[3] - start[2],
            f1 - f2,
        )

    ocp.functions.objective, ocp.functions.continuous = objective, continuous
    ocp.functions.discrete = discrete
    bounds = ocp.bounds.phase[0]
    bounds.initial_time.lower = bounds.initial_time.upper = 0.0
    bounds.final_time.lower, bounds.final_time.upper = 0.02, 1.0
    bounds.state.lower[:] = [-e.STROKE, -10.0, 0.0, 0.0]
    bounds.state.upper[:] = [e.STROKE, 10.0, e.LARGEST, e.LARGEST]
    bounds.initial_state.lower[:] = [-e.STOP, 0.0, 0.0, 0.0]
    bounds.initial_state.upper[:] = [-e.STOP, 0.0, e.LARGEST, e.LARGEST]
    bounds.control.lower[:], bounds.control.upper[:] = 0.0, e.LARGEST
    bounds.path.lower[:] = [0.0, 0.0, -e.RATE, -e.RATE]
    bounds.path.upper[:] = [np.inf, np.inf, e.RATE, e.RATE]
    ocp.bounds.discrete.lower[:] = ocp.bounds.discrete.upper[:] = 0.0
    guess = ocp.guess.phase[0]
    guess.time = (0.0, e.GUESS)
    guess.state = ((-e.STOP, e.STOP), (0.2, 0.2), (3.0, 3.0), (3.0, 3.0))
    guess.control = ((3.0, 3.0), (3.0, 3.0))
    ocp.spectral_method = "lgr"
    ocp.mesh.phase[0].collocation_points = intervals * (degree,)
    ocp.mesh.phase[0].fraction = intervals * (1.0 / intervals,)
    ocp.derivatives.method, ocp.derivatives.order = "auto", "second"
    ocp.scale.phase[0].state = ocp.scale.phase[0].dynamics = 0.01, 1.0, 3.0, 3.0
    ocp.scale.phase[0].time = 0.1
    ocp.ipopt_options.print_level = 0
    ocp.ipopt_options.sb = "yes"
    return ocp


def main():
    kind = sys.argv[1] if len(sys.argv) > 1 else "high"
    intervals, degree = MESHES[kind]
    begin = e.clock()
    found = state_problem(intervals, degree).solve()
    first = e.clock(), e.clock() - begin
    problems = []  # each is solved once
    stated = lambda: problems.append(state_problem(intervals, degree))  # noqa: E731
    _, best, _ = e.repeated(lambda: problems[-1].solve(), begin, 2, stated)
    phase = found.phase[0]
    time, at = np.asarray(phase.time), np.asarray(phase.time_c)
    breaks = np.linspace(0, phase.final_time, intervals + 1)
    index = [int(np.argmin(np.abs(time - b))) for b in breaks]
    points = (at[:degree] - breaks[0]) / (breaks[1] - breaks[0])
    control = np.asarray(phase.control).reshape(2, intervals, degree).transpose(1, 0, 2)
    name, states = f"yapss: LGR {intervals} x {degree}", np.asarray(phase.state)[:, index]
    name += ", input at the points"
    e.report(name, first, best, None, phase.final_time, states, control, points=points)


main()
