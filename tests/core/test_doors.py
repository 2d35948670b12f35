"""At the doors: sloppy calls work or are answered in a sentence, odd values warn, usual ones never
do.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

import absurd
import casadi as ca
import numpy as np
import pytest
from conftest import BAR, flat, refused

import pam_ocp as pam
from pam_ocp.core.quantities import meant

MUSCLE = pam.muscle("DMSP-20-400N")
MOTION = pam.simulate(pam.HangingLoad(MUSCLE), {"muscle.command": 3 * BAR}, duration=0.3)
REFUSALS = {"InputError", "UnknownNameError", "EquilibriumError", "WriteError"}


@pytest.mark.parametrize("call", absurd.CALLS)
def test_a_sloppy_call_works_or_is_answered_in_one_sentence(call: str) -> None:
    expected = absurd.CALLS[call]
    kind, said = absurd.answer(call)
    if expected == "works":
        assert (kind, said) == ("works", "")
    elif expected.startswith(absurd.WARNS):
        assert kind == "warns", (kind, said)
        assert expected.removeprefix(absurd.WARNS) in said
    else:
        assert kind in REFUSALS or "() has no argument " in said, (kind, said)
        assert expected in said
        assert len(said) < 500
        assert "NoneType" not in said
        assert "object is" not in said


INNER = {"attach", "as_feed", "as_loads", "applied", "AttachedMuscle", "Coordinate", "SlipElements"}
"""Of who writes components, not of who uses them."""
INNER |= {"muscle_names", "valve_names", "RealClock", "ForceLaw"}
"""Without arguments, or abstract."""


def public() -> dict[str, Callable[..., Any]]:
    """All that the face and its rooms have to be called, but errors and protocols."""
    rooms = [pam, *(m for n in pam.__all__ if isinstance(m := getattr(pam, n), ModuleType))]
    found = {n: getattr(room, n) for room in rooms for n in room.__all__ if n not in INNER}
    kinds = {n: f for n, f in found.items() if callable(f) and not getattr(f, "_is_protocol", 0)}
    return {
        n: f for n, f in kinds.items() if not (isinstance(f, type) and issubclass(f, Exception))
    }


def test_every_public_name_tells_an_argument_that_it_has_not() -> None:
    told = {}
    for name, made in public().items():
        known = inspect.signature(made).parameters.values()
        if not any(p.kind is p.VAR_KEYWORD for p in known):
            with pytest.raises(TypeError) as caught:
                made(nonsense_=1)
            told[name] = str(caught.value)
    assert len(told) > 150
    assert {n: s for n, s in told.items() if "() has no argument 'nonsense_'" not in s} == {}


# ---- units ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "unit", "probable"),
    [
        (3.0, "Pa", "3 bar"),
        (40.0, "Pa", "40 psi"),
        (600.0, "Pa", "600 kPa"),
        (0.5, "Pa", "0.5 MPa"),
        (-3.0, "Pa", "-3 bar"),
        (20.0, "m", "20 mm"),
        (8000.0, "kg", "8000 g"),
        (30.0, "rad", "30 deg"),
        (20.0, "K", "20 degC"),
        (500.0, "m/s", "500 mm/s"),
        (7.0, "m3", "7 cm3"),
    ],
)
def test_of_several_units_the_one_is_named_that_makes_the_value_usual(
    value: float, unit: str, probable: str
) -> None:
    assert (meant(value, unit) or "").startswith(probable + " = ")


def test_what_is_small_but_sane_or_was_computed_is_not_doubted() -> None:
    for value, unit in (
        (0.0, "Pa"),
        (1e3, "Pa"),
        (-2e4, "Pa"),
        (1e6, "Pa"),
        (1e-4, "m"),
        (2.5, "m"),
        (1e-3, "kg"),
        (300.0, "kg"),
        (0.137, "rad"),
        (293.15, "K"),
        (math.inf, "Pa"),
        (0.1370012345, "Pa"),
        (12.3456789, "Pa"),
        (1e9, "N"),
        (1e-12, "1"),
    ):
        assert meant(value, unit) is None, (value, unit)


def test_no_muscle_of_the_catalogue_and_no_arrangement_is_doubted() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", pam.UnitWarning)
        for name in pam.muscles.muscle_names():
            pam.HangingLoad(pam.muscle(name, rest_length=0.25))
        for feed in (
            pam.feeds.Regulator(),
            pam.feeds.IdealPressure(),
            pam.feeds.OnOffValves(tube=pam.feeds.Tube()),
        ):
            pam.AntagonisticJoint(MUSCLE, limits=(-0.2, 0.3), feed=feed, losses=pam.losses.Creep())
            pam.SeriesLoad(
                MUSCLE, loads=(pam.loads.Wall(0.05), pam.loads.DryFriction(3.0)), feed=feed
            )


def test_the_warning_points_at_the_line_of_the_caller() -> None:
    with pytest.warns(pam.UnitWarning) as caught:
        pam.HangingLoad(MUSCLE, feed=pam.feeds.Regulator(50))
    assert caught[0].filename == __file__


def test_a_text_with_its_unit_is_the_number_in_si() -> None:
    plant = pam.HangingLoad(MUSCLE, "5000 g", damping="0.02 N.s/mm")
    assert plant.variable("mass").start == 5.0
    assert plant.variable("damping").start == pytest.approx(20.0)
    assert plant.with_values({"muscle.pressure": "3 bar"}).variable("muscle.pressure").start == 3e5


def test_axes_steps_and_tolerances_take_texts_with_units_too() -> None:
    plant, rest = pam.HangingLoad(MUSCLE, 5.0), {"muscle.command": "3 bar"}
    branch = pam.operating.equilibrium_branch(plant, "mass", "5000 g", "6 kg", rest)
    assert branch.values[[0, -1]] == pytest.approx([5.0, 6.0])
    path = pam.operating.equilibrium_path(plant, "mass", ["5000 g", "6 kg"], rest)
    assert path.values.tolist() == [5.0, 6.0]
    assert pam.vibration.stability_path(plant, "mass", ["5000 g", "6 kg"], rest).values[0] == 5.0
    grid = pam.operating.linearize_grid(plant, {"x": ["20 mm", "3 cm"]})
    assert grid.axes["x"].tolist() == [0.02, 0.03]
    modes = pam.control.mode_map(plant, {"mass": ["5 kg"], "x": ["20 mm"]})
    assert modes.axes["x"].tolist() == [0.02]
    black_box = pam.fitting.ArxStructure(
        ["x"], ["muscle.command"], 2, ["500 ms"], "20 ms", first="0.1 s"
    )
    assert (*black_box.horizon, black_box.every, black_box.first) == (0.5, 0.02, 0.1)
    stops = [{"x": "10 mm"}, pam.Stop({"x": "30 mm"}, within="0.001")]
    assert pam.plan(plant, stops, tolerance="1e-3").verified


# ---- loads with inertia
# ---------------------------------------------------------------------------


class Disc:
    """A load of one's own: a force and an inertia, as a method."""

    def __init__(self, inertia: float) -> None:
        self.value = inertia

    def force(self, plant: pam.Plant, at: object) -> ca.SX:
        return ca.SX(-7.0)

    def inertia(self, plant: pam.Plant, at: object) -> ca.SX:
        return plant.parameter("disc", self.value, unit="kg.m2" if at.rotary else "kg")


