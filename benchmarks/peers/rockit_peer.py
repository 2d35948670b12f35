"""rockit: direct collocation (Radau) or multiple shooting of 50 intervals, expanded, IPOPT."""

import sys

import casadi as ca
import equations as e
import numpy as np
import rockit


def state_problem(method):
    """The problem and its signals (states, inputs)."""
    ocp = rockit.Ocp(T=rockit.FreeTime(e.GUESS))
    states = [ocp.state() for _ in range(4)]
    inputs = [ocp.control() for _ in range(2)]
    (x, v, p1, p2), (u1, u2) = states, inputs
    for state, slope in zip(states, e.slopes(x, v, p1, p2, u1, u2, exp=ca.exp), strict=True):
        ocp.set_der(state, slope)
    for p, u in ((p1, u1), (p2, u2)):
        ocp.subject_to((p <= e.LARGEST) >= 0)
        ocp.subject_to((u <= e.LARGEST) >= 0, include_last=False)
        ocp.subject_to(((u - p) / e.LAG <= e.RATE) >= -e.RATE, include_last=False)
    ocp.subject_to((x <= e.STROKE) >= -e.STROKE)
    for force in e.forces(x, p1, p2, exp=ca.exp):
        ocp.subject_to(force >= 0)
    f1, f2 = e.forces(x, p1, p2, exp=ca.exp)
    ocp.subject_to(ocp.at_t0(x) == -e.STOP)
    ocp.subject_to(ocp.at_t0(v) == 0)
    ocp.subject_to(ocp.at_t0(f1 - f2) == 0)
    ocp.subject_to(ocp.at_tf(x) == e.STOP)
    ocp.subject_to(ocp.at_tf(v) == 0)
    ocp.subject_to(ocp.at_tf(p1) == ocp.at_t0(p2))
    ocp.subject_to(ocp.at_tf(p2) == ocp.at_t0(p1))
    ocp.subject_to((ocp.T <= 1.0) >= 0.02)
    ocp.add_objective(ocp.T)
    ocp.set_initial(x, -e.STOP + 2 * e.STOP * ocp.t / e.GUESS)
    ocp.set_initial(v, 0.2)
    for signal in (p1, p2, u1, u2):
        ocp.set_initial(signal, 3)
    options = {"expand": True, "print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    ocp.solver("ipopt", options)
    ocp.method(method)
    return ocp, states, inputs


def main():
    begin = e.clock()
    shooting = len(sys.argv) > 1 and sys.argv[1] == "shooting"
    if shooting:
        method, name = rockit.MultipleShooting(N=e.INTERVALS, M=4, intg="rk"), "shooting, RK4 x 4"
    else:
        method, name = rockit.DirectCollocation(N=e.INTERVALS, M=1, degree=3), "Radau 3"
    ocp, states, inputs = state_problem(method)
    found = ocp.solve()
    first = e.clock(), e.clock() - begin
    solver = ocp._method.opti
    start = solver.debug.value(solver.x, solver.initial())
    guess = lambda: solver.set_initial(solver.x, start)  # noqa: E731
    _, best, _ = e.repeated(solver.solve_limited, begin, prepare=guess)
    x = np.array([found.sample(s, grid="control")[1] for s in states])
    u = np.array([found.sample(s, grid="control")[1] for s in inputs])[:, : e.INTERVALS]
    name, iterations = f"rockit: {name}, expanded", found.stats["iter_count"]
    e.report(name, first, best, iterations, found.value(ocp.T), x, u.T[:, :, None])


main()
