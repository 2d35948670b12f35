"""Receivers, tubes, spools, quick exhausts, valves of the catalogue: closed forms, by hand."""

import math

import numpy as np
import pytest
from conftest import rates_and_outputs, refused
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.core.errors import UnknownNameError
from pam_ocp.muscles.gas import Gas, PolynomialVolume
from pam_ocp.muscles.heat import ConstantHeatTransfer
from pam_ocp.plants.plant_file import plant_of
from pam_ocp.plants.valves import valve_entry

F = pam.feeds
R, T0, RHO0, P0, G = 287.05, 293.15, 1.185, 101325.0, 1.4
CV = R / (G - 1)
V, C, B = 1e-4, 1e-8, 0.3
STILL = Gas(PolynomialVolume([V]), dead_volume=0.0, exponent=1.0)
FIXED = {"shortening": 0.0, "rate": 0.0, "pre_contraction": 0.1}


def chambers(*names, **feed):
    """Fixed volumes, each behind a valve of the same feed."""
    plant = pam.Plant("chambers")
    made = F.SpoolValve(**{"conductance": C, "gas": STILL, **feed})
    for name in names:
        plant.add_muscle(name, "DMSP-20-200N", **FIXED, feed=made)
    return plant


# ---- receiver ------------------------------------------------------------------------------------
def test_filling_one_muscle_starves_the_other():
    plant = chambers("one", "two", supply=F.Receiver(5e-4, source=None))
    t = np.linspace(0, 0.5, 11)
    start = {"one.pressure": 1e5, "two.pressure": 1e5}
    alone = pam.simulate(plant, {"one.command": 1.0}, t=t, start=start)
    both = pam.simulate(plant, {"one.command": 1.0, "two.command": 1.0}, t=t, start=start)
    assert both["one.pressure"][-1] < alone["one.pressure"][-1] - 2e4
    assert both["one.pressure"] == pytest.approx(both["two.pressure"])


def test_a_receiver_and_two_chambers_agree_with_scipy():
    def rate(t, p):
        def flow(p1, p2, opening):
            r = p2 / p1
            root = math.sqrt(1 - ((r - B) / (1 - B)) ** 2) if r > B else 1.0
            return opening * p1 * C * RHO0 * root

        one, two = flow(p[0], p[1], 1.0), flow(p[0], p[2], (0.5 - 0.01) / 0.99)
        free = R * T0
        return [-free * (one + two) / 5e-4, free * one / V, free * two / V]

    plant = chambers("one", "two", supply=F.Receiver(5e-4, source=None))
    t = np.linspace(0, 0.03, 7)
    start = {"one.pressure": 1e5, "two.pressure": 5e4}
    motion = pam.simulate(plant, {"one.command": 1.0, "two.command": 0.5}, t=t, start=start)
    first = np.array([6e5, 1e5, 5e4]) + P0
    exact = solve_ivp(rate, (0, 0.03), first, t_eval=t, rtol=1e-11, atol=1e-8)
    for name, values in zip(
        ("receiver.air_pressure", "one.pressure", "two.pressure"), exact.y, strict=False
    ):
        assert motion[name] + P0 == pytest.approx(values, rel=1e-6)


def test_a_compressor_fills_a_receiver_along_a_straight_line():
    source = F.Compressor(flow=2e-3, pressure=8e5, band=1e4)
    plant = chambers("one", supply=F.Receiver(2e-3, pressure=1e5, source=source))
    motion = pam.simulate(plant, duration=2.0)
    line = 1e5 + R * T0 * 2e-3 * RHO0 / 2e-3 * motion.t
    assert motion["receiver.air_pressure"] == pytest.approx(line, rel=1e-6)
    full = pam.simulate(plant, duration=9.0)["receiver.air_pressure"]
    assert full.max() < 8e5 * (1 + 1e-9)
    assert full[-1] > 7.999e5


