"""From closed rest, on all feeds that there are: do LQR, its trajectory and Mpc arrive?

Draws from the registry of feeds, each with random options (overlaps of either side, offset, spools
of first and second order with and without hysteresis, tubes, quick exhausts, receivers, leaks, dead
times), and a feed of one's own; random muscles, masses and set points of a hanging load, a spring,
a slide and a joint. Figures: the largest distance from the set point over the last 0.1 s of a run
of 1.5 s (Mpc 1 s), as a part of the way, in percent. Wanted is 1 % of the stroke, or one sentence
(an error or a warning) that says why not: such cases show "said", and the sentence below; "SILENT"
and "TWICE" are what must not be.

    python benchmarks/valve_study.py [cases] [seed]
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import casadi as ca
import harness
import numpy as np

import pam_ocp as pam
from pam_ocp.control import closed_loop
from pam_ocp.plants.kinds import FEEDS

KINDS = ("hanging", "spring", "slide", "joint")
LOOPS = ("lqr", "tvlqr", "Mpc")
STEP = 4e-3
"""Sample time of state feedback [s]; of Mpc 0.01."""
WANTED = 0.01
LIMIT = 45.0
"""[s] of a run; stiff plants that chatter end there, and say so."""


class OwnSpool(pam.feeds.SpoolValve):
    """A feed of one's own: its spool is two lags in a row, its dead zone is declared."""

    def openings(self, plant: Any, name: str) -> tuple[ca.SX, ca.SX]:
        command = plant.input(f"{name}.command", min=-1.0, max=1.0, nominal=0.1)
        moved = command
        for part in ("coil", "slide"):
            state = plant.state(f"{name}.{part}", min=-1.5, max=1.5, memory="settling")
            plant.der(state, (moved - state) / 4e-3)
            moved = state
        effect = plant.dead_zone(moved, 0.1, f"{name}.effect")
        return ca.fmax(effect, 0), ca.fmax(-effect, 0)


def of_gas(rng: np.random.Generator) -> dict[str, Any]:
    """Random options of every feed that knows the gas."""
    options: dict[str, Any] = {}
    if rng.random() < 0.3:
        options["tube"] = pam.feeds.Tube()
        if rng.random() < 0.4:
            options["quick_exhaust"] = pam.feeds.QuickExhaust()
    if rng.random() < 0.15:
        options["supply"] = pam.feeds.Receiver(5e-3)
    if rng.random() < 0.2:
        options["leak"] = 2e-11
    return options


def of_spool(rng: np.random.Generator) -> dict[str, Any]:
    """Random options of a proportional valve."""
    options: dict[str, Any] = {"overlap": float(rng.choice([0.0, 0.02, 0.05, 0.1]))}
    if rng.random() < 0.2:
        options["exhaust_overlap"] = 0.04
    if rng.random() < 0.2:
        options["offset"] = 0.03
    hysteresis = float(rng.choice([0.0, 0.0, 0.004, 0.05]))
    spool = rng.choice(["none", "first", "second"])
    if spool == "first":
        lag = float(rng.choice([2e-3, 5e-3, 2e-2]))
        options["spool"] = pam.feeds.FirstOrderSpool(lag, hysteresis)
    elif spool == "second":
        options["spool"] = pam.feeds.SecondOrderSpool(
            float(rng.choice([30.0, 60.0, 100.0])), hysteresis=hysteresis
        )
    return options


def of_regulator(rng: np.random.Generator) -> dict[str, Any]:
    options: dict[str, Any] = {"lag": float(rng.choice([0.05, 0.15]))}
    if rng.random() < 0.4:
        options["dead_time"] = 0.01
    if rng.random() < 0.3:
        options["slew"] = 3e6
    return options


def fed(rng: np.random.Generator, kind: str, pair: bool) -> Any:
    """A random feed of a registered kind (of two muscles: ``pair``)."""
    if kind == "own":
        return OwnSpool(**of_gas(rng))
    if kind in ("SpoolValve", "ServoValve"):
        return FEEDS[kind](**of_gas(rng), **of_spool(rng))
    if kind == "OnOffValves":
        return FEEDS[kind](**of_gas(rng))
    if kind in ("Regulator", "PairRegulator"):
        return FEEDS[kind if pair else "Regulator"](**of_regulator(rng))
    return FEEDS[kind]()


def drawn(rng: np.random.Generator, case: int) -> tuple[str, pam.Plant, str, Any, Any]:
    """(words, plant, position, closed rest, set point), a way of 10 to 40 % of what there is."""
    kinds = [*FEEDS, "own", "SpoolValve", "ServoValve"]  # those with most options twice
    load, kind = KINDS[case % 4], kinds[int(rng.integers(len(kinds)))]
    feed = fed(rng, kind, load in ("slide", "joint"))
    name = str(rng.choice(["DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300"]))
    words, muscle = f"{load}, {name}, {_said(feed)}", pam.muscle(name)
    if load in ("hanging", "spring"):
        plant: pam.Plant = (
            pam.HangingLoad(muscle, rng.uniform(8, 30), feed=feed)
            if load == "hanging"
            else pam.SpringOverMuscle(muscle, rng.uniform(1, 4), feed=feed)
        )
        low, high = np.sort(rng.uniform(1.5e5, 4.5e5, 2))
        ends = (
            plant.equilibrium({"muscle.pressure": p, **_references(plant)})
            for p in (low, max(high, low + 5e4))
        )
        return words, plant, "x", *ends
    if load == "slide":
        plant = pam.AntagonisticSlide(muscle, rng.uniform(1, 6), feed=feed)
        x, unit = "x", 0.02 * muscle.rest_length
    else:
        plant = pam.AntagonisticJoint(
            muscle, link_mass=rng.uniform(0.5, 2), link_length=0.2, feed=feed
        )
        x, unit = "theta", 0.2
    start, goal = rng.uniform(-1, -0.2) * unit, rng.uniform(0.2, 1) * unit
    mean = rng.uniform(2.0e5, 3.2e5)
    more = _references(plant)
    if len([v for v in plant.in_openings().inputs if not v.disturbance]) > 1:
        both = plant.equilibrium({"muscle1.pressure": mean, "muscle2.pressure": mean, **more})
        more["stiffness"] = both["stiffness"]
    ends = (plant.equilibrium({x: at, **more}) for at in (start, goal))
    return words, plant, x, *ends


