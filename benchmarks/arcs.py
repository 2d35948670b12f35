"""Planning to tight errors: intervals that move onto switches beside a mesh that is split there.

Processor seconds and intervals to errors from 1e-3 to 1e-8 of nominal (replay and all bounds,
between the points too), for PAM-2DIR (a) and (b), a slide, a joint and two plants of one's own.
*arcs*: `pam.Arcs()`; *split*: `Collocation(6, 9, "polynomial")` refined as it was before arcs.
Medians of ``REPEATS``, both ways in turn in this one process; the ratio is arcs to split. *scipy*:
the inputs found, integrated by DOP853 at 1e-10 from piece to piece.

Run:  python benchmarks/arcs.py [CASE ...] [--fine]     (--fine: all six errors)
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from time import process_time
from typing import Any

import numpy as np
from pam_2dir import slide as benchmark_slide
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.planning.search import Search

REPEATS = 3
TOLERANCES = (1e-3, 1e-6, 1e-8)
FINE = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
SPLIT = pam.Collocation(6, 9, "polynomial")


def a() -> dict[str, Any]:
    """Minimum time, mirrored."""
    stops = [{"x": -0.015}, {"x": 0.015}]
    return {"plant": benchmark_slide(), "stops": stops, "cyclic": "mirrored"}


def b() -> dict[str, Any]:
    """The rate of the commands in 0.15 s, mirrored (the bound of the rate is not reached)."""
    stops = [{"x": -0.015}, {"x": 0.015}]
    asked = {"cyclic": "mirrored", "duration": 0.15, "minimise": "rate"}
    return {"plant": benchmark_slide(), "stops": stops, **asked}


def slide() -> dict[str, Any]:
    """Minimum time between two stops and back."""
    stops = [{"x": -0.01}, {"x": 0.01}, {"x": 0.0}]
    return {"plant": benchmark_slide(), "stops": stops}


def joint() -> dict[str, Any]:
    """Minimum time of an elbow."""
    plant = pam.AntagonisticJoint(
        pam.muscle("DMSP-20-200N"), inertia=0.02, moment_arm=0.03, pre_contraction=0.10
    )
    return {"plant": plant, "stops": [{"theta": -0.2}, {"theta": 0.2}]}


def mass() -> dict[str, Any]:
    """x''' = u with limits of velocity and acceleration: seven arcs."""
    plant = pam.Plant("mass")
    x = plant.state("x", unit="m", nominal=1.0)
    v = plant.state("v", unit="m/s", nominal=1.0, min=-1.0, max=1.0)
    c = plant.state("a", unit="m/s2", nominal=1.0, min=-1.0, max=1.0)
    u = plant.input("u", unit="m/s3", nominal=1.0, min=-4.0, max=4.0)
    for state, rate in ((x, v), (v, c), (c, u)):
        plant.der(state, rate)
    stops = [{"x": 0.0, "v": 0.0, "a": 0.0}, {"x": 3.0, "v": 0.0, "a": 0.0}]
    return {"plant": plant, "stops": stops, "rest": False}


def oscillator() -> dict[str, Any]:
    """x'' = u - sin x: a pendulum, two arcs or more."""
    import casadi as ca

    plant = pam.Plant("pendulum")
    x = plant.state("x", unit="rad", nominal=1.0)
    v = plant.state("v", unit="rad/s", nominal=1.0)
    u = plant.input("u", unit="rad/s2", nominal=1.0, min=-0.8, max=0.8)
    plant.der(x, v)
    plant.der(v, u - ca.sin(x))
    stops = [{"x": 0.0, "v": 0.0}, {"x": 1.5, "v": 0.0}]
    return {"plant": plant, "stops": stops, "rest": False}


CASES: dict[str, Callable[[], dict[str, Any]]] = {
    f.__name__: f for f in (a, b, slide, joint, mass, oscillator)
}


def scipy_error(plan: pam.planning.Plan) -> float:
    """Largest deviation at the plan's samples, in nominals."""
    plant, motion, signals = plan.plant, plan.trajectory, plan.trajectory.signals
    p, nominal = plant.vector("parameter"), plant.vector("state", attribute="nominal")
    states = motion.array(motion.named("state"))
    x, worst, powers = states[0], 0.0, np.arange(signals.degree + 1)
    for k, (begin, end) in enumerate(zip(signals.breaks[:-1], signals.breaks[1:], strict=True)):
        c = signals.coefficients[k]
        own = (motion.t > begin + 1e-12) & (motion.t <= end + 1e-12)

        def slope(t: float, z: np.ndarray, c: np.ndarray = c, begin: float = begin) -> np.ndarray:
            u = ((t - begin) ** powers) @ c
            return np.asarray(plant.function(z * nominal, u, p)[0], float).ravel() / nominal

        at = np.append(np.minimum(motion.t[own], end), end)
        run = solve_ivp(
            slope, (begin, end), x / nominal, "DOP853", np.unique(at), rtol=1e-10, atol=1e-12
        )
        found = run.y[:, : own.sum()].T * nominal
        worst = max(worst, float(np.max(np.abs(found - states[own]) / nominal, initial=0.0)))
        x = run.y[:, -1] * nominal
    return worst


def once(case: dict[str, Any], tolerance: float, arcs: bool) -> tuple[float, pam.planning.Plan]:
    usual = Search._by_arcs
    if not arcs:
        Search._by_arcs = lambda self, c: False  # type: ignore[method-assign]
    begin = process_time()
    try:
        method = pam.Arcs() if arcs else SPLIT
        found = pam.plan(**case, method=method, tolerance=tolerance)
    finally:
        Search._by_arcs = usual  # type: ignore[method-assign]
    return process_time() - begin, found


def main() -> None:
    names = [n for n in sys.argv[1:] if not n.startswith("-")] or list(CASES)
    warnings.simplefilter("ignore", pam.PlanWarning)
    head = ("case", "error", "arcs s", "n", "split s", "n", "ratio", "objective: arcs", "split")
    print("{:<12}{:>7}{:>9}{:>5}{:>9}{:>5}{:>7}{:>17}{:>13}".format(*head), "  scipy  verified")
    for name in names:
        case = CASES[name]()
        for tolerance in FINE if "--fine" in sys.argv else TOLERANCES:
            times: dict[bool, list[float]] = {True: [], False: []}
            plans = {}
            for _ in range(REPEATS):
                for arcs in (True, False):
                    try:
                        seconds, plans[arcs] = once(case, tolerance, arcs)
                    except pam.PlanError as error:
                        print(f"{name}: {error}")
                        continue
                    times[arcs].append(seconds)
            if len(plans) < 2:
                continue
            ours, theirs = (float(np.median(times[each])) for each in (True, False))
            n, m = (plans[each].statistics["intervals"] for each in (True, False))
            one, other = plans[True], plans[False]
            print(
                f"{name:<12}{tolerance:>7.0e}{ours:>9.3f}{n:>5}{theirs:>9.3f}{m:>5}"
                f"{ours / theirs:>7.2f}{one.objective:>17.10g}{other.objective:>13.8g}"
                f"  {scipy_error(one):.0e}  {one.verified}/{other.verified}",
                flush=True,
            )


if __name__ == "__main__":
    main()
