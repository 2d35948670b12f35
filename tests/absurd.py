"""Sloppy, wrong and absurd calls, each with what it is answered: ``python tests/absurd.py`` prints
them.

A call works (WORKS), warns with the unit that was probably meant (its fragment stands behind
WARNS), or is refused in one sentence that holds a fragment.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

import pam_ocp as pam

WORKS, WARNS = "works", "warns: "
NAME = "DMSP-20-300"
TABLE = "DMSP-20-300_static.csv"
Call = Callable[[], Any]
SAID = {
    "Pa": "3 bar",
    "N": "300 N",
    "1": "10 %",
    "m3": "100 cm3",
    "m3/(s.Pa)": "2e-8 m3/(s.Pa)",
}
"""A quantity of each unit as a text."""


@cache
def muscle() -> pam.Muscle:
    return pam.muscle(NAME)


@cache
def plant() -> pam.Plant:
    return pam.HangingLoad(muscle(), 20.0)


@cache
def slide() -> pam.Plant:
    return pam.AntagonisticSlide(muscle())


@cache
def rest() -> pam.operating.OperatingPoint:
    return plant().equilibrium(x=0.03)


@cache
def motion() -> pam.Trajectory:
    return pam.simulate(plant(), duration=0.02)


def own(change: Callable[[Any, Any], Any]) -> pam.Plant:
    """A mass whose acceleration is what ``change`` makes of its position and velocity."""
    built = pam.Plant("own")
    x, v = built.state("x", unit="m"), built.state("v", unit="m/s")
    built.der(x, v)
    built.der(v, change(x, v))
    return built


def run(**options: Any) -> pam.Trajectory:
    return pam.simulate(plant(), **{"duration": 0.02, **options})


def looped(answer: Any, **options: Any) -> pam.Trajectory:
    controller = answer if callable(answer) else lambda t, y: answer
    return pam.closed_loop(
        controller, plant(), **{"duration": 0.01, "sample_time": 5e-3, **options}
    )


def posed(**options: Any) -> pam.Planner:
    return pam.Planner(slide(), **{"stops": [{"x": -0.01}, {"x": 0.01}], **options})


@cache
def feedback() -> Any:
    return pam.lqr(plant(), rest())


@cache
def cells() -> pam.fitting.ForceTable:
    return pam.read_table(TABLE, rest_length=0.3)


@cache
def fitted() -> Any:
    return pam.fit_force(cells(), "three-element")


def follower(reference: Any, pid: Any) -> Any:
    return pam.control.PositionController(slide(), reference, pid, sample_time=0.01)


def own_law(formula: Any) -> Any:
    return pam.laws.own_law("mine", formula, {"a": pam.laws.coefficient("N/Pa", 1e-3, "gain")})


class Flywheel:
    """A load of one's own whose inertia is a number."""

    inertia = 0.5

    def force(self, plant: pam.Plant, at: Any) -> Any:
        return ca.SX(0)


