"""do-mpc: Radau collocation of degree 3 over 50 intervals; the duration is a state that stays."""

import casadi as ca
import do_mpc
import equations as e
import numpy as np

N = e.INTERVALS
STATES, INPUTS = ("x", "v", "p1", "p2"), ("u1", "u2")


def controller():
    """The tool's controller, its fixed initial state freed and the mirrored end added."""
    model = do_mpc.model.Model("continuous", "SX")
    x, v, p1, p2, duration = (model.set_variable("_x", n) for n in (*STATES, "duration"))
    u1, u2 = (model.set_variable("_u", n) for n in INPUTS)
    for name, slope in zip(STATES, e.slopes(x, v, p1, p2, u1, u2, exp=ca.exp), strict=True):
        model.set_rhs(name, duration * slope)
    model.set_rhs("duration", ca.SX(0))
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step, mpc.settings.n_robust = N, 1 / N, 0
    mpc.settings.collocation_deg, mpc.settings.nl_cons_check_colloc_points = 3, True
    mpc.settings.store_full_solution = False
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0}
    mpc.settings.nlpsol_opts = {**quiet, "expand": True}
    mpc.set_objective(mterm=duration, lterm=ca.SX(0))
    mpc.set_rterm(u1=0.0, u2=0.0)
    for kind, names, low, high in (
        ("_x", ("x",), -e.STROKE, e.STROKE),
        ("_x", ("p1", "p2"), 0, e.LARGEST),
        ("_x", ("duration",), 0.02, 1.0),
        ("_u", INPUTS, 0, e.LARGEST),
    ):
        for name in names:
            mpc.bounds["lower", kind, name], mpc.bounds["upper", kind, name] = low, high
    for i, force in enumerate(e.forces(x, p1, p2, exp=ca.exp)):
        mpc.set_nl_cons(f"force{i}", -force, ub=0)
    for i, (u, p) in enumerate(((u1, p1), (u2, p2))):
        mpc.set_nl_cons(f"rise{i}", (u - p) / e.LAG, ub=e.RATE)
        mpc.set_nl_cons(f"fall{i}", (p - u) / e.LAG, ub=e.RATE)
    mpc.prepare_nlp()
    start, end = mpc.opt_x["_x", 0, 0, -1], mpc.opt_x["_x", N, 0, -1]
    f1, f2 = e.forces(start[0], start[2], start[3], exp=ca.exp)
    mpc.nlp_cons[0] = ca.vertcat(
        start[0] + e.STOP,
        start[1],
        f1 - f2,
        end[0] + start[0],
        end[1],
        end[2] - start[3],
        end[3] - start[2],
    )
    mpc.nlp_cons_lb[0] = mpc.nlp_cons_ub[0] = np.zeros((7, 1))
    # the tool checks collocation points, of which the start of an interval is none
    for k in range(N):
        pressures, commands = mpc.opt_x["_x", k, 0, -1][2:4], mpc.opt_x["_u", k, 0]
        mpc.nlp_cons.append((commands - pressures) / e.LAG)
        mpc.nlp_cons_lb.append(np.full((2, 1), -e.RATE))
        mpc.nlp_cons_ub.append(np.full((2, 1), e.RATE))
    mpc.create_nlp()
    return mpc


def set_guess(mpc):
    """x linear in time, the rest constant."""
    for k in range(N + 1):
        state = np.array([-e.STOP + 2 * e.STOP * k / N, 0.2, 3.0, 3.0, e.GUESS])
        mpc.opt_x_num["_x", k, 0] = [state] * len(mpc.opt_x_num["_x", k, 0])
        if k < N:
            mpc.opt_x_num["_u", k, 0] = np.array([3.0, 3.0])


def main():
    begin = e.clock()
    mpc = controller()
    first, best, _ = e.repeated(mpc.solve, begin, prepare=lambda: set_guess(mpc))
    found = mpc.opt_x_num
    states = np.hstack([np.asarray(found["_x", k, 0, -1]).reshape(-1, 1) for k in range(N + 1)])
    inputs = np.array([np.asarray(found["_u", k, 0]).ravel() for k in range(N)])
    iterations = mpc.solver_stats["iter_count"]
    name, inputs = "do-mpc: Radau 3, expanded", inputs[:, :, None]
    e.report(name, first, best, iterations, states[4, 0], states[:4], inputs)


main()
