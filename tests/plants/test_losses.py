"""Losses: damping, friction, hysteresis with memory, creep."""

import math
from itertools import pairwise

import numpy as np
import pytest
from conftest import rates_and_outputs, refused, scipy_states
from scipy.integrate import solve_ivp, trapezoid
from scipy.optimize import brentq, least_squares

import pam_ocp as pam
from pam_ocp.muscles.catalogue import muscle
from pam_ocp.muscles.law import coefficient
from pam_ocp.muscles.laws.user_defined import own_law
from pam_ocp.muscles.pneumatic_muscle import Muscle
from pam_ocp.plants.damping import (
    ConstantDamping,
    CoulombFriction,
    DirectionalDamping,
    StiffnessDamping,
)
from pam_ocp.plants.feeds import IdealPressure, attach
from pam_ocp.plants.hanging import HangingLoad
from pam_ocp.plants.memory import BoucWen, Creep, MaxwellSlip
from pam_ocp.plants.plant import Plant
from pam_ocp.plants.slide import AntagonisticSlide

LENGTH = 0.3
PRESSURE = 4e5


class Drawn(Plant):
    """A muscle at constant pressure whose end is moved: x' = the input ``speed``."""

    def __init__(self, *losses):
        super().__init__("drawn", "a muscle on a testing machine")
        x = self.state("x", unit="m", nominal=0.01)
        speed = self.input("speed", unit="m/s")
        self.der(x, speed)
        place = {"shortening": x, "rate": speed, "pre_contraction": 0.08}
        known, feed = muscle("DMSP-20-300"), IdealPressure()
        attach(self, "muscle", known, **place, feed=feed, losses=losses)


def loss_at(loss, velocity, pressure=PRESSURE):
    """Force of a memoryless loss at a speed of shortening [m/s]."""
    at = {"speed": velocity, "muscle.pressure": pressure}
    return rates_and_outputs(Drawn(loss), at)[1]["muscle.loss"]


@pytest.mark.parametrize(
    "loss",
    [
        CoulombFriction(0.0, per_pressure=1e-3),
        DirectionalDamping([(1.0, 1e-3)], [(1.0, 1e-3)]),
        pam.losses.ForceVelocity(1.0, 1e-3, 1.0, 1e-3),
        pam.losses.StrandFriction(),
    ],
)
def test_below_the_ambient_pressure_no_friction_drives(loss):
    for pressure, velocity in ((-2e4, 0.1), (-2e4, -0.1), (-9e4, 1e-4)):
        assert loss_at(loss, velocity, pressure) * velocity >= 0


def drawn_along(loss, turns, rate):
    """Contraction and loss force along straight strokes between ``turns`` at ``rate`` [1/s]."""
    plant = Drawn(loss)
    names = [v.name for v in plant.outputs]
    p, state = plant.vector("parameter"), plant.vector("state", {"x": turns[0] * LENGTH})
    kappa, force = [], []
    for here, there in pairwise(turns):
        speed = math.copysign(rate, there - here) * LENGTH
        u = plant.vector("input", {"speed": speed, "muscle.pressure": PRESSURE})
        duration = abs(there - here) / rate
        run = solve_ivp(
            lambda t, x, u=u: np.asarray(plant.function(x, u, p)[0]).ravel(),
            (0, duration),
            state,
            method="LSODA",
            rtol=1e-9,
            atol=1e-10,
            t_eval=np.linspace(0, duration, 301),
            max_step=duration / 50,
        )
        state = run.y[:, -1]
        y = np.asarray(plant.function(run.y, np.tile(u[:, None], 301), np.tile(p[:, None], 301))[1])
        kappa.append(run.y[0] / LENGTH)
        force.append(y[names.index("muscle.loss")])
    return np.array(kappa), np.array(force)  # a row for each stroke


# ---- without memory ------------------------------------------------------------------------------


