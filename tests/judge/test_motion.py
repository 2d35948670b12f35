"""The judge of motions, beside motions that are known by hand."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import hardening_cart, judged_held, refused
from scipy.integrate import simpson

import pam_ocp as pam
from pam_ocp.core.errors import InputError
from pam_ocp.core.signals import PiecewisePolynomial
from pam_ocp.judge import Judgement, Motion, Statement, judge
from pam_ocp.judge.asked import unit_of_sum
from pam_ocp.judge.statement import COSTS, times_seconds

A, WAY = 4.0, 1.0
TIME = 2 * np.sqrt(WAY / A)
"""Quickest way of a cart from rest to rest with an acceleration of at most A."""
X, V, U, P, M = 0.5, 3.0, 5.0, 7.0, 0.2
"""Nominals of position, velocity, input, power and mass: no two are alike, none is one."""


def cart(total: bool = False) -> pam.Plant:
    """x'' = u, with what muscles and valves give out, as costs read it."""
    plant = pam.Plant("cart")
    x, v = plant.state("x", unit="m", nominal=X), plant.state("v", unit="m/s", nominal=V)
    u = plant.input("u", unit="m/s2", min=-A, max=A, nominal=U)
    plant.parameter("mass", 1.0, unit="kg", nominal=M)
    plant.der(x, v)
    plant.der(v, u)
    if total:
        plant.der(plant.state("spent", start=2.0, nominal=4.0), u**2)
    plant.output("power", u * v, unit="W/kg", nominal=P)
    plant.parameter("c.rest_length", 0.25, unit="m")
    for name, expression in (
        ("a.supply_flow", u**2),
        ("b.supply_flow", 3 * v**2),
        ("a.exergy_flow", x),
        ("c.force", u),
        ("c.contraction", x),
        ("d.force", v),
        ("e.force", v),
        ("e.contraction", x),
        ("e.power", 2 * v),
    ):
        plant.output(name, expression)
    plant.mirror({"x": (-1.0, "x"), "v": (-1.0, "v"), "u": (-1.0, "u")})
    return plant


CART = cart()


def bang_bang(time: float = TIME, size: float = A, x0: float = 0.0, v0: float = 0.0) -> Motion:
    breaks = np.array([0.0, time / 2, time])
    signals = PiecewisePolynomial(breaks, np.array([[[size]], [[-size]]]))
    return Motion(np.array([x0, v0]), signals, (time,))


STOPS = [{"x": 0.0}, {"x": WAY}]


def by_label(judgement: Judgement) -> dict[str, float]:
    """By how much each is missed, at most."""
    return {f.label: f.by for f in reversed(judgement.findings)}


def found(motion: Motion, stops=STOPS, **words) -> dict[str, float]:
    return by_label(judge(CART, Statement(stops, **words), motion))


ANYHOW = pam.Stop({}, rest=False)


def test_a_motion_known_by_hand_keeps_all_and_costs_what_theory_says():
    weights = {"time": 2.0, "effort": 1.0, "square(v)": 3.0, "final(x)": 5.0, "peak(v)": 7.0}
    weights |= {"rate": 0.1, "air": 1e-4, "exergy": 11.0, "work": 13.0}
    said = Statement(STOPS, minimise=weights, final=17 * CART.expression("x"))
    judgement = judge(CART, said, bang_bang())
    assert judgement.violation < 1e-8
    assert len(str(judgement).splitlines()) == 1
    top = np.sqrt(A * WAY)  # v(T/2)
    squares = 2 * A**2 * (TIME / 2) ** 3 / 3
    expected = 2 * TIME + A**2 * TIME / U**2 + 3 * squares / V**2 + 5 * WAY / X + 7 * top / V
    expected += 0.1 * (2 * A / U) ** 2 / (TIME / 2) + 1e-4 * (A**2 * TIME + 3 * squares) / 1e-3
    expected += 11 * (WAY * TIME / 2) / 10  # by symmetry x is WAY / 2 on average
    # c works on the first half of the way; e says its power, d has no contraction
    expected += 13 * (0.25 * A * WAY / 2 + 2 * WAY) + 17 * WAY
    assert judgement.objective == pytest.approx(expected, rel=1e-9)


SLOPES = (4.4**3 - 2**3) / 18 + 16 * 0.6


@pytest.mark.parametrize(
    ("breaks", "coefficients", "expected"),
    [
        # held: steps of 2 and -4, between the middles of 0.2, 0.3 and 1 s
        ([0.0, 0.2, 0.5, 1.5], [[1.0], [3.0], [-1.0]], 2**2 / 0.25 + 4**2 / 0.65),
        # slopes 2 + 6 s over 0.4 s, -4 over 0.6 s; joined, and with a jump of 2.28 between them
        ([0.0, 0.4, 1.0], [[1.0, 2.0, 3.0], [2.28, -4.0, 0.0]], SLOPES),
        ([0.0, 0.4, 1.0], [[1.0, 2.0, 3.0], [0.0, -4.0, 0.0]], SLOPES + 2.28**2 / 0.5),
    ],
)
def test_the_rate_of_inputs_by_hand(breaks, coefficients, expected):
    signals = PiecewisePolynomial(np.array(breaks), np.array(coefficients)[..., None])
    said = Statement([{}, {}], minimise={"rate": 0.5, "time": 3.0})
    objective = judge(CART, said, Motion(np.zeros(2), signals, (breaks[-1],))).objective
    assert objective == pytest.approx(0.5 * expected / U**2 + 3 * breaks[-1], rel=1e-9)


@pytest.mark.parametrize(
    ("motion", "label", "by"),
    [
        (bang_bang(x0=0.01), "stop 1: x", 0.01 / X),
        (bang_bang(x0=1e-6), "stop 1: x", 1e-6 / X),
        (bang_bang(v0=0.02), "stop 2: x", 0.02 * TIME / X),
        (bang_bang(size=1.1 * A), "u", 0.1 * A / U),
        (bang_bang(time=1.01 * TIME), "stop 2: x", 0.0201 * WAY / X),
    ],
)
def test_what_a_hand_made_motion_misses_is_found_to_its_size(motion, label, by):
    assert found(motion)[label] == pytest.approx(by, rel=1e-6)
    assert f"\n  {label}: {by:.3g}\n" in f"{judge(CART, Statement(STOPS), motion)}\n"


def test_a_velocity_at_a_stop_is_no_rest():
    faster = bang_bang(v0=0.05)
    assert found(faster)["stop 1: v at rest"] == pytest.approx(0.05 / V)
    assert found(faster)["stop 2: v at rest"] == pytest.approx(0.05 / V)
    via = [pam.Stop({"x": 0.0}, rest=False), pam.Stop({"x": (None, None)}, rest=False)]
    assert not any("rest" in label for label in found(faster, via))


def test_an_input_may_jump_to_what_holds_the_plant_but_only_where_it_may_go():
    """The cart's input sets its acceleration at once: zero holds it, unless zero is forbidden."""
    forbidden = pam.Constraint(CART.expression("u") ** 2, low=1.0, name="never idle")
    assert found(bang_bang(), constraints=[forbidden])["stop 2: der(v) at rest"] > 0.9 / (10 * V)


