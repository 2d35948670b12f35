"""pam_ocp at each task: ``plan held|fine|high``, ``fit FILE``, ``simulate [compiled]``."""

import json
import sys
from pathlib import Path
from time import perf_counter

import equations as e
import numpy as np

import pam_ocp as pam

sys.path.append(str(Path(__file__).resolve().parents[1]))
from pam_2dir import slide

METHODS = {
    "held": (pam.Collocation(e.INTERVALS, 3), "50 x 3, constant input"),
    "fine": (pam.Collocation(e.INTERVALS, 4), "50 x 4, constant input"),
    # the peers do not look at inputs between their points either
    "high": (pam.Collocation(6, 9, "polynomial", guarded=False), "6 x 9, input at the points"),
}
SIZE = np.array([1, 1, 1e5, 1e5])
"""Of the states, in SI; pressures are in bar in the tasks."""


def plan(kind="held"):
    """The planner, from its own guess."""
    method, name = METHODS[kind]
    begin = e.clock()
    plant, stops, solves = slide(), [{"x": -e.STOP}, {"x": e.STOP}], []

    def planned():
        ready, wall = e.clock(), perf_counter()
        found = pam.plan(plant, stops, cyclic="mirrored", method=method)
        part = (e.clock() - ready) / (perf_counter() - wall)
        # it tells the solver's seconds by the clock: the processor's are the same part of the call
        solves.append(found.statistics["solve_seconds"] * part)
        return found

    first, _, found = e.repeated(planned, begin)
    t, degree = found.trajectory, method.degree
    ends = t.t[::degree]
    # the input is a polynomial in each interval: of degree 0, or through the collocation points
    count = 1 if method.control == "constant" else degree
    points = (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2
    times = ends[:-1, None] + np.diff(ends)[:, None] * points
    within = 1e-5 * t.at(times.ravel()).array(t.named("input"))
    e.report(
        f"pam_ocp: {name}",
        first,
        min(solves),
        found.statistics["iterations"],
        found.duration,
        (t.array(t.named("state")) / SIZE)[::degree].T,
        within.reshape(len(ends) - 1, count, 2).transpose(0, 2, 1),
        ends / ends[-1],
        points,
    )


def fit(file):
    """fit_force from its own start, with intervals by profile likelihood."""
    cells = json.loads(Path(file).read_text("utf-8"))
    begin = e.clock()
    pressure = [1e5 * p for p in cells["p"]]
    table = pam.fitting.ForceTable(pressure, cells["kappa"], cells["force"])

    def fitted():
        found = pam.fit_force(table, errors="independent")  # as the other tools take them
        return found, found.intervals()

    first, best, (found, intervals) = e.repeated(fitted, begin, 4)
    size = {"a1": 1e5, "a2": 1, "a3": 1, "a4": 1e5, "a5": 1e5, "a6": 1}  # from SI: p in Pa
    e.say(
        "pam_ocp: fit_force",
        first,
        best,
        coefficients=[found.coefficients[n].value * f for n, f in size.items()],
        intervals=[[end * f for end in intervals[n]] for n, f in size.items()],
    )


def simulate(compiled=""):
    """simulate, interpreted or compiled."""
    begin = e.clock()
    plant = slide()
    commands = 1e5 * np.array([e.command(t) for t in e.TIMES]).T
    inputs = dict(zip((u.name for u in plant.inputs), commands, strict=True))
    start = dict(zip((s.name for s in plant.states), e.REST * SIZE, strict=True))
    given = {"t": e.TIMES, "start": start, "interpolation": "linear", "rtol": 1e-8}
    first, best, run = e.repeated(
        lambda: pam.simulate(plant, inputs, compiled=bool(compiled), **given), begin, 6
    )
    name = f"pam_ocp: simulate{', compiled' if compiled else ''}"
    e.say(name, first, best, states=(run.array(run.named("state")) / SIZE).T.tolist())


if __name__ == "__main__":
    task, *words = sys.argv[1:] or ["plan"]
    {"plan": plan, "fit": fit, "simulate": simulate}[task](*words)
