"""Every arrangement, feed, loss and load against the equations of hand_equations.py."""

import math

import casadi as ca
import hand_equations as hand
import numpy as np
import pytest
from conftest import rates_and_outputs
from fibres import LONG, SHORT, THIN, bought

import pam_ocp as pam

POINTS = 40
CHOKED = 3e-8
GAS = {"dead_volume": 3e-5, "exponent": 1.3, "temperature": 305.0, "ambient": 0.95e5}
BY_HAND = tuple(GAS.values())  # in the order in which hand.Valves takes them


def by_valves(tube=None):
    """(feed of the library, the same by hand): unequal ways, a leak, warm air, thin air outside."""
    feed = pam.feeds.OnOffValves(
        conductance=CHOKED,
        exhaust_conductance=1.7e-8,
        critical_ratio=0.25,
        supply=6.5e5,
        leak=2e-9,
        tube=pam.feeds.Tube(*tube) if tube else None,
        gas=pam.gas.Gas(**GAS),
    )
    flow = lambda u: (u["fill"], u["vent"])  # noqa: E731
    return feed, hand.Valves(flow, CHOKED, 1.7e-8, 0.25, 6.5e5, 2e-9, *BY_HAND, tube)


FEEDS = {
    "ideal": (pam.feeds.IdealPressure(), hand.ideal),
    "regulator": (pam.feeds.Regulator(0.07), hand.Lag(0.07)),
    "valves": by_valves(),
    "tube": by_valves((1.5e-5, 8e-3)),
}

LOSSES = {
    "none": ((), ()),
    "coulomb": (
        (pam.losses.CoulombFriction(15.0, 3e-5, 0.4, 2e-3, 0.3),),
        (hand.coulomb(15.0, 3e-5, 0.4, 2e-3, 0.3),),
    ),
    "memory": (
        (pam.losses.BoucWen(25.0, 0.008, 0.7, 1.5), pam.losses.Creep((400.0,), (0.6,))),
        (hand.bouc_wen(25.0, 0.008, 0.7, 1.5), hand.creep(400.0, 0.6)),
    ),
    "slip": (
        (pam.losses.MaxwellSlip((6.0, 9.0), (0.004, 0.02), 0.3),),
        (hand.maxwell((6.0, 9.0), (0.004, 0.02), 0.3),),
    ),
}

SHARED = {
    "spring": (700.0, 0.004),
    "damper": 4.0,
    "friction": (6.0, 0.05),
    "inertia": 0.7,
    "outside": "external_force",
}


def loads(wall):
    """Every load of the library at once, and by hand."""
    where, stiffness, damping, side = wall
    given = (
        pam.loads.Spring(700.0, 0.004),
        pam.loads.Damper(4.0),
        pam.loads.DryFriction(6.0, 0.05),
        pam.loads.Inertia(0.7),
        pam.loads.ExternalForce(),
        pam.loads.Wall(where, stiffness, damping, side),
    )
    return given, hand.Loads(**SHARED, wall=wall)


VISCOUS = {
    "constant": (pam.losses.ConstantDamping(23.0), hand.Viscous(23.0)),
    "stiffness": (pam.losses.StiffnessDamping(0.15), hand.Viscous(ratio=0.15)),
}

ARMS = (  # s and r = s': unequal, neither even nor constant
    (
        lambda a: 0.03 * a + 0.008 * math.sin(a) + 0.004 * a**2,
        lambda a: 0.03 + 0.008 * math.cos(a) + 0.008 * a,
    ),
    (lambda a: 0.022 * a - 0.006 * math.cos(a) + 0.006, lambda a: 0.022 + 0.006 * math.sin(a)),
)
PULLEYS = ((lambda a: 0.035 * a, lambda a: 0.035), (lambda a: 0.024 * a, lambda a: 0.024))


def one(fibre, feed, losses):
    return (hand.Puller("muscle", fibre, feed, losses),)


def two(first, second, feed, losses):
    return (
        hand.Puller("muscle1", first, feed, losses),
        hand.Puller("muscle2", second, feed, losses),
    )


def hanging(f, h, ls, hl, d, hd):
    outer, inner = loads((0.05, 4e4, 300.0, 1))
    plant = pam.HangingLoad(
        bought(LONG), 12.0, inclination=0.8, feed=f, losses=ls, damping=d, loads=outer
    )
    return plant, hand.Hanging(12.0, hd, one(LONG, h, hl), inner, 0.8)