def test_an_acceleration_behind_a_lag_must_have_gone():
    """With a lag before the force the input cannot take it away at once: 121 m/s2 is no rest."""
    plant = pam.Plant("lagged")
    x, v, f = plant.state("x", unit="m"), plant.state("v"), plant.state("f", start=0.0)
    u = plant.input("u", min=-10.0, max=10.0)
    plant.der(x, v)
    plant.der(v, f)
    plant.der(f, (u - f) / 0.05)
    stops = [{"x": 0.0}, pam.Stop({"x": 1.0}, rest=False)]
    by = by_label(judged_held(plant, [0.0, 0.0, 2.0], [2.0], stops))
    assert by["stop 1: der(v) at rest"] == pytest.approx(0.2)  # 2 m/s2 of 10 nominals a second
    assert by["stop 1: v settled"] == pytest.approx(0.2, rel=1e-2)  # no input keeps it there


def test_inputs_that_hold_a_plant_are_found_behind_a_slew_limit():
    """p' = clip((u - p)/0.01, -1, 1): but for u within 0.01 of p its slope is zero."""
    plant = pam.Plant("slewing")
    x, v, p = plant.state("x", unit="m"), plant.state("v", unit="m/s"), plant.state("p")
    u = plant.input("u", min=0.0, max=7.0)
    plant.der(x, v)
    plant.der(v, p - x - v)
    plant.der(p, ca.fmin(ca.fmax((u - p) / 0.01, -1.0), 1.0))
    assert judged_held(plant, [5.03, 0.0, 5.03], [2.0], [{"x": 5.03}, ANYHOW], 0.1).violation < 1e-6
    beyond = judged_held(plant, [7.1, 0.0, 7.1], [2.0], [{"x": 7.1}, ANYHOW], 0.1)
    assert beyond.constraint == "stop 1: p settled"


def test_an_integral_of_what_turns_round_is_that_of_its_two_halves():
    """What flows one way and back nearly cancels: v counts in full beyond v0, and by the part k
    below; k leaves a thousandth of either. By hand, with v from 0 to V at a constant rate and back:
    the area of the tip of the triangle, (V - v0)^2/A, less k times the rest."""
    v0, top = 0.4567 * np.sqrt(A * WAY), np.sqrt(A * WAY)
    tip, rest = (top - v0) ** 2 / A, WAY - (top - v0) ** 2 / A
    k = 0.999 * tip / rest
    plant = cart()
    v = plant.expression("v")
    beyond = ca.fmax(v - v0, 0.0)
    for scale in (1.0, 1e-6):
        said = Statement(STOPS, minimise={}, integrand=scale * (beyond - k * (v - beyond)))
        objective = judge(plant, said, bang_bang()).objective
        assert objective == pytest.approx(scale * (tip - k * rest), abs=1e-6 * scale)
    assert abs(tip - k * rest) < 2e-3 * tip


