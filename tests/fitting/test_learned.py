"""What physics leaves out, learned along free runs: shapes, equations, bands, errors.

The records come from SciPy and equations that are written here.
"""

from __future__ import annotations

import pickle
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.fitting import GaussianProcess, Network, Residual, Splines, fit_residual
from pam_ocp.fitting.learned.residual import Visited, attached

SHAPES = (Network(4), GaussianProcess(8), Splines(4))


def mass() -> pam.Plant:
    """A driven mass on a linear spring: x'' = u - rate x - damping v."""
    plant = pam.Plant("mass", "a mass on a spring")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    u = plant.input("u", unit="m/s2")
    rate = plant.parameter("rate", 30.0, unit="1/s2", min=0.0)
    damping = plant.parameter("damping", 2.0, unit="1/s", min=0.0)
    plant.der(x, v)
    plant.der(v, u - rate * x - damping * v)
    return plant


def missing(x: Any, v: Any) -> Any:
    """What the mass has beside: a spring that hardens, friction of the second power."""
    return -40.0 * x**3 - 0.8 * v * np.abs(v)


def records(count: int, seed: int, beside: Any = missing, noise: float = 1e-4) -> list[Any]:
    """Motions under inputs that are held for 0.2 s, from rest."""
    random, t, found = np.random.default_rng(seed), np.arange(0, 4.001, 0.02), []
    plant = mass()
    for _ in range(count):
        steps = random.uniform(-20, 20, 21)

        def rates(time: float, s: np.ndarray, steps: np.ndarray = steps) -> list[float]:
            u = steps[min(int(time / 0.2 + 1e-9), 20)]
            return [s[1], u - 30 * s[0] - 2 * s[1] + beside(s[0], s[1])]

        run = solve_ivp(rates, (0, t[-1]), [0, 0], t_eval=t, max_step=0.02, rtol=1e-8, atol=1e-10)
        u = steps[np.minimum((t / 0.2 + 1e-9).astype(int), 20)]
        x, v = run.y + noise * random.standard_normal(run.y.shape) * [[1], [5]]
        variables = [plant.variable(n) for n in ("u", "x", "v")]
        found.append(pam.Trajectory(t, {"u": u, "x": x, "v": v}, variables, "previous"))
    return found


def physics(train: list[Any]) -> pam.fitting.FreeRunFit:
    return pam.fit_free_run(mass(), train, ["rate", "damping"], horizon=0.5, every=0.5, judge=False)


def visited(plant: pam.Plant) -> Visited:
    random = np.random.default_rng(3)
    return Visited(random.standard_normal((200, len(plant.states))), random.normal(0, 9, (200, 1)))


# ---- shapes --------------------------------------------------------------------------------------
@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_a_form_is_zero_where_it_begins_and_its_penalty_is_definite(shape: Any) -> None:
    samples = np.random.default_rng(1).standard_normal((100, 3))
    form = shape.form(samples, np.random.default_rng(2))
    s, w = ca.SX.sym("s", 3), ca.SX.sym("w", len(form.begin))
    value = ca.Function("value", [s, w], [form.value(s, w)])
    assert all(float(value(row, form.begin)) == 0.0 for row in samples[:5])
    assert np.linalg.eigvalsh(form.precision).min() > 0
    # far away it stays as large as it is among the samples
    weights = form.begin + np.random.default_rng(4).standard_normal(len(form.begin))
    near = max(abs(float(value(row, weights))) for row in samples)
    assert abs(float(value([1e3, -1e3, 1e3], weights))) < 5 * near + 5


def test_network_and_gaussian_process_are_their_formulas() -> None:
    samples = np.random.default_rng(1).standard_normal((60, 2))
    at, random = np.array([0.3, -1.1]), np.random.default_rng(5)
    form = Network(3).form(samples, random)
    w = random.standard_normal(len(form.begin))
    inner, behind = w[:9].reshape(3, 3, order="F"), w[9:]
    expected = behind[:3] @ np.tanh(inner[:, :2] @ at + inner[:, 2]) + behind[3]
    assert float(form.value(ca.SX(at), ca.SX(w))) == pytest.approx(expected, rel=1e-12)
    # a Gaussian process that follows its own posterior mean at its points
    form = GaussianProcess(6).form(samples, np.random.default_rng(5))
    wanted = random.standard_normal(6)
    w = np.linalg.solve(form.precision, wanted)
    rows = np.array([[float(form.value(ca.SX(s), ca.SX(e))) for e in np.eye(6)] for s in samples])
    assert rows.max() <= 1.0
    assert rows.min() >= 0.0
    assert w @ form.precision @ w == pytest.approx(wanted @ w)


