"""The static fit against local solvers from the same random starts: success rate and time.

    python benchmarks/fit.py [starts]

A spreadsheet's solver (generalised reduced gradient) is a local method; SLSQP, the method of its
kind in SciPy, stands for it. IPOPT (the solver of our last step, alone) and lmfit (where it is
installed, else said so) start from the same points. Starts: each coefficient at its nominal size
times 10^(-1 .. 1), of either sign. Success: the sum of squares is within one part in a million of
the least one found. Times as ratios to ours in the same run.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import casadi as ca
import numpy as np
from scipy.optimize import least_squares, minimize

import pam_ocp as pam
from pam_ocp.fitting import fit_force
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


def lmfit_of(table: pam.fitting.ForceTable) -> Callable[[np.ndarray], float] | None:
    """lmfit's Minimizer (leastsq with exact derivatives), or None where it is not installed."""
    try:
        import lmfit
    except ImportError:
        return None
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


def main(count: int) -> None:
    random = np.random.default_rng(1000)
    starts = 10 ** random.uniform(-1, 1, (count, 6)) * random.choice([-1, 1], (count, 6))
    print(f"{'muscle':<14}{'method':<24}{'success':>9}{'ms a fit':>10}{'time/ours':>11}")
    for name, length in MUSCLES.items():
        table = pam.read_table(f"{name}_static.csv", rest_length=length).taut
        residuals, jacobian = squares_of(table)
        fit_force(table)  # CasADi builds its functions once

        def ours(start: np.ndarray, table: pam.fitting.ForceTable = table) -> float:
            law = SixParameterLaw.from_published(start * SIZES)
            found = fit_force(table, start={n: float(v) for n, v in law.values.items()})
            found.intervals()
            return found.squares

        results: dict[str, tuple[np.ndarray, float]] = {}
        methods: dict[str, Callable[[np.ndarray], float] | None] = {
            "ours, with intervals": ours,
            "SLSQP (GRG's kind)": partial(slsqp, residuals, jacobian),
            "SciPy least_squares": partial(trust_region, residuals, jacobian),
            "IPOPT alone": ipopt(table),
            "lmfit": lmfit_of(table),
        }
        for method, run in methods.items():
            if run is None:
                print(f"{name:<14}{method:<24}  not installed (pip install lmfit): skipped")
                continue
            began = time.perf_counter()
            found = np.array([run(start) for start in starts])
            results[method] = found, (time.perf_counter() - began) / count
        least = min(float(np.nanmin(found)) for found, _ in results.values())
        reference = results["ours, with intervals"][1]
        for method, (found, seconds) in results.items():
            share = float(np.mean(found <= least * (1 + 1e-6)))
            print(
                f"{name:<14}{method:<24}{100 * share:>7.1f} %{1e3 * seconds:>10.2f}"
                f"{seconds / reference:>11.2f}"
            )


if __name__ == "__main__":
    with np.errstate(all="ignore"):  # local solvers run away from some starts
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
