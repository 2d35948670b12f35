"""Plans by arcs: motions whose switching times are known in closed form.

Sources: the double integrator and the oscillator after Bryson, Ho, Applied Optimal Control, 1975,
sections 3.9 and 7.1; Breakwell's problem section 3.11; the seven arcs of a motion with limits of
velocity, acceleration and jerk follow by counting: T = d/v + v/a + a/j.
"""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.planning.transcription.mesh import Collocation

TIGHT = 1e-7
UNITS = ["m", "m/s", "m/s2", "m/s3"]


def chain(count: int, most: float = 1.0, **limits: float) -> pam.Plant:
    """x, v, a, ...: integrators in a row behind an input."""
    plant = pam.Plant("chain")
    names = "xva"[:count]
    states = [
        plant.state(
            name,
            unit=unit,
            nominal=1.0,
            min=-limits.get(name, np.inf),
            max=limits.get(name, np.inf),
        )
        for name, unit in zip(names, UNITS, strict=False)
    ]
    u = plant.input("u", unit=UNITS[count], min=-most, max=most, nominal=1.0)
    for state, rate in zip(states, [*states[1:], u], strict=True):
        plant.der(state, rate)
    return plant


def at(count: int, x: float) -> dict[str, float]:
    return {name: x if name == "x" else 0.0 for name in "xva"[:count]}


def planned(plant: pam.Plant, stops: list[dict[str, float]], **asked: object) -> pam.planning.Plan:
    method = asked.pop("method", pam.Arcs(8, 5))
    return pam.plan(plant, stops, rest=False, method=method, tolerance=TIGHT, **asked)


def told(plan: pam.planning.Plan, name: str = "u") -> list[str]:
    return [arc.active for arc in plan.arcs if arc.input == name]


def ends(plan: pam.planning.Plan, name: str = "u") -> list[float]:
    return [arc.end for arc in plan.arcs if arc.input == name]


def replayed_by_scipy(plan: pam.planning.Plan) -> float:
    """Largest deviation at the plan's samples, in nominals, of SciPy's DOP853 at 1e-10."""
    plant, motion = plan.plant, plan.trajectory
    signals = motion.signals
    p, nominal = plant.vector("parameter"), plant.vector("state", attribute="nominal")
    states = motion.array(motion.named("state"))
    x, worst, powers = states[0], 0.0, np.arange(signals.degree + 1)
    for k, (begin, end) in enumerate(zip(signals.breaks[:-1], signals.breaks[1:], strict=True)):

        def slope(t, z, begin=begin, c=signals.coefficients[k]):
            return np.asarray(plant.function(z, ((t - begin) ** powers) @ c, p)[0], float).ravel()

        own = (motion.t > begin + 1e-12) & (motion.t <= end + 1e-12)
        run = solve_ivp(
            slope, (begin, end), x, "DOP853", np.minimum(motion.t[own], end), rtol=1e-10, atol=1e-12
        )
        worst = max(worst, float(np.max(np.abs(run.y.T - states[own]) / nominal)))
        x = run.y[:, -1]
    return worst


@pytest.mark.parametrize(("distance", "most"), [(1.0, 1.0), (0.3, 2.5)])
def test_a_rest_to_rest_motion_of_a_mass_has_two_arcs(distance, most):
    plan = planned(chain(2, most), [at(2, 0.0), at(2, distance)])
    expected = 2 * np.sqrt(distance / most)
    assert plan.verified
    assert plan.statistics["intervals"] == 2
    assert plan.duration == pytest.approx(expected, rel=1e-8)
    assert told(plan) == ["u max", "u min"]
    assert ends(plan) == pytest.approx([expected / 2, expected], rel=1e-7)
    assert replayed_by_scipy(plan) < TIGHT


def test_a_limit_of_velocity_adds_an_arc():
    plan = planned(chain(2, v=0.5), [at(2, 0.0), at(2, 1.0)])
    assert plan.statistics["intervals"] == 3
    assert told(plan) == ["u max", "v max", "u min"]
    assert ends(plan) == pytest.approx([0.5, 2.0, 2.5], abs=1e-7)


def test_limits_of_velocity_acceleration_and_jerk_make_seven_arcs():
    plan = planned(chain(3, 4.0, v=1.0, a=1.0), [at(3, 0.0), at(3, 3.0)])
    assert plan.verified
    assert plan.statistics["intervals"] == 7
    assert told(plan) == ["u max", "a max", "u min", "v max", "u min", "a min", "u max"]
    assert ends(plan) == pytest.approx([0.25, 1.0, 1.25, 3.0, 3.25, 4.0, 4.25], abs=1e-7)
    assert replayed_by_scipy(plan) < TIGHT


def test_three_integrators_switch_at_a_quarter_and_three():
    plan = planned(chain(3), [at(3, 0.0), at(3, 1.0)])
    assert plan.duration == pytest.approx(32 ** (1 / 3), rel=1e-8)
    assert np.array(ends(plan)) / plan.duration == pytest.approx([0.25, 0.75, 1.0], abs=1e-7)


def test_an_oscillator_switches_where_its_circles_meet():
    """x'' = -x + u from (0, 0) to (1, 0): circles about (1, 0) and (-1, 0) in the plane of phases.

    On the first cos t = 1 - x; on the second, through (1, 0), (x + 1)^2 + v^2 = 4: they meet at
    x = 3/4.
    """
    plant = pam.Plant("oscillator")
    x = plant.state("x", unit="m", nominal=1.0)
    v = plant.state("v", unit="m/s", nominal=1.0)
    u = plant.input("u", unit="m/s2", min=-1.0, max=1.0, nominal=1.0)
    plant.der(x, v)
    plant.der(v, u - x)
    plan = planned(plant, [at(2, 0.0), at(2, 1.0)])
    first, second = np.arccos(0.25), np.arccos(1.75 / 2.0)
    assert told(plan) == ["u max", "u min"]
    assert ends(plan) == pytest.approx([first, first + second], abs=1e-7)
    assert replayed_by_scipy(plan) < TIGHT


