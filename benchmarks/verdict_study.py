"""Can a verdict be trusted? Random tasks at the default call, each verified plan replayed by SciPy.

A plan is right when SciPy's Radau (1e-9, started anew at every break of the inputs) meets its
states to the tolerance, and its bounds, path constraints, stops and rest hold between the points
too. Counted are verified plans, verified ones that SciPy contradicts (there must be none), plans
returned as unverified, refusals (all wrong, since each task is feasible by construction) and tasks
over the time limit. Times are those of the processor, all processes of a task together.

Run:  python benchmarks/verdict_study.py [tasks] [seed] [--first N] [--only N ...] [--limit SECONDS]
      [--own]
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import random_tasks
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.core.signals import signals

TOLERANCE = 1e-3
"""The default of plan, in units of nominal."""
MARGIN = 1.1
"""For the error of the replays themselves."""


def scipy_replay(plant, plan, samples=400):
    """(times, states, largest miss of the planned states in nominals) by SciPy from the plan's
    inputs.
    """
    planned = plan.trajectory
    names = [v.name for v in plant.states]
    nominal = plant.vector("state", attribute="nominal")
    p, inputs = plant.vector("parameter"), signals(plant, planned, planned.t)
    function, jacobians = plant.function, plant.jacobians
    breaks = np.unique(np.concatenate([[planned.t[0], planned.t[-1]], inputs.breaks]))
    breaks = breaks[(breaks >= planned.t[0]) & (breaks <= planned.t[-1])]
    x = planned.array(names)[0]
    times, states, worst = [], [], 0.0
    for begin, end in pairwise(breaks):
        if end - begin < 1e-12:
            continue

        def held(t, begin=begin, end=end):
            return inputs(min(max(t, begin), begin + (end - begin) * (1 - 1e-12)))[0]

        def rate(t, z, held=held):
            return np.asarray(function(z * nominal, held(t), p)[0], float).ravel() / nominal

        def slope(t, z, held=held):
            return np.asarray(jacobians(z * nominal, held(t), p)[0]) * nominal / nominal[:, None]

        inside = planned.t[(planned.t > begin + 1e-12) & (planned.t <= end + 1e-12)]
        dense = np.linspace(begin, end, max(3, int(samples * (end - begin) / planned.t[-1]) + 2))
        at = np.unique(np.clip(np.concatenate([dense, inside]), begin, end))
        found = solve_ivp(
            rate, (begin, end), x / nominal, "Radau", at, rtol=1e-9, atol=1e-9, jac=slope
        )
        if not found.success:
            return None, None, np.inf
        z = found.y.T
        if len(inside):
            rows = np.searchsorted(at, np.clip(inside, begin, end))
            planned_rows = np.searchsorted(planned.t, inside)
            miss = z[rows] - planned.array(names)[planned_rows] / nominal
            worst = max(worst, float(np.abs(miss).max()))
        times.append(at)
        states.append(z * nominal)
        x = z[-1] * nominal
    return np.concatenate(times), np.vstack(states), worst


def excess(plant, plan, t, states):
    """Largest violation of the plant's bounds and path constraints along a motion, in nominals."""
    p = plant.vector("parameter")
    u = signals(plant, plan.trajectory, t)(t)
    c = np.asarray(plant.function(states.T, u.T, p)[2], float).T
    worst, where = 0.0, ""
    for variables, values in (
        (plant.states, states),
        (plant.inputs, u),
        (plant.constraints, c),
    ):
        for i, v in enumerate(variables):
            if v.memory:
                continue
            over = np.max(np.maximum(v.min - values[:, i], values[:, i] - v.max)) / v.nominal
            if over > worst:
                worst, where = float(over), v.name
    return worst, where


def missed_stops(plant, plan, task, states):
    """Largest miss of the two stops' own values at the ends, in nominals (of tasks that are not
    cyclic: the end is stop 2).
    """
    p, worst = plant.vector("parameter"), 0.0
    ends = [(task.stops[0], 0)] + ([] if task.arguments.get("cyclic") else [(task.stops[1], -1)])
    for stop, row in ends:
        u = plan.trajectory.array([v.name for v in plant.inputs])[row]
        outputs = np.asarray(plant.function(states[row], u, p)[1], float).ravel()
        known = dict(zip([v.name for v in plant.states], states[row], strict=True))
        known |= dict(zip([v.name for v in plant.outputs], outputs, strict=True))
        for name, value in stop.items():
            worst = max(worst, abs(known[name] - value) / plant.variable(name).nominal)
    return worst