def test_a_law_and_its_damping_are_what_the_load_feels():
    known = muscle("DMSP-20-400N")
    for damping, expected in (
        (ConstantDamping(30.0), 30.0),
        (StiffnessDamping(0.08), 2 * 0.08 * math.sqrt(20.0 * float(known.stiffness(3e5, 0.1)))),
    ):
        plant = HangingLoad(known, 20.0, damping=damping, feed=IdealPressure())
        at = {"x": 0.04, "muscle.pressure": 3e5}
        slow, fast = (rates_and_outputs(plant, {**at, "v": v})[0]["v"] for v in (0.0, 0.5))
        assert (slow - fast) * 20.0 / 0.5 == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("kpa", [250.0, 400.0, 600.0])
def test_reynolds_damping_differs_between_contracting_and_relaxing(kpa):
    for mm_per_s in (20.0, -20.0):
        b = 1.01 + 0.00691 * kpa if mm_per_s > 0 else 0.6 - 0.000803 * kpa
        found = loss_at(DirectionalDamping.reynolds(), mm_per_s / 1e3, kpa * 1e3)
        assert found == pytest.approx(b * mm_per_s, rel=1e-9)


@pytest.mark.parametrize(("kpa", "b"), [(200.0, 1.57), (500.0, 0.311 + 0.00338 * 500)])
def test_festo_damping_has_two_slopes_while_relaxing(kpa, b):
    for slope, v in ((b, -0.02), (2.90, 0.02)):
        found = loss_at(DirectionalDamping.festo(), v, kpa * 1e3)
        assert found == pytest.approx(slope * 1e3 * v, rel=1e-9)


def test_directional_damping_never_drives():
    falling = DirectionalDamping([(100.0, -1e-3)], [(100.0, -1e-3)])
    assert loss_at(falling, 0.1, 3e5) == 0.0
    for v in (-0.1, -1e-4, 1e-4, 0.1):
        assert loss_at(DirectionalDamping.reynolds(), v) * v > 0


def test_dry_friction_opposes_motion_and_falls_with_speed_when_asked():
    friction = CoulombFriction(10.0, per_pressure=5e-5)
    assert loss_at(friction, 0.05) == pytest.approx(10 + 5e-5 * PRESSURE)
    assert loss_at(friction, -0.05) == pytest.approx(-(10 + 5e-5 * PRESSURE))
    assert loss_at(friction, 0.0) == 0.0
    stribeck = CoulombFriction(10.0, excess=0.5, stribeck_speed=0.02)
    assert loss_at(stribeck, 0.005) == pytest.approx(10 * (1 + 0.5 * math.exp(-1 / 16)), rel=1e-3)
    assert loss_at(stribeck, 0.2) == pytest.approx(10.0)


def test_losses_are_taken_off_the_pull_before_the_clamp():
    plant = Drawn(CoulombFriction(10.0), DirectionalDamping.festo())
    taut, slack = (
        rates_and_outputs(plant, {"speed": 0.02, "muscle.pressure": p})[1] for p in (PRESSURE, 0.0)
    )
    law = muscle("DMSP-20-300").force(PRESSURE, 0.08)
    assert taut["muscle.loss"] == pytest.approx(10 + 58, rel=1e-9)
    assert taut["muscle.force"] == pytest.approx(law - 68, rel=1e-9)
    assert slack["muscle.force"] == 0.0


# ---- with memory ---------------------------------------------------------------------------------

each_hysteresis = pytest.mark.parametrize(
    "loss",
    [BoucWen(), BoucWen(beta=0.8, order=1.0), MaxwellSlip()],
    ids=["bouc-wen", "bouc-wen-1", "maxwell-slip"],
)


@each_hysteresis
def test_hysteresis_does_not_depend_on_the_rate(loss):
    turns = [0.0, 0.06, 0.02, 0.05, 0.0]
    _, slow = drawn_along(loss, turns, 0.01)
    _, fast = drawn_along(loss, turns, 1.0)
    assert np.max(np.abs(fast - slow)) < 0.01 * np.max(np.abs(slow))


@each_hysteresis
def test_every_closed_loop_dissipates(loss):
    rng = np.random.default_rng(6)
    sticking = 2 * np.min(loss.yield_contraction)  # smaller Maxwell-slip loops are elastic
    for _ in range(2):
        low, width = rng.uniform(0.0, 0.04), rng.uniform(1.05 * sticking, 0.04)
        high = low + width
        kappa, force = drawn_along(loss, [low, *[high, low] * 3], 0.2)
        area = trapezoid(force[-2:].ravel(), kappa[-2:].ravel())
        assert 0 < area < 2 * np.sum(loss.friction) * width


