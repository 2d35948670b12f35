"""How often the planner finds a motion from its own first guess, what it says when there is none,
and whether other starts lead to other motions.

    python benchmarks/plan_study.py [tasks] [seed]
    python benchmarks/plan_study.py [tasks] [seed] --optima [--valves]

Random tasks of ``random_tasks.py`` with pressure regulators, feasible by statics, by methods drawn
as well; the time is free up to 10 s. A fifth as many infeasible ones: what is named as the conflict
is widened by what is said to be missing, and then a motion must exist.

--optima: minimum-time tasks alone, each from twelve starts (two first guesses, states held or
running between the equilibria; three durations; two barrier strategies): how far the plan from the
planner's own start is above the best of them, and the better of the first two. --valves: tasks with
valves, on the mesh that was asked for; no least work, air or exergy, no loads on tendons.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import harness
import numpy as np
import random_tasks

import pam_ocp as pam
from pam_ocp.planning.solvers.diagnosis import elastic
from pam_ocp.planning.solvers.solver import Ipopt
from pam_ocp.planning.starts import in_series

TOLERANCE = 1e-3
"""Of the plans' verdicts, in units of nominal."""
KINDS = ("no time", "no pressure", "place taken", "no budget")
Task = random_tasks.Task
Draw = np.random.Generator


def random_task(rng: Draw, makers: dict[Any, float] = random_tasks.MAKERS) -> Task:
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


def infeasible_task(rng: Draw, kind: str) -> Task:
    """One of four kinds of tasks that cannot be."""
    while True:
        hanging: dict[str, Any] = {"makers": {random_tasks.single: 1}}
        task = random_task(rng, **(hanging if kind == "no pressure" else {}))
        task.arguments.pop("minimise", None)
        name, goal = next(iter(task.stops[1].items()))
        if kind == "no time":
            task.arguments["duration"] = 0.012
        elif kind == "no pressure":
            pressure = balancing_pressure(task)
            if pressure is None:
                continue
            task.arguments["bounds"] = {"muscle.pressure": (None, 0.7 * pressure)}
        elif kind == "place taken":
            half = 0.2 * abs(goal - next(iter(task.stops[0].values())))
            task.arguments["constraints"] = [pam.Avoid({name: (goal, half)})]
        else:  # no budget
            task.arguments["budgets"] = {"effort": 1e-4}
        task.words = f"{kind}: {task.words}"
        return task


def balancing_pressure(task: Task) -> float | None:
    """What holds a hanging load at the higher stop; None where none does, or it is no such load."""
    commands = {v.name for v in task.plant.inputs}
    if task.plant.name != "hanging_load" or "muscle.command" not in commands:
        return None
    point = max(next(iter(s.values())) for s in task.stops)
    try:
        return float(task.plant.equilibrium(x=point)["muscle.pressure"])
    except pam.operating.EquilibriumError:
        return None


def solve(task: Task) -> tuple[pam.planning.Plan | None, pam.PlanError | None]:
    try:
        return pam.plan(task.plant, task.stops, **task.arguments), None
    except pam.PlanError as error:
        return None, error


def conflict_is_true(error: Any) -> bool | None:
    """Whether a motion exists once the named constraints are widened by what is said to be
    missing.
    """
    failed, wider = error.plan, {}
    program = failed._solved.program
    for conflict in failed.conflicts:
        if conflict.condition is None:
            return None
        wider[conflict.label] = (1.02 * conflict.excess + 1e-5) * conflict.condition.nominal

    def widened(condition: Any) -> Any:
        margin = wider.get(condition.label, 0.0)
        return replace(condition, low=condition.low - margin, high=condition.high + margin)

    rows = tuple(
        replace(r, conditions=tuple(widened(c) for c in r.conditions)) for r in program.rows
    )
    program = replace(program, rows=rows)
    end = elastic(program, failed._solved.outcome.w, None)
    return bool(end.feasible or Ipopt(program)(program, end.w).success)


# ---- the study -----------------------------------------------------------------------------------
def feasible(task: Task) -> harness.Row:
    plan, error = solve(task)
    row: harness.Row = {"text": task.words, "kind": "feasible"}
    if plan is None:
        return {**row, "verdict": "FAILED", "why": [str(error)]}
    if plan.verified:
        return {**row, "verdict": "verified"}
    words = f"replay {plan.replay_error:.1e}, violation {plan.replay.violation:.1e} of nominal"
    return {**row, "verdict": "UNVERIFIED", "why": [words]}


def infeasible(task: Task) -> harness.Row:
    plan, error = solve(task)
    row: harness.Row = {"text": task.words, "kind": "infeasible"}
    if plan is not None:
        return {**row, "verdict": "SOLVED", "why": [f"in {plan.duration} s"]}
    verdict = "true conflict" if conflict_is_true(error) else "UNCLEAR"
    return {**row, "verdict": verdict, "why": [str(error)]}


def optima(task: Task) -> harness.Row:
    limited = {"tolerance": None, "time_limit": 90.0} if task.plant.openings else {}
    plan = pam.plan(task.plant, task.stops, **(task.arguments | limited), starts=12)
    ends = plan.statistics["starts"]  # the planner's own first
    values = [end["objective"] for end in ends if end["solved"]]
    gap, two = (
        min((e["objective"] for e in ends[:n] if e["solved"]), default=np.inf) / min(values) - 1
        for n in (1, 2)
    )
    feed = "valve" if task.plant.openings else "regulator"
    words = task.words.split(", {")[0]
    text = f"{len(values)} of {len(ends)} starts solved; first {gap:.1e}, first two {two:.1e} above"
    return {"verdict": feed, "gap": gap, "text": f"{text} {min(values):.6g}: {words}"}


def with_valves(rng: Draw) -> Task:
    """A random feasible task of ``random_tasks.py`` with valves."""
    while True:
        task = random_tasks.random_task(rng)
        terms = task.arguments.get("minimise", "time")
        costly = {"work", "air", "exergy"} & {*([terms] if isinstance(terms, str) else terms)}
        if task.plant.openings and not costly and not in_series(task.plant):
            return task


def cases(given: harness.Given) -> harness.Keyed:
    rng = np.random.default_rng(given.seed)
    if given.optima:
        number = 0
        while number < given.count:
            task = with_valves(rng) if given.valves else random_task(rng)
            task.arguments.pop("tolerance", None)
            if given.valves or "minimise" not in task.arguments:
                yield number, partial(optima, task)
                number += 1
        return
    for number in range(given.count):
        yield number, partial(feasible, random_task(rng))
    for number in range(max(given.count // 5, 4)):
        kind = KINDS[number % len(KINDS)]
        yield f"{kind} {number}", partial(infeasible, infeasible_task(rng, kind))


def summary(rows: list[harness.Row]) -> str:
    gaps = [r["gap"] for r in rows if "gap" in r]
    if gaps:
        return f"at most {max(gaps):.1e} above the best of the starts"
    seconds = [r["clock"] for r in rows if r.get("kind") == "feasible"]
    return f"feasible: median {np.median(seconds):.2f} s, longest {max(seconds):.2f} s"


OPTIONS = {
    "--optima": harness.flag("twelve starts for each task"),
    "--valves": harness.flag("of tasks with valves"),
}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=100, seed=1, options=OPTIONS)
