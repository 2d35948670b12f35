"""Every component of the physics through the same verbs: a line for each.

    python benchmarks/physics_study.py [--seed N] [--only NAME ...] [--verbs balance fmu plan fit]

Each component sits in a plant that lets it matter and is driven by commands drawn from the seed.
`balance`: over 200 random motions, the largest part of what is exchanged that is missing in the
books of what the component conserves or loses (``balance.py``), and the least loss, in parts of the
largest. `fmu`: largest deviation of the FMU (FMI 2 and 3, Co-Simulation and Model Exchange) from a
simulation at 1e-11, in units of nominal. `plan`: the verdict of a motion. `fit`: the component's
own parameters from a noisy record, begun 20 to 40 % beside the truth: distance of the estimate
from the truth in standard deviations (2 is the end of the 95 % interval).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import balance as books
import casadi as ca
import harness
import numpy as np

import pam_ocp as pam
from pam_ocp.muscles.gas import Gas
from pam_ocp.muscles.heat import ConstantHeatTransfer, PressureHeatTransfer, Rubber

F, L = pam.feeds, pam.losses
MUSCLE = "DMSP-20-200N"
SMALL = F.Receiver(1e-3, source=F.Compressor(2e-4, pressure=7e5))
WARM = Gas(heat=ConstantHeatTransfer(40.0))
LAWS = pam.laws
LOSSES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "Coulomb friction": (L.CoulombFriction(30.0, excess=0.3, speed=5e-3), ("friction_constant",)),
    "Bouc-Wen": (L.BoucWen(), ("hysteresis_force", "hysteresis_yield")),
    "Maxwell-slip": (L.MaxwellSlip((8.0, 12.0), (0.004, 0.02)), ("slip1_force", "slip2_force")),
    "Prandtl-Ishlinskii": (
        L.PrandtlIshlinskii((10.0,), (6.0,), (0.01,)),
        ("play1_contracting", "play1_relaxing"),
    ),
    "creep": (L.Creep((500.0,), (0.5,)), ("creep1_stiffness", "creep1_time")),
    "creep under load": (
        L.LoadCreep((500.0,), (0.8,)),
        ("load_creep1_stiffness", "load_creep1_time"),
    ),
    "strand friction": (L.StrandFriction(speed=5e-3), ("strand_coefficient",)),
    "force-velocity": (L.ForceVelocity(), ("velocity_contracting",)),
    "preconditioning": (L.Preconditioning(), ("softening_stiffness",)),
    "directional damping": (
        L.DirectionalDamping([(200.0, 2e-4)], [(100.0, 1e-4)]),
        ("contracting1", "relaxing1"),
    ),
    "Bouc-Wen by pressure": (L.BoucWen(per_pressure=2e-6), ("hysteresis_force",)),
    "Maxwell-slip by pressure": (
        L.MaxwellSlip((6.0, 8.0), (0.004, 0.02), per_pressure=2e-6),
        ("slip1_force", "slip2_force"),
    ),
    "play by pressure": (
        L.PrandtlIshlinskii((8.0,), (5.0,), (0.01,), per_pressure=2e-6),
        ("play1_contracting", "play1_relaxing"),
    ),
}
FEEDS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "regulator": (
        F.Regulator(0.05, venting_lag=0.08, slew=6e6, dead_time=0.01),
        ("lag", "venting_lag"),
    ),
    "valve": (F.SpoolValve(leak=4e-10), ("gas.conductance", "gas.leak")),
    "heat": (F.SpoolValve(gas=WARM), ("gas.heat_transfer", "gas.conductance")),
    "heat by pressure, rubber": (
        F.SpoolValve(gas=Gas(heat=PressureHeatTransfer(), rubber=Rubber(20.0, stiffening=2e-3))),
        ("gas.conductance",),
    ),
    "warm supply": (
        F.SpoolValve(gas=WARM, supply_temperature=330.0),
        ("gas.supply_temperature", "gas.conductance"),
    ),
    "on/off valves": (F.OnOffValves(), ("gas.conductance",)),
    "unequal openings": (
        F.SpoolValve(exhaust_conductance=1.5e-8),
        ("gas.conductance", "gas.exhaust_conductance"),
    ),
    "meters": (F.SpoolValve(totals=True), ("gas.conductance",)),
    "receiver": (F.SpoolValve(supply=SMALL), ("receiver.volume",)),
    "receiver behind a regulator": (
        F.SpoolValve(
            supply=F.Receiver(5e-4, source=F.PressureRegulator(conductance=5e-9)), gas=WARM
        ),
        ("receiver.conductance",),
    ),
    "warm receiver": (
        F.SpoolValve(
            supply=F.Receiver(1e-3, source=F.Compressor(pressure=6e5), wall_conductance=1.0),
            gas=WARM,
        ),
        ("gas.conductance",),
    ),
    "tube": (F.SpoolValve(tube=F.Tube(2e-5, 0.01)), ("gas.tube_lag",)),
    "lumped tube": (F.SpoolValve(tube=F.LumpedTube(1.0, 4e-3, 2)), ("gas.tube_length",)),
    "first-order spool": (
        F.SpoolValve(spool=F.FirstOrderSpool(8e-3), offset=0.01),
        ("valve.time", "valve.offset"),
    ),
    "spool with play": (
        F.SpoolValve(spool=F.FirstOrderSpool(8e-3, hysteresis=0.02)),
        ("valve.time",),
    ),
    "second-order spool": (
        F.SpoolValve(spool=F.SecondOrderSpool(40.0), exhaust_overlap=0.05),
        ("valve.frequency",),
    ),
    "quick exhaust": (
        F.SpoolValve(tube=F.Tube(1e-5, 0.02), quick_exhaust=F.QuickExhaust()),
        ("gas.conductance",),
    ),
    "position feedback": (pam.plants.PositionFeedback(gain=5e5, lag=0.05), ("gain", "lag")),
    "servo valve": (F.ServoValve(command_lag=5e-3, leak=4e-10), ("pressure_gain", "command_lag")),
}
PLAIN = pam.muscle(MUSCLE)
BODIES: dict[str, tuple[pam.Muscle, tuple[str, ...]]] = {
    "body with mass": (replace(PLAIN, mass_per_length=0.4, end_mass=0.8), ("end_mass",)),
    "bladder": (replace(PLAIN, law=LAWS.with_bladder(PLAIN.law, 3e4)), ("threshold",)),
    "rigid ends": (
        replace(PLAIN, law=LAWS.with_ends(PLAIN.law, rigid=0.08, taper=1.03, tube=100.0)),
        ("rigid", "gas.conductance"),
    ),
    "two in parallel": (pam.muscles.in_parallel(PLAIN, 2), ("gas.conductance",)),
    "strength": (replace(PLAIN, burst_pressure=7e5, pull_off=1.2e3), ("gas.conductance",)),
}
SENSOR = pam.plants.Sensor(gain=1.1, zero=1e-3, filter=0.02)
FITTED = replace(PLAIN, mass_per_length=0.4, end_mass=0.8)
SHARED = F.Receiver(1e-3, source=F.Compressor(2e-4, pressure=7e5), wall_conductance=1.0)
PAIRS: dict[str, tuple[Callable[[], pam.Plant], tuple[str, ...]]] = {
    "body on a pulley": (
        lambda: pam.AntagonisticJoint(
            FITTED, moment_arm=0.03, link_mass=1.0, link_length=0.1, feed=F.Regulator(0.03)
        ),
        ("inertia", "muscle1.radius"),
    ),
    "body on a lever": (
        lambda: pam.AntagonisticJoint(
            FITTED, moment_arm=lambda angle: 0.03 * ca.cos(angle), feed=F.Regulator(0.03)
        ),
        ("inertia",),
    ),
    "shared receiver": (
        lambda: pam.AntagonisticSlide(
            PLAIN, damping=60.0, feed=F.SpoolValve(supply=SHARED, gas=WARM)
        ),
        ("receiver.volume",),
    ),
    "regulator of a pair": (
        lambda: pam.AntagonisticSlide(
            PLAIN, damping=60.0, feed=F.PairRegulator(0.05, venting_lag=0.08)
        ),
        ("muscle1.lag", "muscle1.venting_lag"),
    ),
}
QUICK = F.Regulator(0.03)
PARTS: dict[str, tuple[pam.Muscle, Any, Any, tuple[str, ...]]] = {
    **{n: (PLAIN, QUICK, loss, free) for n, (loss, free) in LOSSES.items()},
    **{n: (PLAIN, feed, None, free) for n, (feed, free) in FEEDS.items()},
    **{n: (muscle, F.SpoolValve(), None, free) for n, (muscle, free) in BODIES.items()},
    "sensor": (PLAIN, QUICK, None, ("x.filter", "x.gain")),
}
"""Muscle, feed and loss of a hanging load with the component, and what a fit frees, of the muscle
where it has that.
"""
COMPONENTS = [*LOSSES, *FEEDS, *BODIES, *PAIRS, "sensor"]
LIMIT = 600.0
"""Of a fit, by the clock, which a busy machine makes go fast [s]."""
FMU_TOLERANCE = 1e-8
"""Of Co-Simulation, for its states. Outputs may be steeper: as a slack muscle begins to pull, its
stiffness comes up within the slack width of 1 N, some 5 times nominal for a nominal of force.
"""
NOISE = {"m": 2e-5, "rad": 1e-4, "Pa": 500.0}
"""Of what a fit reads, by its unit."""


def built(name: str) -> tuple[pam.Plant, list[str]]:
    """The plant with the component, and the parameters that a fit frees."""
    if name in PAIRS:
        make, free = PAIRS[name]
        return make(), list(free)
    plant = load(name)[0]
    known = {v.name for v in plant.variables}
    return plant, [f"muscle.{n}" if f"muscle.{n}" in known else n for n in PARTS[name][-1]]


def load(name: str, change: Callable[[Any], Any] = lambda feed: feed) -> tuple[pam.Plant, Any]:
    """The hanging load with the component, and its feed, which may be another one's change."""
    muscle, feed, loss, _ = PARTS[name]
    feed, damping = change(feed), 100.0 if name in (*FEEDS, *BODIES) else 60.0
    plant = pam.HangingLoad(muscle, 10.0, damping=damping, feed=feed, losses=loss or ())
    if name == "sensor":
        plant.add_sensor("x", SENSOR)
    return plant, feed