def test_the_largest_value_is_found_between_points():
    """Two lags of 4 ms in a row, the first at 1: s t e^(-t/s)/s is 1/e at most."""
    plant = pam.Plant("lags")
    a, b = plant.state("a"), plant.state("b")
    plant.der(a, (plant.input("u") - a) / 0.004)
    plant.der(b, (a - b) / 0.004)
    judgement = judged_held(plant, [1.0, 0.0], [0.0], [ANYHOW, ANYHOW], minimise="peak(b)")
    assert judgement.objective == pytest.approx(np.exp(-1), rel=2e-4)


LINE = pam.Profile([0.0, TIME], [0.0, WAY])
HIGH = pam.Profile([0.0, TIME], [2.0, 2.0])
SPIKE = pam.Profile([0.0, 0.3036, 0.3037, 0.3038, 1.0], [9.0, 9.0, 1.0, 9.0, 9.0])
BENT = pam.Profile([0.0, 0.2, 0.5, 1.0], np.array([0.0, 0.2, 0.5, 1.0]) ** 3, smooth=True)
VIA = [{"x": 0.0}, pam.Stop({"x": 0.5}, rest=False), {"x": WAY}]


def limit(**ends) -> pam.Constraint:
    return pam.Constraint(CART.expression("x"), name="place", nominal=0.25, **ends)


@pytest.mark.parametrize(
    ("words", "label", "by"),
    [
        ({"constraints": [pam.Avoid({"x": (0.5, 0.1)}, name="block")]}, "block", 1.0),
        ({"constraints": [pam.Avoid({"x": (0.5, 0.1), "time": (0.5, 0.2)}, "then")]}, "then", 1.0),
        ({"constraints": [pam.Avoid({"x": (0.5, 0.1), "time": (0.9, 0.2)}, "then")]}, "then", 0.0),
        ({"constraints": [pam.Avoid({"x": (0.3, 1e-5)}, "thin")]}, "thin", 1.0),
        ({"constraints": [pam.Avoid({"x": (0.3, 1e-5), "v": (1.0, 0.2)}, "thin")]}, "thin", 0.0),
        ({"constraints": [limit(high=0.9)]}, "place", 0.1 / 0.25),
        ({"constraints": [limit(low=0.2)]}, "place", 0.2 / 0.25),
        ({"bounds": {"v": (None, 1.5)}}, "v", 0.5 / V),  # between the points
        ({"bounds": {"power": (None, 1.0)}}, "power", (2 * A - 1) / P),  # before the jump alone
        ({"bounds": {"x": (None, LINE)}}, "x below its profile", 1 / 8 / X),  # 1 - 2 s^2 - (1 - s)
        ({"bounds": {"v": (None, SPIKE)}}, "v below its profile", (4 * 0.3037 - 1) / V),
        (
            {"bounds": {"x": (None, LINE)}, "phases": [None, pam.Phase(bounds={"x": (0, HIGH)})]},
            "x below its profile",
            1 / 8 / X,
        ),
        ({"bounds": {"u": (-9.0, 9.0)}}, "u", 0.0),
        ({"bounds": {"u": (-3.0, None)}}, "u", (A - 3) / U),
        ({"bounds": {"u": (None, 3.0)}}, "u", (A - 3) / U),
        ({"bounds": {"der(v)": (None, 3.0)}}, "der(v)", (A - 3) / (10 * V)),
        ({"bounds": {"der(x)": (0.1, np.inf)}}, "der(x)", 0.1 / (10 * X)),
        ({"bounds": {"v": (pam.Profile([0, 1], [0.3, 0.3]), None)}}, "v above its profile", 0.1),
        ({"budgets": {"effort": 0.5}}, "budget of effort", A**2 * TIME / U**2 - 0.5),
        ({"budgets": {"effort": (0.9, None)}}, "budget of effort", 0.9 - A**2 * TIME / U**2),
        ({"budgets": {"integral(v)": (0.2, 0.9)}}, "budget of integral(v)", 0.1 / V),
        ({"budgets": {"time": 0.9}}, "budget of time", 0.1),
        ({"duration": 0.4}, "duration of leg 2", 0.1 / 0.5),
        ({"duration": [0.3, (None, 0.4)]}, "duration of leg 1", 0.2 / 0.5),
        ({"duration": [0.3, (None, 0.4)]}, "duration of leg 2", 0.1 / 0.5),
        ({"duration": (0.6, None)}, "duration of leg 1", 0.1 / 0.5),
        ({"duration": 0.5, "phases": [None, pam.Phase(0.3)]}, "duration of leg 2", 0.2 / 0.5),
        ({"duration": 0.5, "phases": [pam.Phase(0.3), None]}, "duration of leg 2", 0.0),
        ({"phases": [pam.Phase(bounds={"x": (None, 0.7)}), None]}, "x", 0.0),
        ({"phases": [pam.Phase(bounds={"x": (None, 0.3)}), None]}, "x", 0.2 / X),
        ({"phases": [None, pam.Phase(bounds={"x": (None, 0.7)})]}, "x", 0.3 / X),
        ({"phases": [None, pam.Phase(constraints=[limit(low=0.6)])]}, "place", 0.1 / 0.25),
        ({"design": {"mass": (2.0, 3.0)}}, "design: mass", 1.0 / M),
        ({"design": {"mass": (0.1, 0.4)}}, "design: mass", 0.6 / M),
        ({"stops": [{"x": 0.0}, {"x": (None, 0.4)}, {}]}, "stop 2: x", 0.1 / X),
        ({"stops": [{"x": 0.0}, {"x": (0.7, np.inf)}, {}]}, "stop 2: x", 0.2 / X),
        ({"stops": [{"x": 0.0}, {"u": A}, {}]}, "stop 2: u", 2 * A / U),  # behind the jump
        ({"stops": [{"x": 0.0}, {"x": LINE}, {"x": 0.5}]}, "stop 3: x", 0.5 / X),
        ({"stops": [{"x": 0.0}, {"v": LINE}, {}]}, "stop 2: v", 1.5 / V),
        ({"stops": [{"x": 0.0}, VIA[1]], "cyclic": True}, "closing of the cycle: x", WAY / X),
    ],
)
def test_what_is_asked_of_two_legs_is_found_to_its_size(words, label, by):
    """The bang-bang motion by way of its middle, at 0.5 s with 2 m/s."""
    by_each = found(replace(bang_bang(), durations=(0.5, 0.5)), **({"stops": VIA} | words))
    assert by_each.get(label, 0.0) == pytest.approx(by, abs=1e-6)