def drawn(index, seed, own):
    """The task of this number."""
    rng = np.random.default_rng([seed, index])
    return random_tasks.own_task(rng) if own else random_tasks.random_task(rng)


def spent():
    """Processor seconds of this process and of those it started."""
    each = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in each)


def judged(index, task):
    """One task: what plan says, and what SciPy says of it."""
    begin = spent()
    result = {"index": index, "words": f"{task.words}, {task.arguments}", "objective": np.nan}
    try:
        plan = pam.plan(task.plant, task.stops, **task.arguments)
    except pam.PamError as error:
        words = " ".join(str(error).split())[:300]
        return result | {"verdict": "refused", "seconds": spent() - begin, "why": words}
    seconds = spent() - begin
    t, states, miss = scipy_replay(task.plant, plan)
    beyond, where, stops = np.inf, "", np.inf
    if states is not None:
        beyond, where = excess(task.plant, plan, t, states)
        stops = missed_stops(task.plant, plan, task, states)
    right = max(miss, beyond, stops) <= MARGIN * TOLERANCE
    said = getattr(plan, "verified", plan.success)
    verdict = {
        (True, True): "verified",
        (True, False): "WRONGLY VERIFIED",
        (False, True): "unverified, but right",
        (False, False): "unverified",
    }[said, right]
    figures = f"T = {plan.duration:.5g} s, objective {plan.objective:.5g}, "
    figures += f"miss {miss:.1e}, beyond {beyond:.1e} {where}, stops {stops:.1e}"
    if not said:
        figures += f"; {getattr(plan, 'verdict', '')}"
    return result | {
        "verdict": verdict,
        "seconds": seconds,
        "why": figures,
        "objective": plan.objective,
    }


def _child(connection, index, seed, own):
    os.setsid()  # the processes that it starts are counted with it
    warnings.simplefilter("ignore")
    try:
        task = drawn(index, seed, own)
        connection.send(f"{task.words}, {task.arguments}")
        connection.send(judged(index, task))
    except Exception as error:  # a raw exception is a finding of its own
        connection.send(
            {
                "index": index,
                "verdict": "RAISED",
                "seconds": np.nan,
                "words": "",
                "why": f"{type(error).__name__}: {error}",
            }
        )


def spent_by(session):
    """Processor seconds of all processes of a session, those that have ended and were waited for
    included.
    """
    ticks = 0
    for each in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = each.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == session:
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def limited(index, seed, own, limit):
    """``judged`` in a process of its own, given up after ``limit`` seconds of the processor."""
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(
        target=_child, args=(there, index, seed, own)
    )
    process.start()
    there.close()
    result = {"index": index, "verdict": "over time", "seconds": limit, "words": "", "why": ""}
    while True:
        if not here.poll(0.2):
            if spent_by(process.pid) > limit:
                break
            continue
        try:
            message = here.recv()
        except EOFError:
            result["verdict"] = "DIED"
            break
        if isinstance(message, dict):
            result = message
            break
        result["words"] = message
    process.terminate()
    process.join(5)
    if process.is_alive():
        process.kill()
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=150)
    parser.add_argument("seed", nargs="?", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", nargs="*", type=int, default=[], help="numbers of tasks")
    parser.add_argument(
        "--limit", type=float, default=180.0, help="seconds of the processor for each task"
    )
    parser.add_argument("--own", action="store_true", help="only plants of one's own")
    arguments = parser.parse_args()
    results = []
    numbers = range(arguments.first, arguments.first + arguments.count)
    for index in arguments.only or numbers:
        result = limited(index, arguments.seed, arguments.own, arguments.limit)
        results.append(result)
        print(
            f"{index:4d} {result['verdict']:22s} {result['seconds']:6.1f} s  {result['words']}\n"
            f"       {result['why']}",
            flush=True,
        )
    seconds = np.array([r["seconds"] for r in results])
    for verdict in sorted({r["verdict"] for r in results}):
        count = sum(r["verdict"] == verdict for r in results)
        print(f"{count:4d} of {len(results)} {verdict}")
    print(f"seconds a task: median {np.nanmedian(seconds):.2f}, worst {np.nanmax(seconds):.1f}")


if __name__ == "__main__":
    main()
