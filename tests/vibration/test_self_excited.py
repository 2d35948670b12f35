"""What sustains a vibration and what cannot: maps of its border and size, passive rests."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp import vibration
from pam_ocp.plants.regulated import RegulatedLoad

BAR = 1e5
G = 9.80665
MUSCLE = "DMSP-20-400N"


def force_slopes(muscle: pam.Muscle, pressure: float, x: float) -> tuple[float, float]:
    """(stiffness k [N/m], dF/dp [m2]) of the law itself, by central differences."""
    force, l0 = muscle.law.tension, muscle.rest_length
    dx, dp = 1e-6, 10.0
    k = (force(pressure, (x - dx) / l0) - force(pressure, (x + dx) / l0)) / (2 * dx)
    slope = (force(pressure + dp, x / l0) - force(pressure - dp, x / l0)) / (2 * dp)
    return float(k), float(slope)


def resting_pressure(muscle: pam.Muscle, mass: float, x: float) -> float:
    """Pressure that carries the mass at x; the law is affine in p."""
    force, kappa = muscle.law.tension, x / muscle.rest_length
    low, high = float(force(0.0, kappa)), float(force(BAR, kappa))
    return (mass * G - low) / (high - low) * BAR


# ---- where it begins --------------------------------------------------------------------------


def test_a_map_of_the_border_is_that_of_routh_and_hurwitz() -> None:
    muscle, c, lag = pam.muscle(MUSCLE), 40.0, 0.1
    plant = RegulatedLoad(muscle, lag=lag, damping=c)
    masses, places = [8.0, 20.0, 45.0], [0.03, 0.05]
    axes = {"mass": masses, "x": places}
    resting = {"muscle.reference": 0.04}
    found = vibration.hopf_map(plant, "muscle.gain", (1e3, 1e7), axes, resting)
    for i, m in enumerate(masses):
        for j, x in enumerate(places):
            k, slope = force_slopes(muscle, resting_pressure(muscle, m, x), x)
            gain = ((m + c * lag) * (c + k * lag) / (m * lag) - k) / slope
            assert found.border[i, j] == pytest.approx(gain, rel=1e-5)
            hertz = np.sqrt((c + k * lag) / (m * lag)) / (2 * np.pi)
            assert found.frequencies[i, j] == pytest.approx(hertz, rel=1e-5)
    assert not found.reasons
    assert "border of vibration over mass and x" in str(found)


def test_a_position_servo_of_a_leaking_muscle_begins_to_vibrate_where_theory_says() -> None:
    """m s^3 + (c + m a) s^2 + (k + c a + F_p b) s + k a + F_p K g = 0: p' = -a p - b v + K w.

    a, b, K by central differences of the balance n (R T mdot - p V')/V, written out here.
    """
    muscle, c, m, x = pam.muscle(MUSCLE), 40.0, 20.0, 0.05
    valve = pam.feeds.ServoValve(
        pressure_gain=0.0, position_gain=5.0, conductance=2e-8, leak=4e-10, supply=6e5
    )
    plant = pam.HangingLoad(muscle, m, damping=c, feed=valve)
    found = vibration.hopf(plant, "muscle.position_gain", (0.1, 100.0), {"x": x})
    p0 = resting_pressure(muscle, m, x)
    k, slope = force_slopes(muscle, p0, x)
    n, warm, ambient, gas = 1.2, 293.15, 101325.0, 287.05

    def flow(p1: float, p2: float, conductance: float, b: float = 0.3) -> float:
        ratio = p2 / p1
        share = 1.0 if ratio <= b else np.sqrt(1 - ((ratio - b) / (1 - b)) ** 2)
        return p1 * conductance * 1.185 * np.sqrt(293.15 / warm) * share

    def volume(at: float) -> float:
        return plant.equilibrium(x=at)["muscle.volume"]  # its formula is tested with the muscles

    v0, h = volume(x), 1e-5
    grown = (volume(x + h) - volume(x - h)) / (2 * h)

    def mass_flow(p: float, w: float) -> float:
        p1 = p + ambient
        return w * flow(6e5 + ambient, p1, 2e-8) - flow(p1, ambient, 4e-10)

    w0 = flow(p0 + ambient, ambient, 4e-10) / flow(6e5 + ambient, p0 + ambient, 2e-8)
    scale, dp = n * gas * warm / v0, 100.0
    a = -scale * (mass_flow(p0 + dp, w0) - mass_flow(p0 - dp, w0)) / (2 * dp)
    b = n * (p0 + ambient) * grown / v0
    opens = scale * flow(6e5 + ambient, p0 + ambient, 2e-8)
    # Routh and Hurwitz: (c + m a)(k + c a + F_p b) = m (k a + F_p K g)
    gain = ((c + m * a) * (k + c * a + slope * b) / m - k * a) / (slope * opens)
    assert found.value == pytest.approx(gain, rel=2e-4)


def test_a_border_is_found_where_a_pair_is_born_and_crosses_between_two_points() -> None:
    """A pressure loop too fast for its spool and its electronics."""
    valve = pam.feeds.ServoValve(
        command_lag=0.004,
        spool=pam.feeds.FirstOrderSpool(0.006),
        conductance=5e-8,
        leak=2e-10,
        overlap=0.0,
    )
    plant = pam.HangingLoad(MUSCLE, 20.0, feed=valve)
    found = vibration.hopf(plant, "muscle.pressure_gain", (1e-6, 1e-3), {"x": 0.05}, points=5)
    for factor, stable in ((0.99, True), (1.01, False)):
        near = plant.with_values({"muscle.pressure_gain": factor * found.value})
        poles = np.linalg.eigvals(near.linearize(near.equilibrium(x=0.05)).A)
        assert (poles.real.max() < 0) == stable


# ---- how large it becomes ---------------------------------------------------------------------


@pytest.mark.slow
def test_the_amplitude_in_a_map_is_that_of_scipy() -> None:
    muscle, c, lag, m = pam.muscle(MUSCLE), 40.0, 0.1, 20.0
    plant = RegulatedLoad(muscle, m, lag=lag, damping=c, gain=8.4e5)
    found = vibration.amplitude_map(
        plant, {"mass": [m], "x": [0.04]}, {"muscle.reference": 0.04}, push={"x": 0.01}
    )
    middle = resting_pressure(muscle, m, 0.04)
    top, width = muscle.pressure_range[1], 2e4

    def clamp(z: float) -> float:
        if abs(z) >= width:
            return max(z, 0.0)
        s = (z / width + 1) / 2
        return width * s**4 * (2 * s**2 - 6 * s + 5)

    def rates(_t: float, y: np.ndarray) -> list[float]:
        x, v, p = y
        tension = float(muscle.law.tension(p, x / muscle.rest_length))
        assert tension > 20  # never near slack: the clamp at zero force is not needed here
        wanted = middle + 8.4e5 * (0.04 - x)
        return [v, (tension - m * G - c * v) / m, (clamp(wanted) - clamp(wanted - top) - p) / lag]

    run = solve_ivp(
        rates, (0, 100), [0.05, 0.0, middle], "LSODA", rtol=1e-9, atol=1e-9, dense_output=True
    )
    tail = run.sol(np.linspace(90, 100, 20001))[0]
    assert found.closed[0, 0]
    assert found.amplitude[0, 0] == pytest.approx(np.ptp(tail) / 2, rel=2e-4)
    assert found.growth[0, 0] > 0


def mapped_at(mass: float, x: float) -> vibration.AmplitudeMap:
    plant = RegulatedLoad(pam.muscle(MUSCLE), 20.0, gain=2e5)
    return vibration.amplitude_map(plant, {"mass": [mass], "x": [x]}, {"muscle.reference": 0.04})


def test_where_rest_is_stable_a_push_dies_out() -> None:
    found = mapped_at(20.0, 0.04)
    assert found.amplitude[0, 0] == 0
    assert found.growth[0, 0] < 0
    assert "0 of 1 points vibrate" in str(found)


def test_points_that_have_no_rest_say_why() -> None:
    found = mapped_at(500.0, 0.09)
    assert "no equilibrium" in found.reasons[500.0, 0.09]
    assert np.isnan(found.amplitude[0, 0])


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        ({"mass": [20.0]}, "give two"),
        ({"mass": [20.0], "x": [0.04], "muscle.lag": [0.1]}, "give two"),
        ({"mass": [20.0], "muscle.reference": [0.04]}, "among the conditions"),
    ],
)
def test_axes_that_cannot_be_meant_are_refused(axes: dict, said: str) -> None:
    plant = RegulatedLoad(pam.muscle(MUSCLE), 20.0)
    refused(said, vibration.amplitude_map, plant, axes, {"muscle.reference": 0.04})


def test_a_servo_without_gains_is_refused() -> None:
    refused("nothing that is followed", pam.feeds.ServoValve, pressure_gain=0.0)


@pytest.mark.parametrize("gains", [(2e-5, 0.0), (0.0, 40.0), (2e-5, -40.0)])
def test_a_plan_of_a_servo_begins_with_gains_that_never_open_it_fully(
    gains: tuple[float, float],
) -> None:
    """Beyond full opening a command has no slope; the muscle's range is 0 .. 6 bar, 0 .. 25 %."""
    valve = pam.feeds.ServoValve(pressure_gain=gains[0], position_gain=gains[1])
    plant = pam.HangingLoad(MUSCLE, 20.0, feed=valve)
    relaxed = {v.name: v.relaxed for v in plant.parameters if v.relaxed}
    muscle = pam.muscle(MUSCLE)
    ends = {
        "muscle.pressure_gain": muscle.pressure_range[1],
        "muscle.position_gain": muscle.contraction_range[1] * muscle.rest_length,
    }
    own = dict(zip(ends, gains, strict=True))
    assert relaxed == {
        n: pytest.approx(1 / ends[n], rel=1e-12) for n, gain in own.items() if gain > 0
    }
    assert all(0 < value < own[name] for name, value in relaxed.items())


# ---- what cannot ------------------------------------------------------------------------------


def passive(kind: str, rng: np.random.Generator) -> tuple[pam.Plant, dict[str, float]]:
    """A plant under constant commands, and where it rests."""
    c = pam.losses.ConstantDamping(rng.uniform(1.0, 60.0))
    valve = {
        "conductance": 10 ** rng.uniform(-9, -7.3),
        "leak": 10 ** rng.uniform(-10.5, -8.5),
        "supply": 6e5,
    }
    losses: tuple = ()
    feeds = {
        "regulator": lambda: pam.feeds.Regulator(lag=rng.uniform(0.01, 0.5)),
        "valve": lambda: pam.feeds.SpoolValve(**valve),
        "heat": lambda: pam.feeds.SpoolValve(
            **valve, gas=pam.gas.Gas(heat=pam.muscles.ConstantHeatTransfer())
        ),
        "tube": lambda: pam.feeds.SpoolValve(**valve, tube=pam.feeds.Tube(rng.uniform(5e-6, 8e-5))),
        "line": lambda: pam.feeds.SpoolValve(
            **valve, tube=pam.feeds.LumpedTube(rng.uniform(0.3, 4.0))
        ),
        "receiver": lambda: pam.feeds.SpoolValve(
            **{**valve, "supply": pam.feeds.Receiver(rng.uniform(1e-4, 3e-3))}
        ),
    }
    if kind == "memory":
        losses = (pam.losses.MaxwellSlip(), pam.losses.Creep())
        feed = feeds["valve"]()
    else:
        feed = feeds[kind]()
    mass = rng.uniform(5.0, 60.0)
    plant = pam.HangingLoad(MUSCLE, mass, damping=c, feed=feed, losses=losses)
    lowest = 0.1 if mass < 40 else 0.3
    return plant, {"x": rng.uniform(lowest, 0.9) * 0.06}


@pytest.mark.parametrize(
    "kind", ["regulator", "valve", "heat", "tube", "line", "receiver", "memory"]
)
def test_under_constant_commands_every_rest_is_stable(kind: str) -> None:
    rng = np.random.default_rng(sum(map(ord, kind)))
    for _ in range(12):
        plant, resting = passive(kind, rng)
        point = plant.equilibrium(resting)
        poles = np.linalg.eigvals(plant.linearize(point).A)
        assert poles.real.max() < 1e-9 * np.abs(poles).max()