@pytest.mark.parametrize("wall", [None, 0.0, 3.0])
def test_a_regulator_holds_its_set_pressure_at_rest(wall):
    source = F.PressureRegulator(5.5e5)
    tank = F.Receiver(2e-3, pressure=5e5, wall_conductance=wall, source=source)
    plant = chambers("one", supply=tank)
    motion = pam.simulate(plant, duration=60.0 if wall else 3.0)
    if wall is None or wall:
        assert motion["receiver.air_pressure"][-1] == pytest.approx(5.5e5, rel=1e-4)
    hanging = pam.HangingLoad("DMSP-20-200N", 8.0, feed=F.SpoolValve(supply=F.Receiver()))
    point = hanging.equilibrium({"x": 0.02})
    assert point["receiver.air_pressure"] == pytest.approx(6e5, rel=1e-6)


def test_mass_and_energy_of_receiver_muscles_and_surroundings_are_conserved():
    gas = Gas(heat=ConstantHeatTransfer(40.0))
    supply = F.Receiver(5e-4, source=F.Compressor(), wall_conductance=2.0)
    feed = F.SpoolValve(supply=supply, gas=gas, leak=1e-10, spool=F.SecondOrderSpool())
    plant = pam.AntagonisticSlide("DMSP-20-200N", feed=feed)
    draw, names = np.random.default_rng(5), [v.name for v in plant.states]
    for _ in range(200):
        x = dict(zip(names, plant.vector("state"), strict=True))
        x |= {"x": draw.uniform(-0.01, 0.01), "v": draw.uniform(-0.5, 0.5)}
        x["receiver.air_pressure"], x["receiver.air_temperature"] = draw.uniform(
            [3e5, 260.0], [8e5, 330.0]
        )
        for i in (1, 2):
            x[f"muscle{i}.pressure"] = draw.uniform(0.2e5, 5.5e5)
            x[f"muscle{i}.temperature"] = draw.uniform(250.0, 350.0)
            x[f"muscle{i}.valve.spool"] = draw.uniform(-1, 1)
        xdot, y = rates_and_outputs(plant, x)
        mass, energy = stored(x, xdot, "receiver.air_", 5e-4, 0.0)
        heat, work = y["receiver.heat_flow"], 0.0
        entering, inflow = 293.15 * y["receiver.inflow"], y["receiver.inflow"]
        for i, sign in ((1, 1), (2, -1)):
            growing = grown(x["x"] * sign, x["v"] * sign)
            own = stored(x, xdot, f"muscle{i}.", y[f"muscle{i}.volume"], growing)
            mass, energy = mass + own[0], energy + own[1]
            heat += y[f"muscle{i}.heat_flow"]
            work += (x[f"muscle{i}.pressure"] + P0) * growing
            inflow -= y[f"muscle{i}.vent_flow"]
            entering -= x[f"muscle{i}.temperature"] * y[f"muscle{i}.vent_flow"]
        assert mass == pytest.approx(inflow, abs=1e-12)
        assert energy == pytest.approx((CV + R) * entering + heat - work, abs=1e-8 * 1e3)


def stored(x, xdot, place, volume, growing):
    """Rates of m = p V/(R T) and U = p V/(g - 1) in a place."""
    p, w = x[f"{place}pressure"] + P0, x[f"{place}temperature"]
    dp, dw = xdot[f"{place}pressure"], xdot[f"{place}temperature"]
    mass = p * volume / (R * w) * (dp / p + growing / volume - dw / w)
    return mass, (dp * volume + p * growing) / (G - 1)


def grown(x, v):
    """dV/dt of a DMSP-20-200N at 10 % pre-contraction, by hand."""
    a1, a3, a4, a5, length = -4.00180705, -0.32930845, -9.33564098, 294.0538256, 0.2
    k = 100 * (0.1 + x / length)
    gain = (a1 * math.exp(a3 * k) + a4 * k + a5) / 1e5
    return gain * v


# ---- tubes -------------------------------------------------------------------------------------
def tube_poles(segments, exponent=1.4, length=2.0, diameter=6e-3):
    """Poles of the closed tube about 3 bar with a large muscle at its end, none at the valve's."""
    gas = Gas(PolynomialVolume([1e4]), dead_volume=0.0, exponent=1.0)
    plant = chambers("one", gas=gas, tube=F.LumpedTube(length, diameter, segments, exponent))
    x, u = plant.vector("state", dict.fromkeys(pressures(plant), 300000.0)), plant.vector("input")
    return np.linalg.eigvals(np.asarray(plant.jacobians(x, u, plant.vector("parameter"))[0]))


