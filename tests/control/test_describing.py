"""Describing functions against theory, python-control and the frequency response."""

import casadi as ca
import control
import numpy as np
import pytest
from conftest import BAR, refused

import pam_ocp as pam
from pam_ocp import InputError, SimulationError
from pam_ocp.control.analysis import frequency_response
from pam_ocp.control.describing import describing_function, muscle_characteristic


def characteristic(expression):
    """A memoryless characteristic in a plant (which must have a state)."""
    plant = pam.Plant("characteristic")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, u - x)
    plant.output("y", expression(u))
    return plant


def saturation(u):
    return ca.fmin(ca.fmax(u, -1.0), 1.0)


def test_a_saturation_has_the_describing_function_of_theory_and_of_python_control():
    """2/pi (arcsin d + d sqrt(1 - d^2)), d = 1/A; 1 below."""
    amplitudes = np.array([0.5, 1.5, 3.0, 10.0])
    found = describing_function(
        characteristic(saturation), "u", "y", amplitudes, [0.3, 2.0], samples=4096
    )
    d = 1 / np.maximum(amplitudes, 1.0)
    expected = 2 / np.pi * (np.arcsin(d) + d * np.sqrt(1 - d**2))
    theirs = control.describing_function(control.saturation_nonlinearity(1.0), amplitudes)
    for j in range(2):
        assert found.values[:, j] == pytest.approx(expected, abs=1e-6)
        assert found.values[:, j] == pytest.approx(np.asarray(theirs), abs=1e-3)
    assert found.distortion[0, 0] < 1e-9 < 0.1 < found.distortion[-1, 0]
    assert found.stable.all()


def test_dry_friction_has_four_over_pi_of_its_force():
    force, width = 3.0, 1e-3
    plant = characteristic(lambda v: force * ca.tanh(v / width))
    found = describing_function(plant, "u", "y", [1.0, 2.0], [1.0], samples=8192)
    assert found.values[:, 0] == pytest.approx(4 * force / np.pi / np.array([1.0, 2.0]), rel=1e-4)


def test_small_swings_give_the_frequency_response(slide):
    point = slide.equilibrium(x=0.003, stiffness=2.2e4)
    hertz = np.array([0.5, 4.0, 15.0, 40.0])
    found = describing_function(slide, "muscle1.command", "x", [10.0], hertz, point)
    system = slide.linearize(point, inputs=["muscle1.command"], outputs=["x"])
    expected = frequency_response(system, hertz).ravel()
    assert np.abs(found.values[0] - expected).max() < 1e-4 * np.abs(expected).max()
    assert np.abs(found.values[0] / expected - 1).max() < 1e-2
    assert found.mean[0] == pytest.approx(point["x"], abs=1e-8)


def test_a_large_swing_is_that_of_a_long_simulation(long_muscle):
    plant = pam.HangingLoad(long_muscle, 20.0, damping=pam.losses.ConstantDamping(200.0))
    point, hertz, amplitude = plant.equilibrium(x=0.05), 2.0, 1.2 * BAR
    found = describing_function(plant, "muscle.command", "x", [amplitude], [hertz], point)
    t = np.arange(0, 10.0, 1 / (64 * hertz))
    motion = pam.simulate(
        plant,
        {"muscle.command": lambda s: point.u[0] + amplitude * np.sin(2 * np.pi * hertz * s)},
        t=t,
        start={v.name: x for v, x in zip(plant.states, point.x, strict=True)},
    )
    last = slice(-64, None)
    wave = np.exp(-2j * np.pi * hertz * t[last])
    expected = 2 * np.mean(motion["x"][last] * wave) * 1j / amplitude
    assert found.values[0, 0] == pytest.approx(expected, rel=1e-5)
    assert found.mean[0, 0] == pytest.approx(np.mean(motion["x"][last]), rel=1e-6)
    small = describing_function(plant, "muscle.command", "x", [10.0], [hertz], point)
    assert abs(found.values[0, 0] / small.values[0, 0] - 1) > 1e-2  # the force law is curved


def test_the_characteristic_of_a_muscle_softens(long_muscle):
    p = 3 * BAR
    gains = control.describing_function(
        muscle_characteristic(long_muscle, p, 0.10), [1e-5, 0.02], zero_check=False
    )
    assert np.real(gains[0]) == pytest.approx(long_muscle.stiffness(p, 0.10), rel=1e-4)
    assert np.real(gains[1]) != pytest.approx(np.real(gains[0]), rel=1e-3)


def test_what_has_no_describing_function_is_refused(slide):
    refused("source: x is a state", describing_function, slide, "x", "v", [1.0], [1.0])
    with pytest.raises(InputError, match="amplitudes must hold finite numbers > 0"):
        describing_function(slide, "muscle1.command", "x", [0.0], [1.0])
    refused("hertz = 'fast'", describing_function, slide, "muscle1.command", "x", [1.0], "fast")
    words = r"swings by 4 bar about 3 bar, beyond its range 0 bar .*; give at most 3 bar"
    three = {"muscle1.command": 3 * BAR}
    refused(words, describing_function, slide, "muscle1.command", "x", [4 * BAR], [1.0], three)
    drifting = pam.Plant("drifting")
    x, u = drifting.state("x"), drifting.input("u")
    drifting.der(x, u + 1.0)
    with pytest.raises(SimulationError, match="does not become periodic"):
        describing_function(drifting, "u", "x", [1.0], [1.0])