def balance(name: str, draw: np.random.Generator, motions: int = 200) -> str:
    """The worst of each ledger over random motions."""
    sheet, found = accounted(name), {}
    for _ in range(motions):
        for closing in sheet.closed(*random_motion(sheet.plant, draw)):
            found.setdefault(closing.ledger, []).append(closing)
    words = []
    for ledger, all_of in found.items():
        missing, least = max(c.missing for c in all_of), min(c.least for c in all_of)
        open_books = "" if all(c.holds for c in all_of) else " DOES NOT CLOSE"
        words.append(f"{ledger} {missing:.0e} ({least:.0e}){open_books}")
    return "; ".join(words)


def accounted(name: str) -> books.Books:
    """The plant of a component with the books of all that it conserves or loses."""
    if name in PAIRS:
        plant = built(name)[0]
        return books.Books(plant, books.of_a_pair(plant))
    muscle, _, loss, _ = PARTS[name]
    plant, feed = load(name, books.with_heat)
    return books.Books(plant, books.ledgers(plant, muscle, feed, loss))


def random_motion(plant: pam.Plant, draw: np.random.Generator) -> tuple[Any, Any, float, int]:
    """Inputs, start, duration and samples of a motion under held random commands."""
    count, hold = int(draw.integers(2, 7)), float(draw.uniform(0.03, 0.15))
    levels = commands(plant, draw, count, 0.3)
    low, high = RANGES[pair(plant)]
    position, velocity = (v.name for v in plant.states[:2])
    start = {position: draw.uniform(low, high), velocity: draw.uniform(-0.1, 0.1)}
    pressure = draw.uniform(2e5, 4.5e5)
    for v in plant.states:
        if v.name.startswith("muscle") and "pressure" in v.name:
            start[v.name] = pressure
        if v.name == "muscle.reached":  # exercised at least to where it stands
            start[v.name] = draw.uniform(start["x"] / 0.2, 0.26)
    times = hold * np.arange(count + 1)  # the last sample only says where the last level ends
    inputs = {n: (times, np.append(column, column[-1])) for n, column in levels.items()}
    return inputs, start, hold * count, 40 * count + 1


