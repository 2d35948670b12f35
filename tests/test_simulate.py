"""simulate against SciPy, against energy, and under failure."""

import numpy as np
import pytest
from conftest import BAR, scipy_states

import pam_ocp as pam
from pam_ocp import InputError, SimulationError


@pytest.mark.parametrize("interpolation", ["previous", "linear"])
def test_a_slide_under_random_commands_agrees_with_scipy(slide, interpolation):
    t = np.linspace(0.0, 0.5, 26)
    u = np.random.default_rng(4).uniform(2 * BAR, 5 * BAR, size=(2, 26))
    inputs = {"muscle1.command": u[0], "muscle2.command": u[1]}
    motion = pam.simulate(slide, inputs, t=t, interpolation=interpolation)

    def value(time):
        k = min(int(np.searchsorted(t, time, side="right")) - 1, len(t) - 2)
        part = (time - t[k]) / (t[k + 1] - t[k]) if interpolation == "linear" else 0.0
        return u[:, k] + part * (u[:, k + 1] - u[:, k])

    expected = scipy_states(slide, value, t)
    nominal = slide.vector("state", attribute="nominal")
    assert np.max(np.abs(motion.array(motion.named("state")) - expected) / nominal) < 1e-7


def test_a_hanging_load_under_a_function_of_time_agrees_with_scipy(hanging):
    command = lambda t: 4 * BAR + BAR * np.sin(12 * t)  # noqa: E731
    t = np.linspace(0.0, 1.0, 41)
    motion = pam.simulate(hanging, {"muscle.command": command}, t=t, rtol=1e-11)
    expected = scipy_states(hanging, command, t)
    nominal = hanging.vector("state", attribute="nominal")
    assert np.max(np.abs(motion.array(motion.named("state")) - expected) / nominal) < 1e-7


def test_a_trajectory_replays_itself(slide):
    commands = {"muscle1.command": lambda t: (3 + np.sin(30 * t)) * BAR, "muscle2.command": 3 * BAR}
    t = np.linspace(0, 0.2, 41)
    sampled = {
        "muscle1.command": commands["muscle1.command"](t),
        "muscle2.command": np.full(41, 3 * BAR),
    }
    first = pam.simulate(slide, sampled, t=t)
    again = pam.simulate(slide, first)
    assert first.compare(again).largest < 1e-12


def test_without_damping_energy_is_conserved():
    """E = m v^2/2 - integral of (F - m g) dx stays, with constant pressure and c = 0."""
    muscle = pam.muscle("DMSP-20-400N")
    plant = pam.HangingLoad(
        muscle, 20.0, damping=pam.ConstantDamping(0.0), feed=pam.IdealPressure()
    )
    motion = pam.simulate(plant, {"muscle.pressure": 4 * BAR}, t=np.linspace(0, 3, 301),
                          start={"x": 0.0708}, rtol=1e-12)  # fmt: skip
    a1, a2, a3, a4, a5, a6 = muscle.law.values.values()
    x, v, p, l0 = motion["x"], motion["v"], 4 * BAR, 0.4
    assert motion["muscle.force"].min() > 2.0  # taut all along: the closed form below holds
    k = x / l0
    work = l0 * ((a1 * p + a2) / a3 * np.exp(a3 * k) + a4 * p * k**2 / 2 + (a5 * p + a6) * k)
    energy = 20.0 * v**2 / 2 - work + 20.0 * 9.80665 * x
    assert np.ptp(energy) < 1e-9 * np.ptp(work)


def test_parameters_apply_to_one_run_only(hanging):
    heavy = pam.simulate(
        hanging, {"muscle.command": 4 * BAR}, duration=5.0, parameters={"mass": 50.0}
    )
    light = pam.simulate(hanging, {"muscle.command": 4 * BAR}, duration=5.0)
    assert heavy["x"][-1] == pytest.approx(49.5e-3, abs=0.05e-3)
    assert light["x"][-1] == pytest.approx(80.8e-3, abs=0.05e-3)


def test_a_failure_says_where_and_keeps_what_was_computed():
    plant = pam.Plant("blow_up", "x' = x^2 ends at t = 1")
    x = plant.state("x", start=1.0)
    plant.der(x, x**2)
    with pytest.raises(SimulationError, match=r"gave up behind t = 0\.974") as caught:
        pam.simulate(plant, t=np.linspace(0.0, 2.0, 40))
    part = caught.value.trajectory
    assert caught.value.time == pytest.approx(38 / 39)
    assert part["x"] == pytest.approx(1 / (1 - part.t), rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give duration"),
        ({"duration": -1.0}, "duration = -1 s must be > 0"),
        ({"duration": 1.0, "t": [0.0, 1.0]}, "not both"),
        ({"t": [0.0, 1.0, 0.5]}, "rise"),
        ({"duration": 1.0, "start": {"x": 9.0}}, "outside"),
        ({"duration": 1.0, "start": {"mass": 9.0}}, "mass is a parameter, not a state"),
        ({"duration": 1.0, "parameters": {"x": 9.0}}, "x is a state"),
        ({"duration": 1.0, "rtol": 0.0}, "rtol"),
    ],
)
def test_bad_arguments_are_refused(hanging, arguments, message):
    with pytest.raises(InputError, match=message):
        pam.simulate(hanging, **arguments)
