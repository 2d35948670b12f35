"""The answers to the exercises of the guides: by the library, and by hand."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

import pam_ocp as pam

DOCS = Path(__file__).parents[2] / "docs"
DMSP = (12.789, 419.48, -0.56665, -8.7013, 267.672, -309.603)  # p in bar, kappa in %


def answers(page):
    """The bold numbers of a page's answers, with the place of each."""
    text = (DOCS / f"{page}.md").read_text("utf-8")
    (block,) = re.findall(r"^## Exercises\n.*?<details>(.*?)</details>", text, re.S | re.M)
    return [float(n) for n in re.findall(r"\*\*(-?[\d.]+)", block)]


def force(bar, percent):
    a1, a2, a3, a4, a5, a6 = DMSP
    return (a1 * bar + a2) * math.exp(a3 * percent) + a4 * percent * bar + a5 * bar + a6


def levels_of_a_table():
    """Coefficients that contraction levels determine: rank of the Jacobian."""
    pressure = np.linspace(1e5, 6e5, 8)
    law = pam.muscle("DMSP-20-300").law
    start = np.array([getattr(law, f"a{i}") for i in range(1, 7)])

    def tensions(coefficients, kappa):
        a1, a2, a3, a4, a5, a6 = coefficients
        made = pam.laws.SixParameterLaw(a1, a2, a3, a4, a5, a6)
        return np.concatenate([np.ravel(made.tension(pressure, np.full(8, k))) for k in kappa])

    kappa = (0.02, 0.10)
    steps = 1e-6 * np.diag(start)
    jacobian = np.column_stack(
        [(tensions(start + s, kappa) - tensions(start - s, kappa)) / 2e-6 for s in steps]
    )
    by_library = np.linalg.matrix_rank(jacobian / np.linalg.norm(jacobian, axis=0), tol=1e-6)
    return by_library, 2 * len(kappa)  # a line in p, thus two numbers, at each


def angle_of_the_braid():
    law = pam.laws.GeometricLaw(alpha0=math.radians(23.0), radius=0.010)
    by_library = brentq(lambda kappa: float(law.tension(3e5, kappa)), 0.1, 0.5)
    return 100 * by_library, 100 * (1 - 1 / (math.sqrt(3) * math.cos(math.radians(23.0))))


def hanging():
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0, feed=pam.feeds.IdealPressure())
    by_library = plant.equilibrium({"muscle.pressure": 3e5})["x"]
    percent = brentq(lambda k: force(3.0, k) - 10 * 9.80665, 1, 26)
    return 1e3 * by_library, 300 * percent / 100


def step_of_a_regulator():
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0, feed=pam.feeds.Regulator(0.05))
    start = plant.equilibrium({"muscle.pressure": 2e5})
    t = np.linspace(0, 0.3, 3001)
    run = pam.simulate(plant, {"muscle.command": 4e5}, t=t, start=start)
    by_library = np.interp(3.9e5, run["muscle.pressure"], t)
    return 1e3 * by_library, 50 * math.log(2 / 0.1)


def lag_from_readings():
    plant = pam.Plant("regulator")
    p, u = plant.state("p", unit="bar"), plant.input("u", unit="bar")
    plant.der(p, (u - p) / plant.parameter("lag", 0.02, unit="s", nominal=0.05, min=0.001))
    t = np.array([0.0, 0.02, 0.04, 0.06])
    readings = np.array([1.0, 1.659, 2.101, 2.398]) * 1e5
    record = pam.Trajectory(t, {"p": readings, "u": np.full(4, 3e5)})
    by_library = pam.fit_plant(plant, [record], ["lag"]).values["lag"]
    by_hand = -1 / np.polyfit(t, np.log(3e5 - readings), 1)[0]
    return 1e3 * by_library, 1e3 * by_hand


def error_of_a_mean():
    """Over that with white noise: by the covariances of all pairs."""
    apart = np.arange(1, 4000)
    return math.sqrt(1 + 2 * np.sum((1 - apart / 4000) * 0.9**apart)), math.sqrt(1.9 / 0.1)


def sled(**force):
    plant = pam.Plant("sled")
    x, v = plant.state("x", unit="m", nominal=0.01), plant.state("v", unit="m/s")
    plant.der(x, v)
    plant.der(v, plant.input("force", unit="N", **force) / 2.0)
    return plant


def quickest():
    plan = pam.plan(
        sled(min=-100, max=100, nominal=100), [{"x": 0.0}, {"x": 0.02}], minimise="time"
    )
    return 1e3 * plan.duration, 2e3 * math.sqrt(2 * 0.02 / 100)


def cheapest():
    plan = pam.plan(
        sled(min=-1000, max=1000, nominal=100),
        [{"x": 0.0}, {"x": 0.02}],
        minimise="effort",
        duration=0.1,
        method=pam.Collocation(2, 5, "polynomial"),
    )
    return 1e3 * plan.objective, 1e3 * 12 * (2 * 0.02 / 100) ** 2 / 0.1**3