def sprung(f, h, ls, hl, d, hd):
    outer, inner = loads((0.02, 4e4, 300.0, -1))
    plant = pam.SpringOverMuscle(
        bought(SHORT), 3.0, 4e3, 70.0, inclination=-0.4, feed=f, losses=ls, damping=d, loads=outer
    )
    return plant, hand.Sprung(3.0, hd, one(SHORT, h, hl), inner, 4e3, 70.0, -0.4)


def slide(f, h, ls, hl, d, hd):
    outer, inner = loads((-0.004, 4e4, 300.0, -1))
    plant = pam.AntagonisticSlide(
        bought(LONG), 2.5, 0.11, muscle2=bought(THIN), feed=f, losses=ls, damping=d, loads=outer
    )
    return plant, hand.Slide(2.5, hd, two(LONG, THIN, h, hl), inner, 0.11)


def joint(arms, hand_arms, wall, f, h, ls, hl, d, hd):
    outer, inner = loads(wall)
    link, feeding = {"link_mass": 1.4, "link_length": 0.25}, {"feed": f, "losses": ls, "damping": d}
    pair = {"muscle2": bought(SHORT), "moment_arm2": arms[1]}
    plant = pam.AntagonisticJoint(
        bought(LONG), 0.06, arms[0], 0.12, **pair, **link, **feeding, loads=outer
    )
    pullers = two(LONG, SHORT, h, hl)
    return plant, hand.Joint(0.06, hd, pullers, inner, 0.12, hand_arms, (1.4, 0.25))


def bent(*parts):
    arms = (lambda a: 0.03 + 0.008 * ca.cos(a) + 0.008 * a, lambda a: 0.022 + 0.006 * ca.sin(a))
    return joint(arms, ARMS, (0.3, 5e3, 40.0, 1), *parts)


def pulleys(*parts):
    return joint((0.035, 0.024), PULLEYS, (-0.2, 5e3, 40.0, -1), *parts)


def series(f, h, ls, hl, d, hd):
    outer, inner = loads((0.01, 4e4, 300.0, 1))
    tendon = {"tendon_damping": 150.0, "fitting_mass": 0.3}
    plant = pam.SeriesLoad(
        bought(LONG), 9.0, 6e4, **tendon, feed=f, losses=ls, damping=d, loads=outer
    )
    return plant, hand.Series(9.0, hd, one(LONG, h, hl), inner, (6e4, 150.0), 0.3)


BUILT = {f.__name__: f for f in (hanging, sprung, slide, bent, pulleys, series)}


def somewhere(plant, rng):
    """Random values of states and inputs, by name."""
    x = {}
    for v in plant.states:
        last = v.name.rpartition(".")[2]
        if last in ("pressure", "tube_pressure"):
            x[v.name] = rng.uniform(0.8e5, 5.8e5)
        elif last.startswith(("hysteresis", "slip")):
            x[v.name] = rng.uniform(-0.95, 0.95)
        elif last.startswith("creep"):
            x[v.name] = rng.uniform(0.0, 0.2)
        elif last in ("v", "velocity", "omega"):
            quick = 8.0 if last == "omega" else 0.8  # memory rounds off below some 1e-2 1/s
            x[v.name] = rng.choice([-1, 1]) * rng.uniform(0.2, 1.0) * quick
        else:
            x[v.name] = rng.uniform(v.min, v.max)
    if "muscle.shortening" in x:  # a tendon of some millimetres
        x["x"] = x["muscle.shortening"] - rng.uniform(-2e-3, 6e-3)
    u = {}
    for v in plant.inputs:
        low, high = (-30.0, 30.0) if v.name == "external_force" else (v.min, v.max)
        u[v.name] = rng.uniform(max(low, -1e6), min(high, 6e5))
    return x, u


def compare(plant, equations, seed, points=POINTS):
    """Derivatives and outputs at random points; returns the names of all outputs compared."""
    rng, met, seen = np.random.default_rng(seed), 0, set()
    size = {v.name: v.nominal for v in plant.variables}
    for _ in range(20 * points):
        x, u = somewhere(plant, rng)
        try:
            rates, outputs = equations(x, u)
        except AssertionError:  # where something is rounded off, which has tests of its own
            continue
        slopes, shown = rates_and_outputs(plant, x | u)
        seen |= set(shown) & set(outputs)
        pairs = [(n, slope, rates[n]) for n, slope in slopes.items()]
        pairs += [(n, shown[n], outputs[n]) for n in set(shown) & set(outputs)]
        for name, value, expected in pairs:
            assert value == pytest.approx(expected, rel=1e-6, abs=1e-6 * size[name]), name
        met += 1
        if met == points:
            return seen
    raise AssertionError(f"only {met} points are free of rounding")


