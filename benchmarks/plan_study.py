"""How often the planner finds a motion from its own first guess, and what it says when there is
none.

100 random tasks that are feasible by construction: along the whole way a point of rest exists with
every muscle taut and every pressure inside its range (found here by SciPy on the force law alone),
and the time is free up to 10 s. 20 infeasible ones: what is named as the conflict is widened by
what is said to be missing, and then a motion must exist.

Run:  python benchmarks/plan_study.py [number of tasks] [seed]
"""

import sys
import time
import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp.planning.solvers.diagnosis import elastic
from pam_ocp.planning.solvers.solver import Ipopt

MUSCLES = ("DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300", "DMSP-10-250", "DMSP-20-300-wall")
GRAVITY = 9.80665
TOLERANCE = 1e-3
"""Of the plans' verdicts, in units of nominal."""
MARGIN = 0.05
"""Of the pressure range, kept free at the points of rest."""


@dataclass
class Task:
    """A plant and the arguments of plan."""

    words: str
    plant: pam.Plant
    stops: list
    arguments: dict


def balancing(muscle, contraction, force):
    """The gauge pressure at which a muscle pulls with ``force``, or None outside its range."""
    low, high = muscle.pressure_range
    low, high = (max(low, 0.0) + MARGIN * high, high * (1 - MARGIN))

    def excess(pressure):
        return float(muscle.tension(pressure, contraction)) - force

    if excess(low) > 0 or excess(high) < 0:
        return None
    return brentq(excess, low, high)


def pairs_balance(first, second, kappa1, kappa2, ratio=1.0):
    """Whether two muscles against each other can both pull with the same torque, taut."""
    for pull in np.geomspace(10.0, 1500.0, 30):
        pressures = (balancing(first, kappa1, pull), balancing(second, kappa2, pull * ratio))
        if None not in pressures:
            return True
    return False


def feed(rng, muscle):
    """A pressure regulator, or now and then a spool valve with its gas."""
    if muscle.diameter is not None and rng.random() < 0.15:
        return pam.feeds.SpoolValve()
    limit = None if rng.random() < 0.6 else rng.uniform(1e6, 6e6)
    return pam.feeds.Regulator(lag=rng.uniform(0.03, 0.15), max_rate=limit)


def way(a, b):
    return np.linspace(a, b, 9)


def hanging(rng, muscle):
    mass = rng.uniform(1.0, 25.0)
    x = rng.uniform(0.0, 0.25, 2) * float(muscle.rest_length)
    if any(
        balancing(muscle, s / float(muscle.rest_length), mass * GRAVITY) is None for s in way(*x)
    ):
        return None
    return pam.HangingLoad(muscle, mass, feed=feed(rng, muscle)), "x", x, f"{mass:.1f} kg hanging"


def sprung(rng, muscle):
    mass, spring, preload = rng.uniform(0.5, 5), rng.uniform(1e3, 1e4), rng.uniform(20, 150)
    x = rng.uniform(0.0, 0.2, 2) * float(muscle.rest_length)
    for s in way(*x):
        if balancing(muscle, s / float(muscle.rest_length), preload + spring * s) is None:
            return None
    plant = pam.SpringOverMuscle(muscle, mass, spring, preload, feed=feed(rng, muscle))
    return plant, "x", x, f"{mass:.1f} kg against a spring"


def slide(rng, muscle):
    mass, k0 = rng.uniform(0.5, 10.0), rng.uniform(0.06, 0.14)
    other = muscle if rng.random() < 0.6 else pam.muscle(str(rng.choice(MUSCLES)))
    length, other_length = float(muscle.rest_length), float(other.rest_length)
    x = rng.uniform(-0.08, 0.08, 2) * min(length, other_length)
    for s in way(*x):
        if not pairs_balance(muscle, other, k0 + s / length, k0 - s / other_length):
            return None
    plant = pam.AntagonisticSlide(muscle, mass, k0, muscle2=other, feed=feed(rng, muscle))
    return plant, "x", x, f"{mass:.1f} kg on a slide"


def joint(rng, muscle):
    inertia, arm = rng.uniform(0.01, 0.2), rng.uniform(0.02, 0.05)
    length = float(muscle.rest_length)
    reach = 0.09 * length / arm
    angle = rng.uniform(-reach, reach, 2)
    for s in way(*angle):
        bend = arm * s / length
        if not pairs_balance(muscle, muscle, 0.125 + bend, 0.125 - bend):
            return None
    plant = pam.AntagonisticJoint(muscle, inertia, arm, feed=feed(rng, muscle))
    return plant, "theta", angle, f"{inertia:.2f} kg m2 on a joint"


