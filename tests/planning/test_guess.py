"""Where a plan's solver starts: minimum-jerk paths, inputs that drive them, other solutions."""

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp import Collocation
from pam_ocp.core.signals import PiecewisePolynomial
from pam_ocp.judge.statement import Statement
from pam_ocp.planning import Shooting
from pam_ocp.planning.problem.formulation import formulate
from pam_ocp.planning.starts import tasks
from pam_ocp.planning.transcription.guess import (
    by_leading,
    by_rests,
    by_stops,
    from_solution,
    rest_point,
    wants_balance,
)
from pam_ocp.planning.transcription.solution import Solution, unpack
from pam_ocp.planning.transcription.transcription import is_nonsmooth, smoothed_at


def geared(limit=30.0):
    """x' = v/2, v' = u - 3 x: velocities twice the slope, 3 x holds it at rest."""
    plant = pam.Plant("geared")
    v = plant.state("v", unit="m/s", nominal=2.5)
    x = plant.state("x", unit="m", nominal=0.4, min=-2.0, max=2.0)
    u = plant.input("u", unit="N", min=-limit, max=limit, nominal=3.0, start=0.7)
    k = plant.parameter("k", 3.0, min=0.0)
    plant.der(x, v / 2)
    plant.der(v, u - k * x)
    return plant


def unpacked(guess, problem, mesh):
    """(times, states, inputs, durations): of all points, and of all values of the inputs."""
    legs = len(problem.legs)
    tail = len(guess) - legs - len(problem.design) - problem.m.numel()
    durations = guess[tail : tail + legs] * problem.time_nominals
    x_nominal, u_nominal, at = np.array([2.5, 0.4]), 3.0, 2
    t, states, when, inputs, begin = [0.0], [guess[:2] * x_nominal], [], [], 0.0
    for interval in mesh.intervals:
        h = durations[interval.leg] * interval.fraction
        taus, own = (mesh.form.state_taus(interval.degree), mesh.form.input_taus(interval.degree))
        for tau in taus:
            t.append(begin + h * tau)
            states.append(guess[at : at + 2] * x_nominal)
            at += 2
        for tau in own:
            when.append(begin + h * tau)
            inputs.append(guess[at] * u_nominal)
            at += 1
        begin += h
    assert at == tail
    return np.array(t), np.array(states), np.array(when), np.array(inputs), durations


STOPS = [{"x": 0.1}, {"x": (0.5, 0.7)}, {"x": -0.2}]
PHASES = [pam.Phase(duration=0.8), pam.Phase(duration=0.5)]


def minimum_jerk(t):
    """(positions, slopes) through 0.1, 0.6 and -0.2 in 0.8 and 0.5 s."""
    second = t > 0.8
    a, b = np.where(second, 0.6, 0.1), np.where(second, -0.2, 0.6)
    s, span = np.where(second, (t - 0.8) / 0.5, t / 0.8), np.where(second, 0.5, 0.8)
    return (
        a + (b - a) * (10 * s**3 - 15 * s**4 + 6 * s**5),
        (b - a) * (30 * s**2 - 60 * s**3 + 30 * s**4) / span,
    )


@pytest.mark.parametrize("method", [Collocation(3, 3), Shooting(4, 2), Collocation(2, 4, "linear")])
def test_positions_run_by_minimum_jerk_and_velocities_with_them(method):
    problem = formulate(geared(), Statement(STOPS, phases=PHASES, minimise="effort"))
    mesh = method.mesh(2)
    t, states, _, inputs, durations = unpacked(by_stops(problem, mesh), problem, mesh)
    x, slope = minimum_jerk(t)
    assert durations == pytest.approx([0.8, 0.5])
    assert states[:, 1] == pytest.approx(x, abs=1e-9)
    assert states[:, 0] == pytest.approx(2 * slope, abs=1e-6)
    assert inputs == pytest.approx(np.full(len(inputs), 0.7))  # where the plant's own stands