def _said(feed: Any) -> str:
    plain = type(feed)() if not isinstance(feed, OwnSpool) else OwnSpool()
    options = {n: v for n, v in vars(feed).items() if v != vars(plain)[n] and n != "gas"}
    return f"{type(feed).__name__}({', '.join(f'{n}={v}' for n, v in options.items())})"


def _references(plant: pam.Plant) -> dict[str, float]:
    """Conditions for the inputs that a feed has besides a pressure."""
    return {v.name: 0.01 for v in plant.inputs if v.name.endswith(".reference")}


def missed(run: pam.Trajectory, x: str, start: Any, goal: Any) -> float:
    late = run.t >= run.t[-1] - 0.1
    return float(np.abs(run[x][late] - goal[x]).max() / abs(goal[x] - start[x]))


def answered(attempt: Callable[[], tuple[Any, float]]) -> tuple[Any, float, list[str]]:
    """(what a controller's run gives, what it misses, the sentences that were said)."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            found, error = attempt()
        except (pam.PamError, ValueError) as refused:
            return None, np.inf, [str(refused)]
    return found, error, [str(w.message) for w in given]


def runs(plant: pam.Plant, x: str, start: Any, goal: Any) -> list[tuple[float, list[str]]]:
    """(miss, sentences) of LQR, of its trajectory from a tenth of the way beside it, of Mpc."""
    begin = {v.name: start[v.name] for v in plant.states}
    loop: dict[str, Any] = {"duration": 1.5, "sample_time": STEP, "rtol": 1e-6, "time_limit": LIMIT}

    def still() -> tuple[Any, float]:
        law = pam.lqr(plant, goal, sample_time=STEP, sampled=True)
        motion = closed_loop(law, plant, start=begin, **loop).trajectory
        return motion, missed(motion, x, start, goal)

    def along() -> tuple[Any, float]:
        times = np.linspace(0, 1.5, 151)
        law = pam.control.tvlqr(plant, motion, t=times, sample_time=STEP, sampled=True)
        beside = begin | {x: begin[x] + 0.1 * (goal[x] - start[x])}
        run = closed_loop(law, plant, start=beside, **loop).trajectory
        return None, missed(run, x, start, {x: motion[x][-1]})

    def led() -> tuple[Any, float]:
        pair = "stiffness" in [v.name for v in plant.outputs] and len(plant.inputs) > 1
        track = {x: 1.0} | ({"stiffness": 0.05} if pair else {})
        rate = {v.name: 0.05 for v in plant.inputs}
        mpc = pam.Mpc(plant, horizon=20, sample_time=0.01, track=track, rate=rate)
        run = mpc.closed_loop(
            plant, {n: goal[n] for n in track}, 1.0, start=begin, rtol=1e-6, time_limit=LIMIT
        )
        return None, missed(run.trajectory, x, start, goal)

    motion, first, said = answered(still)
    found = [(first, said)]
    if motion is not None and first < WANTED:
        found.append(answered(along)[1:])
    else:
        found.append((np.nan, []))  # no motion to go along
    return [*found, answered(led)[1:]]


def one(words: str, plant: pam.Plant, x: str, start: Any, goal: Any) -> harness.Row:
    """How each controller ends: within, said, SILENT or TWICE, and the part of the way missed."""
    kinds, shown, sentences = {}, [], []
    for name, (miss, said) in zip(LOOPS, runs(plant, x, start, goal), strict=True):
        if np.isnan(miss):
            continue
        sentences += [f"{name}: {s}" for s in said]
        within = miss < WANTED
        kinds[name] = "within" if within else {0: "SILENT", 1: "said"}.get(len(said), "TWICE")
        shown.append(f"{name} {100 * miss:.3f} %" if within else f"{name} {kinds[name]}")
    text = f"{', '.join(shown)}; {start[x]:.4g} to {goal[x]:.4g}, {words}"
    return {"kinds": kinds, "text": text, "why": sentences}


def no_rest(error: pam.PamError) -> harness.Row:
    return {"verdict": "no rest", "why": [str(error)]}


def cases(given: harness.Given) -> harness.Keyed:
    rng = np.random.default_rng(given.seed)
    for case in range(given.count):
        try:
            yield case, partial(one, *drawn(rng, case))
        except pam.PamError as error:
            yield case, partial(no_rest, error)


def counted(rows: list[harness.Row]) -> dict[str, Counter[str]]:
    """By controller: how many ended in which way."""
    return {n: Counter(r["kinds"][n] for r in rows if n in r.get("kinds", {})) for n in LOOPS}


def summary(rows: list[harness.Row]) -> str:
    ways = ("within", "said", "SILENT", "TWICE")
    lines = [[name, *(counts[w] for w in ways)] for name, counts in counted(rows).items()]
    return harness.table(("controller", *ways), lines)


if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=24, seed=1)