def pressures(plant):
    return [v.name for v in plant.states if "pressure" in v.name]


@pytest.mark.filterwarnings("ignore:one.gas.v0")  # a very large muscle
@pytest.mark.parametrize("segments", [1, 2, 5])
def test_a_lumped_tube_rings_as_a_chain_of_springs_and_masses(segments):
    """Closed at one end, open at the other: w_k = 2 (n c/L) sin((2k - 1) pi/(2 (2n + 1))) rad/s."""
    poles = tube_poles(segments)
    speed = math.sqrt(1.4 * R * T0)
    k = np.arange(1, segments + 1)
    chain = 2 * segments * speed / 2.0 * np.sin((2 * k - 1) * math.pi / (2 * (2 * segments + 1)))
    # the laminar friction damps each by half of 32 mu/(rho d^2), and lowers it a little
    half = 16 * 1.82e-5 / ((3e5 + P0) / (R * T0) * 6e-3**2)
    found = np.sort(np.abs(poles.imag[poles.imag > 1.0]))
    assert found == pytest.approx(np.sqrt(chain**2 - half**2), rel=1e-6)
    ringing = poles[poles.imag > 1.0].real
    assert ringing == pytest.approx(np.full(segments, -half), rel=1e-6)


@pytest.mark.filterwarnings("ignore:one.gas.v0")
def test_with_segments_the_first_resonance_goes_to_a_quarter_wave():
    exact = 2 * math.pi * math.sqrt(1.4 * R * T0) / (4 * 2.0)
    errors = [
        abs(np.abs(tube_poles(n).imag)[np.abs(tube_poles(n).imag) > 1].min() / exact - 1)
        for n in (4, 8, 16)
    ]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.04


@pytest.mark.parametrize(("flow", "share"), [(1e-6, "laminar"), (3e-3, "Blasius")])
def test_the_friction_of_a_tube_is_that_of_the_textbook(flow, share):
    diameter, length = 4e-3, 1.5
    plant = chambers("one", tube=F.LumpedTube(length, diameter, 1))
    x = {"one.pressure": 3e5, "one.tube_pressure1": 3e5, "one.tube_flow1": flow}
    xdot, _ = rates_and_outputs(plant, x)
    bore, rho = math.pi / 4 * diameter**2, (3e5 + P0) / (R * T0)
    speed = flow / (rho * bore)
    reynolds = rho * speed * diameter / 1.82e-5
    factor = 64 / reynolds if share == "laminar" else 0.3164 / reynolds**0.25
    drop = factor * length / diameter * rho * speed**2 / 2
    assert xdot["one.tube_flow1"] == pytest.approx(-bore / length * drop, rel=1e-4)


def test_a_pressure_step_needs_the_time_of_sound_to_pass_a_tube():
    length = 5.0
    plant = chambers("one", tube=F.LumpedTube(length, 8e-3, 40), conductance=1e-7)
    t = np.linspace(0, 0.03, 601)
    start = dict.fromkeys(pressures(plant), 100000.0)
    motion = pam.simulate(plant, {"one.command": 1.0}, t=t, start=start, rtol=1e-7)
    moved = motion["one.pressure"] - 1e5
    arrival = t[np.argmax(moved > 0.02 * moved.max())]
    assert arrival == pytest.approx(length / math.sqrt(1.4 * R * T0), rel=0.1)


@pytest.mark.parametrize("tube", [F.LumpedTube(1.0, 4e-3, 3, exponent=1.0), F.Tube()])
def test_no_air_is_lost_in_a_tube(tube):
    plant = chambers("one", supply=F.Receiver(5e-4, source=None), tube=tube)
    start = dict.fromkeys(pressures(plant), 100000.0) | {"receiver.air_pressure": 6e5}
    motion = pam.simulate(plant, {"one.command": 0.7}, duration=0.5, start=start)
    size = math.pi / 4 * 4e-3**2 / 3 if isinstance(tube, F.LumpedTube) else 10e-6
    total = 5e-4 * motion["receiver.air_pressure"] + V * motion["one.pressure"]
    total = total + sum(size * motion[n] for n in pressures(plant) if "tube" in n)
    assert total == pytest.approx(np.full(len(total), total[0]), rel=1e-8)


