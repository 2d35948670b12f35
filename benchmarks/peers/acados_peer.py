"""acados: multiple shooting (RK4 x 4) of 50 intervals, SQP with HPIPM, exact Hessian, compiled C.

The duration and the pressures at the start are states that stay, which closes the mirrored cycle.
Full condensing: with partial condensing the end conditions, which HPIPM takes as pairs of
inequalities, keep the iterations from 1e-6 (all of its modes and regularisations were tried).
The library and its code generator come from a wheel (see environments.py); the generated C is
compiled by the system's make and compiler, in a folder of its own each time.
"""

import ctypes
import os
import shutil
import tempfile
from pathlib import Path

import acados
import casadi as ca
import equations as e
import numpy as np

os.environ["ACADOS_SOURCE_DIR"], os.environ["TERA_PATH"] = acados.DIR, acados.TERA_PATH
os.environ["ACADOS_PYTHON_INTERFACE_PATH"] = acados.TEMPLATE_DIR

# the wheel's libraries do not find one another by themselves
for library in ("libblasfeo.so", "libhpipm.so", "libqpOASES_e.so"):
    ctypes.CDLL(str(Path(acados.LIB_DIR) / library), mode=ctypes.RTLD_GLOBAL)

from acados.acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver  # noqa: E402

N, FREE = e.INTERVALS, 100.0
"""Intervals; a bound that is none, in the units below."""
SIZE = np.array([0.01, 0.5, 1.0, 1.0, 0.1, 1.0, 1.0])
"""Units of the states; forces are in 100 N, rates in those allowed."""


def state_model():
    """States x, v, p1, p2, the duration, and the pressures at the start; time in 0 .. 1."""
    model = AcadosModel()
    z, u = ca.SX.sym("z", 7), ca.SX.sym("u", 2)
    x, v, p1, p2, duration = ca.vertsplit((z * SIZE)[:5])
    slopes = [duration * s for s in e.slopes(x, v, p1, p2, u[0], u[1], exp=ca.exp)]
    pulls = [force / 100 for force in e.forces(x, p1, p2, exp=ca.exp)]
    rates = [(u[0] - p1) / e.LAG / e.RATE, (u[1] - p2) / e.LAG / e.RATE]
    model.name, model.x, model.u, model.p = "pam_2dir", z, u, ca.SX.sym("p", 0)
    model.f_expl_expr = ca.vertcat(*slopes, 0, 0, 0) / SIZE
    model.con_h_expr = ca.vertcat(*pulls, *rates, pulls[0] - pulls[1])
    model.con_h_expr_e = ca.vertcat(*pulls)
    model.cost_expr_ext_cost, model.cost_expr_ext_cost_e = ca.SX(0), duration
    return model


def state_problem(folder):
    """The problem in the tool's words, its code to be written into a folder."""
    ocp = AcadosOcp()
    ocp.model, ocp.dims.N = state_model(), N
    ocp.code_export_directory = str(Path(folder) / "code")
    ocp.cost.cost_type = ocp.cost.cost_type_e = "EXTERNAL"
    c = ocp.constraints
    low = np.array([-e.STROKE, 0.0, 0.0, 0.0, 0.02, 0.0, 0.0]) / SIZE
    high = np.array([e.STROKE, 0.0, e.LARGEST, e.LARGEST, 1.0, e.LARGEST, e.LARGEST]) / SIZE
    stop, within = e.STOP / SIZE[0], [0, 2, 3, 4, 5, 6]
    c.idxbx, c.lbx, c.ubx = np.array(within), low[within], high[within]
    c.idxbx_0, c.idxbxe_0, c.idxbx_e = np.arange(7), np.arange(2), np.arange(7)
    c.lbx_0, c.ubx_0 = (np.array([-stop, *side[1:]]) for side in (low, high))
    c.lbx_e, c.ubx_e = (np.array([stop, *side[1:]]) for side in (low, high))
    c.idxbu, c.lbu, c.ubu = np.arange(2), np.zeros(2), np.full(2, e.LARGEST)
    c.lh = np.array([0.0, 0.0, -1.0, -1.0, -FREE])
    c.uh = np.array([FREE, FREE, 1.0, 1.0, FREE])
    c.lh_e, c.uh_e = np.zeros(2), np.full(2, FREE)
    # at the start the copies are the pressures, at the end they are those of the other muscle
    copies = np.zeros((2, 7))
    copies[:, 5:] = -np.eye(2)
    c.C, c.C_e, c.D = copies.copy(), copies.copy(), np.zeros((2, 2))
    c.C[[0, 1], [2, 3]] = c.C_e[[0, 1], [3, 2]] = 1.0
    c.lg, c.ug = np.full(2, -FREE), np.full(2, FREE)
    c.lg_e = c.ug_e = np.zeros(2)
    o = ocp.solver_options
    o.tf, o.integrator_type, o.nlp_solver_type = 1.0, "ERK", "SQP"
    o.sim_method_num_stages = o.sim_method_num_steps = 4
    o.qp_solver, o.qp_solver_iter_max = "FULL_CONDENSING_HPIPM", 200
    o.hessian_approx, o.regularize_method = "EXACT", "PROJECT"
    o.globalization, o.nlp_solver_max_iter, o.nlp_solver_tol_stat = "FIXED_STEP", 200, 1e-6
    o.print_level = 0
    return ocp


def set_guess(solver):
    """x linear in time, the rest constant."""
    solver.reset()
    for k in range(N + 1):
        place = -e.STOP + 2 * e.STOP * k / N
        solver.set(k, "x", np.array([place, 0.2, 3.0, 3.0, e.GUESS, 3.0, 3.0]) / SIZE)
        if k < N:
            solver.set(k, "u", np.array([3.0, 3.0]))


def main():
    begin, folder = e.clock(), tempfile.mkdtemp()
    try:
        os.chdir(folder)
        solver = AcadosOcpSolver(state_problem(folder), json_file="ocp.json", verbose=False)
        solver.constraints_set(0, "lh", np.array([0.0, 0.0, -1.0, -1.0, 0.0]))
        solver.constraints_set(0, "uh", np.array([FREE, FREE, 1.0, 1.0, 0.0]))
        solver.constraints_set(0, "lg", np.zeros(2))
        solver.constraints_set(0, "ug", np.zeros(2))

        def solved():
            if status := solver.solve():
                solver.print_statistics()
                raise SystemExit(f"the solver ended with status {status}")

        first, best, _ = e.repeated(solved, begin, prepare=lambda: set_guess(solver))
        states = np.array([solver.get(k, "x") * SIZE for k in range(N + 1)])
        inputs = np.array([solver.get(k, "u") for k in range(N)])
        iterations = int(np.ravel(solver.get_stats("sqp_iter"))[0])
    finally:
        os.chdir("/")
        shutil.rmtree(folder, ignore_errors=True)
    name, motion = "acados: shooting, RK4 x 4, SQP, compiled", states[:, :4].T
    e.report(name, first, best, iterations, states[0, 4], motion, inputs[:, :, None])


main()