def test_balanced_inputs_are_the_nearest_of_24_levels_to_those_that_move_the_plant():
    problem = formulate(geared(), Statement(STOPS, phases=PHASES, minimise="effort"))
    mesh = Collocation(4, 3, "linear").mesh(2)
    t, states, when, inputs, _ = unpacked(by_stops(problem, mesh, balanced=True), problem, mesh)
    assert states[:, 1] == pytest.approx(minimum_jerk(t)[0], abs=1e-6)
    assert states[0, 0] == pytest.approx(0.0, abs=1e-9)
    level = 60 / 23
    spring = 3 * minimum_jerk(np.array(when))[0]  # velocities of the nodes do not change: v' = 0
    assert np.abs(inputs - spring).max() <= 0.51 * level + 0.1


def test_a_point_of_rest_balances_the_springs_and_keeps_the_limits():
    problem = formulate(geared(), Statement(STOPS, phases=PHASES, minimise="effort"))
    assert rest_point(problem, {"x": 0.4})[0] == pytest.approx([0.0, 0.4], abs=1e-7)
    assert rest_point(problem, {"u": 1.5})[0] == pytest.approx([0.0, 0.5], abs=1e-6)


def test_closed_valves_rest_where_both_pulls_are_within_their_limits():
    """v' = (p1 - 2) - (p2 - 3), both pulls at least zero; what a closed valve holds has no slope,
    and of what a stop names too much may be said.
    """
    plant = pam.Plant("pair")
    x, v = plant.state("x", unit="m", nominal=1.0), plant.state("v", unit="m/s", nominal=1.0)
    pulls = []
    for name, least in (("1", 2.0), ("2", 3.0)):
        p = plant.state(f"p{name}", nominal=1.0, start=1.0, min=0.0, max=9.0)
        u = plant.input(f"u{name}", min=-1.0, max=1.0, nominal=1.0)
        plant.der(p, ca.fmax(u - 0.1, 0) * (9 - p) + ca.fmin(u + 0.1, 0) * p)
        pulls.append(plant.constraint(f"pull{name}", p - least, min=0.0))
    tank = plant.state("tank", nominal=1.0, start=5.0)
    plant.der(tank, 5 - tank)
    plant.der(x, v)
    plant.der(v, pulls[0] - pulls[1])
    stops = [{"x": 0.1}, {"x": 0.3}]
    problem = formulate(plant, Statement(stops, duration=1.0, minimise="effort"))

    def pressures(**named):
        point = rest_point(problem, {"x": 0.1, "tank": 5.0} | named)
        return None if point is None else point[0][2:4]

    assert pressures() == pytest.approx([2.0, 3.0], abs=1e-6)
    assert pressures(p1=2.5) == pytest.approx([2.5, 3.5], abs=1e-6)
    assert pressures(p2=1.0) is None  # both would pull with -2


def test_free_durations_start_at_their_usual_ones_within_their_range():
    def durations(duration, stretch=1.0):
        problem = formulate(geared(), Statement([{"x": 0.0}, {"x": 0.5}], duration=duration))
        mesh = Collocation(2, 2).mesh(1)
        usual = problem.time_nominals
        return unpacked(by_stops(problem, mesh, stretch=stretch), problem, mesh)[4], usual

    found, usual = durations(None)
    assert found == pytest.approx(usual)
    found, usual = durations(None, 1.5)
    assert found == pytest.approx(1.5 * usual)
    assert durations((20.0, 30.0), 0.1)[0] == pytest.approx([20.0])
    assert durations((0.01, 0.02), 9.0)[0] == pytest.approx([0.02])


def test_another_solution_is_followed_on_the_new_mesh():
    """Between its points by lines; inputs on this side of each jump."""
    problem = formulate(
        geared(), Statement([{"x": 0.1}, {"x": 0.5}], duration=2.0, minimise="effort")
    )
    known = np.array([0.0, 0.5, 2.0])
    table = np.array([[0.0, 0.1], [0.4, 0.2], [1.0, 0.5]])
    inputs = PiecewisePolynomial(np.array([0.0, 1.0, 2.0]), np.array([[[2.0]], [[-5.0]]]))
    solution = Solution(known, table, inputs, np.array([2.0]), np.zeros(0), np.zeros(0))
    mesh = Collocation(2, 3).mesh(1)
    guess = from_solution(problem, mesh, solution)
    t, states, when, found, _ = unpacked(guess, problem, mesh)
    for i in range(2):
        assert states[:, i] == pytest.approx(np.interp(t, known, table[:, i]))
    assert list(when) == [0.0, 1.0]
    assert found == pytest.approx([2.0, -5.0])
    two = Solution(known, table, inputs, np.array([1.0, 1.0]), np.zeros(0), np.zeros(0))
    refused("a motion of 2 legs cannot start one of 1", from_solution, problem, mesh, two)