@pytest.mark.parametrize("place", [1, 2])
@pytest.mark.parametrize(
    ("dwell", "label", "by"),
    [
        (pam.Stop({}, dwell=0.25, within=1e-3), "dwell at stop {}: x", 0.024),
        (pam.Stop({}, dwell=0.25, within=0.01), "dwell at stop {}: x", 0.015),
        (pam.Stop({}, dwell=0.2), "duration of the dwell at stop {}", 0.2),
        (pam.Stop({}, dwell=(0.3, 0.4)), "duration of the dwell at stop {}", 0.2),
        (pam.Stop({}, dwell=(0.2, 0.3)), "duration of the dwell at stop {}", 0.0),
    ],
)
def test_a_dwell_lasts_and_holds_what_its_stop_names(place, dwell, label, by):
    """For 0.25 s it drifts by 0.4/2 0.25^2 = 0.0125, at the end down, at the begin up."""
    ends = [0.25, 0.75, 1.25] if place == 1 else [0.5, 1.0, 1.25]
    held = [0.4, A, -A] if place == 1 else [A, -A, -0.4]
    signals = PiecewisePolynomial(np.array([0.0, *ends]), np.array(held)[:, None, None])
    stops = [ANYHOW, ANYHOW]
    durations = (0.25, 1.0) if place == 1 else (1.0, 0.25)
    stops[place - 1] = replace(dwell, values={"x": float(place - 1)} if "x" in label else {})
    by_each = found(Motion(np.zeros(2), signals, durations), stops, duration=1.0)
    assert by_each.get(label.format(place), 0.0) == pytest.approx(by, abs=1e-6)
    assert "duration of leg 1" not in by_each


def held_by_pull(force: float, inputs: list[float], durations: list[float], stops, **words):
    """x'' = f + w, f' = u: what is found of a motion with (u, w) held on three equal parts."""
    plant = pam.Plant("pulled")
    x, v, f = plant.state("x"), plant.state("v"), plant.state("f")
    u, w = plant.input("u"), plant.input("w", min=-4.0, max=4.0)
    plant.der(x, v)
    plant.der(v, f + w)
    plant.der(f, u)
    plant.output("pull", f + w, max=2.5)
    pieces = np.array([[[0.0, w]] for w in inputs])
    signals = PiecewisePolynomial(np.linspace(0.0, sum(durations), len(pieces) + 1), pieces)
    motion = Motion(np.array([0.0, 0.0, force]), signals, tuple(durations))
    return by_label(judge(plant, Statement(stops, **words), motion))