CALLS: dict[str, tuple[Call, str]] = {
    # ---- nouns: names, single components, numbers, classes --------------------------------------
    "HangingLoad('DMSP-20-300')": (lambda: pam.HangingLoad(NAME), WORKS),
    "HangingLoad('DMSP-20-30')": (lambda: pam.HangingLoad("DMSP-20-30"), "did you mean"),
    "relaxed=-1": (
        lambda: pam.Variable("a", "parameter", relaxed=-1.0),
        "a: relaxed = -1: give a finite number > 0, of a parameter",
    ),
    "relaxed of a state": (
        lambda: pam.Variable("a", "state", relaxed=2.0),
        "a: relaxed = 2: give a finite number > 0, of a parameter",
    ),
    "PID(plant, 'x')": (
        lambda: pam.control.PID(plant(), "x"),  # type: ignore[arg-type]
        "is not a number",
    ),
    "a function without the time": (
        lambda: run(inputs={"muscle.command": lambda: 3e5}),
        "the function has to take one argument, the time [s]",
    ),
    "bounds of three numbers": (
        lambda: posed(bounds={"v": (1, 2, 3)}),
        "(1, 2, 3): give a number, or (low, high)",
    ),
    "bounds of a phase = 3": (
        lambda: posed(phases=[pam.Phase(bounds=3)]),  # type: ignore[arg-type]
        "phases[0].bounds = 3: give {name: (low, high)}",
    ),
    "options={'max_itr': 3}": (
        lambda: posed(options={"max_itr": 3})(),
        "No such IPOPT option: max_itr; see IPOPT's list",
    ),
    "unit='furlong'": (
        lambda: pam.Variable("x", "state", unit="furlong"),
        "unknown unit 'furlong': known: 1, %, kg",
    ),
    "mode_map(plant, 'zz')": (
        lambda: pam.control.mode_map(plant(), "zz"),  # type: ignore[arg-type]
        "axes = 'zz': give a mapping {text: numbers}",
    ),
    "HangingLoad(None)": (lambda: pam.HangingLoad(None), "muscle is None: give a Muscle"),
    "HangingLoad([muscle])": (lambda: pam.HangingLoad([muscle()]), "give a Muscle"),
    "HangingLoad(law)": (lambda: pam.HangingLoad(muscle().law), "give a Muscle"),
    "HangingLoad(mass, muscle)": (lambda: pam.HangingLoad(20.0, muscle()), "muscle is 20.0"),
    "slide of two names": (lambda: pam.AntagonisticSlide(NAME, muscle2="DMSP-10-250"), WORKS),
    "joint of a name": (lambda: pam.AntagonisticJoint(NAME), WORKS),
    "spring over a name": (lambda: pam.SpringOverMuscle(NAME), WORKS),
    "tendon on a name": (lambda: pam.SeriesLoad(NAME), WORKS),
    "regulated load of a name": (lambda: pam.RegulatedLoad(NAME), WORKS),
    "muscle2=3": (lambda: pam.AntagonisticSlide(muscle(), muscle2=3), "muscle2 is 3"),
    "damping=20.0": (lambda: pam.HangingLoad(NAME, damping=20.0), WORKS),
    "damping=numpy scalar": (lambda: pam.HangingLoad(NAME, damping=np.float64(20)), WORKS),
    "damping='20 N.s/m'": (lambda: pam.HangingLoad(NAME, damping="20 N.s/m"), WORKS),
    "damping=-1": (lambda: pam.HangingLoad(NAME, damping=-1), "must be >= 0"),
    "damping=the class": (
        lambda: pam.HangingLoad(NAME, damping=pam.losses.ConstantDamping),
        "ConstantDamping(...)",
    ),
    "damping=Spring": (
        lambda: pam.HangingLoad(NAME, damping=pam.loads.Spring(1e3)),
        "give components",
    ),
    "loads=Spring(...)": (lambda: pam.HangingLoad(NAME, loads=pam.loads.Spring(1e3)), WORKS),
    "loads=[Spring(...)]": (lambda: pam.HangingLoad(NAME, loads=[pam.loads.Spring(1e3)]), WORKS),
    "loads=None": (lambda: pam.HangingLoad(NAME, loads=None), WORKS),
    "loads=Spring": (lambda: pam.HangingLoad(NAME, loads=pam.loads.Spring), "Spring(...)"),
    "loads='spring'": (lambda: pam.HangingLoad(NAME, loads="spring"), "give components"),
    "loads=(5.0,)": (lambda: pam.AntagonisticSlide(NAME, loads=(5.0,)), "give components"),
    "loads=own with inertia": (lambda: pam.AntagonisticSlide(NAME, loads=Flywheel()), WORKS),
    "losses=BoucWen()": (lambda: pam.HangingLoad(NAME, losses=pam.losses.BoucWen()), WORKS),
    "losses=BoucWen": (lambda: pam.HangingLoad(NAME, losses=pam.losses.BoucWen), "BoucWen(...)"),
    "feed=Regulator": (lambda: pam.HangingLoad(NAME, feed=pam.feeds.Regulator), "Regulator(...)"),
    "feed='regulator'": (lambda: pam.HangingLoad(NAME, feed="regulator"), "give components"),
    "feed=0.05": (lambda: pam.HangingLoad(NAME, feed=0.05), "give components"),
    "limits=0.5": (lambda: pam.AntagonisticJoint(NAME, limits=0.5), "give (low, high)"),
    "limits=('a', 'b')": (lambda: pam.AntagonisticJoint(NAME, limits=("a", "b")), "limits"),
    "Plant('two words')": (lambda: pam.Plant("two words"), "use letters"),
    # ---- numbers ---------------------------------------------------------------------------------
    "mass='5 kg'": (lambda: pam.HangingLoad(NAME, "5 kg"), WORKS),
    "mass='5 mm'": (lambda: pam.HangingLoad(NAME, "5 mm"), "measures something else"),
    "mass='five'": (lambda: pam.HangingLoad(NAME, "five"), "give a number with its unit"),
    "mass=None": (lambda: pam.HangingLoad(NAME, None), "is not a number"),
    "mass=nan": (lambda: pam.HangingLoad(NAME, math.nan), "must be a finite number"),
    "mass=inf": (lambda: pam.HangingLoad(NAME, math.inf), "must be a finite number"),
    "mass=-5": (lambda: pam.HangingLoad(NAME, -5), "must be > 0"),
    "mass=1j": (lambda: pam.HangingLoad(NAME, 1j), "is not a number"),
    "mass=[5]": (lambda: pam.HangingLoad(NAME, [5]), "is not a number"),
    "mass=True": (lambda: pam.HangingLoad(NAME, True), "must be a finite number"),
    "mass=0-d array": (lambda: pam.HangingLoad(NAME, np.array(5.0)), WORKS),
    "mass=numpy integer": (lambda: pam.HangingLoad(NAME, np.int64(5)), WORKS),
    "mass=symbol": (lambda: pam.HangingLoad(NAME, ca.SX.sym("m")), "must be a finite number"),
    "with_values(mass='2 kg')": (lambda: plant().with_values(mass="2 kg"), WORKS),
    "with_values(mass=[1, 2])": (lambda: plant().with_values(mass=[1, 2]), "is not a number"),
    "with_values(3)": (lambda: plant().with_values(3), "give values by name"),
    "with_values(masse=2)": (lambda: plant().with_values(masse=2), "did you mean"),
    "with_values(an output)": (
        lambda: plant().with_values({"muscle.force": 1}),
        "follows from the others",
    ),
    "pre_contraction=10 for 10 %": (
        lambda: pam.AntagonisticSlide(NAME, pre_contraction=10),
        "did you mean 10 %",
    ),
    "pre_contraction='10 %'": (
        lambda: pam.AntagonisticSlide(NAME, pre_contraction="10 %"),
        "measures something",
    ),
    "Regulator(max_pressure='6 bar')": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.Regulator(max_pressure="6 bar")),
        WORKS,
    ),
    "Regulator(lag='50 ms')": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.Regulator("50 ms")),
        WORKS,
    ),
    "Regulator(lag=0)": (lambda: pam.feeds.Regulator(0), "must be > 0"),
    # ---- units -----------------------------------------------------------------------------------
    "max_pressure=6 for bar": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.Regulator(max_pressure=6)),
        WARNS + "6 bar",
    ),
    "IdealPressure(0.6) for MPa": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.IdealPressure(0.6)),
        WARNS + "0.6 MPa",
    ),
    "max_rate=40 for bar/s": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.Regulator(max_rate=40)),
        WARNS + "40 bar/s",
    ),
    "lag=50 for ms": (lambda: pam.HangingLoad(NAME, feed=pam.feeds.Regulator(50)), WARNS + "50 ms"),
    "mass=5000 for g": (lambda: pam.HangingLoad(NAME, 5000), WARNS + "5000 g"),
    "stroke=15 for mm": (lambda: pam.AntagonisticSlide(NAME, stroke=15), "did you mean 15 mm"),
    "moment_arm=40 for mm": (lambda: pam.AntagonisticJoint(NAME, moment_arm=40), WARNS + "40 mm"),
    "limits=(-10, 10) for deg": (
        lambda: pam.AntagonisticJoint(NAME, limits=(-10, 10)),
        "did you mean 10 deg",
    ),
    "inclination=30 for deg": (
        lambda: pam.HangingLoad(NAME, inclination=30),
        "did you mean 30 deg",
    ),
    "rest_length=300 for mm": (lambda: pam.Muscle(muscle().law, 300), WARNS + "300 mm"),
    "diameter=20 for mm": (lambda: pam.Muscle(muscle().law, 0.3, diameter=20), WARNS + "20 mm"),
    "pressure_range=(0, 6) for bar": (
        lambda: pam.Muscle(muscle().law, 0.3, pressure_range=(0, 6)),
        WARNS + "6 bar",
    ),
    "Gas(temperature=20) for degC": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(gas=pam.gas.Gas(temperature=20))),
        WARNS + "20 degC",
    ),
    "supply=6 for bar": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(supply=6)),
        WARNS + "6 bar",
    ),
    "conductance=700 l/min": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(conductance=700)),
        WARNS + "conductance_from_flow",
    ),
    "Tube(volume=10) for ml": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(tube=pam.feeds.Tube(volume=10))),
        WARNS + "10 cm3",
    ),
    "start pressure 3 for bar": (
        lambda: plant().with_values({"muscle.pressure": 3.0}),
        WARNS + "3 bar",
    ),
    "start pressure 1e3 Pa": (lambda: plant().with_values({"muscle.pressure": 1e3}), WORKS),
    "start pressure 0": (lambda: plant().with_values({"muscle.pressure": 0}), WORKS),
    "x=0.1 mm": (lambda: plant().with_values(x=1e-4), WORKS),
    # ---- what muscles and gases answer -----------------------------------------------------------
    **{
        f"{name}({label})": (lambda call=call, value=value: call(value), expected)
        for name, unit, call in (
            ("force of p", "Pa", lambda p: muscle().force(p, 0.1)),
            ("stiffness of p", "Pa", lambda p: muscle().stiffness(p, 0.1)),
            ("tension of p", "Pa", lambda p: muscle().tension(p, 0.1)),
            ("blocked_force of p", "Pa", lambda p: muscle().blocked_force(p)),
            ("max_contraction of p", "Pa", lambda p: muscle().max_contraction(p)),
            ("dtension_dkappa of p", "Pa", lambda p: muscle().law.dtension_dkappa(p, 0.1)),
            ("closed_stiffness of p", "Pa", lambda p: pam.gas.closed_stiffness(muscle(), p, 0.1)),
            ("air_mass of p", "Pa", lambda p: pam.gas.air_mass(p, 1e-4)),
            ("iso6358 of p", "Pa", lambda p: pam.gas.iso6358(p, 1e5, 2e-8)),
            ("specific_exergy of p", "Pa", lambda p: pam.gas.specific_exergy(p, 1e5, 293.15)),
            ("pressure of F", "N", lambda f: muscle().pressure(f, 0.1)),
            ("force of kappa", "1", lambda k: muscle().force(3e5, k)),
            ("pressure of kappa", "1", lambda k: muscle().pressure(300.0, k)),
            ("gain_area of kappa", "1", lambda k: muscle().law.gain_area(k)),
            ("muscle_volume of kappa", "1", lambda k: pam.gas.muscle_volume(muscle(), k)),
            ("air_mass of V", "m3", lambda v: pam.gas.air_mass(4e5, v)),
            ("iso6358 of C", "m3/(s.Pa)", lambda c: pam.gas.iso6358(6e5, 1e5, c)),
        )
        for label, value, expected in (
            ("a text", SAID[unit], WORKS),
            ("a list of texts", [SAID[unit], SAID[unit]], WORKS),
            ("another unit", "3 lumen", "unknown unit"),
            ("another quantity", "3 kg", "measures something else"),
            ("a word", "high", "is not a number"),
            ("nan", math.nan, "finite"),
            ("inf", math.inf, "finite"),
            ("an array with nan", np.array([0.1, math.nan]), "sample 1 is nan"),
            ("10**400", 10**400, "larger than any float"),
            ("a list with 10**400", [0.1, 10**400], "larger than any float"),
            ("None", None, "is not a number"),
            ("an object", object(), "is not a number"),
            ("a complex number", 1j, "is not a number"),
            ("complex numbers", np.array([1j]), "numbers only"),
            ("ragged rows", [[1.0, 2.0], [3.0]], "rows differ in length"),
        )
    },
    "force(3 for bar)": (lambda: muscle().force(3, 0.1), WARNS + "3 bar"),
    "force([1, 2, 3] for bar)": (lambda: muscle().force([1, 2, 3], 0.1), WARNS + "3 bar"),
    "force(10 for 10 %)": (lambda: muscle().force(3e5, 10), "did you mean 10 % = 0.1"),
    "force('10 %')": (lambda: muscle().force(3e5, "10 %"), WORKS),
    **{
        f"{name}(-2 bar)": (call, "must be >= -101325")
        for name, call in (
            ("force", lambda: muscle().force(-2e5, 0.1)),
            ("tension", lambda: muscle().tension([1e5, -2e5], 0.1)),
            ("stiffness", lambda: muscle().stiffness("-2 bar", 0.1)),
            ("max_contraction", lambda: muscle().max_contraction(-2e5)),
        )
    },
    "force(a small vacuum)": (lambda: muscle().force(-2e4, 0.1), WORKS),
    "force(True)": (lambda: muscle().force(True, 0.1), "p = True"),
    "force(numpy True)": (lambda: muscle().force(np.True_, 0.1), "p = True"),
    "max_contraction(6 for bar)": (lambda: muscle().max_contraction(6), WARNS + "6 bar"),
    "air_mass(-1)": (lambda: pam.gas.air_mass(-1e5, 1e-3), "must be >= 0"),
    "air_mass(4 for bar)": (lambda: pam.gas.air_mass(4, 1e-3), WARNS + "4 bar"),
    "air_mass at 20 for degC": (lambda: pam.gas.air_mass(4e5, 1e-3, 20), WARNS + "20 degC"),
    "air_mass at 0 K": (lambda: pam.gas.air_mass(4e5, 1e-3, 0), "temperature = 0 K"),
    "iso6358(C=700 l/min)": (
        lambda: pam.gas.iso6358(6e5, 1e5, 700),
        WARNS + "conductance_from_flow",
    ),
    "iso6358(b=1)": (lambda: pam.gas.iso6358(6e5, 1e5, 2e-8, 1.0), "within 0 .. 0.99"),
    "iso6358(arrays)": (lambda: pam.gas.iso6358([6e5, 7e5], 1e5, 2e-8), WORKS),
    "conductance_from_flow('700 l/min')": (
        lambda: pam.gas.conductance_from_flow("700 l/min"),
        WORKS,
    ),
    "with_rest_length('250 mm')": (lambda: muscle().with_rest_length("250 mm"), WORKS),
    "with_rest_length(10**400)": (lambda: muscle().with_rest_length(10**400), "larger than any"),
    "Muscle(rest_length=None)": (lambda: pam.Muscle(muscle().law, None), "is not a number"),
    "pressure_range=('0 bar', '6 bar')": (
        lambda: pam.Muscle(muscle().law, 0.3, pressure_range=("0 bar", "6 bar")),
        WORKS,
    ),
    "pressure_range=6e5": (
        lambda: pam.Muscle(muscle().law, 0.3, pressure_range=6e5),
        "give (low, high)",
    ),
    "pressure_range=(0, [1, 2])": (
        lambda: pam.Muscle(muscle().law, 0.3, pressure_range=(0, [1, 2])),
        "is not a number",
    ),
    "equilibrium(x=ragged)": (
        lambda: plant().equilibrium(x=[0.02, [0.03, 0.04]]),
        "is not a number",
    ),
    "contraction_range=(0, 25) for %": (
        lambda: pam.Muscle(muscle().law, 0.3, contraction_range=(0, 25)),
        "did you mean 25 %",
    ),
    "burst_pressure=8 for bar": (
        lambda: pam.Muscle(muscle().law, 0.3, burst_pressure=8),
        WARNS + "8 bar",
    ),
    "LumpedTube(segments='many')": (
        lambda: pam.feeds.LumpedTube(segments="many"),
        "is not a number",
    ),
    "LumpedTube(segments=2.5)": (lambda: pam.feeds.LumpedTube(segments=2.5), "whole number"),
    "Variable(max='6 bar')": (
        lambda: pam.Variable("p", "input", unit="Pa", max="6 bar", nominal="3 bar"),
        WORKS,
    ),
    "Variable(nominal=None)": (
        lambda: pam.Variable("x", "state", nominal=None),
        "nominal = None is not a number",
    ),
    "ForceTable([3] for bar)": (
        lambda: pam.fitting.ForceTable([3], [0.0], [100.0]),
        WARNS + "3 bar",
    ),
    "table.subset('x')": (
        lambda: pam.fitting.ForceTable([1e5], [0.0], [100.0]).subset("x"),
        "give a mask of 1 cells",
    ),
    "table.subset([7])": (
        lambda: pam.fitting.ForceTable([1e5], [0.0], [100.0]).subset([7]),
        "out of",
    ),
    "hysteresis(None)": (lambda: pam.fitting.hysteresis(None), "read it with read_table"),
    "weights of words": (
        lambda: pam.fit_force(
            pam.fitting.ForceTable([1e5, 2e5], [0.0, 0.1], [100.0, 90.0]), weights=["a", "b"]
        ),
        "does not hold numbers only",
    ),
    "ForceTable(['3 bar'])": (lambda: pam.fitting.ForceTable(["3 bar"], [0.0], ["100 N"]), WORKS),
    "Trajectory(['0 s', '20 ms'])": (
        lambda: pam.Trajectory(["0 s", "20 ms"], {"x": [0, 1]}),
        WORKS,
    ),
    "Trajectory([0, 'late'])": (
        lambda: pam.Trajectory([0, "late"], {"x": [0, 1]}),
        "numbers only",
    ),
    "motion.at('5 ms')": (lambda: motion().at("5 ms"), WORKS),
    "motion.at(None)": (lambda: motion().at(None), "is not a number"),
    "free_vibration('5 mm')": (
        lambda: pam.vibration.free_vibration(plant(), {"muscle.pressure": 3e5}, "5 mm"),
        WORKS,
    ),
    "backbone('high')": (
        lambda: pam.vibration.backbone(plant(), {"muscle.pressure": 3e5}, ["high"]),
        "numbers only",
    ),
    # ---- numbers beyond floats -------------------------------------------------------------------
    "mass=10**400": (lambda: pam.HangingLoad(NAME, 10**400), "larger than any float"),
    "lag=10**400": (lambda: pam.feeds.Regulator(10**400), "larger than any float"),
    "start=10**400": (lambda: plant().with_values(x=10**400), "larger than any float"),
    "equilibrium(x=10**400)": (lambda: plant().equilibrium(x=10**400), "larger than any float"),
    "simulate(duration=10**400)": (lambda: run(duration=10**400), "larger than any float"),
    "simulate(max_steps=10**400)": (lambda: run(max_steps=10**400), "larger than any count"),
    "simulate(t=[0, 10**400])": (
        lambda: run(duration=None, t=[0, 10**400]),
        "larger than any float",
    ),
    "plan(stop=10**400)": (lambda: posed(stops=[{"x": 0}, {"x": 10**400}]), "larger than any"),
    "plan(bounds=10**400)": (
        lambda: posed(bounds={"x": (-0.01, 10**400)}),
        "larger than any float",
    ),
    "rest_length=10**400": (
        lambda: pam.read_table("DMSP-20-300_static.csv", rest_length=10**400),
        "larger than any float",
    ),
    # ---- expressions -----------------------------------------------------------------------------
    "math.sin(x)": (lambda: own(lambda x, v: -math.sin(x)), "casadi.sin"),
    "float(x)": (lambda: own(lambda x, v: -float(x)), "holds the constant nan"),
    "x*inf": (lambda: own(lambda x, v: x * math.inf), "holds the constant inf"),
    "np.sin(x)": (lambda: own(lambda x, v: -np.sin(x)), WORKS),
    "der(v, 'x')": (lambda: own(lambda x, v: "x"), "is no expression"),
    "der(v, None)": (lambda: own(lambda x, v: None), "is no expression"),
    "der(v, MX)": (lambda: own(lambda x, v: ca.MX.sym("x")), "is no expression"),
    "der(v, column)": (lambda: own(lambda x, v: ca.vertcat(x, v)), "give a scalar"),
    "moment arm with math.cos": (
        lambda: pam.AntagonisticJoint(NAME, moment_arm=lambda a: 0.04 * math.cos(a)),
        "casadi.sin",
    ),
    "moment arm with if": (
        lambda: pam.AntagonisticJoint(NAME, moment_arm=lambda a: 0.04 if a > 0 else 0.03),
        "casadi.if_else",
    ),
    "own_law with math.exp": (
        lambda: own_law(lambda p, kappa, a: a * p * math.exp(-kappa)),
        "casadi.sin",
    ),
    "own_law with if": (
        lambda: own_law(lambda p, kappa, a: a * p if kappa > 0 else p),
        "casadi.if_else",
    ),
    "own_law with casadi.exp": (lambda: own_law(lambda p, kappa, a: a * p * ca.exp(-kappa)), WORKS),
    "output of nan": (lambda: own(lambda x, v: v).output("y", math.nan), "holds the constant nan"),
    # ---- equilibrium -----------------------------------------------------------------------------
    "equilibrium(x='20 mm')": (lambda: plant().equilibrium(x="20 mm"), WORKS),
    "equilibrium(x=20)": (lambda: plant().equilibrium(x=20), "did you mean 20 mm"),
    "equilibrium(x=None)": (lambda: plant().equilibrium(x=None), "is not a number"),
    "equilibrium(x=nan)": (lambda: plant().equilibrium(x=math.nan), "must be finite"),
    "equilibrium(0.02)": (lambda: plant().equilibrium(0.02), "give values by name"),
    "equilibrium()": (lambda: plant().equilibrium(), "needs 1 condition"),
    "equilibrium(muscle)": (lambda: pam.equilibrium(muscle(), x=0.02), "not a Plant"),
    "equilibrium(command=3 for bar)": (
        lambda: plant().equilibrium({"muscle.command": 3.0, "mass": 1e-3}),
        WARNS + "3 bar",
    ),
    # ---- simulate --------------------------------------------------------------------------------
    "simulate(start=operating point)": (lambda: run(start=rest()), WORKS),
    "simulate(start=[0, 0, 0])": (lambda: run(start=[0, 0, 0]), "give values by name"),
    "simulate(start={x: '5 mm'})": (lambda: run(start={"x": "5 mm"}), WORKS),
    "simulate(start={x: 5})": (lambda: run(start={"x": 5}), "did you mean 5 mm"),
    "simulate(inputs=3e5)": (lambda: run(inputs=3e5), "give {name: value}"),
    "simulate(inputs={..: '3 bar'})": (lambda: run(inputs={"muscle.command": "3 bar"}), WORKS),
    "simulate(inputs={..: 3.0})": (lambda: run(inputs={"muscle.command": 3.0}), WARNS + "3 bar"),
    "simulate(inputs={..: [1, 2]})": (
        lambda: run(inputs={"muscle.command": [1, 2]}, t=[0, 0.01], duration=None),
        WARNS + "2 bar",
    ),
    "simulate(inputs={..: None})": (
        lambda: run(inputs={"muscle.command": None}),
        "is not a number",
    ),
    "simulate(inputs={..: ['a']})": (
        lambda: run(inputs={"muscle.command": ["a", "b"]}),
        "numbers only",
    ),
    "simulate(inputs={..: []})": (lambda: run(inputs={"muscle.command": []}), "0 samples"),
    "simulate(duration='20 ms')": (lambda: run(duration="20 ms"), WORKS),
    "simulate(duration=-1)": (lambda: run(duration=-1), "must be > 0"),
    "simulate(duration=None)": (lambda: run(duration=None), "give duration"),
    "simulate(t=[0, nan])": (lambda: run(duration=None, t=[0, math.nan]), "must be finite"),
    "simulate(t=[1, 0])": (lambda: run(duration=None, t=[1, 0]), "rise from sample to sample"),
    "simulate(t='1 s')": (lambda: run(duration=None, t="1 s"), "at least two times"),
    "simulate(rtol='1e-8')": (lambda: run(rtol="1e-8"), WORKS),
    "simulate(inputs={..: ['1 bar', '2 bar']})": (
        lambda: run(
            inputs={"muscle.command": ["1 bar", "2 bar"]}, t=["0 s", "10 ms"], duration=None
        ),
        WORKS,
    ),
    "simulate(inputs={..: ragged})": (
        lambda: run(inputs={"muscle.command": [1e5, [2e5, 3e5]]}),
        "rows differ in length",
    ),
    "simulate(inputs={..: function of text})": (
        lambda: run(inputs={"muscle.command": lambda t: "3 bar"}),
        WORKS,
    ),
    "simulate(inputs={..: function of 3})": (
        lambda: run(inputs={"muscle.command": lambda t: 3.0}),
        WARNS + "3 bar",
    ),
    "simulate(inputs={..: function of None})": (
        lambda: run(inputs={"muscle.command": lambda t: None}),
        "it must give one finite number",
    ),
    "simulate(rtol=10)": (lambda: run(rtol=10), "must lie in 1e-14"),
    "simulate(method='euler')": (lambda: run(method="euler"), "choose one of"),
    "simulate(method='rk4', step=-1)": (lambda: run(method="rk4", step=-1), "must be > 0"),
    "simulate(interpolation='cubic')": (lambda: run(interpolation="cubic"), "choose 'previous'"),
    "simulate(max_steps=0.5)": (lambda: run(max_steps=0.5), "whole number"),
    "simulate(events='muscle.tension')": (lambda: run(events="muscle.tension"), WORKS),
    "simulate(parameters={'x': 1})": (lambda: run(parameters={"x": 1}), "x is a state"),
    "simulate(parameters=[1])": (lambda: run(parameters=[1]), "give values by name"),
    "simulate(muscle)": (lambda: pam.simulate(muscle(), duration=1), "put the muscle into one"),
    # ---- closed loop -----------------------------------------------------------------------------
    "closed_loop(controller=None)": (
        lambda: pam.closed_loop(None, plant(), duration=1),
        "is not called with",
    ),
    "controller answers None": (lambda: looped(None), "give inputs by name"),
    "controller answers a number": (lambda: looped(3e5), "give inputs by name"),
    "controller answers a text": (lambda: looped({"muscle.command": "high"}), "is not a number"),
    "controller answers nan": (lambda: looped({"muscle.command": math.nan}), "is not finite"),
    "controller names a state": (lambda: looped({"x": 1.0}), "not an input"),
    "closed_loop(start=operating point)": (lambda: looped({}, start=rest()), WORKS),
    "closed_loop(sample_time=0)": (lambda: looped({}, sample_time=0), "must be > 0"),
    "closed_loop(delay=0.5)": (lambda: looped({}, delay=0.5), "whole number"),
    "closed_loop(noise={..: -1})": (lambda: looped({}, noise={"x": -1.0}), "must be >= 0"),
    "closed_loop(disturbances={..: 3})": (
        lambda: looped({}, disturbances={"muscle.command": 3.0}),
        WARNS + "3 bar",
    ),
    # ---- studies and plans
    # ------------------------------------------------------------------------
    "load_study(pressures=[2, 3])": (lambda: pam.load_study(NAME, [20], [2, 3]), WARNS + "2 bar"),
    "load_study(masses=20)": (lambda: pam.load_study(NAME, 20, 3e5, duration=0.5), WORKS),
    "load_study(pressures='3 bar')": (
        lambda: pam.load_study(NAME, "20 kg", "3 bar", duration=0.5),
        WORKS,
    ),
    "load_study(masses=[])": (lambda: pam.load_study(NAME, []), "at least one value"),
    "load_study(masses=[-1])": (lambda: pam.load_study(NAME, [-1]), "must be > 0"),
    "load_study(step=0.2 for bar)": (
        lambda: pam.load_study(NAME, 20, 3e5, step=0.2, duration=0.5),
        WARNS + "0.2",
    ),
    "load_study(plant)": (lambda: pam.load_study(plant()), "give a Muscle"),
    "plan(bounds=(0, 4) for bar)": (
        lambda: posed(bounds={"muscle1.pressure": (0, 4)}),
        WARNS + "4 bar",
    ),
    "plan(stops in mm)": (lambda: posed(stops=[{"x": -10}, {"x": 10}]), "-10"),
    "plan(bounds crossed)": (lambda: posed(bounds={"x": (0.01, -0.01)}), "crossed"),
    "plan(bounds of text)": (
        lambda: posed(bounds={"x": ("low", "high")}),
        "give a number with its unit",
    ),
    "stroke_work(plant)": (
        lambda: pam.simulation.stroke_work(plant()),
        "give what simulate() returned",
    ),
    "stroke_work(end before begin)": (
        lambda: pam.simulation.stroke_work(motion(), 0.01, 0.005),
        "give a part of",
    ),
    "plan(stops='20 mm')": (lambda: posed(stops=[{"x": "-10 mm"}, {"x": "10 mm"}]), WORKS),
    "plan(stop pressure 3 for bar)": (
        lambda: posed(stops=[{"x": 0, "muscle1.pressure": 3}, {"x": 0.01}]),
        WARNS + "3 bar",
    ),
    "muscle('no-such')": (lambda: pam.muscle("no-such"), "muscle"),
    "muscle(3)": (lambda: pam.muscle(3), "muscle"),
    "linearize(plant, 3)": (lambda: plant().linearize(3), "give an OperatingPoint"),
    "Spring('stiff')": (lambda: pam.loads.Spring("stiff"), "give a number"),
    "Spring(-1)": (lambda: pam.loads.Spring(-1), "must be >= 0"),
    "Wall(side=0)": (lambda: pam.loads.Wall(0.01, side=0), "stops motion"),
    # ---- laws, muscles, gases --------------------------------------------------------------------
    "in_parallel(name)": (lambda: pam.muscles.in_parallel(NAME, 2), "give a Muscle"),  # type: ignore[arg-type]
    "in_parallel(0)": (lambda: pam.muscles.in_parallel(muscle(), 0), "count = 0: give a whole"),
    "attribution('DMSP-20-30')": (lambda: pam.muscles.attribution("DMSP-20-30"), "did you mean"),
    "own_law of no coefficients": (
        lambda: pam.laws.own_law("mine", lambda p, kappa: p, {}),
        "coefficients is empty",
    ),
    "own_law of a number": (
        lambda: pam.laws.own_law("mine", lambda p, kappa, a: p * a, {"a": 3.0}),
        "describe it by coefficient(",
    ),
    "own_law of another name": (
        lambda: own_law(lambda p, kappa, b: p * b),
        "the function has to take p, kappa, a, by these names",
    ),
    "coefficient(nominal=0)": (lambda: pam.laws.coefficient("N", 0.0, "gain"), "nominal = 0 must"),
    "coefficient crossed": (
        lambda: pam.laws.coefficient("N", 1.0, "gain", minimum=2, maximum=1),
        "minimum = 2 must not lie above",
    ),
    "polynomial_law(2.5)": (lambda: pam.laws.polynomial_law(2.5), "from 0 to 12"),  # type: ignore[arg-type]
    "spline_law falling": (lambda: pam.laws.spline_law([0.2, 0.1]), "two or more increasing"),
    "with_bladder(muscle)": (
        lambda: pam.laws.with_bladder(muscle(), 2e4),  # type: ignore[arg-type]
        "must be a class of laws",
    ),
    "save_muscle as CSV": (lambda: pam.save_muscle(muscle(), "m.csv"), "ends in .toml or .json"),
    "save_muscle nowhere": (lambda: pam.save_muscle(muscle(), "none/m.toml"), "create it first"),
    "load_muscle of a folder": (lambda: pam.load_muscle("."), "ends in .toml or .json"),
    "plot_surface('volume')": (
        lambda: muscle().plot_surface("volume"),  # type: ignore[arg-type]
        "choose 'force' or 'stiffness'",
    ),
    "Gas(volume=1e-4)": (lambda: pam.gas.Gas(volume=1e-4), "such as ConsistentVolume()"),  # type: ignore[arg-type]
    "Gas(exponent=0.9)": (lambda: pam.gas.Gas(exponent=0.9), "must lie in 1 (isothermal)"),
    "BraidVolume(24 for deg)": (lambda: pam.gas.BraidVolume(angle=24), "must lie in 0 .. pi/2"),
    "flow uphill": (
        lambda: pam.gas.conductance_from_flow("700 l/min", upstream=6e5, downstream=7e5),
        "must be above downstream",
    ),
    # ---- feeds, losses, loads --------------------------------------------------------------------
    "SpoolValve(gas=1.2)": (lambda: pam.feeds.SpoolValve(gas=1.2), "give a Gas"),  # type: ignore[arg-type]
    "supply='compressor'": (lambda: pam.feeds.SpoolValve(supply="compressor"), "is not a number"),
    "dead_time='3 bar'": (
        lambda: pam.feeds.Regulator(dead_time="3 bar"),
        "something else than 's'",
    ),
    "DeadTime(order=0)": (lambda: pam.feeds.DeadTime(0.01, order=0), "from 1 to 9"),
    "valve of 1/4": (lambda: pam.feeds.valve("MPYE-5-1/4"), "did you mean"),
    "PairRegulator for one": (
        lambda: pam.HangingLoad(NAME, feed=pam.feeds.PairRegulator()),
        "feeds two muscles by one command",
    ),
    "tube=0.01": (lambda: pam.feeds.SpoolValve(tube=0.01), "such as Tube(10e-6)"),  # type: ignore[arg-type]
    "Creep of two and one": (lambda: pam.losses.Creep((5e2, 2e2), (1.0,)), "one of each per"),
    "two springs": (
        lambda: pam.HangingLoad(NAME, loads=[pam.loads.Spring(1e3), pam.loads.Spring(2e3)]),
        "declared twice in plant 'hanging_load'; give one of the two another name",
    ),
    "Spring of two words": (
        lambda: pam.HangingLoad(NAME, loads=pam.loads.Spring(1e3, name="my spring")),
        "use letters, digits",
    ),
    "Regulator(lagg=1)": (
        lambda: pam.feeds.Regulator(lagg=1),  # type: ignore[call-arg]
        "Regulator() has no argument 'lagg'; did you mean lag?",
    ),
    # ---- plants of one's own ---------------------------------------------------------------------
    "state(units='m')": (lambda: pam.Plant("p").state("x", units="m"), "did you mean unit?"),
    "state('my state')": (lambda: pam.Plant("p").state("my state"), "use letters, digits"),
    "state(start=5, max=1)": (lambda: pam.Plant("p").state("x", start=5, max=1), "is outside"),
    "add_muscle(shortening='x')": (
        lambda: pam.Plant("p").add_muscle("m", NAME, shortening="x", rate=0.0),
        "m: shortening: a str is no expression",
    ),
    "add_sensor('x', 3)": (lambda: plant().add_sensor("x", 3), "give a Sensor"),  # type: ignore[arg-type]
    "vector('states')": (lambda: plant().vector("states"), "causality = 'states': choose one of"),  # type: ignore[arg-type]
    "vector(attribute='stop')": (
        lambda: plant().vector("state", attribute="stop"),
        "choose one of start, min, max, nominal",
    ),
    "load_plant of a text": (lambda: pam.plants.load_plant("notes.txt"), "read from .json, .npz"),
    # ---- rest and linear models ------------------------------------------------------------------
    "guess of another plant": (
        lambda: pam.equilibrium(slide(), {"x": 0.0, "muscle1.pressure": 3e5}, guess=rest()),
        "the operating point belongs to 'hanging_load', not 'antagonistic_slide'",
    ),
    "guess={'x': 0.02}": (
        lambda: pam.equilibrium(plant(), x=0.02, guess={"x": 0.02}),  # type: ignore[arg-type]
        "give an OperatingPoint",
    ),
    "a path of nothing": (lambda: pam.operating.equilibrium_path(plant(), "x", []), "is empty"),
    "a branch by steps of 0": (
        lambda: pam.operating.equilibrium_branch(plant(), "muscle.command", 3e5, 4e5, step=0),
        "step = 0 must be > 0",
    ),
    "equilibria(seed=-1)": (
        lambda: pam.operating.equilibria(plant(), x=0.03, seed=-1),
        "seed = -1: give",
    ),
    "Allocation(hanging)": (
        lambda: pam.operating.Allocation(plant()),
        "give an AntagonisticSlide or AntagonisticJoint",
    ),
    "pressures_of 2 and 3": (
        lambda: pam.operating.pressures_of([1e5, 2e5], [1e4, 2e4, 3e4]),
        "common has shape (2,), difference has shape (3,)",
    ),
    "common_and_difference('a', 3)": (
        lambda: pam.operating.common_and_difference("a", 3.0),  # type: ignore[arg-type]
        "p1 = 'a' is not a number",
    ),
    "linearize(units of bar)": (
        lambda: plant().linearize(rest(), units={"x": "bar"}),
        "units['x'] = 'bar': this measures something else",
    ),
    "linearize_along a table": (
        lambda: pam.operating.linearize_along(plant(), cells()),  # type: ignore[arg-type]
        "give a Trajectory",
    ),
    # ---- motions and many of them ----------------------------------------------------------------
    "Trajectory of a list": (
        lambda: pam.Trajectory([0, 1], [1, 2]),
        "give a mapping {name: samples}",
    ),  # type: ignore[arg-type]
    "Trajectory back": (lambda: pam.Trajectory([0, 2, 1], {"x": [1, 2, 3]}), "not at sample 2"),
    "row(10**6)": (lambda: motion().row(10**6), "index = 1000000: give a whole number from"),
    "named('states')": (lambda: motion().named("states"), "choose one of state, input"),  # type: ignore[arg-type]
    "at(5 s)": (lambda: motion().at(5.0), "leaves the record"),
    "motion.save as a film": (lambda: motion().save("m.mp4"), "one of .csv, .npz, .parquet"),
    "motion.plot([])": (lambda: motion().plot([]), "names is empty"),
    "inputs of another plant": (
        lambda: run(inputs=pam.simulate(slide(), duration=0.01)),
        "holds no column 'muscle.command'",
    ),
    "sweep(mass='heavy')": (lambda: pam.simulation.sweep(mass="heavy"), "give a list of values"),
    "draws of -1": (
        lambda: pam.simulation.draws({"mass": 1.0}, [[-1.0]], 3),
        "symmetric, without negative eigenvalues",
    ),
    "draws(seed=-1)": (
        lambda: pam.simulation.draws({"mass": 1.0}, [[1.0]], 3, seed=-1),
        "seed = -1: give a whole number >= 0",
    ),
    "SobolCases crossed": (
        lambda: pam.simulation.SobolCases({"mass": (2, 1)}, 8),
        "low = 2 must lie below high = 1",
    ),
    "measured(x=1e-3)": (
        lambda: pam.simulation.measured(motion(), {"x": 1e-3}),  # type: ignore[dict-item]
        "such as Instrument(noise=1e-5",
    ),
    "measured(seed=-1)": (
        lambda: pam.simulation.measured(motion(), {"x": pam.simulation.Instrument()}, seed=-1),
        "seed = -1: give a whole number >= 0",
    ),
    "max_shift=-1": (
        lambda: pam.simulation.compare_with_record(motion(), motion(), max_shift=-1),
        "max_shift = -1 s must be >= 0",
    ),
    # ---- tables, records, fits -------------------------------------------------------------------
    "read_table('tabelle.csv')": (lambda: pam.read_table("tabelle.csv"), "unknown table file"),
    "read_table(restlength=0.3)": (
        lambda: pam.read_table(TABLE, restlength=0.3),  # type: ignore[call-arg]
        "did you mean rest_length?",
    ),
    "read_table(skip=-1)": (lambda: pam.read_table(TABLE, skip=-1), "skip = -1: give a whole"),
    "read_table(floor=-5)": (
        lambda: pam.read_table(TABLE, rest_length=0.3, floor=-5),
        "floor = -5 N must be >= 0",
    ),
    "with_floor('-5 N')": (lambda: cells().with_floor("-5 N"), "floor = -5 N must be >= 0"),  # type: ignore[arg-type]
    "read_record(of a muscle)": (
        lambda: pam.read_record({"t [s]": [0, 1], "x [m]": [0, 1]}, muscle()),  # type: ignore[arg-type]
        "put the muscle into one",
    ),
    "read_folder('nowhere')": (lambda: pam.read_folder("nowhere"), "is no folder"),
    "fit_force(path)": (lambda: pam.fit_force(TABLE), "read it with read_table"),  # type: ignore[arg-type]
    "fit_force(loss='cauchi')": (lambda: pam.fit_force(cells(), loss="cauchi"), "choose 'squares'"),  # type: ignore[arg-type]
    "fit_force(bounds crossed)": (
        lambda: pam.fit_force(cells(), "three-element", bounds={"f0": (2, 1)}),
        "must be (low, high), the first the smaller",
    ),
    "a level of 95": (lambda: fitted().interval("f0", level=95), "as in 0.95"),
    "bootstrap(seed=-1)": (lambda: fitted().bootstrap(5, seed=-1), "seed = -1: give a whole"),
    "bootstrap of pairs": (lambda: fitted().bootstrap(5, method="pairs"), "'residuals' or 'cases'"),  # type: ignore[arg-type]
    "fit_forces of one": (lambda: pam.fit_forces({}), "one alone is for fit_force"),
    "fit_plant(noise of 0)": (
        lambda: pam.fit_plant(plant(), motion(), ["mass"], outputs=["x"], noise={"x": 0}),
        "noise['x'] = 0 must be > 0",
    ),
    "fit_plant of a table": (
        lambda: pam.fit_plant(plant(), cells(), ["mass"]),
        "records is a Force",
    ),  # type: ignore[arg-type]
    "fit_plant('colocation')": (
        lambda: pam.fit_plant(plant(), motion(), ["mass"], method="colocation"),  # type: ignore[arg-type]
        "choose one of collocation",
    ),
    "design_cells upside down": (
        lambda: pam.experiments.design_cells(fitted(), 8, pressure=(6e5, 1e5)),
        "the lower must be the smaller",
    ),
    # ---- plans -----------------------------------------------------------------------------------
    "one stop": (lambda: posed(stops=[{"x": 0.01}]), "stops holds 1: a motion needs at least two"),
    "Stop(rest='yes')": (lambda: pam.Stop({"x": 0.01}, rest="yes"), "Stop.rest = 'yes': give True"),  # type: ignore[arg-type]
    "Collocation(interval=3)": (
        lambda: pam.Collocation(interval=3),  # type: ignore[call-arg]
        "did you mean intervals?",
    ),
    "a constraint of another plant": (
        lambda: posed(constraints=[pam.Constraint(plant().expression("x"), 0, 1)]),
        "holds symbols that are not the plant's: x",
    ),
    "a constraint of words": (
        lambda: posed(constraints=[pam.Constraint("x < 0.01", 0, 1)]),  # type: ignore[arg-type]
        "give a scalar CasADi SX expression",
    ),
    "design crossed": (lambda: posed(design={"mass": (2, 1)}), "the bounds are crossed"),
    "durations of three legs": (lambda: posed(duration=[0.1, 0.2, 0.3]), "give one per phase"),
    "pareto of time and time": (
        lambda: pam.pareto(slide(), [{"x": 0}, {"x": 0.01}], first="time", second="time"),
        "first and second are both 'time'",
    ),
    "a film of a motion": (
        lambda: pam.figures.animate_plan(motion(), "a.gif"),
        "give what plan() returned",
    ),  # type: ignore[arg-type]
    # ---- controllers and loops -------------------------------------------------------------------
    "reference='sine'": (
        lambda: follower("sine", pam.control.PID(1e5)),
        "reference = 'sine': give a function of the time",
    ),
    "pid=3.0": (lambda: follower(lambda t: (0.0, 0.0, 0.0), 3.0), "give a PID"),
    "WithEstimate(law, 3)": (lambda: pam.control.WithEstimate(feedback(), 3), "that of kalman()"),  # type: ignore[arg-type]
    "margins over nothing": (
        lambda: pam.control.margins_over(feedback(), [], {"x": 0.03}),
        "margins_over: cases is empty",
    ),
    "frequencies downwards": (
        lambda: pam.control.margins(feedback().loop, (100.0, 0.1)),
        "hertz = (100.0, 0.1) must be (low, high)",
    ),
    "a controller of another plant": (
        lambda: pam.closed_loop(feedback(), slide(), duration=0.02),
        "unknown measurement that the controller asks for 'muscle.pressure'",
    ),
    "a controller's typo": (
        lambda: looped(lambda t, y: {"muscle.command": 1e5 * y["xx"]}),
        "unknown measurement that the controller asks for 'xx'",
    ),
    "estimator='kalman'": (lambda: looped({}, estimator="kalman"), "such as a KalmanFilter"),
    "closed_loop(seed=-1)": (lambda: looped({}, seed=-1), "seed = -1: give a whole number >= 0"),
    "judged by limits of y": (
        lambda: pam.judge.judge_loop(motion(), limits={"y": (0, 1)}),
        "unknown column of the trajectory 'y'",
    ),
    "Mpc(track=['x'])": (
        lambda: pam.Mpc(plant(), horizon=5, sample_time=0.01, track=["x"]),  # type: ignore[arg-type]
        "give {name: weight}",
    ),
    "mpc_block(lqr)": (lambda: pam.control.mpc_block(feedback()), "give an Mpc"),  # type: ignore[arg-type]
    # ---- files, pictures, rigs -------------------------------------------------------------------
    "an FMU as a zip": (
        lambda: pam.export_fmu(plant(), "h.zip"),
        "the name of an FMU ends in .fmu",
    ),
    "an FMU for win64": (
        lambda: pam.export_fmu(plant(), "h.fmu", platforms=["win64"]),
        "unknown pl",
    ),
    "check_fmu(durations=1)": (
        lambda: pam.check_fmu("h.fmu", durations=1),  # type: ignore[call-arg]
        "did you mean duration?",
    ),
    "check_fmu of a folder": (lambda: pam.check_fmu("."), "a folder, no FMU"),
    "Modelica as text": (lambda: pam.export.export_modelica(plant(), "p.txt"), "ends in .mo"),
    "inputs as a workbook": (
        lambda: pam.export.save_input_table(motion(), "i.xlsx"),
        "the name of a table of inputs ends in .csv",
    ),
    "a way of one joint's name": (
        lambda: pam.export.MujocoMuscle("m", NAME, "joint"),
        "give two sites or more",
    ),
    "an SSP by pairs": (
        lambda: pam.export_ssp({"a": plant()}, [("a.x", "a.u")], "s.ssp"),  # type: ignore[arg-type]
        "give a mapping {text: text}",
    ),
    "new_figure(0)": (lambda: pam.figures.new_figure(0, size=(1, 1)), "rows = 0: give a whole"),
    "a crate without a licence": (
        lambda: pam.figures.save_crate("c.zip", {"a": muscle()}, licence=None),  # type: ignore[arg-type]
        "licence is missing: give an SPDX",
    ),
    "a report of 3": (lambda: pam.figures.write_report("r.html", {"a": 3}), "which shows nothing"),
    "serve(port=99999)": (
        lambda: pam.rig.serve(pam.rig.Twin(plant()), "udp", port=99999),
        "port = 99999: give a whole number from 0 to 65535",
    ),
    "driver('modbuss')": (lambda: pam.rig.driver("modbuss"), "did you mean 'modbus'?"),
    "Rig(plant)": (lambda: pam.Rig(plant()), "a driver has read, write, vent, close"),  # type: ignore[arg-type]
    "a fault that ends before": (
        lambda: pam.rig.Fault("stuck", "x", at=2, until=1),
        "must be before until",
    ),
    "hopf downwards": (
        lambda: pam.vibration.hopf(plant(), "masss", (10, 30), {"x": 0.03}),
        "did you mean 'mass'?",
    ),
}


def answer(call: Call) -> tuple[str, str]:
    """("works" | "warns" | class of the error, what was said)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            call()
        except Exception as error:
            return type(error).__name__, " ".join(str(error).split())
    said = [str(w.message) for w in caught if issubclass(w.category, pam.UnitWarning)]
    return ("warns", said[0]) if said else ("works", "")


def main() -> None:
    for label, (call, _) in CALLS.items():
        kind, said = answer(call)
        print(f"{label:<36} {kind:<16} {said[:150]}", flush=True)


if __name__ == "__main__":
    main()