def largest_sampled_gain():
    plant = pam.Plant("pressure")
    p, u = plant.state("p", unit="Pa", nominal=1e5), plant.input("u", unit="Pa", nominal=1e5)
    plant.der(p, (u - p) / 0.05)

    def last_to_first(gain):
        loop = pam.closed_loop(
            lambda t, seen: {"u": -gain * seen["p"]},
            plant,
            duration=1.0,
            start={"p": 1e5},
            sample_time=0.02,
        )
        return math.log(abs(loop.seen["p"][-1] / loop.seen["p"][0]))

    return brentq(last_to_first, 4.0, 6.0), 1 / math.tanh(0.02 / (2 * 0.05))


def loss_of_height_without_integral():
    feed = pam.feeds.Regulator(0.05)
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0, feed=feed)
    point = plant.equilibrium({"muscle.pressure": 3e5})
    loop = pam.closed_loop(
        lambda t, seen: {"muscle.command": 3e5 + 1e6 * (point["x"] - seen["x"])},
        plant,
        duration=4.0,
        start=point,
        parameters={"mass": 10.5},
        sample_time=2e-3,
    )
    first = brentq(lambda x: force(3.0, x / 3e-3) - 10 * 9.80665, 0.01, 0.07)
    last = brentq(
        lambda x: force(3.0 + 10 * (first - x), x / 3e-3) - 10.5 * 9.80665, first - 2e-3, first
    )
    return 1e3 * (point["x"] - loop["x"][-1]), 1e3 * (first - last)


def error_of_held_inputs():
    t = np.arange(0, 1.0001, 0.01)
    fine = np.linspace(0, 1, 100001)
    course = pam.Trajectory(t, {"u": np.sin(2 * np.pi * t)}, interpolation="linear")
    between = np.abs(course.at(fine)["u"] - np.sin(2 * np.pi * fine)).max()
    return 1e4 * between, 1e4 * (2 * np.pi * 0.01) ** 2 / 8


def growth_by_an_exchanged_spring():
    plant = pam.Plant("mass")
    x, v = plant.state("x", unit="m", nominal=0.01), plant.state("v", unit="m/s")
    plant.der(x, v)
    plant.der(v, plant.input("force", unit="N", nominal=100.0) / 2.0)
    loop = pam.closed_loop(
        lambda t, seen: {"force": -2e4 * seen["x"]},
        plant,
        duration=1.0,
        start={"x": 1e-3},
        sample_time=1e-3,
    )
    energy = 1e4 * loop.seen["x"] ** 2 + loop.seen["v"] ** 2
    rate = np.polyfit(loop.seen.t, np.log(energy) / 2, 1)[0]
    return math.log(2) / rate, math.log(2) / (math.log(1 + 0.1**2 / 2) / 2e-3)


def damping_of_a_decay():
    plant = pam.Plant("load")
    x, v = plant.state("x", unit="m", nominal=0.01), plant.state("v", unit="m/s")
    zeta = plant.parameter("zeta", 0.02)
    plant.der(x, v)
    plant.der(v, -(30.0**2) * x - 2 * zeta * 30.0 * v)

    def left(zeta):
        cycles = 10 * math.pi / (30.0 * math.sqrt(1 - zeta**2))
        start, parameters = {"x": 0.01}, {"zeta": zeta}
        run = pam.simulate(plant, t=[0.0, cycles], start=start, parameters=parameters)
        return run["x"][-1] / 0.01

    decrement = math.log(2) / 5
    by_hand = decrement / math.sqrt(4 * math.pi**2 + decrement**2)
    return 100 * brentq(lambda z: left(z) - 0.5, 0.01, 0.05), 100 * by_hand


def weakest_gain():
    """The worst lag's Hopf point over k/F_p, of a damping ratio of 0.1."""
    muscle, mass = pam.muscle("DMSP-20-400N"), 20.0
    rest = {"x": 0.04, "muscle.reference": 0.04}
    loop = pam.RegulatedLoad(muscle, mass=mass, lag=0.1)
    at = loop.equilibrium(rest)
    k = at["muscle.stiffness"]
    f_p = muscle.law.dtension_dp(at["muscle.pressure"], at["muscle.contraction"])
    lag = math.sqrt(mass / k)
    worst = pam.RegulatedLoad(muscle, mass=mass, lag=lag)
    border = pam.vibration.hopf(worst, "muscle.gain", (1e5, 1e7), rest)
    return border.value * f_p / k, 4 * 0.1 * 1.1


EXERCISES = {
    "fitting": (levels_of_a_table, angle_of_the_braid),
    "model": (hanging, step_of_a_regulator),
    "dynamic_fits": (lag_from_readings, error_of_a_mean),
    "planning": (quickest, cheapest),
    "control": (largest_sampled_gain, loss_of_height_without_integral),
    "fmu": (error_of_held_inputs, growth_by_an_exchanged_spring),
    "vibration": (damping_of_a_decay, weakest_gain),
}


@pytest.mark.parametrize("page", EXERCISES)
def test_an_answer_is_what_the_library_and_a_hand_find(page):
    given = answers(page)
    assert len(given) == len(EXERCISES[page])
    for number, solve in zip(given, EXERCISES[page], strict=True):
        by_library, by_hand = solve()
        assert by_library == pytest.approx(by_hand, rel=2e-3)
        assert number == pytest.approx(by_hand, rel=2e-3), solve.__name__
