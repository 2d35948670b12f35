"""Gas in a muscle: volume, energy, closed-valve stiffness, flow by ISO 6358, feeds of air."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from conftest import refused
from scipy.integrate import quad, solve_ivp, trapezoid
from scipy.optimize import brentq

from pam_ocp.muscles.catalogue import muscle
from pam_ocp.muscles.gas import (
    BraidVolume,
    ConsistentVolume,
    Gas,
    PolynomialVolume,
    air_mass,
    closed_stiffness,
    conductance_from_flow,
    iso6358,
    muscle_volume,
    specific_exergy,
)
from pam_ocp.muscles.gas import energy_balance as balance
from pam_ocp.muscles.heat import ConstantHeatTransfer, PressureHeatTransfer, Rubber
from pam_ocp.muscles.laws.braid import CorrectedLaw, GeometricLaw, ThickWallLaw
from pam_ocp.muscles.pneumatic_muscle import Muscle
from pam_ocp.plants.damping import ConstantDamping, StiffnessDamping
from pam_ocp.plants.hanging import HangingLoad
from pam_ocp.plants.valves import OnOffValves, SpoolValve, Tube

R, T, RHO0 = 287.05, 293.15, 1.185
GRAVITY = 9.80665
# DMSP-20-400N: p in bar, kappa in percent, F in N; rest length and inner diameter in m
A1, A2, A3, A4, A5, A6 = -4.35573, 281.22370, -0.32866, -9.27035, 302.20107, -263.69185
L0, D0, DEAD = 0.4, 0.02, 20e-6


@pytest.fixture(scope="module")
def fluidic() -> Muscle:
    return muscle("DMSP-20-400N")


def reference_volume(kappa):
    """V0 + l0/1e7 [(a1/a3)(e^(a3 k) - 1) + a4 k^2/2 + a5 k], k in percent; without dead volume."""
    k = 100 * np.asarray(kappa)
    integral = A1 / A3 * (np.exp(A3 * k) - 1) + A4 * k**2 / 2 + A5 * k
    return math.pi * (D0 / 2) ** 2 * L0 + L0 / 1e7 * integral


def braid_volume(kappa):
    alpha = math.radians(24.42)
    length = 1 - np.asarray(kappa)
    rest = math.pi * (D0 / 2) ** 2 * L0
    return rest * length * (1 - (math.cos(alpha) * length) ** 2) / math.sin(alpha) ** 2


def wall_energy(kappa):
    """-l0 times the integral of the force at p = 0 [J], by hand from eq. (3)."""
    k = 100 * np.asarray(kappa)
    return -L0 / 100 * (A2 / A3 * (np.exp(A3 * k) - 1) + A6 * k)


# ---- volume -------------------------------------------------------------------------------------


def test_consistent_volume_is_that_of_the_reference(fluidic):
    kappa = np.linspace(-0.02, 0.27, 30)
    assert muscle_volume(fluidic, kappa) == pytest.approx(reference_volume(kappa), rel=1e-12)


@pytest.mark.parametrize("name", ["DMSP-20-200N", "DMSP-20-400N"])
def test_volume_grows_by_241_to_248_percent_at_25_percent(name):
    known = muscle(name)
    ratio = muscle_volume(known, 0.25) / muscle_volume(known, 0.0)
    assert 2.405 < ratio < 2.485
    braid = BraidVolume(math.radians(24.42))
    assert muscle_volume(known, 0.25, braid) / muscle_volume(known, 0.0, braid) == pytest.approx(
        2.34, abs=0.005
    )


def test_volume_of_the_ideal_braid_is_consistent_with_its_own_law():
    alpha = math.radians(22.0)
    ideal = Muscle(GeometricLaw(alpha, D0 / 2), rest_length=L0, diameter=D0)
    kappa = np.linspace(0, 0.3, 7)
    assert muscle_volume(ideal, kappa) == pytest.approx(
        muscle_volume(ideal, kappa, BraidVolume(alpha)), rel=1e-12
    )


def test_thick_wall_law_fills_its_own_cylinder():
    theta = math.radians(28.6) - 0.073
    fibre, turns = 0.3 / math.cos(theta), 0.3 * math.tan(theta) / (math.pi * 0.02)
    known = Muscle(ThickWallLaw.from_published("DMSP-20-300"), rest_length=0.3, diameter=0.02)
    for kappa in (0.0, 0.1, 0.2):
        length = 0.3 * (1 - kappa)
        diameter = math.sqrt(fibre**2 - length**2) / (turns * math.pi)
        assert muscle_volume(known, kappa) == pytest.approx(
            math.pi / 4 * diameter**2 * length, rel=1e-12
        )


def test_the_gas_touches_the_wall_of_a_cylinder_of_its_volume_and_length(fluidic):
    """A = 2 pi r l with V = pi r^2 l; fittings add volume and no wall."""
    gas = Gas(BraidVolume(math.radians(24.42)), DEAD, 1.3, 300.0, 1.1e5).chamber(fluidic, 0.1)
    volume, length = float(braid_volume(0.1)), L0 * 0.9
    slope = (braid_volume(0.1 + 1e-6) - braid_volume(0.1 - 1e-6)) / 2e-6
    radius = math.sqrt(volume / (math.pi * length))
    found = [float(e) for e in (gas.volume, gas.slope, gas.area)]
    assert found == pytest.approx([volume + DEAD, slope, 2 * math.pi * radius * length], rel=1e-8)
    assert float(gas.pressure_rate(ca.SX(4e5), 1e-3, 0.5)) == pytest.approx(
        1.3 * (R * 300.0 * 1e-3 - 4e5 * slope * 0.5) / (volume + DEAD), rel=1e-8
    )


def test_polynomial_volume_is_its_polynomial(fluidic):
    assert muscle_volume(fluidic, 0.1, PolynomialVolume([1e-4, 5e-4, -1e-3])) == pytest.approx(
        1.4e-4
    )


def test_volumes_that_cannot_be_known_are_refused():
    bare = Muscle(GeometricLaw(0.4, 0.01), rest_length=0.3)
    refused("has no diameter", muscle_volume, bare, 0.1)
    corrected = Muscle(CorrectedLaw(0.4, 0.3, 1.0, 0.01), rest_length=0.3, diameter=0.02)
    refused("not a straight line in pressure", muscle_volume, corrected, 0.1)
    refused("must be > 0", PolynomialVolume, [-1e-4])


@pytest.mark.parametrize(
    ("component", "arguments", "words"),
    [
        (Gas, {"exponent": 0.99}, "must lie in 1"),
        (Gas, {"exponent": 1.68}, "must lie in 1"),
        (Gas, {"dead_volume": -1e-6}, "Gas.dead_volume = -1e-06 m3 must be >= 0"),
        (Gas, {"temperature": 0.0}, "Gas.temperature = 0 K must be > 0"),
        (Gas, {"ambient": 0.0}, "Gas.ambient = 0 Pa must be > 0"),
        (SpoolValve, {"conductance": 0.0}, "SpoolValve.conductance = 0"),
        (SpoolValve, {"critical_ratio": 1.0}, "critical_ratio = 1 must lie in 0"),
        (SpoolValve, {"overlap": -0.01}, "overlap = -0.01 must lie in 0"),
        (SpoolValve, {"supply": -1e5}, "SpoolValve.supply = -100000 Pa must be > 0"),
        (SpoolValve, {"supply_temperature": 0.0}, "must be > 0"),
        (PolynomialVolume, {"coefficients": [0.0]}, "must be > 0"),
        (BraidVolume, {"angle": 0.0}, r"must lie in 0 \.\. pi/2"),
        (BraidVolume, {"angle": math.pi / 2}, r"must lie in 0 \.\. pi/2"),
        (Gas, {"rubber": Rubber()}, "give heat="),
        (Gas, {"heat": 30.0}, "ConstantHeatTransfer"),
        (ConstantHeatTransfer, {"value": -1.0}, "must be >= 0"),
        (PressureHeatTransfer, {"value": -1.0}, "must be >= 0"),
        (PressureHeatTransfer, {"pressure": 0.0}, "must be > 0"),
        (Rubber, {"capacity": 0.0}, "must be > 0"),
        (Rubber, {"outward": -1.0}, "must be >= 0"),
        (Rubber, {"reference": 0.0}, "must be > 0"),
        (Rubber, {"warming": -1.0}, "must be >= 0"),
    ],
)
def test_gas_and_valves_that_cannot_be_are_refused(component, arguments, words):
    refused(words, component, **arguments)
    Gas(
        exponent=1.0,
        dead_volume=0.0,
        heat=ConstantHeatTransfer(0.0),
        rubber=Rubber(1, 0, warming=0),
    )
    Gas(exponent=1.67)


# ---- stiffness with closed valve -----------------------------------------------------------------

# kappa, volume, stiffness isobaric / isothermal / adiabatic at 4 bar [N/mm]
CLOSED = [
    (0.10, ConsistentVolume(), (10.1, 19.0, 22.5)),
    (0.10, BraidVolume(math.radians(24.42)), (10.1, 18.3, 21.6)),
    (0.20, ConsistentVolume(), (9.3, 11.5, 12.4)),
    (0.20, BraidVolume(math.radians(24.42)), (9.3, 11.5, 12.3)),
]


@pytest.mark.parametrize(("kappa", "volume", "expected"), CLOSED)
def test_closed_valve_stiffnesses_are_those_of_the_reference(fluidic, kappa, volume, expected):
    found = [fluidic.stiffness(4e5, kappa)] + [
        closed_stiffness(fluidic, 4e5, kappa, Gas(volume, DEAD, n)) for n in (1.0, 1.4)
    ]
    assert [round(k / 1e3, 1) for k in found] == list(expected)


def test_closed_valve_stiffness_is_the_slope_along_the_adiabat(fluidic):
    n, kappa, h = 1.4, 0.12, 1e-5

    def force(k):
        ratio = (reference_volume(kappa) + DEAD) / (reference_volume(k) + DEAD)
        return fluidic.tension((3e5 + 101325) * ratio**n - 101325, k)

    slope = -(force(kappa + h) - force(kappa - h)) / (2 * h) / L0
    found = closed_stiffness(fluidic, 3e5, kappa, Gas(exponent=n, dead_volume=DEAD))
    assert found == pytest.approx(slope, rel=1e-7)
    assert found > fluidic.stiffness(3e5, kappa)  # closed is stiffer than open


# ---- flow ----------------------------------------------------------------------------------------


def test_flow_is_iso_6358_at_random_states():
    rng = np.random.default_rng(6358)
    choked = laminar = 0
    for _ in range(1000):
        p1, b = rng.uniform(1e5, 9e5), rng.uniform(0.1, 0.5)
        conductance, temperature = 10 ** rng.uniform(-9, -7), rng.uniform(260, 330)
        ratio = rng.choice([rng.uniform(0.05, 1.0), rng.uniform(0.9985, 1.0)])
        full = p1 * conductance * RHO0 * math.sqrt(T / temperature)
        if ratio <= b:
            expected, choked = full, choked + 1
        elif ratio <= 0.999:
            expected = full * math.sqrt(1 - ((ratio - b) / (1 - b)) ** 2)
        else:
            edge = math.sqrt(1 - ((0.999 - b) / (1 - b)) ** 2)
            expected, laminar = full * edge * (1 - ratio) / 0.001, laminar + 1
        forward = float(iso6358(p1, ratio * p1, conductance, b, temperature))
        assert forward == pytest.approx(expected, rel=1e-9, abs=1e-12 * full)
        backward = float(iso6358(ratio * p1, p1, conductance, b, temperature))
        assert backward == -forward
    ends = np.array([[4e5], [5e5]]), np.array([1e5, 3e5, 6e5])
    together = iso6358(*ends, 1e-8)
    assert together == pytest.approx(
        np.array([[iso6358(p1, p2, 1e-8) for p2 in ends[1]] for p1 in ends[0].ravel()], float)
    )
    assert choked > 100
    assert laminar > 100


def test_flow_has_finite_derivatives_everywhere_also_without_difference_of_pressure():
    p1, p2 = ca.SX.sym("p1"), ca.SX.sym("p2")
    flow = iso6358(p1, p2, 2.75e-8, 0.3)
    slopes = ca.Function("s", [p1, p2], [ca.jacobian(flow, ca.vertcat(p1, p2))])
    edge = math.sqrt(1 - (0.699 / 0.7) ** 2) * 2.75e-8 * RHO0 / 0.001  # straight line's slope
    assert np.asarray(slopes(5e5, 5e5)).ravel() == pytest.approx([edge, -edge], rel=1e-9)
    for ratio in (0.1, 0.3, 0.5, 0.999, 0.9999, 1.0, 1.0001, 1.001, 2.0, 10.0):
        found = np.asarray(slopes(5e5, 5e5 * ratio)).ravel()
        assert np.all(np.isfinite(found))
        assert np.all(np.abs(found) <= 2 * edge)


def test_conductance_from_a_catalogue_flow():
    assert conductance_from_flow(700) == pytest.approx(2.75e-8, abs=5e-11)
    # and back: with rho0 at the reference state, 700 l/min of it flow from 6 to 5 bar gauge
    mass_flow = float(iso6358(7.013e5, 6.013e5, conductance_from_flow(700), 0.3))
    assert mass_flow / RHO0 * 60e3 == pytest.approx(700, rel=1e-12)
    assert conductance_from_flow(600, 0.5, 6e5, 2e5) == pytest.approx(0.01 / 6e5)  # choked
    for ratio in (-0.1, 1.0):
        refused(r"must lie in 0 \.\. 1", conductance_from_flow, 600, ratio)
    refused("must be above downstream", conductance_from_flow, 700, upstream=1e5, downstream=2e5)


# ---- energy of the air ---------------------------------------------------------------------------


def test_pressure_and_temperature_change_as_mass_and_energy_do():
    """m = p V/(R T) and U = cv m T a moment later, by the mass and the enthalpy that came."""
    p, warm, volume, grown, flow, carried, heat = 4e5, 310.0, 2e-4, 3e-4, 1e-3, 0.28, 5.0
    cv, step = R / 0.4, 1e-7
    mass = p * volume / (R * warm)
    energy = cv * mass * warm + step * (1.4 * cv * carried - p * grown + heat)
    mass, volume_then = mass + step * flow, volume + step * grown
    then = 0.4 * energy / volume_then, energy / (cv * mass)
    rates = balance(p, warm, volume, grown, flow, carried, heat)
    assert rates == pytest.approx(((then[0] - p) / step, (then[1] - warm) / step), rel=1e-5)


def test_exergy_is_the_work_of_an_engine_between_the_air_and_its_surroundings():
    for own in (250.0, 293.15, 400.0):
        warmth = quad(lambda x: 3.5 * R * (1 - 290.0 / x), 290.0, own, epsrel=1e-12)[0]
        expected = R * 290.0 * math.log(6.0) + warmth
        assert specific_exergy(6e5, 1e5, 290.0, own) == pytest.approx(expected, rel=1e-9)
    assert specific_exergy(6e5, 1e5, 290.0) == pytest.approx(R * 290.0 * math.log(6.0))
    assert air_mass([1e5, 2e5], 1e-3, 300.0) == pytest.approx(np.array([100, 200]) / (R * 300))


def test_heat_transfer_rises_with_the_root_of_pressure_and_temperature():
    absolute, temperature = ca.SX(4e5), ca.SX(310.0)
    for law, expected in (
        (PressureHeatTransfer(40.0), 40 * math.sqrt(4e5 * 310.0 / (101325 * 293.15))),
        (PressureHeatTransfer(40.0, 1.0, 2e5), 40 * 2 * 310.0 / 293.15),
        (ConstantHeatTransfer(40.0), 40.0),
    ):
        found = law.coefficient(absolute, temperature, lambda name, value, **_: value)
        assert float(found) == pytest.approx(expected)


# ---- filling -------------------------------------------------------------------------------------


def solved(plant, inputs, start, duration, rtol=1e-8, **options):
    """States over time by SciPy, inputs constant; returns (solution, {name: row})."""
    x0, p = plant.vector("state", start), plant.vector("parameter")
    u = plant.vector("input", inputs)
    scale = plant.vector("state", attribute="nominal")

    def slope(t, x):
        return np.asarray(plant.function(x, u, p)[0]).ravel()

    solution = solve_ivp(
        slope, (0, duration), x0, method="LSODA", rtol=rtol, atol=rtol * scale, **options
    )
    assert solution.success
    return solution, {v.name: i for i, v in enumerate(plant.states)}


@pytest.mark.parametrize(("flow", "t90"), [(700, 0.13), (350, 0.21), (100, 0.64)])
def test_filling_times_are_those_of_the_reference(fluidic, flow, t90):
    gas = Gas(BraidVolume(math.radians(24.42)), dead_volume=DEAD, exponent=1.2, ambient=101300.0)
    feed = SpoolValve(conductance=conductance_from_flow(flow), supply=5e5 - 101300.0, gas=gas)
    plant = HangingLoad(fluidic, 20.0, damping=StiffnessDamping(0.08), feed=feed)
    rest = brentq(lambda k: float(fluidic.tension(1e5, k)) - 20 * GRAVITY, 0, 0.2)
    start = {"x": rest * L0, "muscle.pressure": 1e5}
    target = 1e5 + 0.9 * (feed.supply - 1e5)

    def reached(t, x):
        return x[2] - target

    reached.terminal = True
    solution, row = solved(plant, {"muscle.command": 1.0}, start, 3.0, events=reached)
    assert row["muscle.pressure"] == 2
    assert round(solution.t_events[0][0], 2) == t90


# ---- energy --------------------------------------------------------------------------------------

EXPONENT, DAMPING = 1.2, 30.0


def energy_balance(fluidic, volume, volume_by_hand, motions):
    """Largest gap of random motions, of the energy that passed the valve.

    stored = kinetic + weight + wall + gas p_abs V/(n-1) + p_0 V, with all terms by hand;
    supplied = integral of n/(n-1) R T mdot; lost = integral of c v^2.
    """
    feed = SpoolValve(
        supply=9e5, conductance=conductance_from_flow(300), gas=Gas(volume, DEAD, EXPONENT)
    )
    plant = HangingLoad(fluidic, damping=ConstantDamping(DAMPING), feed=feed)
    rng = np.random.default_rng(1)
    mass = rng.uniform(20, 60, motions)
    parameters = np.tile(plant.vector("parameter")[:, None], motions)
    names = [v.name for v in plant.parameters]
    parameters[names.index("mass")] = mass
    outputs = [v.name for v in plant.outputs]
    flow_row, force_row = outputs.index("muscle.mass_flow"), outputs.index("muscle.force")
    frequency, phase = rng.uniform(2, 6, motions), rng.uniform(0, 2 * np.pi, motions)
    amplitude = rng.uniform(0.05, 0.15, motions)
    kappa = rng.uniform(0.02, 0.12, motions)
    rest = fluidic.pressure(mass * GRAVITY, kappa)
    start = np.array(  # x, v, p, supplied, throughput, lost
        [kappa * L0, rng.uniform(-0.1, 0.1, motions), rest, *np.zeros((3, motions))]
    )
    scale = np.array([0.01, 0.1, 1e5, 1.0, 1.0, 1.0])[:, None]
    weakest = [math.inf]

    def slope(t, flat):
        state = flat.reshape(6, motions) * scale
        command = amplitude * np.sin(2 * np.pi * frequency * t + phase)
        xdot, y, _ = (np.asarray(a) for a in plant.function(state[:3], command[None], parameters))
        weakest[0] = min(weakest[0], y[force_row].min())
        supplied = EXPONENT / (EXPONENT - 1) * R * T * y[flow_row]
        lost = DAMPING * state[1] ** 2
        return (np.vstack([xdot, supplied, np.abs(supplied), lost]) / scale).ravel()

    def stored(state):
        x, v, p = state
        kappa = x / L0
        filled = volume_by_hand(kappa) + DEAD
        gas = (p + 101325) * filled / (EXPONENT - 1) + 101325 * filled
        return mass * v**2 / 2 + mass * GRAVITY * x + wall_energy(kappa) + gas

    run = solve_ivp(
        slope, (0, 0.5), (start / scale).ravel(), method="DOP853", rtol=1e-10, atol=1e-10
    )
    end = run.y[:, -1].reshape(6, motions) * scale
    assert weakest[0] > 1.0  # taut, so the clamp is not in play
    gap = stored(end[:3]) - stored(start[:3]) + end[5] - end[3]
    return float(np.max(np.abs(gap) / end[4]))


@pytest.mark.slow
def test_muscle_with_consistent_volume_neither_gains_nor_loses_energy(fluidic):
    assert energy_balance(fluidic, ConsistentVolume(), reference_volume, 50) < 1e-8


def test_muscle_with_another_volume_does_not_keep_its_energy(fluidic):
    assert energy_balance(fluidic, BraidVolume(math.radians(24.42)), braid_volume, 10) > 1e-3


# ---- feeds ---------------------------------------------------------------------------------------


def test_air_is_conserved_between_valve_tube_muscle_and_leak(fluidic):
    feed = OnOffValves(
        tube=Tube(volume=15e-6, lag=8e-3), leak=2e-10, gas=Gas(exponent=1.0), totals=True
    )
    plant = HangingLoad(fluidic, 20.0, feed=feed)
    start = {"x": 0.03, "muscle.pressure": 2e5, "muscle.tube_pressure": 2e5}
    inputs = {"muscle.fill": 0.2, "muscle.vent": 0.0}
    solution, row = solved(plant, inputs, start, 1.0, rtol=1e-9, dense_output=True)

    def air(state):  # isothermal: m = p V/(R T)
        filled = reference_volume(state[row["x"]] / L0) + DEAD
        inside = (state[row["muscle.pressure"]] + 101325) * filled
        tube = (state[row["muscle.tube_pressure"]] + 101325) * 15e-6
        return (inside + tube) / (R * T)

    t = np.linspace(0, 1, 20001)
    pressure = solution.sol(t)[row["muscle.pressure"]] + 101325
    leaked = trapezoid([float(iso6358(p, 101325, 2e-10)) for p in pressure[::20]], t[::20])
    drawn = solution.y[row["muscle.air_drawn"], -1]
    gained = air(solution.y[:, -1]) - air(solution.y[:, 0])
    assert drawn == pytest.approx(gained + leaked, rel=1e-6)
    assert leaked > 1e-3 * drawn
