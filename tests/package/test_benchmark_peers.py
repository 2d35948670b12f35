"""benchmarks/peers: what other tools answer is verified, a wrong answer is seen; failures stay in
the table.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit
from scipy.stats import t as student

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks" / "peers"
NAMES = ("answers", "environments", "equations", "run")
"""Of modules there; "run" is a name of others, too."""


@pytest.fixture(scope="module")
def peers():
    """The modules of the peers, by name."""
    before = {n: sys.modules.pop(n, None) for n in NAMES}
    path = list(sys.path)
    sys.path.insert(0, str(FOLDER))
    try:
        yield {n: __import__(n) for n in NAMES}
    finally:
        sys.path[:] = path
        for name, module in before.items():
            del sys.modules[name]
            if module is not None:
                sys.modules[name] = module


@pytest.fixture
def answers(peers):
    return peers["answers"]


def test_the_plants_equations_are_those_of_the_peers(peers):
    peers["run"].check_equations()


def integrated(e, commands, ends, start):
    """States at the ends of intervals, by SciPy's Radau: not the method that verifies."""
    states = [np.array(start, float)]
    for begin, end, command in zip(ends[:-1], ends[1:], commands, strict=True):

        def slope(t, z, u=command):
            return e.slopes(*z, *u(t))

        run = solve_ivp(slope, (begin, end), states[-1], method="Radau", rtol=1e-10, atol=1e-12)
        states.append(run.y[:, -1])
    return np.array(states).T


@pytest.mark.slow
def test_the_error_of_a_simulation(peers):
    e = peers["equations"]
    t, u = peers["answers"].simulated_inputs()
    commands = [lambda s: [np.interp(s, t, row) for row in u]] * (len(t) - 1)
    states = integrated(e, commands, t, e.REST)
    assert peers["answers"].simulation_error({"states": states}) < 1e-7
    states[2, 50] += 0.6
    assert peers["answers"].simulation_error({"states": states}) == pytest.approx(0.1, rel=1e-4)


def test_the_optimum_and_the_intervals_of_a_fit(peers):
    """SciPy's curve_fit is at the optimum; linearised ends are near those of the profile, half
    as wide ones are not.
    """
    answers = peers["answers"]
    cells = answers.Measurements(60)
    assert len(cells.force) == 60

    def law(_, *a):
        return cells.law(np.array(a))

    found, covariance = curve_fit(law, None, cells.force, answers.TRUTH, xtol=1e-14, ftol=1e-14)
    assert abs(cells.excess(found)) < 1e-10
    assert cells.excess([found[0], found[1] + 1, *found[2:]]) > 1e-4
    half = student.ppf(0.975, 54) * np.sqrt(np.diag(covariance))
    assert cells.ends(np.stack([found - half, found + half], 1)) < 0.1
    assert cells.ends(np.stack([found - half / 2, found + half / 2], 1)) == pytest.approx(
        0.5, abs=0.05
    )


def test_what_fails_is_listed_with_its_message(peers, monkeypatch, tmp_path, capsys):
    environments, run = peers["environments"], peers["run"]
    scripts = {
        "good": 'import json; print("RESULT " + json.dumps('
        '{"name": "good one", "whole": 2.0, "first": 1.0, "solve": 0.5, "v": 3.0}))',
        "broken": 'raise ValueError("no such thing")',
        "silent": "pass",
    }
    for name, text in scripts.items():
        (tmp_path / f"{name}_peer.py").write_text(text, "utf-8")
    monkeypatch.setattr(environments, "HERE", tmp_path)
    monkeypatch.setattr(environments, "CACHE", tmp_path)
    monkeypatch.setattr(environments, "OWN", tuple(scripts))
    ways = (("good",), ("broken",), ("silent",), ("absent",))
    task = run.Task("task", ways, lambda found: {"error": found["v"]})
    monkeypatch.setattr(run, "OWN", tuple(scripts))
    figures = run.compare(task, ["absent"], 2)
    assert figures == {
        "good one": {"whole": 1.0, "first": 1.0, "solve": 1.0, "error": 3.0},
        "broken": "failed: ValueError: no such thing",
        "silent": "failed: it printed nothing",
        "absent": "not installed (--install)",
        "base": {"whole": 2.0, "first": 1.0, "solve": 0.5},
    }
    assert json.loads(json.dumps(figures)) == figures
    assert "failed: ValueError: no such thing" in capsys.readouterr().out


def test_an_environment_that_cannot_be_made_is_told(peers, monkeypatch, tmp_path):
    environments = peers["environments"]
    (tmp_path / "peers").write_text("a file where a folder should be", "utf-8")
    monkeypatch.setattr(environments, "CACHE", tmp_path / "peers")
    failed = environments.install(["lmfit"])
    assert list(failed) == ["lmfit"]
    assert failed["lmfit"].startswith("not installed: ")


# ---- answers made by hand ------------------------------------------------------------------------
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
