"""Air by its energy: limits in closed form, hand-written equations, conserved energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import rates_and_outputs
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.muscles.gas import Gas, PolynomialVolume
from pam_ocp.muscles.heat import ConstantHeatTransfer, PressureHeatTransfer, Rubber

R, T0, RHO0, P0, G = 287.05, 293.15, 1.185, 101325.0, 1.4
CP = R * G / (G - 1)
V, C, B = 1e-4, 1e-8, 0.3
PER_SECOND = R * C * RHO0 * T0 / V  # R C rho0 sqrt(Tref T0)/V at T0
MUSCLE = "DMSP-20-200N"


def chamber(heat: float | None, **feed):
    """A fixed volume behind a valve; the muscle around it does not move."""
    transfer = None if heat is None else ConstantHeatTransfer(heat)
    gas = Gas(PolynomialVolume([V]), dead_volume=0.0, heat=transfer, **feed.pop("gas", {}))
    plant = pam.Plant("chamber")
    valve = pam.feeds.SpoolValve(conductance=C, critical_ratio=B, gas=gas, **feed)
    plant.add_muscle("m", MUSCLE, shortening=0.0, rate=0.0, pre_contraction=0.1, feed=valve)
    return plant


def run(plant, command, duration, **start):
    given = {f"m.{k}": v for k, v in start.items()}
    t = np.linspace(0.0, duration, 21)
    return pam.simulate(plant, {"m.command": command}, t=t, start=given, rtol=1e-11)


def test_without_heat_choked_venting_takes_its_time_in_closed_form():
    first = 6e5 + P0
    motion = run(chamber(0.0), -1.0, 0.04, pressure=6e5)
    falling = (1 + (G - 1) / 2 * PER_SECOND * motion.t) ** (-2 * G / (G - 1))
    assert first * falling[-1] > P0 / B  # choked to the end
    assert motion["m.pressure"] + P0 == pytest.approx(first * falling, rel=1e-6)
    assert motion["m.temperature"] == pytest.approx(T0 * falling ** ((G - 1) / G), rel=1e-6)


def test_with_perfect_heat_choked_venting_is_exponential():
    first = 6e5 + P0
    motion = run(chamber(1e9), -1.0, 0.06, pressure=6e5)
    falling = np.exp(-PER_SECOND * motion.t)
    assert motion["m.pressure"] + P0 == pytest.approx(first * falling, rel=1e-6)


@pytest.mark.parametrize(("heat", "exponent"), [(0.0, G), (1e9, 1.0)])
@pytest.mark.parametrize("warm", [T0, 330.0])
def test_choked_filling_is_a_straight_line_in_time(heat, exponent, warm):
    source = 9e5 + P0
    flow = source * C * RHO0 * math.sqrt(T0 / warm)
    motion = run(chamber(heat, supply=9e5, supply_temperature=warm), 1.0, 0.012, pressure=0.0)
    assert motion["m.pressure"][-1] + P0 < B * source
    entering = warm if heat == 0 else T0
    line = P0 + exponent * R * entering * flow / V * motion.t
    assert motion["m.pressure"] + P0 == pytest.approx(line, rel=1e-6)
    mass = P0 * V / (R * T0) + flow * motion.t
    assert motion["m.air_mass"] == pytest.approx(mass, rel=1e-6)


@pytest.mark.parametrize("heat", [0.0, 1e9])
def test_unchoked_filling_agrees_with_scipy(heat):
    source = 3e5 + P0

    def rate(t, z):
        p, _m = z
        r = min(p / source, 0.999)
        flow = source * C * RHO0 * math.sqrt(1 - ((r - B) / (1 - B)) ** 2)
        return [(G if heat == 0 else 1.0) * R * T0 * flow / V, flow]

    first = [2e5 + P0, (2e5 + P0) * V / (R * T0)]
    motion = run(chamber(heat, supply=3e5), 1.0, 0.04, pressure=2e5)
    exact = solve_ivp(rate, (0, 0.04), first, t_eval=motion.t, rtol=1e-11, atol=1e-12)
    assert motion["m.pressure"] + P0 == pytest.approx(exact.y[0], rel=1e-6)
    assert motion["m.air_mass"] == pytest.approx(exact.y[1], rel=1e-6)


@pytest.mark.parametrize(("heat", "exponent"), [(0.0, G), (1e10, 1.0)])
def test_a_closed_muscle_is_compressed_by_the_exponent_of_the_limit(heat, exponent):
    plant = pam.Plant("pulled")
    x = plant.state("x", unit="m", start=0.0)
    plant.der(x, -0.05)
    gas = Gas(PolynomialVolume([5e-5, 4e-4]), dead_volume=0.0, heat=ConstantHeatTransfer(heat))
    feed = pam.feeds.SpoolValve(gas=gas)
    plant.add_muscle("m", MUSCLE, shortening=x, rate=-0.05, pre_contraction=0.2, feed=feed)
    motion = pam.simulate(plant, duration=0.3, start={"m.pressure": 2e5}, rtol=1e-11)
    product = (motion["m.pressure"] + P0) * motion["m.volume"] ** exponent
    assert np.ptp(motion["m.volume"]) > 2e-5
    assert product == pytest.approx(np.full(len(product), product[0]), rel=1e-6)


def test_air_shut_in_with_heat_damps_as_a_relaxing_spring():
    """docs/self_excited.md (2): the part of p in phase with v is (g - 1) tau/(1 + w^2 tau^2).

    tau = m cv/(h A), with A = 2 sqrt(pi V l) of the wall; slower than 1/tau it damps most.
    """
    h, p0, v0, slope, x0 = 30.0, 3e5 + P0, 6e-5, 4e-4, 0.02
    plant = pam.Plant("pulled")
    x, v = plant.state("x", unit="m", start=x0), plant.input("v", unit="m/s")
    plant.der(x, v)
    gas = Gas(PolynomialVolume([v0, slope * L0]), dead_volume=0.0, heat=ConstantHeatTransfer(h))
    valve = pam.feeds.SpoolValve(gas=gas)
    plant.add_muscle("m", MUSCLE, shortening=x, rate=v, feed=valve)
    names = [s.name for s in plant.states]
    state = plant.vector("state", {"x": x0, "m.pressure": 3e5, "m.temperature": T0})
    jacobians = plant.jacobians(state, plant.vector("input"), plant.vector("parameter"))
    a, b = (np.asarray(m) for m in jacobians[:2])
    volume = v0 + slope * x0
    wall = 2 * math.sqrt(math.pi * volume * (L0 - x0))
    tau = p0 * volume / (R * T0) * (CP - R) / (h * wall)
    column = [i.name for i in plant.inputs].index("v")
    for w in (0.02 / tau, 1 / tau, 30 / tau):
        response = np.linalg.solve(1j * w * np.eye(len(names)) - a, b[:, column])
        expected = -p0 * slope / volume * (G - 1) * tau / (1 + (w * tau) ** 2)
        found = response[names.index("m.pressure")]
        assert found.real == pytest.approx(expected, rel=1e-6)
        stiffness = p0 * slope / volume * (1 + G * (w * tau) ** 2) / (1 + (w * tau) ** 2)
        assert (1j * w * found).real == pytest.approx(-stiffness, rel=1e-6)


# ---- hand-written equations --------------------------------------------------------------------
A1, A2, A3 = -4.00180705, 292.4620246, -0.32930845
A4, A5, A6 = -9.33564098, 294.0538256, -280.498151
L0, D0, DEAD = 0.2, 0.02, 20e-6
HEAT, POWER, CAPACITY, OUTWARD, STIFF = 40.0, 0.5, 20.0, 0.5, 2e-3
MASS, SUPPLY, OVERLAP, LEAK = 8.0, 5e5 + P0, 0.02, 2e-10


def warm_plant():
    heat, rubber = PressureHeatTransfer(HEAT, POWER), Rubber(CAPACITY, OUTWARD, stiffening=STIFF)
    gas = Gas(dead_volume=DEAD, heat=heat, rubber=rubber)
    given = {"supply": 5e5, "supply_temperature": 300.0, "gas": gas, "leak": LEAK}
    feed = pam.feeds.SpoolValve(conductance=C, **given)
    return pam.HangingLoad(MUSCLE, MASS, damping=60.0, feed=feed)


def by_hand(x, v, p, warm, wall, command):
    """(rates, flows of energy into the air): m x'' = F - m g - c v, with the air's energy."""
    k = 100 * x / L0
    grown = math.exp(A3 * k)
    gain = (A1 * grown + A4 * k + A5) / 1e5
    tension = (A1 * p / 1e5 + A2) * grown + A4 * k * p / 1e5 + A5 * p / 1e5 + A6
    tension += STIFF * (wall - 293.15) * (A2 * grown + A6)
    assert tension > 1.0, "within the rounding of the clamp, or slack"
    own = math.pi / 4 * D0**2 * L0
    own += L0 / 1e7 * (A1 / A3 * (grown - 1) + A4 * k**2 / 2 + A5 * k)
    total, inside = own + DEAD, p + P0

    def orifice(p1, p2, t1, conductance):
        r = p2 / p1
        choked = p1 * conductance * RHO0 * math.sqrt(293.15 / t1)
        return choked * (math.sqrt(1 - ((r - B) / (1 - B)) ** 2) if r > B else 1.0)

    opening = (abs(command) - OVERLAP / 2) / (1 - OVERLAP / 2)
    drawn = opening * orifice(SUPPLY, inside, 300.0, C) if command > 0 else 0.0
    vented = opening * orifice(inside, P0, warm, C) if command < 0 else 0.0
    vented += orifice(inside, P0, warm, LEAK)
    area = 2 * math.sqrt(math.pi * own * L0 * (1 - x / L0))
    h = HEAT * (inside * warm / (101325.0 * 293.15)) ** POWER
    heat, growing = h * area * (wall - warm), gain * v
    enthalpy = CP * (drawn * 300.0 - vented * warm)
    mass, flow = inside * total / (R * warm), drawn - vented
    energy = enthalpy + heat - inside * growing  # dU/dt, U = m cv T
    cv = R / (G - 1)
    warming = (energy - flow * cv * warm) / (mass * cv)
    pressing = inside * (flow / mass + warming / warm - growing / total)
    cooling = (-heat - OUTWARD * (wall - 293.15)) / CAPACITY
    rates = [v, (tension - MASS * 9.80665 - 60.0 * v) / MASS, pressing, warming, cooling]
    return rates, (enthalpy, heat, inside * growing, mass * cv * warm)


