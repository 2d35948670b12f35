"""The static fit against local solvers from the same random starts: success rate and time.

    python benchmarks/fit.py [starts] [--only WORD ...]

A spreadsheet's solver (generalised reduced gradient) is a local method; SLSQP, the method of its
kind in SciPy, stands for it. IPOPT (the solver of our last step, alone) and lmfit (where it is
installed, else said so) start from the same points. Starts: each coefficient at its nominal size
times 10^(-1 .. 1), of either sign. Success: the sum of squares is within one part in a million of
the least one found. Times as ratios to ours in the same run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import casadi as ca
import harness
import numpy as np
from scipy.optimize import least_squares, minimize

import pam_ocp as pam
from pam_ocp.muscles.law import SixParameterLaw

MUSCLES = {"DMSP-20-300": 0.300, "DMSP-10-250": 0.250}
SIZES = np.array([10.0, 100.0, 0.1, 10.0, 100.0, 100.0])  # a1 .. a6 for p in bar, kappa in %


def squares_of(table: pam.fitting.ForceTable) -> tuple[Callable, Callable]:
    """Residuals and Jacobian over scaled coefficients, p in bar and kappa in %."""
    p, kappa, force = table.pressure / 1e5, table.contraction * 100, table.force

    def residuals(z: np.ndarray) -> np.ndarray:
        a1, a2, a3, a4, a5, a6 = z * SIZES
        with np.errstate(all="ignore"):
            model = (a1 * p + a2) * np.exp(a3 * kappa) + a4 * kappa * p + a5 * p + a6
        return np.nan_to_num(model - force, nan=1e8, posinf=1e8, neginf=-1e8)

    def jacobian(z: np.ndarray) -> np.ndarray:
        a1, a2, a3 = (z * SIZES)[:3]
        with np.errstate(all="ignore"):
            e = np.exp(a3 * kappa)
            columns = [p * e, e, (a1 * p + a2) * kappa * e, kappa * p, p, np.ones_like(p)]
        return np.nan_to_num(np.stack(columns, 1) * SIZES, nan=0.0, posinf=1e8, neginf=-1e8)

    return residuals, jacobian


def slsqp(residuals: Callable, jacobian: Callable, start: np.ndarray) -> float:
    """The gradient method of a spreadsheet, with exact derivatives."""
    answer = minimize(
        lambda z: float(np.sum(residuals(z) ** 2)),
        start,
        jac=lambda z: 2 * jacobian(z).T @ residuals(z),
        method="SLSQP",
        options={"maxiter": 1000, "ftol": 1e-12},
    )
    return float(answer.fun)


def trust_region(residuals: Callable, jacobian: Callable, start: np.ndarray) -> float:
    """SciPy's least_squares with exact derivatives."""
    return 2 * float(least_squares(residuals, start, jac=jacobian, x_scale="jac").cost)


def ipopt(table: pam.fitting.ForceTable) -> Callable[[np.ndarray], float]:
    """IPOPT alone with exact derivatives, from one start."""
    z = ca.SX.sym("z", 6)
    a1, a2, a3, a4, a5, a6 = ca.vertsplit(z * SIZES)
    p, kappa = ca.DM(table.pressure / 1e5), ca.DM(table.contraction * 100)
    model = (a1 * p + a2) * ca.exp(a3 * kappa) + a4 * kappa * p + a5 * p + a6
    options = {
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 1000},
    }
    nlp = {"x": z, "f": ca.sumsqr(model - ca.DM(table.force)) / 1e4}
    solver = ca.nlpsol("local", "ipopt", nlp, options)
    return lambda start: 1e4 * float(solver(x0=start)["f"])


def lmfit_of(table: pam.fitting.ForceTable) -> Callable[[np.ndarray], float]:
    """lmfit's Minimizer (leastsq with exact derivatives)."""
    import lmfit

    residuals, jacobian = squares_of(table)

    def vector(parameters: lmfit.Parameters) -> np.ndarray:
        return np.array([parameters[f"z{i}"].value for i in range(6)])

    def run(start: np.ndarray) -> float:
        parameters = lmfit.Parameters()
        for i, value in enumerate(start):
            parameters.add(f"z{i}", value=value)
        try:
            found = lmfit.minimize(
                lambda q: residuals(vector(q)),
                parameters,
                Dfun=lambda q: jacobian(vector(q)),
                col_deriv=False,
                max_nfev=4000,
            )
        except ValueError:  # it gives up on numbers that overflow
            return float("inf")
        return float(found.chisqr)

    return run


def ours(table: pam.fitting.ForceTable) -> Callable[[np.ndarray], float]:
    """fit_force, with intervals."""
    pam.fit_force(table)  # CasADi builds its functions once

    def run(start: np.ndarray) -> float:
        law = SixParameterLaw.from_published(start * SIZES)
        found = pam.fit_force(table, start={n: float(v) for n, v in law.values.items()})
        found.intervals()
        return float(found.squares)

    return run


METHODS: dict[str, Callable[[pam.fitting.ForceTable], Callable[[np.ndarray], float]]] = {
    "ours, with intervals": ours,
    "SLSQP (GRG's kind)": lambda table: partial(slsqp, *squares_of(table)),
    "SciPy least_squares": lambda table: partial(trust_region, *squares_of(table)),
    "IPOPT alone": ipopt,
    "lmfit": lmfit_of,
}


def one(muscle: str, method: str, starts: np.ndarray) -> harness.Row:
    """Sums of squares from all starts, and milliseconds of a fit."""
    table = pam.read_table(f"{muscle}_static.csv", rest_length=MUSCLES[muscle]).taut
    try:
        run = METHODS[method](table)
    except ImportError as missing:
        return {"verdict": "skipped", "why": [str(missing)]}
    with np.errstate(all="ignore"):  # local solvers run away from some starts
        fits = harness.took(lambda: [run(start) for start in starts])
    each = 1e3 * fits.clock / len(starts)
    return {"muscle": muscle, "method": method, "squares": fits.result, "ms": each}


def cases(given: harness.Given) -> harness.Keyed:
    random = np.random.default_rng(given.seed)
    size = (given.count, 6)
    starts = 10 ** random.uniform(-1, 1, size) * random.choice([-1, 1], size)
    for muscle in MUSCLES:
        for method in METHODS:
            yield f"{muscle}, {method}", partial(one, muscle, method, starts)


def summary(rows: list[harness.Row]) -> str:
    lines = []
    for muscle in MUSCLES:
        found = [r for r in rows if r.get("muscle") == muscle]
        least = min((float(np.nanmin(r["squares"])) for r in found), default=np.nan)
        base = next((r["ms"] for r in found if r["method"].startswith("ours")), np.nan)
        for r in found:
            success = harness.share(s <= least * (1 + 1e-6) for s in r["squares"])
            lines.append([muscle, r["method"], f"{success:.1f} %", r["ms"], r["ms"] / base])
    return harness.table(("muscle", "method", "success", "ms a fit", "time / ours"), lines)


if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=1000, seed=1000)
