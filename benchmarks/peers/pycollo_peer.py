"""Pycollo: Legendre-Gauss-Lobatto, 50 sections of four points, input joined at their ends."""

import contextlib
import io

import equations as e
import numpy as np
import pycollo
import sympy

N, POINTS = e.INTERVALS, 4


def state_problem():
    """The problem, scaled by the tool from its bounds."""
    problem = pycollo.OptimalControlProblem(name="PAM-2DIR")
    x, v, p1, p2, u1, u2 = sympy.symbols("x v p1 p2 u1 u2")
    phase = problem.new_phase(name="A", state_variables=[x, v, p1, p2], control_variables=[u1, u2])
    slopes = e.slopes(x, v, p1, p2, u1, u2, exp=sympy.exp)
    phase.state_equations = dict(zip((x, v, p1, p2), slopes, strict=True))
    rates = [(u1 - p1) / e.LAG, (u2 - p2) / e.LAG]
    phase.path_constraints = [*e.forces(x, p1, p2, exp=sympy.exp), *rates]
    phase.auxiliary_data = {}
    pressure = [0.0, e.LARGEST]
    bounds, guess, settings = phase.bounds, phase.guess, problem.settings
    bounds.initial_time, bounds.final_time = 0.0, [0.02, 1.0]
    # it scales from bounds, so even what has no limit needs one that is wide enough
    bounds.state_variables = {x: [-e.STROKE, e.STROKE], v: [-10.0, 10.0]}
    bounds.state_variables |= {p1: pressure, p2: pressure}
    bounds.control_variables = {u1: pressure, u2: pressure}
    bounds.initial_state_constraints = {x: [-e.STOP, -e.STOP], v: [0.0, 0.0]}
    bounds.final_state_constraints = {x: [e.STOP, e.STOP], v: [0.0, 0.0]}
    bounds.path_constraints = [[0.0, 3000.0]] * 2 + [[-e.RATE, e.RATE]] * 2
    guess.time = [0.0, e.GUESS]
    guess.state_variables = [[-e.STOP, e.STOP], [0.2, 0.2], [3.0, 3.0], [3.0, 3.0]]
    guess.control_variables = [[3.0, 3.0], [3.0, 3.0]]
    start, end = phase.initial_state_variables, phase.final_state_variables
    f1, f2 = e.forces(start[0], start[2], start[3], exp=sympy.exp)
    problem.objective_function = phase.final_time_variable
    problem.endpoint_constraints = [end[2] - start[3], end[3] - start[2], f1 - f2]
    problem.bounds.endpoint_constraints = [[0.0, 0.0]] * 3
    phase.mesh.number_mesh_sections, phase.mesh.number_mesh_section_nodes = N, POINTS
    settings.max_mesh_iterations, settings.nlp_tolerance = 1, 1e-8
    settings.display_mesh_result_info = settings.display_mesh_refinement_info = False
    return problem


def main():
    begin = e.clock()
    with contextlib.redirect_stdout(io.StringIO()):
        problem = state_problem()
        problem.solve()
    first = e.clock(), e.clock() - begin
    back, found = problem._backend, problem.solution
    stats = back.nlp_solver.stats()
    if not stats["success"]:
        raise SystemExit(stats["return_status"])
    with contextlib.redirect_stdout(io.StringIO()):
        _, best, _ = e.repeated(back.solve_nlp, begin)
    share, nodes = (np.asarray(found.tau[0]) + 1) / 2, POINTS - 1
    state, control = np.asarray(found.state[0]), np.asarray(found.control[0])
    pieces = [control[:, nodes * k : nodes * k + POINTS] for k in range(N)]
    name, iterations = f"pycollo: LGL {N} x {POINTS}, input at the points", stats["iter_count"]
    duration, points = found.final_time[0], share[:POINTS] * N
    pieces = np.array(pieces)
    e.report(name, first, best, iterations, duration, state[:, ::nodes], pieces, points=points)


main()