def random_task(rng):
    """A random feasible task (draws anew until one is)."""
    while True:
        muscle = pam.muscle(str(rng.choice(MUSCLES)))
        maker = rng.choice([hanging, sprung, slide, joint])
        try:
            made = maker(rng, muscle)
        except pam.InputError:  # a stroke outside the muscles' measured range
            continue
        if made is None:
            continue
        plant, name, (a, b), words = made
        variable = plant.variable(name)
        if not all(variable.min <= s <= variable.max for s in (a, b)) or abs(b - a) < 2e-3:
            continue
        arguments = {"cyclic": bool(rng.random() < 0.4), "tolerance": TOLERANCE}
        if rng.random() < 0.3:
            arguments |= {"duration": 2.0, "minimise": "effort"}
        arguments["method"] = (
            pam.Collocation(int(rng.integers(20, 60)), 3)
            if rng.random() < 0.6
            else pam.Collocation(int(rng.integers(5, 10)), 8, "polynomial")
        )
        feed_words = "valve" if plant.inputs[0].min < 0 else "regulator"
        words = f"{muscle.name}, {words}, {feed_words}, {arguments}"
        return Task(words, plant, [{name: float(a)}, {name: float(b)}], arguments)


def infeasible_task(rng, kind):
    """One of four kinds of tasks that cannot be."""
    while True:
        task = random_task(rng)
        task.arguments.pop("minimise", None)
        name, goal = next(iter(task.stops[1].items()))
        if kind == "no time":
            task.arguments["duration"] = 0.012
        elif kind == "no pressure":
            if task.plant.name != "hanging_load" or "muscle.command" not in {
                v.name for v in task.plant.inputs
            }:
                continue
            muscle_force = balancing_pressure(task)
            if muscle_force is None:
                continue
            task.arguments["bounds"] = {"muscle.pressure": (None, 0.7 * muscle_force)}
        elif kind == "place taken":
            half = 0.2 * abs(goal - next(iter(task.stops[0].values())))
            task.arguments["constraints"] = [pam.Avoid({name: (goal, half)})]
        else:  # no budget
            task.arguments["budgets"] = {"effort": 1e-4}
        task.words = f"{kind}: {task.words}"
        return task


def balancing_pressure(task):
    """What holds the hanging load at the higher stop."""
    point = max(next(iter(s.values())) for s in task.stops)
    plant = task.plant
    values = {v.name: v.start for v in plant.parameters}
    try:
        rest = plant.equilibrium(x=point)
    except pam.EquilibriumError:
        return None
    return rest["muscle.pressure"] if values else None


def solve(task):
    try:
        return pam.plan(task.plant, task.stops, **task.arguments), None
    except pam.PlanError as error:
        return None, error


def conflict_is_true(error):
    """Whether a motion exists once the named constraints are widened by what is said to be
    missing.
    """
    failed = error.plan
    program = failed._solved.program
    wider = {}
    for conflict in failed.conflicts:
        if conflict.condition is None:
            return None
        margin = (
            1.02 * conflict.excess * conflict.condition.nominal + 1e-5 * conflict.condition.nominal
        )
        wider[conflict.label] = margin

    def widened(condition):
        margin = wider.get(condition.label)
        if margin is None:
            return condition
        return replace(condition, low=condition.low - margin, high=condition.high + margin)

    rows = tuple(
        replace(r, conditions=tuple(widened(c) for c in r.conditions)) for r in program.rows
    )
    program = replace(program, rows=rows)
    guess = failed._solved.outcome.w
    ipopt = Ipopt(program)
    end = elastic(program, guess, None)
    return end.feasible or ipopt(program, end.w).success


def main(count=100, seed=1):
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(seed)
    solved, times, doubtful = 0, [], []
    for i in range(count):
        task = random_task(rng)
        begin = time.perf_counter()
        plan, error = solve(task)
        times.append(time.perf_counter() - begin)
        if (i + 1) % 10 == 0:
            print(f"{i + 1} tasks done", flush=True)
        if plan is None:
            print(f"{i:3d} FAILED {task.words}\n    {error}", flush=True)
            continue
        solved += 1
        if not plan.verified:
            doubtful.append((i, plan.replay_error, plan.replay.violation, task.words))
    print(
        f"{solved} of {count} solved, {solved - len(doubtful)} verified by replay; median "
        f"{np.median(times):.2f} s, longest {max(times):.2f} s"
    )
    for i, deviation, violation, words in doubtful:
        print(f"{i:3d} replay {deviation:.1e}, violation {violation:.1e} of nominal: {words}")
    true = 0
    kinds = ("no time", "no pressure", "place taken", "no budget")
    total = max(count // 5, 4)
    for i in range(total):
        task = infeasible_task(rng, kinds[i % len(kinds)])
        plan, error = solve(task)
        if plan is not None:
            print(f"{i:3d} SOLVED {task.words}: {plan.duration}")
            continue
        verdict = conflict_is_true(error)
        true += bool(verdict)
        print(f"{i:3d} {'true' if verdict else 'UNCLEAR'}: {task.words}\n    {error}", flush=True)
    print(f"{true} of {total} infeasible tasks name a conflict that is one")
    return solved, true


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))
