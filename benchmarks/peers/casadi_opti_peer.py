"""Plain CasADi as its users write it: Opti, Radau collocation of degree 3, unscaled, IPOPT."""

import casadi as ca
import equations as e
import numpy as np

N, DEGREE = e.INTERVALS, 3


def state_problem():
    """The problem, and its unknowns (x, u, duration)."""
    z, w = ca.SX.sym("z", 4), ca.SX.sym("w", 2)
    parts = [*ca.vertsplit(z), *ca.vertsplit(w)]
    model = ca.Function("model", [z, w], [ca.vertcat(*e.slopes(*parts, exp=ca.exp))])
    pulls = ca.Function(
        "pulls", [z], [ca.vertcat(*e.forces(parts[0], parts[2], parts[3], exp=ca.exp))]
    )
    opti = ca.Opti()
    duration = opti.variable()
    opti.subject_to(opti.bounded(0.02, duration, 1.0))
    opti.set_initial(duration, e.GUESS)
    x, u = opti.variable(4, N + 1), opti.variable(2, N)
    c, d, _ = ca.collocation_coeff(ca.collocation_points(DEGREE, "radau"))
    h = duration / N
    for k in range(N):
        points = opti.variable(4, DEGREE)
        stage = ca.horzcat(x[:, k], points)
        slopes = stage @ c
        for j in range(DEGREE):
            opti.subject_to(slopes[:, j] == h * model(points[:, j], u[:, k]))
            opti.subject_to(pulls(points[:, j]) >= 0)
            opti.subject_to(opti.bounded(-e.RATE, (u[:, k] - points[2:, j]) / e.LAG, e.RATE))
            opti.subject_to(opti.bounded(-e.STROKE, points[0, j], e.STROKE))
            opti.subject_to(opti.bounded(0, points[2:, j], e.LARGEST))
        opti.subject_to(opti.bounded(-e.RATE, (u[:, k] - x[2:, k]) / e.LAG, e.RATE))
        opti.subject_to(opti.bounded(0, u[:, k], e.LARGEST))
        opti.subject_to(x[:, k + 1] == stage @ d)
        opti.set_initial(points, np.array([[0], [0.2], [3], [3]]) @ np.ones((1, DEGREE)))
    start = pulls(x[:, 0])
    opti.subject_to(x[0, 0] == -e.STOP)
    opti.subject_to(x[1, 0] == 0)
    opti.subject_to(start[0] == start[1])
    opti.subject_to(x[:, N] == ca.vertcat(-x[0, 0], -x[1, 0], x[3, 0], x[2, 0]))
    line = np.linspace(-e.STOP, e.STOP, N + 1)
    opti.set_initial(x, np.vstack([line, np.full(N + 1, 0.2), np.full((2, N + 1), 3)]))
    opti.set_initial(u, 3)
    opti.minimize(duration)
    return opti, (x, u, duration)


def main():
    begin = e.clock()
    opti, unknowns = state_problem()
    opti.solver("ipopt")
    options = {"print_time": False, "expand": True, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("plain", "ipopt", {"x": opti.x, "f": opti.f, "g": opti.g}, options)
    guess = opti.debug.value(opti.x, opti.initial())
    low, high = (opti.debug.value(b) for b in (opti.lbg, opti.ubg))
    first, best, found = e.repeated(lambda: solver(x0=guess, lbg=low, ubg=high), begin)
    w = found["x"]
    x, u, duration = (np.asarray(v) for v in ca.Function("v", [opti.x], list(unknowns))(w))
    name, iterations = "plain CasADi: Opti, Radau 3, expanded", solver.stats()["iter_count"]
    e.report(name, first, best, iterations, duration.item(), x, u.T[:, :, None])


main()