def test_splines_reproduce_straight_lines_and_hold_their_ends() -> None:
    samples = np.linspace(-2, 2, 201)[:, None]
    form = Splines(5).form(samples, np.random.default_rng(0))
    low, high = np.quantile(samples, [0.01, 0.99])
    # weights in a row make the straight line through them: a property of cubic B-splines
    w = np.arange(8) - 1.0
    for s in (-1.5, 0.0, 0.7):
        expected = 5 * (s - low) / (high - low)
        assert float(form.value(ca.SX([s]), ca.SX(w))) == pytest.approx(expected, abs=1e-12)
    assert float(form.value(ca.SX([9.0]), ca.SX(w))) == pytest.approx(5.0)


# ---- equations -----------------------------------------------------------------------------------
def test_terms_are_added_and_travel_with_the_plant(tmp_path: Any) -> None:
    plant = mass()

    def declare(made: pam.Plant) -> dict[str, Any]:
        level = made.parameter("level", 2.0, unit="m/s2")
        slow = made.state("slow", start=0.5)
        made.der(slow, -slow)
        return {"v": level * slow - 3 * plant.expression("x")}

    more = plant.with_terms(declare)
    assert [v.name for v in more.states] == ["x", "v", "slow"]
    copies = [more, pickle.loads(pickle.dumps(more))]
    copies.append(pam.plants.load_plant(pam.plants.save_plant(more, tmp_path / "more.json")))
    for one in copies:
        rates = one.function([0.1, 0.2, 0.5], [1.0], one.vector("parameter"))[0]
        expected = [0.2, 1.0 - 3.0 - 0.4 + 1.0 - 0.3, -0.5]
        assert np.allclose(np.asarray(rates).ravel(), expected, rtol=1e-12)
    assert len(plant.states) == 2
    refused("a term of u, an input", plant.with_terms, lambda made: {"u": 1.0})


def test_a_plant_with_openings_keeps_them() -> None:
    load = pam.HangingLoad("DMSP-20-200N", 10.0, feed=pam.feeds.SpoolValve())
    more = load.with_terms(lambda made: {"v": -load.expression("v")})
    assert [o.name for o in more.openings] == [o.name for o in load.openings]
    inside, before = more.in_openings(), load.in_openings()
    x, u, p = (before.vector(c) for c in ("state", "input", "parameter"))
    x[[v.name for v in before.states].index("v")] = 0.3
    gap = np.asarray(inside.function(x, u, p)[0] - before.function(x, u, p)[0]).ravel()
    assert gap[[v.name for v in before.states].index("v")] == pytest.approx(-0.3)
    assert np.count_nonzero(gap) == 1


def test_at_its_centre_a_residual_changes_nothing_and_passive_ones_take_energy() -> None:
    plant, random = mass(), np.random.default_rng(7)
    for shape in SHAPES:
        for passive in (False, True):
            one = Residual("v", ["x", "v", "u"], shape, passive=passive, memory=2)
            made = attached(plant, [one], visited(plant), np.random.default_rng(1))
            more, weights = made.at(made.centre), made.at(random.standard_normal(len(made.centre)))
            for _ in range(5):
                x, u = random.standard_normal(4), random.normal(0, 9, 1)
                before = np.asarray(plant.function(x[:2], u, plant.vector("parameter"))[0]).ravel()
                same = np.asarray(more.function(x, u, more.vector("parameter"))[0]).ravel()
                assert np.allclose(same[:2], before, rtol=0, atol=1e-12)
                pushed = np.asarray(weights.function(x, u, weights.vector("parameter"))[0]).ravel()
                power = (pushed[1] - before[1]) * x[1]
                assert not passive or power <= 0.0