def test_the_plant_is_the_hand_written_one_at_200_random_points():
    plant, draw = warm_plant(), np.random.default_rng(11)
    names = [v.name for v in plant.states]
    of_muscle = ("pressure", "temperature", "rubber_temperature")
    assert names == ["x", "v", *(f"muscle.{n}" for n in of_muscle)]
    for _ in range(200):
        command = draw.choice([-1, 1]) * draw.uniform(0.05, 0.9)
        at = draw.uniform([0.0, -0.3, 1.8e5, 250.0, 285.0], [0.03, 0.3, 4.5e5, 350.0, 330.0])
        given = dict(zip(names, at, strict=True)) | {"muscle.command": command}
        rates, outputs = rates_and_outputs(plant, given)
        expected, (enthalpy, heat, _, _) = by_hand(*at, command)
        assert [*rates.values()] == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert outputs["muscle.enthalpy_flow"] == pytest.approx(enthalpy, rel=1e-9, abs=1e-9)
        assert outputs["muscle.heat_flow"] == pytest.approx(heat, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(("x", "v"), [(0.02, 0.2), (0.0526, 0.2), (0.0534, -0.2), (0.06, 0.2)])
def test_losses_warm_the_rubber_by_what_they_take_from_the_pull(x, v):
    heat, friction = ConstantHeatTransfer(30.0), pam.losses.CoulombFriction(20.0)
    feed = pam.feeds.SpoolValve(gas=Gas(heat=heat, rubber=Rubber(CAPACITY)))
    plant = pam.HangingLoad(MUSCLE, MASS, feed=feed, losses=friction)
    pull = pam.muscle(MUSCLE).tension(
        6e5, x / L0
    )  # taut, slack by friction, taut by friction, slack
    taken = max(pull, 0.0) - max(pull - math.copysign(20.0, v), 0.0)
    rates = rates_and_outputs(plant, {"x": x, "v": v, "muscle.pressure": 6e5})[0]
    assert rates["muscle.rubber_temperature"] == pytest.approx(taken * v / CAPACITY, abs=1e-12)


def test_the_energy_balance_of_a_motion_closes_to_1e_8():
    def rates(t, z, command):
        found, (enthalpy, heat, work, _) = by_hand(*z[:5], command)
        return [*found, enthalpy, heat, work]

    z = np.array([0.033, 0.0, 3e5, 293.15, 293.15, 0.0, 0.0, 0.0])
    first = by_hand(*z[:5], 0.5)[1][3]
    times, commands = [0.0, 0.1, 0.25, 0.4], [0.1, -0.2, 0.15]
    for start, end, command in zip(times[:-1], times[1:], commands, strict=True):
        step = solve_ivp(rates, (start, end), z, "DOP853", rtol=1e-12, atol=1e-13, args=(command,))
        z = step.y[:, -1]
    stored = by_hand(*z[:5], 0.5)[1][3] - first
    assert stored == pytest.approx(z[5] + z[6] - z[7], abs=1e-8 * (abs(z[5:8]).sum() + first))
    plant, start = warm_plant(), {"x": 0.033, "muscle.pressure": 3e5}
    given = {"muscle.command": (times, [*commands, 0.0])}
    motion = pam.simulate(plant, given, duration=0.4, start=start)
    end = [motion[v.name][-1] for v in plant.states]
    assert end == pytest.approx(z[:5], rel=1e-6, abs=1e-7)


# ---- the wall -----------------------------------------------------------------------------------
def test_friction_warms_the_rubber_by_what_it_takes_from_the_motion():
    gas = Gas(heat=ConstantHeatTransfer(0.0), rubber=Rubber(50.0, 0.0))
    feed, friction = pam.feeds.SpoolValve(gas=gas), pam.losses.CoulombFriction(40.0)
    plant = pam.HangingLoad(MUSCLE, 8.0, feed=feed, losses=friction)
    rates, _ = rates_and_outputs(plant, {"v": 0.2, "muscle.pressure": 3e5, "x": 0.01})
    loss = 40.0 * math.tanh(0.2 / 1e-3) * 0.2
    assert rates["muscle.rubber_temperature"] == pytest.approx(loss / 50.0)


def test_a_warm_wall_changes_the_force_at_zero_pressure_alone():
    plant, wall = warm_plant(), A2 * math.exp(A3 * 10) + A6
    for bar in (2, 4):
        at = {"x": 0.02, "v": 0.0, "muscle.pressure": bar * 1e5, "muscle.temperature": 293.15}
        cold, warm = (
            rates_and_outputs(plant, {**at, "muscle.rubber_temperature": t})[1]["muscle.force"]
            for t in (293.15, 323.15)
        )
        assert warm - cold == pytest.approx(STIFF * 30 * wall, rel=1e-9)


def test_a_file_may_speak_of_heat():
    from pam_ocp.plants.plant_file import plant_of

    heat = {"kind": "PressureHeatTransfer", "value": "25 W/(m2.K)"}
    gas = {"heat": heat, "rubber": {"stiffening": 1e-3}, "dead_volume": 1e-5}
    feed = {"kind": "SpoolValve", "gas": gas, "tube": {"volume": 5e-6}}
    plant = plant_of({"arrangement": "HangingLoad", "muscle": "DMSP-20-200N", "feed": feed})
    assert plant.variable("muscle.gas.heat_transfer").start == 25.0
    assert plant.variable("muscle.gas.tube_volume").start == 5e-6