class Block(Disc):
    """The same with a number."""

    def __init__(self, inertia: float) -> None:
        self.inertia = inertia


ARRANGEMENTS = {
    "hanging": lambda loads: pam.HangingLoad(MUSCLE, 20.0, damping=0.0, loads=loads),
    "slide": lambda loads: pam.AntagonisticSlide(MUSCLE, 2.0, damping=0.0, loads=loads),
    "joint": lambda loads: pam.AntagonisticJoint(MUSCLE, 0.05, damping=0.0, loads=loads),
    "spring": lambda loads: pam.SpringOverMuscle(MUSCLE, 2.0, damping=0.0, loads=loads),
    "series": lambda loads: pam.SeriesLoad(MUSCLE, 20.0, damping=0.0, loads=loads),
}
EFFORT = {
    "hanging": lambda y, x: y["muscle.force"] - 20.0 * 9.80665,
    "slide": lambda y, x: y["muscle1.force"] - y["muscle2.force"],
    "joint": lambda y, x: 0.04 * (y["muscle1.force"] - y["muscle2.force"]),
    "spring": lambda y, x: y["muscle.force"] - 100.0 - 5e3 * x,
    "series": lambda y, x: y["tendon_force"] - 20.0 * 9.80665,
}


@pytest.mark.parametrize("load", [Disc, Block])
@pytest.mark.parametrize("kind", ARRANGEMENTS)
def test_the_inertia_of_a_load_of_ones_own_moves_along(kind: str, load: type) -> None:
    """(m + own) x'' = effort of the muscles - weight - 7, written by hand."""
    plant = ARRANGEMENTS[kind]((load(0.75), pam.loads.Inertia(0.5)))
    own = {"hanging": 20.0, "slide": 2.0, "joint": 0.05, "spring": 2.0, "series": 20.0}[kind]
    x = plant.vector("state")
    x[0] = 0.004
    names = [v.name for v in plant.states]
    if kind == "series":
        x[names.index("muscle.shortening")] = 0.007
    xdot, y, _ = plant.function(x, plant.vector("input"), plant.vector("parameter"))
    outputs = dict(zip([v.name for v in plant.outputs], flat(y), strict=True))
    expected = (EFFORT[kind](outputs, x[0]) - 7.0) / (own + 0.75 + 0.5)
    assert flat(xdot)[1] == pytest.approx(expected, rel=1e-12)