def test_an_arc_along_a_limit_of_second_order_is_found():
    """Breakwell: least integral of u^2/2 between v = 1 and v = -1 under x <= l is 4/(9 l), along
    the limit from 3 l to 1 - 3 l."""
    limit = 0.1
    plant = chain(2, 40.0, x=limit)
    stops = [{"x": 0.0, "v": 1.0}, {"x": 0.0, "v": -1.0}]
    plan = planned(plant, stops, duration=1.0, minimise={"square(u)": 0.5})
    assert plan.objective == pytest.approx(4 / (9 * limit), rel=1e-7)
    assert told(plan) == ["interior", "x max", "interior"]
    assert ends(plan) == pytest.approx([3 * limit, 1 - 3 * limit, 1.0], abs=1e-4)
    assert np.max(plan.replay.trajectory["x"]) <= limit + TIGHT


def test_each_leg_between_stops_has_its_own_arcs():
    stops = [at(2, 0.0), at(2, 1.0), at(2, -0.5)]
    plan = planned(chain(2, v=0.6), stops)
    assert plan.statistics["intervals"] == 6
    assert len(plan.durations) == 2
    # passing stop 2 at rest: each leg takes d/v + v/u
    assert plan.durations == pytest.approx([1 / 0.6 + 0.6, 1.5 / 0.6 + 0.6], abs=1e-7)


def test_a_leg_of_fixed_duration_keeps_it():
    """Least integral of u^2 under |u| <= 4 in 1.1 s: u = 4 to t1, on a line to -4, and so on.

    With h half the time and s the line's length to zero, half of the way is 1/2 = 2 h^2 - 2 s^2/3,
    and the integral is 32 (h - s) + 32 s/3.
    """
    plan = planned(chain(2, 4.0), [at(2, 0.0), at(2, 1.0)], duration=1.1, minimise="effort")
    h = 0.55
    s = np.sqrt(3 * (h**2 - 1 / 4))
    assert plan.duration == pytest.approx(1.1, abs=1e-9)
    assert told(plan) == ["u max", "interior", "u min"]
    assert plan.objective == pytest.approx(32 * (h - s) + 32 * s / 3, rel=1e-8)
    # times by the root of that: the objective hardly depends on them
    assert ends(plan)[:2] == pytest.approx([h - s, h + s], abs=2e-4)


def test_two_inputs_have_arcs_of_their_own():
    """Two masses that arrive together: the slower one sets the time, and switches in the middle."""
    plant = pam.Plant("masses")
    for i, most in ((1, 1.0), (2, 1.5)):
        x = plant.state(f"x{i}", unit="m", nominal=1.0)
        v = plant.state(f"v{i}", unit="m/s", nominal=1.0)
        u = plant.input(f"u{i}", unit="m/s2", min=-most, max=most, nominal=1.0)
        plant.der(x, v)
        plant.der(v, u)
    stops = [{"x1": x, "v1": 0.0, "x2": x, "v2": 0.0} for x in (0.0, 1.0)]
    plan = planned(plant, stops)
    assert plan.verified
    assert plan.duration == pytest.approx(2.0, rel=1e-7)
    assert told(plan, "u1") == ["u1 max", "u1 min"]
    assert ends(plan, "u1")[0] == pytest.approx(1.0, abs=1e-6)
    assert replayed_by_scipy(plan) < TIGHT


def test_the_costates_of_a_plan_by_arcs_are_those_of_theory():
    """T = 2 sqrt(d): dT/dd = 1 at d = 1, so lambda_x = -1."""
    plan = planned(chain(2), [at(2, 0.0), at(2, 1.0)])
    assert plan.costates["x"] == pytest.approx(-1.0, abs=1e-4)
    assert plan.stop_sensitivities["stop 2: x"] == pytest.approx(1.0, abs=1e-4)


def test_arcs_survive_files_and_processes(tmp_path):
    plan = planned(chain(2), [at(2, 0.0), at(2, 1.0)])
    loaded = pam.load_plan(plan.save(tmp_path / "plan.npz"), plan.plant)
    assert loaded.verified
    for other in (loaded, pickle.loads(pickle.dumps(plan))):
        assert told(other) == ["u max", "u min"]
        assert ends(other) == pytest.approx(ends(plan), rel=1e-12)


def test_a_plan_of_held_inputs_names_its_arcs_to_the_mesh():
    method = Collocation(20, 3)
    plan = planned(chain(2), [at(2, 0.0), at(2, 1.0)], method=method)
    assert told(plan) == ["u max", "u min"]
    assert ends(plan)[0] == pytest.approx(1.0, abs=0.051)


def test_a_planner_moves_the_switches_with_the_task():
    plant = chain(2)
    planner = pam.Planner(plant, [at(2, 0.0), at(2, 1.0)], rest=False, method=pam.Arcs())
    first = planner(tolerance=TIGHT)
    second = planner(stops=[at(2, 0.0), at(2, 2.0)], guess=first, tolerance=TIGHT)
    assert second.duration == pytest.approx(2 * np.sqrt(2), rel=1e-8)


def test_counts_that_cannot_be_meant_are_refused():
    refused("degree", pam.Arcs, degree=1)
    refused("intervals", pam.Arcs, 0)