@pytest.mark.parametrize(
    ("named", "phase", "by"),
    [
        ({}, {}, 0.0),
        ({"w": (-9.0, 0.0)}, {}, 0.0),
        ({}, {"w": (0.0, 9.0)}, 0.0),
        ({"w": 0.5}, {}, 0.15),
        ({"pull": 0.5}, {}, 0.05),
        ({"f": 1.0, "w": (0.0, 0.0)}, {}, 0.1),
    ],
)
def test_what_holds_a_plant_at_a_stop_is_what_the_stop_says(named, phase, by):
    """A force of 1 is held by w = -1; phases say nothing of stops."""
    stops = [pam.Stop({"x": 0.0} | named), ANYHOW]
    found = held_by_pull(1.0, [0.0], [1.0], stops, phases=[pam.Phase(bounds=phase)])
    assert found.get("stop 1: der(v) at rest", 0.0) == pytest.approx(by, rel=0.02, abs=1e-9)


def test_a_dwell_says_nothing_of_the_inputs_behind_it():
    """w is 0 for a second, then 3: that is the next leg's, and more than the output may be."""
    stops = [pam.Stop({"x": 0.0, "w": 0.0}, dwell=1.0), ANYHOW]
    found = held_by_pull(0.0, [0.0, 3.0], [1.0, 1.0], stops)
    assert {n: by for n, by in found.items() if by > 1e-9} == pytest.approx({"pull": 0.5})
    late = held_by_pull(0.0, [0.0, 3.0, 3.0], [2.0, 1.0], stops)
    assert late["dwell at stop 1: w"] == pytest.approx(3.0 - 1e-3)


def test_a_mirrored_cycle_ends_in_its_image_and_what_only_sums_up_does_not_close():
    """x from 0.2 to 1.2, whose image is -0.2; the sum begins at 3, not at its start value 2."""
    plant = cart(total=True)
    stops = [{"x": 0.2}, {"x": 1.2}]
    motion = replace(bang_bang(x0=0.2), start=np.array([0.2, 0.0, 3.0]))
    for cyclic, expected in (
        ("mirrored", {"closing of the cycle: x": 1.4 / X}),
        (False, {"stop 1: spent at the start": 1 / 4}),
    ):
        findings = judge(plant, Statement(stops, cyclic=cyclic), motion).findings
        assert {f.label: f.by for f in findings if f.by > 1e-9} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("bounds", "by"), [({}, 0.1), ({"d": (0.4, 0.6)}, 0.0), ({"d": (None, 0.2)}, 0.15)]
)
def test_a_disturbance_is_what_it_is_unless_the_statement_says_otherwise(bounds, by):
    plant = pam.Plant("blown")
    x, v, u = plant.state("x"), plant.state("v"), plant.input("u", min=-2.0, max=2.0)
    plant.der(x, v)
    plant.der(v, u + plant.input("d", disturbance=True, start=0.3, nominal=2.0))
    judgement = judged_held(plant, [0.0, 0.0], [-0.5, 0.5], [{"x": 0.0}] * 2, bounds=bounds)
    assert judgement.constraint in ("d", "")
    assert judgement.violation == pytest.approx(by, abs=1e-9)
    effort = judged_held(plant, [0.0, 0.0], [-0.5, 0.5], [ANYHOW] * 2, minimise="effort")
    assert effort.objective == pytest.approx(0.5**2)  # nobody makes the disturbance


@pytest.mark.parametrize(
    ("lag", "values", "expected"),
    [
        (0.05, {"b": 0.0}, {"der(b) at rest": 0.4, "a settled": 0.25, "b settled": 0.4}),
        (10.0, {"b": 0.0}, {"der(b) at rest": 0.002, "a settled": 0.25, "b settled": 0.2}),
        (10.0, {}, {"a settled": 0.25, "b settled": 0.1}),
    ],
)
def test_levels_without_velocities_have_settled(lag, values, expected):
    """b follows a: b' = 1/lag, in ten nominals a second. a is 0.5 from where an input holds it,
    10 s away, and b then, too; what the stop names has a way of 1, beside a as it is."""
    plant = pam.Plant("lags")
    a, b = plant.state("a", nominal=2.0), plant.state("b", nominal=5.0)
    plant.der(a, (plant.input("u", min=0.0, max=0.5) - a) / 10)
    plant.der(b, (a - b) / lag)
    by = by_label(judged_held(plant, [1.0, 0.0], [0.0], [values, ANYHOW]))
    assert {label.removeprefix("stop 1: "): b for label, b in by.items()} == pytest.approx(expected)


def test_where_a_motion_cannot_go_on_the_time_is_told():
    """x' = 1, y' = sqrt(1 - x): there is no such rate behind 1 s."""
    plant = pam.Plant("ending")
    x, y = plant.state("x"), plant.state("y")
    plant.der(x, 1.0)
    plant.der(y, ca.sqrt(1 - x) + plant.input("u"))
    judgement = judged_held(plant, [0.0, 0.0], [0.0], [ANYHOW, ANYHOW], 2.0)
    assert (judgement.violation, judgement.error) == (np.inf, np.inf)
    assert np.isnan(judgement.objective)
    told = re.fullmatch(r"the integration of its inputs stops at t = (.+) s", judgement.constraint)
    assert 0.9 < float(told[1]) <= 1.0


