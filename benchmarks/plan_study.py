"""How often the planner finds a motion from its own first guess, and what it says when there is
none.

100 random tasks of ``random_tasks.py`` with pressure regulators, feasible by statics, on methods
drawn as well; the time is free up to 10 s. 20 infeasible ones: what is named as the conflict is
widened by what is said to be missing, and then a motion must exist.

Run:  python benchmarks/plan_study.py [number of tasks] [seed]
"""

import sys
import time
import warnings
from dataclasses import replace

import numpy as np
import random_tasks

import pam_ocp as pam
from pam_ocp.planning.solvers.diagnosis import elastic
from pam_ocp.planning.solvers.solver import Ipopt

TOLERANCE = 1e-3
"""Of the plans' verdicts, in units of nominal."""


def random_task(rng, makers=random_tasks.MAKERS):
    """A random feasible task of ``random_tasks.py`` with pressure regulators, from stop to stop in
    least time, or in 2 s with least effort.
    """
    while True:
        task = random_tasks.random_task(rng, makers)
        regulated = all(v.name.endswith(".command") and v.unit == "Pa" for v in task.plant.inputs)
        plain = all(isinstance(stop, dict) for stop in task.stops) and len(task.stops) == 2
        memory = any(v.memory for v in task.plant.states)
        if not (regulated and plain) or memory:
            continue
        cyclic = task.arguments.get("cyclic", False)
        task.arguments = {"cyclic": cyclic, "tolerance": TOLERANCE}
        if rng.random() < 0.3:
            task.arguments |= {"duration": 2.0, "minimise": "effort"}
        task.arguments["method"] = (
            pam.Collocation(int(rng.integers(20, 60)), 3)
            if rng.random() < 0.6
            else pam.Collocation(int(rng.integers(5, 10)), 8, "polynomial")
        )
        task.words = f"{task.words}, {task.arguments}"
        return task


def infeasible_task(rng, kind):
    """One of four kinds of tasks that cannot be."""
    while True:
        hanging = {"makers": {random_tasks.single: 1}} if kind == "no pressure" else {}
        task = random_task(rng, **hanging)
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
    except pam.operating.EquilibriumError:
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