@pytest.mark.parametrize("name", BUILT)
@pytest.mark.parametrize(
    ("feed", "losses", "damping"),
    [
        ("ideal", "none", "constant"),
        ("regulator", "coulomb", "stiffness"),
        ("valves", "memory", "constant"),
        ("tube", "slip", "stiffness"),
    ],
)
def test_every_arrangement_moves_as_its_equations_say(name, feed, losses, damping):
    parts = (*FEEDS[feed], *LOSSES[losses], *VISCOUS[damping])
    plant, equations = BUILT[name](*parts)
    seen = compare(plant, equations, seed=list(map(ord, name + feed)))
    muscles = [p.name for p in equations.pulling]
    wanted = {"stiffness"} | {f"{m}.{k}" for m in muscles for k in ("force", "contraction")}
    if feed in ("valves", "tube"):
        kinds = ("volume", "mass_flow", "supply_flow", "exergy_flow", "power")
        wanted |= {f"{m}.{k}" for m in muscles for k in kinds}
    assert wanted <= seen


def test_a_load_fed_back_from_its_position_moves_as_its_equations_say():
    plant = pam.RegulatedLoad(
        bought(LONG),
        15.0,
        gain=2e6,
        derivative_gain=3e5,
        lag=0.12,
        max_pressure=5e5,
        damping=pam.losses.ConstantDamping(30.0),
    )
    feed = hand.Regulated(2e6, 3e5, 0.12, 5e5)
    equations = hand.Hanging(15.0, hand.Viscous(30.0), one(LONG, feed, ()))
    rng, ends = np.random.default_rng(5), set()
    for _ in range(400):
        x = {"x": rng.uniform(0, 0.1), "v": rng.uniform(-0.5, 0.5)}
        x["muscle.pressure"] = rng.uniform(1e5, 5e5)
        u = {"muscle.set_pressure": rng.uniform(0, 5e5), "muscle.reference": rng.uniform(0, 0.1)}
        try:
            rates, outputs = equations(x, u)
        except AssertionError:
            continue
        slopes, shown = rates_and_outputs(plant, x | u)
        assert slopes == pytest.approx({n: rates[n] for n in slopes}, rel=1e-9)
        command = shown["muscle.command"]
        assert command == pytest.approx(outputs["muscle.command"], rel=1e-9, abs=1e-3)
        ends.add("low" if command < 1 else "high" if command > 5e5 - 1 else "between")
    assert ends == {"low", "high", "between"}


def test_a_fully_open_spool_is_an_open_valve():
    feed = pam.feeds.SpoolValve(
        conductance=CHOKED, exhaust_conductance=1.7e-8, gas=pam.gas.Gas(**GAS)
    )
    plant = pam.HangingLoad(bought(LONG), 12.0, feed=feed)
    at = {"x": 0.05, "v": 0.3, "muscle.pressure": 2.2e5}
    for command, opened in ((1.0, (1.0, 0.0)), (-1.0, (0.0, 1.0))):
        flow = lambda _, opened=opened: opened  # noqa: E731
        valves = hand.Valves(flow, CHOKED, 1.7e-8, 0.3, 6e5, 0.0, *BY_HAND)
        expected, _ = valves({"pressure": 2.2e5}, {}, LONG, 0.05 / 0.4, 0.3)
        rates, _ = rates_and_outputs(plant, {**at, "muscle.command": command})
        assert rates["muscle.pressure"] == pytest.approx(expected["pressure"], rel=1e-9)