def test_a_motion_with_other_legs_is_refused():
    with pytest.raises(InputError, match="durations: 1 legs for 3 stops"):
        judge(CART, Statement([*STOPS, {"x": 0.0}]), bang_bang())
    with pytest.raises(InputError, match="durations: 0 legs for 1 stops"):
        judge(CART, Statement(STOPS[:1]), replace(bang_bang(), durations=()))


def test_the_judge_finds_what_a_planner_forgets(monkeypatch):
    """A planner without rows of rest: the motion arrives, and does not stop."""
    from pam_ocp.planning.problem import formulation

    monkeypatch.setattr(formulation, "at_rest", lambda *given: [])
    with pytest.warns(pam.PlanWarning, match="at rest"):
        plan = pam.plan(cart(), STOPS, method=pam.Collocation(10, 3), tolerance=None)
    assert not plan.verified
    assert plan.replay.violation < 1e-6  # by its own conditions all is well


def test_a_plan_from_a_file_is_judged_by_the_words_in_it(tmp_path):
    plant = cart()
    limit = pam.Constraint(plant.expression("x") * pam.planning.TIME, high=2.0, name="late and far")
    words = {"constraints": [limit, pam.Avoid({"v": (0.0, 0.5), "x": (0.5, 0.1)})]}
    words |= {"bounds": {"v": (None, "1.9 m/s")}, "minimise": {"time": 1.0, "effort": 1e-3}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plan = pam.plan(plant, STOPS, **words)
        again = pam.load_plan(plan.save(tmp_path / "plan.npz"), cart())
    assert again.judgement.objective == pytest.approx(plan.judgement.objective, rel=1e-9)
    assert [f.label for f in again.judgement.findings] == [f.label for f in plan.judgement.findings]


def test_what_swings_many_times_between_two_points_is_seen_and_counted():
    # a free oscillator of 400 rad/s: 64 swings in a second, on one piece of the input
    swing, plant = 400.0, pam.Plant("fork")
    x, v = plant.state("x", nominal=1.0), plant.state("v", nominal=swing)
    plant.input("pull", min=-1.0, max=1.0)
    plant.der(x, v)
    plant.der(v, -(swing**2) * x)
    words = {"minimise": "square(x)", "bounds": {"x": (-0.9, 0.9)}}
    found = judged_held(plant, [1.0, 0.0], [0.0], [ANYHOW, ANYHOW], **words)
    # the integral of cos^2 over the second
    assert found.objective == pytest.approx(0.5 + np.sin(2 * swing) / (4 * swing), rel=1e-6)
    assert found.constraint == "x"
    assert found.violation == pytest.approx(0.1, rel=1e-3)


# ---- motions from elsewhere ----------------------------------------------------------------------
def test_a_motion_from_elsewhere_is_made_of_what_simulate_takes():
    plant = pam.Plant("mass", "a mass that a force pushes")
    x, v, f = plant.state("x"), plant.state("v"), plant.input("f")
    plant.der(x, v)
    plant.der(v, f)
    held = {"f": ([0.0, 1.0, 2.0], [1.0, -1.0, -1.0])}  # 1 m in 2 s, by hand
    motion = Motion.of(plant, {"x": 0.25}, held, [2.0])
    assert motion.start.tolist() == [0.25, 0.0]
    statement = Statement([{"x": 0.25}, {"x": 1.5}])
    found = judge(plant, statement, motion)
    assert found.constraint == "stop 2: x"  # it comes to rest at 1.25 m
    assert found.violation == pytest.approx(0.25, rel=1e-6)
    assert "stop 2: x: 0.25" in str(found)
    run = pam.simulate(plant, held, start={"x": 0.25}, duration=2.0)
    again = judge(plant, statement, Motion.of(plant, {"x": 0.25}, run, [2.0]))
    assert again.violation == pytest.approx(found.violation)


def test_a_motion_of_something_else_names_what_takes_it(slide):
    run = pam.simulate(slide, duration=0.1)
    refused(r"is a Trajectory: Motion\.of\(plant", Motion, run.array(["x"])[0], run, (0.1,))


@pytest.mark.parametrize(
    ("durations", "words"),
    [([], "durations is empty"), ([0.1, -0.1], r"durations\[1\]"), (["a"], r"durations\[0\]")],
)
def test_a_motion_of_ones_own_has_legs_that_last(durations: list[float], words: str) -> None:
    plant = pam.HangingLoad("DMSP-20-300", 20.0)
    refused(words, pam.judge.Motion.of, plant, {"x": 0.0}, {"muscle.command": 1e5}, durations)


# ---- costs and deviations, beside other computations ---------------------------------------------
@pytest.mark.parametrize(
    ("words", "cost"),
    [
        ({"track": {"x": (0.3, 2.0)}}, lambda t, x: 2 * (x - 0.3) ** 2 / X**2),
        ({"track": {"x": 0.3}}, lambda t, x: (x - 0.3) ** 2 / X**2),
        ({"track": {"x": LINE}}, lambda t, x: (x - t) ** 2 / X**2),
        ({"track": {"x": (BENT, 3.0)}}, lambda t, x: 3 * (x - t**3) ** 2 / X**2),
        ({"minimise": {"integral(x)": 3.0}}, lambda t, x: 3 * x / X),
    ],
)
def test_what_is_tracked_or_summed_along_a_motion(words, cost):
    t = np.linspace(0.0, TIME, 20_001)
    x = np.where(t < 0.5, A / 2 * t**2, WAY - A / 2 * (TIME - t) ** 2)
    said = Statement(STOPS, **({"minimise": {}} | words))
    expected = simpson(cost(t, x), x=t)
    assert judge(CART, said, bang_bang()).objective == pytest.approx(expected, rel=1e-7)


def test_one_sample_that_is_claimed_elsewhere_is_the_error():
    claimed = judge(cart(), Statement(STOPS), bang_bang()).trajectory
    columns = {n: claimed[n].copy() for n in ("x", "v")}
    columns["x"][7] += 0.03
    other = pam.Trajectory(claimed.t, columns, [cart().variable(n) for n in columns])
    judgement = judge(cart(), Statement(STOPS), bang_bang(), other)
    assert (judgement.error, judgement.state) == (pytest.approx(0.03 / X, rel=1e-6), "x")


@pytest.mark.parametrize("term", ["nothing", "peak(x)", "final(x)"])
def test_a_budget_is_of_what_adds_up_along_a_motion(term):
    with pytest.raises(pam.PamError, match=re.escape(f"unknown objective '{term}'")):
        judge(cart(), Statement(STOPS, budgets={term: 1.0}), bang_bang())


ODD = {"cyclic": "mirrored"}


def limit_of(nominal: float) -> pam.Constraint:
    return pam.Constraint(CART.expression("x"), high=1.0, nominal=nominal)


# ---- statements ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("words", "make"),
    [
        ("give a mapping, such as", lambda: pam.Stop(3)),
        ("2 entries|at least two", lambda: pam.Profile([0.0], [1.0])),
        ("lists of equal length", lambda: pam.Profile([0.0, 1.0], [1.0])),
        ("lists of equal length", lambda: pam.Profile([[0.0, 1.0]] * 2, [[1.0, 2.0]] * 2)),
        ("must rise", lambda: pam.Profile([0.0, 0.0], [1.0, 2.0])),
        ("must be finite", lambda: pam.Profile([0.0, 1.0], [1.0, np.nan])),
        ("at least 4 values", lambda: pam.Profile([0.0, 1.0, 2.0], [0.0, 0.0, 0.0], smooth=True)),
        ("phases", lambda: Statement(STOPS, phases=[3])),
        ("constraints", lambda: Statement(STOPS, constraints=3)),
        ("budgets", lambda: Statement(STOPS, budgets=[3])),
        ("scalar CasADi SX", lambda: found(bang_bang(), constraints=[pam.Constraint(CART.x)])),
        ("scalar CasADi SX", lambda: found(bang_bang(), constraints=[pam.Constraint(3.0)])),
        (
            "not the plant's: x",
            lambda: found(bang_bang(), constraints=[pam.Constraint(cart().x[0])]),
        ),
        ("not the plant's: x", lambda: found(bang_bang(), final=cart().x[0])),
        ("neither a Constraint", lambda: found(bang_bang(), constraints=[None])),
        ("nominal = -1 must be > 0", lambda: found(bang_bang(), constraints=[limit_of(-1.0)])),
        ("give one of them", lambda: found(bang_bang(), constraints=[limit()])),
        ("region is empty", lambda: found(bang_bang(), constraints=[pam.Avoid({})])),
        ("x = 0 m must", lambda: found(bang_bang(), constraints=[pam.Avoid({"x": (0.5, 0.0)})])),
        ("2 entries for 1 phases", lambda: found(bang_bang(), phases=[None, None])),
        ("0 entries for 1 phases", lambda: found(bang_bang(), duration=[])),
        ("(shortest, longest)", lambda: found(bang_bang(), duration=(0.1, 0.2, 0.3))),
        ("give the most", lambda: found(bang_bang(), budgets={"effort": (1.0, 2.0, 3.0)})),
        ("give the aim", lambda: found(bang_bang(), track={"x": (1.0, 2.0, 3.0)})),
        ("'mirrored'", lambda: found(bang_bang(), cyclic="mirror")),
        ("no mirror symmetry", lambda: judged_held(hardening_cart(), [0, 0], [0], [{}, {}], **ODD)),
        ("from 0 to 1 s, and", lambda: found(replace(bang_bang(), durations=(2.0,)))),
        ("3 states and 1 inputs; cart", lambda: found(replace(bang_bang(), start=np.zeros(3)))),
        ("has no muscle", lambda: COSTS["work"].expression(hardening_cart(), None)),
        ("'air' needs the outputs", lambda: COSTS["air"].expression(hardening_cart(), None)),
    ],
)
def test_what_no_statement_can_be_is_refused(words, make):
    refused(words, make)