@each_hysteresis
def test_hysteresis_dissipates_at_every_instant(loss):
    plant, rng = Drawn(loss), np.random.default_rng(7)
    memory = [v.name for v in plant.states][1:]
    stored = np.atleast_1d(loss.friction) * np.atleast_1d(loss.yield_contraction)  # times z^2/2
    for _ in range(300):
        rate = rng.choice([-1, 1]) * 10 ** rng.uniform(-6, 1)
        z = rng.uniform(-1, 1, len(memory))
        at = {"speed": rate * LENGTH, "muscle.pressure": PRESSURE, "x": 0.01}
        rates, outputs = rates_and_outputs(plant, at | dict(zip(memory, z, strict=True)))
        power = outputs["muscle.loss"] * rate
        gained = np.sum(stored * z * [rates[n] for n in memory])
        assert power - gained >= -1e-12 * abs(power)


@each_hysteresis
def test_full_slide_gives_the_friction_and_a_reversal_the_stiffness(loss):
    kappa, force = drawn_along(loss, [0.0, 0.08, 0.0], 0.1)
    friction, width = np.atleast_1d(loss.friction), np.atleast_1d(loss.yield_contraction)
    assert force[0, -1] == pytest.approx(friction.sum(), rel=0.01)
    assert force[1, -1] == pytest.approx(-friction.sum(), rel=0.01)
    start = (force[0, 1] - force[0, 0]) / (kappa[0, 1] - kappa[0, 0])
    assert start == pytest.approx(np.sum(friction / width), rel=0.05)


def test_minor_loops_of_maxwell_slip_close():
    _, force = drawn_along(MaxwellSlip(), [0.0, 0.05, 0.04, 0.05, 0.04, 0.05], 0.1)
    friction = np.sum(MaxwellSlip().friction)
    assert np.max(np.abs(force[1] - force[3])) < 0.01 * friction  # a second loop is the first
    assert abs(force[2, -1] - force[0, -1]) < 0.01 * friction  # which ends where it began


def test_minor_loops_of_bouc_wen_drift():
    plant_of = BoucWen(friction=20.0, yield_contraction=0.02, order=1.0)
    _, force = drawn_along(plant_of, [0.0, 0.02, *[0.018, 0.02] * 8], 0.1)
    tops = force[0::2, -1]  # force each time at the same contraction
    assert np.all(np.diff(tops) < 0)
    assert tops[0] - tops[-1] > 0.05 * 20.0


def test_hysteresis_of_both_muscles_keeps_the_mirror_symmetry_of_the_slide():
    plant = AntagonisticSlide(muscle("DMSP-20-200N"), losses=(MaxwellSlip(),))
    assert plant.mirror_map["muscle1.slip2"] == (1.0, "muscle2.slip2")
    assert plant.mirror_map["muscle2.slip2"] == (1.0, "muscle1.slip2")


# ---- creep ---------------------------------------------------------------------------------------

MASS, DAMPER, TAU = 20.0, 300.0, 0.9


def tension_by_hand(bar, kappa):
    """Eq. (3) for the DMSP-20-400N."""
    k = 100 * kappa
    exponential = (-4.35573 * bar + 281.22370) * math.exp(-0.32866 * k)
    return exponential - 9.27035 * k * bar + 302.20107 * bar - 263.69185


def creeping_lift(stiffness, t):
    """Contraction after a step from 2 to 4 bar: m x'' = F - K (k - e) - m g - c x', e' = (k-e)/tau.

    Returns those settled before, at once after the step (no inertia, no creep yet), and over t.
    """
    weight = MASS * 9.80665
    before = brentq(lambda k: tension_by_hand(2.0, k) - weight, 0, 0.27)
    at_once = brentq(lambda k: tension_by_hand(4.0, k) - stiffness * (k - before) - weight, 0, 0.27)

    def slope(_, state):
        k, rate, e = state
        pull = tension_by_hand(4.0, k) - stiffness * (k - e) - weight - DAMPER * 0.4 * rate
        return [rate, pull / MASS / 0.4, (k - e) / TAU]

    run = solve_ivp(slope, (0, t[-1]), [before, 0.0, before], t_eval=t, rtol=1e-9, atol=1e-11)
    return before, at_once, run.y[0]