def test_the_stroke_of_a_pair_ends_where_the_first_muscle_leaves_its_range():
    """0 .. 25 % of 0.4 m and of 0.25 m, both at 11 %: 11 % of 0.25 m is the least of the four."""
    plant, joint = (
        BUILT[n](*FEEDS["ideal"], *LOSSES["none"], *VISCOUS["constant"])[0]
        for n in ("slide", "pulleys")
    )
    assert plant.variable("x").max == pytest.approx(0.11 * 0.25, rel=1e-12)
    assert plant.variable("x").min == pytest.approx(-0.11 * 0.25, rel=1e-12)
    # at 12 %: 0.12 0.4/0.035 = 1.371 rad, 0.12 0.2/0.024 = 1.0 rad
    assert joint.variable("theta").max == pytest.approx(1.0, rel=1e-12)
    other = pam.AntagonisticSlide(bought(LONG), 2.5, 0.2, muscle2=bought(THIN))
    assert other.variable("x").max == pytest.approx(0.05 * 0.25, rel=1e-12)  # to 25 % now
    swapped = pam.AntagonisticSlide(bought(THIN), 2.5, 0.2, muscle2=bought(LONG))
    assert swapped.variable("x").max == pytest.approx(0.05 * 0.25, rel=1e-12)


@pytest.mark.parametrize("side", [1, -1])
def test_a_wall_pushes_back_but_never_holds(side):
    """Deep in the wall, leaving it ever quicker: its force falls to nothing, never below."""
    wall = pam.loads.Wall(0.05, 4e4, 300.0, side)
    plant, bare = (pam.HangingLoad(bought(LONG), 12.0, loads=some) for some in ((wall,), ()))

    def pushed(v):
        at = {"x": 0.05 + side * 5e-3, "v": side * v, "muscle.pressure": 3e5}
        walled, free = (rates_and_outputs(p, at)[0]["v"] for p in (plant, bare))
        return -side * 12.0 * (walled - free)

    speeds = np.linspace(-3.0, 3.0, 61)
    found = np.array([pushed(v) for v in speeds])
    assert np.all(found >= -1e-9)
    assert np.all(np.diff(found) >= -1e-9)
    assert found[speeds < -0.9] == pytest.approx(0.0, abs=1e-9)  # 300 N s/m * 0.67 m/s = 200 N
    assert pushed(1.0) == pytest.approx(200.0 + 300.0 * 200 / 201, rel=1e-6)


@pytest.mark.parametrize(("theta", "omega"), [(0.52, 0.3), (0.52, -2.0), (-0.43, -0.4), (0.1, 1.0)])
def test_the_stops_of_a_joint_stand_at_its_limits(theta, omega):
    """2000 N m/rad and 5 N m s/rad beyond -0.4 and 0.5 rad."""
    held, free = (
        pam.AntagonisticJoint(bought(LONG), 0.06, limits=limits, feed=pam.feeds.IdealPressure())
        for limits in ((-0.4, 0.5), None)
    )
    at = {"theta": theta, "omega": omega, "muscle1.pressure": 3e5, "muscle2.pressure": 3e5}
    torque = [0.06 * rates_and_outputs(p, at)[0]["omega"] for p in (held, free)]
    expected = sum(
        hand.wall_force(where, 2e3, 5.0, side, theta, omega, 0.1)
        for where, side in ((0.5, 1), (-0.4, -1))
    )
    assert torque[0] - torque[1] == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", ["bent", "pulleys", "slide"])
def test_allocation_of_unequal_muscles_and_arms(name):
    """Random taut pressures come back from the effort and the stiffness written out by hand."""
    plant, equations = BUILT[name](*FEEDS["ideal"], *LOSSES["none"], *VISCOUS["constant"])
    pair, rng, found = pam.operating.Allocation(plant), np.random.default_rng(8), 0
    position = "x" if name == "slide" else "theta"
    for _ in range(200):
        at, p = rng.uniform(-0.01, 0.01), rng.uniform(1e5, 5.5e5, 2)
        at = at if name == "slide" else 50 * at
        x = {position: at, ("v" if name == "slide" else "omega"): 0.0}
        u = {"muscle1.pressure": p[0], "muscle2.pressure": p[1], "external_force": 0.0}
        try:
            _, outputs = equations(x, u)
        except AssertionError:
            continue
        if min(outputs["muscle1.force"], outputs["muscle2.force"]) <= 1.0:
            continue
        one_force, two_force = outputs["muscle1.force"], outputs["muscle2.force"]
        effort = outputs["torque"] if name != "slide" else one_force - two_force
        assert pair.pressures(at, effort, outputs["stiffness"]) == pytest.approx(tuple(p), rel=1e-8)
        assert pair.feasible(at, *p)
        found += 1
    assert found > 50