# ---- valves ------------------------------------------------------------------------------------
def test_spools_follow_a_step_in_closed_form():
    t = np.linspace(0, 0.05, 26)
    first = chambers("one", spool=F.FirstOrderSpool(8e-3))
    moved = pam.simulate(first, {"one.command": 0.6}, t=t)["one.valve.spool"]
    assert moved == pytest.approx(0.6 * (1 - np.exp(-t / 8e-3)), abs=1e-7)
    second = chambers("one", spool=F.SecondOrderSpool(50.0, 0.6))
    w, z = 2 * math.pi * 50, 0.6
    damped = w * math.sqrt(1 - z**2)
    ring = np.exp(-z * w * t) * (np.cos(damped * t) + z * w / damped * np.sin(damped * t))
    moved = pam.simulate(second, {"one.command": 0.6}, t=t)["one.valve.spool"]
    assert moved == pytest.approx(0.6 * (1 - ring), abs=1e-7)


@pytest.mark.parametrize(
    "spool", [F.FirstOrderSpool(1e-3, 0.04), F.SecondOrderSpool(500.0, 0.9, 0.04)]
)
def test_the_play_of_a_spool_is_as_wide_as_its_hysteresis(spool):
    plant = chambers("one", spool=spool)
    t = np.linspace(0, 8.0, 801)
    command = 0.5 * np.interp(t % 4, [0, 1, 3, 4], [0, 1, -1, 0])
    motion = pam.simulate(plant, {"one.command": command}, t=t, interpolation="linear", rtol=1e-8)
    play = motion["one.valve.play"]
    assert np.abs(play).max() <= 1 + 1e-6
    at = [np.argmin(np.abs(t - when)) for when in (6.0, 7.9)]
    assert play[at] == pytest.approx([-1.0, 1.0], abs=1e-3)  # 0.02 behind to either side


@pytest.mark.parametrize("slowly", [1.0, 100.0])
def test_however_slow_a_spool_is_its_play_is_off_by_its_edge_at_most(slowly):
    """Against the play operator without smoothing, turn by turn; it rests at the end."""
    plant = chambers("one", spool=F.FirstOrderSpool(1e-3, 0.04))
    turns, times = [0.0, 0.3, -0.2, 0.1, 0.1], slowly * np.array([0.0, 1.0, 3.0, 4.0, 6.0])
    t = np.linspace(0, times[-1], 4001)
    command = {"one.command": np.interp(t, times, turns)}
    motion = pam.simulate(plant, command, t=t, interpolation="linear", rtol=1e-8)
    spool, exact = motion["one.valve.spool"], [motion["one.valve.play"][0]]
    for step in np.diff(spool) / 0.02:
        exact.append(min(max(exact[-1] + step, -1.0), 1.0))
    assert np.abs(motion["one.valve.play"] - exact).max() < 0.055  # of one half of the play


def test_offset_and_unequal_lands_shift_what_is_closed():
    plant = chambers("one", overlap=0.1, exhaust_overlap=0.3, offset=0.05)
    at = {"one.pressure": 3e5}
    flows = {c: rates_and_outputs(plant, {**at, "one.command": c}) for c in (0.55, -0.75)}
    choked = (6e5 + P0) * C * RHO0
    r = (3e5 + P0) / (6e5 + P0)
    filled = choked * math.sqrt(1 - ((r - B) / (1 - B)) ** 2) * (0.6 - 0.05) / 0.95
    assert flows[0.55][1]["one.supply_flow"] == pytest.approx(filled, rel=1e-9)
    vented = (3e5 + P0) * C * RHO0 * (0.7 - 0.15) / 0.85
    assert -flows[-0.75][1]["one.mass_flow"] == pytest.approx(vented, rel=1e-9)
    inner = plant.in_openings()
    for c in (0.55, -0.75):
        opening = (0.6 - 0.05) / 0.95 if c > 0 else -(0.7 - 0.15) / 0.85
        same = rates_and_outputs(inner, {**at, "one.opening": opening})[0]
        assert same["one.pressure"] == pytest.approx(flows[c][0]["one.pressure"], rel=1e-9)


