"""Sloppy, wrong and absurd calls, each with what it is answered: ``python tests/absurd.py`` prints
them.

A call works, warns with the unit that was probably meant (a fragment of the warning stands behind
"warns: "), or is refused in one sentence that holds a fragment.
"""

from __future__ import annotations

import ast
import math  # noqa: F401 - of the calls
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import casadi as ca
import numpy as np  # noqa: F401 - of the calls

import pam_ocp as pam

WARNS = "warns: "
NAME = "DMSP-20-300"
TABLE = "DMSP-20-300_static.csv"


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


SLOPPY = """
# ---- nouns: names, single components, numbers, classes
pam.HangingLoad(NAME)  # works
pam.HangingLoad("DMSP-20-30")  # did you mean
pam.Variable(
    "a", "parameter", relaxed=-1.0
)  # a: relaxed = -1: give a finite number > 0, of a parameter
pam.Variable("a", "state", relaxed=2.0)  # a: relaxed = 2: give a finite number > 0, of a parameter
pam.control.PID(plant(), "x")  # is not a number
run(inputs={"muscle.command": lambda: 3e5})  # the function has to take one argument, the time [s]
posed(bounds={"v": (1, 2, 3)})  # (1, 2, 3): give a number, or (low, high)
posed(phases=[pam.Phase(bounds=3)])  # phases[0].bounds = 3: give {name: (low, high)}
posed(options={"max_itr": 3})()  # No such IPOPT option: max_itr; see IPOPT's list
pam.Variable("x", "state", unit="furlong")  # unknown unit 'furlong': known: 1, %, kg
pam.control.mode_map(plant(), "zz")  # axes = 'zz': give a mapping {text: numbers}
pam.HangingLoad(None)  # muscle is None: give a Muscle
pam.HangingLoad([muscle()])  # give a Muscle
pam.HangingLoad(muscle().law)  # give a Muscle
pam.HangingLoad(20.0, muscle())  # muscle is 20.0
pam.AntagonisticSlide(NAME, muscle2="DMSP-10-250")  # works
pam.AntagonisticJoint(NAME)  # works
pam.SpringOverMuscle(NAME)  # works
pam.SeriesLoad(NAME)  # works
pam.RegulatedLoad(NAME)  # works
pam.AntagonisticSlide(muscle(), muscle2=3)  # muscle2 is 3
pam.HangingLoad(NAME, damping=20.0)  # works
pam.HangingLoad(NAME, damping=np.float64(20))  # works
pam.HangingLoad(NAME, damping="20 N.s/m")  # works
pam.HangingLoad(NAME, damping=-1)  # must be >= 0
pam.HangingLoad(NAME, damping=pam.losses.ConstantDamping)  # ConstantDamping(...)
pam.HangingLoad(NAME, damping=pam.loads.Spring(1e3))  # give components
pam.HangingLoad(NAME, loads=pam.loads.Spring(1e3))  # works
pam.HangingLoad(NAME, loads=[pam.loads.Spring(1e3)])  # works
pam.HangingLoad(NAME, loads=None)  # works
pam.HangingLoad(NAME, loads=pam.loads.Spring)  # Spring(...)
pam.HangingLoad(NAME, loads="spring")  # give components
pam.AntagonisticSlide(NAME, loads=(5.0,))  # give components
pam.AntagonisticSlide(NAME, loads=Flywheel())  # works
pam.HangingLoad(NAME, losses=pam.losses.BoucWen())  # works
pam.HangingLoad(NAME, losses=pam.losses.BoucWen)  # BoucWen(...)
pam.HangingLoad(NAME, feed=pam.feeds.Regulator)  # Regulator(...)
pam.HangingLoad(NAME, feed="regulator")  # give components
pam.HangingLoad(NAME, feed=0.05)  # give components
pam.AntagonisticJoint(NAME, limits=0.5)  # give (low, high)
pam.AntagonisticJoint(NAME, limits=("a", "b"))  # limits
pam.Plant("two words")  # use letters
# ---- numbers
pam.HangingLoad(NAME, "5 kg")  # works
pam.HangingLoad(NAME, "5 mm")  # measures something else
pam.HangingLoad(NAME, "five")  # give a number with its unit
pam.HangingLoad(NAME, None)  # is not a number
pam.HangingLoad(NAME, math.nan)  # must be a finite number
pam.HangingLoad(NAME, math.inf)  # must be a finite number
pam.HangingLoad(NAME, -5)  # must be > 0
pam.HangingLoad(NAME, 1j)  # is not a number
pam.HangingLoad(NAME, [5])  # is not a number
pam.HangingLoad(NAME, True)  # is not a number
pam.HangingLoad(NAME, np.array(5.0))  # works
pam.HangingLoad(NAME, np.int64(5))  # works
pam.HangingLoad(NAME, ca.SX.sym("m"))  # must be a finite number
plant().with_values(mass="2 kg")  # works
plant().with_values(mass=[1, 2])  # is not a number
plant().with_values(3)  # give values by name
plant().with_values(masse=2)  # did you mean
plant().with_values({"muscle.force": 1})  # follows from the others
pam.AntagonisticSlide(NAME, pre_contraction="10 %")  # works
pam.AntagonisticSlide(NAME, pre_contraction="10 mm")  # measures something else than '1'
pam.AntagonisticSlide(NAME, pre_contraction=10)  # did you mean 10 %
pam.HangingLoad(NAME, feed=pam.feeds.Regulator(max_pressure="6 bar"))  # works
pam.HangingLoad(NAME, feed=pam.feeds.Regulator("50 ms"))  # works
pam.feeds.Regulator(0)  # must be > 0
# ---- units
pam.HangingLoad(NAME, feed=pam.feeds.Regulator(max_pressure=6))  # warns: 6 bar
pam.HangingLoad(NAME, feed=pam.feeds.IdealPressure(0.6))  # warns: 0.6 MPa
pam.HangingLoad(NAME, feed=pam.feeds.Regulator(max_rate=40))  # warns: 40 bar/s
pam.HangingLoad(NAME, feed=pam.feeds.Regulator(50))  # warns: 50 ms
pam.HangingLoad(NAME, 5000)  # warns: 5000 g
pam.AntagonisticSlide(NAME, stroke=15)  # did you mean 15 mm
pam.AntagonisticJoint(NAME, moment_arm=40)  # warns: 40 mm
pam.AntagonisticJoint(NAME, limits=(-10, 10))  # did you mean 10 deg
pam.HangingLoad(NAME, inclination=30)  # did you mean 30 deg
pam.Muscle(muscle().law, 300)  # warns: 300 mm
pam.Muscle(muscle().law, 0.3, diameter=20)  # warns: 20 mm
pam.Muscle(muscle().law, 0.3, pressure_range=(0, 6))  # warns: 6 bar
pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(gas=pam.gas.Gas(temperature=20)))  # warns: 20 degC
pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(supply=6))  # warns: 6 bar
pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(conductance=700))  # warns: conductance_from_flow
pam.HangingLoad(NAME, feed=pam.feeds.SpoolValve(tube=pam.feeds.Tube(volume=10)))  # warns: 10 cm3
plant().with_values({"muscle.pressure": 3.0})  # warns: 3 bar
plant().with_values({"muscle.pressure": 1e3})  # works
plant().with_values({"muscle.pressure": 0})  # works
plant().with_values(x=1e-4)  # works
# ---- what muscles and gases answer
muscle().force(3, 0.1)  # warns: 3 bar
muscle().force([1, 2, 3], 0.1)  # warns: 3 bar
muscle().force(3e5, 10)  # did you mean 10 % = 0.1
muscle().force(3e5, "10 %")  # works
muscle().force(-2e5, 0.1)  # must be >= -101325
muscle().tension([1e5, -2e5], 0.1)  # must be >= -101325
muscle().stiffness("-2 bar", 0.1)  # must be >= -101325
muscle().max_contraction(-2e5)  # must be >= -101325
muscle().force(-2e4, 0.1)  # works
muscle().force(True, 0.1)  # p = True
muscle().force(np.True_, 0.1)  # p = True
muscle().max_contraction(6)  # warns: 6 bar
pam.gas.air_mass(-1e5, 1e-3)  # must be >= 0
pam.gas.air_mass(4, 1e-3)  # warns: 4 bar
pam.gas.air_mass(4e5, 1e-3, 20)  # warns: 20 degC
pam.gas.air_mass(4e5, 1e-3, 0)  # temperature = 0 K
pam.gas.iso6358(6e5, 1e5, 700)  # warns: conductance_from_flow
pam.gas.iso6358(6e5, 1e5, 2e-8, 1.0)  # within 0 .. 0.99
pam.gas.iso6358([6e5, 7e5], 1e5, 2e-8)  # works
pam.gas.conductance_from_flow("700 l/min")  # works
muscle().with_rest_length("250 mm")  # works
muscle().with_rest_length(10**400)  # larger than any
pam.Muscle(muscle().law, None)  # is not a number
pam.Muscle(muscle().law, 0.3, pressure_range=("0 bar", "6 bar"))  # works
pam.Muscle(muscle().law, 0.3, pressure_range=6e5)  # give (low, high)
pam.Muscle(muscle().law, 0.3, pressure_range=(0, [1, 2]))  # is not a number
plant().equilibrium(x=[0.02, [0.03, 0.04]])  # is not a number
pam.Muscle(muscle().law, 0.3, contraction_range=(0, 25))  # did you mean 25 %
pam.Muscle(muscle().law, 0.3, burst_pressure=8)  # warns: 8 bar
pam.feeds.LumpedTube(segments="many")  # is not a number
pam.feeds.LumpedTube(segments=2.5)  # whole number
pam.Variable("p", "input", unit="Pa", max="6 bar", nominal="3 bar")  # works
pam.Variable("x", "state", nominal=None)  # nominal = None is not a number
pam.fitting.ForceTable([3], [0.0], [100.0])  # warns: 3 bar
pam.fitting.ForceTable([1e5], [0.0], [100.0]).subset("x")  # give a mask of 1 cells
pam.fitting.ForceTable([1e5], [0.0], [100.0]).subset([7])  # out of
pam.fitting.hysteresis(None)  # read it with read_table
pam.fit_force(
    pam.fitting.ForceTable([1e5, 2e5], [0.0, 0.1], [100.0, 90.0]), weights=["a", "b"]
)  # does not hold numbers only
pam.fitting.ForceTable(["3 bar"], [0.0], ["100 N"])  # works
pam.Trajectory(["0 s", "20 ms"], {"x": [0, 1]})  # works
pam.Trajectory([0, "late"], {"x": [0, 1]})  # numbers only
motion().at("5 ms")  # works
motion().at(None)  # is not a number
pam.vibration.free_vibration(plant(), {"muscle.pressure": 3e5}, "5 mm")  # works
pam.vibration.backbone(plant(), {"muscle.pressure": 3e5}, ["high"])  # numbers only
# ---- numbers beyond floats
pam.HangingLoad(NAME, 10**400)  # larger than any float
pam.feeds.Regulator(10**400)  # larger than any float
plant().with_values(x=10**400)  # larger than any float
plant().equilibrium(x=10**400)  # larger than any float
run(duration=10**400)  # larger than any float
run(max_steps=10**400)  # larger than any count
run(duration=None, t=[0, 10**400])  # larger than any float
posed(stops=[{"x": 0}, {"x": 10**400}])  # larger than any
posed(bounds={"x": (-0.01, 10**400)})  # larger than any float
pam.read_table("DMSP-20-300_static.csv", rest_length=10**400)  # larger than any float
# ---- expressions
own(lambda x, v: -math.sin(x))  # casadi.sin
own(lambda x, v: -float(x))  # holds the constant nan
own(lambda x, v: x * math.inf)  # holds the constant inf
own(lambda x, v: -np.sin(x))  # works
own(lambda x, v: "x")  # is no expression
own(lambda x, v: None)  # is no expression
own(lambda x, v: ca.MX.sym("x"))  # is no expression
own(lambda x, v: ca.vertcat(x, v))  # give a scalar
pam.AntagonisticJoint(NAME, moment_arm=lambda a: 0.04 * math.cos(a))  # casadi.sin
pam.AntagonisticJoint(NAME, moment_arm=lambda a: 0.04 if a > 0 else 0.03)  # casadi.if_else
own_law(lambda p, kappa, a: a * p * math.exp(-kappa))  # casadi.sin
own_law(lambda p, kappa, a: a * p if kappa > 0 else p)  # casadi.if_else
own_law(lambda p, kappa, a: a * p * ca.exp(-kappa))  # works
own(lambda x, v: v).output("y", math.nan)  # holds the constant nan
# ---- equilibrium
plant().equilibrium(x="20 mm")  # works
plant().equilibrium(x=20)  # did you mean 20 mm
plant().equilibrium(x=None)  # is not a number
plant().equilibrium(x=math.nan)  # must be finite
plant().equilibrium(0.02)  # give values by name
plant().equilibrium()  # needs 1 condition
pam.equilibrium(muscle(), x=0.02)  # not a Plant
plant().equilibrium({"muscle.command": 3.0, "mass": 1e-3})  # warns: 3 bar
# ---- simulate
run(start=rest())  # works
run(start=[0, 0, 0])  # give values by name
run(start={"x": "5 mm"})  # works
run(start={"x": 5})  # did you mean 5 mm
run(inputs=3e5)  # give {name: value}
run(inputs={"muscle.command": "3 bar"})  # works
run(inputs={"muscle.command": np.array(3e5)})  # works
run(inputs={"muscle.command": range(300000, 300002)}, t=[0, 0.01], duration=None)  # works
run(inputs={"muscle.command": (1e5, 3e5)})  # 1 samples for 1 times
run(inputs={"muscle.command": 3.0})  # warns: 3 bar
run(inputs={"muscle.command": [1, 2]}, t=[0, 0.01], duration=None)  # warns: 2 bar
run(inputs={"muscle.command": None})  # is not a number
run(inputs={"muscle.command": ["a", "b"]})  # numbers only
run(inputs={"muscle.command": []})  # 0 samples
run(duration="20 ms")  # works
run(duration=-1)  # must be > 0
run(duration=None)  # give duration
run(duration=None, t=[0, math.nan])  # must be finite
run(duration=None, t=[1, 0])  # rise from sample to sample
run(duration=None, t="1 s")  # at least two times
run(rtol="1e-8")  # works
run(inputs={"muscle.command": ["1 bar", "2 bar"]}, t=["0 s", "10 ms"], duration=None)  # works
run(inputs={"muscle.command": [1e5, [2e5, 3e5]]})  # rows differ in length
run(inputs={"muscle.command": lambda t: "3 bar"})  # works
run(inputs={"muscle.command": lambda t: 3.0})  # warns: 3 bar
run(inputs={"muscle.command": lambda t: None})  # it must give one finite number
run(rtol=10)  # must lie in 1e-14
run(method="euler")  # choose one of
run(method="rk4", step=-1)  # must be > 0
run(interpolation="cubic")  # choose 'previous'
run(max_steps=0.5)  # whole number
run(events="muscle.tension")  # works
run(parameters={"x": 1})  # x is a state
run(parameters=[1])  # give values by name
pam.simulate(muscle(), duration=1)  # put the muscle into one
# ---- closed loop
pam.closed_loop(None, plant(), duration=1)  # is not called with
looped(None)  # give inputs by name
looped(3e5)  # give inputs by name
looped({"muscle.command": "high"})  # is not a number
looped({"muscle.command": math.nan})  # is not finite
looped({"x": 1.0})  # not an input
looped({}, start=rest())  # works
looped({}, sample_time=0)  # must be > 0
looped({}, delay=0.5)  # whole number
looped({}, noise={"x": -1.0})  # must be >= 0
looped({}, disturbances={"muscle.command": 3.0})  # warns: 3 bar
# ---- studies and plans
pam.load_study(NAME, [20], [2, 3])  # warns: 2 bar
pam.load_study(NAME, 20, 3e5, duration=0.5)  # works
pam.load_study(NAME, "20 kg", "3 bar", duration=0.5)  # works
pam.load_study(NAME, [])  # at least one value
pam.load_study(NAME, [-1])  # must be > 0
pam.load_study(NAME, 20, 3e5, step=0.2, duration=0.5)  # warns: 0.2
pam.load_study(plant())  # give a Muscle
posed(bounds={"muscle1.pressure": (0, 4)})  # warns: 4 bar
posed(stops=[{"x": -10}, {"x": 10}])  # -10
posed(bounds={"x": (0.01, -0.01)})  # crossed
posed(bounds={"x": ("low", "high")})  # give a number with its unit
pam.simulation.stroke_work(plant())  # give what simulate() returned
pam.simulation.stroke_work(motion(), 0.01, 0.005)  # give a part of
posed(stops=[{"x": "-10 mm"}, {"x": "10 mm"}])  # works
posed(stops=[{"x": 0, "muscle1.pressure": 3}, {"x": 0.01}])  # warns: 3 bar
pam.muscle("no-such")  # muscle
pam.muscle(3)  # muscle
plant().linearize(3)  # give an OperatingPoint
pam.loads.Spring("stiff")  # give a number
pam.loads.Spring(-1)  # must be >= 0
pam.loads.Wall(0.01, side=0)  # stops motion
# ---- laws, muscles, gases
pam.muscles.in_parallel(NAME, 2)  # give a Muscle
pam.muscles.in_parallel(muscle(), 0)  # count = 0: give a whole
pam.muscles.attribution("DMSP-20-30")  # did you mean
pam.laws.own_law("mine", lambda p, kappa: p, {})  # coefficients is empty
pam.laws.own_law("mine", lambda p, kappa, a: p * a, {"a": 3.0})  # describe it by coefficient(
own_law(lambda p, kappa, b: p * b)  # the function has to take p, kappa, a, by these names
pam.laws.coefficient("N", 0.0, "gain")  # nominal = 0 must
pam.laws.coefficient("N", 1.0, "gain", minimum=2, maximum=1)  # minimum = 2 must not lie above
pam.laws.polynomial_law(2.5)  # from 0 to 12
pam.laws.spline_law([0.2, 0.1])  # two or more increasing
pam.laws.with_bladder(muscle(), 2e4)  # must be a class of laws
pam.save_muscle(muscle(), "m.csv")  # ends in .toml or .json
pam.save_muscle(muscle(), "none/m.toml")  # create it first
pam.load_muscle(".")  # ends in .toml or .json
muscle().plot_surface("volume")  # choose 'force' or 'stiffness'
pam.gas.Gas(volume=1e-4)  # such as ConsistentVolume()
pam.gas.Gas(exponent=0.9)  # must lie in 1 (isothermal)
pam.gas.BraidVolume(angle=24)  # must lie in 0 .. pi/2
pam.gas.conductance_from_flow("700 l/min", upstream=6e5, downstream=7e5)  # must be above downstream
# ---- feeds, losses, loads
pam.feeds.SpoolValve(gas=1.2)  # give a Gas
pam.feeds.SpoolValve(supply="compressor")  # is not a number
pam.feeds.Regulator(dead_time="3 bar")  # something else than 's'
pam.feeds.DeadTime(0.01, order=0)  # from 1 to 9
pam.feeds.valve("MPYE-5-1/4")  # did you mean
pam.HangingLoad(NAME, feed=pam.feeds.PairRegulator())  # feeds two muscles by one command
pam.feeds.SpoolValve(tube=0.01)  # such as Tube(10e-6)
pam.losses.Creep((5e2, 2e2), (1.0,))  # one of each per
pam.HangingLoad(
    NAME, loads=[pam.loads.Spring(1e3), pam.loads.Spring(2e3)]
)  # declared twice in plant 'hanging_load'; give one of the two another name
pam.HangingLoad(NAME, loads=pam.loads.Spring(1e3, name="my spring"))  # use letters, digits
pam.feeds.Regulator(lagg=1)  # Regulator() has no argument 'lagg'; did you mean lag?
# ---- plants of one's own
pam.Plant("p").state("x", units="m")  # did you mean unit?
pam.Plant("p").state("my state")  # use letters, digits
pam.Plant("p").state("x", start=5, max=1)  # is outside
pam.Plant(
    "p").add_muscle("m", NAME, shortening="x", rate=0.0
)  # m: shortening: a str is no expression
plant().add_sensor("x", 3)  # give a Sensor
plant().vector("states")  # causality = 'states': choose one of
plant().vector("state", attribute="stop")  # choose one of start, min, max, nominal
pam.plants.load_plant("notes.txt")  # read from .json, .npz
# ---- rest and linear models
pam.equilibrium(
    slide(), {"x": 0.0, "muscle1.pressure": 3e5}, guess=rest()
)  # the operating point belongs to 'hanging_load', not 'antagonistic_slide'
pam.equilibrium(plant(), x=0.02, guess={"x": 0.02})  # give an OperatingPoint
pam.operating.equilibrium_path(plant(), "x", [])  # is empty
pam.operating.equilibrium_branch(
    plant(), "muscle.command", 3e5, 4e5, step=0
)  # step = 0 must be > 0
pam.operating.equilibria(plant(), x=0.03, seed=-1)  # seed = -1: give
looped({"muscle.command": 3e5}, noise={"x": "0.01 mm"})  # works
looped({"muscle.command": 3e5}, noise={"x": "0.01 bar"})  # something else than 'm'
pam.Profile(["0 s", "10 ms"], [0, 0.01])  # works
pam.Profile([0, 1], ["1 mm", "2 mm"])  # something else than a plain number
pam.operating.Allocation(plant())  # give an AntagonisticSlide or AntagonisticJoint
pam.operating.pressures_of(
    [1e5, 2e5], [1e4, 2e4, 3e4]
)  # common has shape (2,), difference has shape (3,)
pam.operating.common_and_difference("a", 3.0)  # p1 = 'a' is not a number
plant().linearize(rest(), units={"x": "bar"})  # units['x'] = 'bar': this measures something else
pam.operating.linearize_along(plant(), cells())  # give a Trajectory
# ---- motions and many of them
pam.Trajectory([0, 1], [1, 2])  # give a mapping {name: samples}
pam.Trajectory([0, 2, 1], {"x": [1, 2, 3]})  # not at sample 2
motion().row(10**6)  # index = 1000000: give a whole number from
motion().named("states")  # choose one of state, input
motion().at(5.0)  # leaves the record
motion().at([])  # t is empty; give at least one time
motion()[1:3]  # names no column; other times: at(t), a sample: row(index)
pam.Trajectory(np.array(["2026-01-01"], "M8[s]"), {"x": [0]})  # numbers only: these are datetime64
pam.Trajectory([0], {"x": np.array([1], "m8[ms]")})  # numbers only: these are timedelta64
pam.Trajectory([0], {"x": [1]}, [pam.Variable("x", "output")] * 2)  # two columns are named 'x'
motion().compare(pam.Trajectory(motion().t, {"x": motion().t}))  # works
motion().compare(
    pam.Trajectory([0, 1], {"x": [0, 1]}, [pam.Variable("x", "state", unit="Pa")])
)  # x is in m here and in Pa there
motion().save("m.mp4")  # one of .csv, .npz, .parquet
motion().plot([])  # names is empty
run(inputs=pam.simulate(slide(), duration=0.01))  # holds no column 'muscle.command'
pam.simulation.sweep(mass="heavy")  # give a list of values
pam.simulation.draws({"mass": 1.0}, [[-1.0]], 3)  # symmetric, without negative eigenvalues
pam.simulation.draws({"mass": 1.0}, [[1.0]], 3, seed=-1)  # seed = -1: give a whole number >= 0
pam.simulation.SobolCases({"mass": (2, 1)}, 8)  # low = 2 must lie below high = 1
pam.simulation.measured(motion(), {"x": 1e-3})  # such as Instrument(noise=1e-5
pam.simulation.measured(
    motion(), {"x": pam.simulation.Instrument()}, seed=-1
)  # seed = -1: give a whole number >= 0
pam.simulation.compare_with_record(
    motion(), motion(), max_shift=-1
)  # max_shift = -1 s must be >= 0
# ---- tables, records, fits
pam.read_table("tabelle.csv")  # unknown table file
pam.read_table(TABLE, restlength=0.3)  # did you mean rest_length?
pam.read_table(TABLE, skip=-1)  # skip = -1: give a whole
pam.read_table(TABLE, rest_length=0.3, floor=-5)  # floor = -5 N must be >= 0
cells().with_floor("-5 N")  # floor = -5 N must be >= 0
pam.read_record({"t [s]": [0, 1], "x [m]": [0, 1]}, muscle())  # put the muscle into one
pam.read_folder("nowhere")  # is no folder
pam.fit_force(TABLE)  # read it with read_table
pam.fit_force(cells(), loss="cauchi")  # choose 'squares'
pam.fit_force(
    cells(), "three-element", bounds={"f0": (2, 1)}
)  # must be (low, high), the first the smaller
fitted().interval("f0", level=95)  # as in 0.95
fitted().bootstrap(5, seed=-1)  # seed = -1: give a whole
fitted().bootstrap(5, method="pairs")  # 'residuals' or 'cases'
pam.fit_forces({})  # one alone is for fit_force
pam.fit_plant(
    plant(), motion(), ["mass"], outputs=["x"], noise={"x": 0}
)  # noise['x'] = 0 must be > 0
pam.fit_plant(plant(), cells(), ["mass"])  # records is a Force
pam.fit_plant(plant(), motion(), ["mass"], method="colocation")  # choose one of collocation
pam.experiments.design_cells(fitted(), 8, pressure=(6e5, 1e5))  # the first the smaller
# ---- plans
posed(stops=[{"x": 0.01}])  # stops holds 1: a motion needs at least two
pam.Stop({"x": 0.01}, rest="yes")  # Stop.rest = 'yes': give True
pam.Collocation(interval=3)  # did you mean intervals?
posed(
    constraints=[pam.Constraint(plant().expression("x"), 0, 1)]
)  # holds symbols that are not the plant's: x
posed(constraints=[pam.Constraint("x < 0.01", 0, 1)])  # give a scalar CasADi SX expression
posed(design={"mass": (2, 1)})  # the bounds are crossed
posed(duration=[0.1, 0.2, 0.3])  # give one per phase
pam.pareto(
    slide(), [{"x": 0}, {"x": 0.01}], first="time", second="time"
)  # first and second are both 'time'
pam.figures.animate_plan(motion(), "a.gif")  # give what plan() returned
# ---- controllers and loops
follower("sine", pam.control.PID(1e5))  # reference = 'sine': give a function of the time
follower(lambda t: (0.0, 0.0, 0.0), 3.0)  # give a PID
pam.control.WithEstimate(feedback(), 3)  # that of kalman()
pam.control.margins_over(feedback(), [], {"x": 0.03})  # margins_over: cases is empty
pam.control.margins(feedback().loop, (100.0, 0.1))  # hertz = (100.0, 0.1) must be (low, high)
pam.closed_loop(
    feedback(), slide(), duration=0.02
)  # unknown measurement that the controller asks for 'muscle.pressure'
looped(
    lambda t, y: {"muscle.command": 1e5 * y["xx"]}
)  # unknown measurement that the controller asks for 'xx'
looped({}, estimator="kalman")  # such as a KalmanFilter
looped({}, seed=-1)  # seed = -1: give a whole number >= 0
pam.judge.judge_loop(motion(), limits={"y": (0, 1)})  # unknown column of the trajectory 'y'
pam.Mpc(plant(), horizon=5, sample_time=0.01, track=["x"])  # give {name: weight}
pam.control.mpc_block(feedback())  # give an Mpc
# ---- files, pictures, rigs
pam.export_fmu(plant(), "h.zip")  # the name of an FMU ends in .fmu
pam.export_fmu(plant(), "h.fmu", platforms=["win64"])  # unknown pl
pam.check_fmu("h.fmu", durations=1)  # did you mean duration?
pam.check_fmu(".")  # a folder, no FMU
pam.export.export_modelica(plant(), "p.txt")  # ends in .mo
pam.export.save_input_table(motion(), "i.xlsx")  # the name of a table of inputs ends in .csv
pam.export.MujocoMuscle("m", NAME, "joint")  # give two sites or more
pam.export_ssp({"a": plant()}, [("a.x", "a.u")], "s.ssp")  # give a mapping {text: text}
pam.figures.new_figure(0, size=(1, 1))  # rows = 0: give a whole
pam.figures.save_crate("c.zip", {"a": muscle()}, licence=None)  # licence is missing: give an SPDX
pam.figures.write_report("r.html", {"a": 3})  # which shows nothing
pam.rig.serve(
    pam.rig.Twin(plant()), "udp", port=99999
)  # port = 99999: give a whole number from 0 to 65535
pam.rig.driver("modbuss")  # did you mean 'modbus'?
pam.Rig(plant())  # a driver has read, write, vent, close
pam.rig.Fault("stuck", "x", at=2, until=1)  # must be before until
pam.vibration.hopf(plant(), "masss", (10, 30), {"x": 0.03})  # did you mean 'mass'?
"""
QUESTIONS = """
muscle().force(VALUE, 0.1)  # Pa
muscle().stiffness(VALUE, 0.1)  # Pa
muscle().tension(VALUE, 0.1)  # Pa
muscle().blocked_force(VALUE)  # Pa
muscle().max_contraction(VALUE)  # Pa
muscle().law.dtension_dkappa(VALUE, 0.1)  # Pa
pam.gas.closed_stiffness(muscle(), VALUE, 0.1)  # Pa
pam.gas.air_mass(VALUE, 1e-4)  # Pa
pam.gas.iso6358(VALUE, 1e5, 2e-8)  # Pa
pam.gas.specific_exergy(VALUE, 1e5, 293.15)  # Pa
muscle().pressure(VALUE, 0.1)  # N
muscle().force(3e5, VALUE)  # 1
muscle().pressure(300.0, VALUE)  # 1
muscle().law.gain_area(VALUE)  # 1
pam.gas.muscle_volume(muscle(), VALUE)  # 1
pam.gas.air_mass(4e5, VALUE)  # m3
pam.gas.iso6358(6e5, 1e5, VALUE)  # m3/(s.Pa)
"""
"""What muscles and gases are asked for VALUE, and its unit."""
SAID = {"Pa": "3 bar", "N": "300 N", "1": "10 %", "m3": "100 cm3", "m3/(s.Pa)": "2e-8 m3/(s.Pa)"}
"""A quantity of each unit as a text."""
VALUES = """
TEXT  # works
[TEXT, TEXT]  # works
"3 lumen"  # unknown unit
"3 kg"  # measures something else
"high"  # is not a number
math.nan  # finite
math.inf  # finite
np.array([0.1, math.nan])  # sample 1 is nan
10**400  # larger than any float
[0.1, 10**400]  # larger than any float
None  # is not a number
object()  # is not a number
1j  # is not a number
np.array([1j])  # numbers only
[[1.0, 2.0], [3.0]]  # rows differ in length
"""


def rows(table: str) -> Iterator[tuple[str, str]]:
    """The calls of a table and what stands behind each."""
    lines = table.splitlines()
    for call in ast.parse(table).body:
        said = lines[call.end_lineno - 1][call.end_col_offset :]
        text = " ".join(lines[call.lineno - 1 : call.end_lineno]).removesuffix(said)
        yield " ".join(text.split()), said.removeprefix("  # ")


CALLS = dict(rows(SLOPPY)) | {
    question.replace("VALUE", value.replace("TEXT", repr(SAID[unit]))): expected
    for question, unit in rows(QUESTIONS)
    for value, expected in rows(VALUES)
}


def answer(call: str) -> tuple[str, str]:
    """("works" | "warns" | class of the error, what was said)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            eval(call, globals())
        except Exception as error:
            return type(error).__name__, " ".join(str(error).split())
    said = [str(w.message) for w in caught if issubclass(w.category, pam.UnitWarning)]
    return ("warns", said[0]) if said else ("works", "")


def main() -> None:
    for call in CALLS:
        kind, said = answer(call)
        print(f"{call:<60} {kind:<16} {said[:150]}", flush=True)


if __name__ == "__main__":
    main()
