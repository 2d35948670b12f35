"""The planner of pam_ocp: 50 intervals of constant input, its own guess."""

import sys
from time import perf_counter

import equations as e
import numpy as np
from pam_ocp_slide import slide

import pam_ocp as pam

METHODS = {
    "held": (pam.Collocation(e.INTERVALS, 3), "pam_ocp: 50 x 3, constant input"),
    "fine": (pam.Collocation(e.INTERVALS, 4), "pam_ocp: 50 x 4, constant input"),
    "high": (
        # the peers do not look at inputs between their points either
        pam.Collocation(6, 9, "polynomial", guarded=False),
        "pam_ocp: 6 x 9, input at the points",
    ),
}


def main():
    method, name = METHODS[sys.argv[1] if len(sys.argv) > 1 else "held"]
    begin = e.clock()
    plant = slide()
    stops, seconds = [{"x": -e.STOP}, {"x": e.STOP}], []
    for again in range(3):
        ready, wall = e.clock(), perf_counter()
        plan = pam.plan(plant, stops, cyclic="mirrored", method=method)
        done, elapsed = e.clock(), perf_counter() - wall
        if not again:
            first = done, done - begin
        # it tells the solver's seconds by the clock: the processor's are the same part of the call
        seconds.append(plan.statistics["solve_seconds"] * (done - ready) / elapsed)
    t = plan.trajectory
    degree, scale = method.degree, [1, 1, 1e-5, 1e-5]
    ends = t.t[::degree]
    # the input is a polynomial in each interval: of degree 0, or through the collocation points
    count = 1 if method.control == "constant" else degree
    points = (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2
    times = ends[:-1, None] + np.diff(ends)[:, None] * points
    within = 1e-5 * t.at(times.ravel()).array(t.named("input"))
    inputs = within.reshape(len(ends) - 1, count, 2).transpose(0, 2, 1)
    states = (t.array(t.named("state")) * scale)[::degree].T
    e.report(
        name,
        first,
        min(seconds),
        plan.statistics["iterations"],
        plan.duration,
        states,
        inputs,
        ends / ends[-1],
        points,
    )


main()
