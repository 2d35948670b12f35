"""fit_force of pam_ocp: from its own start, with intervals by profile likelihood."""

import json
import sys
from pathlib import Path

import equations as e

import pam_ocp as pam


def main():
    cells = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    begin, seconds = e.clock(), []
    pressure = [1e5 * p for p in cells["p"]]
    table = pam.fitting.ForceTable(pressure, cells["kappa"], cells["force"])
    for again in range(4):
        ready = e.clock()
        fit = pam.fit_force(table, errors="independent")  # as the other tools take them
        intervals = fit.intervals()
        done = e.clock()
        seconds.append(done - ready)
        if not again:
            first = done, done - begin
    # coefficients in SI: p in Pa
    size = {"a1": 1e5, "a2": 1, "a3": 1, "a4": 1e5, "a5": 1e5, "a6": 1}
    e.say(
        "pam_ocp: fit_force",
        first,
        min(seconds),
        coefficients=[fit.coefficients[n].value * f for n, f in size.items()],
        intervals=[[end * f for end in intervals[n]] for n, f in size.items()],
    )


main()