def test_a_negative_or_impossible_inertia_is_refused() -> None:
    for wrong, message in (
        (-1.0, "must be >= 0"),
        ("heavy", "give a number"),
        (math.nan, "finite"),
    ):
        refused(message, pam.HangingLoad, MUSCLE, loads=Block(wrong))


# ---- starts, loops, studies
# -----------------------------------------------------------------------


def test_started_at_an_operating_point_a_plant_stays_there() -> None:
    plant = pam.HangingLoad(MUSCLE, 20.0)
    point = plant.equilibrium(x=0.05)
    found = pam.simulate(plant, duration=0.5, start=point)
    assert found["x"] == pytest.approx(0.05, abs=1e-9)
    other = pam.simulate(plant, {"muscle.command": 4 * BAR}, duration=0.5, start=point)
    assert other["x"][0] == point["x"]
    assert other["x"][-1] > 0.06


def test_from_its_start_values_a_slack_muscle_is_simulated_without_a_word(capfd) -> None:
    """Thrown up, the muscle is slack, and trial steps end far below: nothing overflows there."""
    for mass in (5.0, 1.0, 0.2):
        motion = pam.simulate(pam.HangingLoad("DMSP-20-300", mass=mass), duration=1.0)
        assert motion["muscle.force"].min() == 0.0
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def test_a_loop_that_cannot_be_integrated_blames_the_controller_only_where_it_must() -> None:
    plant = pam.Plant("root")
    x = plant.state("x", unit="m", start=1.0)
    u = plant.input("u")
    plant.der(x, -ca.sqrt(x) - 1 + 0 * u)  # ends at x = 0 by itself
    with pytest.raises(pam.SimulationError) as caught:
        pam.closed_loop(lambda t, y: {"u": 0.0}, plant, duration=5.0, sample_time=0.1)
    assert "unstable" not in str(caught.value)
    assert "Cause: " in str(caught.value)
    assert caught.value.__cause__ is not None or "not finite" in str(caught.value)
    runaway = pam.Plant("runaway")
    x = runaway.state("x", unit="m", start=0.1, nominal=0.1)
    runaway.der(x, 40 * x + runaway.input("u"))
    with pytest.raises(pam.SimulationError, match="the closed loop is unstable"):
        pam.closed_loop(lambda t, y: {"u": 10 * y["x"]}, runaway, duration=50.0, sample_time=0.1)