def test_designed_parameters_start_at_their_own_values_inside_their_ranges():
    for ends, start in (((1.0, 9.0), 3.0), ((4.0, 9.0), 4.0), ((0.5, 2.0), 2.0)):
        wish = Statement(
            [{"x": 0.1}, {"x": 0.5}], duration=1.0, minimise="effort", design={"k": ends}
        )
        problem = formulate(geared(), wish)
        mesh = Collocation(2, 2).mesh(1)
        own = by_stops(problem, mesh)[-1 - problem.m.numel()] * problem.design_nominals[0]
        assert own == pytest.approx(start)


def test_balance_is_wanted_where_positions_are_open_or_inputs_idle():
    def wanted(plant, stops):
        return wants_balance(formulate(plant, Statement(stops, duration=1.0, minimise="effort")))

    assert not wanted(geared(), [{"x": 0.1}, {"x": 0.5}])
    assert wanted(geared(), [{"v": 0.0}, {"v": 0.0}])
    closed = pam.Plant("closed")
    x, v, u = closed.state("x", unit="m"), closed.state("v", unit="m/s"), closed.input("u")
    closed.der(x, v)
    closed.der(v, u**3)
    assert wanted(closed, [{"x": 0.1}, {"x": 0.5}])
    assert not wanted(closed.with_values(u=0.5), [{"x": 0.1}, {"x": 0.5}])


def test_balance_is_wanted_with_the_widest_roundings_too():
    """Nothing is left to narrow there, but hysteresis has to be led all the same."""
    plant = pam.AntagonisticSlide("DMSP-20-200N", losses=pam.losses.BoucWen())
    stops = [{"x": -0.01}, {"x": 0.01}]
    program = pam.Planner(plant, stops, duration=0.5, minimise="effort")._program
    wide = smoothed_at(program, 0.0).problem
    assert is_nonsmooth(program.problem)
    assert not is_nonsmooth(wide)
    assert wants_balance(program.problem)
    assert wants_balance(wide)
    mesh = program.mesh
    (own,) = tasks(wide, mesh, 1)
    assert np.array_equal(own.guess, by_stops(wide, mesh, balanced=True))
    assert not np.allclose(own.guess, by_stops(wide, mesh, balanced=False))


def test_a_led_motion_keeps_the_plants_equations_along_the_stops():
    """Points between the stops are in balance at rest only; hysteresis needs what went before."""
    muscle = pam.muscle("DMSP-20-300")
    plant = pam.SeriesLoad(
        muscle, 11.0, 1e5, feed=pam.feeds.Regulator(0.1), losses=(pam.losses.BoucWen(15.0, 0.005),)
    )
    stops = [{"x": 0.017}, {"x": 0.002}]
    planner = pam.Planner(plant, stops, duration=2.0, minimise="effort")
    program = smoothed_at(planner._program, 0.0)
    problem, mesh, nlp = program.problem, program.mesh, program.nlp
    function = ca.Function("g", [nlp["x"], nlp["p"]], [nlp["g"]])

    def defect(guess):
        g = np.asarray(function(guess, program.parameters())).ravel()
        return max(
            np.abs(g[s.first_row : s.first_row + s.rows * len(s.members)]).max()
            for s in program.groups
        )

    led = by_leading(problem, mesh)
    assert defect(led) < 0.2 * min(defect(by_rests(problem, mesh)), defect(by_stops(problem, mesh)))
    solution = unpack(problem, mesh, led)
    t, states = solution.t, solution.states
    x = states[:, [v.name for v in plant.states].index("x")]
    assert x[0] == pytest.approx(0.017, abs=1e-6)
    assert x[-1] == pytest.approx(0.002, abs=5e-4)
    s = t / t[-1]
    path = 0.017 - 0.015 * s**3 * (10 - 15 * s + 6 * s**2)
    assert np.abs(x - path).max() < 1.5e-3
    memory = states[:, [v.name for v in plant.states].index("muscle.hysteresis")]
    assert np.abs(memory).max() <= 1.0 + 1e-9
    assert np.ptp(memory) > 0.5
