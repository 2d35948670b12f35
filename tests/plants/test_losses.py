"""Losses: damping, friction, hysteresis with memory, creep."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp, trapezoid
from scipy.optimize import brentq, least_squares

import pam_ocp as pam
from pam_ocp.core.errors import InputError
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
        attach(
            self,
            "muscle",
            muscle("DMSP-20-300"),
            shortening=x,
            rate=speed,
            pre_contraction=0.08,
            feed=IdealPressure(),
            losses=losses,
        )


def loss_at(loss, velocity, pressure=PRESSURE):
    """Force of a memoryless loss at a speed of shortening [m/s]."""
    plant = Drawn(loss)
    u = plant.vector("input", {"speed": velocity, "muscle.pressure": pressure})
    y = plant.function(plant.vector("state"), u, plant.vector("parameter"))[1]
    return float(y[[v.name for v in plant.outputs].index("muscle.loss")])


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


# ---- without memory
# -------------------------------------------------------------------------------


def test_a_law_and_its_damping_are_what_the_load_feels():
    known = muscle("DMSP-20-400N")
    for damping, expected in (
        (ConstantDamping(30.0), 30.0),
        (StiffnessDamping(0.08), 2 * 0.08 * math.sqrt(20.0 * float(known.stiffness(3e5, 0.1)))),
    ):
        plant = HangingLoad(known, 20.0, damping=damping, feed=IdealPressure())
        u, p = plant.vector("input", {"muscle.pressure": 3e5}), plant.vector("parameter")
        slow, fast = (
            float(plant.function(plant.vector("state", {"x": 0.04, "v": v}), u, p)[0][1])
            for v in (0.0, 0.5)
        )
        assert (slow - fast) * 20.0 / 0.5 == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("kpa", [250.0, 400.0, 600.0])
def test_reynolds_damping_differs_between_contracting_and_relaxing(kpa):
    for mm_per_s in (20.0, -20.0):
        b = 1.01 + 0.00691 * kpa if mm_per_s > 0 else 0.6 - 0.000803 * kpa
        found = loss_at(DirectionalDamping.reynolds(), mm_per_s / 1e3, kpa * 1e3)
        assert found == pytest.approx(b * mm_per_s, rel=1e-9)


@pytest.mark.parametrize(("kpa", "b"), [(200.0, 1.57), (500.0, 0.311 + 0.00338 * 500)])
def test_festo_damping_has_two_slopes_while_relaxing(kpa, b):
    assert loss_at(DirectionalDamping.festo(), -0.02, kpa * 1e3) == pytest.approx(-b * 20, rel=1e-9)
    assert loss_at(DirectionalDamping.festo(), 0.02, kpa * 1e3) == pytest.approx(
        2.90 * 20, rel=1e-9
    )


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
    names = [v.name for v in plant.outputs]
    u = plant.vector("input", {"speed": 0.02, "muscle.pressure": PRESSURE})
    y = np.asarray(plant.function(plant.vector("state"), u, plant.vector("parameter"))[1]).ravel()
    law = muscle("DMSP-20-300").force(PRESSURE, 0.08)
    assert y[names.index("muscle.loss")] == pytest.approx(10 + 58, rel=1e-9)
    assert y[names.index("muscle.force")] == pytest.approx(law - 68, rel=1e-9)
    slack = plant.vector("input", {"speed": 0.02, "muscle.pressure": 0.0})
    y = np.asarray(
        plant.function(plant.vector("state"), slack, plant.vector("parameter"))[1]
    ).ravel()
    assert y[names.index("muscle.force")] == 0.0


# ---- with memory ---------------------------------------------------------------------------------

HYSTERESES = [BoucWen(), BoucWen(beta=0.8, order=1.0), MaxwellSlip()]


@pytest.mark.parametrize("loss", HYSTERESES, ids=["bouc-wen", "bouc-wen-1", "maxwell-slip"])
def test_hysteresis_does_not_depend_on_the_rate(loss):
    turns = [0.0, 0.06, 0.02, 0.05, 0.0]
    _, slow = drawn_along(loss, turns, 0.01)
    _, fast = drawn_along(loss, turns, 1.0)
    assert np.max(np.abs(fast - slow)) < 0.01 * np.max(np.abs(slow))


@pytest.mark.parametrize("loss", HYSTERESES, ids=["bouc-wen", "bouc-wen-1", "maxwell-slip"])
def test_every_closed_loop_dissipates(loss):
    rng = np.random.default_rng(6)
    sticking = 2 * np.min(loss.yield_contraction)  # smaller Maxwell-slip loops are elastic
    for _ in range(2):
        low, width = rng.uniform(0.0, 0.04), rng.uniform(1.05 * sticking, 0.04)
        high = low + width
        kappa, force = drawn_along(loss, [low, *[high, low] * 3], 0.2)
        area = trapezoid(force[-2:].ravel(), kappa[-2:].ravel())
        assert 0 < area < 2 * np.sum(loss.friction) * width


@pytest.mark.parametrize("loss", HYSTERESES, ids=["bouc-wen", "bouc-wen-1", "maxwell-slip"])
def test_hysteresis_dissipates_at_every_instant(loss):
    plant = Drawn(loss)
    rng = np.random.default_rng(7)
    memory, outputs = plant.vector("state").size - 1, [v.name for v in plant.outputs]
    stored = np.atleast_1d(loss.friction) * np.atleast_1d(loss.yield_contraction)  # times z^2/2
    for _ in range(300):
        rate = rng.choice([-1, 1]) * 10 ** rng.uniform(-6, 1)
        state = np.array([0.01, *rng.uniform(-1, 1, memory)])
        u = plant.vector("input", {"speed": rate * LENGTH, "muscle.pressure": PRESSURE})
        xdot, y, _ = plant.function(state, u, plant.vector("parameter"))
        z, zdot = state[1:], np.asarray(xdot).ravel()[1:]
        power = float(y[outputs.index("muscle.loss")]) * rate
        assert power - np.sum(stored * z * zdot) >= -1e-12 * abs(power)


@pytest.mark.parametrize("loss", HYSTERESES, ids=["bouc-wen", "bouc-wen-1", "maxwell-slip"])
def test_full_slide_gives_the_friction_and_a_reversal_the_stiffness(loss):
    kappa, force = drawn_along(loss, [0.0, 0.08, 0.0], 0.1)
    friction, width = np.atleast_1d(loss.friction), np.atleast_1d(loss.yield_contraction)
    assert force[0, -1] == pytest.approx(friction.sum(), rel=0.01)
    assert force[1, -1] == pytest.approx(-friction.sum(), rel=0.01)
    start = (force[0, 1] - force[0, 0]) / (kappa[0, 1] - kappa[0, 0])
    assert start == pytest.approx(np.sum(friction / width), rel=0.05)


def minor_loop_gap(loss):
    """How far apart the force is at both ends of a minor loop on the way up, and a second one."""
    _, force = drawn_along(loss, [0.0, 0.05, 0.04, 0.05, 0.04, 0.05], 0.1)
    friction = np.sum(loss.friction)
    return (
        np.max(np.abs(force[1] - force[3])) / friction,
        abs(force[2, -1] - force[0, -1]) / friction,
    )


def test_minor_loops_of_maxwell_slip_close():
    repeated, returned = minor_loop_gap(MaxwellSlip())
    assert repeated < 0.01
    assert returned < 0.01


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

    plant = HangingLoad(
        muscle("DMSP-20-400N"),
        MASS,
        feed=IdealPressure(),
        damping=ConstantDamping(DAMPER),
        losses=(Creep(),),
    )
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
    u, p = plant.vector("input"), plant.vector("parameter")
    run = solve_ivp(
        lambda t, x: np.asarray(plant.function(x, u, p)[0]).ravel(),
        (0, 1.0),
        [0.0, 0.0],
        rtol=1e-9,
        atol=1e-12,
    )
    loss = 800.0 * (0.08 - run.y[1, -1])
    assert loss == pytest.approx(800 * 0.08 * math.exp(-1.0 / 0.5), rel=1e-6)


def test_creep_against_a_linear_law_is_that_of_a_kelvin_voigt_element():
    slope, stiffness, tau, weight = 4000.0, 1000.0, 2.0, 5 * 9.80665
    described = {"area": coefficient("N/Pa", 1e-3, "area"), "slope": coefficient("N", 1e3, "slope")}
    linear = own_law("linear", lambda p, kappa, area, slope: area * p - slope * kappa, described)
    plant = HangingLoad(
        Muscle(linear(area=1e-3, slope=slope), rest_length=LENGTH),
        5.0,
        feed=IdealPressure(),
        damping=ConstantDamping(200.0),
        losses=(Creep([stiffness], [tau]),),
    )
    u, p = plant.vector("input", {"muscle.pressure": 5e5}), plant.vector("parameter")
    t = np.linspace(1.0, 10.0, 10)
    run = solve_ivp(
        lambda t, x: np.asarray(plant.function(x, u, p)[0]).ravel(),
        (0, 10.0),
        [0.0, 0.0, 0.0],
        method="LSODA",
        rtol=1e-9,
        atol=1e-12,
        t_eval=t,
    )
    settled, at_once = (500.0 - weight) / slope, (500.0 - weight) / (slope + stiffness)
    assert 1 - at_once / settled == pytest.approx(stiffness / (slope + stiffness))
    retarded = tau * (1 + stiffness / slope)
    expected = settled - (settled - at_once) * np.exp(-t / retarded)
    assert run.y[0] / LENGTH == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MaxwellSlip((1.0, 2.0), (0.01,)), "one of each per element"),
        (lambda: DirectionalDamping([], [(1.0, 0.0)]), "at least one line"),
    ],
)
def test_impossible_losses_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