def test_a_quick_exhaust_vents_by_its_own_orifice():
    quick = F.QuickExhaust(3e-8, 0.3, threshold=1e4, band=2e4)
    plants = chambers("one", tube=F.Tube(), quick_exhaust=quick), chambers("one", tube=F.Tube())

    def rates(in_tube):
        at = {"one.pressure": 4e5, "one.tube_pressure": in_tube}
        return [rates_and_outputs(plant, at)[0]["one.pressure"] for plant in plants]

    opened, without = rates(3.6e5)
    vented = (4e5 + P0) * 3e-8 * RHO0
    assert opened - without == pytest.approx(-R * T0 * vented / V, rel=1e-9)
    shut, without = rates(3.95e5)
    assert shut == without


def test_every_valve_of_the_catalogue_has_a_source_and_makes_a_feed():
    for name in F.valve_names():
        entry = valve_entry(name)
        assert entry["source"]
        assert entry["how_sure"] in ("data sheet", "dealer", "user", "weak")
        feed = F.valve(name, supply=5e5)
        assert 1e-9 < feed.conductance < 1e-7
        assert feed.supply == 5e5
    assert F.valve("SMC VT307 2-3").conductance == 0.71e-8
    assert isinstance(F.valve("Festo MPYE-5-1/8-LF-010-B"), F.SpoolValve)
    refused("Festo MPYE-5-1/8", F.valve, "Festo MPYE", error=UnknownNameError)


# ---- parts in common -----------------------------------------------------------------------------
def test_receivers_of_one_name_are_one_or_refused():
    plant = pam.Plant("two")

    def add(muscle, volume, name):
        feed = F.SpoolValve(gas=STILL, supply=F.Receiver(volume, name=name))
        plant.add_muscle(muscle, "DMSP-20-200N", **FIXED, feed=feed)

    add("one", 1e-3, "pot")
    add("two", 2e-3, "tank")
    assert {"pot.air_pressure", "tank.air_pressure"} <= {v.name for v in plant.states}
    refused("two different parts are called 'pot'", add, "three", 3e-3, "pot")


def test_a_gathered_sum_stands_for_whatever_is_added_later():
    plant = pam.Plant("sum")
    x = plant.state("x")
    total, add = plant.gathered()
    plant.output("doubled", 2 * total)
    plant.der(x, total)
    add(3 * x)
    add(4.0)
    assert float(plant.function([2.0], [], [])[0]) == 10.0
    assert float(plant.function([2.0], [], [])[1]) == 20.0
    refused("cannot be changed any more", add, 1.0)


def test_a_file_may_speak_of_all_of_it():
    feed = {
        "kind": "SpoolValve",
        "supply": {"volume": "1 l", "source": {"kind": "Compressor", "flow": "2 l/s"}},
        "spool": {"kind": "FirstOrderSpool", "time": "4 ms"},
        "tube": {"kind": "LumpedTube", "length": "0.5 m", "segments": 2},
        "quick_exhaust": {},
    }
    plant = plant_of({"arrangement": "HangingLoad", "muscle": "DMSP-20-200N", "feed": feed})
    assert plant.variable("receiver.flow").start == pytest.approx(2e-3)
    assert "muscle.tube_flow2" in {v.name for v in plant.states}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: F.Receiver(0.0), "must be > 0"),
        (lambda: F.Receiver(name="a b"), "letters, digits"),
        (lambda: F.SpoolValve(quick_exhaust=F.QuickExhaust()), "give tube="),
        (lambda: F.SpoolValve(supply=F.Receiver(), supply_temperature=300.0), "receiver's source"),
        (lambda: F.SpoolValve(tube=5e-6), "give components"),
        (lambda: F.SpoolValve(spool=5e-3), "give components"),
        (lambda: F.SpoolValve(offset=0.7), "must lie in"),
        (lambda: F.LumpedTube(segments=0), "whole number"),
        (lambda: F.LumpedTube(diameter=-1.0), "must be > 0"),
        (lambda: F.FirstOrderSpool(hysteresis=0.5), "must lie in 0 .. 0.2"),
        (lambda: F.PressureRegulator(relief=2.0), "must lie in"),
        (lambda: F.Compressor(flow=0.0), "must be > 0"),
    ],
)
def test_supply_that_cannot_be_is_refused(make, words):
    refused(words, make)
