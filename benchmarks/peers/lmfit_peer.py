"""lmfit: leastsq from a start near the truth, conf_interval, which is a profile by the F-test."""

import json
import sys
from pathlib import Path

import equations as e
import lmfit
import numpy as np

START = {"a1": -5.0, "a2": 300.0, "a3": -30.0, "a4": -900.0, "a5": 300.0, "a6": -300.0}
"""The true ones, rounded: from far away it often ends elsewhere, see benchmarks/fit.py."""


def force(p, kappa, a1, a2, a3, a4, a5, a6):
    """The law; p in bar."""
    return (a1 * p + a2) * np.exp(a3 * kappa) + a4 * kappa * p + a5 * p + a6


def main():
    cells = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    begin = e.clock()
    p, kappa, measured = (np.array(cells[n]) for n in ("p", "kappa", "force"))

    def fitted():
        model = lmfit.Model(force, independent_vars=["p", "kappa"])
        fit = model.fit(measured, model.make_params(**START), p=p, kappa=kappa)
        return fit, fit.conf_interval(sigmas=[0.95])

    first, best, (fit, found) = e.repeated(fitted, begin, 4)
    e.say(
        "lmfit: Model.fit, conf_interval",
        first,
        best,
        coefficients=[float(fit.params[n].value) for n in START],
        intervals=[[float(found[n][0][1]), float(found[n][2][1])] for n in START],
    )


main()
