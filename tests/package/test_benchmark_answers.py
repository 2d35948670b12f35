"""benchmarks/peers/answers.py: what other tools answer is verified; a wrong answer is seen."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks" / "peers"


@pytest.fixture(scope="module")
def answers():
    sys.path.insert(0, str(FOLDER))
    try:
        import answers

        yield answers
    finally:
        sys.path.remove(str(FOLDER))
        for name in ("answers", "equations"):  # short names, which others may want
            sys.modules.pop(name, None)


@pytest.fixture
def plan(answers):
    """A motion of held inputs over four intervals, by another integrator than the verifier's."""
    e = answers.e
    inputs, duration = np.array([[3.5, 2.5], [3.0, 3.0], [2.5, 3.5], [3.0, 3.0]]), 0.1
    states, breaks = [np.array([0.0, 0.0, 3.0, 3.0])], np.linspace(0, 1, 5)
    for u in inputs:
        run = solve_ivp(
            lambda t, z, u=u: e.slopes(*z, *u),
            (0, duration / 4),
            states[-1],
            "LSODA",
            rtol=1e-11,
            atol=1e-12,
        )
        states.append(run.y[:, -1])
    return {
        "states": np.array(states).T.tolist(),
        "inputs": inputs[:, :, None].tolist(),
        "duration": duration,
        "breaks": breaks.tolist(),
        "points": [0.0],
    }


def test_a_right_motion_has_no_error(answers, plan):
    assert answers.plan_error(plan) < 1e-8


@pytest.mark.parametrize(("state", "off", "error"), [(0, 0.003, 0.1), (2, 0.6, 0.1)])
def test_a_wrong_state_is_seen_in_its_unit(answers, plan, state, off, error):
    plan["states"][state][-1] += off
    assert answers.plan_error(plan) == pytest.approx(error, rel=1e-4)


def test_inputs_are_polynomials_through_their_points(answers, plan):
    """Two equal values are the held input again; two that differ are another motion."""
    plan["inputs"] = [[[u[0], u[0]] for u in pair] for pair in plan["inputs"]]
    plan["points"] = [0.2, 0.9]
    assert answers.plan_error(plan) < 1e-8
    plan["inputs"][0][0][1] += 1.0
    assert answers.plan_error(plan) > 1e-3


@pytest.fixture
def task(answers):
    """States and inputs within all that is asked; made up, and no motion of the plant."""
    e = answers.e
    kappa = e.CONTRACTION - e.STOP / e.LENGTH, e.CONTRACTION + e.STOP / e.LENGTH
    hold = []  # the force on both muscles at the start, linear in pressure there
    for k in kappa:
        bend = np.exp(e.A3 * k)
        hold.append((e.A1 * bend + e.A4 * k + e.A5, e.A2 * bend + e.A6))
    p1 = 2.0
    p2 = (hold[0][0] * p1 + hold[0][1] - hold[1][1]) / hold[1][0]
    assert 0 < p2 < e.LARGEST
    x = [-e.STOP, 0.0, e.STOP]
    states = [x, [0.0, 0.5, 0.0], [p1, 3.0, p2], [p2, 3.0, p1]]
    inputs = [[[p1], [p2]], [[3.0], [3.0]]]
    common = {"duration": 0.1, "breaks": [0.0, 0.5, 1.0], "points": [0.0]}
    return {"states": states, "inputs": inputs, **common}


def test_what_keeps_ends_and_limits_misses_nothing(answers, task):
    assert answers.plan_miss(task) < 1e-12


@pytest.mark.parametrize(
    ("state", "node", "value", "miss"),
    [
        (1, 0, 0.2, 0.2),  # not at rest at the start, 0.2 m/s
        (1, -1, 0.3, 0.3),  # nor at the end
        (0, 1, 0.019, 0.1),  # beyond the stroke by 3 mm
        (2, 1, 6.6, 0.1),  # beyond 6 bar by 0.6
    ],
)
def test_what_breaks_one_is_told_by_how_much(answers, task, state, node, value, miss):
    if state == 2:
        task["inputs"][1][0] = [6.0]  # which holds the rate
    task["states"][state][node] = value
    assert answers.plan_miss(task) == pytest.approx(miss, rel=1e-9)


def test_a_rate_a_force_and_a_mirrored_end_are_asked_for(answers, task):
    e = answers.e
    quick = [[list(u) for u in pair] for pair in task["inputs"]]
    quick[1][0][0] += 1.5 * e.RATE * e.LAG  # beyond the rate by a half of it
    assert answers.plan_miss({**task, "inputs": quick}) == pytest.approx(0.5)
    pushed = [list(s) for s in task["states"]]
    pushed[2][-1] += 0.6
    assert answers.plan_miss({**task, "states": pushed}) == pytest.approx(0.1)
    slack = [list(s) for s in task["states"]]
    slack[2][1] = 0.1
    pull = e.forces(0.0, 0.1, 3.0)[0]
    assert pull < 0
    held = [task["inputs"][0], [[0.1], [3.0]]]
    miss = answers.plan_miss({**task, "states": slack, "inputs": held})
    assert miss == pytest.approx(-pull / 100)


def test_the_least_squares_are_the_least(answers):
    cells = answers.Measurements(60)
    assert cells.excess(answers.TRUTH.tolist()) > 0  # the truth is not the fit of noisy cells
    shifted = [*answers.TRUTH[:5], answers.TRUTH[5] + 10.0]
    assert cells.excess(shifted) > cells.excess(answers.TRUTH.tolist())