def test_creep_of_a_fifth_of_the_stroke_is_found_back_from_a_record():
    t = np.linspace(0.0, 3.5, 71)

    def share(stiffness):
        before, at_once, kappa = creeping_lift(stiffness, t)
        return (kappa[-1] - at_once) / (kappa[-1] - before)

    true = brentq(lambda k: share(k) - 0.20, 100.0, 5000.0, xtol=1.0)
    assert share(true) == pytest.approx(0.20, abs=1e-3)
    before, _, record = creeping_lift(true, t)
    noise = 2.5e-4  # of the contraction: 0.1 mm
    measured = record + np.random.default_rng(2).normal(0.0, noise, t.size)

    parts = {"damping": ConstantDamping(DAMPER), "losses": (Creep(),)}
    plant = HangingLoad(muscle("DMSP-20-400N"), MASS, feed=IdealPressure(), **parts)
    told = {"start": {"x": before * 0.4, "muscle.creep1": before}, "t": t, "rtol": 1e-9}

    def residual(z):
        creep = {"muscle.creep1_stiffness": z[0], "muscle.creep1_time": z[1]}
        run = pam.simulate(plant, {"muscle.pressure": 4e5}, parameters=creep, **told)
        return (run["x"] / 0.4 - measured) / noise

    bounds = ([10.0, 0.1], [5000.0, 10.0])
    fit = least_squares(residual, [500.0, 2.0], bounds=bounds, x_scale=[500.0, 1.0], diff_step=1e-4)
    deviation = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    assert np.all(np.abs(fit.x - [true, TAU]) < 3 * deviation)
    assert np.all(deviation < 0.02 * np.array([true, TAU]))
    assert np.sqrt(np.mean(fit.fun**2)) == pytest.approx(1.0, abs=0.25)


def test_held_muscle_relaxes_with_the_time_of_the_creep_element():
    plant = Drawn(Creep([800.0], [0.5]))
    crept = scipy_states(plant, lambda _: plant.vector("input"), [0.0, 1.0], [0.0, 0.0])[-1, 1]
    loss = 800.0 * (0.08 - crept)
    assert loss == pytest.approx(800 * 0.08 * math.exp(-1.0 / 0.5), rel=1e-6)


def test_creep_against_a_linear_law_is_that_of_a_kelvin_voigt_element():
    slope, stiffness, tau, weight = 4000.0, 1000.0, 2.0, 5 * 9.80665
    described = {"area": coefficient("N/Pa", 1e-3, "area"), "slope": coefficient("N", 1e3, "slope")}
    linear = own_law("linear", lambda p, kappa, area, slope: area * p - slope * kappa, described)
    known = Muscle(linear(area=1e-3, slope=slope), rest_length=LENGTH)
    parts = {"damping": ConstantDamping(200.0), "losses": (Creep([stiffness], [tau]),)}
    plant = HangingLoad(known, 5.0, feed=IdealPressure(), **parts)
    t = np.linspace(0.0, 10.0, 11)
    x = scipy_states(plant, lambda _: [5e5], t, np.zeros(3), method="LSODA", rtol=1e-9)[1:, 0]
    settled, at_once = (500.0 - weight) / slope, (500.0 - weight) / (slope + stiffness)
    assert 1 - at_once / settled == pytest.approx(stiffness / (slope + stiffness))
    retarded = tau * (1 + stiffness / slope)
    expected = settled - (settled - at_once) * np.exp(-t[1:] / retarded)
    assert x / LENGTH == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MaxwellSlip((1.0, 2.0), (0.01,)), "one of each per element"),
        (lambda: DirectionalDamping([], [(1.0, 0.0)]), "at least one line"),
    ],
)
def test_impossible_losses_are_refused(make, words):
    refused(words, make)