FEEDS = {
    "ideal": pam.feeds.IdealPressure(),
    "regulator": pam.feeds.Regulator(0.02),
    "spool": pam.feeds.SpoolValve(),
    "on-off": pam.feeds.OnOffValves(),
    "tube": pam.feeds.SpoolValve(tube=pam.feeds.Tube()),
}


@pytest.mark.parametrize("feed", FEEDS)
def test_a_load_study_takes_every_feed_and_rests_where_force_is_weight(feed: str) -> None:
    case = pam.load_study(MUSCLE, 20.0, 3 * BAR, feed=FEEDS[feed], duration=1.0).cases[0]
    force = MUSCLE.force(3 * BAR, case.position / MUSCLE.rest_length)
    assert force == pytest.approx(20.0 * 9.80665, rel=1e-6)
    k = MUSCLE.stiffness(3 * BAR, case.position / MUSCLE.rest_length)
    if feed in ("spool", "on-off"):  # closed valves: the gas is a spring, too
        k = pam.gas.closed_stiffness(MUSCLE, 3 * BAR, case.position / MUSCLE.rest_length)
        assert math.isnan(case.overshoot)
    elif feed != "tube":
        assert case.overshoot > 0.5
    if feed != "tube":
        assert case.frequency == pytest.approx(math.sqrt(k / 20.0) / 2 / math.pi, rel=2e-2)
    assert case.work > 0


# ---- work of every muscle
# -------------------------------------------------------------------------


@pytest.mark.parametrize("feed", FEEDS)
def test_power_is_force_times_speed_of_shortening_with_every_feed(feed: str) -> None:
    plant = pam.AntagonisticJoint(MUSCLE, moment_arm=0.03, moment_arm2=0.05, feed=FEEDS[feed])
    x = plant.vector("state", {"theta": 0.1, "omega": 1.7})
    y = flat(plant.function(x, plant.vector("input"), plant.vector("parameter"))[1])
    found = dict(zip([v.name for v in plant.outputs], y, strict=True))
    for name, speed in (("muscle1", 0.03 * 1.7), ("muscle2", -0.05 * 1.7)):
        assert found[f"{name}.power"] == pytest.approx(found[f"{name}.force"] * speed, rel=1e-12)
    assert next(v for v in plant.outputs if v.name == "muscle1.power").unit == "W"


def test_the_work_of_a_stroke_is_what_the_load_gained() -> None:
    """Without losses: m g dx + m v^2/2, by the power, and by the totals to the integrator's
    accuracy.
    """
    for totals, accuracy in ((False, 1e-4), (True, 1e-8)):
        plant = pam.HangingLoad(MUSCLE, 20.0, damping=0.0, feed=pam.feeds.Regulator(totals=totals))
        start = {"x": 0.03, "muscle.pressure": 2 * BAR}
        motion = pam.simulate(plant, {"muscle.command": 4 * BAR}, duration=0.31, start=start)
        found = pam.simulation.stroke_work(motion)["muscle"]
        gained = 20.0 * (9.80665 * (motion["x"][-1] - 0.03) + motion["v"][-1] ** 2 / 2)
        assert found.work == pytest.approx(gained, rel=accuracy)
        assert found.delivered - found.absorbed == pytest.approx(gained, rel=1e-3)
        assert found.peak_power == pytest.approx(motion["muscle.power"].max(), rel=1e-3)
        halves = [
            pam.simulation.stroke_work(motion, *part)["muscle"].work
            for part in ((0, 0.1), (0.1, 0.31))
        ]
        assert sum(halves) == pytest.approx(found.work, rel=2e-3)


