"""Groups of measured.py that grow: curves over intervals, horizon, cells, states and cases.

A figure named NAME@SIZE belongs to the curve NAME; page.py draws the curves and tells their slopes.
"""

from __future__ import annotations

import sys
from time import process_time
from typing import Any

from measuring import BAR, HERE, STOPS, group, slide, timed

PLAIN = 400
"""Intervals beyond which plain CasADi, no figure of ours, takes longer than all else here."""


@group
def intervals(quick: bool) -> dict[str, float]:
    """Growth with the number of intervals, beside plain CasADi."""
    import plain

    import pam_ocp as pam

    plant, found = slide(), {}
    for n in (25, 50, 100) if quick else (25, 50, 100, 200, 400, 800):
        planner = pam.Planner(plant, STOPS, cyclic="mirrored", method=pam.Collocation(n, 3))
        begin = process_time()
        plan = planner(tolerance=None)
        found[f"plan [s]@{n}"] = process_time() - begin
        found[f"iterations@{n}"] = float(plan.statistics["iterations"])
        if n > PLAIN:
            continue
        bare = plain.Plain("a", n)()
        found[f"plan, plain CasADi [s]@{n}"] = bare["seconds"]
        found[f"iterations, plain CasADi@{n}"] = bare["iterations"]
    return found


@group
def mpc_step(quick: bool) -> dict[str, float]:
    """Mpc on the slide, and its growth with the horizon [ms]; worst steps out of 10 000."""
    sys.path.insert(0, str(HERE))
    import mpc
    import numpy as np

    plant, found = mpc.benchmark_plant(), {}
    for horizon in (10, 50) if quick else (10, 25, 50, 100, 200):
        for how, compiled in (("Mpc", False), ("Mpc compiled", True)):
            for name, iterations in (("one iteration", 1), ("converged", 30)):
                steps = 200 if horizon != 50 or quick else 10_000 if compiled else 1000
                options = {"iterations": iterations, "compiled": compiled}
                _, seconds = mpc.run(plant, horizon, False, steps, **options)
                middle = 1e3 * float(np.median(seconds))
                found[f"{how}, {name} [ms]@{horizon}"] = middle
                if horizon == 50:
                    found[f"{how} 50, {name} [ms]"] = middle
                    worst = 1e3 * float(seconds.max()) / middle
                    found[f"{how} 50, {name}, worst / median"] = worst
    return found


@group
def fit_cells(quick: bool) -> dict[str, float]:
    """fit_force with intervals, and SciPy's Levenberg-Marquardt, over the number of cells."""
    import numpy as np
    from scipy.optimize import curve_fit

    import pam_ocp as pam

    law, found = pam.muscle("DMSP-20-200N").force, {}
    random = np.random.default_rng(20)

    def formula(at: Any, a1: float, a2: float, a3: float, a4: float, a5: float, a6: float) -> Any:
        p, kappa = at
        return (a1 * p + a2) * np.exp(a3 * kappa) + a4 * kappa * p + a5 * p + a6

    begin = list(law.published) if hasattr(law, "published") else [-4.0, 292, -33, -934, 294, -280]
    for count in (60, 1000) if quick else (60, 300, 1000, 10_000, 50_000):
        p, kappa = random.uniform(0.5, 6, count) * BAR, random.uniform(0, 0.2, count)
        force = np.asarray(law(p, kappa)).ravel() + random.normal(0, 5.0, count)
        table = pam.fitting.ForceTable(p, kappa, force, rest_length=0.3).taut
        once = process_time()
        pam.fit_force(table).intervals()
        once = process_time() - once
        work = lambda t=table: pam.fit_force(t).intervals()  # noqa: E731
        found[f"fit_force with intervals [s]@{count}"] = timed(work, 1) if once < 5 else once
        at = np.array([table.pressure / BAR, table.contraction])
        begin[2] = -20.0
        lm = lambda a=at, t=table: curve_fit(formula, a, t.force, begin, maxfev=20000)  # noqa: E731
        found[f"SciPy LM [s]@{count}"] = timed(lm, 1)
    return found


def chain(count: int, pushed: int = 1) -> Any:
    """Masses in a row between springs and dampers, 2 count states; so many of them are pushed."""
    import pam_ocp as pam

    plant = pam.Plant("chain", "masses between springs")
    q = [plant.state(f"q{i}", nominal=0.01) for i in range(count)]
    v = [plant.state(f"v{i}", nominal=0.1) for i in range(count)]
    push = [plant.input(f"push{i}", start=1.0, min=-20.0, max=20.0) for i in range(pushed)]
    for i in range(count):
        left = q[i - 1] if i else 0
        right = q[i + 1] if i + 1 < count else 0
        force = 400 * (left - 2 * q[i] + right) - 3 * v[i] - 1e4 * q[i] ** 3
        plant.der(q[i], v[i])
        plant.der(v[i], force + (push[i] if i < pushed else 0))
    return plant


@group
def states(quick: bool) -> dict[str, float]:
    """A simulation, and a plan (quickest from rest to rest, each mass pushed), over the states."""
    import numpy as np

    import pam_ocp as pam

    found, t = {}, np.linspace(0.0, 1.0, 101)
    push, common = {"push0": np.sin(20 * t)}, {"t": t, "rtol": 1e-8}
    for count in (2, 8) if quick else (2, 4, 8, 12, 18):
        plant, many = chain(count), 2 * count
        run = lambda p=plant, **way: pam.simulate(p, push, **common, **way)  # noqa: E731
        found[f"simulate [s]@{many}"] = timed(run, 3)
        machine = lambda r=run: r(compiled=True)  # noqa: E731
        found[f"simulate, compiled [s]@{many}"] = timed(machine, 9)
        stops = [{f"q{i}": place for i in range(count)} for place in (0.0, 0.01)]
        planner = pam.Planner(chain(count, count), stops, method=pam.Collocation(30, 3))
        made: list[Any] = []
        seconds = timed(lambda p=planner, m=made: m.append(p(tolerance=None)), 1)
        found[f"plan, masses in a row [s]@{many}"] = seconds
        found[f"iterations, masses in a row@{many}"] = float(made[-1].statistics["iterations"])
    return found


@group
def cases(quick: bool) -> dict[str, float]:
    """What the loop over cases adds to a plain loop, and what two processes gain (wall)."""
    sys.path.insert(0, str(HERE))
    import many

    return many.figures(quick)