def test_units_over_time():
    units = ("1", "m", "N/m", "W/(m.K)")
    assert [times_seconds(u) for u in units] == ["s", "m.s", "N.s/m", "W.s/(m.K)"]
    assert [times_seconds(u, -1) for u in units] == ["1/s", "m/s", "N/(m.s)", "W/(m.K.s)"]


def test_what_running_costs_say_of_themselves():
    flags = ("from_supply", "slower_is_less", "economical")
    said = {flag: {name for name in COSTS if getattr(COSTS[name], flag)} for flag in flags}
    assert [said[flag] for flag in flags] == [
        {"air", "exergy"}, {"effort"}, {"air", "exergy", "work"}
    ]  # fmt: skip
    assert COSTS["work"].title == (
        "Mechanical work of the muscles, each counted where its power is positive"
    )
    assert [unit_of_sum(CART, n) for n in ("air", "integral(v)", "square(v)")] == [
        "kg", "m.s/s", "s"
    ]  # fmt: skip
    jumping = Statement(STOPS), Statement(STOPS, jumps=False), Statement(STOPS, minimise="rate")
    assert [s.inputs_jump for s in jumping] == [True, False, False]


# ---- the verdict of a plan -----------------------------------------------------------------------
def test_where_an_ordinary_integration_parts_from_a_tight_one_nothing_is_verified():
    """Lorenz's equations: errors grow by exp(0.906) each second (J. C. Sprott, Chaos and
    Time-Series Analysis, 2003), so 1e-7 is 1e-3 behind 10 s and all of the motion behind 20 s.
    """
    plant = pam.Plant("lorenz")
    x, y, z = (plant.state(n, nominal=10.0) for n in "xyz")
    plant.der(x, 10 * (y - x) + plant.input("u"))
    plant.der(y, x * (28 - z) - y)
    plant.der(z, x * y - 8 / 3 * z)
    start = np.array([1.0, 1.0, 20.0])
    for duration, kept in ((2.0, True), (25.0, False)):
        inputs = PiecewisePolynomial(np.array([0.0, duration]), np.zeros((1, 1, 1)))
        claimed = pam.simulate(
            plant,
            t=np.linspace(0, duration, 50),
            start=dict(zip("xyz", start, strict=True)),
            rtol=1e-11,
        )
        said = Statement([{"x": 1.0}, {"x": (None, None)}], duration=duration)
        motion = pam.judge.Motion(start, inputs, (duration,))
        judged = pam.judge.judge(plant, said, motion, claimed)
        assert (judged.apart < 1e-3) == kept
        verdict = pam.planning.Verdict("", True, 0.0, "x", 0.0, "", 1e-3, apart=judged.apart)
        assert verdict.verified == kept
        assert ("run it with feedback" in str(verdict)) != kept