@pytest.mark.parametrize("losses", [(), pam.losses.CoulombFriction(40.0)])
def test_over_a_cycle_the_muscle_gives_what_the_gas_gave_less_its_friction(losses) -> None:
    """The passive part of the law takes and gives back: W = p dV - friction dx (dV/dl = -dF/dp)."""
    plant = pam.HangingLoad(MUSCLE, 20.0, losses=losses, feed=pam.feeds.IdealPressure(totals=True))
    swing = lambda t: (3 + np.sin(2 * np.pi * t)) * BAR  # noqa: E731
    motion = pam.simulate(plant, {"muscle.pressure": swing}, t=np.linspace(0, 12, 4801))
    last = motion.t >= 11.0
    lost = 0.0
    if losses:
        power = motion["muscle.loss"] * motion["v"]
        lost = float(np.sum((power[1:] + power[:-1])[last[1:] & last[:-1]]) / 2 * 0.0025)
        assert lost > 1.0
    put_in = np.ptp(motion["muscle.pneumatic_work"][[np.argmax(last), -1]])
    share = pam.simulation.stroke_work(motion, 11.0, 12.0)["muscle"].efficiency
    assert share == pytest.approx(1 - lost / put_in, abs=1e-5)


def test_per_mass_and_efficiency_come_with_every_feed() -> None:
    heavy = pam.Muscle(MUSCLE.law, MUSCLE.rest_length, MUSCLE.diameter, mass=0.5)
    for feed in (pam.feeds.Regulator(totals=True), pam.feeds.SpoolValve(totals=True)):
        plant = pam.HangingLoad(heavy, 20.0, feed=feed)
        names = {v.name for v in plant.outputs}
        assert {"muscle.power_per_mass", "muscle.work_per_mass", "muscle.efficiency"} <= names
    motion = pam.simulate(pam.HangingLoad(heavy, 20.0), {"muscle.command": 4 * BAR}, duration=0.3)
    found = pam.simulation.stroke_work(motion)["muscle"]
    assert found.work_per_mass == pytest.approx(found.work / 0.5, rel=1e-12)


# ---- one bad input each --------------------------------------------------------------------------
LOAD, FREE = pam.HangingLoad(MUSCLE), {"horizon": 0.2, "outputs": ["x"]}
FLAG = "give True, False or None"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pam.fitting.fit_branches(3), "table is an int"),
        (lambda: pam.compare_laws(None), "table is None"),
        (lambda: pam.read_records([]), "sources is empty"),
        (lambda: pam.Variable("a", "foo"), "causality = 'foo'"),
        (lambda: pam.losses.MaxwellSlip((1.0, 2.0), 0.01), "2 of friction and 1 of yield"),
        (lambda: pam.closed_loop(len, LOAD, duration=0.1, rtol=1e-30), "rtol = 1e-30 must lie in"),
        (lambda: pam.control.kalman(LOAD, {"x": 0.02}, measured={}), "measured is empty"),
        (lambda: pam.each(3, [1.0]), "work = 3 cannot be called"),
        (lambda: pam.each(abs, 5), "cases is an int: give a list of cases"),
        (lambda: pam.simulate(LOAD, duration=0.1, compiled="yes"), f"compiled = 'yes': {FLAG}"),
        (
            lambda: pam.KalmanFilter(LOAD, sample_time=0.01, measured={"x": 1e-4}, compiled=1),
            f"compiled = 1: {FLAG}",
        ),
        (
            lambda: pam.plan(LOAD, [{"x": 0.01}, {"x": 0.02}], compiled=None),
            "None: give True or False",
        ),
        (lambda: pam.simulate(LOAD, duration=0.1, events=5), "events = 5: give a name in quotes"),
        (lambda: pam.export_fmu(LOAD, "m.fmu", platforms=[64]), r"platforms = \[64\]: give a name"),
        (
            lambda: pam.fit_free_run(LOAD, MOTION, ["mass"], **FREE, disturbance=5),
            "disturbance = 5: give a name in quotes",
        ),
    ],
)
def test_what_no_verb_can_use_is_answered_by_one_sentence(call, words):
    with pytest.raises(pam.InputError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
