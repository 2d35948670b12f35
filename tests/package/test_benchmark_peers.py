"""benchmarks/peers: fits and simulations are verified, and failures stay in the table."""

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