def test_memories_stay_bounded_whatever_the_weights() -> None:
    plant = mass()
    one = Residual("v", ["x", "v"], Network(4), memory=3)
    made = attached(plant, [one], visited(plant), np.random.default_rng(1))
    wild = made.at(30 * np.random.default_rng(2).standard_normal(len(made.centre)))
    run = pam.simulate(wild, {"u": 5.0}, duration=3.0)
    assert all(np.abs(run[n]).max() <= 1 + 1e-6 for n in made.memories)


# ---- learning ------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def learned() -> pam.fitting.LearnedFit:
    lacking = Residual("v", ["x", "v"], GaussianProcess(12))
    return fit_residual(physics(records(8, 1)), lacking, folds=4, strengths=[1e-3, 1e-5])


def test_what_is_missing_is_found(learned: pam.fitting.LearnedFit) -> None:
    test = records(6, 2)
    before = learned.physics.validate(test).rmse["x"]
    after = learned.validate(test).rmse["x"]
    assert after < before / 3  # starts from noisy samples are in both
    assert learned.strength is not None
    assert "chosen" in str(learned)
    # rates where the records were, to a tenth of what was missing
    seen = np.array([(r["x"], np.gradient(r["x"], r.t)) for r in test])[:, :, ::9]
    x, v = (seen[:, i].ravel() for i in (0, 1))
    inside = (np.abs(x) < 0.8) & (np.abs(v) < 3)
    plant = learned.plant
    x, v = x[inside], v[inside]
    mapped, still = plant.function.map(len(x)), np.zeros((1, len(x)))
    rates = mapped(np.vstack([x, v]), still, plant.vector("parameter"))[0]
    error = np.asarray(rates)[1] - (-30 * x - 2 * v + missing(x, v))
    assert np.std(error) < 0.2 * np.std(missing(x, v))


def test_bands_hold_what_they_say(learned: pam.fitting.LearnedFit) -> None:
    test = records(12, 3)
    for level, low, high in ((0.9, 0.85, 0.95), (0.5, 0.4, 0.6)):
        band = learned.predict(test, level)
        assert low < band.coverage["x"] < high
    refused("level", learned.predict, test, 90)


@pytest.mark.slow
def test_complete_physics_stays_alone() -> None:
    fit = physics(records(6, 5, beside=lambda x, v: 0.0))
    learned = fit_residual(fit, Residual("v", ["x", "v"], Splines(3)), folds=3, strengths=[1e-4])
    assert learned.strength is None
    assert learned.plant is fit.plant
    assert not learned.members
    assert 0.8 < learned.predict(records(6, 6, beside=lambda x, v: 0.0)).coverage["x"] < 0.97


def test_one_record_is_cut_into_parts() -> None:
    fit = physics(records(1, 8))
    lacking = Residual("v", ["x", "v"], Splines(3), passive=True)
    learned = fit_residual(fit, lacking, folds=2, strengths=[1e-3])
    assert [s.value for s in learned.strengths] == [None, 1e-3]


@pytest.mark.slow
def test_a_structure_among_others() -> None:
    options = {"horizon": [0.5], "every": 0.5}
    given = mass(), ["rate", "damping"], options
    lacking = [Residual("v", ["x", "v"], Splines(4))]
    learned = pam.fitting.LearnedStructure(*given, lacking, {"strengths": [1e-4], "folds": 2})
    several = {"physics": pam.fitting.FreeRunStructure(*given), "learned": learned}
    choice = pam.fitting.choose(several, records(6, 11), folds=3, seed=1)
    assert choice.name == "learned"


def test_wrong_arguments_are_named() -> None:
    refused("on is empty", Residual, "v", [])
    refused("shape", Residual, "v", ["x"], "network")
    plant = mass()
    where = visited(plant), np.random.default_rng(0)
    refused("of = 'u' is an input", attached, plant, [Residual("u", ["x"])], *where)
    refused("no velocity", attached, plant, [Residual("x", ["x"], passive=True)], *where)
    refused("second one of v", attached, plant, [Residual("v", ["x"])] * 2, *where)
    fit = physics(records(2, 1))
    wrong = [{"strengths": s} for s in ([], [-1.0], [float("nan")])]
    for option in (*wrong, {"evaluations": 0}, {"seed": -1}, {"folds": 1}):
        refused(next(iter(option)), fit_residual, fit, Residual("v", ["x"]), **option)
    refused("declare returns", plant.with_terms, lambda made: None)
    refused("fit_free_run", fit_residual, plant, Residual("v", ["x"]))