RANGES = {False: (0.01, 0.045), True: (-0.015, 0.015)}
"""Of the position where a motion begins: of one muscle, of a pair."""


def pair(plant: pam.Plant) -> bool:
    """Whether two muscles pull against each other."""
    return any(v.name.startswith("muscle1.") for v in plant.variables)


def commands(
    plant: pam.Plant, draw: np.random.Generator, count: int, most: float
) -> dict[str, np.ndarray]:
    """Random levels of inputs: openings to ``most``, duties, pressures, references."""
    levels = {}
    for v in plant.inputs:
        if v.unit == "1":
            levels[v.name] = draw.uniform(most * max(v.min, -1.0), most, count)
        elif v.unit == "Pa":
            difference = (-1.2e5, 1.2e5)  # of two pressures
            low, high = difference if v.min < 0.0 else (1.2e5, 4.5e5)
            levels[v.name] = draw.uniform(low, high, count)
        elif v.unit == "m":
            levels[v.name] = draw.uniform(0.02, 0.04, count)
    return levels


def driven(
    plant: pam.Plant, draw: np.random.Generator, t: np.ndarray, hold: float
) -> tuple[pam.Trajectory, dict[str, np.ndarray]]:
    """A simulation under held random commands, and these."""
    each = round(hold / (t[1] - t[0]))
    levels = commands(plant, draw, -(-len(t) // each), 0.25)
    start = {} if pair(plant) else {"x": 0.03}
    for v in plant.states:
        if v.name.startswith("muscle") and "pressure" in v.name:
            start[v.name] = 3e5
    columns = {n: np.repeat(column, each)[: len(t)] for n, column in levels.items()}
    inputs = {n: (t, column) for n, column in columns.items()}
    return pam.simulate(plant, inputs, t=t, start=start, rtol=1e-11), columns


def fmu(name: str, draw: np.random.Generator) -> str:
    plant, _ = built(name)
    motion, _ = driven(plant, draw, np.linspace(0, 0.6, 61), 0.06)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for version in ("2.0", "3.0"):
            path = Path(folder) / f"unit{version[0]}.fmu"
            unit = pam.export_fmu(
                plant, path, platforms="native", fmi=version, tolerance=FMU_TOLERANCE
            )
            check = pam.check_fmu(unit, against=motion)
            found.append(f"{check.largest:.1e}" + (f" {check.findings}" if check.findings else ""))
    return " ".join(found)


def plan(name: str, draw: np.random.Generator) -> str:
    plant, _ = built(name)
    position, unit = plant.states[0].name, plant.states[0].unit
    stops = (0.025, draw.uniform(0.028, 0.036))
    if pair(plant):
        stops = (-0.005, draw.uniform(0.0, 0.005))
    scale = 10.0 if unit == "rad" else 1.0
    found = pam.plan(
        plant,
        stops=[{position: scale * float(stop)} for stop in stops],
        minimise="effort",
        duration=0.4,
        starts=1,
    )
    return str(found.verdict).splitlines()[0]


def fit(name: str, draw: np.random.Generator) -> str:
    plant, free = built(name)
    t = np.arange(0, 2.0, 0.01)
    run, columns = driven(plant, draw, t, 0.1)
    position, muscle = plant.states[0], "muscle1" if pair(plant) else "muscle"
    read = "x.measured" if name == "sensor" else position.name
    for measured, unit in ((read, position.unit), (f"{muscle}.pressure", "Pa")):
        columns[measured] = run[measured] + NOISE[unit] * draw.standard_normal(t.size)
    record = pam.Trajectory(t, columns, [plant.variable(n) for n in columns], "previous")
    truth = {n: float(plant.variable(n).start or 0.0) for n in free}
    beside = {
        n: v * float(draw.choice([0.65, 1.35])) if v else 0.1 * plant.variable(n).nominal
        for n, v in truth.items()
    }
    found = pam.fit_plant(plant.with_values(beside), record, free, time_limit=LIMIT)
    words = []
    for each, (low, high) in found.intervals().items():
        if each not in truth:
            continue
        middle, half = (low + high) / 2, (high - low) / 2
        off = (truth[each] - middle) / half * 1.96 if half else np.nan
        words.append(f"{each.removeprefix('muscle.')} {off:+.1f}s (+-{half / abs(middle):.1%})")
    ended = found.status in ("Solve_Succeeded", "Solved_To_Acceptable_Level")
    spent = "" if ended else f" [{found.status}]"
    return ", ".join(words) + spent


VERBS = {"balance": balance, "fmu": fmu, "plan": plan, "fit": fit}


def one(name: str, verb: str, seed: int) -> harness.Row:
    draw = np.random.default_rng([seed, sum(map(ord, name))])
    return {"text": VERBS[verb](name, draw)}


def cases(given: harness.Given) -> harness.Keyed:
    for name in COMPONENTS:
        for verb in given.verbs:
            yield f"{name}: {verb}", partial(one, name, verb, given.seed)


OPTIONS = {"--verbs": {"nargs": "+", "choices": VERBS, "default": list(VERBS)}}

if __name__ == "__main__":
    harness.main(__doc__, cases, options=OPTIONS)