GOOD = pam.planning.Verdict("Solve_Succeeded", True, 1e-4, "x", 2e-4, "force", 1e-3)


def test_a_verdict_names_each_figure_that_failed():
    assert "violates force by 0.02" in str(replace(GOOD, violation=0.02))
    failed = str(replace(GOOD, solved=False, status="Restoration_Failed"))
    assert "did not converge (Restoration_Failed)" in failed
    stopped = str(replace(GOOD, ended="interrupted"))
    assert stopped == "not verified: interrupted before the search was done"


@pytest.mark.parametrize(
    ("words", "verified", "unstable"),
    [
        ({}, True, False),
        ({"error": np.nan}, False, False),
        ({"violation": np.nan}, False, False),
        ({"error": np.inf}, False, False),
        ({"ended": "interrupted"}, False, False),
        ({"error": 1.0, "local": 1e-4}, False, True),  # grown ten thousand times
        ({"error": 1.0, "local": 1e-4, "apart": 1.0}, False, True),
        ({"error": 1.0, "local": 1e-4, "solved": False}, False, False),
        ({"error": 0.05, "local": 1e-4}, False, False),
        ({"error": 10.0, "local": 2e-3}, False, False),  # the mesh is too coarse besides
        ({"error": 1.0, "local": 0.0}, False, False),
        ({"error": 1.0}, False, False),
        ({"apart": 2e-3}, False, False),
        ({"apart": 5e-3, "tolerance": 1e-2}, True, False),
        ({"apart": 5e-4, "tolerance": 2e-4}, True, False),
    ],
)
def test_a_verdict_by_its_figures(words, verified, unstable):
    verdict = replace(GOOD, **words)
    assert (verdict.verified, bool(verdict), verdict.unstable) == (verified, verified, unstable)
    assert ("errors grow" in str(verdict)) == unstable
    assert ("control.tvlqr" in str(verdict)) == (unstable or words == {"apart": 2e-3})
